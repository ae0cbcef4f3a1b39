"""Baselines of noise.pooled are those that a loop over waveforms finds from their quiet samples."""

from dataclasses import replace

import naive_signal
import numpy as np
import pytest

from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.kernels.signal.noise import find_levels
from wavebatch.stages.chain import STAGES
from wavebatch.stages.decompose.fit import adaptive
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.noise import LOWEST_TENTH, pooled
from wavebatch.stages.pulse_tables import noise_factors

SYSTEM = SystemPulse(2.0, noise=ReceiverNoise(baseline=12.0, baseline_spread=0.5, std=1.1))


def record(rng, n=60, s=80):
    """Whole counts with an echo and its slow tail in each waveform."""
    x = np.arange(s)
    time = rng.uniform(15, 40, (n, 1))
    y = 12 + 0.5 * rng.standard_normal((n, 1)) + 1.1 * rng.standard_normal((n, s))
    y += 80 * np.exp(-0.5 * ((x - time) / 2.0) ** 2) + 2.5 * (x > time) * np.exp(-np.maximum(x - time, 0) / 20)
    return WaveformBlock.from_samples(np.clip(np.rint(y), 0, 255).astype(np.uint8))


@pytest.mark.parametrize("recovery", [0.0, 25.0])
@pytest.mark.parametrize("gaps", [False, True])
def test_baselines_are_those_of_a_loop(rng, recovery, gaps):
    block = record(rng)
    missing = np.zeros(block.samples.shape, bool)
    missing[:, 70:] = gaps
    block = replace(block, missing=missing) if gaps else block
    noise = STAGES["noise.pooled"].function(block, replace(SYSTEM, noise=replace(SYSTEM.noise, recovery=recovery)))
    width = 3.5 * np.hypot(np.sqrt(6) / 4 * 1.1, 0.5)
    for w, waveform in enumerate(block.samples.astype(float) - 12):
        quiet = naive_signal.find_quiet(waveform[:, None].astype(np.float32), width, 6, int(recovery))[:, 0]
        quiet &= ~missing[w]
        trust = 0.25 / (0.25 + 1.1**2 / max(quiet.sum(), 1)) if quiet.any() else 0.0
        assert noise.baseline[w] == pytest.approx(12 + trust * waveform[quiet].mean() if quiet.any() else 12, abs=1e-4)
        assert noise.baseline_err[w] == pytest.approx(0.5 * np.sqrt(1 - trust), rel=1e-5)
    assert noise.std == pytest.approx(1.1)
    level = replace(SYSTEM.noise, recovery=recovery, baseline_spread=0.0)
    assert STAGES["noise.pooled"].function(block, replace(SYSTEM, noise=level)).baseline_err is None


@pytest.mark.parametrize("gaps", [False, True])
def test_a_level_far_from_the_strips_is_seen_where_a_waveform_is_flat(rng, gaps):
    """One waveform 4 DN above levels that scatter by .5: no sample of it is quiet by the strip's. One full of echoes,
    and one full of a clipped one, keep the strip's level; so does one that is flat in its first 85 samples, of 200 but
    not of 150 that were recorded."""
    x = np.arange(200.0)
    samples = 12 + 1.1 * rng.standard_normal((50, 200))
    samples[[7, 9]] += 4
    samples[8] += 30 + 20 * np.sin(x / 4)
    samples[9, 85:] += 30 + 20 * np.sin(x[85:] / 4)
    samples[10, 4:] = 255
    missing = np.zeros(samples.shape, bool)
    missing[:, 150:] = gaps
    block = WaveformBlock.from_samples(np.rint(samples).astype(np.uint8))
    block = replace(block, missing=missing) if gaps else block
    baseline = STAGES["noise.pooled"].function(block, SYSTEM).baseline
    assert baseline[7] == pytest.approx(16, abs=0.3)
    assert baseline[9] == (pytest.approx(16, abs=0.3) if gaps else 12)
    assert baseline[[8, 10]] == pytest.approx([12, 12], abs=0.5)
    assert np.delete(baseline, [7, 8, 9, 10]) == pytest.approx(np.full(46, 12), abs=0.5)


@pytest.mark.parametrize("gaps", [False, True])
def test_levels_of_the_last_samples_scatter_by_their_errors(rng, gaps):
    samples = np.rint(20 + 1.5 * rng.standard_normal((4000, 60))).astype(np.uint8)
    missing = np.zeros(samples.shape, bool)
    missing[::2, 50:] = gaps
    block = WaveformBlock.from_samples(samples)
    block = replace(block, missing=missing) if gaps else block
    noise = STAGES["noise.tail"].function(block, replace(SYSTEM, noise=ReceiverNoise(std=1.5)), samples=20)
    assert np.std((noise.baseline - 20) / noise.baseline_err) == pytest.approx(0.93, abs=0.06)  # own noise, if larger


