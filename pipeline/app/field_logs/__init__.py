"""Compensation of field logs: a log in, the same log with calibrated readings out, in a stream."""
