"""The founding document beside what this product makes of its experiment (Sudsanguan 2019, Sudsanguan 2018).

The campaign ``data/thesis`` simulates every device, table and procedure of the thesis and calibrates each by every
method; this package lays the figures that were printed beside those that come out, and judges its conclusions over many
seeds. See docs/thesis.md.
"""
