"""What a detector saw: the signal in which it searched for echoes, with its threshold.

`waveform.build_views` asks for it and `draw_waveform` draws it. The signals are computed by the functions and kernels
that the stages use; tests/tools/test_detector_signals.py holds that the stages find echoes exactly where these signals
pass their thresholds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.signal.deconvolve import deconvolve_richardson_lucy
from wavebatch.kernels.signal.filters import (
    curvature_taps,
    filter_energy,
    filter_symmetric,
    gaussian_taps,
)
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, smooth_121
from wavebatch.kernels.signal.square_differences import pad_samples, slide_taps, square_differences
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.stages.detect.candidates import signal_above
from wavebatch.stages.detect.maximum import LEAST_BLUR, smooth_to_pulse
from wavebatch.stages.detect.wavelet import BACKGROUND, spike_reach, transform
from wavebatch.stages.reference_pulse import reference_pulse

KINDS: Mapping[str, tuple[str, ...]] = {
    "asdf": ("detect.asdf",),
    "wavelet": ("detect.wavelet",),
    "correlation": ("detect.correlation", "detect.matched_filter"),
    "deconvolved": ("detect.richardson_lucy",),
    "derivative": ("detect.second_derivative",),
}
"""Kinds of signal, each with the detectors that search in it; the first one if the chain has none of them."""

SHOWN = ("detector", *KINDS)
"""Values of --show: `detector` for the signal of the chain's own detector."""


@dataclass(frozen=True, slots=True, eq=False)
class DetectorSignal:
    """The signal of a detector for n waveforms, or for one of them."""

    label: str
    """What it is, with its unit."""
    rule: str
    """When a maximum or a minimum of it is an echo."""
    time: np.ndarray
    """Times of its values after the first sample [ns], f8 (q,)."""
    values: np.ndarray
    """f4 (n, q); (q,) of one waveform."""
    least: np.ndarray
    """Threshold: a level, or the depth that a minimum needs, f8 (n,); NaN without one."""
    deep: bool = False
    """Whether `least` is the depth of minima instead of a level."""
    second: np.ndarray | None = None
    """A further line with the same unit and times, to which `least` belongs, as `values`."""
    second_label: str = ""
    stage: str = ""
    """The detector, with the parameters that are not its defaults."""
    found: EchoTable | None = None
    """The echoes that the detector found in the one waveform."""

    def take(self, row: int, found: EchoTable) -> DetectorSignal:
        """The signal of one waveform, with what the detector found in it."""
        second = None if self.second is None else self.second[row]
        return DetectorSignal(
            self.label, self.rule, self.time, self.values[row], self.least[row], self.deep, second, self.second_label,
            self.stage, found,
        )  # fmt: skip


def choose_step(chain: Chain, show: str) -> Step:
    """The detector whose signal is shown: that of the chain if it searches in this kind, else the kind's first one."""
    if show not in SHOWN:
        raise ConfigError(f"--show {show!r}: must be one of {', '.join(SHOWN)}")
    own = chain.steps[1]
    if show != "detector":
        return own if own.stage.name in KINDS[show] else Step(STAGES[KINDS[show][0]])
    if own.stage.name not in _SIGNALS:
        raise ConfigError(f"--show detector: the signal of {own.stage.name} is not known; choose {', '.join(KINDS)}")
    return own


def see_block(
    block: WaveformBlock, noise: Noise, system: SystemPulse, step: Step, *, own: bool = True
) -> list[DetectorSignal]:
    """What the detector of a step sees in each waveform of a block, with the echoes that it finds there.

    own: whether it is the detector of the chain; the title then does not say that it is another one.
    """
    whole = _SIGNALS[step.stage.name](block, noise, system, **step.effective())
    found = step.stage.function(block, noise, system, **step.parameters)
    name = describe_step(step) + ("" if own else ", which the chain does not use")
    signals = [whole.take(row, found.take(np.flatnonzero(found.waveform == row))) for row in range(len(block))]
    return [_name(one, name) for one in signals]


def _name(signal: DetectorSignal, stage: str) -> DetectorSignal:
    values = {name: getattr(signal, name) for name in DetectorSignal.__slots__}
    return DetectorSignal(**{**values, "stage": stage})


def describe_step(step: Step) -> str:
    """The stage, with the parameters that the chain sets."""
    given = ", ".join(f"{name} = {value}" for name, value in step.parameters.items())
    return step.stage.name + (f" ({given})" if given else "")


def _times(block: WaveformBlock, values: np.ndarray, first: float = 0.0) -> np.ndarray:
    """Times of the rows of values (q, n), of which the first lies at sample `first`."""
    return (first + np.arange(len(values))) * block.spacing


def _level(
    block: WaveformBlock, label: str, rule: str, values: np.ndarray, least: np.ndarray, **more: Any
) -> DetectorSignal:
    return DetectorSignal(label, rule, _times(block, values), values.T, least.astype(np.float64), **more)


def _see_maximum(block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float) -> DetectorSignal:
    _, even, gain, _ = smooth_to_pulse(signal_above(block, noise), system.sigma_ref / block.spacing)
    return _level(block, "smoothed [DN]", f"maxima above {threshold:g} std", even, threshold * gain * noise.std)


