"""Worker processes that were started for nothing end with the process that started them."""

import os
import subprocess
import sys

import pytest
from batch_tools import is_alive, wait_until

EARLY = """
import os, sys, time
from wavebatch.batch.workers.spawned import start_early
if __name__ == "__main__":
    start_early(2)
    with open(f"/proc/{os.getpid()}/task/{os.getpid()}/children") as file:
        print(file.read(), flush=True)
    if sys.argv[1] == "stopped":
        import signal
        from wavebatch.batch.workers.spawned import _early
        for one in _early:
            os.kill(one.process.pid, signal.SIGSTOP)
"""


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
    # One of them is multiprocessing's own, which ends by itself.
    wait_until(lambda: not any(map(is_alive, children)), "a process stays")


def test_wrong_options_end_a_run_of_several_jobs_as_usual(tmp_path):
    command = [sys.executable, "-m", "wavebatch", "run", "a.las", "-o", str(tmp_path), "--columns", "none"]
    done = subprocess.run([*command, "--jobs", "3"], capture_output=True, text=True, timeout=300)
    assert done.returncode == 2 and done.stderr.count("\n") == 1, done.stderr
