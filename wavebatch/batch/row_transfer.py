"""The way of rows from the workers into a cloud: through memory that processes share, and as compressed chunks.

`strip_task` submits `process_unit_shared` and gives what it returns to a `RowStream`, which has workers compress LAZ
chunks; the process that writes only puts them one after another.
Before you change it: a chunk holds CHUNK_POINTS rows counted from the start of the cloud, wherever units end, so that
the bytes of a cloud do not depend on who compressed it.
"""

from __future__ import annotations

import contextlib
import pickle
import shutil
import tempfile
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path

from wavebatch.batch.counts import RunReport
from wavebatch.batch.unit import process_unit, unpack
from wavebatch.core.errors import InputError
from wavebatch.files.disk.shared_rows import Rows, discard_rows, join_rows, read_rows, share_rows
from wavebatch.files.las.laz_encode import CHUNK_POINTS
from wavebatch.files.las.write_points import ChunkMaker, PointFile, Statistics


def process_unit_shared(
    blob: bytes, number: int, block_size: int | None, folder: Path | None
) -> tuple[Rows, RunReport]:
    """Make the output rows of one unit, and leave them in memory that processes share.

    Parameters
    ----------
    blob, number, block_size
        As for `process_unit`.
    folder : Path or None
        Of shared memory; None: the rows themselves are returned.

    Returns
    -------
    rows : Rows
    report : RunReport
    """
    rows, report = process_unit(blob, number, block_size)
    return share_rows(rows, folder), report


def make_chunk(blob: bytes, parts: list[Rows]) -> tuple[bytes, Statistics, float]:
    """Compress rows as one LAZ chunk.

    Parameters
    ----------
    blob : bytes
        A pickled ChunkMaker.
    parts : list of Rows
        In order.

    Returns
    -------
    chunk : bytes
    statistics : Statistics
        Of the rows.
    seconds : float
        That it took.

    Raises
    ------
    InputError
        Where the rows cannot be read or compressed.
    """
    start = time.perf_counter()
    maker: ChunkMaker = unpack(blob)
    chunk, statistics = maker.make(join_rows(parts))
    return chunk, statistics, time.perf_counter() - start


class RowStream:
    """Rows of a strip on their way into its cloud: `add` in order, then `end`; `take` writes compressed chunks.

    Parameters
    ----------
    writer : PointFile
    submit : callable or None
        `Workers.submit`, to compress in the workers; None: rows are written when they are added.
    memory : Path or None
        The run's folder of shared memory.
    """

    def __init__(self, writer: PointFile, submit: Callable[..., Future] | None, memory: Path | None) -> None:
        self._writer, self._submit = writer, submit
        self.folder: Path | None = None
        """Where workers may leave the strip's rows."""
        if memory is not None:
            with contextlib.suppress(OSError):  # no room: rows travel through pipes
                self.folder = Path(tempfile.mkdtemp(dir=memory))
        maker = writer.chunk_maker if submit is not None else None
        self._blob = b"" if maker is None else pickle.dumps(maker, pickle.HIGHEST_PROTOCOL)
        self.pending: deque[Future] = deque()
        """Chunks that are being compressed, in order."""
        self._used_up: deque[list[Rows]] = deque()
        """Per pending chunk: rows that no later chunk needs."""
        self._held: list[Rows] = []

    def add(self, rows: Rows) -> None:
        """Write rows (m,), or hold them until they fill a chunk."""
        if not self._blob:
            self._writer.write(read_rows(rows))
            discard_rows(rows)
            return
        if not len(rows):
            return
        self._held.append(rows)
        while sum(map(len, self._held)) >= CHUNK_POINTS:
            self._cut(CHUNK_POINTS)

    def end(self) -> None:
        """Compress the rows that are left; may be called twice."""
        if self._held:
            self._cut(sum(map(len, self._held)))

    def take(self) -> float:
        """Wait for the oldest chunk and write it; return the seconds that a worker took for it."""
        try:
            chunk, statistics, seconds = self.pending.popleft().result()
        except InputError as error:
            raise InputError(f"{self._writer.target}: {error}") from error
        self._writer.write_chunk(chunk, statistics)
        for rows in self._used_up.popleft():
            discard_rows(rows)
        return seconds

    def close(self) -> None:
        """Give up what is not written, and remove the shared memory; may be called twice."""
        for future in self.pending:
            future.cancel()
        self.pending.clear()
        self._held.clear()
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _cut(self, points: int) -> None:
        """Have the next chunk compressed."""
        parts: list[Rows] = []
        used_up: list[Rows] = []
        while points:
            rows = self._held[0]
            parts.append(rows[:points])
            points -= len(parts[-1])
            if len(parts[-1]) == len(rows):
                used_up.append(self._held.pop(0))
            else:
                self._held[0] = rows[len(parts[-1]) :]
        self.pending.append(self._submit(make_chunk, self._blob, parts))
        self._used_up.append(used_up)
