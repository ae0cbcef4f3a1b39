"""One strip on its way through a batch: prepared, processed by the workers, written here in order, published.

`run` drives it: `start`, then `submit` and `take` until `is_complete`, then `finish`; `drop` after a failure.
Before you change it: results are taken in the order in which they were submitted; that makes the output reproducible.
"""

from __future__ import annotations

import contextlib
import os
import pickle
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from wavebatch.batch import report_file
from wavebatch.batch.counts import RunReport
from wavebatch.batch.job import StripJob, plan_filter, plan_layout
from wavebatch.batch.options import RunOptions
from wavebatch.batch.unit import Packing, Prepared, UnitResult, pack_chunk, prepare_strip, process_unit, scan_run
from wavebatch.batch.workers.processes import Workers
from wavebatch.core.errors import InputError, StageError
from wavebatch.core.process import Seconds
from wavebatch.files.cloud.writer import CloudWriter
from wavebatch.files.disk.publish import Claim, check_target
from wavebatch.files.disk.raw_bytes import Closing, take_fingerprint
from wavebatch.files.las.write_points import Chunk
from wavebatch.files.strip.packets import StripFacts
from wavebatch.files.strip.scanner import ScanPart
from wavebatch.files.text_file import draft_text

if TYPE_CHECKING:
    from wavebatch.batch.neighbour_pass import SecondPass
    from wavebatch.batch.workers.dask_cluster import Cluster

T = TypeVar("T")


