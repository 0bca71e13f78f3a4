"""Base and effects from hand-held rests and moves, where no table says what the body did.

A rest tells the length of gravity to the accelerometer, and rate zero to the gyroscope; a move tells the gyroscope that
it must turn the direction of gravity before it into that after it. The models of both sensors are brought to one linear
form (``equations``), on which fit and selection work.
"""
