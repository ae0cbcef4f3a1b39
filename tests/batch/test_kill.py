"""Runs that end in the middle: killed, interrupted, a worker shot. Nothing half-written is taken for a cloud."""

import functools
import json
import os
import signal
import subprocess
import sys
import time

import pytest

from wavebatch.batch.workers import serve
from wavebatch.tools.simulate import simulate_strip

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")

PROFILE = ["--profile", "fast"]
DRAFT = ".wavebatch-[0-9]*.tmp"  # not the lock of a strip, which is there before its worker


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """Three strips, the last with two units."""
    folder = tmp_path_factory.mktemp("strips")
    for name, pulses in (("a", 300), ("b", 300), ("c", 56_000)):
        simulate_strip("flat", folder / f"{name}.las", pulses=pulses, seed=1)
    return folder


@pytest.fixture(scope="module")
def undisturbed(strips, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    subprocess.run(_command(strips, folder), check=True)
    return _contents(folder)


def _command(strips, folder, *more):
    return [sys.executable, "-m", "wavebatch", "run", str(strips), "-o", str(folder), *PROFILE, "-q", *more]


def _contents(folder):
    """Bytes of the clouds, reports without timing, by name; temporary files too."""
    found = {}
    for path in sorted(folder.iterdir()):
        if path.name.endswith(".report.json"):
            found[path.name] = {k: v for k, v in json.loads(path.read_text()).items() if k != "timing"}
        else:
            found[path.name] = path.read_bytes()
    return found


def _wait_for(folder, pattern, process):
    """Until a file like that is in the folder; False where the run ended before it was seen."""
    deadline = time.monotonic() + 120
    while not list(folder.glob(pattern)):
        assert time.monotonic() < deadline, "the run does not begin"
        if process.poll() is not None:
            return False
        time.sleep(0.002)
    return True


def _disturb(strips, folder, pattern, number, *more):
    """The output folder, exit code and stderr of a run that got a signal once a file like that was there.

    On a busy machine a run may end before this process sees the file: then another one is started.
    """
    deadline, attempt = time.monotonic() + 120, 0
    while True:
        assert time.monotonic() < deadline, "no run could be disturbed"
        out, attempt = folder / str(attempt), attempt + 1
        out.mkdir()
        with subprocess.Popen(_command(strips, out, *more), stderr=subprocess.PIPE, text=True) as process:
            if _wait_for(out, pattern, process):
                process.send_signal(number)
            _, said = process.communicate(timeout=120)
        if process.returncode:
            return out, process.returncode, said


def _children(pid):
    with open(f"/proc/{pid}/task/{pid}/children") as file:
        return [int(word) for word in file.read().split()]


def _is_alive(pid):
    """Whether the process runs; one that ended and was not collected does not."""
    try:
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def _is_tracker(pid):
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            return b"resource_tracker" in file.read()
    except OSError:
        return False


@pytest.mark.parametrize(("jobs", "pattern"), [("1", "a.report.json"), ("2", DRAFT)])
def test_killed_in_the_middle_resume_gives_what_an_undisturbed_run_gives(strips, undisturbed, tmp_path, jobs, pattern):
    out, code, _ = _disturb(strips, tmp_path, pattern, signal.SIGKILL, "--jobs", jobs)
    assert code == -signal.SIGKILL and _contents(out).keys() != undisturbed.keys()
    subprocess.run(_command(strips, out, "--resume"), check=True)
    assert _contents(out) == undisturbed


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_cleans_up_and_says_130(strips, undisturbed, tmp_path, number):
    out, code, said = _disturb(strips, tmp_path, DRAFT, number, "--jobs", "2")
    assert code == 130
    assert said.startswith("interrupted") and said.count("\n") == 1
    assert set(_contents(out)) <= set(undisturbed)
    for path in out.glob("*.report.json"):
        assert path.with_name(path.name.replace(".report.json", ".laz")).exists()


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="finds processes through /proc")
@pytest.mark.parametrize("stopped", [False, True])
def test_workers_die_with_their_parent(tmp_path, stopped):
    """Also those that are stopped, and cannot see that it is dead."""
    strips, out = tmp_path / "strips", tmp_path / "out"
    strips.mkdir()
    simulate_strip("flat", strips / "a.las", pulses=400_000, seed=1)  # long enough to be disturbed below
    with subprocess.Popen(_command(strips, out, "--jobs", "2")) as process:
        assert _wait_for(out, DRAFT, process), "the run ended before it could be disturbed"
        children = _children(process.pid)
        assert children
        time.sleep(0.1)  # workers have begun
        for child in children if stopped else ():
            os.kill(child, signal.SIGSTOP)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    children = [child for child in children if not _is_tracker(child)]  # it ends when all others have
    deadline = time.monotonic() + 20
    while any(_is_alive(child) for child in children):
        assert time.monotonic() < deadline, "a worker outlived its parent"
        time.sleep(0.01)


