"""Temporary folders go with their process: at its end, or at the start of the next one when it was killed."""

import os
import pickle
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from commands import refuses

from wavebatch.core.errors import InputError
from wavebatch.files.disk import publish, temp_store
from wavebatch.tools.simulate import simulate_strip

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="file locks of POSIX systems")

HOLD = """
import sys
from pathlib import Path
from wavebatch.files.disk.temp_store import owning_scratch
with owning_scratch(Path(sys.argv[1])) as folder:
    (folder / "data").write_bytes(bytes(1000))
    print(folder, flush=True)
    sys.stdin.read()
"""

LIVE_AND_LET_LIVE = """
import sys
from pathlib import Path
from wavebatch.files.disk.temp_store import owning_scratch, remove_orphans
for turn in range(60):
    with owning_scratch(Path(sys.argv[1])) as folder:
        (folder / "data").write_text("mine")
        remove_orphans(Path(sys.argv[1]))
        assert (folder / "data").read_text() == "mine"
        assert (folder / "lock").exists()
"""


@pytest.fixture
def hold(tmp_path):
    """`hold()`: a process that owns a folder in tmp_path, and that folder."""
    processes = []

    def start():
        process = subprocess.Popen(
            [sys.executable, "-c", HOLD, str(tmp_path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        processes.append(process)
        return process, Path(process.stdout.readline().strip())

    yield start
    for process in processes:
        process.kill()
        process.communicate()


def test_a_folder_is_there_while_it_is_needed(tmp_path):
    with temp_store.owning_scratch(tmp_path) as folder:
        inner = temp_store.make_folder()
        assert inner.parent == folder and folder.parent == tmp_path
        assert folder.name.startswith(".wavebatch-") and f"-{os.getpid()}-" in folder.name
        assert temp_store.remove_orphans(tmp_path) == []
        (inner / "file").write_text("x")
    assert list(tmp_path.iterdir()) == []


def test_what_a_killed_process_left_goes_and_what_is_in_use_stays(tmp_path, hold):
    killed, orphan = hold()
    _, used = hold()
    killed.send_signal(signal.SIGKILL)
    killed.wait()
    assert orphan.exists() and used.exists()
    assert temp_store.remove_orphans(tmp_path) == [orphan]
    assert (used / "data").read_bytes() == bytes(1000) and not orphan.exists()
    assert temp_store.remove_orphans(tmp_path) == []


def test_only_what_is_surely_an_orphan_is_removed(tmp_path):
    """Other machines', links, files, and what merely looks alike."""
    here = f"wavebatch-{socket.gethostname()}-"
    kept = [tmp_path / "wavebatch-another.machine-1-abc", tmp_path / f"my-{here}1", tmp_path / "elsewhere"]
    for folder in kept:
        folder.mkdir()
        (folder / "precious").write_text("x")
    (tmp_path / f"{here}2-link").symlink_to(kept[2])
    (tmp_path / f"{here}3-file").write_text("x")
    (tmp_path / f"{here}4-mine").mkdir()
    assert temp_store.remove_orphans(tmp_path) == [tmp_path / f"{here}4-mine"]
    assert all((folder / "precious").exists() for folder in kept)
    assert (tmp_path / f"{here}3-file").exists() and (tmp_path / f"{here}2-link").is_symlink()


def test_processes_that_start_together_leave_each_other_alone(tmp_path):
    runs = [subprocess.Popen([sys.executable, "-c", LIVE_AND_LET_LIVE, str(tmp_path)]) for _ in range(4)]
    assert [run.wait(timeout=300) for run in runs] == [0] * 4
    assert list(tmp_path.iterdir()) == []


def test_a_lock_that_was_removed_meanwhile_says_nothing_of_its_folder(tmp_path):
    """Two processes find the same folder left over: the slower one waits at a lock that is no more, and a third process
    has made the folder its own since."""

    def open_lock(folder):
        descriptor = os.open(folder / "lock", os.O_RDWR | os.O_CREAT)
        (folder / "lock").unlink()
        (folder / "lock").write_text("of the new owner")
        return descriptor

    assert publish.remove_unlocked([tmp_path], open_lock, shutil.rmtree) == []
    assert (tmp_path / "lock").read_text() == "of the new owner"


def test_a_place_given_by_another_process_is_this_thread_s_only(tmp_path):
    found = []
    temp_store.use_scratch(tmp_path)
    try:
        thread = threading.Thread(target=lambda: found.append(temp_store.scratch_place()))
        thread.start()
        thread.join()
        assert temp_store.make_folder().parent == tmp_path and found != [tmp_path]
    finally:
        temp_store.use_scratch(None)


def test_without_a_place_the_spool_says_so(no_place):
    with temp_store.owning_scratch(no_place) as folder:
        assert folder is None
    spool = temp_store.Spool(2, np.dtype("<i8"), memory=1)
    refuses(InputError, "No such file.*set TMPDIR", spool.append, np.array([0, 1]), np.array([5, 6]))


def test_a_spool_keeps_what_came_after_its_last_segment():
    with temp_store.Spool(1, np.dtype("<i8"), memory=64) as spool:
        for entries in (np.arange(8), np.arange(8, 10)):
            spool.append(np.zeros(len(entries), np.int64), entries)
        assert spool.path is not None and spool.read(0).tolist() == list(range(10))


def test_a_spool_that_travels_takes_a_file_or_its_entries_with_it(tmp_path):
    temp_store.use_scratch(tmp_path / "missing")
    try:
        with temp_store.Spool(2, np.dtype("<i8"), kept=0) as spool:
            spool.append(np.array([1, 0, 1]), np.array([5, 6, 7]))
            assert spool.read(1).tolist() == [5, 7] and spool.path is None
            assert pickle.loads(pickle.dumps(spool)).read(1).tolist() == [5, 7] and spool.path is None
            temp_store.use_scratch(tmp_path)
            copies = [pickle.loads(pickle.dumps(spool)) for _ in range(2)]
            assert {copy.path for copy in copies} == {spool.path} and spool.path.exists()
            for one in (spool, *copies):
                assert [one.read(bucket).tolist() for bucket in (0, 1)] == [[6], [5, 7]]
        assert not spool.path.exists()
    finally:
        temp_store.use_scratch(None)


EVERY_PROCESS = """
import os, signal
from wavebatch.batch import strip_task
from wavebatch.files.strip import reader, scanner
reader.UNIT_POINTS = 500
object.__setattr__(scanner.SCAN_SIZES, "spooled", 1)

def kill(task, *arguments):
    os.kill(os.getpid(), signal.SIGKILL)

if "TEST_KILLS" in os.environ:
    strip_task.StripTask._take_prepared = kill  # the scan of the strip is done, its spool is there
"""
"""As sitecustomize: workers do not run the script of the user."""


@pytest.mark.slow
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_the_next_run_clears_up_after_one_that_was_killed(tmp_path, edit_points, jobs):
    strips, temporary, out = tmp_path / "in", tmp_path / "tmp", tmp_path / "out"
    strips.mkdir()
    temporary.mkdir()
    simulate_strip("urban", tmp_path / "b.las", pulses=3000, seed=2)
    order = np.random.default_rng(1)
    edit_points(tmp_path / "b.las", strips / "b.las", lambda points: order.permutation(points))
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "sitecustomize.py").write_text(EVERY_PROCESS)
    command = [sys.executable, "-m", "wavebatch", "run", str(strips), "-o", str(out), "--profile", "fast", "-q"]
    environment = {**os.environ, "TMPDIR": str(temporary), "PYTHONPATH": str(tmp_path / "site")}
    run = subprocess.run([*command, "--jobs", jobs], env=environment | {"TEST_KILLS": "1"})
    assert run.returncode == -signal.SIGKILL
    assert list(temporary.rglob("spool"))
    deadline = time.monotonic() + 300
    while subprocess.run([*command, "--resume"], env=environment).returncode:  # until its workers have ended too
        assert time.monotonic() < deadline
    assert list(temporary.iterdir()) == []
    assert sorted(path.name for path in out.iterdir()) == ["b.laz", "b.report.json"]
