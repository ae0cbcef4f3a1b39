"""Attributes that need nothing but the fit: amplitude, width, energy, shape of the pulse, position."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA, HALF_C, SQRT_2PI
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.hermite import residual_moments
from wavebatch.kernels.fit.pulse_shape import PulseShape, evaluate_pulse
from wavebatch.kernels.fit.render import render_echoes
from wavebatch.kernels.geometry.group_returns import match_returns
from wavebatch.stages.attribute.radiometry import area_factor, light_error
from wavebatch.stages.chain import Chain, Range, Step, stage
from wavebatch.stages.pulse_tables import BROADEST, model_parameters, pulse_shape, shape_limits


@stage("attribute", makes=("amplitude", "amplitude_err"))
def amplitude(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Peak of each echo above the baseline [DN], and its error."""
    return echoes.with_attributes(amplitude=echoes.amplitude, amplitude_err=echoes.amplitude_err)


def _need_free_skew(step: Step, chain: Chain, system: SystemPulse | None) -> str:
    """Refuse a chain in which no skew is fitted to single echoes."""
    decomposer = chain.steps[2]
    free = decomposer.stage.name == "decompose.skewed" and decomposer.effective()["kappa"] == "free"
    if free or "skew" in decomposer.stage.makes:
        return ""
    return f'{decomposer.stage.name} fits no skew per echo; use decompose.skewed with kappa = "free" before it'


