"""Build backend: compiles kernels/c, then lets setuptools do the rest (pyproject.toml names it).

Uses $CC, else cc, gcc or clang; where the machine has none, pip installs `ziglang`, a compiler in a wheel, for the time
of the build. The flags are strict, so that every build gives the same bits: no contraction of products and sums, no
fast mathematics, no instructions beyond the baseline of the architecture.

Called by pip, and by kernels/library.py in a checkout. Before you change it: it runs where only Python and setuptools
are installed.
"""

from __future__ import annotations

import importlib.util
import os
import shlex
import shutil
import sys
from pathlib import Path
from typing import Any

SOURCES = Path(__file__).with_name("c")
LIBRARY = Path(__file__).with_name("_kernels" + {"win32": ".dll", "darwin": ".dylib"}.get(sys.platform, ".so"))
FLAGS = ("-std=gnu99", "-O3", "-ffp-contract=off", "-fno-math-errno", "-fvisibility=hidden", "-Wno-psabi", "-shared")
ZIG = (sys.executable, "-m", "ziglang", "cc", "-mcpu=baseline", "-fno-sanitize=undefined")
"""Without options zig takes all instructions of this machine, and some of its modes stop at undefined behaviour."""


def find_compiler() -> list[str] | None:
    """The command of a C compiler; None where there is none."""
    if os.environ.get("CC"):
        return shlex.split(os.environ["CC"])
    for name in ("cc", "gcc", "clang"):
        if shutil.which(name):
            return [name]
    if importlib.util.find_spec("ziglang"):
        return list(ZIG)
    return None


def compile_library(target: Path = LIBRARY, flags: tuple[str, ...] = ()) -> None:
    """Compile the library to `target`, which appears whole or not at all.

    Raises
    ------
    RuntimeError
        There is no compiler, or it failed; one line.
    """
    import subprocess  # 10 ms of each start, which compiles nothing
    import tempfile

    command = find_compiler()
    if command is None:
        raise RuntimeError("no C compiler found: install cc, gcc or clang, set CC, or `pip install ziglang`")
    if shutil.which(command[0]) is None:
        raise RuntimeError(f"the C compiler that CC names is not there: {command[0]}; unset CC, or name another")
    source_time = _source_time()
    is_windows = sys.platform == "win32"
    position, mathematics = ((), ()) if is_windows else (("-fPIC",), ("-lm",))  # Windows needs neither
    with tempfile.TemporaryDirectory(dir=target.parent, prefix=".build-") as folder:
        built = Path(folder) / target.name
        call = [*command, *FLAGS, *position, *flags, str(SOURCES / "library.c"), "-o", str(built), *mathematics]
        # Zig keeps what it compiles, 50 MB, in the user's home, which a container may lack.
        caches = dict.fromkeys(("ZIG_GLOBAL_CACHE_DIR", "ZIG_LOCAL_CACHE_DIR"), folder)
        done = subprocess.run(call, capture_output=True, text=True, errors="replace", env={**os.environ, **caches})
        if done.returncode:
            lines = done.stderr.splitlines() or ["it printed nothing"]
            reason = next((line for line in lines if "error" in line), lines[-1])
            raise RuntimeError(f"the C compiler failed: {reason.strip()}; its call: {shlex.join(call)}")
        os.utime(built, ns=(source_time, source_time))
        os.replace(built, target)


def is_outdated() -> bool:
    """Whether this is a checkout whose library is not of the present source; an installed package has no source."""
    source_time = _source_time()
    return source_time > 0 and not (LIBRARY.exists() and LIBRARY.stat().st_mtime_ns == source_time)


def _source_time() -> int:
    """When the source was last changed, which the library takes over [ns]; 0 where there is no source."""
    try:
        with os.scandir(SOURCES) as folder:  # at every start: a glob compiles its pattern
            times = [one.stat().st_mtime_ns for one in folder if one.name.endswith((".c", ".h"))]
    except FileNotFoundError:
        return 0
    return max([*times, os.stat(__file__).st_mtime_ns]) if times else 0


def is_whole(library: Path) -> bool:
    """Whether the file ends where its header says, if it is of ELF: to load less of it kills the process (SIGBUS)."""
    with library.open("rb") as file:
        head = file.read(64)
    if not head.startswith(b"\x7fELF\x02\x01"):
        return True  # other systems refuse what is cut
    place, size, number = (int.from_bytes(head[begin:end], "little") for begin, end in ((40, 48), (58, 60), (60, 62)))
    return len(head) == 64 and library.stat().st_size >= place + size * number


def _setuptools() -> Any:
    from setuptools import build_meta

    return build_meta


def get_requires_for_build_wheel(config_settings: dict | None = None) -> list[str]:
    """What pip must install before a build: a compiler, where the machine has none."""
    return [*_setuptools().get_requires_for_build_wheel(config_settings), *([] if find_compiler() else ["ziglang"])]


get_requires_for_build_editable = get_requires_for_build_wheel


def __getattr__(hook: str) -> Any:
    """The other hooks of PEP 517, as setuptools has them; MANIFEST.in leaves the library of this machine out."""
    if hook not in (
        "get_requires_for_build_sdist", "prepare_metadata_for_build_wheel", "prepare_metadata_for_build_editable",
        "build_sdist",
    ):  # fmt: skip
        raise AttributeError(hook)
    return getattr(_setuptools(), hook)


def build_wheel(
    wheel_directory: str, config_settings: dict | None = None, metadata_directory: str | None = None
) -> str:
    """A wheel for this platform and any Python 3: the library needs no Python headers."""
    import sysconfig

    compile_library()
    platform = sysconfig.get_platform().replace("-", "_").replace(".", "_")
    settings = {**(config_settings or {}), "--build-option": ["--plat-name", platform]}
    return _setuptools().build_wheel(wheel_directory, settings, metadata_directory)


def build_editable(
    wheel_directory: str, config_settings: dict | None = None, metadata_directory: str | None = None
) -> str:
    """A link to the checkout, in which the library is compiled; it is compiled again when its source changes."""
    compile_library()
    return _setuptools().build_editable(wheel_directory, config_settings, metadata_directory)
