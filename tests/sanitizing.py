"""Random and hostile problems, and damaged strips, through the library built with the sanitizers of GCC.

    python tests/sanitizing.py --problems 10000 --strips 500 --seed 1

`make test-all` runs a few hundred. A report of a sanitizer ends the run: the last line names the seed of the
problem, which `--seed` repeats with `--problems 1`.
"""

from __future__ import annotations

import argparse
import ctypes
import os
import random
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from naive_fit import promise_echoes

from wavebatch.core.echoes import EchoTable
from wavebatch.kernels import library
from wavebatch.kernels.build_kernels import compile_library, find_compiler
from wavebatch.kernels.fit import neighbours
from wavebatch.kernels.fit.decompose import (
    Candidates,
    Clusters,
    Settings,
    cluster_candidates,
    decompose_clusters,
    explain_tails,
)
from wavebatch.kernels.fit.neighbours import Faintness, Flagging, Unexplained
from wavebatch.kernels.fit.pulse_shape import PulseShape, PulseTable, PulseTail
from wavebatch.kernels.geometry.planes import Planes, compare_halves
from wavebatch.kernels.library import Samples
from wavebatch.kernels.signal.filters import find_correlated, find_maxima, quiet_levels
from wavebatch.kernels.signal.noise import coloured_variance, find_levels, fit_factors, measure_covariance

FLAGS = ("-g", "-O1", "-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all")
SETTINGS = {
    "ASAN_OPTIONS": "detect_leaks=0:quarantine_size_mb=8:allocator_may_return_null=1:exitcode=99",
    "UBSAN_OPTIONS": "print_stacktrace=1:exitcode=99",
}
"""Python itself leaves memory at its end. Leaks of the library are seen in tests/kernels/test_same_bits.py."""
FITTING = ("run ", "survey ", "calibrate ", "compare --strip", "plot waveform")
"""Commands that fit."""
TYPES = (np.uint8, np.uint16, np.uint32, np.float32)
ODD = (0.0, -0.0, 5e-324, 1e-45, 1e-30, 1e-9, -1e-9, 0.5, 1.0, -1.0, 250.0, 1e9, -1e9, 1e30, -1e38, 1e300)
"""Of candidates, levels and noise; float32 cannot hold the last one."""


def find_runtimes() -> list[str]:
    """The libraries of the sanitizers, which must be loaded first; empty where the compiler has none."""
    command = find_compiler()
    found = []
    for name in ("libasan.so", "libubsan.so"):
        done = (
            subprocess.run([*command, f"-print-file-name={name}"], capture_output=True, text=True) if command else None
        )
        path = Path(done.stdout.strip()) if done is not None and done.returncode == 0 else Path(name)
        found += [str(path.resolve())] if path.is_absolute() and path.exists() else []
    return found if len(found) == 2 else []


def environment() -> dict[str, str]:
    """Of a process that loads the library of `FLAGS`."""
    return {**os.environ, **SETTINGS, "LD_PRELOAD": " ".join(find_runtimes()), "OPENBLAS_NUM_THREADS": "1"}


def draw_problem(rng: np.random.Generator) -> tuple[Samples, Candidates, Clusters, Settings]:
    """Arrays as a stage could hand them over, or as no stage would."""
    n, s = int(rng.integers(1, 5)), int(rng.choice([1, 2, 3, 4, 5, 7, 16, 31, 80, 80, 257]))
    samples = draw_samples(rng, n, s)
    c = int(rng.integers(1, 5))
    number = rng.choice([1, 1, 1, 2, 3, 5, 12], c)
    first = np.cumsum(number) - number
    low = rng.integers(0, s, c)
    clusters = Clusters(rng.integers(0, n, c), low, rng.integers(low + 1, s + 1), first, number)
    m = int(number.sum())
    time, height, width = rng.uniform(-2, s + 2, m), np.exp(rng.uniform(-2, 9, m)), np.exp(rng.normal(0.7, 1.0, m))
    if rng.random() < 0.4:
        for column in (time, height, width):
            odd = rng.random(m) < 0.3
            column[odd] = rng.choice(ODD, m)[odd]
    return samples, Candidates(clusters.waveform.repeat(number), time, height, width), clusters, draw_settings(rng, s)


