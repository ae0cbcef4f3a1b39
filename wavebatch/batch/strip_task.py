"""One strip on its way through a batch: prepared, processed by the workers, written here in order, published.

`run` drives it: `start`, then `submit` and `take` until `is_complete`, then `finish`; `drop` after a failure.
Before you change it: results are taken in the order in which they were submitted; that makes the output reproducible.
"""

from __future__ import annotations

import contextlib
import os
import pickle
from collections import deque
from concurrent.futures import Future
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from wavebatch.batch import report_file
from wavebatch.batch.counts import RunReport
from wavebatch.batch.explain import find_remarks, find_warnings
from wavebatch.batch.job import StripJob
from wavebatch.batch.options import RunOptions
from wavebatch.batch.unit import Prepared, prepare_strip, process_unit
from wavebatch.batch.workers.processes import Workers
from wavebatch.core.errors import InputError, StageError
from wavebatch.core.process import Seconds
from wavebatch.files.cloud.writer import CloudWriter
from wavebatch.files.disk.fingerprint import take_fingerprint
from wavebatch.files.disk.publish import Claim, check_target
from wavebatch.files.strip.facts import StripFacts
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
        Whether no other strip may be under way: it is tried again after a worker process died.
    """

    facts: StripFacts
    """From `start` on."""

    def __init__(self, job: StripJob, options: RunOptions, alone: bool) -> None:
        self.job = job
        self.alone = alone
        self.pending: deque[Future] = deque()
        self.prepared: Prepared | None = None
        self.written = 0
        self._options = options
        self._submitted = 0
        self._blob = b""
        self._claim: Claim | None = None
        self._writer: CloudWriter | None = None
        self._second: SecondPass | None = None
        self._report = RunReport()
        self._described: dict[str, Any] = {}
        self._files: list[Path] = []
        self._state: list[tuple[int, int]] = []

    def claim(self) -> None:
        """Keep other runs from making these outputs until the end; raises InputError while another one makes them."""
        folder = self._options.folder
        self._claim = Claim(folder, self.job.path.stem)

    def release(self) -> None:
        """Let other runs make these outputs; may be called twice."""
        if self._claim is not None:
            self._claim.discard()
            self._claim = None

    def start(self) -> RunReport | None:
        """Look at strip and outputs before any work.

        Returns
        -------
        RunReport or None
            The report of the existing cloud, where resume finds it up to date.

        Raises
        ------
        InputError
            Where the strip cannot be read, or its outputs exist and may not be replaced.
        """
        options, job = self._options, self.job
        with job.open() as reader:
            self.facts = reader.facts
        packet_file = self.facts.packets.file
        self._files = [job.path] + ([packet_file] if packet_file not in (None, job.path) else [])
        self._state = self._stat()
        self._described = report_file.describe_job(job, take_fingerprint(job.path, packet_file))
        if options.resume and (report := report_file.read_current(job, options.folder, self._described)) is not None:
            return report
        self._check_targets()
        return None

    def _check_targets(self) -> None:
        options = self._options
        for target in (report_file.cloud_path, report_file.report_path):
            check_target(target(self.job, options.folder), overwrite=options.overwrite or options.resume)

    @property
    def ready(self) -> Prepared:
        """What the preparation found; it must have ended."""
        return _given(self.prepared)

    @property
    def has_more(self) -> bool:
        """Whether there is a call to submit now."""
        if self.prepared is None:
            return not self.pending
        if self._submitted < self.prepared.units:
            return True
        return self._second is not None and self._second.has_more

    @property
    def is_complete(self) -> bool:
        """Whether all units are done, also by a second pass."""
        if self.prepared is None or self.written < self.prepared.units:
            return False
        return self._second is None or self._second.is_complete

    def submit(self, workers: Workers | Cluster) -> None:
        """Submit the next call: the preparation, then unit by unit, then those of a second pass."""
        if self.prepared is None:
            self.pending.append(workers.submit(prepare_strip, self.job.absolute() if workers.is_remote else self.job))
            return
        if self._submitted == self.prepared.units:
            function, arguments = _given(self._second).next_call(self._blob)
            self.pending.append(workers.submit(function, *arguments))
            return
        function = process_unit
        if self._second is not None:
            from wavebatch.batch.neighbour_pass import begin_unit as function
        self.pending.append(workers.submit(function, self._blob, self._submitted, self._options.block_size))
        self._submitted += 1

    def take(self, workers: Workers | Cluster) -> None:
        """Use the oldest result: open the output, or write rows."""
        result = self.pending.popleft().result()
        start = Seconds.now()
        if self.prepared is None:
            self.prepared = result
            self._report += result.report
            self._open(result, workers.jobs)
        elif self.written == self.prepared.units:
            rows, report = _given(self._second).take(result)
            if rows is not None:
                _given(self._writer).write(rows)
            self._report += report
        else:
            rows, report = result
            if self._second is None:
                _given(self._writer).write(rows)
            else:
                self._second.add(*rows)
            self.written += 1
            self._report += report + RunReport(timing={"write": Seconds.now() - start})
        if self.written == self.ready.units and self._second is not None:
            self._report += self._second.cut()

    def _open(self, prepared: Prepared, threads: int) -> None:
        options = self._options
        self._blob = pickle.dumps(prepared, pickle.HIGHEST_PROTOCOL)
        command = self.job.options.command(self.job.path.name)
        provenance = {**self._described, "command": command, **report_file.describe_chain(prepared)}
        provenance |= report_file.describe_strip_result(prepared, self._described)
        cloud, overwrite = report_file.cloud_path(self.job, options.folder), options.overwrite or options.resume
        self._writer = CloudWriter(prepared.layout, cloud, provenance=provenance, overwrite=overwrite, threads=threads)
        if prepared.second_step is not None:
            from wavebatch.batch.neighbour_pass import SecondPass  # 20 ms that other runs do not need

            self._second = SecondPass(prepared.second_step, prepared.layout.source.header.scales, cloud)

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
        self._report += RunReport(remarks=(*_name_stranger(prepared), *find_remarks(prepared, self._report)))
        if self._stat() != self._state:
            raise InputError(f"{job.path}: changed while it was read; run it again once it is complete")
        cloud = report_file.cloud_path(job, options.folder)
        report = report_file.report_path(job, options.folder)
        replaces = options.overwrite or options.resume
        size = writer.complete()
        self._report += RunReport(timing={"publish": Seconds.now() - start})
        warnings = find_warnings(prepared, self._report, writer.dropped)
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
            if not future.cancel() and self.prepared is None:
                future.add_done_callback(_close_scan)
        self.pending.clear()
        if self._writer is not None:
            self._writer.abort()
        self._close()
        self.release()

    def _close(self) -> None:
        """Remove temporary files."""
        if self._second is not None:
            self._second.close()
        if self.prepared is not None:
            self.prepared.scan.close()

    def _stat(self) -> list[tuple[int, int]]:
        """Size and time of the input files, to see whether they change during the run."""
        stats = [os.stat(path) for path in self._files]
        return [(stat.st_size, stat.st_mtime_ns) for stat in stats]


def _given(value: T | None) -> T:
    """The value of a step that has been done."""
    if value is None:
        raise StageError("a step of the strip was called too early; please report it as a bug")
    return value


def _name_stranger(prepared: Prepared) -> tuple[str, ...]:
    """The line about a strip that does not belong to its flight."""
    if not prepared.stranger:
        return ()
    return (f"does not belong to the flight that was surveyed: {prepared.stranger}; it was surveyed alone",)


def _close_scan(future: Future) -> None:
    """A preparation that ends after its strip was dropped leaves a scan with temporary files."""
    with contextlib.suppress(Exception):
        future.result().scan.close()
