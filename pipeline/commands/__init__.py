"""Commands for people: simulate, new, explain, config."""
