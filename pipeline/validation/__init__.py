"""Errors on held-out motion, beside the noise floor."""
