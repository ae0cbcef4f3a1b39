"""Every command on damaged or strange input: a documented exit code, one line per failure, no warning, no leftovers."""

import json
import os
import re
import subprocess
import sys
import time

import laspy
import numpy as np
import pytest
from commands import run_command, succeed
from strips import make_raw

from wavebatch.cli.messages import printable
from wavebatch.core.echoes import EchoFlag
from wavebatch.files import text_file
from wavebatch.tools.simulate import simulate_strip

SIGNALLING = 0x7F800001
"""A signalling NaN: NumPy warns when it is cast."""


def invoke(command, strip, out):
    """Runs a command on a strip and holds it to its promises; its exit code."""
    arguments = {
        "run": ["-o", out, "--profile", "fast", "-q"],
        "compare": [strip],
        "slice": ["-o", out / "a.csv", "-q"],
        "survey": ["-o", out / "a.toml"],
        "synthesize": ["-o", out / "a.las", "-q"],
    }.get(command, [])
    out.mkdir(exist_ok=True)
    done = run_command(command, strip, *arguments)
    assert done.exit_code in {"run": (0, 4), "compare": (0, 2)}.get(command, (0, 1)), done.output
    left = [path.name for path in out.iterdir()]
    assert not any(name.startswith(".") for name in left)
    if done.exit_code:
        told = done.stdout if command == "check" else done.stderr
        assert str(strip) in told and not left
        assert command == "check" or done.stderr.startswith("error: ") and done.stderr.count("\n") == 1
        assert "bug" not in told
    for path in out.iterdir():
        path.unlink()
    return done.exit_code


COMMANDS = ["run", "info", "check", "survey", "compare", "stats", "slice", "synthesize"]


@pytest.mark.quick_cases("4-return_point_wave_location", "9-gps_time")
@pytest.mark.parametrize("field", ["return_point_wave_location", "x_t", "z_t", "gps_time"])
@pytest.mark.parametrize("point_format", [4, 9])
def test_signalling_nans_in_points_are_no_numbers_and_no_warnings(tmp_path, point_format, field):
    raw = make_raw(60, point_format=point_format)
    kind = raw.points[field].dtype
    bits = np.array([SIGNALLING if kind.itemsize == 4 else 0x7FF0000000000001], f"<u{kind.itemsize}")
    raw.points[field][::3] = bits.view(kind)
    strip = raw.write(tmp_path / "a.las")
    for command in COMMANDS:
        invoke(command, strip, tmp_path / "out")


@pytest.mark.parametrize("command", ["run", "slice", "voxelize", "export"])
def test_what_a_strip_lacks_is_named_by_all_that_read_packets(tmp_path, command):
    """With --quiet too: of a strip whose header claims too few points, `run` lost the others without a word."""
    raw = make_raw(60)
    raw.count = len(raw.points) - 3
    raw.points["wavepacket_offset"][5] = 1
    more = {"run": ["out", "--profile", "fast"], "slice": ["a.csv"], "voxelize": ["a.npz", "--size", "2"],
            "export": ["a.las"]}[command]  # fmt: skip
    strip = raw.write(tmp_path / "strip.las")
    for quiet in ([], ["-q"]):
        said = succeed(command, strip, "-o", tmp_path / more[0], *more[1:], "--overwrite", *quiet).stderr
        assert "the header claims" in succeed("stats", strip).stdout
        lost = "with a packet before the start" if command == "run" else "cannot be used"
        assert "warning: the header claims" in said and lost in said, said
        if command == "run":
            warnings = json.loads((tmp_path / "out" / "strip.report.json").read_text())["warnings"]
            assert {one["code"] for one in warnings} >= {"lost-points", "lost-packets"}


def test_a_cloud_that_seems_to_hold_more_points_is_named_by_all_that_read_it(tmp_path):
    """Maps and rasters of a part of the points had no word about the others."""
    strip, cloud = tmp_path / "a.las", tmp_path / "out" / "a.las"
    simulate_strip("urban", strip, pulses=300, seed=1)
    succeed("run", strip, "-o", cloud.parent, "--profile", "fast", "--format", "las", "-q")
    for path in (strip, cloud):
        with path.open("r+b") as file:
            file.seek(107 if path == strip else 247)
            few = int.from_bytes(file.read(4), "little") - 50
            file.seek(-4, 1)
            file.write(few.to_bytes(4, "little"))
    line = "the header claims .* which leaves room for 50 more"
    for words in (
        "plot histogram out/a.las --column amplitude -o a.png", "compare out/a.las out/a.las",
        "compare --strip a.las fast balanced", "plot waveform a.las -o b.csv", "synthesize out/a.las -o c.las",
    ):  # fmt: skip
        said = succeed(*(tmp_path / word if word[-4:-3] == "." else word for word in words.split())).stderr
        assert re.search(f"warning: .*{line}", said), (words, said)
    assert re.search(line, succeed("info", cloud).stdout)


