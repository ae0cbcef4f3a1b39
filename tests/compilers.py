"""Compilers for the slow tests of the C: the machine's, and zig, which also builds for other processors."""

import os
import shutil
import subprocess
import sys

import pytest

from wavebatch.kernels.build_kernels import FLAGS, ZIG, find_compiler

STRICT = [flag for flag in FLAGS if flag not in ("-shared", "-fvisibility=hidden")]
"""The flags of the library, for a program."""


def machine_compiler() -> list[str]:
    """The command of the machine's compiler; skips the test where there is none."""
    if not any(map(shutil.which, ("cc", "gcc", "clang"))):
        pytest.skip("needs cc, gcc or clang on this machine")
    return find_compiler()


def install_zig(folder) -> tuple[list[str], dict[str, str]]:
    """Zig in the folder: its command and its environment; skips the test where pip cannot get it."""
    call = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--quiet",
        "--only-binary=:all:",
        "--target",
        str(folder),
        "ziglang",
    ]
    done = subprocess.run(call, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"pip does not get ziglang: {done.stderr.strip().splitlines()[-1:]}")
    caches = {name: str(folder / "cache") for name in ("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR")}
    return [word for word in ZIG if word != "-mcpu=baseline"], {**os.environ, **caches, "PYTHONPATH": str(folder)}
