"""Ctrl-C, SIGTERM and SIGXCPU at any instant: exit code 130, one line, no temporary file, nothing half done."""

import os
import random
import signal
import subprocess
import sys
import time

import pytest
from attacking import handles_signals
from batch_tools import make_job
from commands import refuses
from helpers_scenes import simulated

from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.files.disk.publish import Draft

pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="looks at signals through /proc")


strip = simulated("a.las", "flat", pulses=3000, seed=1)


def _start(command, *, code=None):
    program = ["-m", "wavebatch"] if code is None else ["-c", code]
    return subprocess.Popen(
        [sys.executable, *program, *map(str, command)], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
        start_new_session=True,
    )  # fmt: skip


def _wait_for_handlers(process):
    """Until the program has begun: from then on no signal may be lost."""
    while process.poll() is None and not handles_signals(process.pid):
        time.sleep(0.0005)


@pytest.mark.parametrize("jobs", ["1", "2", pytest.param("bench", marks=pytest.mark.slow)])
def test_a_signal_at_any_instant_gives_130_and_leaves_nothing(strip, tmp_path, jobs):
    """Of `run` and of `bench`. Other commands: `tests/test_attack.py`."""
    pairs = [(signal.SIGTERM, None), (signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGINT)]
    for number, second in [*pairs, (signal.SIGXCPU, None), (signal.SIGXCPU, signal.SIGXCPU)]:
        folder = tmp_path / f"{number}{second}"
        folder.mkdir()
        run = ["run", strip, "-o", folder, "--profile", "fast", "--jobs", jobs]
        process = _start(["bench", "-o", folder, "--waveforms", "2000"] if jobs == "bench" else run)
        _wait_for_handlers(process)
        time.sleep(random.Random(jobs + folder.name).choice([0, 0.05, 0.2, 0.5, 1.0]))
        process.send_signal(number)
        for _ in range(3):
            if second is not None:
                time.sleep(0.003)
                process.send_signal(second)
        _, said = process.communicate(timeout=300)
        assert not list(folder.glob(".*")), said
        if process.returncode == 0:  # all was done before
            assert list(folder.iterdir())
            continue
        *before, last = said.splitlines()
        assert process.returncode == 130 and last.startswith("interrupted"), said
        assert all(line.startswith((str(strip), str(folder))) for line in before), said


_COUNTING = """
import resource, time
from wavebatch.__main__ import main
from wavebatch.batch import run
resource.setrlimit(resource.RLIMIT_CPU, (int(time.process_time()) + 2, 30))  # after the imports, which take their time
begin = run.StripTask.start
def count(self, *parts):
    begin(self, *parts)
    while True:
        pass
run.StripTask.start = count
main()
"""


def _end_run(strip, folder, code, *options):
    """A run that its code interrupts says so, and leaves nothing."""
    process = _start(["run", strip, "-o", folder, "--profile", "fast", *options], code=code)
    _, said = process.communicate(timeout=300)
    assert process.returncode == 130 and said.startswith("interrupted: finished clouds are complete"), said
    assert list(folder.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("jobs", ["1", "2"])
def test_a_run_that_reaches_its_limit_of_processor_time_leaves_nothing(strip, tmp_path, jobs):
    """The parent process counts in vain until its limit; the limit holds for each process."""
    _end_run(strip, tmp_path, _COUNTING, "--jobs", jobs)


_IN_COMPRESSOR = """
import os, signal
from wavebatch.files.las import write_points
from wavebatch.__main__ import main

class File(write_points.BytesIO):
    def write(self, data):
        os.kill(os.getpid(), signal.{name})
        return super().write(data)

write_points.BytesIO = File
main()
"""


@pytest.mark.quick_cases("SIGTERM")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_a_signal_inside_the_compressor_is_not_taken_for_a_failed_write(strip, tmp_path, name):
    _end_run(strip, tmp_path, _IN_COMPRESSOR.format(name=name))


def test_ctrl_c_inside_the_compressor_reaches_a_program_that_uses_the_library(strip, tmp_path, monkeypatch):
    from wavebatch.files.las import write_points

    class File(write_points.BytesIO):
        def write(self, data):
            os.kill(os.getpid(), signal.SIGINT)
            return super().write(data)

    monkeypatch.setattr(write_points, "BytesIO", File)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        refuses(KeyboardInterrupt, "", run_batch, [make_job(strip)], RunOptions(tmp_path))
        assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    finally:
        signal.signal(signal.SIGINT, before)
    assert list(tmp_path.iterdir()) == []


_LOST = """
import os, signal
from wavebatch.batch import run
from wavebatch.__main__ import main

class Lost:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)  # Python drops what is raised here

start = run.StripTask.start

def lose(self, *parts):
    Lost()
    return start(self, *parts)

run.StripTask.start = lose
main()
"""


def test_an_interrupt_that_python_drops_is_seen_by_the_loop(strip, tmp_path):
    _end_run(strip, tmp_path, _LOST)


_IN_START = """
import multiprocessing.util, os, signal
from wavebatch.__main__ import main

spawn = multiprocessing.util.spawnv_passfds

def spawn_and_signal(path, args, passfds):
    pid = spawn(path, args, passfds)
    if b"spawn_main" in b"".join(map(os.fsencode, args)):  # a worker, which still waits for what it shall do
        os.kill(os.getpid(), signal.SIGTERM)
    return pid

multiprocessing.util.spawnv_passfds = spawn_and_signal
if __name__ == "__main__":
    main()
"""


def test_a_signal_while_a_worker_starts_leaves_no_process_that_complains(strip, tmp_path):
    script = tmp_path / "start.py"
    script.write_text(_IN_START)
    out = tmp_path / "out"
    command = [sys.executable, str(script), "run", str(strip), "-o", str(out), "--profile", "fast", "--jobs", "2"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300)
    assert done.returncode == 130, done.stderr
    assert done.stderr.startswith("interrupted: finished") and done.stderr.count("\n") == 1
    assert not out.exists() or list(out.iterdir()) == []  # processes start before anything else


_CRASHES_AT_THE_END = """
import atexit, os, signal, sys
from wavebatch.core.interrupts import guard

class Crash:
    def __del__(self):
        os.abort()  # as a compiled library does whose import was interrupted

def command():
    global crash
    crash = Crash()
    atexit.register(print, "cleaned up")
    os.kill(os.getpid(), signal.SIGINT)

guard(command)
"""


def test_what_crashes_when_python_ends_does_not_change_the_exit_code():
    done = subprocess.run([sys.executable, "-c", _CRASHES_AT_THE_END], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "cleaned up\n", "interrupted\n")


def test_hardly_anything_is_imported_before_signals_are_handled():
    code = "import sys; import wavebatch.core.interrupts; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-S", "-c", code], capture_output=True, text=True, check=True)
    assert not {"typing", "click", "numpy", "multiprocessing"} & set(done.stdout.split())


def test_a_draft_that_is_left_open_goes_with_its_process(tmp_path):
    code = "import sys; from wavebatch.files.disk.publish import Draft; Draft(sys.argv[1], overwrite=False)"
    subprocess.run([sys.executable, "-c", code, tmp_path / "a"], check=True)
    assert list(tmp_path.iterdir()) == []
    Draft(tmp_path / "a", overwrite=False).discard()
