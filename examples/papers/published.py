"""The waveforms of published experiments, as docs/algorithms.md 1 describes them.

The scripts of this folder and some tests use them; Wagner's is a scene of tools.simulate.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from given_echoes import FINE, fine_recording, simulate_echoes

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.tools.simulate.render import PulseModel, Recording
from wavebatch.tools.simulate.scenes import FoldedWidth, LogNormal, Scene, WithinDepth

WAGNER = Scene(
    "wagner",
    "1 to 5 echoes at 58, 30, 9, 2.5, 0.5 %, anywhere in 120 samples: tables 1 and 2 of Wagner et al. (2007)",
    counts=(0.0, 0.58, 0.30, 0.09, 0.025, 0.005),
    amplitude=LogNormal(25.0, 0.8, 5.0, 230.0),
    width=FoldedWidth(0.35, 0.105),
    times=WithinDepth(1000.0),
    recording=Recording(n_samples=120, baseline=20.0, baseline_spread=0.0, pulse=PulseModel(2.0)),
)
"""WithinDepth deeper than the window: times evenly over all of it."""

PULSE_SIGMA = 5.0 / FWHM_PER_SIGMA
"""Width of the pulse of Wang et al. and of Jutzi and Stilla (2005): 5 ns at half its maximum [ns]."""

WANG_CASES: dict[str, tuple[tuple[float, float], ...]] = {
    "a": ((80, 0), (100, 4)),
    "b": ((80, 0), (100, 5)),
    "c": ((80, 0), (100, 4), (50, 8)),
    "d": ((80, 0), (100, 4), (50, 9)),
    "e": ((80, 0), (100, 5), (50, 10)),
}
"""Amplitude and time of the echoes of Wang's figure 5."""


def simulate_wang(
    case: str, noise_std: float, n: int, rng: np.random.Generator
) -> tuple[WaveformBlock, EchoTable, Recording]:
    """n waveforms of a case of Wang's figure 5 at random phases (without noise: at phase 0), truth and receiver.

    noise_std: in the unit of WANG_CASES; the receiver has FINE counts per unit.
    """
    recording = fine_recording(noise_std, PULSE_SIGMA)
    amplitude, time = np.array(WANG_CASES[case], np.float64).T
    phase = rng.uniform(-0.5, 0.5, (n, 1)) if noise_std else np.zeros((n, 1))
    return *simulate_echoes(recording, 30.0 + phase + time, FINE * amplitude, PULSE_SIGMA, rng), recording


RETURN_TABLES: dict[str, tuple[float, tuple[float, ...]]] = {
    "orion-6": (0.65, (40.9, 42.3, 13.7, 3.1)),
    "orion-20": (0.65, (28.8, 33.8, 22.9, 14.5)),
    "orion-22": (0.65, (26.9, 32.1, 23.7, 17.3)),
    "gemini-6": (2.0, (81.9, 17.9, 0.2, 0.0)),
    "gemini-24": (2.0, (18.9, 42.3, 29.0, 9.9)),
}
"""Ussyshkin and Theriault (2011): dead zone [m] and shares of pulses with exactly 1, 2, 3, 4 returns [%], by stand.

The second follow from the shares of the returns that the paper prints: see PRINTED_SHARES."""

PRINTED_SHARES: dict[str, tuple[str, ...]] = {
    "orion-6": ("55.88", "33.03", "9.38", "1.71"),
    "orion-20": ("44.8", "31.91", "16.79", "6.51"),
    "orion-22": ("43.22", "31.6", "17.71", "7.47"),
    "gemini-6": ("84.5, 85.7, 83.6", "15.3, 14.1, 15.8", "0.2, 0.2, 0.6", "0.0, 0.0, 0.0"),
    "gemini-24": ("43.5, 39.8, 42.1", "35.3, 31.9, 34.0", "16.9, 21.4, 18.7", "4.3, 6.9, 5.2"),
}
"""Share of the returns with a number [%] in tables 3 and 5, as printed, by stand; of Gemini three samples each. Ours
are fitted to the first."""


def paint_slice(
    rng: np.random.Generator,
    surfaces: Sequence[tuple[float, float, int, int]],
    *,
    height: int = 320,
    width: int = 400,
    sigma: float = 8.0,
    snr: float = 15.0,
) -> np.ndarray:
    """A slice of noise 1, (height, width): a waveform per row, with straight surfaces `snr` high and `sigma` wide.

    surfaces: column at the middle row, columns per row, first row and row after the last. Source: the slices of Jutzi
    and Stilla (2005), docs/algorithms.md 1.3.
    """
    image = rng.standard_normal((height, width))
    row, column = np.arange(height)[:, None], np.arange(width)
    for middle, slope, first, end in surfaces:
        band = snr * np.exp(-0.5 * ((column - middle - slope * (row - height // 2)) / sigma) ** 2)
        image += np.where((row >= first) & (row < end), band, 0)
    return image
