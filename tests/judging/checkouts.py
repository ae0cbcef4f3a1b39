"""Runs a part of the judges in another checkout, and compares two results side by side; the command of two judges."""

from __future__ import annotations

import argparse
import importlib
import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from time import process_time
from typing import Any

import numpy as np

FWHM_PER_SIGMA = 2.3548200450309493
GROUP = 25
"""Strips of one process."""


def run_in(root: Path, script: Path, arguments: Iterable[str]) -> Iterator[dict[str, Any]]:
    """JSON lines that `script --child ...` prints with the wavebatch of a checkout; one thread, one process.

    """
    python = root / ".venv" / "bin" / "python"
    environment = os.environ | {"PYTHONPATH": str(root), "OPENBLAS_NUM_THREADS": "1", "PYTHONWARNINGS": "ignore"}
    command = [str(python if python.exists() else sys.executable), str(script), "--child", *arguments]
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as child:
        yield from (json.loads(line) for line in child.stdout if line.startswith("{"))
    if child.returncode:
        print(f"the child with {' '.join(command[1:])} ended with {child.returncode}", file=sys.stderr)


def timed(call: Callable, *arguments: Any, **options: Any) -> tuple[Any, float]:
    """A result and the processor time that it took [s]."""
    start = process_time()
    result = call(*arguments, **options)
    return result, process_time() - start


def find_echoes(strip: Any, chain: Any, system: Any) -> dict[str, np.ndarray]:
    """Echoes of all packets of an open strip, sorted by packet, then time [ns]."""
    blocks = list(strip.blocks())
    return flatten(blocks, [chain.run(block, system) for block in blocks])


def flatten(blocks: list[Any], tables: list[Any]) -> dict[str, np.ndarray]:
    """Echoes of blocks as columns, sorted by packet, then time [ns]; packets by the row of their first point."""
    names = ("time", "amplitude", "sigma", "time_err", "amplitude_err", "flags")
    parts = [[block.point[echoes.waveform], *(getattr(echoes, name) for name in names)]
             for block, echoes in zip(blocks, tables, strict=True)]  # fmt: skip
    columns = [np.concatenate(column) for column in zip(*parts, strict=True)]
    order = np.lexsort((columns[1], columns[0]))
    return {name: column[order] for name, column in zip(("packet", *names), columns, strict=True)}


def find_doubts(path: Path, survey: Any, folder: Path) -> tuple[list[str], float]:
    """What `wavebatch run` prints as warnings of a strip's survey, and the processor time of that run [s].

    The run is given the survey, which took its time before. Lines about returns and forced surveys are left out.
    """
    import wavebatch as wb

    events = []
    options = {"chain": "auto", "jobs": 1, "system": survey, "overwrite": True}
    _, seconds = timed(wb.run, [path], folder, on_event=events.append, **options)
    said = [str(line) for event in events for line in event.get("warnings", ())]
    return [line for line in said if "--system " not in line.split(":")[0] and "returns" not in line], seconds


def find_function(name: str) -> Callable:
    """A function of wavebatch, wherever it is."""
    import wavebatch

    folder = Path(wavebatch.__file__).parent
    home = next(path for path in sorted(folder.rglob("*.py")) if f"\ndef {name}(" in path.read_text())
    return getattr(importlib.import_module(".".join(home.relative_to(folder.parent).with_suffix("").parts)), name)


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The results in a file, one per line."""
    return [json.loads(line) for line in path.read_text().splitlines() if line]


def format_table(rows: list[list[Any]]) -> str:
    """Rows as text, the first one the head; numbers get three digits."""
    text = [[_format(value) for value in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*text, strict=True)]
    return "\n".join(
        "  ".join(f"{value:<{width}}" if not i else f"{value:>{width}}" for i, (value, width) in enumerate(
            zip(row, widths, strict=True))) for row in text
    )  # fmt: skip


def _format(value: Any) -> str:
    if value is None or (isinstance(value, float) and not np.isfinite(value)):
        return "-"
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def verdict(result: dict[str, Any]) -> str:
    """One word for right or wrong, said or not."""
    said = bool(result["doubts"])
    return ("doubted" if said else "right") if result["right"] else ("said" if said else "silent")


def read_numbers(text: str) -> list[int]:
    """Numbers of "0-299", "3,7" and mixtures of these."""
    parts = [part.split("-") for part in text.split(",")]
    return [number for part in parts for number in range(int(part[0]), int(part[-1]) + 1)]


def judge_seeds(
    script: Path, text: str | None, judge: Callable[[int, Path], dict[str, Any]], tabulate: Callable, home: str,
    seeds: str,
) -> int:  # fmt: skip
    """The command of a judge of numbered strips, which are kept in the folder `home` beside the checkout."""
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[2], help="checkout to judge")
    parser.add_argument("--seeds", default=seeds, help="strips, as 0-299 or 3,7,11")
    parser.add_argument("--strips", type=Path, default=Path(__file__).parents[3] / home,
                        help="folder that keeps the strips; default: beside the checkout")
    parser.add_argument("-o", "--output", type=Path, help="JSON lines; strips that are there already are kept")
    parser.add_argument("--compare", type=Path, help="JSON lines of another checkout")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    given = parser.parse_args()
    numbers = read_numbers(given.seeds)
    if given.child:
        given.strips.mkdir(parents=True, exist_ok=True)
        for number in numbers:
            print(json.dumps(judge(number, given.strips)), flush=True)
        return 0
    kept = read_lines(given.output) if given.output and given.output.exists() else []
    results = {one["strip"]: one for one in kept}
    todo = [number for number in numbers if number not in results]
    for start in range(0, len(todo), GROUP):
        group = ",".join(map(str, todo[start : start + GROUP]))
        for one in run_in(given.root.resolve(), script, ["--seeds", group, "--strips", str(given.strips)]):
            results[one["strip"]] = one
            seconds = one.get("survey_s", one.get("run_s", np.nan))
            print(f"{one['strip']}: {verdict(one)} in {seconds:.2f} s", file=sys.stderr)
            if given.output:
                with given.output.open("a") as file:
                    file.write(json.dumps(one) + "\n")
    older = read_lines(given.compare) if given.compare else []
    print(tabulate([results[number] for number in numbers if number in results], older))
    return 0
