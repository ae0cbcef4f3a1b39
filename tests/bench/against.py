"""Run time and memory of whole runs, of this wavebatch and of another version, side by side.

    PYTHONPATH=tests python -m bench.against DIR [STRIP...] [-o OUT]

`make bench BASE=REV` installs revision REV into DIR and calls it. Speeds of a shared machine change by tens of percent
from minute to minute, ratios of runs that follow each other hardly do: so both take turns, and every round gives one
ratio.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import InputError
from wavebatch.core.process import ONE_THREAD
from wavebatch.tools.bench.command import write_texts
from wavebatch.tools.simulate import find_scene, simulate_strip

SCENES = ("mixed", "open", "forest", "empty")

WHERE = "import wavebatch, sys; sys.stdout.write(wavebatch.__file__)"
"""Asks a process which wavebatch it imports."""


@dataclass(frozen=True, slots=True)
class Lap:
    """One run from file to file."""

    cpu: float
    """Of all its processes [s]."""
    wall: float
    """[s]."""
    peak: int
    """Largest resident memory of a process [bytes]."""


@dataclass(frozen=True, slots=True)
class Ratio:
    """Other over this, of one quantity: above 1 this one is better."""

    middle: float
    low: float
    high: float

    @classmethod
    def of(cls, here: Sequence[float], there: Sequence[float]) -> Ratio:
        """Median and range of the ratios of the rounds."""
        ratios = np.array(there) / np.array(here)
        return cls(float(np.median(ratios)), float(ratios.min()), float(ratios.max()))

    def __str__(self) -> str:
        return f"{self.middle:.3f} ({self.low:.3f}-{self.high:.3f})"


@dataclass(frozen=True, slots=True)
class Paired:
    """A strip, run by both."""

    strip: str
    here: list[Lap]
    there: list[Lap]

    def ratio(self, name: str) -> Ratio:
        """The ratio of `cpu`, `wall` or `peak`."""
        return Ratio.of([getattr(lap, name) for lap in self.here], [getattr(lap, name) for lap in self.there])


def find_package(root: Path) -> Path:
    """The folder that holds the package `wavebatch` of another version.

    Raises
    ------
    InputError
        Where a process that is told to use it imports another one.
    """
    command, elsewhere = [sys.executable, "-c", WHERE], tempfile.gettempdir()
    answer = subprocess.run(
        command, env=_environment(root), cwd=elsewhere, capture_output=True, text=True, check=False
    )
    found = Path(answer.stdout or ".").resolve().parent.parent
    if answer.returncode or found != root.resolve():
        raise InputError(f"{root}: holds no wavebatch that Python can import; name the folder that the package lies in")
    return found


def compare_runs(
    other: Path, strips: Mapping[str, Path], rounds: int, arguments: Sequence[str] = (), say: Callable = print
) -> list[Paired]:
    """Runs every strip by both, `rounds` times, in turn.

    Parameters
    ----------
    other : folder that holds the other package.
    strips : paths by the name that the table shows.
    rounds : how often each is run, after one round that does not count.
    arguments : more arguments of `wavebatch run`.
    say : gets a line for each strip.
    """
    here, there = Path(__file__).resolve().parents[2], find_package(other)
    found = []
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as folder:
        for name, strip in strips.items():
            laps: dict[Path, list[Lap]] = {here: [], there: []}
            for number in range(rounds + 1):
                for root in (here, there) if number % 2 else (there, here):
                    lap = _run(root, strip, Path(folder), arguments)
                    if number:
                        laps[root].append(lap)
            found.append(Paired(name, laps[here], laps[there]))
            say(f"{name}: {found[-1].ratio('cpu')} times as fast")
    return found


def simulate_strips(scenes: Sequence[str], pulses: int, seed: int, folder: Path) -> dict[str, Path]:
    """A strip of every scene, simulated by this wavebatch; both run the same one."""
    strips = {}
    for name in scenes:
        strips[name] = folder / f"{name}.las"
        simulate_strip(find_scene(name), strips[name], pulses=pulses, seed=seed)
    return strips


def _environment(root: Path) -> dict[str, str]:
    """One thread, this wavebatch first, and compiled modules kept: pip compiles those of the other version."""
    kept = {name: value for name, value in os.environ.items() if name != "PYTHONDONTWRITEBYTECODE"}
    return {**kept, **dict.fromkeys(ONE_THREAD, "1"), "PYTHONPATH": str(root.resolve())}


def _run(root: Path, strip: Path, folder: Path, arguments: Sequence[str]) -> Lap:
    command = [sys.executable, "-m", "wavebatch", "run", str(strip.resolve()), "-o", str(folder), "--overwrite"]
    begin = time.perf_counter()
    command += ["--quiet", *arguments]
    process = subprocess.Popen(command, env=_environment(root), cwd=folder, stderr=subprocess.PIPE)
    with process.stderr:
        complaint = process.stderr.read().decode(errors="replace").strip()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode:
        raise InputError(f"{strip}: `wavebatch run` of {root} ended with exit code {process.returncode}: {complaint}")
    return Lap(usage.ru_utime + usage.ru_stime, time.perf_counter() - begin, usage.ru_maxrss * 1024)


def format_paired(other: Path, found: Sequence[Paired]) -> str:
    """The table: medians of this one, and ratios other / this with the range of the rounds."""
    width = max(5, *(len(pair.strip) for pair in found))
    lines = [
        f"this wavebatch against {other}: other / this, median (range of {len(found[0].here)} rounds); above 1: better",
        f"{'strip':{width}}  {'CPU here':>9}  {'CPU':>21}  {'wall':>21}  {'memory':>21}",
    ]
    for pair in found:
        cpu = float(np.median([lap.cpu for lap in pair.here]))
        ratios = "  ".join(f"{pair.ratio(name)!s:>21}" for name in ("cpu", "wall", "peak"))
        lines.append(f"{pair.strip:{width}}  {cpu:7.2f} s  {ratios}")
    return "\n".join(lines)


def to_document(other: Path, found: Sequence[Paired]) -> dict[str, Any]:
    """The same as plain values."""
    names = ("cpu", "wall", "peak")
    return {
        "against": str(other),
        "strips": {
            pair.strip: {name: [ratio.middle, ratio.low, ratio.high] for name in names for ratio in [pair.ratio(name)]}
            for pair in found
        },
    }


def main(words: Sequence[str] | None = None) -> None:
    """Times the strips, or simulated scenes, by both; prints the table and writes against.txt and against.json."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("other", type=Path, metavar="DIR", help="holds the other package `wavebatch`")
    parser.add_argument("strips", type=Path, nargs="*", metavar="STRIP", help="default: simulated scenes")
    parser.add_argument("-o", "--output", type=Path, required=True, help="folder for against.txt and against.json")
    parser.add_argument("--scene", action="append", help=f"default: {', '.join(SCENES)}; may be repeated")
    parser.add_argument("--pulses", type=int, default=200_000, help="of a simulated scene")
    parser.add_argument("--repeat", type=int, default=5, help="rounds")
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args(words)
    with tempfile.TemporaryDirectory(prefix="wavebatch-bench-") as folder:
        strips = {path.name: path for path in given.strips}
        strips = strips or simulate_strips(given.scene or SCENES, given.pulses, given.seed, Path(folder))
        found = compare_runs(given.other, strips, given.repeat, say=lambda text: print(text, file=sys.stderr))
    text, document = format_paired(given.other, found), to_document(given.other, found)
    print(text)
    print(write_texts(given.output, {"against.txt": text, "against.json": json.dumps(document)}), file=sys.stderr)


if __name__ == "__main__":
    try:
        main()
    except InputError as error:
        sys.exit(f"error: {error}")
