"""How well the echoes of a real strip are found, measured on the strip alone: `wavebatch bench --real`.

`pool` reads waveforms, `noise` measures their quiet samples, `templates` learns pulses from clear echoes, `places` and
`inject` add them to other waveforms. `recall` and `false_echoes` count what a chain finds and what it should not have
found, `agreement` compares surveys of parts of the strip. `measure_real` does all of it, `report` writes it down.
"""

from wavebatch.tools.bench.real.measure import RealReport, measure_real

__all__ = ["RealReport", "measure_real"]
