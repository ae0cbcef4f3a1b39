"""One strip on its way through a batch: prepared, its units processed anywhere and written here in order, published."""

from __future__ import annotations

import contextlib
import os
import pickle
import time
from collections import deque
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wavebatch.batch.counts import RunReport
from wavebatch.batch.dask_cluster import Cluster
from wavebatch.batch.explain import find_remarks
from wavebatch.batch.neighbour_pass import SecondPass, process_tile
from wavebatch.batch.processes import Workers
from wavebatch.batch.report_file import (
    build_document,
    cloud_path,
    describe_chain,
    describe_job,
    describe_strip,
    read_current,
    report_path,
    write_json,
)
from wavebatch.batch.unit import Prepared, StripJob, prepare_strip, process_packed_unit
from wavebatch.core.errors import InputError
from wavebatch.files.cloud.writer import CloudWriter
from wavebatch.files.disk.fingerprint import take_fingerprint
from wavebatch.files.disk.publish import refuse_existing


@dataclass(frozen=True, slots=True)
class BatchOptions:
    """Options of a run that change how it goes, never what it writes."""

    folder: Path
    jobs: int = 1
    scheduler: str | None = None
    """Address of a dask cluster whose workers take the place of `jobs` processes."""
    block_size: int | None = None
    """Waveforms that go through a chain at a time; None chooses by their length."""
    overwrite: bool = False
    resume: bool = False


class StripTask:
    """A strip on its way: prepared, its units submitted and written in order, then published."""

    def __init__(self, job: StripJob, options: BatchOptions, alone: bool) -> None:
        self.job = job
        self.alone = alone
        self.pending: deque[Future] = deque()
        self.prepared: Prepared | None = None
        self.written = 0
        self.warnings: list[str] = []
        self._options = options
        self._submitted = 0
        self._blob = b""
        self._writer: CloudWriter | None = None
        self._second: SecondPass | None = None
        self._report = RunReport()
        self._described: dict[str, Any] = {}
        self._files: list[Path] = []
        self._state: list[tuple[int, int]] = []

    def start(self) -> RunReport | None:
        """The report where the strip is done already; InputError where it cannot be read or may not be written."""
        options, job = self._options, self.job
        with job.open() as reader:
            packet_file = reader.facts.packet_file
        self._files = [job.path] + ([packet_file] if packet_file not in (None, job.path) else [])
        self._state = self._stat()
        self._described = describe_job(job, take_fingerprint(job.path, packet_file))
        if options.resume:
            return read_current(job, options.folder, self._described)
        if not options.overwrite:
            refuse_existing(cloud_path(job, options.folder))
            refuse_existing(report_path(job, options.folder))
        return None

    @property
    def has_more(self) -> bool:
        """Whether something can be submitted now."""
        if self.prepared is None:
            return not self.pending
        if self._submitted < self.prepared.units:
            return True
        return self._second is not None and self._second.has_more

    @property
    def is_complete(self) -> bool:
        """Whether all units are written, and all tiles of a second pass are done."""
        if self.prepared is None or self.written < self.prepared.units:
            return False
        return self._second is None or self._second.is_complete

    def submit(self, workers: Workers | Cluster) -> None:
        """The next piece of work: the preparation, then unit by unit, then the tiles of a second pass."""
        if self.prepared is None:
            self.pending.append(workers.submit(prepare_strip, self.job.absolute() if workers.is_remote else self.job))
            return
        if self._submitted == self.prepared.units:
            self.pending.append(workers.submit(process_tile, *self._second.next_tile()))
            return
        arguments = (self._blob, self._submitted, self._options.block_size)
        self.pending.append(workers.submit(process_packed_unit, *arguments))
        self._submitted += 1

    def take(self) -> None:
        """Takes the oldest result: opens the output, or writes rows to it."""
        result = self.pending.popleft().result()
        start = time.perf_counter()
        if self.prepared is None:
            self.prepared = result
            self._report += result.report
            self._open()
        elif self.written == self.prepared.units:
            self._report += self._second.take(result)
            return
        else:
            rows, report = result
            (self._writer.write if self._second is None else self._second.add)(rows)
            self.written += 1
            self._report += report + RunReport(timing={"write": time.perf_counter() - start})
        if self._second is not None and self.written == self.prepared.units:
            self._report += self._second.cut()

    def _open(self) -> None:
        options, prepared = self._options, self.prepared
        self._blob = pickle.dumps(prepared, pickle.HIGHEST_PROTOCOL)
        described = self._described
        provenance = {**described, **describe_chain(prepared), **describe_strip(prepared, described)}
        self._writer = CloudWriter(
            prepared.layout,
            cloud_path(self.job, options.folder),
            provenance=provenance,
            overwrite=options.overwrite or options.resume,
        )
        if prepared.second_step is not None:
            self._second = SecondPass(prepared.second_step, prepared.layout, cloud_path(self.job, options.folder))

    def _fill(self) -> None:
        """Writes the rows that waited for a second pass."""
        start = time.perf_counter()
        for rows in self._second.rows():
            self._writer.write(rows)
        self._second.close()
        no_data = self._second.count_reasons(self._report.count("echoes"))
        self._report += RunReport(no_data=no_data, timing={"write": time.perf_counter() - start})

    def finish(self) -> RunReport:
        """Publishes the cloud, then its report, which says that the cloud is complete."""
        options, job = self._options, self.job
        if self._second is not None:
            self._fill()
        start = time.perf_counter()
        self._report.check(job.options.points, str(job.path))
        self._report += RunReport(remarks=find_remarks(self.prepared, self._report))
        if self._stat() != self._state:
            raise InputError(f"{job.path}: changed while it was read; run it again once it is complete")
        cloud, beside = cloud_path(job, options.folder), report_path(job, options.folder)
        replaces = options.overwrite or options.resume
        if replaces:
            beside.unlink(missing_ok=True)
        self._writer.commit()
        self._report += RunReport(timing={"publish": time.perf_counter() - start})
        document = build_document(self.prepared, self._described, self._report, cloud, self._writer.dropped)
        write_json(beside, document, overwrite=replaces)
        self.warnings = document["warnings"]
        self.prepared.scan.close()
        return self._report

    def drop(self) -> None:
        """Forgets the strip: nothing of it remains on disk or under way."""
        for future in self.pending:
            if not future.cancel() and self.prepared is None:
                future.add_done_callback(_close_scan)
        self.pending.clear()
        if self._writer is not None:
            self._writer.abort()
        if self._second is not None:
            self._second.close()
        if self.prepared is not None:
            self.prepared.scan.close()

    def _stat(self) -> list[tuple[int, int]]:
        stats = [os.stat(path) for path in self._files]
        return [(stat.st_size, stat.st_mtime_ns) for stat in stats]


def _close_scan(future: Future) -> None:
    with contextlib.suppress(Exception):
        future.result().scan.close()
