"""Estimators of the measurement model: least squares, staged, Cholesky/LU, their uncertainty and observability."""
