"""Decomposers with skewed pulses: the log-normal of Wang et al. with a skew per strip or per echo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.cluster import Settings
from wavebatch.kernels.fit.decompose import decompose_clusters
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.decompose.group import find_clusters
from wavebatch.stages.decompose.solve import FIT, FitOptions, describe_solution, fit_candidates, make_settings
from wavebatch.stages.detect.candidates import samples_of
from wavebatch.stages.pulse_tables import pulse_shape

UNKNOWN_SPREAD = 0.15
"""Spread of skews where the survey did not measure it: Wang et al. have 0 to 0.18 for two sensors and two targets."""


def system_skew(system: SystemPulse) -> float:
    """Return the skew of a strip, whichever pulse its survey chose.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.

    Returns
    -------
    float
        0 for a Gaussian.

    Raises
    ------
    ConfigError
        The survey chose a learned pulse and its file does not hold the skew.
    """
    if system.kappa or not system.components:
        return system.kappa or system.skew or 0.0
    if system.skew is None:
        raise ConfigError(
            "kappa: this strip's pulse is a sum of Gaussians and its survey holds no skew (too few clear single "
            "echoes, or a system file of an older version); survey again, or give kappa"
        )
    return system.skew


def skew_system(system: SystemPulse, parameters: Mapping[str, Any]) -> SystemPulse:
    """Return the system with the pulse that `skewed` fits.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    parameters : mapping
        Of the stage: kappa.

    Returns
    -------
    SystemPulse
        Skewed; without a skew where echoes have skews of their own, which they carry.
    """
    kappa = parameters["kappa"]
    return replace(system, components=(), kappa=0.0 if kappa == "free" else kappa or system_skew(system))


@stage("decompose", fits=skew_system, shares=FIT)
def skewed(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    kappa: Annotated[float, Range(-0.9, 0.9)] | Literal["free"] = 0.0,
    **options: Any,
) -> EchoTable:  # fmt: skip
    """Sum of skewed pulses: the log-normal of Wang et al. in its stable form, with one skew for the strip or per echo.

    With `kappa = "free"` every echo gets its skew, within 0.6 and with a prior: a normal law around the skew of the
    strip, with the spread of single echoes that the survey measured. `attribute.skew` writes it with its error. The
    time is then that of the peak; with one skew for the strip it is that of the datum, as for every other pulse.

    Parameters
    ----------
    kappa : float or "free"
        Skew; 0 takes the value of the survey, "free" fits one per echo.

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 0, 1.2.
    """
    shape = pulse_shape(skew_system(system, {"kappa": 0.0 if kappa == "free" else kappa}), block.spacing)
    fit = replace(FIT, **options)
    settings = make_settings(block, system, shape, fit, grow=False)
    if kappa != "free":
        return fit_candidates(block, noise, system, echoes, settings, significance=fit.significance)
    free = settings._replace(skew_mean=shape.kappa, skew_spread=system.skew_spread or UNKNOWN_SPREAD)
    return fit_each(block, noise, system, echoes, free, fit.significance)


def fit_each(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    settings: Settings,
    significance: float,
) -> EchoTable:
    """Fit with a skew per echo, which becomes a column with its error.

    Parameters
    ----------
    block, noise, system, echoes, significance
        As for a stage.
    settings : Settings
        Pulse, limits and options of the fit.

    Returns
    -------
    EchoTable
        Fitted echoes with the columns skew and skew_err.
    """
    candidates, clusters = find_clusters(block, noise, system, echoes, settings)
    solution = decompose_clusters(samples_of(block, noise), candidates, clusters, settings)
    columns = {
        "skew": solution.parameters[:, 3].astype(np.float32),
        "skew_err": solution.errors[:, 3].astype(np.float32),
    }
    # The skew takes part in the area: its error is not that of amplitude and width alone.
    solution = solution._replace(shared=np.full_like(solution.shared, np.nan))
    # Widths and times are of the skewed pulse, which has no further components to be described.
    plain = settings._replace(shape=GAUSSIAN)
    return describe_solution(block, noise, system, clusters, solution, plain, significance, columns)


_LOG_NORMAL = FitOptions(max_iterations=60)


def _fit_skews(system: SystemPulse, parameters: Mapping[str, Any]) -> SystemPulse:
    """Echoes carry their skews, with which they are drawn."""
    return replace(system, components=(), kappa=0.0)


@stage("decompose", makes=("skew", "skew_err"), fits=_fit_skews, shares=_LOG_NORMAL)
def log_normal(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    origin: Literal["segment", "waveform"] = "segment",
    **options: Any,
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
    fit = replace(_LOG_NORMAL, **options)
    settings = make_settings(block, system, PulseShape(origin=origin), fit, grow=False)
    return fit_each(block, noise, system, echoes, settings, fit.significance)
