"""What a detector saw: the signal in which it searched for echoes, with its threshold.

`waveform.build_views` asks for it and `draw_waveform` draws it. The signals are computed by the functions and kernels
that the stages use; tests/tools/test_detector_signals.py holds that the stages find echoes exactly where these signals
pass their thresholds.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import SimpleNamespace
from typing import Any

import numpy as np
from scipy.ndimage import uniform_filter1d

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.signal.deconvolve import deconvolve_richardson_lucy
from wavebatch.kernels.signal.filters import (
    curvature_taps,
    filter_antisymmetric,
    filter_energy,
    filter_symmetric,
    gaussian_taps,
    slope_taps,
)
from wavebatch.kernels.signal.signal import SMOOTH_GAIN, smooth_121
from wavebatch.kernels.signal.square_differences import pad_samples, slide_taps, square_differences
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.stages.detect.candidates import signal_above
from wavebatch.stages.detect.classic import INFLECTED
from wavebatch.stages.detect.maximum import LEAST_BLUR, choose_smoothing
from wavebatch.stages.detect.transformed import BACKGROUND, spike_reach, transform
from wavebatch.stages.pulse_tables import reference_pulse


@dataclass(frozen=True, slots=True, eq=False)
class DetectorSignal:
    """The signal of a detector for n waveforms, or for one of them."""

    label: str
    """What it is, with its unit."""
    rule: str
    """When a maximum or a minimum of it is an echo."""
    values: np.ndarray
    """(q, n) as kernels give it; (q,) of one waveform."""
    least: np.ndarray
    """Threshold: a level, or the depth that a minimum needs, (n,); NaN without one."""
    first: float = 0.0
    """Place of the first value [samples]."""
    deep: bool = False
    """Whether `least` is the depth of minima instead of a level."""
    second: np.ndarray | None = None
    """A further line with the same unit and times, to which `least` belongs, as `values`."""
    second_label: str = ""
    time: np.ndarray = field(default_factory=lambda: np.empty(0))
    """Times of its values after the first sample [ns], f8 (q,)."""
    stage: str = ""
    """The detector, with the parameters that are not its defaults."""
    found: EchoTable | None = None
    """The echoes that the detector found in the one waveform."""


def choose_step(chain: Chain, show: str) -> Step:
    """The detector whose signal is shown: that of the chain if it searches in this kind, else the kind's first one."""
    step = chain.steps[1]
    if show == "detector":
        if step.stage.name not in _SIGNALS:
            raise ConfigError(f"--show detector: {step.stage.name} has no known signal; choose {', '.join(KINDS)}")
        return step
    names = [name for name, (kind, _) in _SIGNALS.items() if kind == show]
    if not show or not names:
        raise ConfigError(f"--show {show!r}: must be one of {', '.join(('detector', *KINDS))}")
    return step if step.stage.name in names else Step(STAGES[names[0]])


def see_block(
    block: WaveformBlock, noise: Noise, system: SystemPulse, step: Step, *, in_chain: bool = True
) -> list[DetectorSignal]:
    """What the detector of a step sees in each waveform of a block, with the echoes that it finds there.

    in_chain: whether it is the detector of the chain; the title then does not say that it is another one.
    """
    scene = _Scene(block, noise, system, SimpleNamespace(**step.effective()))
    whole = _SIGNALS[step.stage.name][1](scene)
    found = step.stage.function(block, noise, system, **step.parameters)
    name = describe_step(step) + ("" if in_chain else ", which the chain does not use")
    time = (whole.first + np.arange(len(whole.values))) * block.spacing
    return [
        replace(whole, values=whole.values[:, row], least=np.float64(whole.least[row]), time=time, stage=name,
                second=None if whole.second is None else whole.second[:, row],
                found=found.take(np.flatnonzero(found.waveform == row)))
        for row in range(len(block))
    ]  # fmt: skip


def describe_step(step: Step) -> str:
    """The stage, with the parameters that the chain sets."""
    given = ", ".join(f"{name} = {value}" for name, value in step.parameters.items())
    return step.stage.name + (f" ({given})" if given else "")


@dataclass(frozen=True)
class _Scene:
    """What a detector works on: the waveforms, and its parameters."""

    block: WaveformBlock
    noise: Noise
    system: SystemPulse
    options: Any

    @cached_property
    def signal(self) -> np.ndarray:
        """Waveforms above their baselines [DN], f4 (s, n)."""
        return signal_above(self.block, self.noise)

    @property
    def std(self) -> np.ndarray:
        """Noise of each waveform [DN], f8 (n,)."""
        return self.noise.std.astype(np.float64)

    @property
    def ref(self) -> float:
        """Width of the system pulse [samples]."""
        return self.system.sigma_ref / self.block.spacing

    @cached_property
    def pulse(self) -> Any:
        """The reference pulse that the parameters choose."""
        one = self.options
        return reference_pulse(self.system, self.block.spacing, one.reference, one.reach, one.pulse)

    @property
    def rule(self) -> str:
        """What a maximum needs."""
        return f"maxima above {self.options.threshold:g} std"


def _see_maximum(scene: _Scene) -> DetectorSignal:
    smoothing = choose_smoothing(scene.ref)
    if smoothing.taps is None:
        even = smooth_121(smooth_121(scene.signal))
    else:
        even = filter_symmetric(scene.signal, smoothing.taps)
    return DetectorSignal("smoothed [DN]", scene.rule, even, scene.options.threshold * smoothing.gain * scene.std)


