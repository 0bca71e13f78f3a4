"""Calibration of the gyroscope: each module is one stage of a fit, and a job imports its own stage alone."""
