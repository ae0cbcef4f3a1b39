"""Shared by the scripts of this folder: options, tables of published and measured figures, and the exit code."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

HEADS = ["figure", "paper", "spec", "ours", "accepted", ""]


@dataclass
class Table:
    """Figures under one title: of the paper, of the simulation in docs/algorithms.md (`spec`), and ours."""

    title: str
    digits: int = 2
    room: float = 1.0
    """Factor of the bands of `near`: a run with fewer waveforms scatters more, see `scatter`."""
    rows: list[list[str]] = field(default_factory=list)
    values: dict[str, float] = field(default_factory=dict)
    failures: list[str] = field(default_factory=list)

    def add(
        self,
        name: str,
        ours: float,
        low: float = -math.inf,
        high: float = math.inf,
        *,
        paper: float | str | None = None,
        spec: float | None = None,
        digits: int | None = None,
    ) -> None:
        """Adds a figure that must lie from low to high; without limits it is only printed.

        paper: a range as text. digits: decimals, as many as the figure is known to; those of the table if None.
        """
        ours = float(ours)
        bounded = math.isfinite(low) or math.isfinite(high)
        verdict = ("ok" if low <= ours <= high else "FAIL") if bounded else ""
        decimals = self.digits if digits is None else digits
        printed = paper if isinstance(paper, str) else format_value(paper, decimals)
        cells = [printed, *(format_value(value, decimals) for value in (spec, ours))]
        self.rows.append([name, *cells, format_band(low, high, decimals), verdict])
        self.values[name] = ours
        if verdict == "FAIL":
            self.failures.append(name)

    def near(
        self, name: str, ours: float, expected: float, *, within: float = 0.0, share: float = 0.0, **known
    ) -> None:
        """Adds a figure that may deviate from the expected one by `within`, or by `share` of it if that is more.

        Both grow by `room`. known: paper, spec and digits as for `add`; without paper and spec the expected value is
        the specification's.
        """
        room = self.room * max(within, share * abs(expected))
        if not known.keys() & {"paper", "spec"}:
            known["spec"] = expected
        self.add(name, ours, expected - room, expected + room, **known)

    def near_share(
        self, name: str, ours: float, expected: float, *, within: float, whole: float = 100.0, **known
    ) -> None:
        """Adds a share as `near`, with a band that ends at 0 and at the whole."""
        low, high = expected - self.room * within, expected + self.room * within
        if not known.keys() & {"paper", "spec"}:
            known["spec"] = expected
        self.add(name, ours, max(low, 0.0), min(high, whole), **known)

    def __str__(self) -> str:
        return "\n".join(_align([[self.title, *HEADS[1:]], *self.rows]))


def _align(lines: Sequence[Sequence[str]]) -> list[str]:
    """Lines of cells as columns: the first aligned to the left, the others to the right."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    form = "  ".join(["{:<%d}", *["{:>%d}"] * (len(widths) - 1)]) % tuple(widths)
    return [form.format(*line).rstrip() for line in lines]


def scatter(number: int, full: int) -> float:
    """How much more the figures of `number` waveforms scatter than those of `full`; 1 where there are as many."""
    return max(math.sqrt(full / number), 1.0)


def format_value(value: float | None, digits: int) -> str:
    """A figure with its decimals; small ones as powers of ten, a dash where there is none."""
    if value is None:
        return "-"
    text = f"{value:.{digits}f}"
    return text if value == 0 or float(text) != 0 else f"{value:.1e}"


def format_band(low: float, high: float, digits: int) -> str:
    """The accepted band; a dash where there is none."""
    if math.isinf(low) and math.isinf(high):
        return "-"
    if math.isinf(high):
        return f">= {format_value(low, digits)}"
    if math.isinf(low):
        return f"<= {format_value(high, digits)}"
    return f"{format_value(low, digits)}..{format_value(high, digits)}"


def main(
    measure: Callable[[int, int], list[Table | str]], doc: str, number: int, words: Sequence[str] | None = None
) -> int:
    """Prints the tables of `measure(number, seed)`; 1 where a figure is not accepted, else 0.

    words: options; those of the command line where there are none.
    """
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the simulation (default 0)")
    parser.add_argument("--number", type=int, default=number, help=f"waveforms, or pulses (default {number})")
    parser.add_argument("--json", type=Path, help="write the tables to this file, too")
    options = parser.parse_args(words)
    tables = measure(options.number, options.seed)
    print("\n\n".join(str(table) for table in tables))
    failures = [f"{t.title}: {name}" for t in tables if isinstance(t, Table) for name in t.failures]
    if options.json is not None:
        rows = [{"title": t.title, "rows": t.rows} if isinstance(t, Table) else {"text": t} for t in tables]
        options.json.write_text(json.dumps(rows), "utf-8")
    print(f"\n{len(failures)} figures not accepted" + "".join(f"\n  {line}" for line in failures))
    return 1 if failures else 0
