"""One strip of a run, as sections of a page: counts, survey, decisions, histograms, waveforms, maps, provenance.

`run_page` calls it for each strip. Everything comes from the strip's report, its cloud and the strip itself.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wavebatch.batch.counts import COUNTS
from wavebatch.core.echoes import FLAG_MEANINGS, EchoFlag
from wavebatch.core.errors import ConfigError, InputError, StageError
from wavebatch.core.no_data import REASONS, NoData
from wavebatch.stages.chain_file import parse_chain
from wavebatch.tools.html import markup
from wavebatch.tools.html.cloud_pictures import picture_cloud
from wavebatch.tools.html.drawing.charts import figures, figures_of
from wavebatch.tools.html.strip_views import draw_views, read_views
from wavebatch.tools.html.survey_part import draw_survey, list_decisions, read_system

PICTURED = ("amplitude", "echo_width", "range_err", "range", "reflectance", "cross_section", "incidence_angle")
"""Columns with a histogram and a map, where the cloud has them."""


def draw_strip(strip: Path, cloud: Path, report: Mapping[str, Any]) -> str:
    """The sections of a strip, from its report; pictures that cannot be made say why."""
    found, survey = report["strip"], report["strip"]["survey"]
    system = read_system(found["system"], survey["figures"])
    warnings = markup.bullets([*report["warnings"], *report["remarks"]], "warning")
    choice = report["choice"]
    parts = [
        warnings,
        markup.section("Counts", count_tables(report["counts"]), level=3),
        markup.section("Survey", markup.paragraph(f"The survey is from: {survey['from']}."),
                       draw_survey(system, survey["figures"], survey["waveforms"]), level=3),
        markup.section("Decisions", markup.paragraph(f"Chain: {choice['chain']}, chosen by: {choice['by']}."),
                       list_decisions(choice["decisions"]), level=3),
        markup.section("Echoes", figures(figures_of(report["quality"])), level=3),
        _draw_waveforms(strip, report, system),
        _draw_cloud(cloud),
        markup.section("Flags", flag_table(report["counts"]), level=3),
        markup.section("Columns and no-data", _list_columns(report), level=3),
        markup.section("Provenance", *_list_provenance(strip, report), level=3),
    ]  # fmt: skip
    return "\n".join(filter(None, parts))


def count_tables(counts: Mapping[str, Any]) -> str:
    """Every count with its meaning, and the sums that must hold."""
    rows = [[name, counts[name], meaning] for name, meaning in COUNTS.items()]
    rows += [[f"passed through: {name}", number, EchoFlag[name].meaning]
             for name, number in counts["passed_through"].items()]  # fmt: skip
    return markup.table(["count", "number", "meaning"], rows) + list_sums(counts)


def list_sums(counts: Mapping[str, Any]) -> str:
    """The sums that the counts must give, with their numbers; one that does not hold is marked."""
    get, passed = counts.__getitem__, sum(counts["passed_through"].values())
    written = get("points_out") - passed
    sums = [
        ("points of the strip", "points_in",
         ["points_with_waveform", "points_without_waveform", "points_broken"]),
        ("points with a waveform", "points_with_waveform", ["matched_returns", "unmatched_returns", "no_echo_returns"]),
        ("echoes", "echoes", ["matched_returns", "added_echoes"]),
    ]  # fmt: skip
    rows = []
    for title, whole, parts in sums:
        total = sum(map(get, parts))
        words = " + ".join(f"{get(part):,} {part}" for part in parts)
        rows.append([title, get(whole), words, _holds(total == get(whole))])
    kind = "echoes" if written == get("echoes") else "matched_returns"
    words = f"{get(kind):,} {kind} + {passed:,} passed through"
    rows.append(["points written", get("points_out"), words, _holds(get(kind) + passed == get("points_out"))])
    return markup.table(["sum", "number", "is", "check"], rows, caption="Sums that must hold")


def _holds(fine: bool) -> Any:
    return "adds up" if fine else markup.Cell('<span class="mark">does not add up</span>')


def flag_table(counts: Mapping[str, Any]) -> str:
    """Points per flag."""
    points = counts["points_out"]
    rows = [[flag.name, counts["flags"][flag.name],
             markup.Cell(markup.share(counts["flags"][flag.name], points), counts["flags"][flag.name]), meaning]
            for flag, meaning in FLAG_MEANINGS.items()]  # fmt: skip
    return markup.table(["flag", "points", "share", "meaning"], rows, sortable=True)


def _draw_waveforms(strip: Path, report: Mapping[str, Any], system: Any) -> str:
    options = report["options"]
    try:
        chain = parse_chain(report["chain"], report["choice"]["chain"])
        views = read_views(strip, chain, system, direction=options["direction"], headerless=options["headerless"])
    except (InputError, ConfigError, StageError, OSError) as error:
        return markup.section("Waveforms", markup.paragraph(f"cannot be drawn: {error}", "warning"), level=3)
    return draw_views(views, report["choice"]["chain"])


def _draw_cloud(cloud: Path) -> str:
    try:
        histograms, maps = picture_cloud(cloud, PICTURED)
    except (InputError, ConfigError, OSError) as error:
        return markup.section("Maps", markup.paragraph(f"cannot be drawn: {error}", "warning"), level=3)
    parts = [markup.section("Columns of the cloud", figures(histograms), level=3)] if histograms else []
    return "\n".join([*parts, markup.section("Maps", figures(maps), level=3) if maps else ""])


def _list_columns(report: Mapping[str, Any]) -> str:
    written, absent = report["output"]["columns"], report["output"]["not_computed"]
    names = markup.table(["column", "name in the cloud"], [[name, stored] for name, stored in written.items()])
    missing = markup.table(["column that is not there", "reason"], [[name, why] for name, why in absent.items()])
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
    seconds = [[name, value] for name, value in sorted(report["timing"]["seconds"].items())]
    return [
        markup.facts(rows),
        markup.section("Chain as it was used", markup.code(report["chain"]), level=4),
        markup.section("Options and request", markup.code(options), level=4),
        markup.section("Seconds of the processes", markup.table(["task", "s"], seconds), level=4),
    ]
