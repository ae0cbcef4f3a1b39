"""How long chains take: kernels alone and file to file, in processes of one thread each, taking turns."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from wavebatch.batch.run import run_batch
from wavebatch.batch.strip_task import BatchOptions
from wavebatch.batch.unit import RunOptions, StripJob, choose_columns
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.stages.chain import Chain
from wavebatch.tools.bench.figures import median_range
from wavebatch.tools.bench.worker import Worker, peak_memory
from wavebatch.tools.simulate import Scene, simulate_strip

PREPARATION = ("scan", "survey")
"""Parts of a run that a strip pays once, whatever its length."""


@dataclass(slots=True)
class Laps:
    """Repeated measurements of one chain."""

    kernels: list[float] = field(default_factory=list)
    """Microseconds per waveform."""
    file: list[float] = field(default_factory=list)
    """Microseconds per waveform from file to file, without what a strip pays once."""
    whole: list[float] = field(default_factory=list)
    """Microseconds per waveform from file to file, all of it."""
    preparation: list[float] = field(default_factory=list)
    """Seconds of scan and survey."""
    memory: int | None = None
    """Most bytes in memory."""

    def to_json(self) -> dict[str, Any]:
        """Medians and ranges, by what was measured."""
        return {
            "kernels": median_range(self.kernels),
            "file": median_range(self.file),
            "file_with_survey": median_range(self.whole),
            "survey_seconds": median_range(self.preparation),
            "peak_bytes": self.memory,
        }


def time_chains(
    chains: Mapping[str, tuple[Chain, SystemPulse]],
    block: WaveformBlock,
    strip: Path | None,
    folder: Path,
    repeats: int,
    progress: Callable[[str], None] = lambda text: None,
) -> dict[str, Laps]:
    """Laps of every chain: kernels on the block, and from `strip` (None: not at all) to a cloud in the folder.

    Each chain has a process of its own, and they take turns, so that whatever else the machine does hits all alike.
    """
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
                    _add_file_lap(laps[name], workers[name].call(run_file, chain, strip, folder / _plain(name), 1))
        for name, worker in workers.items():
            laps[name].memory = worker.call(peak_memory)
    finally:
        for worker in workers.values():
            worker.close()
    return laps


def _add_file_lap(lap: Laps, run: Mapping[str, float]) -> None:
    once = run["preparation"]
    lap.file.append(1e6 * (run["seconds"] - once) / run["waveforms"])
    lap.whole.append(1e6 * run["seconds"] / run["waveforms"])
    lap.preparation.append(once)


def _plain(name: str) -> str:
    """A name of a folder."""
    return "".join(letter if letter.isalnum() else "-" for letter in name)


def run_kernels(chain: Chain, block: WaveformBlock, system: SystemPulse) -> float:
    """Seconds that noise, detection and decomposition of the block take."""
    timing: dict[str, float] = {}
    chain.run(block, system, timing)
    return sum(timing.get(step.stage.name, 0.0) for step in chain.steps[:3])


def run_file(chain: Chain, strip: Path, folder: Path, jobs: int) -> dict[str, float]:
    """The strip through the batch as `wavebatch run` does it: seconds, those of scan and survey, waveforms."""
    job = StripJob(strip, chain, RunOptions(columns=choose_columns(chain)))
    begin = time.perf_counter()
    result = run_batch([job], BatchOptions(folder, jobs=jobs, overwrite=True))
    seconds = time.perf_counter() - begin
    for outcome in result.outcomes:
        if outcome.error is not None:
            raise outcome.error
    timing = result.report.timing
    return {
        "seconds": seconds,
        "preparation": sum(timing.get(name, 0.0) for name in PREPARATION),
        "waveforms": result.report.count("waveforms"),
    }


def make_strip(scene: Scene, target: Path, pulses: int, seed: int) -> Path:
    """A strip of the scene; an existing one is replaced."""
    simulate_strip(scene, target, pulses=pulses, seed=seed, overwrite=True)
    return target


def time_start(repeats: int = 5) -> dict[str, Any]:
    """Seconds from calling `wavebatch --help` to its end."""
    command = [sys.executable, "-m", "wavebatch", "--help"]
    seconds = []
    for _ in range(repeats):
        begin = time.perf_counter()
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        seconds.append(time.perf_counter() - begin)
    return median_range(seconds)


def time_jobs(chain: Chain, strip: Path, folder: Path, jobs: Sequence[int], repeats: int) -> dict[int, dict[str, Any]]:
    """Seconds from file to file, without scan and survey, by number of jobs; they take turns."""
    seconds: dict[int, list[float]] = {number: [] for number in jobs}
    with Worker() as worker:
        for _ in range(repeats):
            for number in jobs:
                run = worker.call(run_file, chain, strip, folder, number)
                seconds[number].append(run["seconds"] - run["preparation"])
    return {number: median_range(values) for number, values in seconds.items()}


def measure_memory(chain: Chain, strip: Path, folder: Path) -> tuple[int | None, int]:
    """Most bytes in memory of a fresh process that takes the strip from file to file, and its waveforms."""
    with Worker() as worker:
        run = worker.call(run_file, chain, strip, folder, 1)
        return worker.call(peak_memory), int(run["waveforms"])
