"""Comparison of two results of one strip: clouds, chains, the vendor's returns, or the truth of a simulation.

`wavebatch compare` calls `clouds` (cloud with cloud, strip or truth) and `chains` (chains that run on a strip, and how
well they fit it). Each brings echoes of the same pulse together; `pairing` pairs them, and sums up the pairs and the
echoes without a partner. Memory is bounded in all. `angle_table` is for `survey --angles`.
"""
