"""The kind of the processor: equal where arithmetic is, different where a BLAS takes other code."""

import os
import subprocess
import sys

import pytest

from wavebatch.batch.workers.processor import describe_processor, probe_arithmetic
from wavebatch.tools.simulate import simulate_strip

KINDS = ("Haswell", "SkylakeX", "Prescott")


def _probe(kind):
    code = "from wavebatch.batch.workers.processor import probe_arithmetic; print(probe_arithmetic())"
    env = {**os.environ, "OPENBLAS_CORETYPE": kind, "OPENBLAS_NUM_THREADS": "1"}
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=env).stdout


def test_the_probe_is_the_same_each_time():
    assert describe_processor() == describe_processor()
    assert probe_arithmetic() == probe_arithmetic() and len(describe_processor()["probe"]) == 16
    assert describe_processor()["name"]


def test_threads_are_no_other_kind():
    code = "from wavebatch.batch.workers.processor import describe_processor; print(describe_processor()['probe'])"
    found = set()
    for threads in ("1", "2", "4"):
        env = {**os.environ, "OPENBLAS_NUM_THREADS": threads}
        found.add(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, env=env).stdout)
    assert len(found) == 1


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux" or os.uname().machine != "x86_64", reason="kinds of x86 processors")
def test_strips_differ_only_between_processors_that_the_probe_tells_apart(tmp_path):
    """Else `run --scheduler` would mix them."""
    simulate_strip("mixed", tmp_path / "a.las", pulses=1500, seed=3)
    probes, clouds = [], []
    for kind in KINDS:
        out = tmp_path / kind
        env = {**os.environ, "OPENBLAS_CORETYPE": kind, "OPENBLAS_NUM_THREADS": "1"}
        command = ["run", tmp_path / "a.las", "-o", out, "--format", "las", "-q"]
        subprocess.run([sys.executable, "-m", "wavebatch", *map(str, command)], check=True, env=env)
        probes.append(_probe(kind))
        clouds.append((out / "a.las").read_bytes())
    for i in range(len(KINDS)):
        for j in range(i):
            assert probes[i] != probes[j] or clouds[i] == clouds[j], (KINDS[i], KINDS[j])