def test_a_point_at_the_limit_of_the_integers_is_flagged(tmp_path, edit_points):
    """It failed its strip, because an echo beside it cannot be stored."""
    simulate_strip("flat", tmp_path / "a.las", pulses=300, seed=1)
    edges = {5: ("X", -(2**31)), 9: ("Z", 2**31 - 1), 14: ("Y", 2**30)}

    def damage(points):
        for row, (axis, value) in edges.items():
            points[axis][row] = value

    edit_points(tmp_path / "a.las", tmp_path / "b.las", damage)
    said = succeed("run", tmp_path / "b.las", "-o", tmp_path / "out", "--profile", "fast").stderr
    assert "warning: 2 points (first: point 5) with coordinates at the limit of the file's integers" in said
    report = json.loads((tmp_path / "out" / "b.report.json").read_text())
    assert report["counts"]["points_broken"] == 2
    cloud = laspy.read(tmp_path / "out" / "b.laz")
    first, second = cloud.points[np.asarray(cloud["echo_flags"]) & int(EchoFlag.BROKEN_PACKET) > 0]
    assert (first.X, second.Z) == (-(2**31), 2**31 - 1)
    assert np.count_nonzero(np.abs(cloud.Y - 2**30) < 10_000)  # far off, but it has room for echoes


