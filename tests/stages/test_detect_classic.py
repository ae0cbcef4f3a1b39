"""Classic detectors: isolated echoes, and detection probabilities (docs/algorithms.md 1.3)."""

import numpy as np
import pytest
from published import PULSE_SIGMA as SIGMA

from wavebatch.core.waveforms import Noise, WaveformBlock
from wavebatch.stages.chain import STAGES
from wavebatch.tools.simulate import FINE, fine_recording, known_noise, known_system, simulate_echoes

SYSTEM = known_system(fine_recording(1.0, SIGMA))


def record(n, *echoes, std=1.0, seed=0, s=80):
    """Waveforms with echoes (amplitude in counts of noise 1, time), in steps of 0.01; the noise known."""
    recording = fine_recording(std, SIGMA, n_samples=s)
    time = np.stack([np.broadcast_to(time, n) for _, time in echoes] or [np.full(n, np.nan)], axis=1)
    amplitude = FINE * np.stack([np.broadcast_to(height, n) for height, _ in echoes] or [np.zeros(n)], axis=1)
    block, _ = simulate_echoes(recording, time, amplitude, SIGMA, np.random.default_rng(seed))
    return block, known_noise(recording, n, FINE)


def detect(name, block, noise, **parameters):
    return STAGES[f"detect.{name}"].function(block, noise, SYSTEM, **parameters)


METHODS = [
    ("threshold", {}),
    ("sustained_threshold", {}),
    ("center_of_gravity", {}),
    ("constant_fraction", {}),
    ("zero_crossing", {}),
    ("zero_crossing", {"derivative": "second"}),
]


@pytest.mark.parametrize(("name", "parameters"), METHODS)
def test_isolated_echoes_are_found_at_their_peak(name, parameters):
    time = np.linspace(30, 42, 200)
    for amplitude in (15, 60, 240):
        block, noise = record(200, (amplitude, time), std=0.0)
        found = detect(name, block, noise, **parameters)
        assert found.waveform.tolist() == list(range(200))
        np.testing.assert_allclose(found.time, time, atol=0.15)
        np.testing.assert_allclose(found.amplitude, 100 * amplitude, rtol=0.15)


def test_the_edge_itself_walks_with_the_amplitude():
    block, noise = record(2, ([20.0, 200.0], 40.0), std=0.0)
    edge = detect("threshold", block, noise, correct_walk=False).time
    wide = np.sqrt(SIGMA**2 + 0.5)
    trigger = 4 * np.sqrt(6) / 4 / (np.array([20, 200]) * SIGMA / wide)
    np.testing.assert_allclose(edge, 40 - wide * np.sqrt(-2 * np.log(trigger)), atol=0.13)


def test_pairs_with_one_run_are_one_echo_for_levels_and_two_for_derivatives():
    block, noise = record(1, (60, [30.0]), (40, [37.0]), std=0.0)
    times = {name: detect(name, block, noise, **p).time for name, p in METHODS if not p}
    assert len(times["center_of_gravity"]) == len(times["threshold"]) == len(times["sustained_threshold"]) == 1
    assert times["center_of_gravity"][0] == pytest.approx((60 * 30 + 40 * 37) / 100, abs=0.1)
    np.testing.assert_allclose(times["zero_crossing"], [30, 37], atol=0.4)
    inflections = detect("zero_crossing", block, noise, derivative="second")
    np.testing.assert_allclose(inflections.time, [30, 37], atol=0.5)


def test_half_of_the_distance_of_the_inflections_is_the_width():
    block, noise = record(20, (200, np.linspace(39, 41, 20)), std=0.0)
    np.testing.assert_allclose(detect("zero_crossing", block, noise, derivative="second").sigma, SIGMA, rtol=0.03)


@pytest.mark.parametrize("fraction", [0.0, 1.0])
def test_a_fraction_must_be_one(fraction):
    block, noise = record(1, (20, [40.0]))
    with pytest.raises(ValueError, match="between 0 and 1"):
        detect("constant_fraction", block, noise, fraction=fraction)


@pytest.mark.parametrize(
    ("ratio", "sustained", "matched"),
    [(2, 0, 0.395), (3, 0.001, 0.95), (4, 0.054, 1), (5, 0.332, 1), (6, 0.699, 1), (7, 0.895, 1), (8, 0.979, 1)],
)
def test_detection_probabilities_of_the_paper(ratio, sustained, matched):
    """T8: 3 standard deviations over 5 samples in a row, and the matched filter at 0.1 % false alarms."""
    n = 3000
    time = 40 + np.random.default_rng(ratio).uniform(-0.5, 0.5, n)
    block, noise = record(n, (ratio, time), seed=10 + ratio)
    for name, published in (("sustained_threshold", sustained), ("matched_filter", matched)):
        found = detect(name, block, noise)
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
