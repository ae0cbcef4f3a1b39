"""`wavebatch survey`: noise, pulse and scene of a strip or of a flight, and the chain that they need.

Calls the survey and prints its sheet; the measurements are in `wavebatch.surveying`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, one_line, talk, tell
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import count
from wavebatch.files.text_file import write_text
from wavebatch.tools.sheets.sheet import Sheet

if TYPE_CHECKING:
    from wavebatch.surveying.systems.survey_result import SavedSurvey

EXIT_PROBLEMS = 1
"""A strip cannot be surveyed, or does not belong to the others."""


@click.command()
@shared.strips_argument
@shared.output_option("Write the survey, for --system of other commands.", "SYSTEM.toml", required=False)
@shared.output_option("Write the cheapest chain that suits the strip, with a reason for each part; for `run --chain`.",
                      "CHAIN.toml", "--chain", "chain_file", required=False)
@click.option("--waveforms", type=click.IntRange(1), metavar="N",
              help="Waveforms to look at, spread over all strips.  [default: 8192, fewer if they are long]")
@click.option("--divergence", type=click.FloatRange(0.001, 100.0), metavar="MRAD",
              help="Full angle of the beam between the 1/e^2 points [mrad]: adds whether echo widths can give "
              "incidence angles; saved in SYSTEM.toml.")
@shared.output_option("Write which echo width means which incidence angle on this strip: .csv, or a picture.", "FILE",
                      "--angles", required=False)
@shared.html_option
@shared.strip_options
@shared.common_options("overwrite", "json")
def survey(strips: tuple[str, ...], output: Path | None, chain_file: Path | None, **options: Any) -> None:
    """Measure noise, pulse and scene of strips, and choose the chain that they need.

    STRIP is a LAS or LAZ file with waveforms, a glob, a folder, or @list.txt with one of these per line. Several strips
    are surveyed together, as the strips of one flight: the result does not depend on their order. Strips whose samples,
    level, noise or pulse differ from the others are named with the reason and left out.

    Prints noise, baseline, system pulse, ringing and saturation, the shares of empty, single and overlapped waveforms,
    and for each optional part of a chain whether the strip needs it and why.

    Exit code: 0 done, 1 a strip cannot be surveyed or does not belong to the others, or a file cannot be written, 2
    wrong usage.

    Examples:
      # noise, pulse and scene, and which chain the strip needs
      wavebatch survey strip.las
      # save both for `run --system` and `--chain`
      wavebatch survey strip.las -o system.toml --chain chain.toml
    """  # fmt: skip
    from wavebatch.files.figure_file import check_picture
    from wavebatch.surveying.choose_chain import chain_text
    from wavebatch.surveying.systems.figures import describe_figures, describe_system
    from wavebatch.surveying.systems.known_systems import doubt_survey, find_likeness, find_source
    from wavebatch.surveying.systems.survey_result import SYSTEM_SCHEMA, format_survey
    from wavebatch.tools.sheets.survey import list_doubts, survey_page, survey_sheet

    angles, html_file, overwrite = options["angles"], options["html_file"], options["overwrite"]
    paths = shared.find_inputs(strips, options)
    shared.check_html(html_file)
    if angles is not None:
        if len(paths) > 1:
            words = "is for one strip, because widths depend on the distance of the ground"
            raise ConfigError(f"--angles {angles}: {words}")
        if angles.suffix.lower() != ".csv":
            check_picture(angles, overwrite=overwrite)
    keeps = bool(output or html_file or options["as_json"])
    saved, facts = _survey(paths[0], options, keeps=keeps) if len(paths) == 1 else _survey_together(paths, options)
    survey = saved.survey
    if output is not None:
        write_text(output, format_survey(saved), overwrite=overwrite)
    if chain_file is not None:
        write_text(chain_file, chain_text(survey), overwrite=overwrite)
    doubts = doubt_survey(survey.system, survey.figures, survey.waveforms)
    like = find_likeness(survey.system, survey.figures.spacing_ns or 0.0)
    document = {
        "schema": SYSTEM_SCHEMA,
        "version": saved.version,
        **facts,
        "warnings": [*facts.get("warnings", ()), *map(asdict, doubts)],
        "fingerprint": dict(saved.fingerprint),
        "waveforms": survey.waveforms,
        "system": describe_system(survey.system),
        "figures": describe_figures(survey.figures),
        "decisions": [{"part": one.part, "needed": bool(one.needed), "reason": one.reason} for one in survey.decisions],
        "candidates": [one._asdict() for one in survey.candidates],
        "chain": chain_text(survey),
        "looks_like": like and {
            "sensor": like.known.sensor, "name": like.known.name, "difference": like.difference,
            "taken": find_source(survey.system) is not None, "sentence": like.describe(),
        },
    }  # fmt: skip
    sheet = survey_sheet(survey, document)
    answer(document, Sheet("survey", [*sheet.parts, *list_doubts(document)]))
    for target in filter(None, (output, chain_file, angles)):
        tell(f"{target}: written")
    reading = {name: options[name] for name in ("direction", "headerless")}
    failed = {*facts.get("failed", ()), *facts.get("misfits", ())}
    used = [path for path in paths if str(path) not in failed]
    of = used[0].name if len(used) == 1 else f"{len(used)} strips"
    shared.write_html(html_file, of, survey_page(survey, document, used, **reading))
    if facts.get("misfits") or facts.get("failed"):
        sys.exit(EXIT_PROBLEMS)


def _survey(strip: Path, options: dict[str, Any], *, keeps: bool) -> tuple[SavedSurvey, dict[str, Any]]:
    """The survey, and what else is shown of the strip; keeps: all of its figures are, not only printed ones."""
    from wavebatch.files.disk.raw_bytes import take_fingerprint
    from wavebatch.surveying import inspect_strip
    from wavebatch.surveying.systems.survey_result import SavedSurvey

    with inspect_strip.open_strip(strip, direction=options["direction"], headerless=options["headerless"]) as opened:
        found = inspect_strip.survey(
            opened, waveforms=options["waveforms"], divergence=options["divergence"], find_divergence=True,
            for_checks=keeps,
        )  # fmt: skip
        scan = opened.scan
        facts = {
            "strip": str(opened.facts.path),
            "points": scan.points,
            "packets": scan.packets,
            "direction": {"sign": scan.vectors.direction, "evidence": scan.vectors.evidence},
            "warnings": [asdict(one) for one in inspect_strip.doubt_files(opened.facts, scan)],
        }
        packet_file = opened.facts.packets.file
        if options["angles"] is not None:
            from wavebatch.surveying.sensor import SensorRequest, find_sensor
            from wavebatch.tools.sheets.survey import write_angles

            distance = find_sensor(opened.reader, opened.scan, SensorRequest()).distance
            name, overwrite = opened.facts.path.name, options["overwrite"]
            write_angles(options["angles"], found, distance, strip=name, overwrite=overwrite)
    return SavedSurvey(found, strip.name, take_fingerprint(strip, packet_file)), facts


def _survey_together(paths: Sequence[Path], options: dict[str, Any]) -> tuple[SavedSurvey, dict[str, Any]]:
    """The survey of a flight, and what else is shown of its strips."""
    from wavebatch.surveying.flight import read_samples, survey_flight

    failed: list[Path] = []

    def report(path: Path, error: InputError) -> None:
        failed.append(path)
        talk(f"error: {one_line(error)}")

    reading = {name: options[name] for name in ("waveforms", "direction", "headerless")}
    samples = read_samples(paths, **reading, on_error=report)
    if not samples:
        raise InputError(f"none of {count(len(paths), 'strip')} can be surveyed")
    flight = survey_flight(samples)
    saved = flight.saved
    if options["divergence"] is not None:
        system = saved.survey.system.with_radiometry(divergence=options["divergence"])
        saved = replace(saved, survey=replace(saved.survey, system=system))
    strips = sorted(flight.strips, key=lambda strip: paths.index(strip.path))
    return saved, {
        "strips": [strip.to_json() for strip in strips],
        "points": sum(strip.facts["points"] for strip in strips if strip.fits),
        "packets": sum(strip.facts["packets"] for strip in strips if strip.fits),
        "misfits": [str(strip.path) for strip in strips if not strip.fits],
        "failed": list(map(str, failed)),
    }
