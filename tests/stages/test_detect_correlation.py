"""Correlation and average square differences: test vectors and tables of docs/algorithms.md 1.1 (T6)."""

import naive
import numpy as np
import pytest
from commands import refuses
from given_echoes import known_noise, known_system
from published import WAGNER

from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import fit_one_gaussian
from wavebatch.kernels.signal import filters
from wavebatch.stages.chain import STAGES
from wavebatch.stages.detect.transformed import parabola_shift
from wavebatch.stages.pulse_tables import reference_pulse
from wavebatch.stages.score import match_echoes
from wavebatch.tools.simulate import simulate_block

SYSTEM = SystemPulse(2.0, noise=ReceiverNoise(baseline=500.0, std=100.0))
UNIT = 100.0
"""Counts per unit of noise, so that rounding does not matter."""


def gauss(s, *echoes):
    return sum(a * np.exp(-0.5 * ((np.arange(s) - t) / width) ** 2) for a, t, width in echoes)


def record(y):
    """Waveforms (n, s) in units of their noise as a block; the noise known."""
    y = np.atleast_2d(y)
    block = WaveformBlock.from_samples(np.rint(500 + UNIT * np.maximum(y, -5)).astype(np.uint16))
    return block, Noise(np.full(len(y), 500, np.float32), np.full(len(y), UNIT, np.float32))


def detect(name, y, system=SYSTEM, **parameters):
    return STAGES[f"detect.{name}"].function(*record(y), system, **parameters)


def test_square_differences_of_the_test_vector():
    signal = np.array([[0, 0, 0, 0, 1, 2, 1, 0, 0, 0, 0]], np.float32).T
    difference, _ = filters.square_differences(signal, np.array([0, 0.5, 1, 0.5, 0]), np.array([2], np.float32))
    assert difference[:, 0].tolist() == [6, 6, 6, 6, 7, 9, 4, 0, 4, 9, 7, 6, 6, 6, 6]
    assert np.argmin(difference) - 4 == 3


def test_parabola_of_the_test_vector():
    assert parabola_shift(*np.array([[4.0], [1.0], [2.0]]))[0] == 0.25
    assert parabola_shift(*np.array([[2.0], [2.0], [2.0]]))[0] == np.inf


def test_minima_of_the_test_vector():
    """Two echoes, three side minima where the window's end crosses one; 0.3 of the range removes those."""
    signal = gauss(64, (80, 20.4, 2), (50, 40.25, 2))[:, None]
    taps = np.exp(-0.5 * (np.arange(-8, 9) / 2) ** 2)
    difference, _ = filters.square_differences(signal, taps, np.array([80.0]))
    values = np.ascontiguousarray(difference.T)
    minima = filters.find_minima(values)
    row = minima.row
    shift = parabola_shift(*(values[0, row + d] for d in (-1, 0, 1)))
    np.testing.assert_allclose(row - 8 + shift, [4.521, 20.395, 31.116, 40.244, 56.116], atol=6e-4)
    least = 0.3 * np.ptp(difference, axis=0)
    assert least[0] == pytest.approx(12005.1, abs=0.05)
    assert difference.max() == pytest.approx(40468.5, abs=0.05)
    np.testing.assert_array_equal(row[filters.keep_prominent(minima, least)] - 8, [20, 40])


@pytest.mark.parametrize("s", [1, 3, 30])
@pytest.mark.parametrize("taps", [np.array([1.0]), np.array([0.2, 1, 0.2]), np.array([0.1, 1, 0.7, 0.3, 0.0])])
def test_square_differences_equal_the_definition(s, taps):
    rng = np.random.default_rng(s)
    signal, height = rng.uniform(-1, 5, (s, 6)), rng.uniform(0, 5, 6)
    expected = np.stack([naive.square_differences(signal[:, w], height[w] * taps) for w in range(6)], axis=1)
    for kind, error in ((np.float64, 1e-11), (np.float32, 2e-3)):
        found, correlation = filters.square_differences(signal.astype(kind), taps, height.astype(kind))
        np.testing.assert_allclose(found, expected, atol=error)
        plain = np.stack([np.correlate(column, taps, "full") for column in signal.T], axis=1)
        np.testing.assert_allclose(correlation, plain, atol=error)


