"""How a calibration is measured, kept and used: files of targets, their echoes, tie points between strips, checks.

`calibration_files` reads the targets, and reads and writes CAL.toml. `strip_echoes` decomposes a strip as `wavebatch
run` does and keeps clean single echoes. `targets` measures the constant of each channel on targets, `adjust_flight`
ties channels and strips to each other where they overlap; `calibrate_flight` is the entry point.
`surveying.matching` finds out whether a calibration fits the strip that it is used for.
"""
