"""Strips of at most 1 MB that ask for much work, and commands run on them under limits of memory and processor time.

`draw_plan` is the only source of chance and takes plain numbers from a `random.Random` (hypothesis has one:
`st.randoms`). More seeds of `tests/test_heavy_strips.py` are more strips.
"""

from __future__ import annotations

import os
import random
import re
import resource
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
from strips import Raw, descriptor, make_raw

MOST_BYTES = 1_000_000
MOST_SAMPLES = 65_535
MEMORY, SECONDS = 2 << 30, 20
"""Address space and processor time of a command, with Python and NumPy."""

SHAPES = {
    "spikes": lambda rng, n, s, top: np.where(np.arange(s) % rng.integers(2, 9) == 0, top, top // 20),
    "dense": lambda rng, n, s, top: rng.integers(0, top // 2 + 1, (n, s)),
    "random": lambda rng, n, s, top: rng.integers(0, top, (n, s), endpoint=True),
    "sparse": lambda rng, n, s, top: np.where(rng.random((n, s)) < 0.01, top, rng.poisson(12, (n, s))),
    "saturated": lambda rng, n, s, top: np.where(rng.random((n, s // 9 + 1)).repeat(9, axis=1)[:, :s] < 0.3, top, 10),
    "constant": lambda rng, n, s, top: rng.integers(0, top, (n, 1), endpoint=True),
    "ramp": lambda rng, n, s, top: np.linspace(0, top, s) * rng.choice([1, -1]) % (top + 1.0),
    "stairs": lambda rng, n, s, top: (np.arange(s) // rng.integers(1, 300) * max(top // 97, 1)) % (top + 1),
    "zeros": lambda rng, n, s, top: np.where(rng.random((n, s)) < 0.001, rng.integers(0, top), 0),
    "not numbers": lambda rng, n, s, top: np.where(rng.random((n, s)) < 0.2, 0x7FC00000 & top, 0xFF800000 & top),
    "pulses": lambda rng, n, s, top: _add_pulses(rng, n, s, top),
    "comb": lambda rng, n, s, top: 20 + top / 3 * np.exp(-((np.arange(s) % rng.integers(5, 40) - 4.0) ** 2) / 4),
}
"""Counts (n, s), or what broadcasts to them, from 0 to `top`."""

COMMANDS = ["run {strip} -o {out}/cloud -v", "survey {strip} -o {out}/a.toml", "check {strip}", "info {strip} -v"]
TOOLS = [
    "run {strip} -o {out}/cloud --profile accurate --columns +incidence_angle_normals,+range",
    "run {strip} -o {out}/cloud --profile fast --points returns --keep-packets",
    "voxelize {strip} -o {out}/a.npz --size 1",
    "slice {strip} -o {out}/a.csv",
    "stats {strip} -o {out}/a.csv",
    "compare --strip {strip} fast balanced --limit 60",
    "plot waveform {strip} -o {out}/a.svg --random 2",
    "plot waveform {strip} -o {out}/a.csv --echoes",
    "synthesize {strip} -o {out}/a.las",
]


class Plan(NamedTuple):
    """What a strip consists of; the same plan gives the same bytes."""

    seed: int
    shape: str
    bits: int
    samples: int
    packets: int
    returns: int
    """Points that share a packet."""
    point_format: int
    internal: bool
    descriptors: int
    """Of half the samples, a third ..., which the packets use in turn."""
    spacing: int
    """Of samples [ps]."""
    shift: int = 0
    """Bytes from packet to packet where packets overlap; 0: they do not."""


def draw_plan(rng: random.Random) -> Plan:
    """Return a random plan whose strip has at most MOST_BYTES."""
    bits = rng.choice([8, 8, 16, 16, 32])
    room = MOST_BYTES - 20_000
    samples = rng.choice([1, 2, 3, 10, 60, 256, 1000, 2000, 10_000, 32_768, MOST_SAMPLES, MOST_SAMPLES])
    samples = min(samples, room * 8 // bits)
    samples = rng.choice([samples, rng.randint(1, samples)])
    shift = rng.choice([0] * 9 + [rng.randint(1, 4) * bits // 8])
    returns = rng.choice([1, 1, 1, 2, 7, 15, 300, 5000])
    record = 70 * returns
    taken = samples * bits // 8
    most = max((room - taken) // (record + shift), 1) if shift else max(room // (record + taken), 1)
    packets = rng.choice([1, most, most, rng.randint(1, most)])
    returns = min(returns, (room - taken) // 70)
    return Plan(
        rng.randrange(1 << 31), rng.choice(sorted(SHAPES)), bits, samples, packets, returns,
        rng.choice([4, 5, 9, 10]), rng.random() < 0.5, rng.choice([1, 1, 1, 2, 12, 255]),
        rng.choice([1000, 1000, 500, 2000, 1, 1_000_000]), shift,
    )  # fmt: skip


def build_strip(plan: Plan, path: Path) -> Path:
    """Write the strip of a plan; a name that ends in .laz is compressed."""
    rng = np.random.default_rng(plan.seed)
    n, s, width = plan.packets, plan.samples, plan.bits // 8
    raw = make_raw(n, seed=plan.seed, n_samples=1, bits=plan.bits, point_format=plan.point_format, most_returns=1)
    recorded = 1 + (n - 1) * plan.shift // (s * width) + 1 if plan.shift else n
    counts = np.broadcast_to(SHAPES[plan.shape](rng, recorded, s, (1 << plan.bits) - 1), (recorded, s))
    raw.packets = np.ascontiguousarray(counts).astype(f"<u{width}").tobytes()
    points = np.repeat(raw.points, plan.returns)
    packet, number = np.repeat(np.arange(n), plan.returns), np.tile(np.arange(plan.returns), n)
    points["wavepacket_offset"] = 60 + packet * (plan.shift or s * width)
    points["wavepacket_index"] = 1 + packet % plan.descriptors
    points["wavepacket_size"] = s * width
    points["return_point_wave_location"] = np.float32(number % s * plan.spacing)
    points["bit_fields"] = number % (15 if plan.point_format > 5 else 7) + 1
    kinds = [descriptor(k, plan.bits, max(s // k, 1), plan.spacing) for k in range(1, plan.descriptors + 1)]
    return Raw(points, raw.packets, plan.point_format, raw.minor, plan.internal, kinds).write(path)


def _add_pulses(rng: np.random.Generator, n: int, s: int, top: int) -> np.ndarray:
    """Echoes like those of a sensor, one for 40 samples, over noise."""
    signal = rng.normal(12, 1, (n, s))
    wave = np.exp(-(np.arange(-8, 9) ** 2) / 8.0)
    for row in range(n):
        spikes = np.where(rng.random(s) < 1 / 40, rng.uniform(5, min(top, 20_000) / 3, s), 0)
        signal[row] += np.convolve(spikes, wave)[8 : 8 + s]
    return np.clip(signal, 0, top)


class Done(NamedTuple):
    """How a command ended under the limits."""

    command: str
    wrong: str
    """What is wrong with it; empty if nothing is."""
    seconds: float
    """Of a processor."""
    memory: int
    """Most that was resident [byte]."""
    code: int
    """Exit code."""
    said: str
    """What it wrote."""


def run_limited(command: str, strip: Path, out: Path, *, memory: int = MEMORY, seconds: int = SECONDS) -> Done:
    """Run a command on a strip in a process with limits."""
    words = [word.format(strip=strip, out=out) for word in command.split()]
    out.mkdir(exist_ok=True)
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    process = subprocess.Popen(
        [sys.executable, "-c", _LIMITED, str(memory), str(seconds), *words],
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    said, _ = process.communicate()
    *_, last = [line for line in said.splitlines() if line.startswith("peak ")] or [""]
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    wrong = ""
    if process.returncode not in range(5) or not last:
        wrong = f"exit code {process.returncode}: {said[-300:]!r}"
    elif found := re.search(r"this is a bug|Traceback|\w*Warning\b|not enough memory|MemoryError", said):
        wrong = f"says {found[0]}: {said[-600:]!r}"
    elif any(path.name.startswith(".") for path in out.rglob("*")):
        wrong = "leaves temporary files"
    return Done(command, wrong, seconds, int(last[5:] or 0), process.returncode, said)


_LIMITED = """
import atexit, os, resource, sys
memory, seconds = map(int, sys.argv[1:3])
resource.setrlimit(resource.RLIMIT_AS, (memory, memory))
resource.setrlimit(resource.RLIMIT_CPU, (seconds, seconds + 2))
del sys.argv[1:3]
from wavebatch.__main__ import main
atexit.register(lambda: print("peak", resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024, flush=True))
main()
"""


def attack(folder: Path, plan: Plan, commands: list[str]) -> list[Done]:
    """Build the strip of a plan and run commands on it."""
    strip = build_strip(plan, folder / ("a.laz" if plan.seed % 4 == 0 else "a.las"))
    return [run_limited(command, strip, folder / str(number)) for number, command in enumerate(commands)]
