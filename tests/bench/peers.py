"""Other decomposers on the same waveforms: gdecomp where it is installed, and scipy's leastsq as the baseline.

`release` calls `measure_peers`. Peers run in a Worker process, because gdecomp crashes or hangs on some waveforms: it
writes its results to a memory-mapped file, and is started again after the waveform that stopped it.
"""

from __future__ import annotations

import importlib.util
import os
import tempfile
import time
import warnings
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.batch.workers.futures import WorkerDied
from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.stages.detect.direct import maximum
from wavebatch.stages.noise import pooled
from wavebatch.tools.bench.accuracy import AccuracyTally, Group
from wavebatch.tools.bench.command import Laps, Worker, make_row
from wavebatch.tools.simulate import Scene

PEER_GROUPS = 6
"""Groups of which peers get a part: they are slow."""

PEER_WAVEFORMS = 2_000

MOST = 12
"""Most echoes per waveform that a peer may report."""

PATIENCE = 2.0
"""Seconds on one waveform after which a peer is stopped."""

HEIGHT = 5.5
"""Least height of an echo for gdecomp, in standard deviations of the noise: there, misses and false echoes balance."""


@dataclass(frozen=True, slots=True, eq=False)
class PeerResult:
    """Echoes that a peer found, and its time without start-up."""

    found: EchoTable
    seconds: float
    waveforms: int
    """Waveforms that it finished."""
    failures: int
    """Waveforms on which it crashed or hung."""


