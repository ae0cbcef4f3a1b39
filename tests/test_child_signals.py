"""Tests that interrupt children work also where signals are ignored from the start, as under `nohup make test &`."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

_STARTED_IGNORING = """
import os, signal, subprocess, sys
for number in signal.SIGINT, signal.SIGTERM, signal.SIGHUP:
    signal.signal(number, signal.SIG_IGN)
sys.exit(subprocess.run([sys.executable, "-c", {parent!r}]).returncode)
"""

_PARENT = """
import os, signal, subprocess, sys
from child_signals import give_children_default_signals
give_children_default_signals()
print(subprocess.run([sys.executable, "-c", "import os; os.kill(os.getpid(), {number})"]).returncode, flush=True)
os.kill(os.getpid(), {number})
print("goes on")
"""


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")
@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_children_do_not_inherit_ignored_signals(name):
    number = getattr(signal, name)
    code = _STARTED_IGNORING.format(parent=_PARENT.format(number=int(number)))
    env = {**os.environ, "PYTHONPATH": str(Path(__file__).parent)}
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, env=env)
    assert done.returncode == 0, done.stderr
    assert done.stdout.split("\n")[:2] == [str(-number), "goes on"]


@pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX systems")
def test_the_tests_themselves_run_with_signals_that_children_get():
    for number in signal.SIGINT, signal.SIGTERM, signal.SIGHUP:
        assert signal.getsignal(number) is not signal.SIG_IGN
