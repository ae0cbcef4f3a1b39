"""Whether the fits of a strip whiten its noise (docs/algorithms.md H11); the survey asks once pulse and noise stand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from wavebatch.core.units import MAD_TO_STD, MEDIAN_ERROR
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.signal.noise import predict_noise
from wavebatch.surveying.measuring.judge import SURE, describe_waveforms, exceed, explain
from wavebatch.surveying.measuring.noise_and_width import FEW, find_single, thin_samples

LEAST_NOISE = 0.5
"""Noise of a sample below which rounding makes what a filter of neighbours sees [count]."""

LEAST_PREDICTED = 0.1
"""Share of the noise's variance that two samples must predict of the next one: below it, the errors of close echoes
fall by less than 5 %, which the time of the fits is not worth."""

LOOK = 120_000
"""Samples on which the two ways are compared: some hundreds of waveforms, whose mean lengths differ by standard errors
of a twentieth of a nat."""

STRONG = 20.0
"""Amplitude over noise from which lone echoes tell whether the filter makes what their fits leave white."""

MOST_LEFT = 1.3
"""chi2 per sample of these fits up to which it does: beyond, the pulse misses its echoes by more than the noise, and a
filter for noise makes more of that."""


def choose_whitening(block: WaveformBlock, system: SystemPulse, change: float = 0.0) -> SystemPulse:
    """Let fits whiten coloured noise where lone echoes then leave white noise, and the judge does not object.

    Parameters
    ----------
    block : WaveformBlock
        A sample of the strip.
    system : SystemPulse
        Its pulse and noise.
    change : float
        Of the pulse from shot to shot, as a share of its amplitude.

    Returns
    -------
    SystemPulse
        With `noise.whitening`: two shares, or empty where fits are to take the noise for white.
    """
    plain = replace(system, noise=replace(system.noise, whitening=()))
    whitening = predict_noise(system.noise.correlation)
    if whitening is None or system.noise.quiet < LEAST_NOISE:
        return plain
    near, far = whitening
    predicted = 1 - (1 - (near / (1 - far)) ** 2) * (1 - far * far)  # of the variance of the next sample
    if predicted < LEAST_PREDICTED:
        return plain
    block = thin_samples(block, LOOK)
    whitened = replace(system, noise=replace(system.noise, whitening=whitening))
    explained = explain(block, plain)
    echoes = explained.echoes
    lone = echoes.waveform[find_single(echoes, len(block), system, STRONG)]
    left = explain(block.rows(lone), whitened, max_echoes=1).echoes.residual.astype(np.float64) ** 2
    if len(left) < FEW:
        return plain
    typical = np.median(left)
    error = MEDIAN_ERROR * MAD_TO_STD * np.median(np.abs(left - typical)) / np.sqrt(len(left))
    if typical - error > MOST_LEFT:
        return plain
    # Whitened fits take small changes of the pulse for echoes: the description, which knows both, is then longer.
    length = describe_waveforms(block, whitened, explain(block, whitened), [change])[0]
    other = describe_waveforms(block, plain, explained, [change])[0]
    return whitened if exceed(length, other) <= SURE else plain
