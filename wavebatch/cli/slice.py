"""`wavebatch slice`: the straight surface lines in the scan lines of a strip.

Reads options and loops over the scan lines; cutting and searching them is in `wavebatch.tools.slices`.
"""

from __future__ import annotations

from contextlib import ExitStack
from itertools import takewhile
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import count, print_summary, talk
from wavebatch.core.errors import InputError
from wavebatch.files.disk.publish import refuse_existing
from wavebatch.files.geojson_crs import GEOJSON_CRS, GeoJsonCrs, find_crs, plan_crs
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.surveying import survey_blocks
from wavebatch.tools.slices.lines import read_scan_lines
from wavebatch.tools.slices.output import SegmentWriter, draw_slice
from wavebatch.tools.slices.segments import SliceOptions, cut_slice, find_segments

_SURVEYED = 2000
"""Waveforms from which the width of the pulse is measured: enough for 1 % of it."""


@click.command(name="slice")
@shared.strip_argument
@shared.output_option("Write the segments: .csv or .geojson.", required=False)
@shared.output_option("Draw the first slice of --lines.", "FILE", "--png", required=False)
@shared.output_option("Draw all segments of --lines in plan and in 3D.", "FILE", "--overview", required=False)
@shared.output_option("Write the samples of --lines as a cube of line, pulse and time, for `wavebatch plot cube`.",
                      "FILE.npz", "--cube", required=False)
@click.option("--lines", callback=lambda context, parameter, text: shared.parse_span(text) if text else (0, None),
              metavar="N|FIRST:END", help="Scan lines, counted from 0; END is not included.  [default: all]")
@click.option("--geometry", type=click.Choice(["plane", "time"]), default="plane", show_default=True,
              help="plane: slices are vertical planes; time: rows are pulses, columns times; flat surfaces bend.")
@click.option("--std", default=2.0, show_default=True, metavar="STD",
              help="Search samples above this many standard deviations of the slice.")
@click.option("--sigma", type=float, metavar="NS",
              help="Standard deviation of the pulse [ns].  [default: surveyed from the strip]")
@click.option("--shortest", default=20.0, show_default=True, metavar="PIXELS",
              help="Least length of a segment [pixels of one sample].")
@click.option("--geojson-crs", type=click.Choice(GEOJSON_CRS), default="wgs84", show_default=True,
              help="Coordinates of a .geojson: longitude and latitude (needs pyproj), or those of the strip with its "
              "CRS, which GDAL and QGIS read.")
@click.option("--most", default=20, show_default=True, metavar="N", help="Most segments per slice.")
@shared.direction_option
@shared.common_options("overwrite", "json", "quiet")
def slice_(strip: Path, output: Path | None, lines: tuple[int, int | None], png: Path | None, **options: Any) -> None:
    """Find the straight surface lines in the scan lines of STRIP.

    A slice shows the waveforms of one scan line side by side. A new line starts where the scan angle turns or jumps
    back, or after a pause. Each segment has its end points in space, length, slope and residual.

    Exit code: 0 done, 1 the strip cannot be read or the output cannot be written, 2 wrong usage.
    """  # fmt: skip
    if output is None and png is None:
        raise click.UsageError("give -o for the segments, --png for a picture, or both")
    if png:
        refuse_existing(png, options["overwrite"])
    with StripReader(strip, direction=options["direction"]) as reader:
        crs = None
        if output is not None and output.suffix.lower() == ".geojson":
            known = find_crs(reader.facts.crs, reader.facts.header.vlrs)
            crs = plan_crs(strip, known, options["geojson_crs"])
        scan = reader.scan()
        sigma = options["sigma"]
        if sigma is None:
            sigma = survey_blocks(reader.sample_blocks(scan, _SURVEYED), learn=False).system.sigma_ref
        settings = shared.from_options(SliceOptions, options, sigma=sigma)
        counts = _find(reader, scan, settings, output, lines, png, crs, options["overwrite"])
    if not counts["lines"]:
        talk(f"{strip}: has no scan line with a number in --lines")
    found = f"{count(counts['segments'], 'segment')} in {count(counts['lines'], 'scan line')}"
    print_summary(options, counts, [f"{strip}: {found} of {count(counts['pulses'], 'pulse')}"])


def _find(
    reader: StripReader,
    scan: StripScan,
    settings: SliceOptions,
    output: Path | None,
    lines: tuple[int, int | None],
    png: Path | None,
    crs: GeoJsonCrs | None,
    overwrite: bool,
) -> dict[str, Any]:
    """Writes the segments of the wanted lines; returns their counts."""
    first, end = lines
    counts = {"lines": 0, "pulses": 0, "segments": 0, "sigma": settings.sigma}
    with ExitStack() as stack:
        writer = None
        if output:
            writer = stack.enter_context(SegmentWriter(output, crs=crs, overwrite=overwrite))
        for line in takewhile(lambda one: end is None or one.number < end, read_scan_lines(reader, scan)):
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
            raise InputError(f"{png}: not drawn, because no scan line has a number in --lines")
        if writer:
            writer.commit()
    return counts
