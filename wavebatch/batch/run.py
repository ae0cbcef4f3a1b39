"""The loop of `wavebatch run`: all strips through a chain, with bounded memory, in order, despite failures.

`run_batch` is the entry point for the command line, the public API and the benchmark. What is checked before a run
stands after it: memory, outputs that would replace inputs, and the plan that --dry-run prints; it writes nothing.
Before you change it: a failure ends its strip only, and no half-written file may remain, even after Ctrl-C.
"""

from __future__ import annotations

import contextlib
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import BrokenExecutor
from dataclasses import asdict, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from wavebatch import __version__
from wavebatch.batch.counts import RunReport
from wavebatch.batch.job import StripJob, plan_layout
from wavebatch.batch.options import RunOptions
from wavebatch.batch.report_file import BATCH_SCHEMA, build_timing, cloud_path, report_path
from wavebatch.batch.strip_task import StripTask
from wavebatch.batch.workers.futures import WorkerDied
from wavebatch.batch.workers.processes import Workers, refuse_import
from wavebatch.core import interrupts
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.frozen import frozen
from wavebatch.files.disk.publish import protecting, refuse_input, remove_stale, reporting
from wavebatch.files.text_file import write_text
from wavebatch.kernels.library import load as load_kernels
from wavebatch.surveying.look import read_flight, surveys_agree
from wavebatch.surveying.systems.survey_result import SavedSurvey, Survey, format_survey, load_survey, parse_survey

if TYPE_CHECKING:
    from wavebatch.batch.workers.dask_cluster import Cluster


@frozen
class Outcome:
    """The end of one strip."""

    job: StripJob
    status: str
    """written, skipped (resume found the cloud up to date), incomplete (either, but packets are missing) or failed."""
    report: RunReport = field(default_factory=RunReport)
    error: BaseException | None = None
    survey: Survey | None = None
    """The strip's survey, where it was made for this strip alone in this run."""


@frozen
class BatchResult:
    """The end of a batch: the outcome of every strip, in the order of the jobs."""

    outcomes: tuple[Outcome, ...]
    seconds: float

    def __repr__(self) -> str:
        """One line, with the first failure: a prompt or a notebook prints it."""
        names = [outcome.status for outcome in self.outcomes]
        written = f"{names.count('written')} strip{'s' * (names.count('written') != 1)} written"
        others = ", ".join(f"{names.count(name)} {name}" for name in ("skipped", "incomplete", "failed"))
        error = next((f": {outcome.error}" for outcome in self.outcomes if outcome.error is not None), "")
        return f"BatchResult({written}, {others}{error})"

    @property
    def failed(self) -> int:
        """Number of strips without a cloud."""
        return sum(outcome.status == "failed" for outcome in self.outcomes)

    def raise_for_failures(self) -> None:
        """Raise InputError where a strip has no cloud: how many, and the first reason; nothing else."""
        errors = [outcome.error for outcome in self.outcomes if outcome.error is not None]
        if errors:
            others = f" ({len(errors)} of {len(self.outcomes)} strips have no cloud)" if len(self.outcomes) > 1 else ""
            raise InputError(f"{' '.join(str(errors[0]).split())}{others}") from errors[0]

    @property
    def report(self) -> RunReport:
        """The sum of the strips' reports."""
        return sum((outcome.report for outcome in self.outcomes), RunReport())

    @property
    def advice(self) -> str:
        """One line where the surveys of single strips agree so well that one of all would serve; else empty."""
        surveys = [outcome.survey for outcome in self.outcomes if outcome.survey is not None]
        if len(surveys) < len(self.outcomes) or not surveys_agree(surveys):
            return ""
        return (
            f"the surveys of the {len(surveys)} strips agree within their errors: --survey flight would survey them "
            "once, and give all of them the same pulse"
        )

    def to_json(self) -> dict[str, Any]:
        """Return the summary of the batch as plain values; all but `timing` is the same for every run."""
        report = self.report
        strips = []
        for outcome in self.outcomes:
            error = None if outcome.error is None else " ".join(str(outcome.error).split())
            found = outcome.report.to_json()
            parts = {name: found[name] for name in ("counts", "warnings")}
            strips.append({"strip": str(outcome.job.path), "status": outcome.status, "error": error, **parts})
        timing = {**build_timing(report), "elapsed_seconds": round(self.seconds, 3)}
        head = {"schema": BATCH_SCHEMA, "version": __version__, "strips": strips}
        advice = self.advice
        return {**head, **({"advice": advice} if advice else {}), **report.to_json(), "timing": timing}


