"""Builds of the C by several compilers for several processors print the same bits of the same fits (tests/c/fits.c)."""

import ctypes
import os
import platform
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from compilers import STRICT, install_zig, machine_compiler

from wavebatch.kernels.build_kernels import compile_library
from wavebatch.kernels.library import load

PROGRAM = Path(__file__).resolve().parents[1] / "c" / "fits.c"
pytestmark = pytest.mark.slow
on_x86 = pytest.mark.skipif(platform.machine() not in ("x86_64", "AMD64"), reason="instructions of x86-64")


def build_and_run(command, target, run=(), environment=None):
    """What the program prints that the command builds."""
    call = [*command, str(PROGRAM), "-o", str(target), "-lm"]
    done = subprocess.run(call, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    done = subprocess.run([*run, str(target)], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture(scope="module")
def zig(tmp_path_factory):
    return install_zig(tmp_path_factory.mktemp("zig"))


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Of the machine's compiler, for any processor of its kind."""
    return build_and_run([*machine_compiler(), *STRICT], tmp_path_factory.mktemp("plain") / "fits")


def has(instructions):
    """Whether this processor has them all."""
    cpuinfo = Path("/proc/cpuinfo")
    return cpuinfo.exists() and set(instructions) <= set(cpuinfo.read_text().split())


def test_all_models_and_options_are_fitted(plain):
    lines = plain.splitlines()
    cases = {line.rpartition(" ")[0] for line in (line.partition(":")[0] for line in lines)}
    assert len(cases) == 18 and len(lines) == 18 * 24
    echoes = [int(line.partition(": ")[2].split()[0]) for line in lines]
    assert min(echoes) == 1 and max(echoes) >= 5 and sum(number > 1 for number in echoes) > 100
    assert sum("converged 1" in line for line in lines) > 0.9 * len(lines) and "nan" not in plain


@on_x86
@pytest.mark.parametrize(
    "flags", [["-mavx2", "-mfma"], ["-march=x86-64-v4"], ["-O0"], ["-O2"], ["-DWIDEST=4"], ["-DWIDEST=8"]], ids=" ".join
)
def test_instructions_and_optimisation_do_not_change_a_bit(plain, tmp_path, flags):
    if flags == ["-march=x86-64-v4"] and not has(("avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl")):
        pytest.skip("this processor has no AVX-512")
    if "-mavx2" in flags and not has(("avx2", "fma")):
        pytest.skip("this processor has no AVX2")
    assert build_and_run([*machine_compiler(), *STRICT, *flags], tmp_path / "fits") == plain


@on_x86
def test_contracted_products_would_be_seen(plain, tmp_path):
    if not has(("avx2", "fma")):
        pytest.skip("this processor has no fused product and sum")
    flags = ["-mfma", "-ffp-contract=fast"]
    assert build_and_run([*machine_compiler(), *STRICT, *flags], tmp_path / "fits") != plain


@pytest.mark.parametrize("flags", [["-mcpu=baseline"], ["-mcpu=native"]], ids=" ".join)
def test_zig_gives_the_same_bits(plain, zig, tmp_path, flags):
    command, environment = zig
    assert build_and_run([*command, *flags, *STRICT], tmp_path / "fits", environment=environment) == plain


def test_aarch64_gives_the_same_bits(plain, zig, tmp_path):
    """Its processors have fused products, which a compiler takes unless it is told not to."""
    emulator = shutil.which("qemu-aarch64-static") or shutil.which("qemu-aarch64")
    if emulator is None:
        pytest.skip("needs qemu-user-static: apt-get install qemu-user-static")
    command, environment = zig
    target = ["-target", "aarch64-linux-musl", "-static", "-mcpu=baseline"]
    printed = build_and_run([*command, *target, *STRICT], tmp_path / "fits", [emulator], environment)
    assert printed == plain


def test_windows_gives_the_same_bits(plain, zig, tmp_path):
    wine = shutil.which("wine64") or shutil.which("wine")
    if wine is None:
        pytest.skip("needs wine: apt-get install wine64")
    command, environment = zig
    target = ["-target", "x86_64-windows-gnu", "-mcpu=baseline"]
    call = [*command, *target, *STRICT, str(PROGRAM), "-o", str(tmp_path / "fits.exe")]
    done = subprocess.run(call, capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stderr
    home = {**os.environ, "WINEPREFIX": str(tmp_path / "wine"), "WINEDEBUG": "-all", "DISPLAY": ""}
    done = subprocess.run([wine, str(tmp_path / "fits.exe")], capture_output=True, text=True, env=home)
    assert done.returncode == 0, done.stderr
    assert done.stdout.replace("\r", "") == plain


def test_no_memory_is_misused_or_left(plain, tmp_path):
    flags = ["-g", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
    assert build_and_run([*machine_compiler(), *STRICT, *flags], tmp_path / "fits") == plain


@on_x86
def test_functions_for_four_doubles_have_the_bits_of_two(tmp_path):
    """`OFFER` in kernels/c/pulse.h compiles them for AVX2 too, exponentials for AVX-512; -DWIDEST=4 leaves that out."""
    compile_library(tmp_path / "four.so", ("-DWIDEST=4",))
    four, rng = ctypes.CDLL(str(tmp_path / "four.so")), np.random.default_rng(7)
    special = np.repeat([np.nan, np.inf, -np.inf, 0.0, 5e-324], 9)
    for x in (rng.uniform(-750, 710, 10_003), rng.normal(0, 3, 1001), special):
        for name, values in (("exponentials", x), ("logarithms", x), ("logarithms", abs(x))):
            assert _ask(four, name, values).tobytes() == _ask(load(), name, values).tobytes()
    widths, terms = np.linspace(1.5, 9.0, 200), rng.uniform(0.1, 2.0, (4, 3))
    found = np.zeros((2, 2, 200))
    for out, library in zip(found, (four, load()), strict=True):
        library.measure_lobes(ctypes.c_int64(200), _point(widths), ctypes.c_int64(4), *map(_point, (terms, *out)))
    assert found[0].tobytes() == found[1].tobytes() and (found > 0).all()


def _point(array):
    return ctypes.c_void_p(array.ctypes.data)


def _ask(library, name, values):
    """What a function of the library makes of these values."""
    out = np.empty_like(values)
    getattr(library, name)(ctypes.c_int64(len(values)), _point(values), _point(out))
    return out
