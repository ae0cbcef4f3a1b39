"""Fuzzing: damaged inputs of every kind through every command that reads them, and odd values of every option.

`make fuzz MINUTES=10 SEED=1` runs it. Hypothesis draws the cases and makes those that break a promise small; each
becomes a line of `tests/fuzz_regressions.jsonl`: the kind of input, the command, the edits of the sound input, which
code builds again, and variables. `tests/fuzz_cases.py` replays these lines.

A forked process runs one case after the other; what hangs or kills it is seen from outside, and the next case gets a
new one.
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import importlib
import json
import multiprocessing
import os
import random
import re
import resource
import shlex
import shutil
import signal
import stat
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import click
from click.testing import CliRunner
from fuzz_damage import Edit, apply_edits, damage
from fuzz_inputs import BESIDE, COMMANDS, IN_RESUMED, build_inputs, read_sound, weight
from fuzz_options import Options
from hypothesis import HealthCheck, Phase, given, seed, settings
from hypothesis import strategies as st

from wavebatch.cli import main

KEPT = Path(__file__).with_name("fuzz_regressions.jsonl")


class Limits(NamedTuple):
    """Of one case."""

    seconds: float = 10
    """Of a processor."""
    waiting: float = 300
    """Of a clock: more than these seconds of a processor take on a busy machine."""
    memory: int = 1 << 30
    """Bytes that the process takes at most, with Python and NumPy."""


PLAIN = Limits()
FORK = multiprocessing.get_context("fork")
GROUP = 40
"""Cases per process: what they leave in memory adds up."""


class Case(NamedTuple):
    """A damaged input and the command that reads it."""

    kind: str
    """Of the input; "options" for sound inputs and odd options."""
    command: str
    """As in a shell, with {input} and other places of `fuzz_inputs`."""
    edits: list[Edit]
    """Of the sound input."""
    variables: dict[str, str] = {}
    """Of the environment."""


class Fuzzer:
    """Runs cases in a folder; `run` returns what is wrong with one, or an empty text."""

    def __init__(self, folder: Path, command: click.Command = main, limits: Limits = PLAIN) -> None:
        self.base, self._folder, self._main, self._limits = folder / "base", folder, command, limits
        self.codes: dict[str, collections.Counter] = collections.defaultdict(collections.Counter)
        """How often each command, and each kind of input in brackets, ended with a code."""
        self.last: dict[str, Any] = {}
        """What the last command did."""
        if not self.base.exists():
            self.base.mkdir()
            made = FORK.Process(target=build_inputs, args=(self.base,))  # threads of laspy would be missing in forks
            made.start()
            made.join()
            assert made.exitcode == 0, "the sound inputs cannot be made"
        self.sound = dict(read_sound(self.base))
        self._kept = _state(self.base)
        self._child: tuple[Any, Any] | None = None
        self._served = 0
        for name in ("matplotlib.backends.backend_agg", "matplotlib.backends.backend_svg", "rasterio"):
            with contextlib.suppress(ImportError):  # once, not in every process
                importlib.import_module(name)

    def run(self, case: Case) -> str:
        """Run a case and return what is wrong, on one line."""
        process, pipe = self._child or self._start()
        pipe.send(case)
        try:
            why = "" if pipe.poll(self._limits.waiting) else f"waits for more than {self._limits.waiting} s"
            self.last = {"code": -1, "out": "", "err": why, "why": why} if why else pipe.recv()
        except EOFError:
            process.join()
            slow = process.exitcode == -signal.SIGPROF
            why = f"ran for more than {self._limits.seconds} s" if slow else f"ended with status {-process.exitcode}"
            self.last = {"code": -1, "out": "", "err": why, "why": why}
        self._served += 1
        if self.last["why"] or self._served == GROUP:
            self.close()
        words = case.command.split()
        for name in (" ".join(words[: 1 + (words[0] == "plot")]), f"[{case.kind}]"):
            self.codes[name][self.last["code"]] += 1
        changed = _state(self.base) ^ self._kept
        assert not changed, f"{case.command} changed sound inputs: {sorted({one[0] for one in changed})}"
        return self.last["why"]

    def close(self) -> None:
        """End the process that runs the cases."""
        if self._child is not None:
            process, pipe = self._child
            process.kill()
            process.join()
            pipe.close()
            self._child, self._served = None, 0

    def _start(self) -> tuple[Any, Any]:
        pipe, theirs = FORK.Pipe()
        process = FORK.Process(target=self._serve, args=(theirs,))
        process.start()
        theirs.close()
        self._child = process, pipe
        return self._child

    def _serve(self, pipe: Any) -> None:
        """In the forked process: run the cases and send what each did, until one fails."""
        os.setsid()
        libraries = tempfile.TemporaryFile()  # noqa: SIM115 - open until the process ends
        while True:
            case = pipe.recv()
            signal.setitimer(signal.ITIMER_PROF, self._limits.seconds)
            with _stderr_into(libraries):
                found = self._run_here(case)
            signal.setitimer(signal.ITIMER_PROF, 0)
            libraries.seek(0)
            written = libraries.read()
            libraries.seek(0)
            libraries.truncate()
            if written and not found["why"]:
                found["why"] = f"a library writes to stderr: {written[:300]!r}"
            pipe.send(found)

    def _run_here(self, case: Case) -> dict[str, Any]:
        folder = self._folder / "case"
        words, variables, before = self._prepare(case, folder)
        inputs = _state(folder, below=False)
        lost: list[str] = []
        sys.unraisablehook = lambda error: lost.append(repr(error.exc_value))
        warnings.resetwarnings()
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)
        opened = len(os.listdir("/proc/self/fd"))
        _reset_peak()
        done = CliRunner().invoke(self._main, words, env=variables)
        is_bug = not isinstance(done.exception, SystemExit | None)
        error = "".join(traceback.format_exception(done.exception)) if is_bug else ""
        found: dict[str, Any] = {"code": done.exit_code, "out": done.stdout, "err": done.stderr}
        found |= {"error": error, "peak": _read_peak()}
        why = _judge(found, folder / "out", before, case, self._limits.memory)
        if not why and inputs - _state(folder, below=False):
            why = "changes an input"
        if not why and lost:
            why = f"Python dropped {lost[0]}"
        if not why and os.listdir(folder / "tmp"):
            why = f"leaves in TMPDIR: {os.listdir(folder / 'tmp')}"
        del done
        if not why and len(os.listdir("/proc/self/fd")) > opened + 20:
            why = "leaves files open"
        return {**found, "out": found["out"][-5000:], "err": found["err"][-5000:], "why": why}

    def _prepare(self, case: Case, folder: Path) -> tuple[list[str], dict[str, str], set[str]]:
        """The command with the damaged input in place, its variables, and the names that its folder holds before."""
        shutil.rmtree(folder, ignore_errors=True)
        out = folder / "out"
        out.mkdir(parents=True)
        (folder / "tmp").mkdir()
        os.chdir(out)
        os.environ["TMPDIR"] = tempfile.tempdir = str(folder / "tmp")
        places = {"out": out, "resumed": out, "base": self.base, "folder": folder, "input": folder / case.kind}
        if case.kind == "options":
            _make_odd_places(folder)
        elif case.kind in IN_RESUMED:
            for name in ("strip.laz", "strip.report.json"):
                (out / name).write_bytes((self.base / "done" / name).read_bytes())
            places["input"] = out / case.kind
        for name in BESIDE.get(case.kind, ()):
            (folder / name).write_bytes(self.sound[name])
        if case.kind == "settings.toml":
            places |= {"base": folder, "input": folder / "wavebatch.toml"}
        if case.kind != "options":
            places["input"].write_bytes(apply_edits(self.sound[case.kind], case.edits, self.sound))

        def fill(text: str) -> str:
            for name, place in places.items():
                text = text.replace(f"{{{name}}}", str(place))
            return text

        variables = {name: fill(value) for name, value in case.variables.items()}
        return list(map(fill, shlex.split(case.command))), variables, {path.name for path in out.iterdir()}


@contextlib.contextmanager
def _stderr_into(file: Any) -> Iterator[None]:
    """What libraries write past Python goes into a file."""
    kept = os.dup(2)
    os.dup2(file.fileno(), 2)
    try:
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)


def _reset_peak() -> None:
    with contextlib.suppress(OSError), open("/proc/self/clear_refs", "w") as file:
        file.write("5")


def _read_peak() -> int:
    """Most memory that the process took since `_reset_peak` [B]."""
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) << 10 for line in file if line.startswith("VmHWM"))


def _make_odd_places(folder: Path) -> None:
    """A pipe, devices, links and a folder that looks like a strip."""
    os.symlink("loop", folder / "loop")
    os.symlink("none", folder / "dangling")
    (folder / "folder.las").mkdir()
    for name in ("pipe", "pipe.las"):
        os.mkfifo(folder / name)
    for name, minor in (("null", 3), ("zero", 5), ("zero.las", 5), ("full", 7)):
        with contextlib.suppress(PermissionError):
            os.mknod(folder / name, stat.S_IFCHR | 0o666, os.makedev(1, minor))


def _state(folder: Path, *, below: bool = True) -> set[tuple]:
    """Names, sizes and times of the files in a folder."""
    found = set()
    for path in folder.rglob("*") if below else folder.iterdir():
        state = path.lstat()
        if stat.S_ISREG(state.st_mode):
            found.add((str(path), state.st_size, state.st_mtime_ns, state.st_ino))
    return found


def _judge(done: dict[str, Any], out: Path, before: set[str], case: Case, most: int) -> str:
    """What is wrong with the end of a command."""
    code, said = done["code"], done["err"]
    left = {path.name for path in out.iterdir()}
    if done["error"]:
        return "traceback: " + " ".join(done["error"].split())[-300:]
    if code not in (0, 1, 2, 3, 4):
        return f"exit code {code}"
    if done["peak"] > most:
        return f"took {done['peak'] >> 20} MB"
    for word in ("this is a bug", "Traceback", "Warning", "not enough memory"):
        if word in said or word in done["out"]:
            return f"says {word}: {' '.join(said.split())[:300]}"
    plain = "\n\r" if _has_bar(case) else "\n"
    if any(c < " " and c not in plain or c == "\x7f" for c in said):
        return f"control characters: {said[:200]!r}"
    if code and not said.strip() and not done["out"].strip():
        return "fails without a word"
    lines = [line for line in said.splitlines() if not line.startswith(("settings:", "warning:"))]
    if code == 2 and len(lines) > 1:
        return f"wrong usage in {len(lines)} lines: {said[:200]!r}"
    if any(name.startswith(".") for name in left):
        return f"leaves {sorted(left)}"
    new = left - before
    wrong = {name for name in new if not (code == 4 and _is_summary(out / name))}
    if code in (1, 2, 4) and wrong and not _may_leave(case, code):
        return f"exit code {code}, but leaves {sorted(wrong)}: {said[:200]}"
    reports = {name.removesuffix(".report.json") for name in new if name.endswith(".report.json")}
    if any(not {f"{name}.laz", f"{name}.las"} & left for name in reports):
        return f"a report without its cloud: {sorted(left)}"
    for name in sorted(new):
        problem = check_whole(out / name)
        if problem and not (case.kind == "options" and _is_other(out / name)):
            return f"{name} is not whole: {problem}"
    return ""


def _is_summary(path: Path) -> bool:
    """Whether it is the report or page of a batch, which says why nothing is written, or its empty folder."""
    if path.is_dir():
        return not any(path.iterdir())
    data = path.read_bytes() if path.is_file() else b""
    return b'"wavebatch.batch-report/' in data or data.lower().startswith(b"<!doctype html")


def _has_bar(case: Case) -> bool:
    """Whether a progress bar is asked for, which is drawn over itself."""
    return "--progress bar" in case.command or any(
        name.endswith("PROGRESS") and value == "bar" for name, value in case.variables.items()
    )


def _may_leave(case: Case, code: int) -> bool:
    """Whether a failing command may keep outputs: `run` with a second output that fails, and one of several strips."""
    if "--log-file" in case.command or any("LOG_FILE" in name for name in case.variables):
        return True
    several = case.kind in ("list.txt", "options") or "{base}/other.las" in case.command
    if case.command.startswith("compare"):
        return code == 1  # a threshold
    return code == 1 and (several or case.command.startswith(("run", "check", "bench")))


def check_whole(path: Path) -> str:
    """What is wrong with an output, by its suffix: it must be readable to its end."""
    if not path.is_file():
        return ""
    try:
        if path.suffix in (".las", ".laz"):
            return _check_cloud(path)
        text = path.read_text(errors="surrogateescape") if path.suffix in (".toml", ".json", ".geojson", ".csv") else ""
        if path.suffix == ".toml":
            import tomllib

            tomllib.loads(text)
        elif path.suffix in (".json", ".geojson"):
            json.loads(text)
        elif path.suffix == ".csv" and not text.endswith("\n"):
            return "the last line has no end"
        elif path.suffix == ".npz":
            import numpy as np

            with np.load(path) as file:
                for name in file.files:
                    file[name]
        elif path.suffix == ".tif":
            import rasterio

            with rasterio.open(path) as file:
                small = file.width * file.height < 10_000_000
                file.read() if small else file.read(window=((0, 256), (0, 256)))
        elif path.suffix in _END and not path.read_bytes().rstrip(b"\n").endswith(_END[path.suffix]):
            return "the picture has no end"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


_END = {".png": b"IEND\xaeB`\x82", ".svg": b"</svg>"}
_BEGIN = {".las": b"LASF", ".laz": b"LASF", ".npz": b"PK", ".png": b"\x89PNG", ".svg": b"<?xml", ".json": b"{",
          ".tif": b"II*"}  # fmt: skip


def _is_other(path: Path) -> bool:
    """Whether it is of another format than its name says, which the user may choose: a log, a table, an array."""
    return not path.read_bytes().startswith(_BEGIN.get(path.suffix, b"?"))


def _check_cloud(path: Path) -> str:
    import laspy

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of laspy
        with laspy.open(path) as file:
            count, points = file.header.point_count, file.read_points(-1)
    return "" if len(points) == count else f"{len(points)} points of {count}"


def draw_case(sound: dict[str, bytes], options: Options, rng: random.Random) -> Case:
    """Any damage of any kind of input with any command that reads it, or odd options with sound inputs."""
    if rng.random() < 0.2:
        command, variables = options.draw(rng)
        return Case("options", command, [], variables)
    kind = rng.choice(sorted(COMMANDS))
    command = rng.choices(COMMANDS[kind], [weight(one) for one in COMMANDS[kind]])[0]
    return Case(kind, command, damage(sound, kind, rng))


def fuzz(fuzzer: Fuzzer, number: int, start: int, known: set[tuple[str, ...]], until: float) -> tuple[Case, str] | None:
    """Run so many cases from a seed, or until a time; return one that fails, made small, and why.

    known: kinds of failure that are not looked for again; that of the case is added.
    """
    failed: list[tuple[Case, str]] = []

    @seed(start)
    @settings(max_examples=number, deadline=None, database=None, report_multiple_bugs=False,
              suppress_health_check=list(HealthCheck), phases=(Phase.generate, Phase.shrink))  # fmt: skip
    @given(st.builds(draw_case, st.just(fuzzer.sound), st.just(Options()), st.randoms(use_true_random=False)))
    def look(case: Case) -> None:
        if time.monotonic() > until and not failed:
            return
        why = fuzzer.run(case)
        if why and _kind_of(case, why) not in known:
            failed.append((case, why))
            raise AssertionError(why)

    try:
        look()
    except Exception:
        if not failed:
            raise
        known.add(_kind_of(*failed[-1]))
        return failed[-1]
    return None


def _kind_of(case: Case, why: str) -> tuple[str, ...]:
    return case.kind, case.command.split()[0], re.sub(r"'.*?'|/\S*|[\d\W]+", " ", why)[:60]


def load_kept(path: Path = KEPT) -> list[Case]:
    """Return the cases that failed once."""
    lines = path.read_text().splitlines() if path.exists() else []
    return [Case(*json.loads(line)[:4]) for line in lines]


def list_codes(codes: dict[str, collections.Counter]) -> Iterator[str]:
    """A table of exit codes per command and per kind of input, so that one sees that cases reach inside."""
    yield f"{'':24}{'cases':>8}{'0':>8}{'1':>8}{'2':>8}{'3':>8}{'4':>8}"
    for name, counts in sorted(codes.items()):
        yield f"{name:24}" + "".join(f"{number:8}" for number in (sum(counts.values()), *(counts[c] for c in range(5))))


def _begin() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--seed", type=int, default=int(time.time()))
    parser.add_argument("--no-keep", action="store_true", help="print failures only")
    options = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_AS, (8 << 30, 8 << 30))
    known, start = set(), 1000 * options.seed
    with tempfile.TemporaryDirectory() as folder, contextlib.suppress(KeyboardInterrupt):
        fuzzer = Fuzzer(Path(folder))
        until = time.monotonic() + 60 * options.minutes
        with contextlib.closing(fuzzer):
            while time.monotonic() < until:
                found, start = fuzz(fuzzer, 500, start, known, until), start + 1
                if found is None:
                    continue
                case, why = found
                line = json.dumps([*case, re.sub(r"/\S*/", "", why)[:100]])
                print(f"{case.kind}: {case.command[:300]!r}: {why}\n    {line[:2000]}", flush=True)
                if not options.no_keep:
                    with open(KEPT, "a") as file:
                        file.write(line + "\n")
            print(*list_codes(fuzzer.codes), sep="\n")
        count = sum(sum(counts.values()) for name, counts in fuzzer.codes.items() if name.startswith("["))
        print(f"{count} cases with seed {options.seed}, {len(known)} kinds of failure")
    return len(known) > 0


if __name__ == "__main__":
    sys.exit(_begin())
