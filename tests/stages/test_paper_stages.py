"""Detectors and decomposers that reproduce what the papers compare with."""

import naive
import numpy as np
import pytest
from contract_tools import assert_same
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes
from published import PULSE_SIGMA as SIGMA

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.bounds import bound_time
from wavebatch.kernels.signal.filters import filter_antisymmetric, slope_taps
from wavebatch.kernels.signal.runs import find_runs, run_moments
from wavebatch.stages.chain import STAGES, Step
from wavebatch.stages.chain_file import parse_chain
from wavebatch.stages.decompose.models import rebuild_waveforms

SYSTEM = known_system(fine_recording(1.0, SIGMA))

DETECTORS = [
    ("detect.sustained_threshold", {}),
    ("detect.center_of_gravity", {}),
    ("detect.zero_crossing", {}),
    ("detect.zero_crossing", {"derivative": "second"}),
]


# Detectors.


def record(n, *echoes, std=1.0, seed=0, s=80):
    """Waveforms with echoes (amplitude in counts of noise 1, time), in steps of 0.01; the noise known."""
    recording = fine_recording(std, SIGMA, n_samples=s)
    time = np.stack([np.broadcast_to(time, n) for _, time in echoes] or [np.full(n, np.nan)], axis=1)
    amplitude = FINE * np.stack([np.broadcast_to(height, n) for height, _ in echoes] or [np.zeros(n)], axis=1)
    block, _ = simulate_echoes(recording, time, amplitude, SIGMA, np.random.default_rng(seed))
    return block, known_noise(recording, n, FINE)


def detect(name, block, noise, **parameters):
    return STAGES[f"detect.{name}"].function(block, noise, SYSTEM, **parameters)


@pytest.mark.parametrize(("name", "parameters"), DETECTORS)
def test_isolated_echoes_are_found_at_their_peak(name, parameters):
    time = np.linspace(30, 42, 200)
    for amplitude in (15, 60, 240):
        block, noise = record(200, (amplitude, time), std=0.0)
        found = STAGES[name].function(block, noise, SYSTEM, **parameters)
        assert found.waveform.tolist() == list(range(200))
        np.testing.assert_allclose(found.time, time, atol=0.15)
        np.testing.assert_allclose(found.amplitude, 100 * amplitude, rtol=0.15)


def test_pairs_with_one_run_are_one_echo_for_levels_and_two_for_derivatives():
    block, noise = record(1, (60, [30.0]), (40, [37.0]), std=0.0)
    gravity, sustained = (detect(name, block, noise).time for name in ("center_of_gravity", "sustained_threshold"))
    assert len(gravity) == len(sustained) == 1
    assert gravity[0] == pytest.approx((60 * 30 + 40 * 37) / 100, abs=0.1)
    np.testing.assert_allclose(detect("zero_crossing", block, noise).time, [30, 37], atol=0.4)
    inflections = detect("zero_crossing", block, noise, derivative="second")
    np.testing.assert_allclose(inflections.time, [30, 37], atol=0.5)


def test_half_of_the_distance_of_the_inflections_is_the_width():
    block, noise = record(20, (200, np.linspace(39, 41, 20)), std=0.0)
    np.testing.assert_allclose(detect("zero_crossing", block, noise, derivative="second").sigma, SIGMA, rtol=0.03)


@pytest.mark.parametrize(
    ("ratio", "published"), [(2, 0), (3, 0.001), (4, 0.054), (5, 0.332), (6, 0.699), (7, 0.895), (8, 0.979)]
)
def test_detection_probabilities_of_the_paper(ratio, published):
    """T8: 3 standard deviations over 5 samples in a row."""
    n = 3000
    time = 40 + np.random.default_rng(ratio).uniform(-0.5, 0.5, n)
    block, noise = record(n, (ratio, time), seed=10 + ratio)
    found = detect("sustained_threshold", block, noise)
    near = np.abs(found.time - time[found.waveform]) < 4
    assert np.bincount(found.waveform[near], minlength=n).astype(bool).mean() == pytest.approx(published, abs=0.045)


def test_noise_never_lasts_as_long_as_a_pulse():
    block, noise = record(5000, seed=5, s=200)
    assert len(detect("sustained_threshold", block, noise)) == 0


def test_a_pulse_of_twenty_samples_per_ns_must_last_a_hundred_samples():
    s, spacing = 400, 0.05
    y = np.zeros((2, s))
    y[0, 100:199] = y[1, 100:200] = 5
    block = WaveformBlock.from_samples(np.rint(500 + 100 * y).astype(np.uint16), spacing=spacing)
    noise = Noise(np.full(2, 500, np.float32), np.full(2, 100, np.float32))
    assert detect("sustained_threshold", block, noise).waveform.tolist() == [1]


