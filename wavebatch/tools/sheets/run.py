"""The page of `wavebatch run --html`: sums of the batch, a table of its strips, and a part per strip.

Everything comes from the reports of the strips and from their clouds: nothing is decomposed again. The parts are
written one after the other, so that memory does not grow with the batch. Strips that differ from the others are marked:
a mark is a hint to look at the strip, not a fault.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from wavebatch import __version__
from wavebatch.batch.counts import COUNTS, LEFT_OUT, list_sums
from wavebatch.batch.report_file import cloud_path, report_path
from wavebatch.batch.run import BatchResult, Outcome
from wavebatch.core.echoes import FLAG_MEANINGS, REASONS, EchoFlag, NoData
from wavebatch.core.frozen import frozen
from wavebatch.core.order import robust_std
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.files.toml_file import format_toml
from wavebatch.surveying.systems.survey_result import SYSTEM_SCHEMA, parse_survey
from wavebatch.tools.plots.charts import figures_of, picture_cloud
from wavebatch.tools.sheets.page import write_page
from wavebatch.tools.sheets.sheet import Cell, Code, Fact, Later, Note, Sheet, SheetPart, Table, sum_table
from wavebatch.tools.sheets.survey import survey_sheet

PICTURED = ("amplitude", "echo_width", "range_err", "range", "reflectance", "cross_section", "incidence_angle")
"""Columns with a histogram and a map, where the cloud has them."""

FEW_STRIPS = 4
"""So many strips all have a part."""

MOST_PARTS = 8
"""Strips with a part each: a part has about 200 kB, and a browser must still open the page."""

PART_WAVEFORMS = 200_000
"""Waveforms of a larger batch for each part but the first: the run of a tenth of these takes as long as a part."""

FIGURES: dict[str, tuple[str, str, float]] = {
    "echoes": ("echoes per waveform", ".3f", 0.02),
    "passed": ("passed through %", ".2f", 1.0),
    "added": ("added %", ".2f", 1.0),
    "weak": ("weak %", ".2f", 1.0),
    "amplitude": ("median amplitude DN", ".1f", 0.0),
    "width": ("median width ns", ".3f", 0.0),
    "pulse": ("pulse width ns", ".3f", 0.0),
    "noise": ("noise DN", ".3f", 0.0),
}
"""By key: head of the column, form of the number, and the smallest difference that counts."""

FEWEST_COMPARED = 5
"""Fewer strips than this have no usual value."""

USUAL_REACH = 3.5
"""Largest usual distance from the median in robust standard deviations (Iglewicz and Hoaglin 1993)."""

LEAST_SHARE = 0.05
"""Smallest difference that counts, as a share of the median: strips may agree so well that any is many deviations."""


@frozen
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
    """How it was recorded: only strips of one sensor have the same usual values."""
    mark: str
    """Target of links to the part of the strip."""


def write_run_page(target: Path, result: BatchResult, folder: Path, command: str = "") -> None:
    """Write the page of a finished batch; folder: of its outputs. Raises InputError if it cannot be written."""
    strips = []
    for number, outcome in enumerate(result.outcomes):
        place = report_path(outcome.job, folder)
        report = None if outcome.status == "failed" else _read_report(place)
        figures, sensor = {}, ""
        if report is not None:
            found, figures = report["strip"]["survey"]["figures"], measure_strip(report)
            sensor = f"{found.get('bits', 0):.0f} bits, {found.get('spacing_ns', 0):g} ns"
        cloud = cloud_path(outcome.job, folder)
        strips.append(_Strip(outcome, number, cloud, place, report is not None, figures, sensor, f"strip-{number}"))
    marks = find_outliers([strip.figures for strip in strips], [strip.sensor for strip in strips])
    # Strips to look at come first, in the table and where there are too many to show all.
    order = sorted(strips, key=lambda one: (not (one.outcome.error or one.outcome.report.warnings),
                                            not marks[one.number], one.number))  # fmt: skip
    allowed = min(MOST_PARTS, 1 + result.report.count("waveforms") // PART_WAVEFORMS)
    most = allowed if len(strips) > FEW_STRIPS else FEW_STRIPS
    shown = [one for one in order if one.has_report][:most]
    names = strips[0].outcome.job.path.name if len(strips) == 1 else f"{len(strips)} strips"
    links = [("strips", "All strips"), *((one.mark, one.outcome.job.path.name) for one in shown), ("run", "Run")]
    parts = _list_parts(result, order, marks, shown, command)
    write_page(target, f"wavebatch run: {names}", parts, links if len(strips) > 1 else ())


def _read_report(path: Path) -> dict[str, Any] | None:
    """A report; None where it was moved or changed after the run: the index then has the strip's counts only."""
    try:
        return json.loads(path.read_text("utf-8"))
    except (OSError, ValueError):
        return None


