"""Rows on their way from workers into a cloud: shared memory, chunks, and what is left when processes die."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future
from pathlib import Path

import numpy as np
import pytest

from wavebatch.batch.row_transfer import RowStream
from wavebatch.batch.workers.processes import settle
from wavebatch.core.errors import InputError
from wavebatch.files.disk import shared_rows, temp_folders
from wavebatch.files.disk.shared_rows import SharedRows, join_rows, read_rows, share_rows
from wavebatch.files.las.header import STANDARD_DTYPES, LasHeader
from wavebatch.files.las.write_points import PointFile

DTYPE = STANDARD_DTYPES[6]


def make_rows(n, seed=0):
    rng = np.random.default_rng(seed)
    rows = np.zeros(n, DTYPE)
    for axis in "XYZ":
        rows[axis] = np.cumsum(rng.integers(-50, 60, n))
    rows["gps_time"] = np.arange(n) * 1e-5
    return rows


def open_file(target):
    return PointFile(target, LasHeader.new((1, 4), 6, (0.01,) * 3, (0.0,) * 3), DTYPE, [], overwrite=True)


def now(function, *arguments):
    return settle(Future(), function, *arguments)


@pytest.fixture
def whole(tmp_path):
    """170,000 rows, and the bytes of their file."""
    rows = make_rows(170_000)
    with open_file(tmp_path / "whole.laz") as file:
        file.write(rows)
        file.commit()
    return rows, (tmp_path / "whole.laz").read_bytes()


@pytest.mark.parametrize("sizes", [[170_000], [50_000] * 3 + [20_000], [1, 0, 49_999, 120_000], [7_000] * 24 + [2_000]])
@pytest.mark.parametrize("shared", [True, False])
def test_the_bytes_do_not_depend_on_how_rows_arrive(whole, tmp_path, sizes, shared):
    rows, expected = whole
    memory = tmp_path / "memory"
    memory.mkdir()
    with open_file(tmp_path / "out.laz") as file:
        stream = RowStream(file, now, memory if shared else None)
        at, most = 0, 0
        for size in sizes:
            part = share_rows(rows[at : at + size], stream.folder)
            assert isinstance(part, SharedRows) == (shared and size > 3000)
            stream.add(part)
            at += size
            while stream.pending:
                stream.take()
            most = max(most, len(list(memory.rglob("tmp*/*"))))
        stream.end()
        stream.end()
        while stream.pending:
            stream.take()
        assert not shared or most <= 8  # files go as soon as their rows are in the cloud
        assert not list(memory.rglob("tmp*/*"))
        stream.close()
        assert not list(memory.iterdir())
        file.commit()
    assert (tmp_path / "out.laz").read_bytes() == expected


def test_without_room_in_memory_rows_travel_through_the_pipe(tmp_path, monkeypatch):
    rows = make_rows(10_000)

    def full(path, *mode, **options):
        raise OSError(28, "No space left on device")

    assert share_rows(rows, None) is rows
    assert share_rows(rows, tmp_path / "gone") is rows
    monkeypatch.setattr(shared_rows.os, "fdopen", full)
    assert share_rows(rows, tmp_path) is rows
    assert not list(tmp_path.iterdir())


def test_shared_rows_are_the_rows(tmp_path):
    rows = make_rows(10_000)
    shared = share_rows(rows, tmp_path)
    assert len(shared) == 10_000 and shared.nbytes == rows.nbytes
    assert read_rows(shared).tobytes() == rows.tobytes()
    parts = [shared[9_990:], rows[:3], shared[:5][2:], shared[3:3]]
    expected = np.concatenate([rows[9_990:], rows[:3], rows[2:5]])
    assert join_rows(parts).tobytes() == expected.tobytes()
    shared.discard()
    shared.discard()
    with pytest.raises(InputError, match=r"rows that another process has left there cannot be read \(No such file"):
        read_rows(shared)


def test_a_chunk_that_fails_names_the_cloud(tmp_path):
    with open_file(tmp_path / "out.laz") as file:
        stream = RowStream(file, now, tmp_path)
        rows = share_rows(make_rows(10_000), stream.folder)
        rows.discard()
        stream.add(rows)
        stream.end()
        with pytest.raises(InputError, match=r"^\S*out\.laz: "):
            stream.take()
        stream.close()


needs_memory = pytest.mark.skipif(not Path("/dev/shm").is_dir(), reason="a place for files in memory")


_PLACE = """
from pathlib import Path
from wavebatch.files.disk import shared_rows, temp_folders
temp_folders.MEMORY_PLACE = Path({place!r})
shared_rows.LEAST = 0
"""


def _elsewhere(tmp_path, place):
    """Environment in which processes and their workers have another place in memory: Python reads sitecustomize."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(_PLACE.format(place=str(place)))
    return {**os.environ, "PYTHONPATH": str(tmp_path / "site")}