def draw_samples(rng: np.random.Generator, n: int, s: int) -> Samples:
    """Echoes in noise, or any counts; levels, noise and gaps of any kind."""
    kind = TYPES[rng.integers(4)]
    most = 1e9 if kind == np.float32 else float(np.iinfo(kind).max)
    x = np.arange(s)
    height, time, width = (
        np.exp(rng.uniform(0, np.log(most), n)),
        rng.uniform(-3, s + 3, n),
        np.exp(rng.normal(0.7, 0.8, n)),
    )
    bells = height[:, None] * np.exp(-0.5 * ((x - time[:, None]) / width[:, None]) ** 2)
    noise, level = float(rng.choice([0.5, 1.0, 20.0])), float(rng.choice([0.0, 12.0, 200.0]))
    counts = bells + level + noise * rng.standard_normal((n, s))
    choice = rng.random()
    if choice < 0.15:
        counts = rng.uniform(0, most, (n, s))
    elif choice < 0.3:
        counts = np.full((n, s), rng.choice([0.0, most, level]))
    elif choice < 0.4 and kind == np.float32:
        counts = rng.choice(ODD[:-1], (n, s))
    baseline = np.full((n, s) if rng.random() < 0.3 else n, level, np.float32)
    std = np.full(n, noise, np.float32)
    if rng.random() < 0.2:
        baseline[...] = rng.choice(ODD[:-1], baseline.shape)
    if rng.random() < 0.2:
        std[:] = rng.choice([1e-45, 1e-30, 1e-9, 1e9, 1e30], n)
    missing = rng.random((n, s)) < rng.choice([0.05, 0.5, 1.0]) if rng.random() < 0.3 else None
    counts = counts.clip(0 if kind != np.float32 else None, most).astype(kind)
    if missing is not None and kind == np.float32:
        counts[missing] = np.nan
    if kind == np.float32 and rng.random() < 0.05:
        counts[0, 0] = rng.choice([np.nan, np.inf])
    level_err = std * np.float32(rng.choice([0.0, 0.1, 1.0, 1e9])) if rng.random() < 0.6 else None
    return Samples(counts, baseline, std, missing, level_err)


def draw_shape(rng: np.random.Generator) -> PulseShape:
    """One of the models, with parameters from usual to absurd."""
    kind = rng.integers(7)
    if kind == 0:
        return PulseShape(kappa=float(rng.choice([1e-7, 1e-4, 0.05, -0.3, 0.6, 20.0])))
    if kind == 1:
        return PulseShape(power=float(rng.choice([0.1, 0.7, 1.5, 3.0, 8.0, 60.0])))
    if kind == 2:
        weights = (
            rng.normal(0, 0.3, 5),
            rng.choice([-40.0, -2.0, 0.0, 3.0, 8.0], 5),
            rng.choice([-9.0, 0.0, 0.5, 1e6], 5),
        )
        return PulseShape(
            components=tuple(zip(*(column.tolist() for column in weights), strict=True))[: rng.integers(1, 6)]
        )
    if kind == 3:
        rows = int(rng.choice([2, 3, 65, 4000]))
        z = np.linspace(-8, 8, rows)
        value = np.exp(-0.5 * z**2).astype(np.float32)
        return PulseShape(table=PulseTable(-8.0, 16 / (rows - 1), value, (-z * value).astype(np.float32), 0.0))
    return PulseShape(origin=("", "", "segment", "waveform")[kind - 3])


def draw_settings(rng: np.random.Generator, s: int) -> Settings:
    """Options from usual to absurd."""

    def one(*values: float) -> float:
        return float(rng.choice(values))

    usual = rng.random() < 0.5
    width = one(1.0, 2.0, 4.5) if usual else one(1e-9, 0.01, 2.0, 40.0, 3000.0, 1e12)
    low, high = (0.5 * width, 6 * width) if usual else (one(1e-9, 1e-3, 1.0), one(1.0, 50.0, 1e9))
    return Settings(
        width, low, high, draw_shape(rng), clip=None if rng.random() < 0.6 else one(-5, 0, 60, 250, 1e9),
        floor=None if rng.random() < 0.6 else one(-1e9, -5, 0, 5, 300), noise_gain=one(0, 0, 0.05, 1e9),
        tolerance=one(1e-2, 1e-6, 0, 1e9), max_iterations=int(one(0, 1, 40, 40, 200)),
        grow=bool(rng.random() < 0.8), acceptance=one(15, 15, 0, 1e9), misfit=one(0, 0.01, 10),
        max_echoes=int(one(1, 6, 6, 20)), prior_spread=one(0, 0.2, 1e-30, 1e9), gate_residual=one(4.2, 0, 1e9),
        gate_hermite=one(8.5, 0, 1e9), undamped=bool(rng.random() < 0.15), skew_mean=one(0, 0.1, 5),
        skew_spread=one(0, 0, 0.1, 1e-30, 1e9), known=one(0, 3, 3, 1e9),
        whitening=None if rng.random() < 0.6 else rng.normal(0, one(1, 1, 0, 1e9), (3, 3)),
        thorough=bool(rng.random() < 0.6), free_levels=bool(rng.random() < 0.7),
    )  # fmt: skip


