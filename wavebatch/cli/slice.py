"""`wavebatch slice`: the straight surface lines in the scan lines of a strip.

Reads options and loops over the scan lines; cutting and searching them is in `wavebatch.tools.scan_slices`.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from itertools import takewhile
from pathlib import Path
from typing import Any

import click

from wavebatch import __version__
from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, talk, tell
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import count
from wavebatch.files.disk.publish import refuse_existing
from wavebatch.files.figure_file import check_picture
from wavebatch.files.geojson import GEOJSON_CRS, plan_crs
from wavebatch.files.las.crs import describe_crs, read_crs_definition
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying import survey_blocks
from wavebatch.tools.scan_slices import SliceOptions, cut_slice, find_segments, read_scan_lines
from wavebatch.tools.slice_output import SEGMENT_SUFFIXES, CubeBuilder, SegmentWriter, draw_segments, draw_slice

EXIT_SOME_FAILED = 1
"""Some strips failed."""

_NOISE_FLOOR = 5.0
"""Standard deviations of the noise above the lower quartile of a waveform, which lies 0.7 of them below its mean: one
sample of noise in 100,000 is higher."""

_ALL = (0, None)
"""Span of all scan lines."""

_SURVEYED = 2000
"""Waveforms from which the width of the pulse is measured: enough for 1 % of it."""


@click.command(name="slice")
@shared.strips_argument
@shared.output_option("Write the segments: .csv or .geojson; or a folder, which gets STEM.csv for each strip.",
                      "FILE|DIR", required=False, folder=None)
@shared.output_option("Draw the first slice of --lines.", "FILE", "--png", required=False)
@shared.output_option("Draw all segments of --lines in plan and in 3D.", "FILE", "--overview", required=False)
@shared.output_option("Write the samples of --lines as a cube of line, pulse and time, for `wavebatch plot cube`.",
                      "FILE.npz", "--cube", required=False)
@click.option("--lines", callback=lambda context, parameter, text: shared.parse_span(text) if text else _ALL,
              metavar="N|FIRST:END", help="Scan lines, counted from 0; END is not included.  [default: all]")
@shared.options_of(SliceOptions, "geometry", "std")
@shared.declared("sigma", kind=SliceOptions, default=None)
@shared.options_of(SliceOptions, "shortest")
@click.option("--geojson-crs", type=click.Choice(GEOJSON_CRS), default="wgs84", show_default=True,
              help="Coordinates of a .geojson: longitude and latitude (needs pyproj), or those of the strip with its "
              "CRS, which GDAL and QGIS read.")
@shared.options_of(SliceOptions, "most")
@shared.declared("direction")
@shared.common_options("overwrite", "json")
def slice_(
    strips: tuple[str, ...],
    output: Path | None,
    lines: tuple[int, int | None],
    png: Path | None,
    overview: Path | None,
    cube: Path | None,
    **options: Any,
) -> None:
    """Find the straight surface lines in the scan lines of each STRIP.

    STRIP is a LAS or LAZ file with waveforms, a glob, a folder, or @list.txt with one of these per line.

    A slice shows the waveforms of one scan line side by side. A new line starts where the scan angle turns or jumps
    back, or after a pause. With plane slices a line that bends, as at the ridge of a roof, is two segments.

    \b
    Each segment has:
      line, segment      scan line and number in it, the strongest first
      x1 y1 z1 x2 y2 z2  its ends [units of the strip]
      length             distance of the ends [units of the strip]
      slope              angle above the horizontal from the first to the second end [degrees]
      residual           rms distance of the pulses' centroids from it [as length; ns with --geometry time]
      pulses             how many; first_pulse, last_pulse: which of the line; first_point: index in the file
      theta, rho         normal form of the line in the slice [degrees, pixels]
      weight             sum of its samples [DN]

    Exit code: 0 done, 1 a strip cannot be read or an output cannot be written (the others are made), 2 wrong usage.

    Examples:
      # straight surface lines in the scan lines
      wavebatch slice strip.las -o lines.csv
    """  # fmt: skip
    extras = [path for path in (png, overview, cube) if path is not None]
    if output is None and not extras:
        raise click.UsageError("give -o for the segments, --png or --overview for a picture, or --cube")
    if options["geojson_crs"] == "keep" and (output is None or output.suffix.lower() != ".geojson"):
        raise click.UsageError("--geojson-crs keep is of no use without -o FILE.geojson: other files keep the CRS")
    for target in extras:
        refuse_existing(target, options["overwrite"])
    for picture in filter(None, (png, overview)):
        check_picture(picture, overwrite=options["overwrite"])
    paths = shared.find_inputs(strips, recursive=options["recursive"])
    if extras and len(paths) > 1:
        raise ConfigError(f"{extras[0]}: one file for {len(paths)} strips; make them one by one")
    targets = {} if output is None else shared.name_outputs(paths, output, SEGMENT_SUFFIXES, ".csv")
    options |= {"lines": lines, "png": png, "overview": overview, "cube": cube, "extras": extras}
    found, failed = shared.for_each(
        paths, lambda strip: _slice(strip, targets.get(strip), options), debug=options["debug"]
    )
    answer(found[0] if len(paths) == 1 else found)
    sys.exit(EXIT_SOME_FAILED if failed else 0)


def _slice(strip: Path, output: Path | None, options: dict[str, Any]) -> dict[str, Any]:
    """Writes the segments of the wanted lines of one strip; returns their counts and says them."""
    (first, end), overwrite = options["lines"], options["overwrite"]
    png, overview = options["png"], options["overview"]
    with StripReader(strip, direction=options["direction"]) as reader, reader.scan() as scan, ExitStack() as stack:
        crs = None
        if output is not None and output.suffix.lower() == ".geojson":
            known = read_crs_definition(strip, reader.facts.header)
            crs = plan_crs(strip, known, options["geojson_crs"])
        sigma, floor = options["sigma"], 0.0
        if scan.with_waveform:
            system = survey_blocks(reader.sample_blocks(scan, _SURVEYED), learn=False).system
            sigma, floor = system.sigma_ref if sigma is None else sigma, _NOISE_FLOOR * system.noise.std
        settings = shared.from_options(SliceOptions, options, **{"sigma": sigma} if sigma else {}, floor=floor)
        counts: dict[str, Any] = {"lines": 0, "pulses": 0, "segments": 0, "full": 0, "sigma": settings.sigma}
        writer, every = None, []
        cube = CubeBuilder(options["cube"]) if options["cube"] else None
        if output:
            writer = stack.enter_context(SegmentWriter(output, crs=crs, overwrite=overwrite))
        for line in takewhile(lambda one: end is None or one.number < end, read_scan_lines(reader, scan)):
            if line.number < first:
                continue
            piece = cut_slice(line, settings)
            segments = find_segments(piece, settings)
            if png and not counts["lines"]:
                draw_slice(piece, segments, png, strip=strip.name, overwrite=overwrite)
            if overview:
                every += segments
            if cube:
                cube.add(line)
            if writer:
                writer.write(segments)
            counts["lines"] += 1
            counts["pulses"] += len(line)
            counts["segments"] += len(segments)
            counts["full"] += len(segments) >= settings.most
        if options["extras"] and not counts["lines"]:
            raise InputError(f"{options['extras'][0]}: not written, because no scan line has a number in --lines")
        if overview:
            if not every:
                raise InputError(f"{overview}: not drawn, because the scan lines have no segment")
            draw_segments(every, overview, strip=strip.name, lines=counts["lines"], crs=describe_crs(strip)[0],
                          overwrite=overwrite)  # fmt: skip
        if cube:
            meta = {"version": __version__, "strip": strip.name}
            counts["cube"] = list(cube.write(meta, reader.facts.crs, overwrite=overwrite))
        if writer:
            writer.commit()
    if not counts["lines"]:
        none = "no scan line" if scan.with_waveform else "no waveform, so no scan line"
        talk(f"{strip}: has {none}" + ("" if options["lines"] == _ALL else " with a number in --lines"))
    found = f"{count(counts['segments'], 'segment')} in {count(counts['lines'], 'scan line')}"
    tell(f"{strip}: {found} of {count(counts['pulses'], 'pulse')}")
    if counts["full"]:
        tell(f"{strip}: {count(counts['full'], 'scan line')} may have more segments than --most {settings.most}; "
             "raise it")  # fmt: skip
    return {"strip": str(strip), **counts}
