"""What all rooms share: records of readings and results, settings, errors, files."""
