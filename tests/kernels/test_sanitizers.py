"""The C under the sanitizers of GCC: random and hostile arrays, damaged strips (tests/sanitizing.py)."""

import subprocess
import sys
from pathlib import Path

import pytest
import sanitizing

from wavebatch.kernels.build_kernels import compile_library

SCRIPT = Path(sanitizing.__file__)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not sanitizing.find_runtimes(), reason="needs gcc with libasan and libubsan"),
]


def test_random_arrays_and_damaged_strips_misuse_no_memory():
    call = [sys.executable, str(SCRIPT), "--problems", "1000", "--strips", "40"]
    done = subprocess.run(call, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr[-4000:]
    words = done.stdout.split()
    assert words[0] == "1000" and int(words[2]) > 900


def test_a_read_outside_of_the_samples_would_be_seen(tmp_path):
    """As it would be if Python did not check the windows before the call."""
    built = tmp_path / "sanitized.so"
    compile_library(built, sanitizing.FLAGS)
    code = f"""
import sys
from pathlib import Path
sys.path.insert(0, {str(SCRIPT.parent)!r})
import numpy as np
from sanitizing import draw_problem
from wavebatch.kernels import library
from wavebatch.kernels.fit import decompose
library.LIBRARY = Path({str(built)!r})
samples, candidates, clusters, settings = draw_problem(np.random.default_rng(1))
try:
    further = clusters._replace(high=clusters.high + 5000)
    decompose.decompose_clusters(samples, candidates, further, settings)
except ValueError as error:
    print(error)
checked = decompose._as_problem(samples, candidates, clusters, settings)
checked[1].arrays[1].high[:] += 5000
decompose._as_problem = lambda *_: checked
decompose.decompose_clusters(samples, candidates, clusters, settings)
"""
    done = subprocess.run([sys.executable, "-c", code], env=sanitizing.environment(), capture_output=True, text=True)
    assert "a window lies outside of its waveform" in done.stdout
    assert done.returncode == 99 and "heap-buffer-overflow" in done.stderr, done.stderr
