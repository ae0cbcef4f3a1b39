"""Wavelets and deconvolution: Wang's cases (T7), the numbers of docs/algorithms.md 1.2 and 2.5, plain twins."""

from dataclasses import replace

import naive
import numpy as np
import pytest
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes
from published import WANG_CASES, simulate_wang

from wavebatch.core.waveforms import ReceiverNoise, SystemPulse
from wavebatch.kernels.signal import deconvolve
from wavebatch.kernels.signal.filters import b3_detail, b3_gain, b3_level
from wavebatch.stages.chain import STAGES
from wavebatch.stages.detect.transformed import transform

GAUSS = np.exp(-0.5 * (np.arange(-6, 7) / 2) ** 2)
SKEWED = np.exp(-0.5 * (np.log1p(0.12 * np.arange(-6, 7)) / 0.24) ** 2)


def record(echoes, sigma, std, n, seed=0, spacing=1.0):
    """Waveforms with echoes (amplitude, time after sample 30) at random phases, finely rounded; the noise known."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(-0.5, 0.5, n) * (std > 0)
    amplitude, time = np.array(echoes, float).T
    recording = fine_recording(std, sigma, spacing=spacing)
    block, _ = simulate_echoes(recording, (30 + time + phase[:, None]) * spacing, FINE * amplitude, sigma, rng)
    return block, known_noise(recording, n, 0.3 * FINE), phase


def count(name, case, std=0.0, n=1, **parameters):
    block, _, recording = simulate_wang(case, std, n, np.random.default_rng(ord(case)))
    noise = known_noise(recording, n, 0.3 * FINE)
    return STAGES[f"detect.{name}"].function(block, noise, known_system(recording), **parameters).count(n)


@pytest.mark.parametrize("wavelet", ["b3", "mexican_hat"])
@pytest.mark.parametrize(("case", "number"), [("a", 1), ("b", 2), ("c", 1), ("d", 2), ("e", 3)])
def test_cases_of_wang_without_noise(case, number, wavelet):
    assert count("wavelet", case, wavelet=wavelet, threshold=3.0).tolist() == [number]


@pytest.mark.parametrize(("scale", "number"), [(1.0, 2), (2.0, 2), (3.0, 1)])
def test_case_b_is_resolved_at_scales_one_and_two(scale, number):
    assert count("wavelet", "b", scale=scale, threshold=3.0).tolist() == [number]


@pytest.mark.parametrize("std", [0.5, 1.0, 2.0, 4.0])
def test_cases_of_wang_in_noise(std):
    """Three standard deviations let noise through in 0.1 % of the samples: most of what is exact in `a` is that."""
    n = 4000
    share = {case: (count("wavelet", case, std, n, threshold=3.0) == len(WANG_CASES[case])).mean() for case in "abe"}
    assert share["b"] >= 0.9
    assert share["a"] <= 0.12
    if std <= 1:
        assert share["e"] >= 0.9


@pytest.mark.parametrize(
    ("sigma", "level", "widths"),
    [(1.06, 1, 0.84), (1.59, 2, 0.99), (2.12, 2, 0.88), (2.97, 3, 1.04), (4.25, 3, 0.89), (6.37, 4, 1.01)],
)
def test_the_scale_follows_the_pulse(sigma, level, widths):
    """Critical separations of 80 and 100 at the rule's level, in full widths at half maximum, mean over phases."""
    assert b3_level(sigma) == level
    fwhm, apart = 2.354820045 * sigma, []
    for phase in np.linspace(0, 1, 4, endpoint=False):
        distance = np.arange(0.6, 1.4, 0.01) * fwhm
        x = np.arange(120)[:, None]
        y = 80 * np.exp(-0.5 * ((x - 45 - phase) / sigma) ** 2)
        y = y + 100 * np.exp(-0.5 * ((x - 45 - phase - distance) / sigma) ** 2)
        detail = b3_detail(y, level)
        peaks = [sum(value > 1 for value in column[naive_peaks(column)]) for column in detail.T]
        apart.append(distance[np.argmax(np.array(peaks) >= 2)] / fwhm)
    assert np.mean(apart) == pytest.approx(widths, abs=0.06)


