"""Worker processes that are killed or stopped at the worst instants: the parent process never waits for them."""

import functools
import multiprocessing.connection
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import Future

import pytest

from wavebatch.batch.workers.futures import WorkerDied
from wavebatch.batch.workers.processes import Workers
from wavebatch.batch.workers.worker_check import _probe_alone
from wavebatch.tools.bench.command import Worker

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")


def square(number):
    return number * number


def raise_error(number):
    raise ValueError(f"bad {number}")


def die_while_sending(keeper=None):
    """The process is killed after half of its result is in the pipe; a child of it, `keeper`, holds the pipe open."""
    if keeper is not None and (child := os.fork()):
        keeper.write_text(str(child))
    elif keeper is not None:
        time.sleep(600)
        os._exit(0)

    def send_half(self, buffer, write=os.write):
        write(self._handle, bytes(buffer)[: len(buffer) // 2])
        os.kill(os.getpid(), signal.SIGKILL)

    multiprocessing.connection.Connection._send = send_half
    return bytes(1000)


def stop(_):
    os.kill(os.getpid(), signal.SIGSTOP)


def stop_idle(asked):
    """The process stops once the file `asked` is there: its caller makes it when all processes wait for calls."""
    parent = os.getpid()
    if os.fork() == 0:
        while not asked.exists():
            if os.getppid() != parent:
                os._exit(1)
            time.sleep(0.01)
        os.kill(parent, signal.SIGSTOP)
        os._exit(0)


def wait_until_stopped(workers):
    """Until one of the processes is stopped."""
    deadline = time.monotonic() + 300
    while not any(_is_stopped(worker.process.pid) for worker in workers._workers):
        assert time.monotonic() < deadline, "no process stops"
        time.sleep(0.01)


def _is_stopped(pid):
    if os.path.exists(f"/proc/{pid}/stat"):
        with open(f"/proc/{pid}/stat") as file:
            return file.read().rpartition(")")[2].split()[0] == "T"
    shown = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False)
    return shown.stdout.startswith("T")


def test_results_and_errors_come_back():
    with Workers(2) as workers:
        futures = [workers.submit(square, number) for number in range(20)] + [workers.submit(raise_error, 7)]
        left = list(futures)
        while left:
            left = [future for future in left if future not in workers.wait(left)]
        assert [future.result() for future in futures[:-1]] == [number**2 for number in range(20)]
        with pytest.raises(ValueError, match="bad 7"):
            futures[-1].result()


@pytest.mark.quick_cases("True")
@pytest.mark.parametrize("kept", [False, True])
def test_a_process_that_dies_while_it_sends_its_result_loses_this_call_only(tmp_path, kept):
    keeper = tmp_path / "keeper" if kept else None
    with Workers(2) as workers:
        dying, fine = workers.submit(die_while_sending, keeper), workers.submit(square, 3)
        while not dying.done():
            workers.wait([dying])
        assert isinstance(dying.exception(), WorkerDied)
        if kept:
            os.kill(int(keeper.read_text()), signal.SIGKILL)  # it is still there: its end was not waited for
        workers.wait([fine])
        assert fine.result() == 9
        again = workers.submit(square, 4)  # by a new process, or the other one
        workers.wait([again])
        assert again.result() == 16


@pytest.mark.quick_cases("stop")
@pytest.mark.parametrize("function", [stop, stop_idle])
def test_a_stopped_process_does_not_keep_this_one_from_ending(tmp_path, function):
    with Workers(2) as workers:
        workers.submit(function, tmp_path / "asked")
        other = workers.submit(square, 5)
        while not other.done():
            workers.wait([other])
        (tmp_path / "asked").touch()
        wait_until_stopped(workers)
    assert not workers._workers


@pytest.mark.slow
def test_calls_that_nobody_has_taken_are_given_up_when_all_processes_are_dead():
    with Workers(2) as workers:
        futures = [workers.submit(die_while_sending) for _ in range(6)]
        while not all(future.done() for future in futures):
            workers.wait([future for future in futures if not future.done()])
        assert all(isinstance(future.exception(), WorkerDied) for future in futures)


_SCRIPT = """
import wavebatch as wb
print("script runs")
result = wb.run({strip!r}, {out!r}, profile="fast", jobs=2)
print(result)
"""

_STAGE_SCRIPT = """
import wavebatch as wb
from wavebatch.core.waveforms import Noise
from wavebatch.stages.chain import STAGES

@wb.stage("noise")
def mine(block: wb.WaveformBlock, system: wb.SystemPulse) -> Noise:
    \"\"\"Noise of this script.\"\"\"
    from wavebatch.stages.noise import pooled
    return pooled(block, system)

def work():
    chain = wb.load_chain("fast")
    steps = (wb.Step(STAGES["noise.mine"]), *chain.steps[1:])
    print(wb.run({strip!r}, {out!r}, chain=wb.Chain(steps, "mine"), jobs=2).failed)
{call}
"""


def _run_script(tmp_path, tiny_strip, text, **more):
    script = tmp_path / "script.py"
    script.write_text(text.format(strip=str(tiny_strip), out=str(tmp_path / "out"), **more))
    return subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=300)


@pytest.mark.slow
def test_a_script_needs_no_main_guard(tiny_strip, tmp_path):
    """Every process ran the user's script: 250 lines of traceback and no cloud."""
    done = _run_script(tmp_path, tiny_strip, _SCRIPT)
    assert done.returncode == 0 and done.stderr == "" and (tmp_path / "out" / "tiny.laz").exists()
    result = "BatchResult(1 strip written, 0 skipped, 0 incomplete, 0 failed)"
    assert done.stdout.splitlines() == ["script runs", result]


