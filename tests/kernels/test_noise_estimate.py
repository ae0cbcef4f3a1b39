"""Noise of whole counts (H10, H11, T14, T16): pooled std, its floor, spread of baselines, coloured noise."""

import numpy as np
import pytest

from wavebatch import surveying
from wavebatch.core.units import QUANTISATION_STD
from wavebatch.core.waveforms import ReceiverNoise, WaveformBlock
from wavebatch.kernels.signal.noise import estimate_noise
from wavebatch.stages.chain import STAGES
from wavebatch.surveying.measuring.residuals import hides_noise
from wavebatch.tools.api import load_chain
from wavebatch.tools.simulate import Recording, simulate_block


def record(std, n=2000, s=80, level=12.0, spread=0.5, seed=0, amplitude=60.0):
    """Rounded waveforms (s, n), one echo in each (none where amplitude is 0)."""
    rng = np.random.default_rng(seed)
    base = level + spread * rng.standard_normal(n)
    time = rng.uniform(20, 60, n)
    y = base + std * rng.standard_normal((s, n))
    y += amplitude * np.exp(-0.5 * ((np.arange(s)[:, None] - time) / 2.0) ** 2)
    return np.clip(np.rint(y), 0, 255).astype(np.float32)


@pytest.mark.parametrize("std", [0.2, 0.3, 0.4, 0.5, 0.7, 1.0])
@pytest.mark.parametrize("amplitude", [0.0, 60.0])
def test_std_of_whole_counts_includes_rounding(std, amplitude):
    """Within 6 % of sqrt(std^2 + 1/12) from 0.2 counts on, within 1 % from 0.5 on (H10)."""
    pooled = estimate_noise(record(std, amplitude=amplitude), 6)
    true = np.hypot(std, QUANTISATION_STD)
    assert pooled.std == pytest.approx(true, rel=0.06 if std < 0.5 else 0.01)
    assert pooled.level == pytest.approx(12.0, abs=0.05)
    assert pooled.share > 0.5


@pytest.mark.parametrize("shape", [(0, 0), (80, 0), (1, 1), (2, 5), (5, 1)])
def test_little_or_nothing_gives_finite_numbers(shape):
    assert np.isfinite(estimate_noise(np.full(shape, 3.0, np.float32), 6)[:4]).all()


def test_waveforms_of_which_nothing_was_recorded_do_not_count():
    signal = record(0.7)
    missing = np.zeros(signal.shape, bool)
    missing[:5] = True
    alone = estimate_noise(signal, 6, missing=missing)
    lost = np.full((len(signal), 3000), 200.0, np.float32)
    found = estimate_noise(np.hstack([signal, lost]), 6, missing=np.hstack([missing, np.ones(lost.shape, bool)]))
    assert found[:4] == pytest.approx(alone[:4], rel=1e-6)
    assert found.correlation == pytest.approx(alone.correlation, abs=1e-6)
    assert np.isfinite(estimate_noise(lost, 6, missing=np.ones(lost.shape, bool))[:4]).all()


@pytest.mark.parametrize("spread", [0.0, 0.4, 1.5, 4.0])
@pytest.mark.parametrize("std", [0.7, 1.5])
def test_spread_of_baselines_is_separated_from_noise(std, spread):
    pooled = estimate_noise(record(std, n=3000, level=30.0, spread=spread), 6)
    assert pooled.spread == pytest.approx(spread, rel=0.08, abs=0.04)
    assert pooled.std == pytest.approx(np.hypot(std, QUANTISATION_STD), rel=0.02)


@pytest.mark.quick_cases("0.667-1.39")
@pytest.mark.parametrize(("rho", "factor"), [(0.5, 1.29), (0.667, 1.39), (0.8, 1.48)])
def test_coloured_noise_shows_in_the_covariance(rho, factor):
    """H11: the remedy multiplies the noise by 1.29, 1.39, 1.48 after the [1 2 1] filter, and by more for a pulse."""
    recording = Recording(rho=rho, noise_std=3.0, baseline=40.0, baseline_spread=0.0)
    block, _ = simulate_block("flat", 4000, np.random.default_rng(5), recording=recording)
    pooled = estimate_noise(block.samples.T.astype(np.float32), 6)
    first, second = pooled.correlation[:2]
    assert np.sqrt((6 + 8 * first + 2 * second) / 6) == pytest.approx(factor, rel=0.03)
    assert surveying.survey_block(block).system.noise.std >= 0.99 * factor * pooled.std


