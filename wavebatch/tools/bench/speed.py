"""Run time and memory of chains: kernels alone and from file to file, each chain in a process with one thread.

`command` calls `time_chains`, and `measure_system` for the promises. The chains take turns, so that other load of the
machine slows all of them alike.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from wavebatch.batch.job import StripJob, choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.stages.chain import Chain
from wavebatch.stages.chain_file import load_profile
from wavebatch.tools.bench.figures import median_range
from wavebatch.tools.bench.scenes import find_bench_scene
from wavebatch.tools.bench.worker import Worker, peak_memory
from wavebatch.tools.simulate import simulate_strip

PREPARATION = ("scan", "survey")
"""Parts of a run whose time does not grow with the strip."""


@dataclass(slots=True)
class Laps:
    """Repeated measurements of one chain; the names are those of the document."""

    kernels: list[float] = field(default_factory=list)
    """Microseconds per waveform."""
    file: list[float] = field(default_factory=list)
    """Microseconds per waveform from file to file, without scan and survey."""
    file_with_survey: list[float] = field(default_factory=list)
    """Microseconds per waveform from file to file."""
    survey_seconds: list[float] = field(default_factory=list)
    """Seconds of scan and survey."""
    peak_bytes: int | None = None
    """Peak memory."""


class FileRun(NamedTuple):
    """A run from file to file."""

    seconds: float
    survey_seconds: float
    """Of these, scan and survey."""
    waveforms: int


def time_chains(
    chains: Mapping[str, tuple[Chain, SystemPulse]],
    block: WaveformBlock,
    strip: Path | None,
    folder: Path,
    repeats: int,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Laps]:
    """Laps of every chain: kernels on the block, and from `strip` to a cloud in the folder (None: kernels only)."""
    laps = {name: Laps() for name in chains}
    workers = {name: Worker() for name in chains}
    try:
        for name, (chain, system) in chains.items():
            workers[name].call(run_kernels, chain, block, system)
        for turn in range(repeats):
            for name, (chain, system) in chains.items():
                progress(f"timing {name}, turn {turn + 1} of {repeats}")
                seconds = workers[name].call(run_kernels, chain, block, system)
                laps[name].kernels.append(1e6 * seconds / len(block))
                if strip is not None:
                    clouds = folder / re.sub(r"\W", "-", name)
                    _add_file_lap(laps[name], workers[name].call(run_file, chain, strip, clouds, 1))
        for name, worker in workers.items():
            laps[name].peak_bytes = worker.call(peak_memory)
    finally:
        for worker in workers.values():
            worker.close()
    return laps


def _add_file_lap(lap: Laps, run: FileRun) -> None:
    lap.file.append(1e6 * (run.seconds - run.survey_seconds) / run.waveforms)
    lap.file_with_survey.append(1e6 * run.seconds / run.waveforms)
    lap.survey_seconds.append(run.survey_seconds)


def run_kernels(chain: Chain, block: WaveformBlock, system: SystemPulse) -> float:
    """Seconds for noise, detection and decomposition of the block."""
    timing: dict[str, float] = {}
    chain.run(block, system, timing)
    return sum(timing.get(step.stage.name, 0.0) for step in chain.steps[:3])


def run_file(chain: Chain, strip: Path, folder: Path, jobs: int) -> FileRun:
    """Times the strip through the batch, as `wavebatch run` does it."""
    job = StripJob(strip, chain, columns=choose_columns(chain))
    begin = time.perf_counter()
    result = run_batch([job], RunOptions(folder, jobs=jobs, overwrite=True))
    seconds = time.perf_counter() - begin
    for outcome in result.outcomes:
        if outcome.error is not None:
            raise outcome.error
    timing = result.report.timing
    return FileRun(seconds, sum(timing.get(name, 0.0) for name in PREPARATION), result.report.count("waveforms"))


def measure_system(
    seed: int, *, pulses: int, large: bool, progress: Callable[[str], None] = lambda text: None
) -> dict[str, Any]:
    """Start-up time, memory over the length of a strip, and speed over the number of jobs, as plain values.

    pulses: of the strip for memory; the one for jobs is five times as long.
    large: also measure memory with 100 times as many.
    """
    chain, scene = load_profile("accurate"), find_bench_scene("open")
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
    with Worker() as worker:
        for _ in range(repeats):
            for number in jobs:
                run = worker.call(run_file, chain, strip, folder, number)
                seconds[number].append(run.seconds - run.survey_seconds)
    return {str(number): median_range(values) for number, values in seconds.items()}


def measure_memory(chain: Chain, strip: Path, folder: Path) -> tuple[int | None, int]:
    """Peak memory [bytes] of a fresh process that takes the strip from file to file, and its waveforms."""
    with Worker() as worker:
        run = worker.call(run_file, chain, strip, folder, 1)
        return worker.call(peak_memory), run.waveforms
