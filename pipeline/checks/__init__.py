"""What the recordings of one unit say about each other, between reading them and filtering them."""
