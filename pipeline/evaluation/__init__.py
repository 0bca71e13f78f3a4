"""What the fits leave: errors on held-out motion, and the effects that the model lacks."""
