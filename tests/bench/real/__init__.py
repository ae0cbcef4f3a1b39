"""How well the echoes of a real strip are found, measured on the strip alone: `make bench-real STRIP=...`.

`pool` reads waveforms, `noise` measures their quiet samples, `templates` learns pulses from clear echoes, `inject` adds
them to other waveforms. `false_echoes` counts echoes that a chain should not have found. `measure` does all of it
and counts what was found, `report` writes it down; `__main__` reads the command line.
"""
