"""What the sensor and the scene of a strip are, measured on a sample of its waveforms, and which chain they need.

`measure` finds noise, baseline, pulse width and saturation, `learn_pulse` the shape of the pulse from clear isolated
echoes, `survey` all of it with its decisions, `flat_ground` how wide echoes of level ground are once the beam is
known. `choose_chain` gives a strip its chain and its pulse, `sensor` says where the sensor was.
"""

from wavebatch.surveying.survey import SAMPLE, Decision, Survey, join_digitizers, survey_block, survey_blocks

__all__ = ["SAMPLE", "Decision", "Survey", "join_digitizers", "survey_block", "survey_blocks"]
