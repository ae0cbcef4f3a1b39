"""Memory of whole commands in processes of their own: long waveforms, noise, damaged counts, deep files.

Limits leave room for other machines; each case took gigabytes before it was mended.
"""

import json
import os
import struct
import subprocess
import sys

import numpy as np
import pytest
from commands import succeed
from strips import descriptor, make_raw
from writer_tools import read_provenance

from wavebatch.cli import messages
from wavebatch.files.cloud.writer import MOST_PAYLOAD
from wavebatch.files.las.header import MAX_EVLRS, find_evlrs, read_header

pytestmark = pytest.mark.skipif(not os.path.exists("/proc/self/status"), reason="reads peaks from /proc")

_PROGRAM = """
import sys
from wavebatch.__main__ import main
try:
    main()
finally:
    with open("/proc/self/status") as file:
        peak = next(int(line.split()[1]) for line in file if line.startswith("VmHWM"))
    sys.stderr.write(f"PEAK {peak >> 10}\\n")
"""


def measure(*command, code=0):
    """Peak of the resident memory of a command [MB], and what it said."""
    done = subprocess.run(
        [sys.executable, "-c", _PROGRAM, *map(str, command)], capture_output=True, text=True, timeout=300,
        env={**os.environ, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == code, done.stderr
    said, _, peak = done.stderr.rpartition("PEAK ")
    return int(peak), said


def write_noise(path, n, s):
    """Uniform noise: a local maximum at every third sample, none of which is an echo."""
    return make_raw(n, n_samples=s, bits=16).write(path)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "s"), [(1, 65536), (1000, 2000)])
def test_long_waveforms_of_noise_stay_within_the_memory_limit(tmp_path, n, s):
    """Tables of candidates by samples took 7 GB."""
    strip = write_noise(tmp_path / "a.las", n, s)
    peak, _ = measure("run", strip, "-o", tmp_path / "out", "--profile", "accurate", "--memory", "400M")
    assert peak < 400


def test_a_block_of_long_waveforms_has_fewer_of_them():
    from types import SimpleNamespace

    from wavebatch.batch.unit import BLOCK_SAMPLES, _block_size

    for s in (1, 80, 256, 2000, 65536):
        unit = SimpleNamespace(packets=SimpleNamespace(n_samples=np.array([7, s])))
        assert _block_size(unit, None) * max(s, 7) <= max(BLOCK_SAMPLES, 65536 * 7)
        small = _block_size(unit, 1024)
        assert 1 <= small <= 1024 and small * s <= max(1024 * 256, s)
        assert _block_size(unit, 1) == 1


@pytest.mark.slow
def test_simulated_waveforms_have_at_most_as_many_samples_as_are_read(tmp_path):
    peak, _ = measure("simulate", "flat", "-o", tmp_path / "a.las", "--pulses", "300", "--samples", "65536")
    assert peak < 500
    assert read_header(tmp_path / "a.las").point_count == 300
    _, said = measure("simulate", "flat", "-o", tmp_path / "b.las", "--pulses", "1", "--samples", "65537", code=2)
    assert "not in the range 8<=x<=65536" in said


@pytest.fixture
def hole(tmp_path):
    """A strip with a count of 4 billion EVLRs over zeros, each of which is an empty record."""
    raw = make_raw(30, point_format=9, internal=False, minor=4)
    raw.evlr = (0, 0)
    path = raw.write(tmp_path / "a.las")
    size = path.stat().st_size
    with open(path, "r+b") as file:
        file.truncate(size + (200 << 20))
        file.seek(235)
        file.write(struct.pack("<QI", size, 2**32 - 1))
    return path


def test_evlrs_of_a_hole_in_the_file_are_not_listed_for_ever(hole):
    found, missing = find_evlrs(hole, read_header(hole))
    assert len(found) == MAX_EVLRS and len(found) + missing == 2**32 - 1


@pytest.mark.slow
def test_evlrs_of_a_hole_take_no_memory_in_a_run(hole, tmp_path):
    peak, _ = measure("run", hole, "-o", tmp_path / "out", "--profile", "fast", "--format", "las")
    assert peak < 400
    report = json.loads((tmp_path / "out" / "a.report.json").read_text())
    assert any("EVLRs" in one["text"] and str(MAX_EVLRS) in one["text"] for one in report["warnings"])


@pytest.mark.parametrize("text", [".".join(["a"] * 20_000) + " = 1", "[" + ".".join(['"a"'] * 20_000) + "]"])
def test_keys_of_many_parts_are_refused_before_they_take_memory(tmp_path, text):
    chain = tmp_path / "a.toml"
    chain.write_text(text)
    peak, _ = measure("check", chain, code=1)
    assert peak < 150


@pytest.mark.slow
def test_the_account_of_many_digitizers_fits_into_the_cloud(tmp_path):
    """180 digitizers with a pulse each: 75 kB, more than a VLR holds."""
    n, s, k = 4500, 64, 180
    rng = np.random.default_rng(1)
    raw = make_raw(n, n_samples=s, bits=16, most_returns=1)
    width = 2.0 + np.arange(n) % k / 60
    raw.packets = np.rint(
        200 + rng.normal(0, 2, (n, s)) + 500 * np.exp(-0.5 * ((np.arange(s) - 30) / width[:, None]) ** 2)
    ).astype("<u2").tobytes()  # fmt: skip
    raw.vlrs = [descriptor(i + 1, bits=16, samples=s, spacing=1000 + i) for i in range(k)]
    raw.points["wavepacket_index"] = 1 + np.arange(n) % k
    strip = raw.write(tmp_path / "a.las")
    succeed("run", strip, "-o", tmp_path / "out", "--format", "las", "-q")
    (account,) = read_provenance(tmp_path / "out" / "a.las")
    report = json.loads((tmp_path / "out" / "a.report.json").read_text())
    left_out = account["left_out"]["sha256"]
    assert left_out and account["chain"] == report["chain"]
    for name in left_out:
        held = report["strip"]
        for key in name.split("."):
            held = held[key]
        assert held  # the report has it
    assert len(json.dumps(report["strip"])) > MOST_PAYLOAD


def test_too_little_memory_is_an_error_with_a_remedy(tmp_path):
    """The limit of the operating system, in a process of its own."""
    strip = write_noise(tmp_path / "a.las", 2000, 1000)
    code = "import numpy; import wavebatch.batch.run; " + _PROGRAM.replace("    main()", "    limit(); main()").replace(
        "import sys", "import resource, sys"
    ).replace("try:", "def limit():\n    with open('/proc/self/statm') as f: now = int(f.read().split()[0]) * 4096\n"
              "    resource.setrlimit(resource.RLIMIT_AS, (now + (60 << 20),) * 2)\ntry:")  # fmt: skip
    # A name that is no setting loads all commands to be explained, SciPy too, whose BLAS waits for memory for ever.
    kept = {name: value for name, value in os.environ.items() if not name.startswith("WAVEBATCH_")}
    done = subprocess.run(
        [sys.executable, "-c", code.strip(), "run", str(strip), "-o", str(tmp_path / "out")], text=True,
        capture_output=True, timeout=300, env={**kept, "OPENBLAS_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 4, done.stderr
    assert "not enough memory" in done.stderr and "fewer --jobs" in done.stderr and "bug" not in done.stderr
    assert messages.one_line(MemoryError()).startswith("not enough memory; ")
