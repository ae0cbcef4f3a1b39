"""Error against run time: chains and peers on simulated truth, with a standard error beside every figure."""
