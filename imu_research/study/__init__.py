"""The blind study: measure how often the diagnosis finds the effects that are hidden in simulated units.

A case is drawn, simulated and diagnosed in memory. Its truth is written to a file that the diagnosis never reads.
"""
