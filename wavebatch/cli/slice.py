"""`wavebatch slice`: the straight surface lines in the scan lines of a strip."""

from __future__ import annotations

import re
from itertools import takewhile
from pathlib import Path

import click

from wavebatch.cli.messages import debug_option, print_json, report_errors, talk
from wavebatch.cli.options import direction_option, json_option, overwrite_option, quiet_option
from wavebatch.core.errors import InputError
from wavebatch.files.disk.publish import refuse_existing
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying import survey_blocks
from wavebatch.tools.slices import SegmentWriter, SliceOptions, cut_slice, draw_slice, find_segments, read_scan_lines

_SURVEYED = 2000


def _read_lines(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[int, int | None]:
    """`7` or `5:20` as the first line and the one behind the last."""
    if text is None:
        return 0, None
    found = re.fullmatch(r"(\d+)|(\d*):(\d*)", text)
    if not found or text == ":":
        raise click.BadParameter(f"{text!r} is neither a number nor FIRST:BEHIND")
    if found[1]:
        return int(found[1]), int(found[1]) + 1
    first, behind = int(found[2] or 0), int(found[3]) if found[3] else None
    if behind is not None and behind <= first:
        raise click.BadParameter(f"{text!r} holds no line; BEHIND is the line after the last one")
    return first, behind


@click.command(name="slice")
@click.argument("strip", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The segments: .csv or .geojson.")
@click.option("--lines", callback=_read_lines, help="Scan lines: one number, or FIRST:BEHIND.  [default: all]")
@click.option(
    "--geometry",
    type=click.Choice(["plane", "time"]),
    default="plane",
    show_default=True,
    help="A vertical plane, or rows of pulses with columns of time, in which flat surfaces bend.",
)
@click.option("--std", default=2.0, show_default=True, help="Look at samples above this many std of the slice.")
@click.option("--sigma", type=float, help="Standard deviation of the pulse [ns].  [default: the strip's survey]")
@click.option("--shortest", default=20.0, show_default=True, help="Least length of a segment [pixels: samples].")
@click.option("--most", default=20, show_default=True, help="Segments per slice.")
@click.option("--png", type=click.Path(path_type=Path), help="Picture of the first slice of --lines.")
@direction_option
@overwrite_option
@json_option("Print the counts as JSON on stdout.")
@quiet_option
@debug_option
@report_errors()
def slice_(strip: Path, output: Path | None, lines: tuple[int, int | None], png: Path | None, **options) -> None:
    """Find the straight surface lines in the space-time slices of STRIP.

    A slice is a scan line - found from the rays, which turn, jump back or pause between lines - with its waveforms side
    by side. Segments come with their ends in space, length, slope and residual. Exit code: 0, 1 where the strip cannot
    be read or the output cannot be written, 2 wrong usage.
    """
    if output is None and png is None:
        raise click.UsageError("give -o for the segments, --png for a picture, or both")
    if png and not options["overwrite"]:
        refuse_existing(png)
    with StripReader(strip, direction=options["direction"]) as reader:
        scan = reader.scan()
        sigma = options["sigma"]
        if sigma is None:
            sigma = survey_blocks(reader.sample_blocks(scan, _SURVEYED), learn=False).system.sigma_ref
        settings = SliceOptions(options["geometry"], options["std"], sigma, options["shortest"], options["most"])
        counts = _find(reader, scan, settings, output, lines, png, options["overwrite"])
    if not counts["lines"]:
        talk(f"{strip}: no scan line has a number that --lines asks for")
    if options["as_json"]:
        print_json(counts)
    if not options["quiet"]:
        talk(f"{strip}: {counts['segments']} segments in {counts['lines']} scan lines of {counts['pulses']} pulses")


def _find(reader: StripReader, scan, settings: SliceOptions, output, lines, png, overwrite: bool) -> dict:
    """Segments of the wanted lines into the output; their counts."""
    first, behind = lines
    counts = {"lines": 0, "pulses": 0, "segments": 0, "sigma": settings.sigma}
    crs = reader.facts.crs
    writer = SegmentWriter(output, crs=crs, overwrite=overwrite) if output else None
    try:
        for line in takewhile(lambda one: behind is None or one.number < behind, read_scan_lines(reader, scan)):
            if line.number < first:
                continue
            piece = cut_slice(line, settings)
            segments = find_segments(piece, settings)
            if png and not counts["lines"]:
                draw_slice(piece, segments, png, overwrite=overwrite)
            if writer:
                writer.write(segments)
            counts["lines"] += 1
            counts["pulses"] += len(line)
            counts["segments"] += len(segments)
        if png and not counts["lines"]:
            raise InputError(f"{png}: not drawn, because no scan line has a number that --lines asks for")
        if writer:
            writer.commit()
    finally:
        if writer:
            writer.__exit__()
    return counts
