"""Noise once the pulse stands: what weak echoes add to it, and whether fits whiten it (docs/algorithms.md H10, H11)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from wavebatch.core.order import median
from wavebatch.core.units import MAD_TO_STD, MEDIAN_ERROR, QUANTISATION_STD
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.elementary import log
from wavebatch.kernels.signal.noise import predict_noise
from wavebatch.stages.pulse_tables import noise_factors, pulse_shape, shape_limits
from wavebatch.surveying.measuring.judge import (
    SEARCH,
    SURE,
    Explained,
    count_errors,
    describe_waveforms,
    exceed,
    explain,
)
from wavebatch.surveying.measuring.mirror import look_in_mirror
from wavebatch.surveying.measuring.noise_and_width import DITHERED, FEW, UNDITHERED, find_single, thin_samples
from wavebatch.surveying.measuring.residuals import find_echoes

LEAST_NOISE = 0.5
"""Noise of a sample below which rounding makes what a filter of neighbours sees [DN]."""

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

Seen = tuple[SystemPulse, Explained]

LOWER = 0.9
"""Step by which less noise is tried: that of a significance in `settle`, over its first."""

LIKELY = 1.0
"""Standard errors by which a further step must be shorter, once one is sure: each step alone adds few echoes, and SURE
of each stopped where noise was still 1.2 to 1.6 times too large."""

LESS = 0.97
"""Noise over another one up to which it is less: it moves one echo in a hundred."""


def lower_noise(block: WaveformBlock, system: SystemPulse) -> tuple[ReceiverNoise, Seen | None]:
    """Take off the noise what echoes too weak to be found add to it, as long as two judges agree.

    Parameters
    ----------
    block : WaveformBlock
        A sample of the strip.
    system : SystemPulse
        Its pulse and noise, with a misfit.

    Returns
    -------
    noise : ReceiverNoise
        With less noise of a pulse, never less than that of a sample; or that of the system.
    seen : (SystemPulse, Explained) or None
        The system with it, and what it explains of the sample, where that was looked at.

    Notes
    -----
    With less noise more echoes are found. They are there if the waveforms in which they are found are shorter to
    describe with them, by SURE, and if the mirror gains less: a description knows of noise what two neighbours say, and
    slow noise goes as often down as up. Once a step is sure the next ones are as LIKELY to be right as not to be.
    """
    block = thin_samples(block, LOOK)
    explained: Explained | None = None
    least = SURE
    while True:
        for noise in _list_lower(system, block.spacing):
            explained = explained or explain(block, system)
            lower = replace(system, noise=noise)
            found = explain(block, lower)
            longer = np.subtract(*(describe_waveforms(block, system, one, [0.0])[0] for one in (found, explained)))
            same = np.equal(*(one.echoes.count(len(block)) for one in (found, explained)))
            if count_errors(np.where(same, 0.0, longer)) < -least:
                before, after = (next(look_in_mirror(block, *one))[1] for one in ((system, explained), (lower, found)))
                if after.worth > before.worth:
                    system, explained, least = lower, found, LIKELY
                    break
        else:
            return system.noise, (system, explained) if explained else None


def _list_lower(system: SystemPulse, spacing: float) -> Iterator[ReceiverNoise]:
    """Less noise: without what two neighbours do not say of its correlation, as weak echoes make it, and by a step."""
    noise, width = system.noise, shape_limits(system, spacing).ref
    near, shares, tried = [1.0, *noise.correlation[:2]], predict_noise(noise.correlation), []
    if shares is not None and len(near) > 2:
        while len(near) <= len(noise.correlation):
            near.append(shares[0] * near[-1] + shares[1] * near[-2])
        both = (noise_factors(pulse_shape(system, spacing), width, tuple(one)) for one in (near[1:], noise.correlation))
        less = float(np.divide(*(factors[0] for factors in both)))
        tried = [replace(noise, std=less * noise.std, correlation=tuple(near[1:]))]
    least = max(noise.quiet, DITHERED if noise.quiet < UNDITHERED else QUANTISATION_STD)
    for one in (*tried, replace(noise, std=LOWER * noise.std)):
        if max(one.std, least) < LESS * noise.std:  # NaN where that correlation is none of a noise
            yield replace(one, std=max(least, one.std))


def choose_whitening(
    block: WaveformBlock, system: SystemPulse, change: float = 0.0, seen: Seen | None = None
) -> SystemPulse:
    """Let fits whiten coloured noise where lone echoes then leave white noise, and the judge does not object.

    Parameters
    ----------
    block : WaveformBlock
        A sample of the strip.
    system : SystemPulse
        Its pulse and noise.
    change : float
        Of the pulse from shot to shot, as a share of its amplitude.
    seen : (SystemPulse, Explained), optional
        As `lower_noise` returns it: a pulse that does not change is explained once.

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
    explained = seen[1] if seen and seen[0] == plain else explain(block, plain)
    echoes = explained.echoes
    lone = echoes.waveform[find_single(echoes, len(block), system, STRONG)]
    left = find_echoes(block.rows(lone), whitened, **SEARCH | {"max_echoes": 1})[2].residual.astype(np.float64) ** 2
    if len(left) < FEW:
        return plain
    typical = median(left)
    error = MEDIAN_ERROR * MAD_TO_STD * median(np.abs(left - typical)) / np.sqrt(len(left))
    if typical - error > MOST_LEFT:
        return plain
    found = explain(block, whitened)
    length = describe_waveforms(block, whitened, found, [change])[0]
    other = describe_waveforms(block, plain, explained, [change])[0]
    # An echo costs the logarithm of what can be known of it: the larger errors of fits that take coloured noise for
    # white are paid in what they leave, and must not make their description shorter.
    number, same = (one.echoes.count(len(block)) for one in (explained, found))
    single = np.flatnonzero((number == 1) & (same == 1))
    for error in ("time_err", "amplitude_err", "sigma_err"):
        known = (getattr(one.echoes, error)[np.isin(one.echoes.waveform, single)] for one in (explained, found))
        ratio = np.divide(*known).astype(np.float64)
        if (ratio > 0).any():
            other += number * log(max(median(ratio[ratio > 0]), 1.0))
    return whitened if exceed(length, other) <= SURE else plain
