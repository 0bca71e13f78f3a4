"""Calibration of the gyroscope: each module is one stage of a fit.

Importing one does not import the others, so that a job pays only for its own stage.
"""
