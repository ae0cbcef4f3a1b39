"""Waveforms with echoes that are given: samples, truth, noise as it is."""

import numpy as np
import pytest
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes

from wavebatch.core.echoes import EchoFlag
from wavebatch.tools.simulate import Recording


def test_waveforms_hold_the_echoes_that_are_given(rng):
    recording = fine_recording(0.0, 2.0, n_samples=60, spacing=0.5)
    time = np.array([[20.3, 9.0], [15.0, np.nan], [np.nan, np.nan]])
    amplitude = FINE * np.array([50.0, 20.0])
    block, truth = simulate_echoes(recording, time, amplitude, np.array([[2.0, 3.0]]), rng)
    x = np.arange(60) * 0.5
    expected = np.full((3, 60), 5000.0)
    expected[0] += 5000 * np.exp(-0.5 * ((x - 20.3) / 2) ** 2) + 2000 * np.exp(-0.5 * ((x - 9) / 3) ** 2)
    expected[1] += 5000 * np.exp(-0.5 * ((x - 15) / 2) ** 2)
    np.testing.assert_allclose(block.samples, expected, atol=0.6)
    assert block.spacing == 0.5
    assert truth.waveform.tolist() == [0, 0, 1]
    assert truth.time == pytest.approx([9.0, 20.3, 15.0])
    assert truth.amplitude.tolist() == [2000, 5000, 5000]
    assert truth.sigma.tolist() == [3, 2, 2]
    assert not (truth.flags & EchoFlag.SATURATED).any()


def test_noise_and_system_are_those_of_the_receiver(rng):
    recording = Recording(noise_std=1.5, baseline_spread=0.0, baseline=20.0, n_samples=200)
    block, truth = simulate_echoes(recording, np.full((300, 1), np.nan), 0.0, 2.0, rng)
    noise, system = known_noise(recording, 300), known_system(recording)
    assert len(truth) == 0
    assert np.std(block.samples) == pytest.approx(noise.std[0], rel=0.01)
    assert np.mean(block.samples) == pytest.approx(noise.baseline[0], abs=0.02)
    assert (system.sigma_ref, system.noise.baseline) == (2.0, 20.0)
    assert system.noise.std == pytest.approx(np.hypot(1.5, np.sqrt(1 / 12)))
    assert known_noise(recording, 2, least=9.0).std.tolist() == [9, 9]
