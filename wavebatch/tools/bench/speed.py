"""Run time and memory of chains: kernels alone and from file to file, each chain in a process with one thread.

`command` calls `time_chains`. The chains take turns, so that other load of the machine slows all of them alike. The
process of a Worker is a plain one, not of multiprocessing, which would import the caller's main module into it.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import re
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from wavebatch.batch.job import StripJob, choose_columns
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.core.errors import StageError
from wavebatch.core.process import CHILD, Seconds
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.disk.raw_bytes import Closing
from wavebatch.stages.chain import Chain

_START = "from wavebatch.tools.bench.speed import serve; serve()"


class BenchWorkerDied(Exception):
    """The process ended before it answered."""


class Worker(Closing):
    """Runs functions in another Python process, one after another; a context manager."""

    def __init__(self) -> None:
        path = [str(Path(__file__).resolve().parents[3]), *filter(None, [os.environ.get("PYTHONPATH")]), *sys.path]
        environment = {**os.environ, **CHILD, "PYTHONPATH": os.pathsep.join(path)}
        self._process = subprocess.Popen(
            [sys.executable, "-c", _START], stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=environment
        )

    def call(self, function: Callable, *arguments: Any) -> Any:
        """`function(*arguments)` computed in the process; the function must be importable by name.

        Raises WorkerDied, or whatever the function raised. A caller that cannot wait uses a thread: `close` ends it.
        """
        try:
            pickle.dump((function, arguments), self._process.stdin, pickle.HIGHEST_PROTOCOL)
            self._process.stdin.flush()
            kind, value = pickle.load(self._process.stdout)
        except (EOFError, OSError, ValueError, pickle.UnpicklingError):
            raise BenchWorkerDied("the measuring process ended") from None
        if kind == "raised":
            raise value
        return value

    def close(self) -> None:
        """Kills the process."""
        self._process.kill()
        self._process.wait()
        with contextlib.suppress(OSError):  # what a call had not sent yet
            self._process.stdin.close()
        self._process.stdout.close()


def serve() -> None:
    """Answers calls on stdin until stdin ends; other output to stdout is sent to stderr."""
    from wavebatch.core.process import keep_freed_memory

    keep_freed_memory()
    replies = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    while True:
        try:
            function, arguments = pickle.load(sys.stdin.buffer)
        except EOFError:
            return
        try:
            answer = ("value", function(*arguments))
        except Exception as error:
            answer = ("raised", StageError(f"{type(error).__name__}: {error}"))
        pickle.dump(answer, replies, pickle.HIGHEST_PROTOCOL)
        replies.flush()


def peak_memory() -> int | None:
    """Peak memory of this process [bytes]; None where the system does not report it."""
    try:
        lines = Path("/proc/self/status").read_text("ascii").splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
    except (OSError, StopIteration):
        pass
    try:
        import resource
    except ImportError:
        return None
    most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return most if sys.platform == "darwin" else most * 1024


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
                    run, lap = workers[name].call(run_file, chain, strip, clouds, 1), laps[name]
                    lap.file.append(1e6 * (run.seconds - run.survey_seconds) / run.waveforms)
                    lap.file_with_survey.append(1e6 * run.seconds / run.waveforms)
                    lap.survey_seconds.append(run.survey_seconds)
        for name, worker in workers.items():
            laps[name].peak_bytes = worker.call(peak_memory)
    finally:
        for worker in workers.values():
            worker.close()
    return laps


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
