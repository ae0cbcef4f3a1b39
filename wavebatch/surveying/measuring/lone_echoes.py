"""Echoes that are alone in their waveform: what pulse, width and noise are measured on.

Used by all parts of a survey. Fits of Gaussians, so that they need no pulse yet.
"""

from __future__ import annotations

import numpy as np

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.stages.decompose.fit import closed_form
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.flags import use_noise_errors

ALONE = 0.1
"""Share of an echo up to which others of its waveform are no disturbance ..."""

LEAST_ALONE, ENOUGH_ALONE, ALONE_BEFORE_RINGING = 0.15, 40, 0.3
"""... unless less than this share of the echoes are alone, or so few; then others may be as high as this: a Gaussian
fitted to a pulse with a tail leaves a second one."""

MIN_SNR = 20.0
"""Amplitude over noise of a clear echo."""

LOOSE = 1.5
"""How far amplitudes of candidates may be off: waveforms in which no fit can be alone are not fitted."""

STEPS = 4
"""Gauss-Newton steps of a fit."""


def fit_lone(block: WaveformBlock, noise: Noise, system: SystemPulse, least: float, fraction: float = 0.2) -> EchoTable:
    """Fit Gaussians to the echoes that are the strongest by far of their waveform, not near an edge or clipped.

    By far means ten to one. Where hardly any echo is alone, every echo has an after-pulse, which may be higher than
    that: second targets would not be in every waveform.

    Parameters
    ----------
    block : WaveformBlock
    noise : Noise
        Of the block.
    system : SystemPulse
        Its width bounds those of the fits.
    least : float
        Least amplitude [standard deviations of the noise].
    fraction : float
        Samples of at least this share of the peak give the start of a fit.

    Returns
    -------
    EchoTable
        At most one echo per waveform.
    """
    n, floor = len(block), least * system.noise.std
    candidates = maximum(block, noise, system)
    strongest, second = find_strongest(candidates, n)
    amplitude = candidates.amplitude[strongest]
    share = _alone_share(amplitude, second, floor)
    hopeful = np.zeros(n, bool)
    hopeful[candidates.waveform[strongest]] = (LOOSE * amplitude > floor) & (second < LOOSE * share * amplitude)
    candidates = candidates.take(np.flatnonzero(hopeful[candidates.waveform]))
    echoes = closed_form(block, noise, system, candidates, fraction=fraction, steps=STEPS)
    echoes = use_noise_errors(echoes, system, block.spacing)
    strongest, second = find_strongest(echoes, n)
    echoes = echoes.take(strongest)
    good = (echoes.amplitude > floor) & (second < share * echoes.amplitude)
    good &= (echoes.flags & int(EchoFlag.NEAR_EDGE | EchoFlag.SATURATED)) == 0
    return echoes.take(np.flatnonzero(good))


def _alone_share(amplitude: np.ndarray, second: np.ndarray, floor: float) -> float:
    """How high, as a share of the strongest echo (m,) of a waveform, the second strongest (m,) may be."""
    clear = amplitude > floor
    alone = clear & (second < ALONE * amplitude)
    enough = max(LEAST_ALONE * clear.sum(), min(ENOUGH_ALONE, clear.sum()))
    return ALONE if alone.sum() >= enough else ALONE_BEFORE_RINGING


def find_strongest(echoes: EchoTable, n: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the strongest echo of each waveform that has any, and the amplitude of the second strongest there."""
    order = np.lexsort((-echoes.amplitude, echoes.waveform))
    waveform = echoes.waveform[order]
    first = np.r_[True, waveform[1:] != waveform[:-1]] if len(order) else np.empty(0, bool)
    second = np.zeros(n)
    runner = np.flatnonzero(~first)
    runner = runner[first[runner - 1]]
    second[waveform[runner]] = echoes.amplitude[order[runner]]
    return order[first], second[waveform[first]]
