"""What the sensor and the scene of a strip are, measured on a sample of its waveforms.

`measuring` finds noise, baseline, pulse width and saturation, `learning` the shape of the pulse from clear isolated
echoes, `scene` all of a survey with its decisions; `levels` how wide level ground's echoes are, once the beam is known.
"""

from wavebatch.survey.scene import SAMPLE, Decision, Survey, join_digitizers, survey_block, survey_blocks

__all__ = ["SAMPLE", "Decision", "Survey", "join_digitizers", "survey_block", "survey_blocks"]