@pytest.mark.parametrize(("rho", "s"), [(0.8, 60), (0.9, 60), (0.9, 120), (0.93, 200)])
def test_slow_noise_is_no_drift_of_the_baseline(rng, rho, s):
    """With 12 lags noise of .9 was 17 % too small, and errors of widths 1.4 times."""
    pooled = estimate_noise(np.rint(40 + 3 * slow_noise(rng, rho, s, 2000)).astype(np.float32), 6)
    assert pooled.std == pytest.approx(3.0, rel=0.07)
    assert pooled.correlation[:3] == pytest.approx(rho ** np.arange(1, 4), abs=0.04)


def slow_noise(rng, rho, s, n):
    """Noise (s, n) of standard deviation 1 with the correlation rho^k."""
    noise = rng.standard_normal((s + 100, n))
    for i in range(1, len(noise)):
        noise[i] = rho * noise[i - 1] + np.sqrt(1 - rho * rho) * noise[i]
    return noise[100:]


@pytest.mark.parametrize(("rho", "s"), [(0.5, 20), (0.7, 24), (0.9, 30), (0.9, 40)])
@pytest.mark.parametrize("spread", [0.0, 2.0])
def test_slow_noise_of_short_packets_is_not_taken_for_levels(rng, rho, s, spread):
    """Runs of four to ten quiet samples do not see all of it: at .9 it was half as large, and the rest was spread."""
    y = 60 + spread * rng.standard_normal(3000) + 2 * slow_noise(rng, rho, s, 3000)
    y += 90 * np.exp(-0.5 * ((np.arange(s)[:, None] - rng.uniform(6, s - 6, 3000)) / 1.9) ** 2)
    pooled = estimate_noise(np.rint(y).astype(np.float32), 6)
    assert pooled.std == pytest.approx(2.0, rel=0.12)
    assert pooled.spread == pytest.approx(spread, abs=0.45)
    assert pooled.correlation[:2] == pytest.approx([rho, rho * rho], abs=0.08)


@pytest.mark.parametrize(("bend", "least"), [(2.0, 0.8), (3.0, 0.65), (4.5, 0.5)])
@pytest.mark.parametrize("spread", [0.0, 4.0])
def test_smooth_noise_of_short_packets_is_more_than_their_levels(rng, bend, least, spread):
    """As receivers of wide pulses make it, seen in six samples before the signal: .76, .55 and .3 of it were found."""
    noise = rng.standard_normal((24 + 40, 2500))
    taps = np.exp(-0.5 * (np.arange(-20, 21) / bend) ** 2)
    noise = sum(tap * noise[i : i + 24] for i, tap in enumerate(taps / np.sqrt(np.sum(taps**2))))
    y = 200 + spread * rng.standard_normal(2500) + 4 * noise
    y += 400 * np.exp(-0.5 * ((np.arange(24)[:, None] - rng.uniform(24, 34, 2500)) / 6.0) ** 2)
    pooled = estimate_noise(np.rint(y).astype(np.float32), 18)
    assert least * 4 < pooled.std < 1.1 * 4
    assert pooled.correlation[0] == pytest.approx(np.exp(-0.25 / bend**2), abs=0.04)


