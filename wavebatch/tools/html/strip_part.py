"""One strip of a run, as sections of a page: counts, survey, decisions, histograms, waveforms, maps, provenance.

`run_page` calls it for each strip. Everything comes from the strip's report, its cloud and the strip itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from wavebatch.batch.counts import COUNTS, LEFT_OUT, list_sums
from wavebatch.core.echoes import FLAG_MEANINGS, EchoFlag
from wavebatch.core.no_data import REASONS, NoData
from wavebatch.stages.chain_file import parse_chain
from wavebatch.tools.html import markup
from wavebatch.tools.html.charts import figures, figures_of
from wavebatch.tools.html.cloud_pictures import picture_cloud
from wavebatch.tools.html.strip_views import draw_waveforms
from wavebatch.tools.html.survey_part import draw_survey, list_decisions, read_survey

PICTURED = ("amplitude", "echo_width", "range_err", "range", "reflectance", "cross_section", "incidence_angle")
"""Columns with a histogram and a map, where the cloud has them."""


def draw_strip(strip: Path, cloud: Path, report: Mapping[str, Any]) -> str:
    """The sections of a strip, from its report; pictures that cannot be made say why."""
    found, survey = report["strip"], report["strip"]["survey"]
    read = read_survey(found)
    warnings = markup.bullets([*(one["text"] for one in report["warnings"]), *report["remarks"]], "warning")
    choice = report["choice"]
    parts = [
        warnings,
        markup.section("Counts", count_tables(report["counts"], report["options"]["points"]), level=3),
        markup.section("Survey", markup.paragraph(_name_source(survey["from"])),
                       draw_survey(read), level=3),
        markup.section("Decisions", markup.paragraph(f"Chain: {choice['chain']}, chosen by: {choice['by']}."),
                       list_decisions(choice["decisions"]), level=3),
        markup.section("Echoes", figures(figures_of(report["quality"])), level=3),
        markup.or_reason(partial(_draw_waveforms, strip, report, read.system), "waveforms"),
        markup.or_reason(partial(_draw_cloud, cloud), "maps"),
        markup.section("Flags", flag_table(report["counts"]), level=3),
        markup.section("Columns and no-data", _list_columns(report), level=3),
        markup.section("Provenance", *_list_provenance(strip, report), level=3),
    ]  # fmt: skip
    return "\n".join(filter(None, parts))


def _name_source(source: str) -> str:
    return {"strip": "This strip was surveyed.", "flight": "All strips of the flight were surveyed together."}.get(
        source, "The survey comes from a file (--system)."
    )


def count_tables(counts: Mapping[str, Any], points: str) -> str:
    """Every count with its meaning, and the sums that must hold; points: what was written, as in `list_sums`."""
    rows = [[name, counts[name], meaning] for name, meaning in COUNTS.items()]
    rows += [[f"passed through: {name}", number, EchoFlag[name].meaning]
             for name, number in counts["passed_through"].items()]  # fmt: skip
    rows += [[f"left out: {name}", number, f"points that {LEFT_OUT[name]}"]
             for name, number in counts["left_out"].items() if number]  # fmt: skip
    return markup.table(["count", "number", "meaning"], rows) + draw_sums(counts, points)


def draw_sums(counts: Mapping[str, Any], points: str) -> str:
    """The sums that the counts must give, with their numbers; one that does not hold is marked."""
    rows = [(name, counts[name], _write_sum(parts), sum(parts.values()) == counts[name])
            for name, parts in list_sums(counts, points).items()]  # fmt: skip
    return markup.sums(rows, "Sums that are checked")


def _write_sum(parts: Mapping[str, int]) -> str:
    """`2 echoes + 1 passed through: NO_ECHO - 1 left out: where`; parts of 0 are named only where there is no other."""
    shown = {name: number for name, number in parts.items() if number} or parts
    words = "".join(f" {'-' if number < 0 else '+'} {abs(number):,} {name}" for name, number in shown.items())
    return words.removeprefix(" + ").strip()


def flag_table(counts: Mapping[str, Any]) -> str:
    """Points per flag."""
    points = counts["points_out"]
    rows = [[flag.name, counts["flags"][flag.name],
             markup.Cell(markup.share(counts["flags"][flag.name], points), counts["flags"][flag.name]), meaning]
            for flag, meaning in FLAG_MEANINGS.items()]  # fmt: skip
    return markup.table(["flag", "points", "share", "meaning"], rows, sortable=True)


def _draw_waveforms(strip: Path, report: Mapping[str, Any], system: Any) -> str:
    options, name = report["options"], report["choice"]["chain"]
    reading = {"direction": options["direction"], "headerless": options["headerless"]}
    return draw_waveforms(strip, parse_chain(report["chain"], name), system, name, **reading)


def _draw_cloud(cloud: Path) -> str:
    histograms, maps = picture_cloud(cloud, PICTURED)
    parts = (("Columns of the cloud", histograms), ("Maps", maps))
    return "\n".join(markup.section(name, figures(drawn), level=3) for name, drawn in parts if drawn)


def _list_columns(report: Mapping[str, Any]) -> str:
    written, absent = report["output"]["columns"], report["output"]["not_computed"]
    names = markup.table(["column", "name in the cloud"], [[name, stored] for name, stored in written.items()])
    missing = markup.table(["missing column", "reason"], [[name, why] for name, why in absent.items()])
    rows = [[column, number, REASONS[NoData[reason]][0] if NoData[reason] in REASONS else reason]
            for column, reasons in sorted(report["counts"]["no_data"].items())
            for reason, number in reasons.items()]  # fmt: skip
    no_data = markup.table(["column", "echoes", "value"], rows, caption="Echoes without a value, by reason")
    return "\n".join([names, missing if absent else "", no_data if rows else ""])


def _list_provenance(strip: Path, report: Mapping[str, Any]) -> list[str]:
    found, given = report["strip"], report["input"]
    rows = {
        "strip": strip,
        "input sha256 (sampled)": given.get("sha256_sampled", ""),
        "input bytes": f"{given.get('size', 0):,}",
        "LAS": f"{found['las_version']}, point format {found['point_format']} -> {report['output']['point_format']}",
        "packet vectors": f"{found['direction']['sign']} the sensor: {found['direction']['evidence']}",
        "sensor position from": found["sensor"]["source"],
        "cloud": f"{report['output']['file']}, {report['output']['size']:,} bytes",
        "wavebatch": report["version"],
    }
    options = json.dumps({**report["options"], **report["request"]}, indent=2, sort_keys=True, ensure_ascii=False)
    timing = report["timing"]
    busy, wall = timing["processor_seconds"], timing["wall_seconds"]
    seconds = [[name, busy[name], wall[name]] for name in sorted(busy)]
    return [
        markup.facts(rows),
        markup.section("Chain as it was used", markup.code(report["chain"]), level=4),
        markup.section("Options and request", markup.code(options), level=4),
        markup.section("Time", markup.table(["task", "processor [s]", "wall [s]"], seconds), level=4),
    ]
