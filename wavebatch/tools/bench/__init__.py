"""`wavebatch bench`: error against run time of chains, on waveforms with known echoes.

command     the benchmark as a whole, its scenes, its chains and their run time, in processes with one thread;
            its tables, files and plots
accuracy    how well echoes are found, against truth and bounds, with a standard error of every figure

What only releases need is in tests/bench and runs by `make bench`: other decomposers, stiff cases, promised figures,
pairs of versions, echoes injected into real strips.
"""
