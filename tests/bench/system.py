"""Start-up time, memory over the length of a strip, and speed over the number of jobs; `release` calls it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from wavebatch.stages.chain import Chain, load_profile
from wavebatch.tools.bench.accuracy import median_range
from wavebatch.tools.bench.command import Worker, peak_memory, run_file
from wavebatch.tools.simulate import find_scene, simulate_strip


def measure_system(
    seed: int, *, pulses: int, large: bool, progress: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Start-up time, memory over the length of a strip, and speed over the number of jobs, as plain values.

    pulses: of the strip for memory; the one for jobs is five times as long.
    large: also measure memory with 100 times as many.
    """
    chain, scene = load_profile("accurate"), find_scene("open")
    progress("timing wavebatch --help")
    start, memory = time_start(), []
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as name:
        folder = Path(name)
        strip = folder / "memory.laz"
        for number in (pulses, 100 * pulses) if large else (pulses,):
            progress(f"memory with {number} pulses")
            simulate_strip(scene, strip, pulses=number, seed=seed, overwrite=True)
            peak, waveforms = measure_memory(chain, strip, folder / "memory")
            memory.append({"waveforms": waveforms, "peak_bytes": peak})
        progress("speed with 1 and 2 jobs")
        strip = folder / "jobs.laz"
        simulate_strip(scene, strip, pulses=5 * pulses, seed=seed)
        jobs = time_jobs(chain, strip, folder / "jobs", (1, 2), 2)
    return {"start_seconds": start, "memory": memory, "jobs": jobs}


def time_start(repeats: int = 5) -> dict[str, Any]:
    """Seconds that `wavebatch --help` takes."""
    command = [sys.executable, "-m", "wavebatch", "--help"]
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds.append(time.perf_counter() - begin)
    return median_range(seconds)


def time_jobs(chain: Chain, strip: Path, folder: Path, jobs: Sequence[int], repeats: int) -> dict[str, dict[str, Any]]:
    """Seconds from file to file, without scan and survey, by number of jobs; the numbers take turns."""
    seconds: dict[int, list[float]] = {number: [] for number in jobs}
    for _ in range(repeats):
        for number in jobs:  # here: a worker process starts no others
            run = run_file(chain, strip, folder, number)
            seconds[number].append(run.seconds - run.survey_seconds)
    return {str(number): median_range(values) for number, values in seconds.items()}


def measure_memory(chain: Chain, strip: Path, folder: Path) -> tuple[int | None, int]:
    """Peak memory [bytes] of a fresh process that takes the strip from file to file, and its waveforms."""
    with Worker() as worker:
        run = worker.call(run_file, chain, strip, folder, 1)
        return worker.call(peak_memory), run.waveforms
