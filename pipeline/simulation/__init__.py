"""A table and a sensor, with any effect hidden in them."""