def solve(seed: int) -> bool:
    """A problem through both functions; what comes back must fit together. False where Python refuses the problem."""
    problem = draw_problem(np.random.default_rng(seed))
    try:
        found = decompose_clusters(*problem)
        promise = promise_echoes(*problem)
    except (ValueError, MemoryError) as error:
        assert str(error), seed
        return False
    look_for(problem[0], problem[1], np.random.default_rng(seed))
    add_up(np.random.default_rng(seed))
    number = problem[2].number
    assert len(found.number) == len(promise) == len(number) and (found.number > 0).all(), seed
    assert len(found.parameters) == found.number.sum() == len(found.errors) == len(found.at_bound), seed
    return True


def look_for(samples: Samples, candidates: Candidates, rng: np.random.Generator) -> None:
    """The functions of whole waveforms on the samples of a problem, with any options."""
    n, s = samples.counts.shape
    level = samples._replace(baseline=samples.baseline if samples.baseline.ndim == 1 else samples.baseline[:, 0])
    reach, recovery = (int(value) for value in rng.integers(0, 3 * s + 2, 2))
    quiet_levels(level, float(10 ** rng.uniform(-9, 12)), reach, recovery)
    find_levels(samples.counts.T, float(10 ** rng.uniform(-3, 3)), reach, 4.0, recovery, rng.integers(0, 2 * s, n))
    taps = rng.normal(size=int(rng.integers(1, 2 * s + 2)))
    for broad in (0.0, float(10 ** rng.uniform(-2, 3))):
        found = find_maxima(samples, float(rng.choice([0.0, 2.0])), float(10 ** rng.uniform(-2, 3)), broad, taps)
        assert len({len(column) for column in found}) == 1
    assert len({len(column) for column in find_correlated(samples, 1.0, float(10 ** rng.uniform(-2, 3)), taps)}) == 1
    order = np.lexsort((candidates.time, candidates.waveform))
    ordered = Candidates(*(field[order] for field in candidates))
    tail = rng.integers(0, 2 * s, len(order)) if rng.random() < 0.5 else None
    margin, reach, most = int(rng.integers(0, 99)), int(rng.integers(0, 99)), int(rng.integers(1, 9))
    clusters = cluster_candidates(samples, ordered, margin=margin, reach=reach, most=most, tail=tail)
    assert clusters.number.sum() == len(order)
    size = int(rng.integers(0, 9))
    highest = np.sort(rng.random(size + 1))[::-1].copy()
    shape = PulseTail(float(rng.normal(0, s)), rng.normal(0, 1, 2 * size + 1), highest)
    assert (explain_tails(ordered, samples.std, shape, most, 1.0)[1] <= size + 1).all()
    judge(samples, ordered, rng)


def judge(samples: Samples, echoes: Candidates, rng: np.random.Generator) -> None:
    """The functions of tables of echoes, with any laws."""
    m, s = len(echoes.time), samples.counts.shape[1]
    values = {name: rng.normal(0, 10, m) for name in ("time_err", "amplitude_err", "sigma_err", "residual")}
    columns = echoes.waveform, echoes.time, echoes.amplitude, echoes.width
    with np.errstate(over="ignore"):
        table = EchoTable.build(*columns, **values, flags=rng.choice([0, 16], m))
    width, level = 10 ** rng.uniform(-3, 3, 2)
    curve = tuple(zip(np.sort(rng.normal(0, 9, rng.integers(0, 4))), rng.random(3), strict=False))
    law = Unexplained(5.0, 0.1, level, 9.0, 1.0, curve, 1.0, 1.0, level, 0.1, width, 1.0)
    assert (neighbours.weigh_fits(table.columns(), law, others=True)[0] >= 1).all()
    flagging = Flagging(0.5, 0.5 * s, width, width, level, 1.5, 0.1)
    faint = Faintness(0.1, 0, 9, True, level, 0.1, curve, 1, 5, 9, 2, 2, 2)
    error = rng.choice([0.0, 1.0])
    steps = neighbours.Finishing(True, 0.5, width, width, error, faint, law, True, True, flagging, faint)
    levels = samples._replace(baseline=samples.std)
    assert len(neighbours.finish_echoes(table.columns(), np.arange(m), levels, steps, np.ones((m, 4)))[1]) <= m