@pytest.mark.parametrize("spread", [1.0, 4.0])
@pytest.mark.parametrize("kind", ["white", "smooth"])
def test_levels_are_not_taken_for_slow_noise(rng, kind, spread):
    """Smooth noise rises faster than its variogram begins: it is none that is known beyond the lags that are seen."""
    noise = rng.standard_normal((30 + 8, 3000))
    taps = np.exp(-0.5 * (np.arange(-4, 5) / 1.5) ** 2)
    if kind == "smooth":
        noise = sum(tap * noise[i : i + 30] for i, tap in enumerate(taps / np.sqrt(np.sum(taps**2))))
    y = 60 + spread * rng.standard_normal(3000) + 2 * noise[:30]
    y += 90 * np.exp(-0.5 * ((np.arange(30)[:, None] - rng.uniform(6, 24, 3000)) / 1.9) ** 2)
    pooled = estimate_noise(np.rint(y).astype(np.float32), 6)
    assert pooled.std < 2.1 and pooled.spread == pytest.approx(spread, rel=0.1, abs=0.2)


@pytest.mark.quick_cases("2.0")
@pytest.mark.parametrize("spread", [0.0, 0.5, 2.0, 6.0])
def test_baselines_of_waveforms_are_recovered(spread):
    """noise.pooled weighs the waveform's own quiet samples against the strip's baseline: never worse than either."""
    n = 3000
    rng = np.random.default_rng(8)
    base = 40 + spread * rng.standard_normal((n, 1))
    y = base + rng.standard_normal((n, 80))
    y += 90 * np.exp(-0.5 * ((np.arange(80) - rng.uniform(20, 60, (n, 1))) / 2.0) ** 2)
    block = WaveformBlock.from_samples(np.rint(y).astype(np.uint8))
    noise = STAGES["noise.pooled"].function(block, surveying.survey_block(block).system)
    error = np.abs(noise.baseline - base[:, 0])
    own = np.hypot(1, QUANTISATION_STD) / np.sqrt(60)
    lost = error > 1
    assert lost.mean() < 0.003
    rms = np.sqrt(np.mean(error[~lost] ** 2))
    assert rms < 1.1 * own * spread / np.hypot(own, spread) + 0.02
    assert noise.std == pytest.approx(np.full(n, np.hypot(1, QUANTISATION_STD)), rel=0.03)


@pytest.mark.parametrize(("number", "s"), [(1, 40), (2, 80), (4, 80), (1, 24)])
@pytest.mark.parametrize("std", [0.9, 2.2])
def test_weak_echoes_everywhere_are_not_taken_for_noise(number, s, std):
    """Echoes of 3 to 8 standard deviations, `number` in each waveform: the noise was 1.6 to 4.5 times too large."""
    rng = np.random.default_rng(number + s)
    n, x = 4096, np.arange(s)[:, None]
    y = 12 + std * rng.standard_normal((s, n))
    for _ in range(number):
        height = std * rng.uniform(3, 8, n)
        y += height * np.exp(-0.5 * ((x - rng.uniform(6, s - 6, n)) / 2.0) ** 2)
    pooled = estimate_noise(np.clip(np.rint(y), 0, 255).astype(np.float32), 6)
    assert pooled.std == pytest.approx(np.hypot(std, QUANTISATION_STD), rel=0.06)


def test_noise_that_is_a_little_lopsided_keeps_its_limit():
    """As that of a receiver (Leica: 1.3): cut off at a tighter limit it would be too small."""
    rng = np.random.default_rng(4)
    noise = rng.gamma(16.0, 0.25, (80, 4000)) - 4.0  # standard deviation 1, skewness 0.5
    pooled = estimate_noise(np.rint(30 + 2 * noise).astype(np.float32), 6)
    assert pooled.std == pytest.approx(np.hypot(2.0, QUANTISATION_STD), rel=0.01)


@pytest.mark.parametrize("level", [30.0, 30.25, 30.43, 30.5])
def test_noise_on_two_counts_is_not_lopsided(rng, level):
    """Their median is one of them: noise of a level of .43 was 10 % too small, and its correlation by a third."""
    exact = rng.standard_normal((240, 3000))
    for at in range(2, 240):
        exact[at] += 0.78 * exact[at - 1] - 0.27 * exact[at - 2]
    pooled = estimate_noise(np.rint(level + 0.47 * exact[40:] / exact[40:].std()).astype(np.float32), 6)
    std = np.hypot(0.47, QUANTISATION_STD)
    assert pooled.std == pytest.approx(std, rel=0.03)
    assert pooled.correlation[0] == pytest.approx(0.78 / 1.27 * 0.47**2 / std**2, rel=0.05)


