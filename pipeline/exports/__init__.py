"""One module per format that consumes a calibration."""