def run_batch(
    jobs: Sequence[StripJob], options: RunOptions, on_event: Callable[[dict[str, Any]], None] | None = None
) -> BatchResult:
    """Write cloud and report of every strip; a strip that fails does not stop the others.

    Parameters
    ----------
    jobs : sequence of StripJob
    options : RunOptions
    on_event : callable, optional
        Called with a dictionary for each event; its key `event` is flight, worker (one that does not fit),
        start, unit, written, skipped, incomplete or failed.
        `again` in a failure means that the same cause was reported for another strip before. `strip` of the event
        flight is the file of the flight's survey.

    Returns
    -------
    BatchResult
        Failures of strips are in it, not raised.

    Raises
    ------
    ConfigError, InputError
        Before any work; InputError if the compiled kernels cannot be loaded, which each strip would report else.
    KeyboardInterrupt
        After temporary files were removed.
    """
    refuse_import()
    start = time.perf_counter()
    check_outputs(jobs, options)
    load_kernels()
    saved = load_flight(jobs, options)
    workers: Workers | Cluster = Workers(options.jobs)
    if options.scheduler is not None:
        files = sorted({file for job in jobs for file in job.files})
        from wavebatch.batch.workers.dask_cluster import Cluster  # 10 ms that other runs do not need

        workers = Cluster(options.scheduler, options.folder, files)
    with protecting(list_read_files(jobs)), workers:
        with reporting(options.folder):
            options.folder.mkdir(parents=True, exist_ok=True)
        remove_stale(options.folder)
        if any(job.request.flight for job in jobs):
            jobs = with_flight(jobs, saved or _survey_flight(jobs, options, workers, on_event))
        with contextlib.closing(_Batch(jobs, options, workers, on_event)) as batch:
            batch.run()
        result = BatchResult(tuple(batch.outcomes[job.path] for job in jobs), time.perf_counter() - start)
        if saved is None and result.failed == len(jobs) and not any(options.folder.glob("*.report.json")):
            # No cloud was written: the next run, perhaps of other strips, would use the survey of this flight.
            with contextlib.suppress(OSError):
                (options.folder / FLIGHT_FILE).unlink(missing_ok=True)
    return result


def _survey_flight(
    jobs: Sequence[StripJob],
    options: RunOptions,
    workers: Workers | Cluster,
    on_event: Callable[[dict[str, Any]], None] | None,
) -> SavedSurvey | None:
    """Survey all strips together and keep the result; None where no strip can be read: each fails in its turn."""
    from wavebatch.surveying.flight import read_samples, survey_flight

    first = jobs[0].options
    paths = [job.path for job in jobs]
    samples = read_samples(paths, direction=first.direction, headerless=first.headerless, spread=workers.map)
    if not samples:
        return None
    path = options.folder / FLIGHT_FILE
    flight = survey_flight(samples, spread=workers.map)
    text = format_survey(flight.saved)
    saved = parse_survey(text, str(path))  # as a later run reads it, so that its identity is the same
    try:
        write_text(path, text, overwrite=options.overwrite)
    except InputError:
        # Another run into this folder was faster: its survey counts, so that all strips have the same one.
        found = load_flight(jobs, options)
        if found is None:
            raise
        return found
    if on_event is not None:
        on_event({"event": "flight", "strip": str(path), "strips": len(flight.strips) - len(flight.misfits)})
    return saved