def measure_peers(
    scene: Scene, groups: list[Group], progress: Callable[[str], None], waveforms: int = PEER_WAVEFORMS
) -> list[dict[str, Any]]:
    """Rows of the benchmark for the peers, on part of the groups; waveforms: in all."""
    groups = groups[:PEER_GROUPS]
    n = min(max(waveforms // len(groups), 1), len(groups[0].block))
    parts = [group.cut(n) for group in groups]
    rows = []
    for name in list_peers():
        progress(f"{scene.name}: {name} on {n * len(parts)} waveforms")
        tally, times, failures = AccuracyTally(), [], 0
        for part in parts:
            result = run_peer(name, part.block, part.system)
            tally.add(part, result.found)
            times.append(1e6 * result.seconds / max(result.waveforms, 1))
            failures += result.failures
        rows.append({**make_row(name, "peer", tally, Laps(kernels=times)), "crashed_or_hung": failures})
    return rows


def list_peers() -> list[str]:
    """Names of the peers that can run here."""
    return [*(["gdecomp"] if importlib.util.find_spec("gdecomp") else []), "scipy leastsq"]


def run_peer(name: str, block: WaveformBlock, system: SystemPulse, *, patience: float = PATIENCE) -> PeerResult:
    """Runs the peer on every waveform of the block, one by one, in another process.

    It gets the waveforms minus the baselines of wavebatch; scipy also gets the candidates of wavebatch.
    """
    noise = pooled(block, system)
    if name == "gdecomp":
        return _run_gdecomp(block, noise, patience)
    with Worker() as worker:
        return worker.call(fit_leastsq, block, noise, system)


def fit_leastsq(block: WaveformBlock, noise: Noise, system: SystemPulse) -> PeerResult:
    """Sums of Gaussians by scipy.optimize.leastsq with the analytic Jacobian, started from detect.maximum."""
    from scipy.optimize import leastsq

    candidates = maximum(block, noise, system)
    signal = block.samples - noise.level.astype(np.float64)
    x = np.arange(signal.shape[1]) * block.spacing
    ends = np.cumsum(candidates.count(len(block)))
    starts = np.stack([candidates.amplitude, candidates.time, candidates.sigma], axis=1).astype(np.float64)
    solved, rows = [], []
    begin = time.perf_counter()
    for row, (first, last) in enumerate(zip(np.r_[0, ends[:-1]], ends, strict=True)):
        if 0 < last - first <= MOST:
            solved.append(_solve(leastsq, starts[first:last].ravel(), x, signal[row]))
            rows.append(np.full(last - first, row))
    seconds = time.perf_counter() - begin
    found = _table(np.concatenate(rows), np.concatenate(solved), x[-1]) if solved else EchoTable.empty()
    return PeerResult(found, seconds, len(block), 0)


def _solve(leastsq, start: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    def residual(p: np.ndarray) -> np.ndarray:
        a, t, s = p[0::3, None], p[1::3, None], p[2::3, None]
        return (a * np.exp(-0.5 * ((x - t) / s) ** 2)).sum(axis=0) - y

    def jacobian(p: np.ndarray) -> np.ndarray:
        a, t, s = p[0::3, None], p[1::3, None], p[2::3, None]
        z = (x - t) / s
        pulse = np.exp(-0.5 * z * z)
        rows = np.empty((len(p), len(x)))
        rows[0::3] = pulse
        rows[1::3] = a * pulse * z / s
        rows[2::3] = rows[1::3] * z
        return rows

    if len(start) > len(x):
        return start.reshape(-1, 3)
    with np.errstate(all="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore")
        return leastsq(residual, start, Dfun=jacobian, col_deriv=True)[0].reshape(-1, 3)


def _table(rows: np.ndarray, parameters: np.ndarray, last: float) -> EchoTable:
    """The echoes that are positive, finite and within the window."""
    amplitude, when, sigma = parameters[:, 0], parameters[:, 1], np.abs(parameters[:, 2])
    keep = np.isfinite(parameters).all(axis=1) & (amplitude > 0) & (sigma > 0) & (when > 0) & (when < last)
    return EchoTable.build(rows[keep], when[keep], amplitude[keep], sigma[keep])


def _run_gdecomp(block: WaveformBlock, noise: Noise, patience: float) -> PeerResult:
    n = len(block)
    with tempfile.TemporaryDirectory() as folder:
        signal, results = Path(folder, "signal.npy"), Path(folder, "results.npy")
        np.save(signal, block.samples - noise.level.astype(np.float64))
        np.save(results, np.full((n, 2 + 3 * MOST), np.nan))
        failures = _drive_gdecomp(signal, results, n, HEIGHT * float(noise.std[0]), patience)
        done = np.load(results)
    good = np.isfinite(done[:, 0])
    count = np.where(good, done[:, 0], 0).astype(np.int64)
    rows = np.repeat(np.arange(n), count)
    parameters = done[:, 2:].reshape(n, MOST, 3)[np.arange(MOST) < count[:, None]]
    with np.errstate(all="ignore"):
        parameters[:, 0] /= np.abs(parameters[:, 2]) * np.sqrt(2 * np.pi)
    found = _table(rows, parameters, block.samples.shape[1] - 1.0)
    found = replace(found, time=found.time * block.spacing, sigma=found.sigma * np.float32(block.spacing))
    return PeerResult(found, float(done[good, 1].sum()), int(good.sum()), failures)


def _drive_gdecomp(signal: Path, results: Path, n: int, height: float, patience: float) -> int:
    """Runs gdecomp, starting it again after every waveform on which it crashes or hangs; returns their number."""
    failures, place = 0, 0
    while place < n:
        with ThreadPoolExecutor(1) as caller, Worker() as worker:
            worker.call(os.getpid)  # so that starting up does not look like hanging
            call = caller.submit(worker.call, fit_gdecomp, signal, results, place, height)
            try:
                _wait(call, results, place, patience)
                break
            except WorkerDied:
                pass
        done = np.load(results, mmap_mode="r")[place:, 0]
        place += int(np.argmax(np.isnan(done))) + 1 if np.isnan(done).any() else n
        failures += 1
    return failures


def _wait(call: Future, results: Path, place: int, patience: float) -> None:
    """Waits until the worker is done; raises WorkerDied when it ends or makes no progress."""
    before = -1
    while True:
        try:
            call.result(patience)
            return
        except TimeoutError:
            now = int(np.isfinite(np.load(results, mmap_mode="r")[place:, 0]).sum())
            if now == before:
                raise WorkerDied("no progress") from None
            before = now


def fit_gdecomp(signal: Path, results: Path, first: int, height: float) -> None:
    """Fills rows of the results from `first` on: number of echoes, seconds, then area, time, width of each."""
    import gdecomp

    waveforms = np.load(signal)
    out = np.load(results, mmap_mode="r+")
    for row in range(first, len(waveforms)):
        begin = time.perf_counter()
        values = np.asarray(gdecomp.GaussianDecomposition(waveforms[row], thres=height), np.float64)[: 3 * MOST]
        out[row, 1] = time.perf_counter() - begin
        out[row, 2 : 2 + len(values)] = values
        out[row, 0] = len(values) // 3
