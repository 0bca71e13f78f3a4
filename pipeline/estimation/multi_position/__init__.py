"""Calibration by rests and moves (multi-position), for recordings without the log of a table.

At rest the specific force has the magnitude of gravity and the rate is zero; the integrated rate of a move must rotate
gravity before it onto gravity after it. Both sensors are brought to one linear form (``model``).
"""
