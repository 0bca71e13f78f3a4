"""One module per stage: read the files of a unit, call the library, write files; ``batch`` runs a stage on a batch."""