def add_up(rng: np.random.Generator) -> None:
    """The functions of sets of points, weights and pairs of samples: none, one or many of them, some no number."""
    sizes = rng.choice([0, 0, 1, 2, 3, 4, 5, 9, 40], rng.integers(0, 6))
    n, k, start = len(sizes), int(sizes.sum()), np.r_[0, np.cumsum(sizes)].astype(np.int64)
    xyz = rng.normal(0, 1, (k, 3))
    odd = rng.random(xyz.shape) < rng.choice([0.0, 0.1, 1.0])
    xyz[odd] = rng.choice([*ODD, np.nan, np.inf], np.count_nonzero(odd))
    kept, limit = np.empty(n, np.int64), np.empty(n)
    factors = (ctypes.c_double(value) for value in (0.0025, rng.choice([0.0, 1.5]), 6.0, 1e-3))
    settings = ctypes.c_int64(n), start, xyz, *factors, *map(ctypes.c_int64, (3, 4))
    library.call("trim_planes", *settings, np.empty((n, 3, 3)), np.empty((n, 3)), np.empty((n, 3)), kept, limit)
    assert (kept <= sizes).all()
    planes = Planes(rng.normal(0, 1, (n, 3, 3)), np.ones((n, 3)), rng.normal(0, 1, (n, 3)), kept, limit)
    compare_halves(xyz, np.repeat(np.arange(n), sizes), planes)
    r, s, lags = (int(rng.choice([0, 1, 2, 3, 9, 30])) for _ in range(3))
    weights, correlation = rng.choice([*ODD, np.nan], (r, s)), rng.normal(0, 1, lags)
    assert coloured_variance(weights, correlation).shape == (r,)
    if r >= 3:
        fit_factors(weights[:3], 0.1, -0.1, rng.normal(0, 1, 3) if r > 3 else None, tuple(correlation))
    signal = rng.normal(12, 1, (s, int(rng.choice([0, 1, 7, 100])))).astype(np.float32)
    signal[rng.random(signal.shape) < rng.choice([0.0, 0.1, 1.0])] = np.nan
    quiet, high, low = (rng.random(signal.shape) < rng.choice([0.0, 0.5, 1.0]) for _ in range(3))
    measure_covariance(signal, quiet, lags + 12, (high, low) if rng.random() < 0.5 else None)


def damage_strips(folder: Path, cases: int, seed: int) -> list[str]:
    """What is wrong with damaged strips and odd chains in commands that fit."""
    from fuzz_inputs import COMMANDS
    from fuzz_options import Options
    from fuzzing import Fuzzer, draw_case

    fuzzer, options, rng, wrong = Fuzzer(folder), Options(), random.Random(seed), []
    kinds = {kind for kind, commands in COMMANDS.items() if any(one.startswith(FITTING) for one in commands)}
    while cases > 0:
        case = draw_case(fuzzer.sound, options, rng)
        if case.kind in kinds and case.command.startswith(FITTING) and "--jobs" not in case.command:
            cases -= 1
            why = fuzzer.run(case)
            wrong += [f"{case}: {why}: {fuzzer.last['err'][-2000:]}"] if why else []
    fuzzer.close()
    return wrong


def main() -> None:
    """Build the library, load it in a process with the sanitizers, and run."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    for name, default in (("problems", 10_000), ("strips", 200), ("seed", 1)):
        parser.add_argument(f"--{name}", type=int, default=default)
    parser.add_argument("--library", type=Path, help="built before, as the process with the sanitizers gets it")
    given = parser.parse_args()
    if given.library is None:
        with tempfile.TemporaryDirectory() as folder:
            target = Path(folder) / library.LIBRARY.name
            compile_library(target, FLAGS)
            call = [sys.executable, __file__, *sys.argv[1:], "--library", str(target)]
            code = subprocess.run(call, env=environment()).returncode
            if code:
                print(f"ended with status {code}; last problem: --seed {target.with_suffix('.seed').read_text()}")
            sys.exit(code)
    library.LIBRARY = given.library
    library.load()
    start, solved = time.process_time(), 0
    for seed in range(given.seed, given.seed + given.problems):
        given.library.with_suffix(".seed").write_text(str(seed))
        solved += solve(seed)
    print(f"{given.problems} problems, {solved} solved, {time.process_time() - start:.0f} s of a processor")
    if given.strips:
        start = time.monotonic()
        with tempfile.TemporaryDirectory() as folder:
            wrong = damage_strips(Path(folder), given.strips, given.seed)
        print(
            f"{given.strips} damaged strips and options, {time.monotonic() - start:.0f} s; {len(wrong)} failures",
            *wrong,
            sep="\n",
        )
        sys.exit(bool(wrong))


if __name__ == "__main__":
    main()
