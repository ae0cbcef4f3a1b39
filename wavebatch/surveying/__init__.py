"""What the sensor and the scene of a strip are, measured on a sample of its waveforms, and which chain they need.

How a strip is surveyed:

1. In the folder `measuring`, `noise_and_width` fits the echoes that are alone in their waveform, and finds noise,
   baseline, pulse width and saturation from them, `learn_pulse` the pulse's shape; `residuals` finds the noise again
   from what fits leave, `misfit` what the pulse does not explain.
2. `survey` runs these and decides which parts of a chain the scene needs. Its result and the file
   of it are in `systems/survey_result`. `look` is the short survey by which strips are compared with a result.
3. `choose_chain` turns the decisions into a chain, and gives each strip its pulse and its chain; `predict_error` tries
   the shipped chains for `--tolerance`.
4. `sensor` finds where the sensor was. With that and the beam's divergence, `flat_ground` measures how wide the echoes
   of level ground are, and predicts how well widths measure angles.

`calibration` and the folder `calibrating` use and make calibrations; `inspect_strip` serves
`wavebatch check`.
"""

from __future__ import annotations

TYPE_CHECKING = False
if TYPE_CHECKING:
    from wavebatch.surveying.survey import Decision, Survey, join_digitizers, survey_block, survey_blocks

__all__ = ["Decision", "Survey", "join_digitizers", "survey_block", "survey_blocks"]


def __getattr__(name: str) -> object:
    """Import the survey when it is first used: `info` looks at strips without one."""
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from wavebatch.surveying import survey

    return getattr(survey, name)
