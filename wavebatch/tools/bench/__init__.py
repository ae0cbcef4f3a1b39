"""`wavebatch bench`: error against run time of chains and other decomposers, on waveforms with known echoes.

command                        the benchmark as a whole; scenes, chains: what is measured
accuracy, truth, figures       how well echoes are found, with a standard error of every figure
speed, worker, peers           how long it takes, in processes with one thread; other decomposers
cases, stability               the stiff cases of docs/algorithms.md 3, and what goes wrong in them
report, plot, promises         tables, files and plots; comparison with the promised figures
"""
