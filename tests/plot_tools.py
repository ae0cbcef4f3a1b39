"""What the tests of pictures share: simulated waveforms, chains and clouds of any columns."""

import numpy as np
from writer_tools import write_points

from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.stages.chain import STAGES, Chain, Step

PULSE = SystemPulse(sigma_ref=2.0, noise=ReceiverNoise(baseline=12.0, std=1.0))
POINTS = 5000


def simulate(shape, echoes, *, n=20, s=80, seed=1, top=255):
    """A block of n waveforms of the echoes (amplitude, time, width), noise 1, baseline 12."""
    rng = np.random.default_rng(seed)
    x = np.arange(float(s))
    signal = sum(a * evaluate_pulse(shape, x - 0.0, np.array([t]), np.array([w]))[0] for a, t, w in echoes)
    counts = np.clip(np.rint(12 + signal + rng.normal(0, 1, (n, s))), 0, top)
    return WaveformBlock.from_samples(counts.astype(np.uint8), bits=8)


def make_chain(decomposer, **parameters):
    attributes = [STAGES[f"attribute.{name}"] for name in ("amplitude", "echo_width")]
    detector = "detect.asdf" if decomposer.startswith("decompose.asdf") else "detect.maximum"
    steps = [Step(STAGES["noise.pooled"]), Step(STAGES[detector]), Step(STAGES[decomposer], parameters)]
    return Chain((*steps, *map(Step, attributes)), "test")


def write_cloud(path, *, seed=1, n=POINTS, point_format=6, **columns):
    """A cloud of n points over 40 m x 25 m with the given extra columns: (values, no-data, scale) each."""
    rng = np.random.default_rng(seed)
    xyz = np.stack([500_000 + rng.uniform(0, 40, n), 5_400_000 + rng.uniform(0, 25, n), rng.normal(100, 5, n)], axis=1)
    fields = {"intensity": rng.integers(0, 3000, n), "return_number": rng.integers(1, 4, n)}
    if point_format >= 6:
        fields["scan_angle"] = rng.integers(-3000, 3000, n)
    write_points(path, xyz, point_format=point_format, offsets=(500_000.0, 5_400_000.0, 0.0),
                 extra=[(name, stored.dtype, *how) for name, (stored, *how) in columns.items()],
                 raw=[(name, stored) for name, (stored, *_) in columns.items()], **fields)  # fmt: skip
    return path
