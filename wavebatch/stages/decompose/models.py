"""Decomposers for comparison: other pulse models, and Gauss-Newton steps without damping."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import log
from wavebatch.kernels.fit.cluster import Solution, choose
from wavebatch.kernels.fit.decompose import decompose_clusters
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape, evaluate_pulse, tabulate_pulse
from wavebatch.stages.chain import stage
from wavebatch.stages.decompose.group import find_clusters
from wavebatch.stages.decompose.solve import FIT, describe_solution, fit_candidates, fit_gaussian, make_settings
from wavebatch.stages.detect.candidates import samples_of
from wavebatch.stages.pulse_tables import pulse_shape, shape_limits
from wavebatch.stages.reference_pulse import reference_pulse

POWERS = (1.4, 1.7, 2.0, 2.4, 3.0, 4.0)
"""Exponents of the generalized Gaussian that are tried for every cluster."""


def _fit_reference(system: SystemPulse, parameters: Mapping[str, Any]) -> SystemPulse:
    """The system with the pulse that `reference` fits; of a stretched one the width is that at half maximum."""
    return system if parameters["model"] == "broadened" else replace(system, components=(), kappa=0.0)


def _shape_reference(system: SystemPulse, spacing: float, parameters: Mapping[str, Any]) -> PulseShape:
    """The pulse that `reference` fits."""
    if parameters["model"] == "stretched":
        return _tabulate_system(system, pulse_shape(system, spacing), spacing)
    if parameters["model"] == "given":
        taps, _ = reference_pulse(system, spacing, "given", pulse=parameters["pulse"])
        return PulseShape(table=tabulate_pulse(np.arange(len(taps), dtype=np.float64), taps))
    return pulse_shape(system, spacing)


@stage("decompose", fits=_fit_reference, shape=_shape_reference, shares=FIT)
def reference(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    model: Literal["broadened", "stretched", "given"] = "broadened",
    pulse: str = "",
    **options: Any,
) -> EchoTable:  # fmt: skip
    """Sum of system pulses, broadened by a Gaussian target or stretched in time; no echo is added.

    The amplitude is that of the pulse's peak, the time that of its datum (the Gaussian that fits a flat target's echo),
    the width its full width at half maximum over 2.354820.

    Parameters
    ----------
    model : {"broadened", "stretched", "given"}
        `broadened` for the survey's pulse convolved with a Gaussian, `stretched` for this pulse stretched in time,
        `given` for the pulse below, stretched.
    pulse : str
        Samples of the given pulse, separated by spaces, with the spacing of the waveform.

    References
    ----------
    docs/algorithms.md R1; Mallet and Bretar (2009).
    """
    shape = _shape_reference(system, block.spacing, {"model": model, "pulse": pulse})
    fit = replace(FIT, **options)
    settings = make_settings(block, system, shape, fit, grow=False)
    if model != "broadened":
        system = replace(system, components=())
    return fit_candidates(block, noise, system, echoes, settings, significance=fit.significance)


def _tabulate_system(system: SystemPulse, shape: PulseShape, spacing: float) -> PulseShape:
    """Tabulate the survey's pulse."""
    ref = shape_limits(system, spacing).ref
    ends = [-6 * ref, 6 * ref]
    for _, delay, extra in shape.components:
        wide = 5 * np.sqrt(ref * ref + extra)
        ends = [min(ends[0], delay - wide), max(ends[1], delay + wide)]
    x = np.arange(ends[0], ends[1], ref / 16)
    value = evaluate_pulse(shape, x[:, None].copy(), np.zeros(1), np.full(1, ref))[0][:, 0]
    return PulseShape(table=tabulate_pulse(x, value))


@stage("decompose", fits=fit_gaussian, shares=FIT)
def generalized_gaussian(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, **options: Any
) -> EchoTable:
    """Sum of generalized Gaussians exp(-|z|^p / 2); the exponent is chosen for each cluster of echoes.

    Exponents from 1.4 (peaked) over 2 (Gaussian) to 4 (flat) are tried, the least chi2 wins. The width is the full
    width at half maximum over 2.354820.

    References
    ----------
    Chauve et al. (2007), eq. 4.
    """
    fit = replace(FIT, **options)
    plain = make_settings(block, system, GAUSSIAN, fit, grow=False)
    candidates, clusters = find_clusters(block, noise, system, echoes, plain)
    samples, solutions = samples_of(block, noise), []
    for power in POWERS:
        factor = half_width_factor(power)
        widths = {name: getattr(plain, name) / factor for name in ("width_ref", "width_low", "width_high")}
        settings = plain._replace(shape=PulseShape(power=power), **widths)
        solutions.append(_as_half_width(decompose_clusters(samples, candidates, clusters, settings), factor))
    chosen = np.argmin([solution.cost for solution in solutions], axis=0)
    best = choose(solutions, chosen)
    columns = {"power": np.array(POWERS, np.float32)[chosen[best.cluster]]}
    return describe_solution(block, noise, system, clusters, best, plain, fit.significance, columns)


def half_width_factor(power: float) -> float:
    """Return the full width at half maximum of exp(-|z|^p / 2) over 2.354820.

    Parameters
    ----------
    power : float
        Exponent p.

    Returns
    -------
    float
        1 for a Gaussian.
    """
    return float(2 * (2 * log(2)) ** (1 / power) / FWHM_PER_SIGMA)


def _as_half_width(solution: Solution, factor: float) -> Solution:
    """Multiply the widths of a solution by the factor."""
    scale = np.array([1.0, 1.0, factor, 1.0])
    return solution._replace(
        parameters=solution.parameters * scale, errors=solution.errors * scale, shared=solution.shared * factor
    )