@pytest.mark.slow
def test_python_without_docstrings_runs(tmp_path):
    """The meanings of parameters are docstrings: under PYTHONOPTIMIZE=2 no stage could be declared."""
    simulate_strip("flat", tmp_path / "a.las", pulses=60, seed=1)
    command = [sys.executable, "-OO", "-m", "wavebatch", "run", "a.las", "-o", "out", "-q"]
    subprocess.run(command, cwd=tmp_path, check=True, env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"})


def test_infinite_times_are_no_warning_of_numpy(tmp_path):
    strip = tmp_path / "a.las"
    simulate_strip("urban", strip, pulses=300, seed=1)
    with strip.open("r+b") as file:
        header = file.read(235)
        start, size = (int.from_bytes(header[at:end], "little") for at, end in ((96, 100), (105, 107)))
        for point in range(100, 200):
            file.seek(start + point * size + 20)
            file.write(np.float64(np.inf).tobytes())
    succeed("run", strip, "-o", tmp_path / "out", "--columns", "+range", "-q")


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX systems")
@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_no_file_is_refused_at_once(tmp_path, command):
    """A pipe would block for ever."""
    os.mkfifo(tmp_path / "pipe.las")
    (tmp_path / "empty.las").touch()
    (tmp_path / "dangling.las").symlink_to(tmp_path / "none")
    for name in ("pipe.las", "empty.las", "dangling.las", "missing.las"):
        assert invoke(command, tmp_path / name, tmp_path / "out"), name


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes")
@pytest.mark.parametrize(
    "name", [b"not \xff utf-8.las", b"two\nlines.las", b"red \x1b[31m.las", "größe 点.las".encode()]
)
def test_names_of_files_may_hold_anything(tmp_path, name):
    strip = tmp_path / os.fsdecode(name)
    strip.write_bytes(make_raw(60).write(tmp_path / "plain.las").read_bytes())
    out = ["-o", str(tmp_path / "out"), "--profile", "fast"]
    for more in ([], ["--resume"]):
        done = succeed("run", strip, *out, *more, "--report", tmp_path / "batch.json")
        assert all(line.startswith(printable(str(strip))) for line in done.stderr.splitlines()), done.stderr
        assert "\x1b" not in done.stderr
    assert "is up to date, skipped" in done.stderr
    assert json.loads((tmp_path / "batch.json").read_text("utf-8"))["strips"][0]["strip"] == str(strip)
    strip.write_bytes(b"nothing")
    done = run_command("run", strip, *out, "--overwrite")
    assert done.exit_code == 4 and done.stderr.count("\n") == 1 and done.stderr.startswith("error: /")


def test_names_of_columns_are_read_in_linear_time(tmp_path):
    """A pattern took 40 s for 100 kB of brackets."""
    strip, path = tmp_path / "a.las", tmp_path / "t.txt"
    simulate_strip("flat", strip, pulses=60, seed=1)
    path.write_text("[" * 1_000_000 + ",time,x,y,z\n")
    start = time.process_time()
    done = run_command("run", strip, "-o", tmp_path / "out", "--trajectory", path)
    assert done.exit_code == 4 and "t.txt" in done.stderr and time.process_time() - start < 10


def test_stats_writes_no_table_that_lacks_a_cloud(tmp_path):
    simulate_strip("flat", tmp_path / "a.las", pulses=60, seed=1)
    (tmp_path / "b.las").write_bytes(b"nothing")
    table = tmp_path / "t.csv"
    done = run_command("stats", tmp_path / "a.las", tmp_path / "b.las", "-o", table)
    assert done.exit_code == 1 and not table.exists()
    assert "t.csv: not written, because 1 cloud of 2 cannot be read" in done.stderr and "a.las" in done.stdout


def test_names_are_printed_without_escapes_of_the_terminal(tmp_path):
    strip = tmp_path / "red \x07\x1b[31m.las"  # click itself takes colours off where the output is no terminal
    simulate_strip("flat", strip, pulses=60, seed=1)
    for words in (["info"], ["check"], ["stats"], ["run", "--dry-run", "-o", str(tmp_path / "out")]):
        assert "red \\x07\\x1b[31m" in succeed(*words, strip).stdout


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX systems")
def test_a_chain_can_come_through_a_pipe(tmp_path):
    """As in --chain <(sed ... chain.toml); also from a writer that takes its time."""
    strip, pipe = make_raw(60).write(tmp_path / "a.las"), tmp_path / "pipe"
    os.mkfifo(pipe)
    slowly = f"exec > '{pipe}'; sleep 0.3; printf x; sleep 0.3; printf 'y = 1'; head -c 200000 /dev/zero | tr '\\0' '#'"
    writer = subprocess.Popen(["sh", "-c", slowly])
    done = run_command("check", strip, "-q")  # the command line itself is fine
    text = text_file.read_text(pipe, "chain file")
    assert writer.wait() == 0 and text.startswith("xy = 1#") and len(text) == 200_006, done.output


def test_damaged_arrays_are_one_line(tmp_path):
    """Errors of zipfile, zlib and Python's tokenizer came through; sizes that a damaged header claims were taken."""
    import io
    import zipfile

    sound = io.BytesIO()
    np.savez(sound, values=np.zeros((2, 3, 4), "f4"), time=np.arange(4.0), line=np.arange(2))
    cube, plain = tmp_path / "cube.npz", sound.getvalue()
    with zipfile.ZipFile(sound) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    for old, new in (
        (b"PK\x03\x04", b"PKxx"), (b"(2, 3, 4), }", b"(2, 3, [[[, "), (b"(2, 3, 4)", b"(999999,)"), (b"<f4", b"|O "),
        (b"'shape': (4,)", b"'shape': (-4)"), (b"(2, 3, 4), }", b"(2, 999999)}"),
    ):  # fmt: skip
        assert old in plain
        with zipfile.ZipFile(cube, "w") as file:  # the checksums are right
            for name, content in members.items():
                file.writestr(name, content.replace(old, new))
        if old.startswith(b"PK"):
            cube.write_bytes(plain.replace(old, new))
        done = run_command("plot", "cube", cube, "-o", tmp_path / "a.png")
        assert done.exit_code == 1 and "holds no cube" in done.stderr and done.stderr.count("\n") == 1, done.stderr


@pytest.mark.quick_cases("<&- >&- 2>&-")
@pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX systems")
@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_do_no_harm(tmp_path, closed):
    """As a daemon has them: run asked whether stderr is a terminal, and files got the numbers of the streams."""
    strip = tmp_path / "a.las"
    simulate_strip("flat", strip, pulses=60, seed=1)
    words = f"'{sys.executable}' -m wavebatch run '{strip}' -o '{tmp_path}/out' --profile fast {closed}"
    done = subprocess.run(["sh", "-c", words], capture_output=True, check=False)
    assert done.returncode == 0 and (tmp_path / "out" / "a.report.json").exists()
    words = f"'{sys.executable}' -m wavebatch run '{tmp_path}/none.las' -o '{tmp_path}/out' {closed}"
    assert subprocess.run(["sh", "-c", words], capture_output=True, check=False).returncode == 4


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="a device that is full")
def test_a_full_stderr_does_not_stop_the_batch(tmp_path):
    """The first message of a strip ended the whole run."""
    for name in ("a", "b"):
        simulate_strip("flat", tmp_path / f"{name}.las", pulses=60, seed=1)
    words = [sys.executable, "-m", "wavebatch", "run", tmp_path, "-o", tmp_path / "out", "--profile", "fast"]
    with open("/dev/full", "wb") as full:
        assert subprocess.run(words, stderr=full, check=False).returncode == 0
    assert sorted(path.name for path in (tmp_path / "out").glob("*.json")) == ["a.report.json", "b.report.json"]
