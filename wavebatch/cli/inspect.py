"""`wavebatch info` and `wavebatch check`: what a strip holds, and what is wrong with strips and chain files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import debug_option, print_json, report_errors
from wavebatch.cli.options import direction_option, headerless_option, json_option
from wavebatch.files.inputs import find_files
from wavebatch.surveying.inspect_strip import check_file, describe_strip

EXIT_PROBLEMS = 1
"""`check` found something."""


@click.command()
@click.argument("strip", type=click.Path(path_type=Path))
@direction_option
@headerless_option
@json_option()
@debug_option
@report_errors()
def info(strip: Path, direction: str, headerless: bool, as_json: bool, debug: bool) -> None:
    """What a strip holds: points, packets, descriptors, where the samples lie.

    Reads all points and a few thousand waveforms. Exit code: 0, or 1 where the strip cannot be read.
    """
    facts = describe_strip(strip, direction=direction, headerless=headerless)
    if as_json:
        print_json(facts)
    else:
        click.echo("\n".join(_list_lines(facts)))


@click.command()
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="STRIP_OR_CHAIN...")
@direction_option
@headerless_option
@click.option("--strict", is_flag=True, help="Let notes count as problems.")
@json_option()
@debug_option
@report_errors()
def check(
    files: tuple[Path, ...], direction: str, headerless: bool, strict: bool, as_json: bool, debug: bool
) -> None:
    """Problems of strips and of chain files (.toml): one line each, with where and what to do.

    STRIP is a LAS or LAZ file, a glob, a folder, or @list.txt. Notes are oddities that do no harm here. Exit code: 0
    clean, 1 problems found.
    """
    clean, results = True, []
    for path in find_files(map(str, files)):
        found = check_file(path, direction=direction, headerless=headerless)
        clean &= found.is_clean and not (strict and found.notes)
        results.append(found.to_json())
        if as_json:
            continue
        for line in found.problems:
            click.echo(f"{found.file}: {line}")
        for line in found.notes:
            click.echo(f"{found.file}: note: {line}")
        if found.is_clean:
            click.echo(f"{found.file}: ok ({found.summary})")
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
        f"with waveform  {facts['points_with_waveform']}" + (f" ({share:.1%})" if share is not None else ""),
        f"without        {facts['points_without_waveform']}, broken {facts['points_broken']}",
        f"packets        {packets['count']} in {packets['file'] or 'no file'} ({packets['bytes']} bytes)",
    ]
    lines += [_describe_descriptor(descriptor) for descriptor in packets["descriptors"]]
    if packets["descriptors_unused"]:
        lines.append(f"descriptors    {packets['descriptors_unused']} more that no point refers to")
    if samples["waveforms_read"]:
        lengths = ", ".join(map(str, samples["lengths"][:8])) + (" ..." if len(samples["lengths"]) > 8 else "")
        lines.append(
            f"samples        {samples['least']} to {samples['largest']} in {samples['waveforms_read']} waveforms of "
            f"{lengths} samples; {samples['waveforms_at_limit']} waveforms at the limit"
        )
    lines.append(f"vectors        {vectors['direction']} the sensor: {vectors['evidence']}")
    if ratio is not None:
        lines.append(f"vector length  {ratio:.4f} of c/2" + (" (once divided)" if vectors["form"] == "range" else ""))
    if facts["extra_dimensions"]:
        lines.append(f"extra bytes    {', '.join(facts['extra_dimensions'])}")
    lines += [f"warning        {line}" for line in facts["warnings"]]
    return lines + [f"problem        {line}" for line in facts["problems"]]


def _describe_descriptor(descriptor: dict[str, Any]) -> str:
    return (
        f"descriptor {descriptor['index']:<3} {descriptor['samples']} samples of {descriptor['bits']} bits, "
        f"{descriptor['spacing_ns']:g} ns apart; {descriptor['points']} points"
    )


def _shorten(text: str, limit: int = 100) -> str:
    """The text on one line, cut where it is long."""
    text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."
