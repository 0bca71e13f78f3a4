"""Commands for people: one module each, with ``main(argv)``."""