def _see_smoothed(scene: _Scene) -> DetectorSignal:
    level = scene.options.level
    return DetectorSignal("smoothed [DN]", f"level {level:g} std", smooth_121(scene.signal),
                          level * SMOOTH_GAIN * scene.std)  # fmt: skip


def _see_samples(scene: _Scene) -> DetectorSignal:
    one = scene.options
    rule = f"runs above {one.level:g} std for {one.duration:g} pulses"
    return DetectorSignal("above the baseline [DN]", rule, scene.signal, one.level * scene.std)


def _see_matched(scene: _Scene) -> DetectorSignal:
    taps = gaussian_taps(scene.ref)
    energy = filter_energy(taps)
    # In units of the amplitude of a lone echo, as the stage reports it.
    values = filter_symmetric(scene.signal, taps) / np.float32(energy)
    return DetectorSignal("correlation [DN]", scene.rule, values, scene.options.threshold * scene.std / np.sqrt(energy))


def _see_correlation(scene: _Scene) -> DetectorSignal:
    pulse, one = scene.pulse, scene.options
    energy = float(np.sum(pulse.taps**2))
    values = slide_taps(pad_samples(scene.signal, pulse.middle), pulse.taps) / np.float32(energy)
    rule = f"{scene.rule}, coefficient at least {one.similarity:g}"
    least = one.threshold * scene.std / np.sqrt(energy)
    return DetectorSignal("correlation [DN]", rule, values, least, pulse.peak - pulse.middle)


def _see_asdf(scene: _Scene) -> DetectorSignal:
    pulse, one = scene.pulse, scene.options
    height = scene.signal.max(axis=0)
    difference, _ = square_differences(scene.signal, pulse.taps, height)
    if one.rule == "paper":
        least = one.fraction * np.ptp(difference, axis=0)
        rule = f"minima as deep as {one.fraction:g} of the range (bars)"
    else:
        gain = one.threshold * np.sqrt(np.sum(pulse.taps**2))
        least = 2 * gain * scene.std * np.maximum(height, 0)
        rule = f"minima as deep as the bars ({one.threshold:g} std), with a correlation above {one.threshold:g} std"
    first = pulse.peak - (len(pulse.taps) - 1)
    return DetectorSignal("square difference R [DN2]", rule, difference, least, first, deep=True)


def _see_wavelet(scene: _Scene) -> DetectorSignal:
    one = scene.options
    detail, gain = transform(scene.signal, scene.ref, one.wavelet, one.scale, scene.block.spacing)
    return DetectorSignal(f"{one.wavelet} coefficients [DN]", scene.rule, detail, one.threshold * gain * scene.std)


def _see_spikes(scene: _Scene) -> DetectorSignal:
    pulse, one, half = scene.pulse, scene.options, spike_reach(scene.ref)
    profile = deconvolve_richardson_lucy(scene.signal, pulse.taps, BACKGROUND * scene.noise.std, one.iterations)
    sums = uniform_filter1d(profile.astype(np.float64), 2 * half + 1, axis=0, mode="constant") * (2 * half + 1)
    least = one.threshold * scene.std / np.sqrt(np.sum(pulse.taps**2))
    return DetectorSignal(
        "deconvolved [DN]", f"spikes whose sum is above {one.threshold:g} std", profile, least,
        pulse.peak - pulse.middle, second=sums, second_label=f"sum of {2 * half + 1} samples",
    )  # fmt: skip


def _see_curvature(scene: _Scene) -> DetectorSignal:
    one = scene.options
    taps = curvature_taps(max(one.scale * scene.ref, LEAST_BLUR))
    rule = f"{scene.rule} where the smoothed signal is above {one.level:g} std"
    least = one.threshold * np.sqrt(filter_energy(taps)) * scene.std
    return DetectorSignal("- second derivative [DN/sample2]", rule, filter_symmetric(scene.signal, taps), least)


def _see_crossings(scene: _Scene) -> DetectorSignal:
    one = scene.options
    blur = max(one.scale * scene.ref, LEAST_BLUR)
    high = f"where the smoothed signal is above {one.level:g} std"
    if one.derivative == "first":
        values = filter_antisymmetric(scene.signal, slope_taps(blur))
        least = np.full(values.shape[1], np.nan)
        return DetectorSignal("derivative [DN/sample]", f"falls through zero {high}", values, least)
    taps = curvature_taps(blur)
    least = INFLECTED * np.sqrt(filter_energy(taps)) * scene.std
    values = filter_symmetric(scene.signal, taps)
    return DetectorSignal("- second derivative [DN/sample2]", f"middle of two zeros {high}", values, least)


_SIGNALS: Mapping[str, tuple[str, Callable[[_Scene], DetectorSignal]]] = {
    "detect.maximum": ("", _see_maximum),
    "detect.threshold": ("", _see_smoothed),
    "detect.constant_fraction": ("", _see_smoothed),
    "detect.center_of_gravity": ("", _see_smoothed),
    "detect.sustained_threshold": ("", _see_samples),
    "detect.asdf": ("asdf", _see_asdf),
    "detect.wavelet": ("wavelet", _see_wavelet),
    "detect.correlation": ("correlation", _see_correlation),
    "detect.matched_filter": ("correlation", _see_matched),
    "detect.richardson_lucy": ("deconvolved", _see_spikes),
    "detect.second_derivative": ("derivative", _see_curvature),
    "detect.zero_crossing": ("derivative", _see_crossings),
}
"""Per detector the kind of its signal, as --show names it, and the function that computes it."""

KINDS = tuple(dict.fromkeys(kind for kind, _ in _SIGNALS.values() if kind))
"""Kinds of signal; --show draws that of the chain's detector, or of the first one that searches in this kind."""
