"""Filters, rests and turns, noise, temperature."""
