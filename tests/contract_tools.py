"""Waveforms and checks that every stage must pass: for the contract tests of stages and of methods."""

from dataclasses import fields, replace

import numpy as np
from given_echoes import FINE, fine_recording, known_noise, simulate_echoes
from published import PULSE_SIGMA as SIGMA

from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, ReceiverNoise, ReturnTable, SystemPulse, WaveformBlock
from wavebatch.stages.chain import STAGES
from wavebatch.tools.simulate import simulate_block

CORE = [field.name for field in fields(EchoTable) if field.name != "attributes"]


DTYPES = {"waveform": np.int32, "time": np.float64, "flags": np.uint16}


SYSTEMS = {
    "gaussian": SystemPulse(2.0, noise=ReceiverNoise(baseline=12.0, baseline_spread=0.4, std=1.0), saturation=255.0),
    "skewed": SystemPulse(2.0, noise=ReceiverNoise(baseline=12.0, std=1.0), kappa=0.1),
    "learned": SystemPulse(
        2.0,
        noise=ReceiverNoise(baseline=12.0, std=1.0),
        components=((1.0, 0.0, 2.0), (0.1, 5.0, 2.0), (-0.03, 10.0, 3.0)),
        skew=0.05,
    ),
    "noise grows": SystemPulse(2.0, noise=ReceiverNoise(baseline=12.0, std=1.0, gain=0.05)),
    "short": SystemPulse(0.6, noise=ReceiverNoise(baseline=12.0, std=0.3)),
    "long": SystemPulse(15.0, noise=ReceiverNoise(baseline=12.0, std=2.0)),
}


def gauss(s, amplitude, width):
    return amplitude * np.exp(-0.5 * ((np.arange(s) - 0.45 * s) / width) ** 2)


def waveforms(s):
    """Name -> raw counts (n, s): everything that a file may hold, those of one type in one block."""
    rng = np.random.default_rng(s)
    i = np.arange(s)
    noisy = 12 + gauss(s, 80, 2) + rng.standard_normal((6, s))
    hard = [
        noisy[:1],
        np.zeros((2, s)),
        np.full((2, s), 12),
        np.full((2, s), 255),
        12 + gauss(s, 900, 3),  # a flat top
        gauss(s, 9000, 0.2 * s + 1),  # all saturated but the ends
        np.where(i == np.array([[0], [s // 2], [s - 1]]), 200, 12),  # spikes
        np.stack([i, i[::-1]]),
        np.where(i < np.array([[s // 2], [s // 3]]), 12, 90),  # steps
        np.where((i + np.array([[0], [1]])) % 2, 255, 0),
        rng.integers(0, 256, (60, s)),
        12 + rng.standard_normal((60, s)),
    ]
    return {
        "none": np.zeros((0, s), np.uint8),
        "one": np.rint(noisy[:1]).astype(np.uint8),
        "bytes": np.clip(np.rint(np.concatenate([np.atleast_2d(part) for part in hard])), 0, 255).astype(np.uint8),
        "two bytes": np.concatenate([np.rint(40 * noisy), rng.integers(0, 65536, (20, s))]).astype(np.uint16),
        "four bytes": np.concatenate([np.rint(1000 * noisy), rng.integers(0, 2**32, (20, s))]).astype(np.uint32),
    }


def make_block(samples, returns=True):
    """A block with geometry, and with two returns per waveform."""
    n, s = samples.shape
    block = WaveformBlock.from_samples(samples)
    if not returns:
        return block
    waveform = np.repeat(np.arange(n, dtype=np.int32), 2)
    time = np.tile([0.45 * s, 0.8 * s], n)
    xyz = np.zeros((2 * n, 3)) + time[:, None]
    return replace(block, returns=ReturnTable(waveform, time, np.arange(2 * n), xyz))


def freeze(table):
    """The same table with every array read-only, so that a stage which writes into it fails."""
    arrays = {name: getattr(table, name).copy() for name in CORE}
    attributes = {name: values.copy() for name, values in table.attributes.items()}
    for array in (*arrays.values(), *attributes.values()):
        array.flags.writeable = False
    return EchoTable(**arrays, attributes=attributes)


def inputs(block, system):
    """Data arguments for a stage of every kind, all read-only: noise, candidates, echoes with every attribute."""
    noise = STAGES["noise.pooled"].function(block, system)
    noise = Noise(noise.baseline.copy(), noise.std.copy())
    noise.baseline.flags.writeable = noise.std.flags.writeable = False
    candidates = freeze(STAGES["detect.maximum"].function(block, noise, system))
    fitted = STAGES["decompose.gaussian"].function(block, noise, system, candidates)
    for stage in STAGES.values():
        if stage.kind == "attribute" and not stage.needs:
            fitted = stage.function(block, noise, system, fitted)
    return noise, candidates, freeze(fitted)


def check_echoes(table, block, system, fitted):
    n, s = block.samples.shape
    for name in CORE:
        values = getattr(table, name)
        assert values.dtype == DTYPES.get(name, np.float32), name
        assert values.shape == (len(table),), name
    if not len(table):
        return
    assert table.waveform.min() >= 0
    assert table.waveform.max() < n
    step = np.diff(table.waveform)
    assert (step >= 0).all()
    assert (np.diff(table.time)[step == 0] >= 0).all()
    names = ["time", "amplitude", "sigma"]
    if fitted:
        names += ["time_err", "amplitude_err", "sigma_err", "residual"]
    for name in names:
        assert np.isfinite(getattr(table, name)).all(), name
    assert (table.amplitude >= 0).all()
    assert (table.sigma >= np.float32(0.7 * system.sigma_ref * (1 - 1e-5))).all()
    assert table.time.min() >= -0.5 * table.sigma.max() - 1
    assert table.time.max() <= (s - 1) * block.spacing + 0.5 * table.sigma.max() + 1
    for name, values in table.attributes.items():
        assert values.shape[:1] == (len(table),), name


def assert_same(a, b):
    """Bit for bit."""
    if isinstance(a, Noise):
        np.testing.assert_array_equal(a.baseline, b.baseline)
        np.testing.assert_array_equal(a.std, b.std)
        return
    for name in CORE:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert list(a.attributes) == list(b.attributes)
    for name, values in a.attributes.items():
        np.testing.assert_array_equal(values, b.attributes[name], err_msg=name)


def scene_blocks():
    stiff, _ = simulate_block("stiff", 260, np.random.default_rng(1))
    mixed, _ = simulate_block("mixed", 301, np.random.default_rng(2))
    return {"mixed": mixed, "stiff": stiff}


def pieces(n, size):
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


def record(n, *echoes, std=1.0, seed=0, s=80):
    """Waveforms with echoes (amplitude in counts of noise 1, time), in steps of 0.01; the noise known."""
    recording = fine_recording(std, SIGMA, n_samples=s)
    time = np.stack([np.broadcast_to(time, n) for _, time in echoes] or [np.full(n, np.nan)], axis=1)
    amplitude = FINE * np.stack([np.broadcast_to(height, n) for height, _ in echoes] or [np.zeros(n)], axis=1)
    block, _ = simulate_echoes(recording, time, amplitude, SIGMA, np.random.default_rng(seed))
    return block, known_noise(recording, n, FINE)
