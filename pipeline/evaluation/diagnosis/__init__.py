"""Where the model fails and which physical effect is missing."""
