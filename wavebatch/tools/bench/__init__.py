"""`wavebatch bench`: error against run time of chains, on waveforms with known echoes.

command                        the benchmark as a whole; scenes, chains: what is measured
accuracy, truth, figures       how well echoes are found, with a standard error of every figure
speed, worker                  how long it takes, in processes with one thread
report, plot                   tables, files and plots

What only releases need is in tests/bench and runs by `make bench`: other decomposers, stiff cases, promised figures,
pairs of versions, echoes injected into real strips.
"""
