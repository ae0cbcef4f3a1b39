"""Runs that end in the middle: killed, interrupted, a worker shot. Nothing half-written is taken for a cloud."""

import os
import signal
import subprocess
import sys

import pytest
from attacking import command_line, has_signal, list_children
from batch_tools import is_alive, read_outputs, wait_until
from commands import run_command

from wavebatch.tools.simulate import simulate_strip

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")

PROFILE = ["--profile", "fast"]


@pytest.fixture(scope="module", params=[300, pytest.param(56_000, marks=pytest.mark.slow)])
def strips(request, tmp_path_factory):
    """Three strips, the last with one unit or two, and the survey of the first."""
    folder = tmp_path_factory.mktemp("strips")
    for name, pulses in (("a", 300), ("b", 300), ("c", request.param)):
        simulate_strip("flat", folder / f"{name}.las", pulses=pulses, seed=1)
    assert run_command("survey", folder / "a.las", "-o", folder / "system.toml").exit_code == 0
    return folder


@pytest.fixture(scope="module")
def undisturbed(strips, tmp_path_factory):
    folder = tmp_path_factory.mktemp("undisturbed")
    assert run_command(*_words(strips, folder)).exit_code == 0
    return read_outputs(folder)


def _words(strips, folder, *more):
    return ["run", str(strips), "-o", str(folder), *PROFILE, "-q", "--system", str(strips / "system.toml"), *more]


_AT = """
import os, sys, time
from wavebatch.core.interrupts import guard

def act():
    {act}

def run():
    from wavebatch.__main__ import _run
    from wavebatch.files.disk.publish import Draft  # here, as in a run: `guard` has its say at the end after it

    before = Draft.{method}

    def here(self, *given, **options):
        before(self, *given, **options)
        if self.target.name.endswith({suffix!r}):
            act()

    Draft.{method} = here
    _run()

if __name__ == "__main__":
    guard(run)
"""
DRAWN_UP = {"method": "__init__", "suffix": ".laz"}
"""The temporary file of a cloud is there; workers are at work."""
REPORTED = {"method": "publish", "suffix": "a.report.json"}
"""The first strip is done."""


def _stage(strips, folder, script, act, *more, **event):
    """The command of a run that acts at an event: nothing depends on when another process sees the event."""
    script.write_text(_AT.format(act=act, **event))
    return [sys.executable, str(script), *_words(strips, folder, *more)]


def _disturb(strips, out, event, number):
    """The exit code and stderr of a run that gets a signal at an event."""
    act = f"os.kill(os.getpid(), {int(number)})"
    command = _stage(strips, out, out.with_suffix(".py"), act, "--jobs", "2" if event is DRAWN_UP else "1", **event)
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True)
    return done.returncode, done.stderr


def _list_workers(pid):
    """Without the process that tracks resources, which ends when all others have."""
    return [child for child in list_children(pid) if "resource_tracker" not in command_line(child)]


@pytest.mark.quick_cases("300-event1")
@pytest.mark.parametrize("event", [REPORTED, DRAWN_UP])
def test_killed_in_the_middle_resume_gives_what_an_undisturbed_run_gives(strips, undisturbed, tmp_path, event):
    out = tmp_path / "out"
    code, _ = _disturb(strips, out, event, signal.SIGKILL)
    assert code == -signal.SIGKILL and read_outputs(out).keys() != undisturbed.keys()
    assert run_command(*_words(strips, out, "--resume")).exit_code == 0
    assert read_outputs(out) == undisturbed


@pytest.mark.quick_cases("300-15")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_run_cleans_up_and_says_130(strips, undisturbed, tmp_path, number):
    out = tmp_path / "out"
    code, said = _disturb(strips, out, DRAWN_UP, number)
    assert code == 130
    assert said.startswith("interrupted") and said.count("\n") == 1
    assert set(read_outputs(out)) <= set(undisturbed)
    for path in out.glob("*.report.json"):
        assert path.with_name(path.name.replace(".report.json", ".laz")).exists()


@pytest.mark.quick_cases("300-True")
@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="finds processes through /proc")
@pytest.mark.parametrize("stopped", [False, True])
def test_workers_die_with_their_parent(strips, tmp_path, stopped):
    """Also those that are stopped, and cannot see that it is dead."""
    act = "print('at work', flush=True); time.sleep(600)"
    command = _stage(strips, tmp_path / "out", tmp_path / "run.py", act, "--jobs", "2", **DRAWN_UP)
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "at work\n"
        children = _list_workers(process.pid)
        assert len(children) == 2
        for child in children if stopped else ():
            os.kill(child, signal.SIGSTOP)
        process.send_signal(signal.SIGKILL)
    assert process.returncode == -signal.SIGKILL
    wait_until(lambda: not any(map(is_alive, children)), "a worker outlived its parent")


_WAITS = """
import time
from wavebatch.batch.workers.processes import Workers

if __name__ == "__main__":
    with Workers(2) as workers:
        workers.submit(time.sleep, 600)
        print("started", flush=True)
        time.sleep(600)
"""


@pytest.mark.skipif(not os.path.exists("/proc/self/task"), reason="finds processes through /proc")
def test_a_worker_that_is_stopped_as_soon_as_our_code_runs_in_it_dies_with_its_parent(tmp_path):
    """The death signal comes first: one that ignores Ctrl-C has it."""
    script = tmp_path / "waits.py"
    script.write_text(_WAITS)
    with subprocess.Popen([sys.executable, str(script)], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "started\n"
        worker = None
        while worker is None:
            assert process.poll() is None
            workers = _list_workers(process.pid)
            worker = next((one for one in workers if has_signal(one, "SigIgn", signal.SIGINT)), None)
        os.kill(worker, signal.SIGSTOP)
        process.send_signal(signal.SIGKILL)
    wait_until(lambda: not is_alive(worker), "a worker outlived its parent")


_SHOT = """
import os
from pathlib import Path
import wavebatch, wavebatch.batch.strip_task, wavebatch.batch.unit

def prepare(job, parts):
    once = Path({once!r})
    if job.path.stem == "b" or job.path.stem == "a" and not once.exists():
        once.touch(exist_ok=True)
        os.kill(os.getpid(), 9)
    return wavebatch.batch.unit.prepare_strip(job, parts)

if __name__ == "__main__":
    wavebatch.batch.strip_task.prepare_strip = prepare
    folder = Path({strips!r})
    result = wavebatch.run([folder], {out!r}, chain="fast", system=folder / "system.toml", jobs=2)
    print([outcome.status for outcome in result.outcomes])
    print(result.outcomes[1].error)
"""


def test_a_strip_at_which_a_worker_dies_is_tried_once_more_and_only_then_fails(strips, undisturbed, tmp_path):
    script = tmp_path / "shot.py"
    out = tmp_path / "out"
    places = {"strips": str(strips), "out": str(out), "once": str(tmp_path / "once")}
    script.write_text(_SHOT.format(**places))
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    statuses, error = done.stdout.splitlines()
    assert statuses == "['written', 'failed', 'written']"
    assert "a worker process died" in error and "b.las" in error and "tried again alone" in error
    found = read_outputs(out)
    assert found == {name: content for name, content in undisturbed.items() if not name.startswith("b.")}
