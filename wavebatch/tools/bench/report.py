"""A benchmark as a sheet, and its files: bench.json, bench.txt, a page and plots of error against run time.

`wavebatch bench` prints `bench_sheet` and calls `write_outputs`. A column of a table names a figure of the rows.
`align` makes tables of the examples and of tests/bench.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch.core.errors import advise_install
from wavebatch.files.disk.publish import reporting
from wavebatch.files.figure_file import has_matplotlib, open_picture, plain_text
from wavebatch.files.text_file import write_text
from wavebatch.stages.score import QUANTITIES
from wavebatch.tools.bench.accuracy import find_front
from wavebatch.tools.sheets.sheet import Cell, Later, Note, Part, Picture, Sheet, Table, list_lines

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


NO_PLOT = f"no plot without matplotlib: {advise_install('matplotlib')}"

PANELS = (
    ("wrong", 100.0, "echoes missed or false [%]"),
    ("rmse_all_cm", 1.0, "rms error of the range, all echoes [cm]"),
)


def bench_sheet(document: Mapping[str, Any]) -> Sheet:
    """The sheet of a benchmark: for each scene what was measured of every chain."""
    words = (
        f"wavebatch {document['version']} bench, seed {document['seed']}. +- is the {document['error_means']} "
        "(1.41 times that of the figure)."
    )
    scenes = (_scene_sheet(one, document.get("tolerance_cm")) for one in document["scenes"])
    return Sheet("bench", [Note(words), *scenes])


def format_document(document: Mapping[str, Any]) -> str:
    """The text of a benchmark."""
    return "\n".join(list_lines(bench_sheet(document)))


def write_bench_page(target: Path, document: Mapping[str, Any]) -> None:
    """Write the page of a benchmark; document: as --json prints it."""
    from wavebatch.tools.sheets.page import write_page

    names = ", ".join(section["scene"] for section in document["scenes"])
    write_page(target, f"wavebatch bench: {names}", bench_sheet(document).parts)


def _scene_sheet(section: Mapping[str, Any], tolerance_cm: float | None) -> Sheet:
    rows, survey = section["rows"], section["survey"]
    found = (
        f"survey of {survey['groups']} x {survey['waveforms_of_a_group']} waveforms: "
        f"sigma {_span(survey['sigma_ref'])} ns, noise {_span(survey['noise_std'])} DN, "
        f"kappa {_span(survey['kappa'])}, "
        f"acceptance {_span(survey['acceptance'])}, Gaussians {', '.join(map(str, survey['components']))}"
    )
    parts: list[Part] = [Note(f"== {section['scene']}: {section['meaning']}"), Note(found)]
    parts += [Later(partial(_draw_scene, section)), _speed_table(rows)]
    parts += [_figure_table("echoes found", rows, SHARES), _figure_table("rms error of the range", rows, LENGTHS)]
    for kind in ("isolated", "overlapped"):
        ratios = [(name, f"{name}_ratio_{kind}", 1.0, 3) for name in QUANTITIES]
        ratios += [("gross %", f"gross_{kind}", 100, 2), ("err column", f"time_calibration_{kind}", 1.0, 3)]
        parts.append(_figure_table(f"{kind}: rms error / Cramer-Rao bound, SNR >= 10", rows, ratios))
    parts.append(_figure_table("rms error of the time / its error column, SNR >= 10", rows, REPORTED))
    if tolerance_cm is not None:
        wanted = f"an error of {tolerance_cm:g} cm for isolated echoes"
        best = next((row for row in rows if row["name"] == section["cheapest"]), None)
        words = f"cheapest chain with {wanted}: {best['name']} ({figure_text(best, LENGTHS[1])} cm)" if best else ""
        parts.append(Note(words or f"no chain meets {wanted}"))
    return Sheet(f"Scene {section['scene']}", parts)


def _span(times: Mapping[str, Any]) -> str:
    low, high = f"{times['min']:.4g}", f"{times['max']:.4g}"
    return low if low == high else f"{low}..{high}"


def _rate(times: Mapping[str, Any]) -> Cell:
    """Waveforms per second from times in microseconds: median and range."""
    if not times["median"]:
        return Cell("-", "")
    rate = 1e6 / times["median"]
    return Cell(f"{rate:,.0f} ({1e6 / times['max']:,.0f}..{1e6 / times['min']:,.0f})", rate)


def _speed_table(rows: Sequence[Mapping[str, Any]]) -> Table:
    head = ("median (least..most) waveforms/s", "kernels", "file to file", "with survey", "survey s", "MB", "front")
    lines = []
    for row in rows:
        name = row["name"]
        if row.get("same_as"):
            name += f" (is {row['same_as']})"
        if row.get("crashed_or_hung"):
            name += f" ({row['crashed_or_hung']} crashed or hung)"
        rates = (_rate(row[kind]) for kind in ("kernels", "file", "file_with_survey"))
        megabytes = None if row["peak_bytes"] is None else row["peak_bytes"] / 1e6
        lines.append((name, *rates, row["survey_seconds"]["median"], megabytes, "*" if row["pareto"] else ""))
    return Table(head, lines, ("", "", "", "", ".2f", ".0f", ""), sortable=True)


def _figure_table(title: str, rows: Sequence[Mapping[str, Any]], columns: Sequence[ReportColumn]) -> Table:
    lines = [(row["name"], *(Cell(figure_text(row, one), row["figures"][one[1]]["value"]) for one in columns))
             for row in rows]  # fmt: skip
    return Table((title, *(column[0] for column in columns)), lines, sortable=True)


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
        with open_picture(folder / name, (11, 4.6), overwrite=True, dpi=120) as figure:
            figure.suptitle(plain_text(f"{section['scene']}: error against run time, one core"))
            for axes, panel in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
                _draw_panel(axes, section["rows"], *panel)
        written += f", {name}"
    return [written]


def write_texts(folder: Path, texts: Mapping[str, str]) -> str:
    """Writes texts by file name into a folder, replacing old ones; returns a line that names them."""
    with reporting(folder):
        folder.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_text(folder / name, text + "\n", overwrite=True)
    return f"{folder}: {', '.join(texts)}"


def _draw_scene(section: Mapping[str, Any]) -> Iterator[Picture]:
    """The same panels for a page."""
    from wavebatch.tools.plots.charts import picture

    for panel in PANELS:
        draw = lambda figure, panel=panel: _draw_panel(  # noqa: E731
            figure.add_axes((0.12, 0.14, 0.85, 0.82)), section["rows"], *panel
        )
        yield from picture(panel[2], (5.6, 3.6), draw, "Below and to the left is better.")


def _draw_panel(axes: Any, rows: list[Mapping[str, Any]], name: str, factor: float, label: str) -> None:
    """Draws one error against time."""
    from matplotlib.ticker import LogLocator, NullLocator, StrMethodFormatter

    from wavebatch.tools.plots.draw_cloud import MARKERS, SERIES

    twins = {row["same_as"]: row["name"] for row in rows if "same_as" in row}
    rows = [row for row in rows if "same_as" not in row]
    known = [row for row in rows if row["kernels"]["median"] and row["figures"][name]["value"] is not None]
    time = np.array([row["kernels"]["median"] for row in known])
    value = np.array([row["figures"][name]["value"] * factor for row in known])
    error = np.array([(row["figures"][name]["error"] or 0.0) * factor for row in known])
    axes.set_xscale("log")
    axes.xaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axes.xaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.xaxis.set_minor_locator(NullLocator())
    axes.set(xlabel="kernels: microseconds per waveform", ylabel=label)
    if not known:
        return
    chains = np.array([row["kind"] == "chain" for row in known])
    front = find_front(np.where(chains[:, None], np.stack([time, value], axis=1), np.nan))
    order = np.flatnonzero(front)[np.argsort(time[front])]
    axes.plot(time[order], value[order], color="tab:red", zorder=1, label="Pareto front")
    for i, row in enumerate(known):
        names = " = ".join([row["name"], *filter(None, [twins.get(row["name"])])])
        marker, color = MARKERS[i // len(SERIES) % len(MARKERS)], SERIES[i % len(SERIES)]
        axes.errorbar(time[i], value[i], yerr=error[i], fmt=marker, color=color, capsize=2, label=names)
    axes.margins(x=0.25, y=0.15)
    axes.set_ylim(bottom=0)
    axes.legend(fontsize=7.0)
