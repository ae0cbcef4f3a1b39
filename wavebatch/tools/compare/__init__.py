"""Comparison of two results of one strip: clouds, chains, the vendor's returns, or the truth of a simulation.

`wavebatch compare` calls `pairing` (cloud with cloud, strip or truth) and `chains` (chains that run on a strip, and how
well they fit it). Echoes of the same pulse are brought together and paired; `pairing` sums up the pairs and the echoes
without a partner. Memory is bounded in all.
"""