_KILLED = """
import os, signal
from wavebatch.files.disk import temp_folders

def kill(stream, rows):
    assert list(temp_folders.MEMORY_PLACE.glob("*/tmp*"))
    os.kill(os.getpid(), signal.SIGKILL)

from wavebatch.__main__ import main
from wavebatch.batch.row_transfer import RowStream
RowStream.add = kill
main()
"""


@needs_memory
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")
def test_a_killed_run_leaves_nothing_in_memory(tiny_strip, tmp_path):
    """Its workers remove it, even if no other run follows: this one has a place of its own."""
    place = tmp_path / "memory"
    place.mkdir()
    script = tmp_path / "run.py"
    script.write_text(_KILLED)
    command = [sys.executable, str(script), "run", str(tiny_strip), "-o", str(tmp_path / "out")]
    command += ["--profile", "fast", "--quiet", "--jobs", "2"]
    assert subprocess.run(command, env=_elsewhere(tmp_path, place)).returncode == -signal.SIGKILL
    _wait_until_empty(place)


def _wait_until_empty(place):
    deadline = time.monotonic() + 300
    while list(place.iterdir()):
        assert time.monotonic() < deadline, "the memory is never given back"
        time.sleep(0.01)


_IDLE = """
import os, signal
if __name__ == "__main__":
    from wavebatch.batch.workers.processes import Workers
    with Workers(2) as workers:
        workers.wait([workers.submit(os.getpid)])
        for number in range(20_000):
            (workers.memory / str(number)).touch()
        os.kill(os.getpid(), signal.SIGKILL)
"""


@needs_memory
@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")
def test_workers_that_wait_for_calls_clean_up_before_they_end(tmp_path):
    """Their pipe closes when the parent is killed: they ended at once, in the middle of the cleaning up."""
    place = tmp_path / "memory"
    place.mkdir()
    script = tmp_path / "idle.py"
    script.write_text(_IDLE)
    assert subprocess.run([sys.executable, str(script)], env=_elsewhere(tmp_path, place)).returncode == -signal.SIGKILL
    _wait_until_empty(place)


@needs_memory
def test_memory_of_a_killed_run_whose_workers_died_too_is_given_back_by_the_next(tmp_path, monkeypatch):
    monkeypatch.setattr(temp_folders, "MEMORY_PLACE", tmp_path)
    left = tmp_path / f"{temp_folders._prefix()}1-abc"
    left.mkdir()
    (left / "rows").write_bytes(bytes(100))
    with temp_folders.owning_memory() as folder:
        assert folder.parent == tmp_path and not left.exists()
    assert not list(tmp_path.iterdir())


@needs_memory
def test_a_lock_that_a_dying_process_still_holds_is_waited_for(tmp_path, monkeypatch):
    monkeypatch.setattr(temp_folders, "MEMORY_PLACE", tmp_path)
    owned = temp_folders._Owned(tmp_path, "")
    temp_folders.remove_memory_of(os.getpid(), 0.1)
    assert owned.folder.exists()
    release = threading.Timer(0.2, os.close, [owned._lock])
    release.start()
    temp_folders.remove_memory_of(os.getpid(), 60.0)
    assert not owned.folder.exists()
    release.join()


def test_no_place_in_memory_is_no_error(tmp_path, monkeypatch):
    for place in tmp_path / "none", Path("/proc"):
        monkeypatch.setattr(temp_folders, "MEMORY_PLACE", place)
        with temp_folders.owning_memory() as folder:
            assert folder is None
        temp_folders.remove_memory_of(1, 0.0)


EARLY = """
import os, sys, time
from wavebatch.batch.workers.processes import start_early
if __name__ == "__main__":
    start_early(2)
    with open(f"/proc/{os.getpid()}/task/{os.getpid()}/children") as file:
        print(file.read(), flush=True)
    if sys.argv[1] == "stopped":
        import signal
        from wavebatch.batch.workers.processes import _early
        for one in _early:
            os.kill(one.process.pid, signal.SIGSTOP)
"""


def _is_alive(pid):
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="finds processes through /proc")
@pytest.mark.parametrize("state", ["running", "stopped"])
def test_processes_that_were_started_for_nothing_end_with_their_parent(tmp_path, state):
    """A run that finds its options wrong has started them already; also one that stands still does not keep it."""
    script = tmp_path / "early.py"
    script.write_text(EARLY)
    done = subprocess.run([sys.executable, script, state], capture_output=True, text=True, timeout=300, check=True)
    assert not done.stderr
    children = [int(word) for word in done.stdout.split()]
    assert len(children) >= 2
    deadline = time.monotonic() + 300
    while any(_is_alive(child) for child in children):  # one of them is multiprocessing's own, which ends by itself
        assert time.monotonic() < deadline, "a process stays"
        time.sleep(0.01)


def test_wrong_options_end_a_run_of_several_jobs_as_usual(tmp_path):
    command = [sys.executable, "-m", "wavebatch", "run", "a.las", "-o", str(tmp_path), "--columns", "none"]
    done = subprocess.run([*command, "--jobs", "3"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
