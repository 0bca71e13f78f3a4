"""What all rooms share: records of readings and results, settings, errors, files."""

VERSION = "0.1.0"