def _see_smoothed(block: WaveformBlock, noise: Noise, system: SystemPulse, *, level: float, **_: Any) -> DetectorSignal:
    smoothed = smooth_121(signal_above(block, noise))
    return _level(block, "smoothed [DN]", f"level {level:g} std", smoothed, level * SMOOTH_GAIN * noise.std)


def _see_matched(block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float) -> DetectorSignal:
    taps = gaussian_taps(system.sigma_ref / block.spacing)
    energy = filter_energy(taps)
    # In units of the amplitude of a lone echo, as the stage reports it.
    values = filter_symmetric(signal_above(block, noise), taps) / np.float32(energy)
    least = threshold * noise.std / np.sqrt(energy)
    return _level(block, "correlation [DN]", f"maxima above {threshold:g} std", values, least)


def _see_correlation(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    reference: str, threshold: float, similarity: float, reach: float, pulse: str,
) -> DetectorSignal:  # fmt: skip
    given = reference_pulse(system, block.spacing, reference, reach, pulse)
    energy = float(np.sum(given.taps**2))
    values = slide_taps(pad_samples(signal_above(block, noise), given.middle), given.taps) / np.float32(energy)
    rule = f"maxima above {threshold:g} std, coefficient at least {similarity:g}"
    least = threshold * noise.std.astype(np.float64) / np.sqrt(energy)
    time = _times(block, values, given.peak - given.middle)
    return DetectorSignal("correlation [DN]", rule, time, values.T, least)


def _see_asdf(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    reference: str, rule: str, fraction: float, threshold: float, interpolation: str, reach: float, pulse: str,
) -> DetectorSignal:  # fmt: skip
    given = reference_pulse(system, block.spacing, reference, reach, pulse)
    signal = signal_above(block, noise)
    height = signal.max(axis=0)
    difference, _ = square_differences(signal, given.taps, height)
    if rule == "paper":
        least, text = fraction * np.ptp(difference, axis=0), f"minima as deep as {fraction:g} of the range (bars)"
    else:
        gain = threshold * np.sqrt(np.sum(given.taps**2))
        least = 2 * gain * noise.std * np.maximum(height, 0)
        text = f"minima as deep as the bars ({threshold:g} std), with a correlation above {threshold:g} std"
    time = _times(block, difference, given.peak - (len(given.taps) - 1))
    return DetectorSignal("square difference R [DN2]", text, time, difference.T, least.astype(np.float64), deep=True)


def _see_wavelet(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, wavelet: str, threshold: float, scale: float
) -> DetectorSignal:
    signal, ref = signal_above(block, noise), system.sigma_ref / block.spacing
    detail, gain = transform(signal, ref, wavelet, scale, block.spacing)
    label, rule = f"{wavelet} coefficients [DN]", f"maxima above {threshold:g} std"
    return _level(block, label, rule, detail, threshold * gain * noise.std)


def _see_spikes(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *,
    reference: str, iterations: int, threshold: float, reach: float, pulse: str,
) -> DetectorSignal:  # fmt: skip
    given = reference_pulse(system, block.spacing, reference, reach, pulse)
    profile = deconvolve_richardson_lucy(signal_above(block, noise), given.taps, BACKGROUND * noise.std, iterations)
    half = spike_reach(system.sigma_ref / block.spacing)
    padded = np.concatenate([np.zeros((half, len(block))), profile, np.zeros((half, len(block)))]).cumsum(axis=0)
    sums = padded[2 * half :] - np.concatenate([np.zeros((1, len(block))), padded])[: len(profile)]
    least = threshold * noise.std.astype(np.float64) / np.sqrt(np.sum(given.taps**2))
    return DetectorSignal(
        "deconvolved [DN]", f"spikes whose sum is above {threshold:g} std", _times(block, profile, given.peak -
        given.middle), profile.T, least, second=sums.T, second_label=f"sum of {2 * half + 1} samples",
    )  # fmt: skip


def _see_curvature(
    block: WaveformBlock, noise: Noise, system: SystemPulse, *, threshold: float, scale: float, level: float
) -> DetectorSignal:
    ref = system.sigma_ref / block.spacing
    taps = curvature_taps(max(scale * ref, LEAST_BLUR))
    curvature = filter_symmetric(signal_above(block, noise), taps)
    rule = f"maxima above {threshold:g} std where the smoothed signal is above {level:g} std"
    label = "- second derivative [DN/sample2]"
    return _level(block, label, rule, curvature, threshold * np.sqrt(filter_energy(taps)) * noise.std)


_SIGNALS: Mapping[str, Callable[..., DetectorSignal]] = {
    "detect.maximum": _see_maximum,
    "detect.matched_filter": _see_matched,
    "detect.second_derivative": _see_curvature,
    "detect.threshold": _see_smoothed,
    "detect.constant_fraction": _see_smoothed,
    "detect.correlation": _see_correlation,
    "detect.asdf": _see_asdf,
    "detect.wavelet": _see_wavelet,
    "detect.richardson_lucy": _see_spikes,
}
"""Per detector the function that computes its signal from its parameters."""