def measure_strip(report: Mapping[str, Any]) -> dict[str, float]:
    """The FIGURES of a strip's report; NaN where one is not known."""
    counts, system = report["counts"], report["strip"]["system"]
    amplitude, width = (report["quality"][name]["p50"] for name in ("amplitude_dn", "echo_width_ns"))
    passed = sum(counts["passed_through"].values())
    rows = counts["points_out"] + sum(counts["left_out"].values())
    parts = {
        "passed": (passed, rows),
        "added": (counts["added_echoes"], counts["echoes"]),
        "weak": (counts["flags"]["WEAK"], counts["points_out"]),
    }
    return {
        "echoes": counts["echoes"] / counts["waveforms"] if counts["waveforms"] else math.nan,
        **{name: 100 * number / whole if whole else math.nan for name, (number, whole) in parts.items()},
        "amplitude": math.nan if amplitude is None else amplitude,
        "width": math.nan if width is None else width,
        "pulse": FWHM_PER_SIGMA * system["sigma_ref_ns"],
        "noise": system["noise_std_dn"],
    }


def find_outliers(strips: Sequence[Mapping[str, float]], sensors: Sequence[str]) -> list[dict[str, str]]:
    """For each strip: the keys of the figures in which it differs from the others of its sensor, and how, in words."""
    found: list[dict[str, str]] = [{} for _ in strips]
    for sensor in dict.fromkeys(sensors):
        places = [place for place, one in enumerate(sensors) if one == sensor]
        for key, (_, form, least) in FIGURES.items():
            values = np.array([strips[place].get(key, math.nan) for place in places], np.float64)
            known = values[np.isfinite(values)]
            if len(known) < FEWEST_COMPARED:
                continue
            median = float(np.median(known))
            limit = max(USUAL_REACH * robust_std(known), LEAST_SHARE * abs(median), least)
            for place, value in zip(places, values, strict=True):
                if abs(value - median) > limit:
                    found[place][key] = f"{value:{form}}; usual is {median:{form}} \u00b1 {limit:{form}}"
    return found


