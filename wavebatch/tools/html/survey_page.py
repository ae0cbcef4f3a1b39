"""The page of `wavebatch survey --html`: what the survey found, its decisions, and waveforms of the strips."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from wavebatch.surveying import Survey
from wavebatch.surveying.auto_chain import choose_chain
from wavebatch.tools.html import markup
from wavebatch.tools.html.page import write_page
from wavebatch.tools.html.strip_views import draw_waveforms
from wavebatch.tools.html.survey_part import draw_survey, list_decisions

MOST_DRAWN = 6
"""Strips of a flight whose waveforms are drawn."""


def write_survey_page(
    target: Path, survey: Survey, document: Mapping[str, Any], strips: Sequence[Path], **reading: Any
) -> None:
    """Write the page of a survey.

    document: as `survey --json` prints it. strips: those that were surveyed. reading: direction and headerless.
    """
    title = f"wavebatch survey: {strips[0].name if len(strips) == 1 else f'{len(strips)} strips'}"
    write_page(target, title, _parts(survey, document, strips, reading))


def _parts(
    survey: Survey, document: Mapping[str, Any], strips: Sequence[Path], reading: Mapping[str, Any]
) -> Iterator[str]:
    rows = {"points": f"{document['points']:,}", "packets": f"{document['packets']:,}"}
    if "direction" in document:
        rows["packet vectors"] = f"{document['direction']['sign']} the sensor: {document['direction']['evidence']}"
    like = document.get("looks_like")
    if like:
        rows["sensor"] = like["sentence"]
    doubts = markup.bullets([one["text"] for one in document["warnings"]], "warning")
    yield markup.section("Summary", doubts, markup.facts(rows))
    if "strips" in document:
        yield _list_strips(document)
    yield markup.section("Survey", draw_survey(survey), mark="survey")
    yield markup.section("Decisions", list_decisions(document["decisions"]), mark="decisions")
    chain = choose_chain(survey)
    for strip in strips[:MOST_DRAWN]:
        draw = partial(draw_waveforms, strip, chain, survey.system, chain.name, **reading)
        yield markup.section(strip.name, markup.or_reason(draw, "waveforms"))
    if len(strips) > MOST_DRAWN:
        yield markup.paragraph(f"Waveforms of the first {MOST_DRAWN} of {len(strips)} strips are drawn.", "soft")
    provenance = {"wavebatch": document["version"], **{f"strip {n + 1}": path for n, path in enumerate(strips)}}
    yield markup.section("Provenance", markup.facts(provenance), markup.section(
        "Chain that the strip needs", markup.code(document["chain"]), level=3))  # fmt: skip


def _list_strips(document: Mapping[str, Any]) -> str:
    rows = [[strip["strip"], "belongs to the others" if strip["fits"] else "does not belong to them",
             strip.get("reason") or ""] for strip in document["strips"]]  # fmt: skip
    failed = markup.bullets([f"{path}: cannot be surveyed" for path in document["failed"]], "warning")
    return markup.section("Strips", markup.table(["strip", "", "reason"], rows, sortable=True), failed)
