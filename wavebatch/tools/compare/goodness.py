"""Goodness of fit E of Wang et al., and the E0 that noise alone gives.

`chains` measures every block with `measure_fit` and collects the values in a FitQuality per chain.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.stages.chain import Step
from wavebatch.stages.decompose.rebuild import rebuild_waveforms
from wavebatch.stages.pulse_tables import clip_level
from wavebatch.tools.even_sample import EvenSample


@dataclass(frozen=True, slots=True)
class Goodness:
    """Goodness of fit E = |f - y|^2 / |f|^2 over waveforms with an echo; NaN without such waveforms."""

    waveforms: int
    mean: float
    median: float
    floor_mean: float
    """Mean of E0, the E that noise alone gives for a perfect fit."""
    floor_median: float


def measure_fit(
    block: WaveformBlock, noise: Noise, system: SystemPulse, decomposer: Step, echoes: EchoTable
) -> tuple[np.ndarray, np.ndarray]:
    """E and E0 of each waveform, f8 (n,); NaN without an echo, or if the model of the decomposer is not known.

    f is the sum of the fitted pulses, y the samples above the baseline; samples at the digitizer's limit are left out
    of both. E0 = n sn^2 / |f|^2 with n samples and sn of one sample: what fits and thresholds use is larger where noise
    is coloured. Source: Wang, Wang and Tseng eq. 5; docs/algorithms.md 1.2.
    """
    model = rebuild_waveforms(block, system, decomposer, echoes)
    if model is None:
        return np.full(len(block), np.nan), np.full(len(block), np.nan)
    used = block.samples < clip_level(block, system)
    if block.missing is not None:
        used &= ~block.missing
    model = np.where(used, model.astype(np.float64), 0.0)
    residual = np.where(used, block.samples - noise.level.astype(np.float64) - model, 0.0)
    energy = np.square(model).sum(axis=1)
    energy[energy <= 0] = np.nan
    std = noise.std.astype(np.float64) * (system.noise.quiet / system.noise.std)
    floor = np.count_nonzero(used, axis=1) * np.square(std)
    return np.square(residual).sum(axis=1) / energy, floor / energy


class FitQuality:
    """Collects E and E0 of waveforms: sums of all, and an even sample of them for medians."""

    def __init__(self, limit: int | None = None) -> None:
        self._sample = EvenSample(limit)
        self._sums = {name: np.zeros(3) for name in ("all", "single", "multi", "both")}

    def add(self, misfit: np.ndarray, floor: np.ndarray, number: np.ndarray, both: np.ndarray) -> None:
        """Adds waveforms (n,): E, E0, number of echoes, and whether the other side has an echo too."""
        rows = np.flatnonzero(np.isfinite(misfit))
        part = {"misfit": misfit[rows], "floor": floor[rows], "number": number[rows], "both": both[rows]}
        for name, inside in _classes(part).items():
            self._sums[name] += [inside.sum(), part["misfit"][inside].sum(), part["floor"][inside].sum()]
        self._sample.add(part)

    def result(self) -> dict[str, Goodness]:
        """Goodness of all waveforms, of those with a single echo, with several, and with an echo on both sides; empty
        if E is not known."""
        whole = self._sample.read()
        if not whole or not len(whole["misfit"]):
            return {}
        classes = _classes(whole)
        found = {}
        for name, (number, misfit, floor) in self._sums.items():
            means = [float(total / number) if number else float("nan") for total in (misfit, floor)]
            medians = [_median(whole[kind][classes[name]]) for kind in ("misfit", "floor")]
            found[name] = Goodness(int(number), means[0], medians[0], means[1], medians[1])
        return found


def _classes(part: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
    number = part["number"]
    return {"all": number > 0, "single": number == 1, "multi": number > 1, "both": part["both"]}


def _median(values: np.ndarray) -> float:
    return float(np.median(values)) if len(values) else float("nan")
