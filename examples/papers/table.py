"""Shared by the scripts of this folder: options, tables of published and measured figures, and the exit code."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from wavebatch.tools.bench.report import align

HEADS = ["figure", "paper", "spec", "ours", "accepted", ""]


@dataclass
class Table:
    """Figures under one title: of the paper, of the simulation in docs/algorithms.md (`spec`), and ours."""

    title: str
    digits: int = 2
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
        paper: float | None = None,
        spec: float | None = None,
    ) -> None:
        """Adds a figure that must lie from low to high; without limits it is only printed."""
        ours = float(ours)
        bounded = math.isfinite(low) or math.isfinite(high)
        verdict = ("ok" if low <= ours <= high else "FAIL") if bounded else ""
        cells = [self._format(value) for value in (paper, spec, ours)]
        self.rows.append([name, *cells, self._format_band(low, high), verdict])
        self.values[name] = ours
        if verdict == "FAIL":
            self.failures.append(name)

    def near(
        self, name: str, ours: float, expected: float, *, within: float = 0.0, share: float = 0.0, **known
    ) -> None:
        """Adds a figure that may deviate from the expected one by `within`, or by `share` of it if that is more."""
        room = max(within, share * abs(expected))
        self.add(name, ours, expected - room, expected + room, **(known or {"spec": expected}))

    def _format(self, value: float | None) -> str:
        if value is None:
            return "-"
        text = f"{value:.{self.digits}f}"
        return text if value == 0 or float(text) != 0 else f"{value:.1e}"

    def _format_band(self, low: float, high: float) -> str:
        if math.isinf(low) and math.isinf(high):
            return "-"
        if math.isinf(high):
            return f">= {self._format(low)}"
        return f"<= {self._format(high)}" if math.isinf(low) else f"{self._format(low)}..{self._format(high)}"

    def __str__(self) -> str:
        return "\n".join(align([[self.title, *HEADS[1:]], *self.rows]))


def main(measure: Callable[[int, int], list[Table | str]], doc: str, number: int) -> int:
    """Prints the tables of `measure(number, seed)`; 1 where a figure is not accepted, else 0."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the simulation (default 0)")
    parser.add_argument("--number", type=int, default=number, help=f"waveforms, or pulses (default {number})")
    parser.add_argument("--json", type=Path, help="write the tables to this file, too")
    options = parser.parse_args()
    tables = measure(options.number, options.seed)
    print("\n\n".join(str(table) for table in tables))
    failures = [f"{t.title}: {name}" for t in tables if isinstance(t, Table) for name in t.failures]
    if options.json is not None:
        rows = [{"title": t.title, "rows": t.rows} if isinstance(t, Table) else {"text": t} for t in tables]
        options.json.write_text(json.dumps(rows), "utf-8")
    print(f"\n{len(failures)} figures not accepted" + "".join(f"\n  {line}" for line in failures))
    return 1 if failures else 0
