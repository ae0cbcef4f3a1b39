"""What two results of one strip have in common: a cloud with a cloud, the strip, the truth, or chain with chain.

`clouds`, `chains` and `angles` each read two sides and bring together what may be of one pulse; `pairing` pairs its
echoes; `differences`, `breakdown` and `goodness` sum up how pairs differ, what has no partner, and how well fits fit.
"""
