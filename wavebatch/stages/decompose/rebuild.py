"""The waveform that a decomposer's echoes stand for: the sum of its fitted pulses. For `plot` and goodness of fit."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse
from wavebatch.kernels.fit.render import render_echoes, render_skewed, skewed_pulse
from wavebatch.stages.chain import Step
from wavebatch.stages.decompose.models import POWERS, half_width_factor
from wavebatch.stages.pulse_tables import BROADEST, model_parameters, pulse_shape, shape_limits


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
        Signal above the baseline [count]; None for decomposers without a pulse model.
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
        Signal above the baseline [count].
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
        From times [ns], shape (q,), to the pulse of each echo [count], float64 (k, q).
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
    limits = shape_limits(system, spacing, most=BROADEST)
    return model_parameters(shape, limits, described.astype(np.float64)).T


def _by_power(echoes: EchoTable) -> Iterator[tuple[float, np.ndarray]]:
    """Exponents, and the echoes that have them."""
    for power in np.unique(echoes.attributes["power"]):
        # As it was tried: a column holds it in single precision.
        exact = POWERS[int(np.argmin(np.abs(np.array(POWERS) - power)))]
        yield exact, np.flatnonzero(echoes.attributes["power"] == power)