@pytest.mark.parametrize(("level", "std"), [(0, 5.0), (4, 5.0), (12, 8.0), (0, 0.6), (3, 40.0), (1, 1.0)])
@pytest.mark.parametrize("rho", [0.0, 0.6])
def test_noise_that_is_cut_at_zero_is_that_before_the_cut(level, std, rho):
    """As recorded, level 0 and noise 1 were 0.38 and 0.63: 4 % of the echoes were noise, errors 1.8 times too small."""
    rng = np.random.default_rng(10)
    y = level + std * slow_noise(rng, rho, 80, 2000)
    y += 60 * std * np.exp(-0.5 * ((np.arange(80)[:, None] - rng.uniform(20, 60, 2000)) / 2.0) ** 2)
    pooled = estimate_noise(np.maximum(np.rint(y), 0), 6)
    assert pooled.std == pytest.approx(np.hypot(std, QUANTISATION_STD), rel=0.07)
    assert pooled.level == pytest.approx(level, abs=(0.12 if rho else 0.04) * std)
    if std >= 1:
        assert pooled.correlation[:2] == pytest.approx([rho, rho * rho], abs=0.07)


@pytest.mark.parametrize(("level", "std"), [(0.0, 0.2), (0.3, 0.1), (2.4, 0.9), (40.0, 5.0)])
def test_noise_that_is_not_cut_is_as_recorded(level, std):
    """At 2.4 over 0.9, as of RIEGL, 2 % of the samples are 0; the first two are 0 but for a few."""
    rng = np.random.default_rng(11)
    y = np.maximum(np.rint(level + std * rng.standard_normal((80, 2000))), 0)
    pooled = estimate_noise(y, 6)
    assert pooled.std == pytest.approx(max(np.std(y), QUANTISATION_STD), rel=0.02)
    assert pooled.level == pytest.approx(np.mean(y), abs=0.02)


def test_zeros_that_are_no_noise_do_not_count_as_such():
    """A tenth of the waveforms is 0 throughout, as where a packet was lost: normal noise has no such gap."""
    y = record(1.0, spread=0.0, level=40.0)
    y[:, ::10] = 0
    assert estimate_noise(y, 6).std < 1.2


@pytest.mark.parametrize("level", [0.0, 1.0])
def test_baselines_at_count_0_are_recovered(rng, level):
    base = level + 0.5 * rng.standard_normal((3000, 1))
    y = base + rng.standard_normal((3000, 80))
    y += 90 * np.exp(-0.5 * ((np.arange(80) - rng.uniform(20, 60, (3000, 1))) / 2.0) ** 2)
    block = WaveformBlock.from_samples(np.maximum(np.rint(y), 0).astype(np.uint8))
    system = surveying.survey_block(block).system
    noise = STAGES["noise.pooled"].function(block, system)
    assert system.noise.baseline_spread == pytest.approx(0.5, rel=0.1)
    error = noise.baseline - base[:, 0]
    assert abs(np.mean(error)) < 0.05 and np.std(error) < 0.3


