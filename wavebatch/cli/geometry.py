"""`wavebatch slice`: straight surface lines in the scan lines of a strip; `wavebatch voxelize`: its signal in a grid.

Reads options, loops over strips and scan lines, and prints; the work is in `wavebatch.tools.scan_slices` and
`wavebatch.tools.voxels`.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import Any

import click

from wavebatch import __version__
from wavebatch.cli import options as shared
from wavebatch.cli.messages import counting, talk, tell
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import count, format_measure
from wavebatch.files.disk.publish import refuse_input
from wavebatch.files.figure_file import check_picture
from wavebatch.files.geojson import GEOJSON_CRS, plan_crs
from wavebatch.files.las.crs import describe_crs, read_crs_definition
from wavebatch.files.strip.reader import UNIT_POINTS, StripReader
from wavebatch.surveying import survey_blocks
from wavebatch.tools import slice_output
from wavebatch.tools.scan_slices import MOST_SAMPLES, SliceOptions, cut_slice, find_segments, read_scan_lines
from wavebatch.tools.voxels.rays import Deconvolution
from wavebatch.tools.voxels.strip import VoxelOptions, VoxelSummary, voxelize_strip

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
def slice_(strips: tuple[str, ...], output: Path | None, **options: Any) -> None:
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
    extras = options["extras"] = [path for path in map(options.get, ("png", "overview", "cube")) if path is not None]
    if output is None and not extras:
        raise click.UsageError("give -o for the segments, --png or --overview for a picture, or --cube")
    if options["geojson_crs"] == "keep" and (output is None or output.suffix.lower() != ".geojson"):
        raise click.UsageError("--geojson-crs keep is of no use without -o FILE.geojson: other files keep the CRS")
    for picture in filter(None, (options["png"], options["overview"])):
        check_picture(picture, overwrite=options["overwrite"])
    paths = shared.find_inputs(strips, options)
    if extras and len(paths) > 1:
        raise ConfigError(f"{extras[0]}: one file for {len(paths)} strips; make them one by one")
    targets = {} if output is None else shared.name_outputs(paths, output, slice_output.SEGMENT_SUFFIXES, ".csv")
    shared.finish_each(paths, lambda strip: _slice(strip, targets.get(strip), options), options)


def _slice(strip: Path, output: Path | None, options: dict[str, Any]) -> dict[str, Any]:
    """Writes the segments of the wanted lines of one strip; returns their counts and says them."""
    (first, end), overwrite = options["lines"], options["overwrite"]
    png, overview = options["png"], options["overview"]
    with StripReader(strip, direction=options["direction"]) as reader:
        longest = max((one.n_samples for one in reader.facts.digitizers.values()), default=0)
    units = min(UNIT_POINTS, MOST_SAMPLES // max(longest, 1))  # 50,000 waveforms of 1,000 samples took 2.3 GB
    with StripReader(reader.facts, unit_points=units) as reader, reader.scan() as scan, ExitStack() as stack:
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
        cube, kept, samples = options["cube"], [], 0
        if output:
            writer = stack.enter_context(slice_output.SegmentWriter(output, crs=crs, overwrite=overwrite))
        for line in takewhile(lambda one: end is None or one.number < end, read_scan_lines(reader, scan)):
            if line.number < first:
                continue
            piece = cut_slice(line, settings)
            segments = find_segments(piece, settings)
            if png and not counts["lines"]:
                slice_output.draw_slice(piece, segments, png, strip=strip.name, overwrite=overwrite)
            if overview:
                every += segments
            if cube:
                kept.append(line)
                samples += len(line.row)
                if samples > (most := slice_output.MOST_VALUES):
                    raise ConfigError(f"--cube {cube}: more than {most} samples; choose fewer --lines")
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
            look = {"strip": strip.name, "lines": counts["lines"], "crs": describe_crs(strip)[0]}
            slice_output.draw_segments(every, overview, **look, overwrite=overwrite)
        if cube:
            meta = {"version": __version__, "strip": strip.name}
            counts["cube"] = list(slice_output.write_cube(cube, kept, meta, reader.facts.crs, overwrite=overwrite))
        if writer:
            writer.commit()
    talk(*(f"{strip}: warning: {line}" for line in (*reader.facts.warnings, *scan.doubts)))
    if scan.broken:
        talk(f"{strip}: warning: packets of {count(scan.broken, 'point')} cannot be used; `wavebatch check` says why")
    if not counts["lines"]:
        none = "no scan line" if scan.with_waveform else "no waveform, so no scan line"
        talk(f"{strip}: has {none}" + ("" if options["lines"] == _ALL else " with a number in --lines"))
    found = f"{count(counts['segments'], 'segment')} in {count(counts['lines'], 'scan line')}"
    tell(f"{strip}: {found} of {count(counts['pulses'], 'pulse')}")
    if counts["full"]:
        tell(f"{strip}: {count(counts['full'], 'scan line')} may have more segments than --most {settings.most}; "
             "raise it")  # fmt: skip
    return {"strip": str(strip), **counts}


@click.command()
@shared.strips_argument
@shared.output_option("Voxels to write: .npz, or .las or .laz with a point at the centre of each; or a folder, which "
                      "gets STEM.npz for each strip, with --forest STEM.laz.", "FILE|DIR", folder=None)
@shared.options_of(VoxelOptions)
@shared.options_of(Deconvolution)
@shared.where_option("Use only pulses with a return (a point of the strip)")
@click.option("--profiles", type=shared.OutputPath(path_type=Path), metavar="FILE.npz",
              help="Also write the deconvolved signal of every pulse: energy and, with --calibration, cross section by "
              "time.")
@shared.system_option
@shared.declared("calibration")
@shared.declared("energy")
@shared.sensor_options
@shared.strip_options
@shared.common_options("overwrite", "json")
def voxelize(strips: tuple[str, ...], output: Path, **options: Any) -> None:
    """Deconvolve the waveforms of each STRIP and sum them in the voxels of a 3D grid.

    STRIP is a LAS or LAZ file with waveforms, a glob, a folder, or @list.txt with one of these per line.

    \b
    Each voxel with signal has:
      energy         integral of the signal from it [DN ns]
      cross_section  backscatter cross section [m2], with --calibration
      rays           number of rays that crossed it and had light left
      path           length of these rays inside it [m]
      light          light that was left in them, in units of whole rays
      share          share of that light that was caught in it; 1 - share is its gap probability
      share_error    standard deviation of share: by the number of rays, by how much more than these explain the
                     shares of neighbouring voxels differ, and by the error of RATIO

    Light is shared along a ray as its signal times the square of the range, where signal from the ground counts
    RATIO times as much as that from the canopy. The ratio is that at which the sum does not depend on how much light
    reached the ground; where the strip does not show it, it is taken as 1, and a note says so.

    A pulse is one ray, with all of its packets (of equal GPS time and scanner, on one line). Between packets nothing
    was recorded, because no light triggered the digitizer: it counts as empty air, and a note says how much light may
    hide there. Where a packet is missing or broken, the light is known up to it, not beyond.

    Each sample is spread over its length along the ray, so that voxels smaller than a sample (15 cm) have no holes. A
    ray ends at its last signal; voxels after it were not seen. A voxel that is not in the file was not seen, or
    (without --all-crossed) was seen to be empty.

    An .npz file holds index (n, 3), one array per value, origin, size, crs and meta; voxel i lies between origin + i
    size and origin + (i + 1) size. --profiles writes an .npz with the arrays point, gps_time, start, step, packets,
    known, anchored, clipped, first, count (one value per pulse with signal) and time, spacing, energy, cross_section
    (one per sample with signal); the samples of pulse p are first[p] to first[p] + count[p] - 1, at start + time step.

    Memory does not grow with the strip; large strips need room in TMPDIR. The options
    for the sensor position are for cross sections only.

    Exit code: 0 done, 1 a strip cannot be read or an output cannot be written (the others are made), 2 wrong usage.

    Examples:
      # cross sections in voxels of 1 m
      wavebatch voxelize strip.las --size 1 -o voxels.npz
    """  # fmt: skip
    from wavebatch.batch.job import StripJob
    from wavebatch.batch.options import RunOptions
    from wavebatch.files.cloud.point_filter import PointFilter
    from wavebatch.surveying.calibrating.calibration_files import load_calibration
    from wavebatch.tools.api import find_request, read_sensor

    for name in ("trajectory", "lever_arm", "crs", "flight_height"):
        if options[name] is not None and options["calibration"] is None:
            raise click.UsageError(f"--{name.replace('_', '-')} is of no use without --calibration")
    settings = shared.from_options(VoxelOptions, options, deconvolution=shared.from_options(Deconvolution, options))
    asked = shared.from_options(RunOptions, options)
    chain, request = find_request(asked)
    calibration = None if asked.calibration is None else load_calibration(Path(asked.calibration))
    job = StripJob(Path(), chain, asked, request=request, sensor=read_sensor(asked), calibration=calibration,
                   selection=PointFilter(where=options["where"]))  # fmt: skip
    files = {name: options[name] for name in ("overwrite", "profiles")}
    paths = shared.find_inputs(strips, options)
    if options["profiles"] is not None:
        refuse_input(options["profiles"])
    if len(paths) > 1 and options["profiles"] is not None:
        raise ConfigError(f"--profiles {options['profiles']}: one file for {len(paths)} strips; make them one by one")
    # `grid --forest` reads clouds.
    kind = ".laz" if options["forest"] else ".npz"
    targets = shared.name_outputs(paths, output, (".npz", ".las", ".laz"), kind)

    def work(strip: Path) -> VoxelSummary:
        with counting("waveforms", options["quiet"]) as bar:

            def show(done: int, total: int) -> None:
                bar.total = total
                bar.update(done)

            summary = voxelize_strip(replace(job, path=strip), targets[strip], settings, progress=show, **files)
        # With --quiet too: they say how far the values can be trusted
        talk(*(f"{strip}: warning: {line}" for line in summary.warnings))
        for line in _list_lines(summary):
            tell(line)
        return summary

    shared.finish_each(paths, work, options)


def _list_lines(summary: VoxelSummary) -> Iterator[str]:
    x, y, z = summary.shape
    yield (
        f"{summary.output}: {count(summary.voxels, 'voxel')} of {summary.size:g} m in {x} x {y} x {z}, "
        f"{summary.energy:.6g} DN ns from {summary.with_signal} of {count(summary.pulses, 'pulse')}"
    )
    if summary.profiles is not None:
        yield f"{summary.profiles}: {count(summary.profile_samples, 'sample')} of {summary.with_signal} pulses"
    if summary.left_out:
        yield f"note: {count(summary.left_out, 'waveform')} left out by --where: no return of the pulse meets it"
    notes = {
        "without a return at the signal; placed by the raw return location": summary.with_signal - summary.anchored,
        "saturated; the energy is too low": summary.clipped,
        "left out: the position is not a number or far outside": summary.outside,
        "without a known cross section": summary.unknown,
        "with a packet that is missing or broken: light is known up to it, not beyond": summary.lost_packets,
    }
    for text, number in notes.items():
        if number:
            yield f"note: {count(number, 'pulse')} {text}"
    if summary.cross_section_error is not None:
        yield f"cross sections: {100 * summary.cross_section_error:.2g} % of error that all share"
    if summary.several_packets:
        hidden = ""
        if summary.hidden_light is not None:
            hidden = f"; up to {summary.hidden_light:.2g} of a pulse's light may hide there"
        yield (
            f"note: {count(summary.several_packets, 'pulse')} of several packets; between them nothing was recorded: "
            f"it counts as empty{hidden}"
        )
    if summary.reflectance_ratio_source == "strip":
        measure = format_measure(summary.reflectance_ratio, summary.reflectance_ratio_err or 0.0)
        yield f"reflectance of canopy over ground: {measure}"
    elif summary.reflectance_ratio_source == "assumed":
        yield (
            "note: the strip does not show the reflectance of canopy over ground (fewer than 100 pulses, all shared by "
            "both alike, or too different in energy); it was taken as 1, so 1 - share is a gap probability only if "
            "both reflect alike: give --reflectance-ratio"
        )
