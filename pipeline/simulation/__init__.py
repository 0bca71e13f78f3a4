"""A table and a sensor, with any effect hidden in them."""

REST_BY_HAND_S = 4.0  # planned length of a rest by hand: rests of less than 2 s may not be found
