"""Runs a part of the judges in another checkout, and compares two results side by side."""

from __future__ import annotations

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