def _ignores_ctrl_c(pid):
    with open(f"/proc/{pid}/status") as file:
        ignored = next(int(line.split()[1], 16) for line in file if line.startswith("SigIgn"))
    return bool(ignored >> (signal.SIGINT - 1) & 1)


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="finds processes through /proc")
def test_a_worker_that_is_stopped_as_soon_as_our_code_runs_in_it_dies_with_its_parent(strips, tmp_path):
    """The death signal comes first: one that ignores Ctrl-C has it."""
    # Jobs that a shell has started in the background ignore Ctrl-C from the first.
    listen = functools.partial(signal.signal, signal.SIGINT, signal.default_int_handler)
    with subprocess.Popen(_command(strips, tmp_path, "--jobs", "2"), preexec_fn=listen) as process:
        worker = None
        while worker is None:
            assert process.poll() is None, "the run ended before it could be disturbed"
            workers = [child for child in _children(process.pid) if not _is_tracker(child)]
            worker = next(filter(_ignores_ctrl_c, workers), None)
        os.kill(worker, signal.SIGSTOP)
        process.send_signal(signal.SIGKILL)
    deadline = time.monotonic() + 20
    while _is_alive(worker):
        assert time.monotonic() < deadline, "a worker outlived its parent"
        time.sleep(0.01)


def test_a_worker_asks_for_the_death_signal_before_all_else(monkeypatch):
    done = []
    monkeypatch.setattr(serve, "_wake_when_parent_dies", lambda: done.append("death signal"))
    monkeypatch.setattr(serve.signal, "signal", lambda *_: done.append("ignores Ctrl-C"))
    monkeypatch.setattr(serve, "keep_freed_memory", lambda: done.append("memory"))
    monkeypatch.setattr(serve.multiprocessing, "parent_process", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        serve.serve_calls(None)
    assert done == ["death signal", "ignores Ctrl-C", "memory"]


_SHOT = """
import os, sys
from pathlib import Path
sys.path.insert(0, {tests!r})
import wavebatch.batch.strip_task, wavebatch.batch.unit
from batch_tools import make_job
from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch

def prepare(job):
    once = Path({once!r})
    if job.path.stem == "b" or job.path.stem == "a" and not once.exists():
        once.touch(exist_ok=True)
        os.kill(os.getpid(), 9)
    return wavebatch.batch.unit.prepare_strip(job)

if __name__ == "__main__":
    wavebatch.batch.strip_task.prepare_strip = prepare
    folder = Path({strips!r})
    jobs = [make_job(folder / name) for name in ("a.las", "b.las", "c.las")]
    result = run_batch(jobs, RunOptions(Path({out!r}), jobs=2))
    print([outcome.status for outcome in result.outcomes])
    print(result.outcomes[1].error)
"""


def test_a_strip_at_which_a_worker_dies_is_tried_once_more_and_only_then_fails(strips, undisturbed, tmp_path):
    script = tmp_path / "shot.py"
    out = tmp_path / "out"
    places = {"strips": str(strips), "out": str(out), "once": str(tmp_path / "once")}
    script.write_text(_SHOT.format(tests=os.path.dirname(os.path.dirname(__file__)), **places))
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=180)
    assert done.returncode == 0, done.stderr
    statuses, error = done.stdout.splitlines()
    assert statuses == "['written', 'failed', 'written']"
    assert "a worker process died" in error and "b.las" in error and "tried again alone" in error
    found = _contents(out)
    assert found == {name: content for name, content in undisturbed.items() if not name.startswith("b.")}
