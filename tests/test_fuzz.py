"""Runs the tests of `fuzz_cases` in a process of their own.

They fork a process per case. Threads that other tests start (those of laspy's compressor) would be missing in it, and
what waits for them would wait for ever.
"""

import subprocess
import sys
from pathlib import Path

import pytest

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks a process per case")


def _run(*options):
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", *options]
    cases = Path(__file__).with_name("fuzz_cases.py")
    done = subprocess.run([*command, str(cases)], cwd=cases.parents[1], capture_output=True, text=True, timeout=2000)
    assert done.returncode == 0 and " passed" in done.stdout, done.stdout[-5000:] + done.stderr[-2000:]


def test_damaged_inputs_and_what_failed_once():
    _run("-m", "not slow")


@pytest.mark.slow
def test_hundreds_of_damaged_inputs():
    _run("-m", "slow")
