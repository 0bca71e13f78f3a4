"""Predict which effects a procedure could find, and propose what to record next."""
