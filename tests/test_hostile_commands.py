"""Every command on damaged or strange input: a documented exit code, one line per failure, no warning, no leftovers."""

import json
import os
import random
import sys

import numpy as np
import pytest
from click.testing import CliRunner
from strips import make_raw

from wavebatch.cli import main
from wavebatch.cli.messages import printable
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
    done = CliRunner().invoke(main, [command, str(strip), *map(str, arguments)])
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


@pytest.mark.skipif(sys.platform == "win32", reason="pipes of POSIX systems")
@pytest.mark.parametrize("command", COMMANDS)
def test_what_is_no_file_is_refused_at_once(tmp_path, command):
    """A pipe would block for ever."""
    os.mkfifo(tmp_path / "pipe.las")
    (tmp_path / "empty.las").touch()
    (tmp_path / "dangling.las").symlink_to(tmp_path / "none")
    for name in ("pipe.las", "empty.las", "dangling.las", "missing.las"):
        assert invoke(command, tmp_path / name, tmp_path / "out"), name


@pytest.mark.parametrize("suffix", [".las", ".laz"])
def test_damaged_strips_through_every_command(tmp_path, suffix):
    rng = random.Random(suffix)
    strip = tmp_path / f"a{suffix}"
    simulate_strip("urban", strip, pulses=100, seed=1)
    whole = strip.read_bytes()
    points_at = int.from_bytes(whole[96:100], "little")
    for _ in range(12):
        data = bytearray(whole)
        for _ in range(rng.choice([1, 3, 20])):
            at = rng.randrange(points_at + 8 if rng.random() < 0.4 else len(data))
            width = rng.choice([1, 2, 4, 8])
            data[at : at + width] = rng.choice([b"\xff" * width, bytes(width), rng.randbytes(width)])
        strip.write_bytes(data)
        for command in rng.sample(COMMANDS, 3):
            invoke(command, strip, tmp_path / "out")


@pytest.mark.skipif(sys.platform != "linux", reason="names of any bytes")
@pytest.mark.parametrize(
    "name", [b"not \xff utf-8.las", b"two\nlines.las", b"red \x1b[31m.las", "größe 点.las".encode()]
)
def test_names_of_files_may_hold_anything(tmp_path, name):
    strip = tmp_path / os.fsdecode(name)
    strip.write_bytes(make_raw(60).write(tmp_path / "plain.las").read_bytes())
    out = ["-o", str(tmp_path / "out"), "--profile", "fast"]
    for more in ([], ["--resume"]):
        done = CliRunner().invoke(main, ["run", str(strip), *out, *more, "--report", str(tmp_path / "batch.json")])
        assert done.exit_code == 0, done.stderr
        assert all(line.startswith(printable(str(strip))) for line in done.stderr.splitlines()), done.stderr
        assert "\x1b" not in done.stderr
    assert "is up to date, skipped" in done.stderr
    assert json.loads((tmp_path / "batch.json").read_text("utf-8"))["strips"][0]["strip"] == str(strip)
    strip.write_bytes(b"nothing")
    done = CliRunner().invoke(main, ["run", str(strip), *out, "--overwrite"])
    assert done.exit_code == 4 and done.stderr.count("\n") == 1 and done.stderr.startswith("error: /")
