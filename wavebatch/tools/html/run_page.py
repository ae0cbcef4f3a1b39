"""The page of `wavebatch run --html`: sums of the batch, an index of its strips, and a part per strip.

The parts are written one after the other, so that memory does not grow with the batch.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wavebatch import __version__
from wavebatch.batch.report_file import cloud_path, report_path
from wavebatch.batch.run import BatchResult, Outcome
from wavebatch.core.errors import StripWarning
from wavebatch.tools.html import markup
from wavebatch.tools.html.charts import figures, figures_of
from wavebatch.tools.html.outliers import FEWEST, FIGURES, describe_sensor, find_outliers, measure_strip
from wavebatch.tools.html.page import write_page
from wavebatch.tools.html.strip_part import count_tables, draw_strip, flag_table

FEW = 4
"""So many strips all have a part."""

MOST_PARTS = 8
"""Strips with a part each: a part has about 200 kB, and a browser must still open the page."""

PART_WAVEFORMS = 200_000
"""Waveforms of a larger batch for each part but the first: the run of a tenth of these takes as long as a part."""


@dataclass(frozen=True, slots=True)
class _Strip:
    """A strip of the batch."""

    outcome: Outcome
    number: int
    cloud: Path
    report: Path
    has_report: bool
    """False where it failed, or its report cannot be read."""
    figures: dict[str, float]
    sensor: str


def write_run_page(target: Path, result: BatchResult, folder: Path, command: str = "") -> None:
    """Write the page of a finished batch; folder: of its outputs. Raises InputError if it cannot be written."""
    strips = [_read_strip(outcome, place, folder) for place, outcome in enumerate(result.outcomes)]
    marks = find_outliers([strip.figures for strip in strips], [strip.sensor for strip in strips])
    # Strips to look at come first, in the table and where there are too many to show all.
    order = sorted(strips, key=lambda one: (not (one.outcome.error or one.outcome.report.warnings),
                                            not marks[one.number], one.number))  # fmt: skip
    most = min(MOST_PARTS, 1 + result.report.count("waveforms") // PART_WAVEFORMS) if len(strips) > FEW else FEW
    shown = {strip.number for strip in [one for one in order if one.has_report][:most]}
    write_page(target, _title(strips), _parts(result, order, marks, shown, command))


def _title(strips: Sequence[_Strip]) -> str:
    names = strips[0].outcome.job.path.name if len(strips) == 1 else f"{len(strips)} strips"
    return f"wavebatch run: {names}"


def _read_strip(outcome: Outcome, number: int, folder: Path) -> _Strip:
    place = report_path(outcome.job, folder)
    report = None if outcome.status == "failed" else _read_report(place)
    figures_, sensor = ({}, "") if report is None else (measure_strip(report), describe_sensor(report))
    return _Strip(outcome, number, cloud_path(outcome.job, folder), place, report is not None, figures_, sensor)


def _read_report(path: Path) -> dict[str, Any] | None:
    """A report; None where it was moved or changed after the run: the index then has the strip's counts only."""
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None


def _parts(
    result: BatchResult, strips: Sequence[_Strip], marks: Sequence[dict[str, str]], shown: set[int], command: str
) -> Iterator[str]:
    whole = result.report.to_json()
    counts = whole["counts"]
    yield _summary(result, counts)
    if len(strips) > 1:
        yield _navigate([strip for strip in strips if strip.number in shown])
    failed = [f"{one.outcome.job.path}: {' '.join(str(one.outcome.error).split())}" for one in strips
              if one.outcome.error is not None]  # fmt: skip
    if failed:
        yield markup.section("Failed strips", markup.bullets(failed, "warning"), mark="failed")
    if len(strips) > 1:
        yield _index(strips, marks, shown)
        points = strips[0].outcome.job.options.points  # the same for all
        yield markup.section("All strips together", count_tables(counts, points),
                             figures(figures_of(whole["quality"])), flag_table(counts))  # fmt: skip
    for strip in strips:
        report = _read_report(strip.report) if strip.number in shown else None  # one at a time: there may be thousands
        if report is not None:
            body = draw_strip(strip.outcome.job.path, strip.cloud, report)
            notes = [f"{FIGURES[key][0]}: {words}" for key, words in marks[strip.number].items()]
            unusual = markup.bullets([f"differs from the other strips: {note}" for note in notes], "warning")
            name = strip.outcome.job.path.name if len(strips) > 1 else "Strip"  # the page has its name then
            heading = markup.section(name, unusual, body, mark=f"strip-{strip.number}")
            yield heading.replace("<section ", '<section class="strip" ', 1)
    yield _provenance(result, command)