@pytest.mark.parametrize("correlation", [(), (0.5, 0.25, 0.125)])
def test_a_wrong_level_is_neither_an_echo_nor_an_amplitude(correlation):
    """Levels scatter by the noise, and two echoes leave few quiet samples: what a level may be is not theirs."""
    rng, m, sigma, time, x = np.random.default_rng(1), 400, 8.0, np.array([38.0, 95.0]), np.arange(135)
    height = np.exp(rng.uniform(np.log(15), np.log(70), (m, 2)))
    noise = rng.standard_normal((m, len(x)))
    for i in range(1, len(x) if correlation else 0):
        noise[:, i] = 0.5 * noise[:, i - 1] + np.sqrt(0.75) * noise[:, i]
    y = 20 + rng.standard_normal((m, 1)) + noise
    y += (height[:, :, None] * np.exp(-0.5 * ((x - time[:, None]) / sigma) ** 2)).sum(axis=1)
    block = WaveformBlock.from_samples(np.rint(y).astype(np.uint16))
    std = 1.04 * noise_factors(GAUSSIAN, sigma, correlation)[0]
    known = ReceiverNoise(
        baseline=20.0, baseline_spread=1.0, std=std, by_kind={"quiet": 1.04}, correlation=correlation,
        whitening=(0.5, 0.0) if correlation else (),
    )  # fmt: skip
    found = []
    for free_levels in (False, True):
        system = SystemPulse(sigma, noise=known)
        levels = pooled(block, system)
        echoes = adaptive(block, levels, system, maximum(block, levels, system), free_levels=free_levels)
        away = np.abs(echoes.time[:, None] - time)
        near = away.min(axis=1) < 4
        off = echoes.amplitude[near] - height[echoes.waveform[near], away.argmin(axis=1)[near]]
        within = np.mean(np.abs(off) < echoes.amplitude_err[near])
        found.append((np.count_nonzero(~near), np.sqrt(np.mean(off**2)), within, np.count_nonzero(near)))
    (false, scatter, _, _), (left, rest, within, number) = found
    assert left < 0.4 * false and rest < (0.9 if correlation else 0.5) * scatter
    assert 0.6 < within < 0.8 and number >= 0.99 * 2 * m


def test_the_lowest_tenth_of_noise_gives_its_level(rng):
    signal = rng.normal(12.0, 2.0, (100, 400)).astype(np.float32)
    lowest = find_levels(signal, 2.0, 3).lowest + LOWEST_TENTH * 2.0
    assert lowest.mean() == pytest.approx(12.0, abs=0.2)


def test_the_level_of_a_recording_has_an_error_of_its_own():
    """Two recordings 20 counts apart, each with an echo that leaves few quiet samples: a third was in one error."""
    rng, m, sigma, x = np.random.default_rng(2), 400, 6.0, np.arange(80)
    time, height = np.array([16.0, 64.0]), np.exp(rng.uniform(np.log(10), np.log(150), (m, 2)))
    y = 20 + 20.0 * (x >= 44) + rng.standard_normal((m, len(x)))
    y += (height[:, :, None] * np.exp(-0.5 * ((x - time[:, None]) / sigma) ** 2)).sum(axis=1)
    missing = np.zeros(y.shape, bool)
    missing[:, 38:44] = True
    block = replace(WaveformBlock.from_samples(np.rint(y).astype(np.uint16)), missing=missing)
    system = SystemPulse(sigma, noise=ReceiverNoise(baseline=20.0, std=1.04, by_kind={"quiet": 1.04}))
    noise = pooled(block, system)
    assert noise.of_sample is not None
    echoes = adaptive(block, noise, system, maximum(block, noise, system))
    away = np.abs(echoes.time[:, None] - time)
    near = away.min(axis=1) < 3
    off = echoes.amplitude[near] - height[echoes.waveform[near], away.argmin(axis=1)[near]]
    assert np.count_nonzero(near) >= 0.99 * 2 * m and np.count_nonzero(~near) < 0.02 * m
    assert 0.6 < np.mean(np.abs(off) < echoes.amplitude_err[near]) < 0.8


def test_what_one_more_echo_needs_is_not_asked_of_lone_ones(rng):
    block = record(rng)
    noise = pooled(block, SYSTEM)
    assert (noise.baseline_err > 0).all()
    found = [adaptive(block, noise, SYSTEM, maximum(block, noise, SYSTEM), acceptance=least) for least in (1e5, 15.0)]
    assert (found[0].count(60) >= 1).all() and len(found[1]) >= len(found[0])
