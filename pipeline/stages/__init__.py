"""One thin module per stage: read files, call one library function, write files."""
