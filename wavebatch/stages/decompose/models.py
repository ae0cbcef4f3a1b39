"""Decomposers with other pulse models, for comparison, and the waveform of any fitted echoes.

Chains name the decomposers: generalized Gaussians, the strip's pulse, Gauss-Newton steps without damping, and skewed
pulses: the log-normal of Wang et al. with a skew per strip or per echo. `plot`, `compare` and the loops of `fit` call
`rebuild_waveforms` and its parts: the sum of the fitted pulses is what a decomposer's echoes stand for.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Any, Literal

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import log
from wavebatch.kernels.fit.decompose import Settings, choose, decompose_clusters
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape, evaluate_pulse, tabulate_pulse
from wavebatch.kernels.fit.render import render_echoes, render_skewed, skewed_pulse
from wavebatch.stages.chain import Range, Step, stage
from wavebatch.stages.decompose import solve
from wavebatch.stages.detect.direct import samples_of
from wavebatch.stages.pulse_tables import BROADEST, model_parameters, pulse_shape, reference_pulse, shape_limits

POWERS = (1.4, 1.7, 2.0, 2.4, 3.0, 4.0)
"""Exponents of the generalized Gaussian that are tried for every cluster."""


def _shape_reference(system: SystemPulse, spacing: float, parameters: Mapping[str, Any]) -> PulseShape:
    """The pulse that `reference` fits."""
    if parameters["model"] == "stretched":
        shape = pulse_shape(system, spacing)
        ref = shape_limits(system, spacing).ref
        ends = [-6 * ref, 6 * ref]
        for _, delay, extra in shape.components:
            wide = 5 * np.sqrt(ref * ref + extra)
            ends = [min(ends[0], delay - wide), max(ends[1], delay + wide)]
        x = np.arange(ends[0], ends[1], ref / 16)
        value = evaluate_pulse(shape, x[:, None].copy(), np.zeros(1), np.full(1, ref))[0][:, 0]
        return PulseShape(table=tabulate_pulse(x, value))
    if parameters["model"] == "given":
        taps, _ = reference_pulse(system, spacing, "given", pulse=parameters["pulse"])
        return PulseShape(table=tabulate_pulse(np.arange(len(taps), dtype=np.float64), taps))
    return pulse_shape(system, spacing)


@stage(
    "decompose",
    # Of a stretched pulse the width is that at half maximum.
    fits=lambda system, parameters: (
        system if parameters["model"] == "broadened" else replace(system, components=(), kappa=0.0)
    ),
    shape=_shape_reference,
    shares=solve.FIT,
)
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
    fit = replace(solve.FIT, **options)
    settings = solve.make_settings(block, system, shape, fit, grow=False)
    if model != "broadened":
        system = replace(system, components=())
    return solve.fit_candidates(block, noise, system, echoes, settings, significance=fit.significance)


@stage("decompose", fits=solve.fit_gaussian, shares=solve.FIT)
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
    fit = replace(solve.FIT, **options)
    plain = solve.make_settings(block, system, GAUSSIAN, fit, grow=False)
    candidates, clusters = solve.find_clusters(block, noise, system, echoes, plain)
    samples, solutions = samples_of(block, noise), []
    for power in POWERS:
        factor = half_width_factor(power)
        widths = {name: getattr(plain, name) / factor for name in ("width_ref", "width_low", "width_high")}
        settings = plain._replace(shape=PulseShape(power=power), **widths)
        solution = decompose_clusters(samples, candidates, clusters, settings)
        scale = np.array([1.0, 1.0, factor, 1.0])
        solutions.append(solution._replace(
            parameters=solution.parameters * scale, errors=solution.errors * scale, shared=solution.shared * factor
        ))
    chosen = np.argmin([solution.cost for solution in solutions], axis=0)
    best = choose(solutions, chosen)
    columns = {"power": np.array(POWERS, np.float32)[chosen[best.cluster]]}
    return solve.describe_solution(block, noise, system, clusters, best, plain, fit.significance, columns)


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


@stage("decompose", fits=skew_system, shares=solve.FIT)
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
    fit = replace(solve.FIT, **options)
    settings = solve.make_settings(block, system, shape, fit, grow=False)
    if kappa != "free":
        return solve.fit_candidates(block, noise, system, echoes, settings, significance=fit.significance)
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
    candidates, clusters = solve.find_clusters(block, noise, system, echoes, settings)
    solution = decompose_clusters(samples_of(block, noise), candidates, clusters, settings)
    columns = {
        "skew": solution.parameters[:, 3].astype(np.float32),
        "skew_err": solution.errors[:, 3].astype(np.float32),
    }
    # The skew takes part in the area: its error is not that of amplitude and width alone.
    solution = solution._replace(shared=np.full_like(solution.shared, np.nan))
    # Widths and times are of the skewed pulse, which has no further components to be described.
    plain = settings._replace(shape=GAUSSIAN)
    return solve.describe_solution(block, noise, system, clusters, solution, plain, significance, columns)


_LOG_NORMAL = solve.FitOptions(max_iterations=60)


@stage(
    "decompose",
    makes=("skew", "skew_err"),
    # Echoes carry their skews, with which they are drawn.
    fits=lambda system, parameters: replace(system, components=(), kappa=0.0),
    shares=_LOG_NORMAL,
)
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
    settings = solve.make_settings(block, system, PulseShape(origin=origin), fit, grow=False)
    return fit_each(block, noise, system, echoes, settings, fit.significance)


def fitted_pulse(decomposer: Step, system: SystemPulse, spacing: float) -> PulseShape | None:
    """Return the pulse that a decomposer fits.

    Parameters
    ----------
    decomposer : Step
        The decompose step of a chain.
    system : SystemPulse
        As the chain used it.
    spacing : float
        Time between two samples [ns].

    Returns
    -------
    PulseShape or None
        Pulse in samples; None where nothing is fitted.
    """
    if decomposer.stage.shape is not None:
        return decomposer.stage.shape(system, spacing, decomposer.effective())
    return pulse_shape(decomposer.fit_system(system), spacing)


def rebuild_waveforms(
    block: WaveformBlock, system: SystemPulse, decomposer: Step, echoes: EchoTable
) -> np.ndarray | None:
    """Add up the pulses of the echoes of a block.

    Parameters
    ----------
    block : WaveformBlock
        n waveforms of s samples.
    system : SystemPulse
        As the chain used it.
    decomposer : Step
        The decompose step of the chain.
    echoes : EchoTable
        What the decomposer found in the block.

    Returns
    -------
    float32 array, shape (n, s), or None
        Signal above the baseline [DN]; None for decomposers without a pulse model.
    """
    shape = fitted_pulse(decomposer, system, block.spacing)
    return None if shape is None else render_table(shape, block, system, echoes)


def render_table(shape: PulseShape, block: WaveformBlock, system: SystemPulse, echoes: EchoTable) -> np.ndarray:
    """Add up the pulses of the echoes of a block; echoes whose skew or exponent was fitted are drawn with it.

    Parameters
    ----------
    shape : PulseShape
        The pulse that was fitted.
    block : WaveformBlock
        n waveforms of s samples.
    system : SystemPulse
        As the chain used it.
    echoes : EchoTable
        What a decomposer found in the block.

    Returns
    -------
    float32 array, shape (n, s)
        Signal above the baseline [DN].
    """
    amplitude, time, width = _parameters(shape, system, block.spacing, echoes)
    n, s = block.samples.shape
    if "skew" in echoes.attributes:
        return render_skewed(n, s, echoes.waveform, time, amplitude, width, echoes.attributes["skew"])
    if "power" not in echoes.attributes:
        return render_echoes(shape, n, s, echoes.waveform, time, amplitude, width)
    total = np.zeros((n, s), np.float32)
    for power, rows in _by_power(echoes):
        scaled = width[rows] / half_width_factor(power)
        pulse = PulseShape(power=power)
        total += render_echoes(pulse, n, s, echoes.waveform[rows], time[rows], amplitude[rows], scaled)
    return total


def echo_pulses(
    shape: PulseShape, system: SystemPulse, spacing: float, echoes: EchoTable
) -> Callable[[np.ndarray], np.ndarray]:
    """Return the fitted pulses of echoes as a function of time.

    Parameters
    ----------
    shape : PulseShape
        The pulse that was fitted.
    system : SystemPulse
        As the chain used it.
    spacing : float
        Time between two samples [ns].
    echoes : EchoTable
        k echoes.

    Returns
    -------
    callable
        From times [ns], shape (q,), to the pulse of each echo [DN], float64 (k, q).
    """
    amplitude, time, width = (values[:, None] for values in _parameters(shape, system, spacing, echoes))

    def evaluate(at: np.ndarray) -> np.ndarray:
        if not len(echoes):
            return np.zeros((0, len(at)))
        x = np.tile(at / spacing, (len(echoes), 1))
        if "skew" in echoes.attributes:
            skew = echoes.attributes["skew"].astype(np.float64)[:, None]
            return amplitude * skewed_pulse(x, time, width, skew)
        if "power" not in echoes.attributes:
            return amplitude * evaluate_pulse(shape, x, time, width)[0]
        curves = np.zeros(x.shape)
        for power, rows in _by_power(echoes):
            scaled = width[rows] / half_width_factor(power)
            curves[rows] = amplitude[rows] * evaluate_pulse(PulseShape(power=power), x[rows], time[rows], scaled)[0]
        return curves

    return evaluate


def _parameters(shape: PulseShape, system: SystemPulse, spacing: float, echoes: EchoTable) -> np.ndarray:
    """Amplitude, time and width of the fitted pulses in samples, float64 (3, k)."""
    described = np.stack([echoes.amplitude, echoes.time / spacing, echoes.sigma / spacing], axis=1)
    # As `make_settings` does: a pulse without components has no width of a main component.
    pulse = system if shape.components else replace(system, components=())
    limits = shape_limits(pulse, spacing, most=BROADEST)
    return model_parameters(shape, limits, described.astype(np.float64)).T


def _by_power(echoes: EchoTable) -> Iterator[tuple[float, np.ndarray]]:
    """Exponents, and the echoes that have them."""
    for power in np.unique(echoes.attributes["power"]):
        # As it was tried: a column holds it in single precision.
        exact = POWERS[int(np.argmin(np.abs(np.array(POWERS) - power)))]
        yield exact, np.flatnonzero(echoes.attributes["power"] == power)
