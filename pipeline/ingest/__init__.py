"""Read files to recordings in the units and the body axes of the package."""
