"""What a file of a stranger seems to be: its shape, units and motion, and the ingest profile that would read it."""