def test_no_process_runs_what_lies_in_the_current_folder(tmp_path, monkeypatch):
    """A folder of data may hold a `signal.py`: runs with --jobs and benchmarks failed there, or ran it."""
    (tmp_path / "signal.py").write_text("import pathlib\npathlib.Path('ran').touch()\nraise SystemExit\n")
    monkeypatch.chdir(tmp_path)
    with Workers(1) as workers, Worker() as worker:
        assert workers.submit(square, 3).result() == 9 and worker.call(abs, -1) == 1
    assert _probe_alone.__wrapped__()
    assert [path.name for path in tmp_path.iterdir()] == ["signal.py"]


@pytest.mark.slow
def test_a_script_with_a_stage_needs_one_and_says_so(tiny_strip, tmp_path):
    done = _run_script(tmp_path, tiny_strip, _STAGE_SCRIPT, call='if __name__ == "__main__":\n    work()')
    assert done.returncode == 0 and done.stdout == "0\n", done.stderr
    (tmp_path / "out" / "tiny.laz").unlink()
    (tmp_path / "out" / "tiny.report.json").unlink()
    done = _run_script(tmp_path, tiny_strip, _STAGE_SCRIPT, call="work()")
    assert "Traceback" not in done.stderr and done.stderr.startswith("error: this script has a stage")


_INTERRUPTED = """
import os, signal, sys
from multiprocessing.process import BaseProcess
from pathlib import Path
sys.path.insert(0, {tests!r})
from test_processes import stop_idle, wait_until_stopped
from wavebatch.batch.workers.processes import Workers
from wavebatch.core.interrupts import guard

def interrupt():
    os.kill(os.getpid(), signal.SIGINT)

def interrupt_join(process, seconds, join=BaseProcess.join):
    BaseProcess.join = join
    interrupt()

def command():
    with Workers(2) as workers:
        asked = Path({asked!r})
        call = workers.submit(stop_idle, asked)
        while not call.done():
            workers.wait([call])
        asked.touch()
        wait_until_stopped(workers)
        if {early}:
            workers._end = interrupt
        else:
            BaseProcess.join = interrupt_join

if __name__ == "__main__":
    guard(command)
"""


@pytest.mark.quick_cases("True")
@pytest.mark.parametrize("early", [True, False])
def test_ctrl_c_while_a_stopped_process_is_waited_for_does_not_hang(tmp_path, early):
    """The interrupt came between the wait for the process and its kill, and Python waited for it at its end."""
    script = tmp_path / "interrupted.py"
    asked = str(tmp_path / "asked")
    script.write_text(_INTERRUPTED.format(tests=os.path.dirname(__file__), early=early, asked=asked))
    done = subprocess.run([sys.executable, str(script)], capture_output=True, text=True, timeout=300)
    assert done.returncode == 130 and done.stderr == "interrupted\n", done.stderr


def test_an_interrupt_at_any_line_of_a_wait_leaves_no_lock_taken():
    """The thread that settles the future waited for a lock of the interrupted `wait`, and `cancel` for that thread."""
    workers = Workers(1)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        for number in range(1, 200):
            # Where the timer comes before the wait, fewer lines are run: only many waits in a row show the last line.
            if not any(_interrupt_wait(workers, number) for _ in range(20)):
                break
        assert number > 50  # lines
    finally:
        signal.signal(signal.SIGINT, before)


def _interrupt_wait(workers, number):
    """Interrupt the wait for a future at this line; whether it came so far. Its thread must end."""
    future: Future = Future()
    thread = threading.Timer(0.01, future.set_result, (1,))
    thread.daemon = True
    thread.start()
    seen = _interrupt_at(number, workers.wait, [future])
    thread.join(100)
    assert not thread.is_alive(), f"line {number}"
    return seen


def _interrupt_at(number, function, *arguments):
    """Send SIGINT when the function runs this line of the library of threads; whether it came so far."""
    count = 0

    def trace(frame, event, argument):
        nonlocal count
        if event == "line" and frame.f_code.co_filename.endswith(("threading.py", "_base.py")):
            count += 1
            if count == number:
                sys.settrace(None)
                os.kill(os.getpid(), signal.SIGINT)
        return trace

    try:
        sys.settrace(trace)
        function(*arguments)
    except KeyboardInterrupt:
        pass
    finally:
        sys.settrace(None)
    return count >= number


@pytest.mark.skipif(sys.platform != "linux", reason="a limit of processes")
def test_a_process_that_the_system_refuses_is_one_line(tiny_strip, tmp_path):
    """It said to check disk and permissions. Root has no limit of processes, so that of open files must do."""
    words = f"ulimit -n 24; exec '{sys.executable}' -m wavebatch run '{tiny_strip}' -o '{tmp_path}/out' --jobs 40 -q"
    done = subprocess.run(["bash", "-c", words], capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 4 and "of --jobs cannot be started (Too many open files); use fewer" in done.stderr
    assert done.stderr.count("\n") == 1, done.stderr


def die_elsewhere(parent, number):
    if os.getpid() != parent and number == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def test_map_gives_results_in_order_and_makes_calls_itself_that_kill_a_process():
    with Workers(2) as workers:
        call = functools.partial(die_elsewhere, os.getpid())
        assert list(workers.map(call, range(12))) == [number**2 for number in range(12)]
        with pytest.raises(ValueError, match="bad 0"):
            list(workers.map(raise_error, range(3)))
    with Workers(1) as workers:
        assert list(workers.map(square, range(3))) == [0, 1, 4]
