"""The library of a checkout is of its source; one that is missing, cut or foreign is one line, no traceback."""

import importlib.util
import os
import shutil
import subprocess
import sys
import tempfile
from types import SimpleNamespace

import numpy as np
import pytest
from commands import refuses, run_command

import wavebatch as wb
from wavebatch.core.errors import InputError
from wavebatch.kernels import build_kernels, library

needs_compiler = pytest.mark.skipif(build_kernels.find_compiler() is None, reason="needs a C compiler")
SMALL = """#include "number.h"
#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif
EXPORT long long decompose_clusters(void) { return NUMBER; }
EXPORT long long promise_echoes(void) { return -NUMBER; }
"""


@pytest.fixture(autouse=True)
def fresh():
    """Nothing is loaded before, and nothing of the test after it."""
    library.load.cache_clear()
    yield
    library.load.cache_clear()


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout with a small source, to which `library.load` belongs; its backend."""
    shutil.copy(build_kernels.__file__, tmp_path / "build_kernels.py")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "library.c").write_text(SMALL)
    (tmp_path / "c" / "number.h").write_text("#define NUMBER 1\n")
    spec = importlib.util.spec_from_file_location("copied_backend", tmp_path / "build_kernels.py")
    backend = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(backend)
    for name in ("LIBRARY", "SOURCES", "compile_library", "is_outdated", "is_whole"):
        monkeypatch.setattr(library, name, getattr(backend, name))
    monkeypatch.setattr(library, "FUNCTIONS", ("decompose_clusters", "promise_echoes"))
    return backend


def load_number():
    """What the library says that `load` leaves; in another process, because one loads a path only once."""
    library.load.cache_clear()
    library.load()
    code = f"import ctypes; print(ctypes.CDLL({str(library.LIBRARY)!r}).decompose_clusters())"
    return int(subprocess.run([sys.executable, "-c", code], capture_output=True, check=True).stdout)


@needs_compiler
def test_a_change_of_the_source_is_compiled_and_nothing_else(checkout):
    assert load_number() == 1
    header = checkout.SOURCES / "number.h"
    header.write_text("#define NUMBER 2\n")
    assert load_number() == 2
    header.write_text("#define NUMBER 3\n")
    os.utime(header, (1, 1))  # as a copy of an older version has it
    os.utime(checkout.SOURCES / "library.c", (1, 1))
    os.utime(checkout.__file__, (1, 1))
    assert load_number() == 3
    compiled = checkout.LIBRARY.stat().st_ino  # another file, where it is compiled again
    assert load_number() == 3 and checkout.LIBRARY.stat().st_ino == compiled
    assert sorted(path.name for path in checkout.LIBRARY.parent.iterdir() if not path.name.startswith("__")) == sorted(
        ["build_kernels.py", "c", checkout.LIBRARY.name]
    )


@needs_compiler
def test_processes_that_build_at_once_load_a_whole_library(checkout):
    code = (
        f"import sys, ctypes; sys.path.insert(0, {str(checkout.LIBRARY.parent)!r}); import build_kernels as b\n"
        "print(b.is_outdated(), flush=True); sys.stdin.read(1); b.compile_library()\n"
        "print(ctypes.CDLL(str(b.LIBRARY)).decompose_clusters(), b.is_outdated())"
    )
    call = [sys.executable, "-c", code]
    jobs = [subprocess.Popen(call, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) for _ in range(3)]
    assert [job.stdout.readline() for job in jobs] == ["True\n"] * 3  # none builds before all have looked
    for job in jobs:
        job.stdin.write("x")
        job.stdin.flush()
    assert [job.communicate()[0] for job in jobs] == ["1 False\n"] * 3
    assert not list(checkout.LIBRARY.parent.glob(".build-*"))


@needs_compiler
def test_a_checkout_that_cannot_be_written_runs_until_its_source_changes(checkout, monkeypatch):
    assert load_number() == 1

    def refuse(**options):
        raise PermissionError(13, "Permission denied", options["dir"])

    monkeypatch.setattr(tempfile, "TemporaryDirectory", refuse)
    assert load_number() == 1
    (checkout.SOURCES / "number.h").write_text("#define NUMBER 2\n")
    refuses(InputError, r"cannot be built from its C sources: .*Permission denied", load_number)


@needs_compiler
def test_a_failure_of_the_compiler_is_one_line_with_its_reason(checkout):
    (checkout.SOURCES / "number.h").write_text("#define NUMBER unknown_name\n")
    with pytest.raises(InputError, match="the C compiler failed: .*error: .*unknown_name") as error:
        load_number()
    assert "\n" not in str(error.value) and not checkout.LIBRARY.exists()


def test_without_a_compiler_pip_is_asked_for_one(checkout, monkeypatch, tmp_path):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    asked = dict.fromkeys(("wheel", "sdist"), lambda settings=None: ["setuptools"])  # it would replace distutils here
    hooks = SimpleNamespace(**{f"get_requires_for_build_{name}": hook for name, hook in asked.items()})
    monkeypatch.setattr(checkout, "_setuptools", lambda: hooks)
    assert "ziglang" in checkout.get_requires_for_build_wheel()
    assert "ziglang" in checkout.get_requires_for_build_editable()
    assert "ziglang" not in checkout.get_requires_for_build_sdist()
    refuses(InputError, "no C compiler found: install cc, gcc or clang, set CC, or `pip install", load_number)
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: name == "ziglang")
    assert checkout.find_compiler()[:4] == [sys.executable, "-m", "ziglang", "cc"]
    monkeypatch.setenv("CC", "/no/cc -pipe")
    refuses(InputError, "the C compiler that CC names is not there: /no/cc; unset CC", load_number)
    monkeypatch.setenv("CC", "ccache 'my cc' -pipe")
    assert checkout.find_compiler() == ["ccache", "my cc", "-pipe"]
    assert "ziglang" not in checkout.get_requires_for_build_wheel()


def of_another_processor(whole):
    """The machine of an ELF header is that of a PDP-11."""
    return whole[:18] + (65).to_bytes(2, "little") + whole[20:]


DAMAGE = {
    "text": lambda whole: b"#!/bin/sh\n",
    "empty": lambda whole: b"",
    "20 bytes": lambda whole: whole[:20],
    "30 percent": lambda whole: whole[: len(whole) * 3 // 10],
    "but a byte": lambda whole: whole[:-1],
    "another processor": of_another_processor,
}


@pytest.mark.skipif(sys.platform != "linux", reason="headers of ELF")
@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
@pytest.mark.parametrize("is_installed", [True, False], ids=["installed", "checkout"])
def test_a_damaged_library_is_refused_with_the_remedy(tmp_path, monkeypatch, damage, is_installed):
    whole = build_kernels.LIBRARY.read_bytes()
    monkeypatch.setattr(library, "LIBRARY", tmp_path / "_kernels.so")
    monkeypatch.setattr(library, "SOURCES", tmp_path / "none" if is_installed else build_kernels.SOURCES)
    library.LIBRARY.write_bytes(damage(whole))
    remedy = "install wavebatch again on this machine" if is_installed else "remove it, it is then built again"
    with pytest.raises(InputError, match=remedy) as error:
        library.load()
    assert "\n" not in str(error.value) and str(error.value).count(str(library.LIBRARY)) == 1
    library.LIBRARY.write_bytes(whole)
    assert library.load().promise_echoes


@needs_compiler
def test_a_library_without_our_functions_is_refused(checkout):
    (checkout.SOURCES / "library.c").write_text("int nothing;\n")
    refuses(InputError, "promise_echoes|decompose_clusters", load_number)


def test_commands_report_a_missing_library_once(tmp_path, monkeypatch):
    strips = [str(tmp_path / name) for name in ("a.las", "b.las")]
    for strip in strips:
        assert run_command("simulate", "flat", "-o", strip, "--pulses", "50").exit_code == 0
    monkeypatch.setattr(library, "LIBRARY", tmp_path / "missing.so")
    out = tmp_path / "out"
    for words, code in ((["run", *strips, "-o", str(out)], 4), (["survey", strips[0]], 1)):
        done = run_command(*words)
        assert done.exit_code == code
        assert done.stderr.count("\n") == 1 and done.stderr.startswith(f"error: {tmp_path / 'missing.so'}: ")
        assert "bug" not in done.stderr and "built again" in done.stderr
    refuses(InputError, r"missing\.so: cannot be loaded", wb.run, strips, out)
    assert not out.exists()


def test_addresses_are_those_of_numpy(tmp_path):
    """Of what may be written or not, is empty, a part, of a subclass, or lies in a file."""
    array = np.arange(12, dtype=np.float32).reshape(3, 4)
    fixed = array.copy()
    fixed.flags.writeable = False
    kept = np.memmap(tmp_path / "kept", np.uint8, "w+", shape=5)
    for one in (array, fixed, array[1:], array[:, 2], np.empty(0), np.empty((0, 3)), np.ones(()), kept,
                np.frombuffer(b"abcd", np.uint8), array.view(np.recarray)):  # fmt: skip
        assert library.address(one) == one.ctypes.data