class _Batch:
    """The loop: keeps the workers busy and takes the results of each strip in order; only a few may wait."""

    def __init__(
        self,
        jobs: Sequence[StripJob],
        options: RunOptions,
        workers: Workers | Cluster,
        on_event: Callable[[dict[str, Any]], None] | None,
    ) -> None:
        self.outcomes: dict[Path, Outcome] = {}
        self._waiting = deque(jobs)
        self._again: deque[StripJob] = deque()
        self._active: list[StripTask] = []
        self._options = options
        self._workers = workers
        self._tell = on_event or (lambda event: None)

    def run(self) -> None:
        """Work until every strip has an outcome."""
        while True:
            while sum(len(strip.pending) for strip in self._active) < self._workers.limit:
                strip = next((strip for strip in self._active if strip.has_more), None) or self._start_next()
                if strip is None:
                    break
                with self._failing(strip):
                    strip.submit(self._workers)
            if not self._active:
                break
            interrupts.check()
            heads = {strip.pending[0]: strip for strip in self._active if strip.pending}
            try:
                done = self._workers.wait(heads)
            except BrokenExecutor as error:
                self._give_up(error)
            else:
                for future in done:
                    self._take(heads[future])

    def close(self) -> None:
        """Remove what unfinished strips have left."""
        for strip in self._active:
            strip.drop()
        self._active.clear()

    def _start_next(self) -> StripTask | None:
        """Start the next strip that needs work; None where no other strip may start now."""
        while not (self._active and (self._again or not self._waiting or self._active[0].alone)):
            alone = bool(self._again)
            queue = self._again or self._waiting
            if not queue:
                return None
            if alone:
                self._workers.restart()  # nothing else shall need memory
            strip = StripTask(queue.popleft(), self._options, alone)
            self._active.append(strip)
            with self._failing(strip):
                strip.claim()
                report = strip.start(self._workers.jobs)
                self._tell({"event": "start", "strip": str(strip.job.path), "outdated": strip.outdated})
                if report is None:
                    return strip
                self._end(strip, Outcome(strip.job, "incomplete" if report.is_incomplete else "skipped", report))
        return None

    def _take(self, strip: StripTask) -> None:
        if strip not in self._active:
            return
        with self._failing(strip):
            before = strip.written
            strip.take()
            if strip.written > before:
                done, units = strip.written, strip.ready.units
                self._tell({"event": "unit", "strip": str(strip.job.path), "done": done, "of": units})
            if strip.is_complete:
                report = strip.finish()
                survey = strip.ready.choice.survey if strip.job.request.system is None else None
                status = "incomplete" if report.is_incomplete else "written"
                self._end(strip, Outcome(strip.job, status, report, survey=survey))

    @contextlib.contextmanager
    def _failing(self, strip: StripTask) -> Iterator[None]:
        """An error inside ends this strip only."""
        try:
            yield
        except WorkerDied:
            # It is tried once more, alone, because several strips may need too much memory.
            strip.drop()
            if strip.alone:
                lost = InputError(
                    f"{strip.job.path}: a worker process died while it worked on this strip (killed, or out of "
                    "memory), also when it was tried again alone; run again with --resume and fewer --jobs or less "
                    "--memory"
                )
                self._end(strip, Outcome(strip.job, "failed", error=lost))
            else:
                self._active.remove(strip)
                self._again.append(strip.job)
        except BrokenExecutor as error:
            self._give_up(error)
        except Exception as error:
            interrupts.check()  # it may come from an interrupt that compiled code has turned into an error
            strip.drop()
            self._end(strip, Outcome(strip.job, "failed", error=error))

    def _give_up(self, reason: BrokenExecutor) -> None:
        """No worker is left: all strips that are not written fail, for one reason that is reported once."""
        unfinished = [*self._active, *(StripTask(job, self._options, False) for job in (*self._again, *self._waiting))]
        self._again.clear()
        self._waiting.clear()
        error = InputError(f"{reason} ({len(unfinished)} of {len(unfinished) + len(self.outcomes)} strips are missing)")
        for strip in unfinished:
            strip.drop()
            self._end(strip, Outcome(strip.job, "failed", error=error), again=strip is not unfinished[0])

    def _end(self, strip: StripTask, outcome: Outcome, *, again: bool = False) -> None:
        strip.release()
        if strip in self._active:
            self._active.remove(strip)
        self.outcomes[outcome.job.path] = outcome
        event = {"event": outcome.status, "strip": str(outcome.job.path)}
        if outcome.error is not None:
            self._tell({**event, "error": outcome.error, "again": again})
        else:
            report = outcome.report.to_json()
            more = {name: report[name] for name in ("counts", "remarks", "warnings")}
            if strip.prepared is not None:
                more["sensor"] = strip.prepared.sensor.describe()
                more["decisions"] = [asdict(decision) for decision in strip.prepared.choice.decisions]
            self._tell({**event, **more})


LEAST_MEMORY = 350 << 20
"""Bytes that one process needs with the smallest blocks: 320 MB for the survey of a strip of noise."""

FULL_MEMORY = 500 << 20
"""Bytes that one process takes with full blocks."""

SMALL_BLOCK = 1024
"""Waveforms of a block when memory is short."""


