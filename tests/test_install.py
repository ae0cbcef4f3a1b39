"""Installation: from a wheel, from a source distribution, and with make on a machine that has no C compiler."""

import os
import shutil
import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

from wavebatch.kernels.build_kernels import LIBRARY, find_compiler

ROOT = Path(__file__).resolve().parent.parent
pytestmark = [pytest.mark.slow, pytest.mark.skipif(sys.platform == "win32", reason="needs sh and make")]
TOOLS = ("make", "sh", "echo", "env", "rm", "mkdir", "touch", "cp", "uname", "dirname")
"""What the Makefile calls, with Python."""


def run(command, folder, environment=None):
    """What a command prints; it must not fail."""
    done = subprocess.run(list(map(str, command)), cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-4000:]
    return done.stdout


@pytest.fixture
def checkout(tmp_path):
    """The files that git tracks, as they are here."""
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("needs a checkout of git")
    names = run(["git", "ls-files", "-z"], ROOT).split("\0")
    for name in filter(None, names):
        if (ROOT / name).exists():
            (tmp_path / "checkout" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, tmp_path / "checkout" / name)
    return tmp_path / "checkout"


def plain_environment(**others):
    """Without what points into this checkout."""
    return {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")} | others


def bare_path(folder):
    """A folder for PATH that has make and Python, but no compiler."""
    folder.mkdir()
    for tool in TOOLS:
        (folder / tool).symlink_to(shutil.which(tool))
    (folder / "python3").symlink_to(Path(sys.executable).resolve())
    return plain_environment(PATH=str(folder), CC="")


def test_make_needs_no_compiler(checkout, tmp_path):
    """pip gets one; its library gives the cloud of this checkout's."""
    environment = bare_path(tmp_path / "bin")
    assert not any(shutil.which(name, path=environment["PATH"]) for name in ("cc", "gcc", "clang", "zig"))
    # A cache in the home would not be noticed.
    (tmp_path / "home").mkdir()
    said = run(["make", "demo"], checkout, {**environment, "HOME": str(tmp_path / "home")})
    assert "completeness" in said and "correctness" in said
    built = checkout / "wavebatch" / "kernels" / LIBRARY.name
    assert b"GCC: (" not in built.read_bytes()
    assert not list(built.parent.glob(".build-*")) and not (tmp_path / "home" / ".cache" / "zig").exists()
    made = checkout / "demo" / "out" / "forest.laz"
    here = [
        "-m",
        "wavebatch",
        "run",
        checkout / "demo" / "forest.laz",
        "-o",
        tmp_path / "here",
        "--profile",
        "accurate",
    ]
    run([sys.executable, *here], ROOT)
    assert (tmp_path / "here" / "forest.laz").read_bytes() == made.read_bytes()
    few = {**environment, "PYTEST_ADDOPTS": "-k 'test_library or test_fit or test_decompose'"}
    assert " passed" in run(["make", "test"], checkout, few)


@pytest.mark.parametrize("kind", ["wheel", "sdist"])
def test_a_distribution_works_in_a_fresh_environment(checkout, tmp_path, kind):
    if find_compiler() is None:
        pytest.skip("needs a C compiler")
    fresh, made, away = tmp_path / "fresh", tmp_path / "made", tmp_path / "away"
    away.mkdir()
    environment = plain_environment()
    run([sys.executable, "-m", "venv", fresh], away, environment)
    pip = [fresh / "bin" / "python", "-m", "pip", "--quiet", "--disable-pip-version-check"]
    if kind == "wheel":
        run([*pip, "wheel", "--no-deps", "--wheel-dir", made, checkout], away, environment)
        (distribution,) = made.glob("wavebatch-*-py3-none-*.whl")
        assert "none-any" not in distribution.name
        with zipfile.ZipFile(distribution) as archive:
            names = archive.namelist()
    else:
        run([*pip, "install", "setuptools>=77"], away, environment)
        backend = "import sys; sys.path.insert(0, 'wavebatch/kernels'); import build_kernels"
        made.mkdir()
        run(
            [fresh / "bin" / "python", "-c", f"{backend}; build_kernels.build_sdist({str(made)!r})"],
            checkout,
            environment,
        )
        (distribution,) = made.glob("wavebatch-*.tar.gz")
        with tarfile.open(distribution) as archive:
            names = [name.partition("/")[2] for name in archive.getnames()]
    assert (f"wavebatch/kernels/{LIBRARY.name}" in names) == (kind == "wheel")
    assert ("wavebatch/kernels/c/library.c" in names) == (kind == "sdist")
    assert not [name for name in names if name.startswith("tests")]
    shutil.rmtree(checkout)
    run([*pip, "install", distribution], away, environment)
    program = fresh / "bin" / "wavebatch"
    run([program, "simulate", "forest", "-o", "strip.laz", "--pulses", "2000", "--seed", "1"], away, environment)
    run([program, "run", "strip.laz", "-o", "clouds"], away, environment)
    code = (
        "import wavebatch; from wavebatch.kernels import build_kernels as b; "
        "print(wavebatch.__file__, b.is_outdated(), b.SOURCES.exists())"
    )
    where, *facts = run([fresh / "bin" / "python", "-c", code], away, environment).split()
    assert Path(where).is_relative_to(fresh) and facts == ["False", "False"]
    run([sys.executable, "-m", "wavebatch", "run", away / "strip.laz", "-o", tmp_path / "here"], ROOT)
    assert (tmp_path / "here" / "strip.laz").read_bytes() == (away / "clouds" / "strip.laz").read_bytes()