def test_sums_of_slid_windows():
    padded = filters.pad_samples(np.arange(12, dtype=np.float64).reshape(4, 3), 1)
    assert filters.slide_taps(padded, np.array([1.0, 10, 100]))[0].tolist() == [300, 410, 520]
    assert filters.slide_energy(padded, 3)[:, 0].tolist() == [9, 45, 126, 117]


@pytest.mark.parametrize("top", [3, 8, 1000])
def test_prominent_minima_equal_those_of_removal_one_by_one(top):
    rng = np.random.default_rng(top)
    values = rng.integers(0, top, (300, 60)).astype(np.float32)
    values[:5] = 1
    least = rng.uniform(0, top, 300).astype(np.float32)
    minima = filters.find_minima(values)
    rows = filters.keep_prominent(minima.take(np.arange(len(minima.row))), least)
    kept = list(zip(minima.waveform[rows].tolist(), minima.row[rows].tolist(), strict=True))
    expected = []
    for w in range(300):
        listed = naive.find_minima(values[w].tolist())
        assert minima.row[minima.waveform == w].tolist() == listed
        expected += [(w, i) for i in naive.keep_prominent(values[w].tolist(), listed, least[w])]
    assert kept == expected


@pytest.mark.parametrize("name", ["correlation", "asdf"])
def test_isolated_gaussians_are_timed_exactly(name):
    time = np.linspace(30, 32, 21)
    found = detect(name, np.stack([gauss(80, (200, t, 2)) for t in time]))
    np.testing.assert_allclose(found.time, time, atol=2e-3)
    np.testing.assert_allclose(found.amplitude, 200 * UNIT, rtol=0.02)


def test_the_paper_parabola_has_its_bias():
    time = np.linspace(30, 31, 101)
    for sigma, bias in ((1.0, 0.0242), (1.5, 0.0107), (2.0, 0.0060), (3.0, 0.0027)):
        y = np.stack([gauss(80, (200, t, sigma)) for t in time])
        found = detect("asdf", y, SystemPulse(sigma), rule="paper", interpolation="parabola")
        assert np.abs(found.time - time).max() == pytest.approx(bias, rel=0.05)


@pytest.mark.parametrize(("ratio", "number"), [(0.28, 1), (0.30, 2)])
def test_the_paper_rule_loses_echoes_below_thirty_percent(ratio, number):
    y = gauss(120, (200, 40, 2), (200 * ratio, 80, 2))
    assert len(detect("asdf", y, rule="paper")) == number
    assert len(detect("asdf", y)) == 2


@pytest.mark.parametrize(("fraction", "apart"), [(0.3, 3.58), (0.2, 3.43), (0.1, 3.24), (0.05, 3.14)])
def test_resolution_of_the_paper_rule(fraction, apart):
    """Least distance of equal echoes that are two, in sigma; mean over the phases of the samples is the published."""
    least = []
    for phase in np.linspace(0, 1, 5)[:-1]:
        for distance in np.arange(2.8, 4.2, 0.02):
            y = gauss(120, (200, 50 + phase, 2), (200, 50 + phase + 2 * distance, 2))
            if len(detect("asdf", y, rule="paper", fraction=fraction)) == 2:
                least.append(distance)
                break
    assert np.mean(least) == pytest.approx(apart, abs=0.12)


def test_noise_has_echoes_by_the_paper_rule_only():
    y = np.random.default_rng(1).standard_normal((300, 80))
    assert detect("asdf", y, rule="paper").count(300).mean() > 0.9
    assert len(detect("asdf", y)) < 3
    assert len(detect("correlation", y)) < 3


def test_a_reference_carries_its_own_datum():
    """The time of a skewed pulse is that of its datum, of a given one that of its peak."""
    x = np.arange(80) - 40.3
    fine = np.arange(-10, 20, 0.01)
    unit = np.exp(-0.5 * (np.log1p(np.maximum(0.15 * fine / 2, -0.999)) / 0.15) ** 2)
    datum = 40.3 + fit_one_gaussian(fine, unit)[0]
    skewed = 200 * np.exp(-0.5 * (np.log1p(np.maximum(0.15 * x / 2, -0.999)) / 0.15) ** 2)
    system = SystemPulse(2.0, kappa=0.15)
    for name in ("asdf", "correlation"):
        assert detect(name, skewed, system, reference="system").time[0] == pytest.approx(datum, abs=0.02)
    pulse = " ".join(f"{value:.5f}" for value in gauss(14, (7.0, 3.3, 2.0)))
    for name in ("asdf", "correlation"):
        found = detect(name, gauss(80, (200, 40.6, 2)), reference="given", pulse=pulse)
        assert found.time[0] == pytest.approx(40.6, abs=0.05)
        assert found.amplitude[0] == pytest.approx(200 * UNIT, rel=0.01)