def test_moments_of_runs_equal_those_of_a_loop():
    signal = np.random.default_rng(17).integers(-1, 5, (17, 80)).astype(np.float32)
    level = np.random.default_rng(2).integers(-2, 4, 80).astype(np.float32)
    mean, spread = run_moments(signal, *find_runs(signal, level))
    expected = naive.find_runs(signal, level)
    assert len(mean) == len(expected) > 10
    for row, (w, a, b) in enumerate(expected):
        y, x = np.maximum(signal[a:b, w], 0), np.arange(a, b)
        middle = np.average(x, weights=y) if y.any() else (a + b - 1) / 2
        assert mean[row] == pytest.approx(middle, abs=1e-9)
        variance = np.average((x - middle) ** 2, weights=y) if y.any() else 0
        assert spread[row] ** 2 == pytest.approx(variance, abs=1e-9)


@pytest.mark.parametrize("s", [1, 4, 50])
def test_antisymmetric_filters_equal_a_double_loop(s):
    signal = np.random.default_rng(4).standard_normal((s, 5)).astype(np.float32)
    taps = slope_taps(1.2)
    expected = np.stack([naive.correlate_antisymmetric(column, taps) for column in signal.T], axis=1)
    np.testing.assert_allclose(filter_antisymmetric(signal, taps), expected, atol=1e-5)


def test_slopes_of_straight_lines_are_exact():
    line = np.linspace(0, 30, 31, dtype=np.float32)[:, None] * 3
    taps = slope_taps(1.2)
    reach = len(taps)
    slopes = filter_antisymmetric(line, taps)
    np.testing.assert_allclose(slopes[reach:-reach], 3, rtol=1e-5)


# Decomposers.


def test_mixed_fits_only_where_detectors_disagree():
    recording = fine_recording(1.0, 2.0, n_samples=64)
    system, rng = known_system(recording), np.random.default_rng(2)
    phase = rng.uniform(-0.5, 0.5, (60, 1))
    one, _ = simulate_echoes(recording, 20 + phase, 60 * FINE, 2.0, rng)
    two, _ = simulate_echoes(recording, np.array([20, 26.0]) + phase, FINE * np.array([100.0, 60.0]), 2.0, rng)
    block = WaveformBlock.from_samples(np.concatenate([one.samples, two.samples]))
    noise = known_noise(recording, 120)
    quick, fitted = (
        STAGES[decomposer].function(block, noise, system, STAGES[detector].function(block, noise, system))
        for decomposer, detector in (("decompose.asdf_only", "detect.asdf"), ("decompose.gaussian", "detect.maximum"))
    )
    given = STAGES["detect.asdf"].function(block, noise, system)
    mixed = STAGES["decompose.asdf_mixed"].function(block, noise, system, given)
    taken = np.zeros(2, int)
    for w in range(120):
        row = [table.take(np.flatnonzero(table.waveform == w)) for table in (mixed, quick, fitted)]
        source = 1 if np.array_equal(row[0].time, row[1].time) else 2
        assert_same(row[0], row[source])
        taken[source - 1] += 1
    assert taken.min() > 30
    with pytest.raises(ConfigError, match="decompose.none"):
        parse_chain(chain_text("asdf_mixed"), "c")


def chain_text(decomposer, *lines):
    names = ("noise.pooled", "detect.maximum", f"decompose.{decomposer}")
    return "\n".join([*(f'[[chain]]\nstage = "{name}"' for name in names), *lines, ""])


@pytest.mark.parametrize(("millimetres", "ratio", "metres"), [
    (2.10, 20.4, 0.216), (3.49, 12.0, 0.207), (1.46, 30.6, 0.236), (2.07, 21.4, 0.232)])  # fmt: skip
