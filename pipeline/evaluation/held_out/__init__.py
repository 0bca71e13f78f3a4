"""Errors on held-out motion, and the noise floor."""