def plan_memory(options_jobs: int, memory: int | None) -> tuple[int, int | None]:
    """Choose number of processes and block size so that a run stays within a memory limit.

    Parameters
    ----------
    options_jobs : int
        Processes that the user asks for.
    memory : int or None
        Bytes for all processes together; with several, the one that writes counts too. None: no limit.

    Returns
    -------
    jobs : int
    block_size : int or None
        Waveforms; None for the usual size.

    Raises
    ------
    ConfigError
        Where not even one process fits.
    """
    if memory is None:
        return options_jobs, None
    if memory < LEAST_MEMORY:
        given = f"{memory >> 20} MB" if memory >> 20 else f"{memory} bytes"
        raise ConfigError(
            f"--memory: {given} is too little, one job needs {LEAST_MEMORY >> 20} MB; write for example 500M or 4G"
        )
    processes = max(min(memory // LEAST_MEMORY, options_jobs + (options_jobs > 1)), 1)
    jobs = max(processes - 1, 1) if options_jobs > 1 else 1
    processes = jobs + (jobs > 1)
    return jobs, SMALL_BLOCK if memory // processes < FULL_MEMORY else None


def check_outputs(jobs: Sequence[StripJob], options: RunOptions) -> None:
    """Raise ConfigError where an output would replace an input."""
    with protecting(list_read_files(jobs)):
        for job in jobs:
            for target in find_outputs(job, options.folder):
                refuse_input(target)


def list_read_files(jobs: Sequence[StripJob]) -> list[Path]:
    """Return the files that the jobs read, also those that are read already: no output may replace them."""
    read = {Path(job.selection.polygon_file["file"]) for job in jobs if job.selection.polygon_file is not None}
    return sorted(read.union(*(job.files for job in jobs)))


def find_outputs(job: StripJob, folder: Path) -> list[Path]:
    """Return the files that the job may write."""
    cloud = cloud_path(job, folder)
    packets = [cloud.with_suffix(".wdp")] if job.options.keep_packets else []
    flight = [folder / FLIGHT_FILE] if job.request.flight else []
    return [cloud, report_path(job, folder), *packets, *flight]


FLIGHT_FILE = "flight.system.toml"
"""The survey of a flight, in the folder of its clouds."""


def load_flight(jobs: Sequence[StripJob], options: RunOptions) -> SavedSurvey | None:
    """Load the survey of a flight that an earlier run has kept.

    Parameters
    ----------
    jobs : sequence of StripJob
    options : RunOptions

    Returns
    -------
    SavedSurvey or None
        None where the jobs want none, where there is none yet, and where `overwrite` asks for a new one.

    Raises
    ------
    ConfigError
        Where the file cannot be read or holds no survey of a flight.
    """
    path = options.folder / FLIGHT_FILE
    if options.overwrite or not any(job.request.flight for job in jobs) or not os.path.lexists(path):
        return None
    try:
        saved = load_survey(path)
        read_flight(saved.survey)
    except ConfigError as error:
        words = str(error).removeprefix(f"{path}: ")
        raise ConfigError(f"{path}: {words}; remove it: then the strips are surveyed again") from error
    return saved


def with_flight(jobs: Sequence[StripJob], saved: SavedSurvey | None) -> list[StripJob]:
    """Return the jobs with the survey of their flight."""
    return [replace(job, request=replace(job.request, system=saved)) if job.request.flight else job for job in jobs]


def plan_strip(job: StripJob, options: RunOptions) -> dict[str, Any]:
    """Describe what `run_batch` would do with a strip, from its headers alone.

    Parameters
    ----------
    job : StripJob
    options : RunOptions

    Returns
    -------
    dict
        Plain values: action (write or skip), strip, output, columns, points, sizes.

    Raises
    ------
    InputError, ConfigError
        Where the run would refuse the strip before it begins.
    """
    (job,) = with_flight([job], load_flight([job], options))
    task = StripTask(job, options, alone=False)
    done = task.start(jobs=1) is not None
    facts = task.facts
    layout, is_laz = plan_layout(job, facts), job.options.format == "laz"
    return {
        "action": "skip" if done else "write",
        "strip": str(job.path),
        "points": facts.header.point_count,
        "point_format": facts.header.point_format,
        "packet_bytes": facts.packets.end - facts.packets.start,
        "output": str(cloud_path(job, options.folder)),
        "output_point_format": layout.point_format,
        "columns": [written.record.name for written in layout.written],
        # LAZ takes about two fifths of LAS.
        "estimated_bytes": math.ceil(facts.header.point_count * layout.dtype.itemsize * (0.4 if is_laz else 1.0)),
    }
