"""The page of `wavebatch bench --html`: error against run time of every chain, with all tables."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from wavebatch.tools.bench.report import LENGTHS, SHARES, ReportColumn, figure_text, rate_text
from wavebatch.tools.html import markup
from wavebatch.tools.html.charts import draw_scatter, figures
from wavebatch.tools.html.page import write_page


def write_bench_page(target: Path, document: Mapping[str, Any], report: str) -> None:
    """Write the page of a benchmark; document: as --json prints it, report: the text that is printed."""
    names = ", ".join(section["scene"] for section in document["scenes"])
    write_page(target, f"wavebatch bench: {names}", _parts(document, report))


def _parts(document: Mapping[str, Any], report: str) -> Iterator[str]:
    rows = {"wavebatch": document["version"], "seed": document["seed"], "\u00b1 is": document["error_means"]}
    yield markup.section("Summary", markup.facts(rows))
    for section in document["scenes"]:
        yield _draw_scene(section)
    yield markup.section("Report", markup.paragraph("The text that the command prints, with all figures."),
                         markup.code(report))  # fmt: skip


def _draw_scene(section: Mapping[str, Any]) -> str:
    rows = section["rows"]
    head = ["chain", "waveforms/s (kernels)", *(column[0] for column in (*SHARES, *LENGTHS)), "on the front"]
    lines = [[_name(row), markup.Cell(markup.text(rate_text(row["kernels"])), _rate(row)),
              *(markup.Cell(_figure(row, column), row["figures"][column[1]]["value"])
                for column in (*SHARES, *LENGTHS)), "yes" if row["pareto"] else ""] for row in rows]  # fmt: skip
    charts = []
    for name, factor, label in (
        ("wrong", 100.0, "echoes missed or false [%]"),
        ("rmse_all_cm", 1.0, "rms error of the range [cm]"),
    ):
        points = [(_name(row), row["kernels"]["median"] or 0.0, factor * (row["figures"][name]["value"] or 0.0))
                  for row in rows]  # fmt: skip
        charts.append(draw_scatter(points, title=label, labels=("microseconds per waveform", label),
                                   note="Below and to the left is better."))  # fmt: skip
    return markup.section(f"Scene {section['scene']}", markup.paragraph(section["meaning"]),
                          figures([chart for chart in charts if chart]),
                          markup.table(head, lines, sortable=True))  # fmt: skip


def _name(row: Mapping[str, Any]) -> str:
    return f"{row['name']} (is {row['same_as']})" if row.get("same_as") else row["name"]


def _rate(row: Mapping[str, Any]) -> float | str:
    return 1e6 / row["kernels"]["median"] if row["kernels"]["median"] else ""


def _figure(row: Mapping[str, Any], column: ReportColumn) -> str:
    return markup.text(figure_text(row, column).replace("+-", "\u00b1 "))
