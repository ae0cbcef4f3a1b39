"""Text tables of a benchmark document, and its files: bench.json, bench.txt and plots.

`wavebatch bench` calls `format_document` and `write_outputs`. A column of a table names a figure of the rows; `align`
makes the text, for the examples and tests/bench too.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from wavebatch.files.disk.publish import reporting
from wavebatch.files.figure_file import has_matplotlib
from wavebatch.files.text_file import write_text
from wavebatch.stages.score import QUANTITIES
from wavebatch.tools.bench.plot import NO_PLOT, plot_scene

ReportColumn = tuple[str, str, float, int]
"""Head, name of the figure, factor, decimals."""

SHARES: tuple[ReportColumn, ...] = (
    ("complete %", "completeness", 100, 2),
    ("correct %", "correctness", 100, 2),
    ("exact %", "exact_count", 100, 2),
    ("splits %", "false_splits", 100, 2),
    ("isolated %", "found_isolated", 100, 2),
    ("overlapped %", "found_overlapped", 100, 2),
)
LENGTHS: tuple[ReportColumn, ...] = (
    ("all cm", "rmse_all_cm", 1, 2),
    ("isolated cm", "rmse_isolated_cm", 1, 2),
    ("overlapped cm", "rmse_overlapped_cm", 1, 2),
)

REPORTED: tuple[ReportColumn, ...] = (
    ("no flag", "time_calibration_not_flagged", 1.0, 2),
    ("flag", "time_calibration_flagged", 1.0, 2),
    ("neighbours found", "time_calibration_not_hidden", 1.0, 2),
    ("one not found", "time_calibration_hidden", 1.0, 2),
    ("share of these %", "hidden", 100, 2),
)
"""Errors of times over the reported ones: echoes without and with a flag of UNCLEAN, and by what was found around."""


def _ratios(kind: str) -> tuple[ReportColumn, ...]:
    columns = tuple((name, f"{name}_ratio_{kind}", 1.0, 3) for name in QUANTITIES)
    return (*columns, ("gross %", f"gross_{kind}", 100, 2), ("err column", f"time_calibration_{kind}", 1.0, 3))


def format_document(document: Mapping[str, Any]) -> str:
    """All tables as text."""
    parts = [
        f"wavebatch {document['version']} bench, seed {document['seed']}. +- is the {document['error_means']} "
        "(1.41 times that of the figure).",
        *(_format_scene(section, document.get("tolerance_cm")) for section in document["scenes"]),
    ]
    return "\n\n".join(parts)


def _format_scene(section: Mapping[str, Any], tolerance_cm: float | None) -> str:
    rows, survey = section["rows"], section["survey"]
    head = [
        f"== {section['scene']}: {section['meaning']}",
        f"survey of {survey['groups']} x {survey['waveforms_of_a_group']} waveforms: "
        f"sigma {_span(survey['sigma_ref'])} ns, noise {_span(survey['noise_std'])} DN, "
        f"kappa {_span(survey['kappa'])}, "
        f"acceptance {_span(survey['acceptance'])}, Gaussians {', '.join(map(str, survey['components']))}",
    ]
    parts = [head, _speed_table(rows), _figure_table("echoes found", rows, SHARES)]
    parts.append(_figure_table("rms error of the range", rows, LENGTHS))
    for kind in ("isolated", "overlapped"):
        parts.append(_figure_table(f"{kind}: rms error / Cramer-Rao bound, SNR >= 10", rows, _ratios(kind)))
    parts.append(_figure_table("rms error of the time / its error column, SNR >= 10", rows, REPORTED))
    if tolerance_cm is not None:
        parts.append([_format_cheapest(section, tolerance_cm)])
    return "\n\n".join(map("\n".join, parts))


def _format_cheapest(section: Mapping[str, Any], tolerance_cm: float) -> str:
    wanted = f"an error of {tolerance_cm:g} cm for isolated echoes"
    if section["cheapest"] is None:
        return f"no chain meets {wanted}"
    row = next(row for row in section["rows"] if row["name"] == section["cheapest"])
    return f"cheapest chain with {wanted}: {row['name']} ({figure_text(row, LENGTHS[1])} cm)"


def _span(times: Mapping[str, Any]) -> str:
    low, high = f"{times['min']:.4g}", f"{times['max']:.4g}"
    return low if low == high else f"{low}..{high}"


def rate_text(times: Mapping[str, Any]) -> str:
    """Waveforms per second from times in microseconds: median and range."""
    if not times["median"]:
        return "-"
    return f"{1e6 / times['median']:,.0f} ({1e6 / times['max']:,.0f}..{1e6 / times['min']:,.0f})"


def _speed_table(rows: Sequence[Mapping[str, Any]]) -> list[str]:
    lines = [["median (least..most) waveforms/s", "kernels", "file to file", "with survey", "survey s", "MB", "front"]]
    for row in rows:
        name = row["name"]
        if row.get("same_as"):
            name += f" (is {row['same_as']})"
        if row.get("crashed_or_hung"):
            name += f" ({row['crashed_or_hung']} crashed or hung)"
        once, memory = row["survey_seconds"]["median"], row["peak_bytes"]
        rates = (rate_text(row[kind]) for kind in ("kernels", "file", "file_with_survey"))
        cells = ("-" if once is None else f"{once:.2f}", "-" if memory is None else f"{memory / 1e6:.0f}")
        lines.append([name, *rates, *cells, "*" if row["pareto"] else ""])
    return align(lines)


def _figure_table(title: str, rows: Sequence[Mapping[str, Any]], columns: Sequence[ReportColumn]) -> list[str]:
    lines = [[title, *(column[0] for column in columns)]]
    lines += [[row["name"], *(figure_text(row, column) for column in columns)] for row in rows]
    return align(lines)


def figure_text(row: Mapping[str, Any], column: ReportColumn) -> str:
    """A figure of a row with its error; a dash where there is no figure."""
    _, name, factor, decimals = column
    figure = row["figures"][name]
    if figure["value"] is None:
        return "-"
    text = f"{figure['value'] * factor:.{decimals}f}"
    return text if figure["error"] is None else f"{text} +-{figure['error'] * factor:.{decimals}f}"


def align(lines: Sequence[Sequence[str]]) -> list[str]:
    """Lines of cells as columns: the first aligned to the left, the others to the right."""
    widths = [max(len(line[i]) for line in lines) for i in range(len(lines[0]))]
    form = "  ".join(["{:<%d}", *["{:>%d}"] * (len(widths) - 1)]) % tuple(widths)
    return [form.format(*line).rstrip() for line in lines]


def write_outputs(document: Mapping[str, Any], text: str, folder: Path) -> list[str]:
    """Writes bench.json, bench.txt and a PNG per scene, replacing old ones; returns messages for the user.

    Without matplotlib there are no plots, and a message says how to get them. Raises InputError where it cannot write.
    """
    texts = {"bench.json": json.dumps(document, indent=1, sort_keys=True), "bench.txt": text}
    written = write_texts(folder, texts)
    if not has_matplotlib():
        return [written, NO_PLOT]
    for section in document["scenes"]:
        name = f"bench-{Path(section['scene']).stem}.png"
        plot_scene(section, folder / name)
        written += f", {name}"
    return [written]


def write_texts(folder: Path, texts: Mapping[str, str]) -> str:
    """Writes texts by file name into a folder, replacing old ones; returns a line that names them."""
    with reporting(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_text(folder / name, text + "\n", overwrite=True)
    return f"{folder}: {', '.join(texts)}"