@stage("attribute", makes=("echo_width", "echo_width_err"))
def echo_width(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Full width at half maximum of each echo [ns], and its error.

    2.354820 sigma of a Gaussian, 2 sinh(1.17741 kappa) / kappa sigma of a skewed pulse. Of a learned pulse it is the
    width of the main lobe.
    """
    factor = _width_factor(_skew_of(system, echoes))
    return echoes.with_attributes(echo_width=echoes.sigma * factor, echo_width_err=echoes.sigma_err * factor)


def _skew_of(system: SystemPulse, echoes: EchoTable) -> np.ndarray:
    """Skew of the pulses that were fitted: one per echo where each has its own, else that of the system."""
    return np.asarray(echoes.attributes.get("skew", system.kappa), np.float64)


def _width_factor(kappa: np.ndarray) -> np.ndarray:
    """Full width at half maximum per sigma of a skewed pulse (docs/algorithms.md 0); 2.354820 without skew."""
    half = FWHM_PER_SIGMA / 2
    small = np.abs(kappa) < 1e-6
    safe = np.where(small, 1.0, kappa)
    return np.where(small, FWHM_PER_SIGMA, 2 * np.sinh(half * safe) / safe).astype(np.float32)


@stage("attribute", makes=("skew", "skew_err"), check=_need_free_skew)
def skew(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Skew of each echo and its error, after decompose.skewed with kappa = "free".

    Ground and plants differ in it. 0 is a Gaussian; of a log-normal it is the sigma of its logarithm.

    References
    ----------
    Wang, Wang and Tseng eq. 2; docs/algorithms.md 1.2.
    """
    unknown = np.full(len(echoes), np.nan, np.float32)
    return echoes.with_attributes(**{name: echoes.attributes.get(name, unknown) for name in ("skew", "skew_err")})


@stage("attribute", makes=("energy", "energy_err"))
def energy(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Integral of each echo over time [DN ns], and its error.

    Amplitude sigma sqrt(2 pi), times exp(kappa^2 / 2) of a skewed pulse; of a generalized Gaussian that of its
    exponent; of a learned pulse the sum over its Gaussians, with tails and after-pulses.
    """
    shape, limits = pulse_shape(system, block.spacing), shape_limits(system, block.spacing, most=BROADEST)
    if shape.components:
        whole = np.stack([echoes.amplitude, np.zeros(len(echoes)), echoes.sigma / block.spacing], axis=1)
        amplitude, _, width = model_parameters(shape, limits, whole.astype(np.float64)).T
        area = amplitude * width * block.spacing * (1.0 + sum(weight for weight, _, _ in shape.components))
    else:
        area = echoes.amplitude.astype(np.float64) * echoes.sigma * area_factor(system, echoes)
    value = SQRT_2PI * area
    error = np.abs(value) * light_error(echoes)
    return echoes.with_attributes(energy=value.astype(np.float32), energy_err=error.astype(np.float32))


def _need_one_pulse(step: Step, chain: Chain, system: SystemPulse | None) -> str:
    """Refuse decomposers that fit another pulse to every echo: none is common to compare with."""
    decomposer = chain.steps[2]
    own = decomposer.effective().get("kappa") == "free" or decomposer.effective().get("model") == "generalized"
    if own or "skew" in decomposer.stage.makes or decomposer.stage.name == "decompose.generalized_gaussian":
        return f"{decomposer.stage.name} fits another shape to every echo; use it after decompose.adaptive"
    return ""


@stage("attribute", makes=("pulse_deviation",), check=_need_one_pulse)
def pulse_deviation(block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable) -> EchoTable:
    """Deviation of each echo from the fitted pulse: sqrt(h3^2 + h4^2) of its residual, per unit of A/std sqrt(s/T).

    The Gauss-Hermite moments h3 (skew) and h4 (peakedness) of a right fit are standard normal numbers, so noise alone
    gives about 1.25 std/A sqrt(T/s). Merged echoes and sloping targets give more.

    References
    ----------
    docs/algorithms.md 4.2.
    """
    s, spacing = block.samples.shape[1], block.spacing
    time, sigma = echoes.time / spacing, echoes.sigma.astype(np.float64) / spacing
    shape, limits = pulse_shape(system, spacing), shape_limits(system, spacing, most=BROADEST)
    whole = np.stack([echoes.amplitude, time, sigma], axis=1).astype(np.float64)
    model = model_parameters(shape, limits, whole)
    std = noise.std[echoes.waveform].astype(np.float64)
    h3, h4 = np.empty(len(echoes)), np.empty(len(echoes))
    alone = echoes.alone(len(block))
    for kind, rows in ((_read_single, np.flatnonzero(alone)), (_read_several, np.flatnonzero(~alone))):
        read = kind(block, noise, shape, echoes.waveform[rows], model[rows])
        h3[rows], h4[rows] = residual_moments(read, s, time[rows], sigma[rows], std[rows])
    unit = echoes.amplitude / std * np.sqrt(sigma)
    return echoes.with_attributes(pulse_deviation=(np.hypot(h3, h4) / np.maximum(unit, 1e-6)).astype(np.float32))


_Read = Callable[[np.ndarray | slice, np.ndarray], np.ndarray]


def _read_single(
    block: WaveformBlock, noise: Noise, shape: PulseShape, waveform: np.ndarray, model: np.ndarray
) -> _Read:
    """Reader of residuals of echoes (k,) that are alone in their waveforms; the pulse is computed where it is read."""
    samples, s = block.samples.ravel(), block.samples.shape[1]
    first = waveform.astype(np.int64)[:, None] * s
    amplitude, time, width = model.astype(np.float32).T[..., None]
    level, missing = (None if values is None else values.ravel() for values in (noise.of_sample, block.missing))

    def read(part: np.ndarray | slice, at: np.ndarray) -> np.ndarray:
        values = samples[first[part] + at].astype(np.float32)
        values -= noise.baseline[waveform[part], None] if level is None else level[first[part] + at]
        values -= amplitude[part] * evaluate_pulse(shape, at.astype(np.float32), time[part], width[part])[0]
        if missing is not None:
            values[missing[first[part] + at]] = 0
        return values

    return read


def _read_several(
    block: WaveformBlock, noise: Noise, shape: PulseShape, waveform: np.ndarray, model: np.ndarray
) -> _Read:
    """Reader of residuals of echoes (k,) that share their waveforms: the model is computed for the whole waveform."""
    rows, place = np.unique(waveform, return_inverse=True)
    residual = block.samples[rows] - noise.level[rows]
    residual -= render_echoes(shape, len(rows), block.samples.shape[1], place, model[:, 1], model[:, 0], model[:, 2])
    if block.missing is not None:
        residual[block.missing[rows]] = 0

    def read(part: np.ndarray | slice, at: np.ndarray) -> np.ndarray:
        return residual[place[part][:, None], at].astype(np.float32)

    return read


@stage("attribute", makes=("x", "y", "z", "point", "range_err"))
def position(
    block: WaveformBlock, noise: Noise, system: SystemPulse, echoes: EchoTable, *,
    tolerance: Annotated[float, Range(0.0, 1e6)] = 2.5,
) -> EchoTable:  # fmt: skip
    """Coordinates of each echo along its ray [m], relative to the returns of its packet, and the return it matches.

    Return locations differ from the fit by an offset that all returns of a packet share (phase of the emitted pulse, a
    detector of leading edges). The offset is measured on the matched returns and subtracted. Besides the error of the
    fit, range_err has that of the returns: their scatter in this strip, or, where the returns of a packet contradict
    each other by more, the error of their mean. Packets without a matched return keep the raw location and are flagged;
    their error has what locations differ from echoes.

    Parameters
    ----------
    tolerance : float
        Largest distance in time between an echo and its return, in addition to half a sample [ns].

    References
    ----------
    docs/las-waveforms.md 8.
    """
    waveform = echoes.waveform
    offset = np.zeros(len(block))
    doubt = np.zeros(len(block))
    known = np.zeros(len(block), bool)
    point = np.full(len(echoes), -1, np.int64)
    returns = block.returns
    if returns is not None and len(returns):
        reach = tolerance + 0.5 * block.spacing
        match = match_returns(waveform, echoes.time, returns.waveform, returns.time, reach)
        offset, doubt, known = _shared_offset(len(block), echoes, match, returns.time)
        shifted = returns.time + offset[returns.waveform]
        again = match_returns(waveform, echoes.time, returns.waveform, shifted, reach)
        if not np.array_equal(again, match):
            match = again
            offset, doubt, known = _shared_offset(len(block), echoes, match, returns.time)
        point = np.where(match >= 0, returns.point[match], -1)
    along = echoes.time - offset[waveform]
    xyz = block.origin[waveform] + block.direction[waveform] * along[:, None]
    speed = np.sqrt(np.sum(block.direction**2, axis=1))
    # In strips in feet or degrees the vectors are no speeds in m/ns, but the error is always in metres.
    speed = np.where(np.abs(speed / HALF_C - 1.0) < 0.5, speed, HALF_C)
    shared = np.where(known, np.maximum(doubt * speed, system.radiometry.returns), system.radiometry.phase)
    echoes = echoes.with_attributes(
        x=xyz[:, 0],
        y=xyz[:, 1],
        z=xyz[:, 2],
        point=point,
        range_err=np.hypot(echoes.time_err * speed[waveform], shared[waveform]).astype(np.float32),
    )
    if returns is None:
        return echoes
    return echoes.with_flags(EchoFlag.ADDED, point < 0).with_flags(EchoFlag.UNANCHORED, ~known[waveform])


def _shared_offset(
    n: int, echoes: EchoTable, match: np.ndarray, return_time: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Offset of the fits from the return locations per waveform [ns], weighted by the errors, and where it is known.

    Between them its error [ns] by the scatter of the returns; 0 where their errors explain it, and for single returns.
    """
    rows = np.flatnonzero(match >= 0)
    error = echoes.time_err[rows].astype(np.float64)
    weight = 1.0 / np.maximum(np.where(np.isfinite(error), error, 1.0), 1e-3) ** 2
    difference = echoes.time[rows] - return_time[match[rows]]
    waveform = echoes.waveform[rows]
    total = np.bincount(waveform, weight, minlength=n)
    offset = np.bincount(waveform, weight * difference, minlength=n) / np.where(total > 0, total, 1.0)
    others = np.bincount(waveform, minlength=n) - 1
    scatter = np.bincount(waveform, weight * (difference - offset[waveform]) ** 2, minlength=n)
    contradict = (others > 0) & (scatter > others)
    doubt = np.sqrt(np.where(contradict, scatter, 0.0) / (np.maximum(others, 1) * np.where(total > 0, total, 1.0)))
    return offset, doubt, total > 0
