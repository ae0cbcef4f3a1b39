"""Decomposers with skewed pulses: the log-normal of Wang et al. with a skew per strip or per echo."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.cluster import Clusters
from wavebatch.kernels.fit.free_skew import MOST_SKEW, SkewFit, SkewPrior, fit_skews
from wavebatch.kernels.fit.grow import Settings, Solution, decompose_clusters
from wavebatch.kernels.fit.least_squares import Limits
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape
from wavebatch.stages.chain import Range, stage
from wavebatch.stages.decompose.group import find_clusters
from wavebatch.stages.decompose.solve import (
    LeastWidth,
    MostWidth,
    alike_clusters,
    cut_alike,
    describe_solutions,
    fit_candidates,
    make_settings,
)
from wavebatch.stages.pulse_tables import LEAST_WIDTH, MOST_WIDTH, pulse_shape

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


def skewed_shape(system: SystemPulse, kappa: float) -> PulseShape:
    """Return the pulse that `skewed` fits.

    Parameters
    ----------
    system : SystemPulse
        Result of the survey.
    kappa : float
        Skew; 0 takes the value of the survey.

    Returns
    -------
    PulseShape
        Skewed, or Gaussian where the skew is negligible.
    """
    return pulse_shape(replace(system, components=(), kappa=kappa or system_skew(system)), 1.0)


def _fit_skewed(system: SystemPulse, parameters: Mapping[str, Any]) -> SystemPulse:
    """The system with the pulse that `skewed` fits; echoes with skews of their own carry them."""
    kappa = parameters["kappa"]
    return replace(system, components=(), kappa=0.0 if kappa == "free" else kappa or system_skew(system))


@stage("decompose", fits=_fit_skewed)
def skewed(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    kappa: Annotated[float, Range(-0.9, 0.9)] | Literal["free"] = 0.0,
    max_iterations: Annotated[int, Range(1, 1000)] = 40,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 0.5,
    significance: Annotated[float, Range(0.0, 1e6)] = 5.0,
    least_width: LeastWidth = LEAST_WIDTH,
    most_width: MostWidth = MOST_WIDTH,
) -> EchoTable:  # fmt: skip
    """Sum of skewed pulses: the log-normal of Wang et al. in its stable form, with one skew for the strip or per echo.

    The time is that of the peak. With `kappa = "free"` every echo gets its skew, within 0.6 and with a prior: a normal
    law around the strip's skew, as wide as the survey saw the skews of single echoes scatter. `attribute.skew` writes
    it with its error.

    Parameters
    ----------
    kappa : float or "free"
        Skew; 0 takes the value of the survey, "free" fits one per echo.
    max_iterations : int
        An echo that has not converged after so many is flagged.
    tolerance : float
        A fit ends with the step that promises a smaller fall of chi2.
    significance : float
        Least energy of an echo [standard deviations of the noise's energy].
    least_width : float
        Smallest width of an echo [widths of the system pulse].
    most_width : float
        Largest width of an echo [widths of the system pulse].

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 0, 1.2.
    """
    shape = skewed_shape(system, 0.0 if kappa == "free" else kappa)
    settings = make_settings(
        block, system, shape, widths=(least_width, most_width), tolerance=tolerance, max_iterations=max_iterations,
        grow=False,
    )  # fmt: skip
    if kappa != "free":
        return fit_candidates(block, noise, system, echoes, settings, significance=significance)
    prior = SkewPrior(shape.kappa, system.skew_spread or UNKNOWN_SPREAD)
    return fit_each(block, noise, system, echoes, settings, significance, prior=prior)


def fit_each(
    block: WaveformBlock,
    noise: Noise,
    system: SystemPulse,
    echoes: EchoTable,
    settings: Settings,
    significance: float,
    *,
    prior: SkewPrior | None = None,
    origin: str = "",
) -> EchoTable:
    """Fit one shape for all echoes first, then from there a skew per echo, which becomes a column.

    Parameters
    ----------
    block, noise, system, echoes, significance
        As for a stage.
    settings : Settings
        Pulse, limits and options of the first fit.
    prior : SkewPrior, optional
        Of free skews.
    origin : {"", "segment", "waveform"}
        Where the samples of a log-normal begin that fixes its skew; empty for free skews.

    Returns
    -------
    EchoTable
        Fitted echoes with the columns skew and skew_err.
    """
    candidates, clusters = find_clusters(block, noise, system, echoes, settings)
    solutions: list[Solution] = []
    columns = {name: [np.empty(0, np.float32)] for name in ("skew", "skew_err")}
    for solution in decompose_clusters(
        block.samples, noise.for_fits, noise.std, candidates, clusters, settings, block.missing
    ):
        number = _with_number(clusters, solution)
        for part in alike_clusters(number, solution.cluster, block):
            one = solution.take(part)
            fit, begin = _refit(block, noise, clusters, one, settings, prior, origin)
            parameters = fit.parameters[:, :3].copy()
            parameters[:, 1] += begin[:, None]
            errors = fit.errors[:, :3]
            # The skew takes part in the area: its error is not that of amplitude and width alone.
            unknown = np.full_like(errors[:, :2], np.nan)
            found = (fit.misfit, fit.cost, fit.converged, fit.at_bound)
            solutions.append(Solution(one.cluster, parameters, errors, unknown, *found))
            columns["skew"].append(fit.parameters[:, 3].reshape(-1).astype(np.float32))
            columns["skew_err"].append(fit.errors[:, 3].reshape(-1).astype(np.float32))
    joined = {name: np.concatenate(values) for name, values in columns.items()}
    # Widths and times are of the skewed pulse, which has no further components to be described.
    plain = settings._replace(shape=GAUSSIAN)
    return describe_solutions(block, noise, system, clusters, solutions, plain, significance, joined)


def _with_number(clusters: Clusters, solution: Solution) -> Clusters:
    """The clusters with the number of echoes that a solution has: fits may have left some out."""
    number = clusters.number.copy()
    number[solution.cluster] = solution.parameters.shape[2]
    return clusters._replace(number=number)


def _refit(
    block: WaveformBlock,
    noise: Noise,
    clusters: Clusters,
    solution: Solution,
    settings: Settings,
    prior: SkewPrior | None,
    origin: str,
) -> tuple[SkewFit, np.ndarray]:
    """Fits from a solution, in samples of their windows, and where each window begins."""
    rows = solution.cluster
    windows, begin = cut_alike(block, noise, clusters, rows, settings)
    skew = np.full_like(solution.parameters[:, :1], settings.shape.kappa)
    start = np.concatenate([solution.parameters, skew], axis=1)
    start[:, 1] -= begin[:, None]
    low = np.zeros((len(rows), 4, 1))
    high = np.zeros_like(low)
    low[:, 0], high[:, 0] = 0.0, 1e9
    low[:, 1, 0], high[:, 1, 0] = clusters.low[rows] - begin - 3.0, clusters.high[rows] - begin + 2.0
    low[:, 2], high[:, 2] = settings.width_low, settings.width_high
    low[:, 3], high[:, 3] = -MOST_SKEW, MOST_SKEW
    first = None
    if origin:
        low[:, 3], high[:, 3] = -np.inf, np.inf
        first = (clusters.low[rows] if origin == "segment" else np.zeros(len(rows))) - begin - 1.0
    fit = fit_skews(
        windows, start, Limits(low, high), prior=prior, origin=first, tolerance=settings.tolerance,
        max_iterations=settings.max_iterations,
    )  # fmt: skip
    return fit, begin
