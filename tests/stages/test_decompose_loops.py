"""Wang's residual loop and ASDF without a fit, on isolated echoes and close pairs."""

from dataclasses import fields

import numpy as np
import pytest

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, WaveformBlock
from wavebatch.kernels.fit import render
from wavebatch.kernels.fit.bounds import crlb
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.stages.chain import STAGES
from wavebatch.tools.simulate import Recording, known_noise, known_system, simulate_echoes

RECORDING = Recording(n_samples=64, bits=16, baseline=20.0, baseline_spread=0.0)
SYSTEM = known_system(RECORDING)
STD = RECORDING.recorded_noise


def record(n, *echoes, seed=1, width=2.0):
    """Waveforms of noise 1 with echoes (amplitude, time), rounded; the noise known; a phase per waveform."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(-0.5, 0.5, n)
    amplitude, time = np.array(echoes, float).T
    block, _ = simulate_echoes(RECORDING, time + phase[:, None], amplitude, width, rng)
    return block, known_noise(RECORDING, n), phase


def decompose(name, block, noise, **parameters):
    candidates = STAGES["detect.maximum"].function(block, noise, SYSTEM)
    return STAGES[f"decompose.{name}"].function(block, noise, SYSTEM, candidates, **parameters)


def assert_same(a, b):
    for field in fields(EchoTable):
        if field.name != "attributes":
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


def test_the_loop_finds_the_echo_that_the_maximum_hides():
    block, noise, phase = record(400, (100, 28), (60, 32))
    assert (decompose("gaussian", block, noise).count(400) == 1).mean() > 0.9
    found = decompose("residual_loop", block, noise)
    two = found.count(400) == 2
    assert two.mean() > 0.9
    pair = found.time[two[found.waveform]].reshape(-1, 2) - phase[two][:, None]
    np.testing.assert_allclose(np.median(pair, axis=0), [28, 32], atol=0.05)


def test_the_loop_leaves_what_is_explained_alone():
    block, noise, _ = record(400, (100, 30))
    found = decompose("residual_loop", block, noise)
    assert (found.count(400) == 1).mean() > 0.98
    assert_same(
        decompose("residual_loop", block, noise, t_diff=1e9), decompose("gaussian", block, noise, tolerance=0.1)
    )


def test_the_loop_stops_at_its_number_of_echoes():
    rng = np.random.default_rng(3)
    block = WaveformBlock.from_samples(rng.integers(0, 256, (50, 80)).astype(np.uint8))
    noise = Noise(np.full(50, 20, np.float32), np.ones(50, np.float32))
    for most in (1, 3):
        start = decompose("gaussian", block, noise, tolerance=0.1).count(50)
        number = decompose("residual_loop", block, noise, max_echoes=most).count(50)
        assert (number <= np.maximum(start, most) + 1).all()


@pytest.mark.parametrize(("width", "lost"), [(2.0, 1.0), (3.0, 1.13), (4.0, 1.4)])
def test_asdf_without_a_fit_is_near_the_bound_and_says_its_errors(width, lost):
    n = 3000
    block, noise, phase = record(n, (160, 30), width=width)
    found = decompose("asdf_only", block, noise)
    assert (found.count(n) == 1).mean() > 0.99
    found = found.take(found.count(n)[found.waveform] == 1)
    error = found.time - 30 - phase[found.waveform]
    bound = crlb(np.array(160.0), np.array(width), STD, 1.0)[0]
    assert np.sqrt(np.mean(error**2)) / bound == pytest.approx(lost, rel=0.08)
    assert np.std(error / found.time_err) == pytest.approx(1.0, abs=0.1)
    assert np.std((found.amplitude - 160) / found.amplitude_err) == pytest.approx(1.0, abs=0.1)
    assert np.std((found.sigma - width) / found.sigma_err) == pytest.approx(1.0, abs=0.15)
    assert np.median(found.amplitude) == pytest.approx(160, rel=0.01)
    assert np.median(found.sigma) == pytest.approx(width, rel=0.02)
    # What five samples make of a broad echo misses it by more than noise does.
    assert 0.8 < np.median(found.residual) < (1.1 if width == 2 else 1.4)


def test_mixed_fits_only_where_detectors_disagree():
    parts = [record(60, (60, 20), seed=2), record(60, (100, 20), (60, 26.0), seed=3)]
    block = WaveformBlock.from_samples(np.concatenate([part[0].samples for part in parts]))
    noise = Noise(np.full(120, 20, np.float32), np.full(120, STD, np.float32))
    quick, fitted = decompose("asdf_only", block, noise), decompose("gaussian", block, noise)
    mixed = decompose("asdf_only", block, noise, mode="mixed")
    taken = np.zeros(2, int)
    for w in range(120):
        row = [table.take(np.flatnonzero(table.waveform == w)) for table in (mixed, quick, fitted)]
        source = 1 if np.array_equal(row[0].time, row[1].time) else 2
        assert_same(row[0], row[source])
        taken[source - 1] += 1
    assert taken.min() > 30


def test_rendered_echoes_do_not_depend_on_their_parts(monkeypatch):
    rng = np.random.default_rng(4)
    waveform = np.sort(rng.integers(0, 12, 60)).astype(np.int32)
    columns = (rng.uniform(0, 30, 60), rng.uniform(5, 200, 60), rng.uniform(1, 4, 60))
    whole = render.render_echoes(GAUSSIAN, 12, 40, waveform, *columns)
    for rows in (1, 3, 7, 60):
        monkeypatch.setattr(render, "ROWS", rows)
        np.testing.assert_array_equal(render.render_echoes(GAUSSIAN, 12, 40, waveform, *columns), whole)
