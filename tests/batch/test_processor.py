"""The kind of the processor, and that results do not depend on it."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from writer_tools import data_file

from wavebatch.batch.workers.worker_check import describe_worker, probe_arithmetic
from wavebatch.tools.simulate import simulate_strip


def test_the_probe_is_the_same_each_time():
    found = describe_worker()
    assert found == describe_worker.__wrapped__()
    assert probe_arithmetic() == probe_arithmetic() and len(found["probe"]) == 16
    assert found["name"]


def test_threads_are_no_other_kind():
    code = "from wavebatch.batch.workers.worker_check import describe_worker; print(describe_worker()['probe'])"
    found = set()
    for threads in ("1", "2", "4"):
        env = {**os.environ, "OPENBLAS_NUM_THREADS": threads}
        found.add(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, env=env).stdout)
    assert len(found) == 1


REAL = {
    "riegl": "riegl-q680i/100429_152240_2535pt_UTM.las",
    "leica": "leica-als/simple1_3_full_internal.las",
    "geolas": "geolas/geolas1.las",
    "lvis": "lvis/lvis1.las",
    "neon": "neon/neon_harv_a.las",
}


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux" or os.uname().machine != "x86_64", reason="kinds of x86 processors")
@pytest.mark.parametrize("others", [1, 4])
@pytest.mark.parametrize("strip", [*REAL, "mixed"])
def test_clouds_and_surveys_are_the_same_bytes_on_other_processors(tmp_path, strip, others):
    """Code of the BLAS for other processors, and NumPy without AVX2, FMA and AVX-512."""
    path = data_file(REAL[strip]) if strip in REAL else tmp_path / "a.las"
    if strip not in REAL:
        simulate_strip(strip, path, pulses=1500, seed=3)
    plain = {"OPENBLAS_CORETYPE": "Prescott", "NPY_DISABLE_CPU_FEATURES": "X86_V3 X86_V4 AVX512_ICL"}
    # Code for a processor with AVX-512 ends at once on one without.
    wide = "avx512f" in Path("/proc/cpuinfo").read_text()
    kinds = [{}, plain, *({"OPENBLAS_CORETYPE": kind} for kind in ("Haswell", *["SkylakeX"] * wide, "ZEN"))]
    found = set()
    for number, kind in enumerate(kinds[: others + 1]):
        out, env = tmp_path / str(number), {**os.environ, "OPENBLAS_NUM_THREADS": "1", **kind}
        command = [sys.executable, "-m", "wavebatch", "run", path, "-o", out, "--format", "las", "-q"]
        subprocess.run(command, check=True, env=env)
        (cloud,), (report,) = out.glob("*.las"), out.glob("*.report.json")
        told = json.loads(report.read_text())
        survey = json.dumps([told[name] for name in ("strip", "choice", "counts", "quality")])
        found.add((cloud.read_bytes(), survey))
    assert len(found) == 1
