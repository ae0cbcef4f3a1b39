"""`wavebatch info` shows what a strip holds, `wavebatch check` what is wrong with strips and chain files.

Only prints; the facts come from `wavebatch.surveying.inspect_strip`.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import count, print_json, print_result, printable
from wavebatch.cli.options import common_options, strip_argument, strip_options
from wavebatch.files.inputs import find_files
from wavebatch.surveying.inspect_strip import check_file, describe_strip

EXIT_PROBLEMS = 1
"""`check` found problems."""


@click.command()
@strip_argument
@strip_options
@click.option("-v", "--verbose", is_flag=True,
              help="Also survey the strip: its pulse, and the known sensor that it looks like.")
@common_options("json")
def info(strip: Path, direction: str, headerless: bool, verbose: bool, as_json: bool, debug: bool) -> None:
    """Show points, wave packets, descriptors and sample values of a strip.

    Reads all points and a few thousand waveforms.

    Exit code: 0 done, 1 the strip cannot be read, 2 wrong usage.
    """
    facts = describe_strip(strip, direction=direction, headerless=headerless)
    if verbose and facts["packets"]["count"] and not facts["problems"]:
        facts["pulse"] = _describe_pulse(strip, direction, headerless)
    print_result(as_json, facts, _list_lines(facts))


def _describe_pulse(path: Path, direction: str, headerless: bool) -> dict[str, Any]:
    """The pulse of a strip by its survey, and the known sensor that it looks like."""
    from wavebatch.core.units import FWHM_PER_SIGMA
    from wavebatch.surveying.systems.known_systems import find_likeness
    from wavebatch.tools.api.strip import open_strip, survey

    with open_strip(path, direction=direction, headerless=headerless) as strip:
        found = survey(strip)
    like = find_likeness(found.system, found.figures["spacing_ns"])
    return {
        "full_width_ns": FWHM_PER_SIGMA * found.system.sigma_ref,
        "noise_dn": found.system.noise_std,
        "sensor": like and like.known.sensor,
        "difference": like and like.difference,
        "sentence": like.describe() if like else "this strip's pulse looks like that of no known sensor",
    }


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="STRIP_OR_CHAIN...")
@strip_options
@click.option("--strict", is_flag=True, help="Count notes as problems.")
@common_options("json")
def check(
    files: tuple[Path, ...], direction: str, headerless: bool, strict: bool, as_json: bool, debug: bool
) -> None:
    """Check strips and chain files (.toml); print one line per problem, with its place and what to do.

    STRIP is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line. Notes are oddities that
    wavebatch can read.

    Exit code: 0 no problems, 1 problems found, 2 wrong usage.
    """
    clean, results = True, []
    for path in find_files(map(str, files)):
        found = check_file(path, direction=direction, headerless=headerless)
        clean &= found.is_clean and not (strict and found.notes)
        results.append(found.to_json())
        if as_json:
            continue
        for line in found.problems:
            click.echo(printable(f"{found.file}: {line}"))
        for line in found.notes:
            click.echo(printable(f"{found.file}: note: {line}"))
        if found.is_clean:
            click.echo(printable(f"{found.file}: ok ({found.summary})"))
    if as_json:
        print_json(results)
    sys.exit(0 if clean else EXIT_PROBLEMS)


def _list_lines(facts: dict[str, Any]) -> list[str]:
    packets, samples, vectors = facts["packets"], facts["samples"], facts["vectors"]
    kind = "LAZ" if facts["compressed"] else "LAS"
    share = facts["share_with_waveform"]
    ratio = vectors["length_over_half_c"]
    lines = [
        f"file           {facts['file']} ({facts['bytes']} bytes)",
        f"format         {kind} {facts['las_version']}, point format {facts['point_format']}",
        f"CRS            {_shorten(facts['crs'] or 'none')}",
        f"points         {facts['points']}",
        f"with waveform  {facts['points_with_waveform']}" + ("" if share is None else f" ({share:.1%})"),
        f"without        {facts['points_without_waveform']}, broken {facts['points_broken']}",
        f"packets        {packets['count']} in {packets['file'] or 'no file'} ({packets['bytes']} bytes)",
    ]
    for one in packets["descriptors"]:
        samples_text = f"{one['samples']} samples of {one['bits']} bits, {one['spacing_ns']:g} ns apart"
        lines.append(f"descriptor {one['index']:<3} {samples_text}; {count(one['points'], 'point')}")
    if packets["descriptors_unused"]:
        lines.append(f"descriptors    {packets['descriptors_unused']} more, which no point uses")
    if samples["waveforms_read"]:
        lengths = ", ".join(map(str, samples["lengths"][:8])) + (" ..." if len(samples["lengths"]) > 8 else "")
        read, limited = (count(samples[name], "waveform") for name in ("waveforms_read", "waveforms_at_limit"))
        values = f"{samples['least']} to {samples['largest']}"
        lines.append(f"samples        {values} in {read} of {lengths} samples; {limited} at the limit")
        if samples["waveforms_with_gaps"]:
            gaps = count(samples["waveforms_with_gaps"], "waveform")
            lines.append(f"gaps           {gaps} with fill between recordings, which is no sample")
    lines.append(f"vectors        {vectors['direction']} the sensor: {vectors['evidence']}")
    if ratio is not None:
        lines.append(f"vector length  {ratio:.4f} of c/2" + (" (once divided)" if vectors["form"] == "range" else ""))
    if "pulse" in facts:
        pulse = facts["pulse"]
        width = f"{pulse['full_width_ns']:.3g} ns at half maximum, noise {pulse['noise_dn']:.3g} DN"
        lines.append(f"pulse          {width}; {pulse['sentence']}")
    if facts["extra_dimensions"]:
        lines.append(f"extra bytes    {', '.join(facts['extra_dimensions'])}")
    lines += [f"note           {line}" for line in facts["notes"]]
    lines += [f"warning        {line}" for line in facts["warnings"]]
    return lines + [f"problem        {line}" for line in facts["problems"]]


def _shorten(text: str, limit: int = 100) -> str:
    """The text on one line, cut if it is longer than the limit."""
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."