class StripTask:
    """The work on one strip.

    Parameters
    ----------
    job : StripJob
    options : RunOptions
    alone : bool
        Whether it runs while no other strip does: a worker process died of it, and it is tried once more.
    """

    facts: StripFacts
    """From `start` on."""

    def __init__(self, job: StripJob, options: RunOptions, alone: bool) -> None:
        self.job = job
        self.alone = alone
        self.pending: deque[Future] = deque()
        self._takers: deque[Callable[[Any], None]] = deque()
        """Methods that take the results of `pending`, in its order."""
        self.prepared: Prepared | None = None
        self.written = 0
        """Units whose results were taken."""
        self.outdated = ""
        """Why a cloud that has a report is made again."""
        self._options = options
        self._submitted = 0
        """Units that were submitted."""
        self._blob = b""
        self._claim: Claim | None = None
        self._writer: CloudWriter | None = None
        self._second: SecondPass | None = None
        self._runs: deque[tuple[int, int]] = deque()
        """Units that several processes scan, not yet submitted; empty where one process scans the strip."""
        self._scanned: list[ScanPart] = []
        """What these have found so far."""
        self._packing = Packing()
        self._report = RunReport()
        self._described: dict[str, Any] = {}
        self._files: list[Path] = []
        self._state: list[tuple[int, int]] = []
        """Size and time of these files when the work began."""

    def claim(self) -> None:
        """Keep other runs from making these outputs until the end; raises InputError while another one makes them."""
        folder = self._options.folder
        self._claim = Claim(folder, self.job.path.stem)

    def release(self) -> None:
        """Let other runs make these outputs; may be called twice."""
        if self._claim is not None:
            self._claim.discard()
            self._claim = None

    def start(self, jobs: int) -> RunReport | None:
        """Look at strip and outputs before any work; up to `jobs` processes will scan the strip.

        Returns
        -------
        RunReport or None
            The report of the existing cloud, where resume finds it up to date.

        Raises
        ------
        InputError
            Where the strip cannot be read, or its outputs exist and may not be replaced.
        ConfigError
            Where columns, format or --where do not fit the strip.
        """
        options, job = self._options, self.job
        with job.open() as reader:
            self.facts = reader.facts
            runs = reader.cut_scan(jobs)
            self._runs = deque(runs if len(runs) > 1 else ())
        packet_file = self.facts.packets.file
        self._files = [job.path] + ([packet_file] if packet_file not in (None, job.path) else [])
        self._state = self._stat()
        self._described = report_file.describe_job(job, take_fingerprint(job.path, packet_file))
        if options.resume:
            report, self.outdated = report_file.read_current(job, options.folder, self._described)
            if report is not None:
                return report
        plan_filter(job, plan_layout(job, self.facts))  # a wrong option is named before outputs that exist
        for target in (report_file.cloud_path, report_file.report_path):
            check_target(target(job, options.folder), overwrite=options.overwrite or options.resume)
        return None

    @property
    def ready(self) -> Prepared:
        """What the preparation found; it must have ended."""
        return _given(self.prepared)

    @property
    def has_more(self) -> bool:
        """Whether there is a call to submit now."""
        if self.prepared is None:
            return bool(self._runs) or not self.pending
        if self._submitted < self.prepared.units or self._packing.has_chunk(last=self._has_all_rows):
            return True
        return self._second is not None and self._second.has_more

    @property
    def is_complete(self) -> bool:
        """Whether all units are done, also by a second pass, and all rows are written."""
        return self.prepared is not None and self._has_all_rows and self._packing.is_empty

    @property
    def _has_all_rows(self) -> bool:
        return self.written == self.ready.units and (self._second is None or self._second.is_complete)

    def submit(self, workers: Workers | Cluster) -> None:
        """Submit the next call: scan, preparation, then chunks of rows and units, and those of a second pass."""
        if self.prepared is None:
            job = self.job.absolute() if workers.is_remote else self.job
            if self._runs:
                self._call(workers, self._take_scanned, scan_run, job, *self._runs.popleft())
            else:
                self._call(workers, self._take_prepared, prepare_strip, job, self._scanned)
        elif self._packing.has_chunk(last=self._has_all_rows):
            rows, point_format = self._packing.next_chunk(), self.prepared.layout.point_format
            self._call(workers, self._take_chunk, pack_chunk, self.job.path, rows, point_format)
        elif self._submitted < self.prepared.units:
            arguments = self._blob, self._submitted, self._options.block_size
            if self._second is None:
                self._call(workers, self._take_rows, process_unit, *arguments)
            else:
                from wavebatch.batch.neighbour_pass import begin_unit

                self._call(workers, self._take_begun, begin_unit, *arguments)
            self._submitted += 1
        else:
            function, arguments = _given(self._second).next_call(self._blob)
            self._call(workers, self._take_rows, function, *arguments)

    def _call(self, workers: Workers | Cluster, take: Callable[[Any], None], function: Callable, *given: Any) -> None:
        self.pending.append(workers.submit(function, *given))
        self._takers.append(take)

    def take(self) -> None:
        """Use the oldest result: open the output, keep rows for a chunk, or write one."""
        self._takers.popleft()(self.pending.popleft().result())
        if self._second is not None and self.written == self.ready.units:
            self._report += self._second.cut()

    def _take_scanned(self, scanned: tuple[ScanPart, Seconds]) -> None:
        part, took = scanned
        self._scanned.append(part)
        self._report += RunReport(timing={"scan": took})

    def _take_prepared(self, prepared: Prepared) -> None:
        self.prepared = prepared
        self._scanned = []
        self._report += prepared.report
        options = self._options
        self._blob = pickle.dumps(prepared, pickle.HIGHEST_PROTOCOL)
        command = self.job.options.command(self.job.path.name)
        provenance = {**self._described, "command": command, **report_file.describe_chain(prepared)}
        provenance |= report_file.describe_strip_result(prepared, self._described)
        cloud, overwrite = report_file.cloud_path(self.job, options.folder), options.overwrite or options.resume
        self._writer = CloudWriter(prepared.layout, cloud, provenance=provenance, overwrite=overwrite)
        if prepared.second_step is not None:
            from wavebatch.batch.neighbour_pass import SecondPass  # 20 ms that other runs do not need

            self._second = SecondPass(prepared.second_step, prepared.layout.source.header.scales, cloud)

    def _take_begun(self, begun: tuple[tuple[np.ndarray, np.ndarray], RunReport]) -> None:
        start = Seconds.now()
        entries, report = begun
        _given(self._second).add(*entries)
        self.written += 1
        self._report += report + RunReport(timing={"write": Seconds.now() - start})

    def _take_rows(self, made: Any) -> None:
        """Rows of LAS are written at once, those of LAZ wait to fill a chunk. A second pass keeps its results."""
        if self._second is None:
            self.written += 1
        else:
            made = self._second.take(made)
        if not isinstance(made, UnitResult):
            self._report += made
            return
        start, writer = Seconds.now(), _given(self._writer)
        writer.statistics.join(made.statistics)
        for chunk in made.chunks:
            writer.append(chunk)
        if self.job.options.format == "laz":
            self._packing.add(made.rows)
        else:
            rows = made.rows.read(0)
            writer.append(Chunk(len(rows), rows.view(np.uint8)))
            made.rows.close()
        self._report += made.report + RunReport(timing={"write": Seconds.now() - start})

    def _take_chunk(self, packed: tuple[Chunk, Seconds]) -> None:
        start = Seconds.now()
        chunk, took = packed
        _given(self._writer).append(chunk)
        self._packing.end_chunk()
        self._report += RunReport(timing={"write": took + (Seconds.now() - start)})

    def finish(self) -> RunReport:
        """Publish the cloud, then its report, which means that the cloud is complete; both or none.

        Returns
        -------
        RunReport
            Of the whole strip.

        Raises
        ------
        InputError
            Where the strip has changed since `start`.
        StageError
            Where counts do not add up.
        """
        options, job, prepared, writer = self._options, self.job, self.ready, _given(self._writer)
        start = Seconds.now()
        self._report.check(job.options.points, str(job.path))
        remarks, missed = report_file.find_remarks(prepared, self._report)
        if prepared.stranger:
            words = "does not belong to the flight that was surveyed"
            remarks = (f"{words}: {prepared.stranger}; it was surveyed alone", *remarks)
        self._report += RunReport(remarks=remarks)
        if self._stat() != self._state:
            raise InputError(f"{job.path}: changed while it was read; run it again once it is complete")
        cloud = report_file.cloud_path(job, options.folder)
        report = report_file.report_path(job, options.folder)
        replaces = options.overwrite or options.resume
        size = writer.complete()
        self._report += RunReport(timing={"publish": Seconds.now() - start})
        warnings = report_file.find_warnings(prepared, self._report, missed, writer.dropped)
        self._report = replace(self._report, warnings=warnings)
        document = report_file.build_document(prepared, self._described, self._report, cloud, size)
        draft = draft_text(report, report_file.format_report(document), overwrite=replaces)
        try:
            if replaces:
                report.unlink(missing_ok=True)  # before the new cloud: an old report must not vouch for it
            writer.publish(draft)
        finally:
            draft.discard()
        self._close()
        return self._report

    def drop(self) -> None:
        """Give the strip up: remove its files and cancel its calls."""
        for future in self.pending:
            if not future.cancel():
                future.add_done_callback(_close_result)
        self.pending.clear()
        if self._writer is not None:
            self._writer.abort()
        self._close()
        self.release()

    def _close(self) -> None:
        """Remove temporary files."""
        for one in (*self._scanned, self._packing, self._second, None if self.prepared is None else self.prepared.scan):
            if one is not None:
                one.close()

    def _stat(self) -> list[tuple[int, int]]:
        """Size and time of the input files, to see whether they change during the run."""
        stats = [os.stat(path) for path in self._files]
        return [(stat.st_size, stat.st_mtime_ns) for stat in stats]


def _given(value: T | None) -> T:
    """The value of a step that has been done."""
    if value is None:
        raise StageError("a step of the strip was called too early; please report it as a bug")
    return value


def _close_result(future: Future) -> None:
    """A call that ends after its strip was dropped may leave temporary files: of the scan, or of rows."""
    with contextlib.suppress(Exception):
        result = future.result()
        for one in (result.scan,) if isinstance(result, Prepared) else result:
            if isinstance(one, Closing):
                one.close()