def _list_parts(
    result: BatchResult, strips: Sequence[_Strip], marks: Sequence[dict[str, str]], shown: Sequence[_Strip],
    command: str,
) -> Iterator[SheetPart]:  # fmt: skip
    whole = result.report.to_json()
    counts = whole["counts"]
    states = [outcome.status for outcome in result.outcomes]
    summary: list[SheetPart] = [
        Fact("strips written", f"{len(states) - result.failed} of {len(states)}"),
        Fact("with warnings", sum(bool(outcome.report.warnings) for outcome in result.outcomes)),
        *(Fact(name.replace("_", " "), counts[name]) for name in ("points_in", "waveforms", "echoes", "added_echoes")),
        Fact("passed through", sum(counts["passed_through"].values())),
    ]
    if left := sum(counts["left_out"].values()):
        summary.append(Fact("left out", left))
    summary.append(Fact("points out", counts["points_out"]))
    if "skipped" in states:
        summary.append(Note(f"{states.count('skipped')} of the strips were up to date (--resume)."))
    if "incomplete" in states:
        summary.append(Note(f"{states.count('incomplete')} of the strips are incomplete: packets are missing."))
    if advice := result.advice:
        summary.append(Note(advice))
    yield Sheet("Summary", summary)
    failed = [Note(f"{one.outcome.job.path}: {' '.join(str(one.outcome.error).split())}", "warning") for one in strips
              if one.outcome.error is not None]  # fmt: skip
    if failed:
        yield Sheet("Failed strips", failed, "failed")
    if len(strips) > 1:
        yield Sheet("Strips", _list_index(strips, marks, {strip.number for strip in shown}), "strips")
        points = strips[0].outcome.job.options.points  # the same for all
        figures = Later(partial(figures_of, whole["quality"]))
        yield Sheet("All strips together", [*count_tables(counts, points), figures, flag_table(counts)])
    for strip in [one for one in strips if one in shown]:
        report = _read_report(strip.report)  # one at a time: there may be thousands
        if report is not None:
            notes = [f"{FIGURES[key][0]}: {words}" for key, words in marks[strip.number].items()]
            unusual = [Note(f"differs from the other strips: {note}", "warning") for note in notes]
            name = strip.outcome.job.path.name if len(strips) > 1 else "Strip"  # the page has its name then
            yield Sheet(name, [*unusual, *_list_strip(strip.outcome.job.path, strip.cloud, report)], strip.mark)
    timing = result.to_json()["timing"]
    facts = [Fact("wavebatch", __version__), Fact("elapsed", f"{timing['elapsed_seconds']:.1f} s")]
    if timing["waveforms_per_processor_second"]:
        facts.append(Fact("waveforms per second of a processor", timing["waveforms_per_processor_second"]))
    yield Sheet("Run", [*facts, *([Code(command)] if command else [])], "run")


def _list_index(strips: Sequence[_Strip], marks: Sequence[dict[str, str]], shown: set[int]) -> Iterator[SheetPart]:
    """A row per strip, with what is unusual of it."""
    few = len(strips) < FEWEST_COMPARED
    yield Note(
        f"Strips are compared with each other if there are at least {FEWEST_COMPARED} of one sensor." if few else
        f"{sum(map(bool, marks))} of {len(strips)} strips differ in a figure from the others of their sensor: these "
        "are marked with \u25b2. It is a reason to look at the strip, not a fault."
    )  # fmt: skip
    if len(shown) < sum(strip.has_report for strip in strips):
        yield Note(
            "Names with a link have a part below, strips with warnings first. For another strip: `wavebatch run STRIP "
            "-o DIR --resume --html PAGE.html` with the same options."
        )
    rows = []
    for strip in strips:
        name, counts = strip.outcome.job.path.name, strip.outcome.report.to_json()["counts"]
        numbers = [counts[one] for one in ("points_in", "waveforms", "echoes", "points_out")]
        figures = []
        for key, (_, form, _) in FIGURES.items():
            value = strip.figures.get(key, math.nan)
            words = marks[strip.number].get(key, "")
            figures.append(Cell(f"{value:{form}}", value, words) if words else value)
        warnings = strip.outcome.report.warnings
        codes = ", ".join(dict.fromkeys(one.code for one in warnings))
        rows.append([Cell(name, name, link=strip.mark if strip.number in shown else ""), strip.outcome.status,
                     Cell(codes, len(warnings), details=[one.text for one in warnings]),
                     *([None] * 4 if strip.outcome.status == "failed" else numbers), *figures])  # fmt: skip
    heads = ("strip", "status", "warnings", "points in", "waveforms", "echoes", "points out")
    names, figure_forms, _ = zip(*FIGURES.values(), strict=True)
    forms = (*[""] * len(heads), *figure_forms)
    yield Table((*heads, *names), rows, forms, sortable=True, filtered=True)