def naive_peaks(column):
    return [i for i in range(1, len(column) - 1) if column[i - 1] < column[i] >= column[i + 1]]


@pytest.mark.parametrize("s", [1, 3, 40])
@pytest.mark.parametrize("level", [1, 2, 3, 4])
def test_details_equal_the_plain_transform(s, level):
    signal = np.random.default_rng(s).standard_normal((s, 4))
    expected = np.stack([naive.b3_detail(column, level) for column in signal.T], axis=1)
    np.testing.assert_allclose(b3_detail(signal, level), expected, atol=1e-12)
    np.testing.assert_allclose(b3_detail(signal.astype(np.float32), level), expected, atol=1e-5)


def test_gain_of_noise_and_impulse_response_of_the_specification():
    assert [b3_gain(level) for level in (1, 2, 3, 4)] == pytest.approx([0.7235, 0.2855, 0.1780, 0.1222], abs=1e-4)
    impulse = np.zeros((41, 1))
    impulse[20] = 1
    expected = [0, 0, -0.00391, -0.01563, -0.03906, -0.07813, -0.05859, 0.09375, 0.20313, 0.09375]
    np.testing.assert_allclose(b3_detail(impulse, 2)[12:22, 0], expected, atol=1e-5)


@pytest.mark.parametrize("taps", [GAUSS, SKEWED], ids=["symmetric", "skewed"])
@pytest.mark.parametrize("s", [1, 5, 40])
def test_pulses_are_put_at_samples_and_back(taps, s):
    signal = np.random.default_rng(s).standard_normal((s, 3))
    matrix = naive.pulse_matrix(s, taps)
    np.testing.assert_allclose(deconvolve.convolve_pulse(signal, taps), matrix @ signal, atol=1e-6)
    np.testing.assert_allclose(deconvolve.correlate_pulse(signal, taps), matrix.T @ signal, atol=1e-6)


@pytest.mark.parametrize("taps", [GAUSS, SKEWED], ids=["symmetric", "skewed"])
def test_deconvolutions_equal_their_plain_twins(taps):
    rng = np.random.default_rng(5)
    truth = np.zeros((50, 4))
    truth[[12, 20, 31, 40], [0, 1, 1, 3]] = 80
    signal = naive.pulse_matrix(50, taps) @ truth + rng.standard_normal((50, 4))
    fast = deconvolve.deconvolve_richardson_lucy(signal, taps, np.full(4, 3.0), 12)
    np.testing.assert_allclose(fast, np.stack([naive.richardson_lucy(y, taps, 3, 12) for y in signal.T], 1), atol=1e-4)
    gold = deconvolve.deconvolve_gold(signal[:, [0, 1, 3]], taps, 8)
    plain = np.stack([naive.gold(y, taps, 8) for y in signal.T[[0, 1, 3]]], axis=1)
    np.testing.assert_allclose(gold, plain, rtol=1e-4, atol=1e-3)


def test_acceleration_is_worth_iterations():
    """The misfit after 16 accelerated iterations is below that after 60 plain ones."""
    truth = np.zeros((60, 1))
    truth[[25, 30]] = 80
    signal = naive.pulse_matrix(60, GAUSS) @ truth
    fast = deconvolve.deconvolve_richardson_lucy(signal, GAUSS, np.array([3.0]), 16)
    plain = naive.richardson_lucy(signal[:, 0], GAUSS, 3.0, 60, accelerate=False)[:, None]
    misfit, of_plain = (np.abs(deconvolve.convolve_pulse(profile, GAUSS) - signal).sum() for profile in (fast, plain))
    assert misfit < of_plain


def test_every_deconvolution_finds_place_and_amplitude():
    truth = np.zeros((60, 2), np.float32)
    truth[[15, 30], [0, 1]] = 50
    signal = deconvolve.convolve_pulse(truth, GAUSS)
    for profile in (
        deconvolve.deconvolve_richardson_lucy(signal, GAUSS, np.full(2, 0.5, np.float32), 30),
        deconvolve.deconvolve_gold(signal, GAUSS, 100),
        deconvolve.deconvolve_wiener(signal, GAUSS, 1e-4),
    ):
        assert np.argmax(profile, axis=0).tolist() == [15, 30]
        for column, place in ((0, 15), (1, 30)):
            assert profile[place - 4 : place + 5, column].sum() == pytest.approx(50, rel=0.05)


