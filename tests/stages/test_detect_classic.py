"""Classic detectors: isolated echoes, and detection probabilities (docs/algorithms.md 1.3)."""

import numpy as np
import pytest
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes
from published import PULSE_SIGMA as SIGMA

from wavebatch.stages.chain import STAGES

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
    ("constant_fraction", {}),
]


@pytest.mark.parametrize(("name", "parameters"), METHODS)
def test_isolated_echoes_are_found_at_their_peak(name, parameters):
    time = np.linspace(30, 42, 200)
    for amplitude in (15, 60, 240):
        block, noise = record(200, (amplitude, time), std=0.0)
        found = detect(name, block, noise, **parameters)
        assert found.waveform.tolist() == list(range(200))
        np.testing.assert_allclose(found.time, time, atol=0.08)
        assert abs(np.mean(found.time - time)) < 0.02, "early by .1 sample where the flank counts as straight"
        np.testing.assert_allclose(found.amplitude, 100 * amplitude, rtol=0.15)


def test_the_edge_itself_walks_with_the_amplitude():
    block, noise = record(2, ([20.0, 200.0], 40.0), std=0.0)
    edge = detect("threshold", block, noise, correct_walk=False).time
    wide = np.sqrt(SIGMA**2 + 0.5)
    trigger = 4 * np.sqrt(6) / 4 / (np.array([20, 200]) * SIGMA / wide)
    np.testing.assert_allclose(edge, 40 - wide * np.sqrt(-2 * np.log(trigger)), atol=0.13)


@pytest.mark.parametrize("fraction", [0.0, 1.0])
def test_a_fraction_must_be_one(fraction):
    block, noise = record(1, (20, [40.0]))
    with pytest.raises(ValueError, match="between 0 and 1"):
        detect("constant_fraction", block, noise, fraction=fraction)


@pytest.mark.parametrize(("ratio", "published"), [(2, 0.395), (3, 0.95), (4, 1), (5, 1), (6, 1), (7, 1), (8, 1)])
def test_detection_probabilities_of_the_paper(ratio, published):
    """T8: the matched filter at 0.1 % false alarms."""
    n = 3000
    time = 40 + np.random.default_rng(ratio).uniform(-0.5, 0.5, n)
    block, noise = record(n, (ratio, time), seed=10 + ratio)
    found = detect("matched_filter", block, noise)
    near = np.abs(found.time - time[found.waveform]) < 4
    assert np.bincount(found.waveform[near], minlength=n).astype(bool).mean() == pytest.approx(published, abs=0.045)
