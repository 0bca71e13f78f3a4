"""The blind study: how often the diagnosis names what is hidden in simulated units.

A case is drawn, simulated and diagnosed in memory; its truth goes to a file that the diagnosis never reads.
"""