def _list_strip(strip: Path, cloud: Path, report: Mapping[str, Any]) -> Iterator[SheetPart]:
    """The parts of a strip; pictures that cannot be made say why."""
    found, choice = report["strip"], report["choice"]
    survey = {"waveforms": found["survey"]["waveforms"], "figures": found["survey"]["figures"]}
    read = parse_survey(format_toml({"schema": SYSTEM_SCHEMA, "system": found["system"], **survey}), "report").survey
    yield from (Note(words, "warning") for words in (*(one["text"] for one in report["warnings"]), *report["remarks"]))
    yield Sheet("Counts", count_tables(report["counts"], report["options"]["points"]))
    sources = {"strip": "This strip was surveyed.", "flight": "All strips of the flight were surveyed together."}
    source = sources.get(found["survey"]["from"], "The survey comes from a file (--system).")
    yield Note(f"{source} Chain: {choice['chain']}, chosen by: {choice['by']}.")
    sheet = survey_sheet(read, choice)
    yield Sheet(sheet.title, sheet.parts)
    yield Sheet("Echoes", [Later(partial(figures_of, report["quality"]))])
    yield Later(partial(picture_cloud, cloud, PICTURED), "maps")
    yield Sheet("Flags", [flag_table(report["counts"])])
    rows = [[column, number, REASONS[NoData[reason]][0] if NoData[reason] in REASONS else reason]
            for column, reasons in sorted(report["counts"]["no_data"].items())
            for reason, number in reasons.items()]  # fmt: skip
    yield Sheet("Columns and no-data", [
        Table(("column", "name in the cloud"), list(report["output"]["columns"].items())),
        Table(("missing column", "reason"), list(report["output"]["not_computed"].items())),
        Table(("column", "echoes", "value"), rows, title="Echoes without a value, by reason"),
    ])  # fmt: skip
    given, output, timing = report["input"], report["output"], report["timing"]
    options = json.dumps({**report["options"], **report["request"]}, indent=2, sort_keys=True, ensure_ascii=False)
    busy, wall = timing["processor_seconds"], timing["wall_seconds"]
    rows = [[name, busy[name], wall[name]] for name in sorted(busy)]
    yield Sheet("Provenance", [
        Fact("strip", str(strip)),
        Fact("input sha256 (sampled)", given.get("sha256_sampled", "")),
        Fact("input bytes", given.get("size", 0)),
        Fact("LAS", f"{found['las_version']}, point format {found['point_format']} -> {output['point_format']}"),
        Fact("packet vectors", f"{found['direction']['sign']} the sensor: {found['direction']['evidence']}"),
        Fact("sensor position from", found["sensor"]["source"]),
        Fact("cloud", f"{output['file']}, {output['size']:,} bytes"),
        Fact("wavebatch", report["version"]),
        Sheet("Chain as it was used", [Code(report["chain"])]),
        Sheet("Options and request", [Code(options)]),
        Sheet("Time", [Table(("task", "processor [s]", "wall [s]"), rows)]),
    ])  # fmt: skip


def count_tables(counts: Mapping[str, Any], points: str) -> list[Table]:
    """Every count with its meaning, and the sums that must hold; points: what was written, as in `list_sums`."""
    rows = [[name, counts[name], meaning] for name, meaning in COUNTS.items()]
    rows += [[f"passed through: {name}", number, EchoFlag[name].meaning]
             for name, number in counts["passed_through"].items()]  # fmt: skip
    rows += [[f"left out: {name}", number, f"points that {LEFT_OUT[name]}"]
             for name, number in counts["left_out"].items() if number]  # fmt: skip
    sums = []
    for name, parts in list_sums(counts, points).items():
        shown = {part: number for part, number in parts.items() if number} or parts
        words = "".join(f" {'-' if number < 0 else '+'} {abs(number):,} {part}" for part, number in shown.items())
        sums.append((name, counts[name], words.removeprefix(" + ").strip(), sum(parts.values()) == counts[name]))
    return [Table(("count", "number", "meaning"), rows), sum_table(sums)]


def flag_table(counts: Mapping[str, Any]) -> Table:
    """Points per flag."""
    points = counts["points_out"]
    rows = [(flag.name, number, number / points if points else None, meaning)
            for flag, meaning in FLAG_MEANINGS.items() for number in [counts["flags"][flag.name]]]  # fmt: skip
    return Table(("flag", "points", "share", "meaning"), rows, ".2%", sortable=True)
