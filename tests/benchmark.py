"""Waveforms per second and error of every profile on simulated strips, beside scipy's leastsq in the same run.

    python tests/benchmark.py FOLDER [PULSES]

Kernels: the decompose stage alone; chain: all stages; file: strip on disk to cloud on disk, in a process of its own,
whose peak memory is shown. Completeness and correctness within 1.5 ns. Written as FOLDER/speed.json too.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import time
from pathlib import Path

for _name in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[_name] = "1"

import numpy as np  # noqa: E402  (after the number of threads is set)
from scipy.optimize import leastsq  # noqa: E402

from wavebatch import survey  # noqa: E402
from wavebatch.config import list_profiles, load_profile  # noqa: E402
from wavebatch.evaluate import Scorer  # noqa: E402
from wavebatch.simulate import find_scene, simulate_blocks, simulate_strip  # noqa: E402

SCENES = ("mixed", "flat", "forest")
BLOCK = 8192
SCIPY_WAVEFORMS = 1000


def run_chain(blocks: list, scene: str, profile: str) -> dict:
    """Speed of the stages of a profile on blocks in memory, and what the echoes are worth."""
    chain = load_profile(profile)
    system = survey.measure(block for block, _ in blocks[:1])
    timing: dict[str, float] = {}
    scorer, n = Scorer(find_scene(scene).recording.recorded_noise, blocks[0][0].spacing), 0
    chain.run(blocks[0][0], system)
    for block, truth in blocks:
        scorer.add(chain.run(block, system, timing), truth, len(block))
        n += len(block)
    value = scorer.result()
    decompose = next(seconds for name, seconds in timing.items() if name.startswith("decompose."))
    return {
        "kernels": n / decompose,
        "chain": n / sum(timing.values()),
        "completeness": value.completeness,
        "correctness": value.correctness,
        "exact": value.exact_count,
    }


def run_file(strip: Path, folder: Path, profile: str) -> dict:
    """Speed and peak memory of `wavebatch run` on a strip, start of the process included."""
    command = [sys.executable, __file__, "--child", str(strip), str(folder), profile]
    start = time.perf_counter()
    told = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return {"file": told["waveforms"] / (time.perf_counter() - start), "peak_mb": told["peak_mb"]}


def run_child(strip: str, folder: str, profile: str) -> None:
    """The run itself, in a process of its own; prints its numbers as JSON."""
    from click.testing import CliRunner

    from wavebatch.cli import main

    arguments = ["run", strip, "-o", folder, "--profile", profile, "--overwrite", "-q", "--report", "-"]
    result = CliRunner().invoke(main, arguments)
    if result.exit_code:
        raise SystemExit(result.stderr)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / (1 << 20 if sys.platform == "darwin" else 1 << 10)
    print(json.dumps({"waveforms": json.loads(result.stdout)["counts"]["waveforms"], "peak_mb": peak}))


def run_scipy(blocks: list) -> float:
    """Waveforms per second of scipy's leastsq with an analytic Jacobian, started at the true number of echoes."""
    block, truth = blocks[0]
    x = np.arange(block.samples.shape[1]) * block.spacing
    edges = np.searchsorted(truth.waveform, np.arange(SCIPY_WAVEFORMS + 1))
    start = time.perf_counter()
    for row in range(SCIPY_WAVEFORMS):
        echoes = slice(edges[row], edges[row + 1])
        y = block.samples[row] - np.median(block.samples[row])
        first = np.stack([truth.amplitude[echoes], truth.time[echoes], truth.sigma[echoes]]).astype(float)
        if first.size:
            leastsq(_residual, first.ravel(), args=(x, y), Dfun=_jacobian, col_deriv=True, full_output=True)
    return SCIPY_WAVEFORMS / (time.perf_counter() - start)


def _terms(parameters: np.ndarray, x: np.ndarray) -> tuple[np.ndarray, ...]:
    amplitude, centre, sigma = parameters.reshape(3, -1, 1)
    z = (x - centre) / sigma
    return amplitude, sigma, z, np.exp(-0.5 * z * z)


def _residual(parameters: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    amplitude, _, _, shape = _terms(parameters, x)
    return (amplitude * shape).sum(axis=0) - y


def _jacobian(parameters: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    amplitude, sigma, z, shape = _terms(parameters, x)
    slope = amplitude * shape * z / sigma
    return np.concatenate([shape, slope, slope * z])


def main(folder: Path, pulses: int) -> None:
    """Prints the table and writes it as JSON."""
    rows = []
    print(f"{'scene':8}{'profile':10}{'kernels/s':>11}{'chain/s':>10}{'file/s':>10}{'peak MB':>9}"
          f"{'complete':>10}{'correct':>9}{'exact':>8}")  # fmt: skip
    for scene in SCENES:
        strip = folder / f"{scene}.las"
        simulate_strip(scene, strip, pulses=pulses, seed=7, overwrite=True)
        blocks = list(simulate_blocks(scene, min(pulses, 32 * BLOCK), seed=7, size=BLOCK))
        for profile in list_profiles():
            measured = {**run_chain(blocks, scene, profile), **run_file(strip, folder, profile)}
            row = {"scene": scene, "profile": profile, **measured}
            rows.append(row)
            print(f"{scene:8}{profile:10}{row['kernels']:11,.0f}{row['chain']:10,.0f}{row['file']:10,.0f}"
                  f"{row['peak_mb']:9,.0f}{row['completeness']:10.3f}{row['correctness']:9.3f}{row['exact']:8.3f}",
                  flush=True)  # fmt: skip
        speed = run_scipy(blocks)
        rows.append({"scene": scene, "profile": "scipy leastsq", "kernels": speed})
        print(f"{scene:8}{'scipy':10}{speed:11,.0f}   (leastsq, one waveform at a time, told the number of echoes)")
    (folder / "speed.json").write_text(json.dumps(rows, indent=2) + "\n")


if __name__ == "__main__":
    if sys.argv[1] == "--child":
        run_child(*sys.argv[2:])
    else:
        target = Path(sys.argv[1])
        target.mkdir(parents=True, exist_ok=True)
        main(target, int(sys.argv[2]) if len(sys.argv) > 2 else 200_000)
