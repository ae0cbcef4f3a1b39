"""The stiff cases as text: a table of every chain, and one line of every method; `release` calls `format_stability`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from wavebatch.stages.score import QUANTITIES
from wavebatch.tools.bench.command import figure_text


def align(lines: Sequence[Sequence[str]]) -> list[str]:
    """Lines of cells as columns: the first aligned to the left, the others to the right."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    form = "  ".join(["{:<%d}", *["{:>%d}"] * (len(widths) - 1)]) % tuple(widths)
    return [form.format(*line).rstrip() for line in lines]


def format_stability(rows: Sequence[Mapping[str, Any]]) -> str:
    """All tables of `measure_stability`."""
    parts = [
        "== stiff and extreme cases: s is the width of the system pulse, false the share of single echoes split or of "
        "empty waveforms with an echo, err the rms error / Cramer-Rao bound"
    ]
    for chain in dict.fromkeys(row["chain"] for row in rows if not row["is_method"]):
        parts.append("\n".join(align(_stability_lines([row for row in rows if row["chain"] == chain], chain))))
    methods = [row for row in rows if row["is_method"]]
    if methods:
        parts.append("\n".join(align(_method_lines(methods))))
    return "\n\n".join(parts)


def _method_lines(rows: Sequence[Mapping[str, Any]]) -> list[list[str]]:
    """A line per method: waveforms with the exact number of echoes, mean of the cases of each hazard, and failures."""
    hazards = list(dict.fromkeys(row["hazard"] for row in rows))
    lines = [["every method: exact %, mean of the cases", *hazards, "failures"]]
    for name in dict.fromkeys(row["chain"] for row in rows):
        of_chain = [row for row in rows if row["chain"] == name]
        cells = []
        for hazard in hazards:
            exact = [row["figures"]["exact_count"]["value"] for row in of_chain if row["hazard"] == hazard]
            cells.append(f"{100 * sum(exact) / len(exact):.1f}")
        lines.append([name, *cells, _list_failures(of_chain)])
    return lines


def _list_failures(rows: Sequence[Mapping[str, Any]]) -> str:
    """Sums per kind of failure over the rows; `none` without any."""
    kinds = {name: sum(row["failures"][name] for row in rows) for name in rows[0]["failures"]}
    return ", ".join(f"{number} {name}" for name, number in kinds.items() if number) or "none"


def _stability_lines(rows: Sequence[Mapping[str, Any]], chain: str) -> list[list[str]]:
    heads = ("found %", "exact %", "false %", "err time", "err amplitude", "err sigma", "gross %")
    title = f"{chain} (is auto)" if all(row["is_auto"] for row in rows) and chain != "auto" else chain
    lines = [[title, "waveforms", *heads, "failures", "flags of the echoes"]]
    for row in rows:
        known = {name for name, figure in row["figures"].items() if figure["value"] is not None}
        kind = "isolated" if "found_isolated" in known else "overlapped"
        names = ["completeness", "exact_count", "false_splits" if "false_splits" in known else "false_alarms"]
        figures = [figure_text(row, ("", name, 100, 1)) for name in names]
        figures += [figure_text(row, ("", f"{name}_ratio_{kind}", 1, 2)) for name in QUANTITIES]
        figures.append(figure_text(row, ("", f"gross_{kind}", 100, 1)))
        cells = [f"{row['hazard']:<4}{row['case']}", str(row["waveforms"])]
        lines.append([*cells, *figures, _list_failures([row]), _list_flags(row)])
    return lines


def _list_flags(row: Mapping[str, Any]) -> str:
    shares = {name: number / max(row["echoes"], 1) for name, number in row["flags"].items()}
    return ", ".join(f"{name} {share:.0%}" if share >= 0.005 else f"{name} <1%" for name, share in shares.items())
