"""Comparison of two results of one strip: clouds, chains, the vendor's returns, or the truth of a simulation.

`wavebatch compare` calls `clouds` (cloud with cloud, strip or truth), `chains` (chains that run on a strip) and
`angles` (incidence angles). Each brings echoes of the same pulse together; `pairing` then pairs them. `differences`,
`breakdown` and `goodness` sum up the pairs, the echoes without a partner, and the fits. Memory is bounded in all.
"""
