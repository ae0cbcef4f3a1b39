"""Run time and memory of chains: kernels alone and from file to file, each chain in a process with one thread.

`command` calls `time_chains`. The chains take turns, so that other load of the
machine slows all of them alike.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from wavebatch.batch.job import StripJob, choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.core.process import Seconds
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.stages.chain import Chain
from wavebatch.tools.bench.worker import Worker, peak_memory

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
    timing: dict[str, Seconds] = {}
    chain.run(block, system, timing)
    return sum(timing[step.stage.name].wall for step in chain.steps[:3])


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
    return FileRun(seconds, sum(timing[name].wall for name in PREPARATION), result.report.count("waveforms"))