def test_the_learned_pulse_is_a_reference_with_its_datum_in_the_middle():
    system = SystemPulse(2.0, components=((1.0, 0.0, 2.0), (0.3, 3.0, 2.0)))
    taps, peak = reference_pulse(system, 1.0, "system")
    assert len(taps) == 21
    assert peak == 10
    assert np.argmax(taps) == 10
    assert taps.max() == pytest.approx(1, abs=0.02)
    assert fit_one_gaussian(np.arange(21.0), taps)[0] == pytest.approx(10, abs=0.01)


@pytest.mark.parametrize("pulse", ["", "1 2", "1 x 3", "0 0 0", "nan 1 1"])
def test_what_is_no_pulse_is_refused(pulse):
    refuses(ConfigError, "pulse must", reference_pulse, SYSTEM, 1.0, "given", pulse=pulse)


def differences(a, b, n=4000):
    """Share of echoes of a and b that are the same within 1 ns, and the differences of those."""
    match = match_echoes(a, b, 1.0)
    return 2 * len(match.found) / (len(a) + len(b)), a.time[match.found] - b.time[match.truth]


def test_tables_of_wagner_et_al():
    """T6: Gaussian decomposition against ASDF; ASDF with a mean pulse against ASDF with a Gaussian."""
    block, _ = simulate_block(WAGNER, 4000, np.random.default_rng(11))
    noise, system = known_noise(WAGNER.recording, len(block)), known_system(WAGNER.recording)
    paper = {"rule": "paper", "interpolation": "parabola"}
    asdf = STAGES["detect.asdf"].function(block, noise, system, **paper)
    maxima = STAGES["detect.maximum"].function(block, noise, system)
    fitted = STAGES["decompose.gaussian"].function(block, noise, system, maxima)
    identical, difference = differences(fitted, asdf)
    assert identical >= 0.80
    assert abs(np.median(difference)) < 0.002
    assert 0.10 < np.sqrt(np.mean(difference**2)) < 0.16
    wider = np.exp(-0.5 * (np.arange(-10, 11) / 2.1) ** 2)
    mean = STAGES["detect.asdf"].function(
        block, noise, system, reference="given", pulse=" ".join(map(str, wider)), **paper
    )
    identical, difference = differences(mean, asdf)
    assert identical >= 0.98
    assert np.sqrt(np.mean(difference**2)) < 0.05


@pytest.mark.parametrize("apart", [7.5, 8.0])
@pytest.mark.parametrize("threshold", [3.0, 4.0])
def test_the_absolute_rule_asks_for_the_depth_that_noise_in_the_correlation_makes(apart, threshold):
    """Two equal echoes: the wall between their minima rises with the square of the height, noise with the height."""
    taps = reference_pulse(SYSTEM, 1.0, "gaussian", 5.0).taps
    pair, edge = gauss(90, (1.0, 40.0, 2.0), (1.0, 40.0 + apart, 2.0)), np.zeros(len(taps))
    wave = np.concatenate([edge, pair, edge])
    height = wave.max()
    # The definition of R, sample by sample, for a waveform of height 1.
    depth = [np.sum((wave[t : t + len(taps)] - height * taps) ** 2) for t in range(len(wave) - len(taps))]
    low = [t for t in range(1, len(depth) - 1) if depth[t - 1] > depth[t] <= depth[t + 1]]
    first, second = sorted(sorted(low, key=lambda t: depth[t])[:2])
    wall = max(depth[first:second]) - max(depth[first], depth[second])
    # Noise of 1 moves the correlation by the root of the pulse's energy, and R by twice the height times that.
    least = 2.0 * threshold * np.sqrt(np.sum(taps**2)) * height / wall
    for factor, expected in ((0.85, 1), (1.15, 2)):
        amplitude = factor * least
        y = gauss(90, (amplitude, 40.0, 2.0), (amplitude, 40.0 + apart, 2.0))
        found = detect("asdf", y, threshold=threshold)
        assert len(found) == expected, (factor, found.time)
