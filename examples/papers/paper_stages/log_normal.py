"""The log-normal as Wang et al. print it, with three parameters per echo (docs/algorithms.md 1.2)."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from wavebatch import EchoTable, Noise, SystemPulse, WaveformBlock, stage
from wavebatch.kernels.fit.pulse_shape import PulseShape
from wavebatch.stages.decompose.skew import fit_each
from wavebatch.stages.decompose.solve import FitOptions, make_settings

_FIT = FitOptions(max_iterations=60)


def _fit_log_normal(system: SystemPulse, parameters: Mapping[str, Any]) -> SystemPulse:
    """Echoes carry their skews, with which they are drawn."""
    return replace(system, components=(), kappa=0.0)


@stage("decompose", makes=("skew", "skew_err"), fits=_fit_log_normal, shares=_FIT)
def log_normal(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    origin: Literal["segment", "waveform"] = "segment",
    **options: float,
) -> EchoTable:  # fmt: skip
    """Sum of log-normals as the paper prints them, a exp(-(ln x - mu)^2 / (2 sigma^2)): three parameters per echo.

    For comparison. The formula needs an origin of x, which the paper does not name, and the origin decides the skew: it
    is the width over the distance of the peak from the origin. Counted from the start of the waveform there is hardly
    any skew; counted from the start of the echo's own samples it depends on the amplitude. `decompose.skewed` has the
    same pulse with a skew that the data choose.

    Parameters
    ----------
    origin : {"segment", "waveform"}
        Sample with x = 1: the first one of the samples that are fitted together, or of the waveform.

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 1.2.
    """
    fit = replace(_FIT, **options)
    settings = make_settings(block, system, PulseShape(origin=origin), fit, grow=False)
    return fit_each(block, noise, system, echoes, settings, fit.significance)
