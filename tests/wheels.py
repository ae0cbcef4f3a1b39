"""All wheels and the source distribution, from one machine: zig compiles the library for each platform.

    python tests/wheels.py dist        (`make dist`)

The library is C without Python's headers, so a wheel serves every Python 3 of its platform. Each library is looked
through: its kind of file, what it offers, and which version of glibc it asks for. The wheel of this machine is
installed in a fresh environment and runs a strip.
"""

import os
import platform
import re
import shutil
import struct
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import NamedTuple

from wavebatch.kernels.build_kernels import FLAGS, ZIG
from wavebatch.kernels.library import FUNCTIONS

ROOT = Path(__file__).resolve().parent.parent
GLIBC = (2, 17)
"""Of manylinux2014, which every distribution since 2014 has."""


class Target(NamedTuple):
    """A platform that gets a wheel."""

    tag: str
    triple: str
    """As zig calls it."""
    suffix: str
    machine: bytes
    """First bytes of the library, or those at `at` that name the processor."""
    at: int = 0


TARGETS = (
    Target("manylinux_2_17_x86_64", "x86_64-linux-gnu.2.17", ".so", struct.pack("<H", 62), 18),
    Target("manylinux_2_17_aarch64", "aarch64-linux-gnu.2.17", ".so", struct.pack("<H", 183), 18),
    Target("macosx_11_0_x86_64", "x86_64-macos.11.0", ".dylib", struct.pack("<II", 0xFEEDFACF, 0x01000007)),
    Target("macosx_11_0_arm64", "aarch64-macos.11.0", ".dylib", struct.pack("<II", 0xFEEDFACF, 0x0100000C)),
    Target("win_amd64", "x86_64-windows-gnu", ".dll", b"MZ"),
)


def compile_for(target: Target, folder: Path, zig: list[str], environment: dict[str, str]) -> Path:
    """The library of a platform, in the folder; the same call gives the same bytes."""
    library = folder / f"_kernels{target.suffix}"
    flags = () if target.suffix == ".dll" else ("-fPIC", "-lm")
    source = ROOT / "wavebatch" / "kernels" / "c" / "library.c"
    words = [*zig, "-target", target.triple, "-mcpu=baseline", *FLAGS, "-s", *flags, str(source), "-o", str(library)]
    subprocess.run(words, check=True, env=environment)
    for rest in [*folder.glob("*.lib"), *folder.glob("*.pdb")]:  # zig writes them beside a DLL
        rest.unlink()
    return library


def check_library(target: Target, library: Path) -> None:
    """AssertionError for a library of another platform, without a function, or for a newer glibc."""
    data = library.read_bytes()
    assert data[target.at : target.at + len(target.machine)] == target.machine, f"{library}: is not for {target.tag}"
    for name in FUNCTIONS:
        assert name.encode() + b"\0" in data, f"{library}: lacks {name}"
    asked = {tuple(map(int, found)) for found in re.findall(rb"GLIBC_(\d+)\.(\d+)", data)}
    assert max(asked, default=GLIBC) <= GLIBC, f"{library}: asks for glibc {max(asked)}"


def build_wheel(source: Path, target: Target, library: Path, wheels: Path) -> Path:
    """A wheel of the source with this library only."""
    kernels = source / "wavebatch" / "kernels"
    for old in kernels.glob("_kernels.*"):
        old.unlink()
    shutil.rmtree(source / "build", ignore_errors=True)
    shutil.copyfile(library, kernels / library.name)
    before = set(wheels.glob("*.whl"))
    options = {"--build-option": ["--plat-name", target.tag]}
    code = f"import setuptools.build_meta as b; b.build_wheel({str(wheels)!r}, {options!r})"
    subprocess.run([sys.executable, "-c", code], cwd=source, check=True, stdout=subprocess.DEVNULL)
    (wheel,) = set(wheels.glob("*.whl")) - before
    with zipfile.ZipFile(wheel) as archive:
        assert f"wavebatch/kernels/{library.name}" in archive.namelist(), f"{wheel}: lacks its library"
    return wheel


def copy_source(folder: Path) -> Path:
    """What a checkout has under version control, or all of a source without it."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        ignored = shutil.ignore_patterns(".*", "site", "demo", "bench", "build", "dist", "*.egg-info", "__pycache__")
        return Path(shutil.copytree(ROOT, folder, ignore=ignored))
    for name in listed.stdout.split("\0")[:-1]:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, folder / name)
    return folder


def try_wheel(wheel: Path, folder: Path) -> None:
    """Install a wheel in a fresh environment, and run a strip with it."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True)
    programs = folder / ("Scripts" if os.name == "nt" else "bin")
    subprocess.run([str(programs / "python"), "-m", "pip", "install", "--quiet", str(wheel)], check=True)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    for words in ("simulate forest -o a.laz --pulses 2000 --seed 1 --quiet", "run a.laz -o out --quiet --jobs 2"):
        subprocess.run([str(programs / "wavebatch"), *words.split()], cwd=folder, env=environment, check=True)


def build_all(wheels: Path, zig: list[str], environment: dict[str, str], targets: tuple[Target, ...] = TARGETS) -> None:
    """Write the wheels and the source distribution into the folder; prints a line for each."""
    wheels.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        source = copy_source(folder / "source")
        code = f"import setuptools.build_meta as b; b.build_sdist({str(wheels.resolve())!r})"
        subprocess.run([sys.executable, "-c", code], cwd=source, check=True, stdout=subprocess.DEVNULL)
        for target in targets:
            (folder / target.tag).mkdir()
            library = compile_for(target, folder / target.tag, zig, environment)
            check_library(target, library)
            wheel = build_wheel(source, target, library, wheels.resolve())
            here = sys.platform == "linux" and platform.machine() in target.tag and "linux" in target.tag
            if here:
                try_wheel(wheel, folder / "fresh")
            tried = ", installed and run" if here else ", not run: no machine of this kind"
            print(f"{wheels / wheel.name}: {wheel.stat().st_size >> 10} kB{tried}")


def main() -> None:
    """Build into the folder that is named; zig comes from PyPI."""
    wheels = Path(sys.argv[1])
    with tempfile.TemporaryDirectory() as cache:
        caches = dict.fromkeys(("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"), cache)
        build_all(wheels, [word for word in ZIG if word != "-mcpu=baseline"], {**os.environ, **caches})


if __name__ == "__main__":
    main()