def test_wiener_undoes_a_skewed_pulse_where_it_lies():
    truth = np.zeros((80, 1), np.float32)
    truth[40] = 50
    profile = deconvolve.deconvolve_wiener(deconvolve.convolve_pulse(truth, SKEWED), SKEWED, 1e-3)
    assert np.argmax(profile) == 40
    assert np.sum(np.arange(80) * profile[:, 0]) / profile.sum() == pytest.approx(40, abs=0.3)


@pytest.mark.parametrize("snr", [30, 100])
def test_richardson_lucy_separates_pairs_and_leaves_singles(snr):
    system = SystemPulse(2.0, noise=ReceiverNoise(baseline=5000.0, std=100.0))
    detect = STAGES["detect.richardson_lucy"].function
    block, noise, phase = record([(snr, 0)], 2.0, 1.0, 400)
    single = detect(block, noise, system)
    assert (single.count(400) == 1).mean() > 0.985
    first = single.take(np.append(True, np.diff(single.waveform) > 0))
    assert np.median(np.abs(first.time - 30 - phase)) < 0.1
    assert np.median(first.amplitude) == pytest.approx(100 * snr, rel=0.1)
    for distance, iterations in ((4.0, 16), (3.0, 60)):
        block, noise, _ = record([(snr, 0), (snr, distance)], 2.0, 1.0, 400)
        assert (detect(block, noise, system, iterations=iterations).count(400) == 2).mean() > 0.85


def test_times_are_in_ns_at_any_spacing():
    block, noise, _ = record([(100, 0)], 1.0, 0.0, 1, spacing=0.5)
    system = SystemPulse(1.0, noise=ReceiverNoise(baseline=5000.0, std=30.0))
    for name in ("wavelet", "richardson_lucy"):
        assert STAGES[f"detect.{name}"].function(block, noise, system).time == pytest.approx([15.0], abs=0.02)


CASES = [("wavelet", {}), ("wavelet", {"wavelet": "mexican_hat"}), ("richardson_lucy", {"reference": "gaussian"})]


@pytest.mark.parametrize(("name", "parameters"), CASES)
def test_amplitudes_are_those_of_the_echoes(name, parameters):
    """Of the samples, not of the coefficients, which are a third as high."""
    block, noise, _ = record([(100.0, 0.0)], 2.0, 1.0, 300)
    system = SystemPulse(2.0, noise=ReceiverNoise(std=FINE))
    found = STAGES[f"detect.{name}"].function(block, noise, system, **parameters)
    assert np.median(found.amplitude[found.amplitude > 30 * FINE]) / FINE == pytest.approx(100.0, rel=0.08)


@pytest.mark.parametrize("threshold", [3.5, 6.0])
@pytest.mark.parametrize(("name", "parameters"), CASES)
def test_thresholds_are_standard_deviations_of_what_is_searched(name, parameters, threshold):
    """Echoes without noise, in units of the noise that white noise leaves in the same filter."""
    pulse = np.exp(-0.5 * (np.arange(-40, 41) / 2.0) ** 2)[:, None]
    if name == "wavelet":
        how = (2.0, parameters.get("wavelet", "b3"), 0.0, 1.0)
        white = np.random.default_rng(0).standard_normal((4000, 20))
        spread = np.std(transform(white, *how)[0][100:-100])
        least = threshold * spread / transform(pulse, *how)[0].max()
    else:
        least = threshold / np.sqrt(np.sum(pulse**2))
    for factor, expected in ((0.88, 0), (1.12, 1)):
        block, noise, _ = record([(10.0 * factor * least, 0.0)], 2.0, 0.0, 1)
        noise = replace(noise, std=np.full(1, 10.0 * FINE, np.float32))
        system = SystemPulse(2.0, noise=ReceiverNoise(std=10.0 * FINE))
        found = STAGES[f"detect.{name}"].function(block, noise, system, threshold=threshold, **parameters)
        assert len(found) == expected, factor
