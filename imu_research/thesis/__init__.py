"""Comparison with the thesis on which this product is founded (Sudsanguan 2019, Sudsanguan 2018).

The campaign ``data/thesis`` simulates every device, table and procedure of the thesis and calibrates each by every
method; this package compares the printed figures with the results, and tests the conclusions over many seeds. See
docs/evidence.md.
"""