def _navigate(shown: Sequence[_Strip]) -> str:
    parts = [("strips", "All strips"), *((f"strip-{one.number}", one.outcome.job.path.name) for one in shown)]
    links = "".join(f'<a href="#{mark}">{markup.text(name)}</a>' for mark, name in [*parts, ("run", "Run")])
    return f'<nav aria-label="parts of the page">{links}</nav>'


def _summary(result: BatchResult, counts: dict[str, Any]) -> str:
    passed = sum(counts["passed_through"].values())
    states = [outcome.status for outcome in result.outcomes]
    cards = [
        ("strips written", f"{len(states) - result.failed} of {len(states)}"),
        ("with warnings", f"{sum(bool(outcome.report.warnings) for outcome in result.outcomes)}"),
        ("points in", f"{counts['points_in']:,}"),
        ("waveforms", f"{counts['waveforms']:,}"),
        ("echoes", f"{counts['echoes']:,}"),
        ("added echoes", f"{counts['added_echoes']:,}"),
        ("passed through", f"{passed:,}"),
        ("points out", f"{counts['points_out']:,}"),
    ]
    left = sum(counts["left_out"].values())
    cards[-1:-1] = [("left out", f"{left:,}")] if left else []
    body = "".join(f'<div class="card"><b>{markup.text(value)}</b>{markup.text(name)}</div>' for name, value in cards)
    lines = [f"{states.count('skipped')} of the strips were up to date (--resume)."] if "skipped" in states else []
    if "incomplete" in states:
        lines.append(f"{states.count('incomplete')} of the strips are incomplete: packets are missing.")
    if advice := result.advice:
        lines.append(advice)
    return markup.section("Summary", f'<div class="cards">{body}</div>', *map(markup.paragraph, lines))


def _index(strips: Sequence[_Strip], marks: Sequence[dict[str, str]], shown: set[int]) -> str:
    head = ["strip", "status", "warnings", "points in", "waveforms", "echoes", "points out",
            *(one[0] for one in FIGURES.values())]  # fmt: skip
    rows = []
    for strip in strips:
        counts = strip.outcome.report.to_json()["counts"]
        numbers = [counts[name] for name in ("points_in", "waveforms", "echoes", "points_out")]
        name, place = markup.text(strip.outcome.job.path.name), strip.number
        link = f'<a href="#strip-{place}">{name}</a>' if place in shown else name
        rows.append([markup.Cell(link, strip.outcome.job.path.name), strip.outcome.status,
                     _warning_cell(strip.outcome.report.warnings),
                     *([None] * 4 if strip.outcome.status == "failed" else numbers),
                     *(_figure_cell(strip, key, marks[place]) for key in FIGURES)])  # fmt: skip
    notes = [
        f"{sum(map(bool, marks))} of {len(strips)} strips differ in a figure from the others of their sensor: these "
        "are marked with \u25b2. It is a reason to look at the strip, not a fault."
        if len(strips) >= FEWEST
        else f"Strips are compared with each other if there are at least {FEWEST} of one sensor."
    ]
    if len(shown) < sum(strip.has_report for strip in strips):
        notes.append(
            "Names with a link have a part below, strips with warnings first. For another strip: `wavebatch run STRIP "
            "-o DIR --resume --html PAGE.html` with the same options."
        )
    index = markup.table(head, rows, sortable=True, tall=True)
    return markup.section("Strips", *map(markup.paragraph, notes), markup.FILTER, index, mark="strips")


def _warning_cell(warnings: Sequence[StripWarning]) -> markup.Cell:
    """The codes of the warnings, and below them what they say."""
    if not warnings:
        return markup.Cell("", 0)
    codes = markup.text(", ".join(dict.fromkeys(one.code for one in warnings)))
    says = markup.bullets(one.text for one in warnings)
    return markup.Cell(f'<details><summary class="mark">{codes}</summary>{says}</details>', len(warnings))


def _figure_cell(strip: _Strip, key: str, marks: dict[str, str]) -> markup.Cell:
    value = strip.figures.get(key, float("nan"))
    words = markup.number(value, FIGURES[key][1])
    if key in marks:
        words = f'<span class="mark" title="{markup.text(marks[key])}">\u25b2 {words}</span>'
    return markup.Cell(words, float(value) if value == value else "")


def _provenance(result: BatchResult, command: str) -> str:
    timing = result.to_json()["timing"]
    rows = {"wavebatch": __version__, "elapsed": f"{timing['elapsed_seconds']:.1f} s"}
    if timing["waveforms_per_processor_second"]:
        rows["waveforms per second of a processor"] = f"{timing['waveforms_per_processor_second']:,}"
    return markup.section("Run", markup.facts(rows), markup.code(command) if command else "", mark="run")