def test_gauss_newton_reaches_the_bound_at_fifty_picoseconds(millimetres, ratio, metres):
    """T8: the pulses of Jutzi and Stilla's table 1; standard deviations of range and sigma over the bound."""
    n, spacing, sigma = 300, 0.05, metres / HALF_C
    recording = fine_recording(1.0, sigma, n_samples=320, spacing=spacing)
    rng = np.random.default_rng(int(100 * ratio))
    time = 8 + rng.uniform(-0.025, 0.025, (n, 1))
    block, _ = simulate_echoes(recording, time, ratio * FINE, sigma, rng)
    start = EchoTable.build(np.arange(n), time[:, 0] + 0.3, np.full(n, 0.9 * ratio * FINE), np.full(n, 1.2 * sigma))
    found = STAGES["decompose.gauss_newton"].function(block, known_noise(recording, n), SystemPulse(sigma), start)
    assert found.waveform.tolist() == list(range(n))
    assert not (found.flags & EchoFlag.NOT_CONVERGED).any()
    bound = 1000 * HALF_C * float(bound_time(np.array(ratio), np.array(sigma), 1.0, spacing))
    assert bound == pytest.approx(millimetres, rel=0.005)
    for name, values in (("time", found.time - time[:, 0]), ("sigma", found.sigma - sigma)):
        assert 1000 * HALF_C * np.std(values) / bound == pytest.approx(1, abs=0.13)
        assert np.std(values / getattr(found, f"{name}_err")) == pytest.approx(1, abs=0.13)


@pytest.mark.parametrize(("off", "least", "most"), [(0.5, 1, 1), (1.0, 1, 1), (2.0, 0, 0)])
@pytest.mark.parametrize("width", [0.8, 2.0, 3.0])
def test_basin_of_undamped_steps(off, width, least, most):
    """s = 2, SNR 100: from up to one sigma off every fit converges, from two none (docs/algorithms.md 1.3)."""
    n, recording = 100, fine_recording(1.0, 2.0, n_samples=60)
    block, _ = simulate_echoes(recording, np.full((n, 1), 30.0), 100 * FINE, 2.0, np.random.default_rng(3))
    start = EchoTable.build(np.arange(n), np.full(n, 30 + 2 * off), np.full(n, 100 * FINE), np.full(n, width))
    system = known_system(recording)
    found = STAGES["decompose.gauss_newton"].function(block, known_noise(recording, n), system, start)
    right = ((found.flags & EchoFlag.NOT_CONVERGED) == 0) & (np.abs(found.time - 30) < 0.2)
    assert least <= right.sum() / n <= most


def test_lost_fits_give_their_start_back_with_a_flag():
    block, noise = record(1, (100, [30.0]), std=0.0, s=60)
    start = EchoTable.build(np.zeros(1), np.array([35.0]), np.array([100 * FINE]), np.array([SIGMA]))
    found = STAGES["decompose.gauss_newton"].function(block, noise, SYSTEM, start)
    assert found.time.tolist() == [35.0]
    assert (found.flags & EchoFlag.NOT_CONVERGED).all()


@pytest.mark.parametrize(("origin", "low", "high"), [("segment", 0.1, 0.4), ("waveform", 0.05, 0.09)])
def test_the_printed_formula_has_the_skew_of_its_origin(origin, low, high):
    """The width over the distance of the peak from the origin, whatever the pulse is."""
    rng, n = np.random.default_rng(7), 200
    recording = fine_recording(1.0, 2.4, n_samples=80)
    block, _ = simulate_echoes(recording, 36 + rng.uniform(-0.5, 0.5, (n, 1)), 150 * FINE, 2.4, rng)
    system = known_system(recording)
    chain = parse_chain(chain_text("log_normal", f'origin = "{origin}"', "[[chain]]", 'stage = "attribute.skew"'), "c")
    found = chain.run(block, system)
    skew = found.attributes["skew"]
    assert low < np.median(skew) < high
    if origin == "waveform":
        np.testing.assert_allclose(skew, found.sigma / (found.time + 1.0), rtol=1e-4)
    for refused in ("pulse_deviation", "incidence_angle"):
        with pytest.raises(ConfigError, match="fits another shape|skew per echo"):
            parse_chain(chain_text("log_normal", "[[chain]]", 'stage = "attribute.position"', "[[chain]]",
                                   f'stage = "attribute.{refused}"'), "c")  # fmt: skip


@pytest.mark.parametrize("name", ["gauss_newton", "log_normal", "asdf_mixed"])
def test_what_was_fitted_is_drawn(name):
    block, noise = record(20, (150, np.linspace(30, 31, 20)))
    detector = "detect.asdf" if name == "asdf_mixed" else "detect.maximum"
    given = STAGES[detector].function(block, noise, SYSTEM)
    step = Step(STAGES[f"decompose.{name}"])
    found = step.stage.function(block, noise, SYSTEM, given)
    left = block.samples - noise.level - rebuild_waveforms(block, SYSTEM, step, found)
    assert np.abs(left).max() < (20 if name == "log_normal" else 8) * FINE