@pytest.mark.quick_cases("0.0-0.5-*", "40.0-0.9-24-7")
@pytest.mark.parametrize(
    ("level", "rho", "s", "edge"),
    [(0.0, 0.0, 80, 20), (0.5, 0.0, 80, 20), (0.0, 0.5, 80, 20), (40.0, 0.9, 24, 7), (40.0, 0.9, 40, 10)],
)
def test_echoes_over_noise_that_is_not_seen_whole_have_right_errors(rng, level, rho, s, edge):
    """Cut off at 0, or slow in short packets. Before: 4 % false echoes, rms error over reported error to 1.9."""
    n = 1500
    time, height = rng.uniform(edge, s - edge, n), np.exp(rng.uniform(np.log(10), np.log(200), n))
    y = level + slow_noise(rng, rho, s, n).T
    y += height[:, None] * np.exp(-0.5 * ((np.arange(s) - time[:, None]) / 2.0) ** 2)
    block = WaveformBlock.from_samples(np.clip(np.rint(y), 0, 255).astype(np.uint8))
    system = surveying.survey_block(block).system
    echoes = load_chain("accurate").run(block, system)
    assert len(echoes) < 1.005 * n
    near = np.abs(echoes.time - time[echoes.waveform]) < 2
    assert n <= np.count_nonzero(near) <= 1.002 * n, "each is found, and hardly one is split"
    for off, error in (
        (echoes.amplitude - height[echoes.waveform], echoes.amplitude_err),
        (echoes.sigma - 2.0, echoes.sigma_err),
        (echoes.time - time[echoes.waveform], echoes.time_err),
    ):
        assert 0.85 < np.sqrt(np.mean((off / error)[near] ** 2)) < 1.12


@pytest.mark.parametrize(
    ("level", "quiet", "spread", "weak", "said"),
    [
        (0.0, 1.0, 0.0, 0.0, False),  # half of it: measured from the rest
        (-0.7, 1.0, 0.0, 0.0, True),
        (1.0, 0.9, 1.2, 0.0, True),  # levels of waveforms below 0 do not show
        (40.0, 0.9, 1.2, 0.0, False),
        (0.02, 0.29, 0.0, 0.3, False),  # a small noise
        (0.02, 0.29, 0.0, 0.8, True),  # one that only echoes lift above 0
        (40.0, 0.29, 0.0, 0.8, False),
    ],
)
def test_noise_below_count_0_is_a_guess(level, quiet, spread, weak, said):
    kinds = {"quiet": quiet, "weak_echoes": weak}
    assert hides_noise(ReceiverNoise(level, spread, std=max(quiet, weak), by_kind=kinds)) is said


@pytest.mark.parametrize("spread", [0.0, 4.0])
def test_weak_echoes_of_a_wide_pulse_are_no_slow_noise(spread):
    """Of canopies, one to three noises high: single samples do not show them. They made this noise 1.9 times as large
    to the pulse, and hid echoes of nine standard deviations.
    """
    rng = np.random.default_rng(12)
    s, n, width, std = 100, 3000, 6.0, 3.0
    y = 200 + spread * rng.standard_normal(n) + std * rng.standard_normal((s, n))
    first = rng.uniform(35, 70, n)
    for height in (rng.uniform(1, 3, n), rng.uniform(1, 40, n), rng.uniform(1, 3, n)):
        time = first + rng.uniform(-15, 15, n)
        y += std * height * np.exp(-0.5 * ((np.arange(s)[:, None] - time) / width) ** 2)
    pooled = estimate_noise(np.rint(y).astype(np.float32), int(3 * width))
    lags = np.arange(1, len(pooled.correlation) + 1)
    gain = 1 + 2 * np.sum(pooled.correlation * np.exp(-0.25 * (lags / width) ** 2))
    assert pooled.std * np.sqrt(gain) == pytest.approx(std, rel=0.08)
    assert pooled.level == pytest.approx(200, abs=0.1 * std + 0.1 * spread)


def test_levels_of_known_noise_have_no_tails_in_them():
    """By levels of one round, white noise that was known had correlations of .014 beside the late part of a pulse."""
    rng = np.random.default_rng(1)
    lag = np.arange(120)[:, None] - rng.uniform(36, 50, 2000)
    pulse = np.exp(-0.5 * (lag / 3.1) ** 2) + 0.0046 * np.exp(-0.5 * ((lag - 39.6) / 9.9) ** 2)
    height = 900 * np.exp(0.5 * rng.standard_normal(2000))
    signal = np.rint(200 + rng.standard_normal(lag.shape) + height * pulse).astype(np.float32)
    found = estimate_noise(signal, 11, begin=np.array([1.04**2]))
    assert found.std == pytest.approx(1.04, rel=0.005) and found.correlation[:8].sum() < 0.03
