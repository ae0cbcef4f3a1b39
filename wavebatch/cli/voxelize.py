"""`wavebatch voxelize`: deconvolved waveforms in a 3D grid.

Only reads options and prints; the work is in `wavebatch.tools.voxels`.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, counting, talk, tell
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import count, format_measure
from wavebatch.files.disk.publish import refuse_input
from wavebatch.tools.voxels.rays import Deconvolution
from wavebatch.tools.voxels.strip import VoxelOptions

if TYPE_CHECKING:
    from wavebatch.tools.voxels.strip import VoxelSummary

EXIT_SOME_FAILED = 1
"""Some strips failed."""

_SENSOR = ("trajectory", "lever_arm", "crs", "flight_height")


@click.command()
@shared.strips_argument
@shared.output_option("Voxels to write: .npz, or .las or .laz with a point at the centre of each; or a folder, which "
                      "gets STEM.npz for each strip, with --forest STEM.laz.", "FILE|DIR", folder=None)
@shared.options_of(VoxelOptions, "size")
@shared.options_of(Deconvolution)
@shared.options_of(VoxelOptions, "headroom", "ground_height", "reflectance_ratio")
@shared.where_option("Use only pulses with a return (a point of the strip)")
@click.option("--profiles", type=shared.OutputPath(path_type=Path), metavar="FILE.npz",
              help="Also write the deconvolved signal of every pulse: energy and, with --calibration, cross section by "
              "time.")
@shared.options_of(VoxelOptions, "all_crossed", "forest")
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
    from wavebatch.batch.options import RunOptions
    from wavebatch.files.cloud.point_filter import PointFilter
    from wavebatch.surveying.calibrating.calibration_file import load_calibration
    from wavebatch.surveying.system_file import load_survey
    from wavebatch.tools.api.run import read_sensor
    from wavebatch.tools.voxels.strip import voxelize_strip

    _check_options(options)
    settings = shared.from_options(VoxelOptions, options, deconvolution=shared.from_options(Deconvolution, options),
                                   chosen=PointFilter(where=options["where"]))  # fmt: skip
    names = ("direction", "headerless", "overwrite", "force", "profiles")
    asked = shared.from_options(RunOptions, options)
    more: dict[str, Any] = {"sensor": read_sensor(asked), **{name: options[name] for name in names}}
    more["system"] = None if asked.system is None else load_survey(asked.system)
    more["calibration"] = None if asked.calibration is None else load_calibration(asked.calibration)
    paths = shared.find_inputs(strips, recursive=options["recursive"])
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

            summary = voxelize_strip(strip, targets[strip], settings, progress=show, **more)
        for line in summary.warnings:  # with --quiet too: they say how far the values can be trusted
            talk(f"warning: {line}")
        for line in _list_lines(summary):
            tell(line)
        return summary

    summaries, failed = shared.for_each(paths, work, debug=options["debug"])
    answer(summaries[0] if len(paths) == 1 else [asdict(one) for one in summaries])
    sys.exit(EXIT_SOME_FAILED if failed else 0)


def _check_options(options: dict[str, Any]) -> None:
    """Refuses options that would have no effect."""
    for name in _SENSOR:
        if options[name] is not None and options["calibration"] is None:
            raise click.UsageError(f"--{name.replace('_', '-')} is of no use without --calibration")


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
    if summary.several_packets:
        hidden = ""
        if summary.hidden_light is not None:
            hidden = f"; up to {summary.hidden_light:.2g} of a pulse's light may hide there"
        yield (
            f"note: {count(summary.several_packets, 'pulse')} of several packets; between them nothing was recorded: "
            f"it counts as empty{hidden}"
        )
    yield from _tell_ratio(summary)


def _tell_ratio(summary: VoxelSummary) -> Iterator[str]:
    """The reflectance ratio by which light is shared."""
    if summary.reflectance_ratio_source == "strip":
        measure = format_measure(summary.reflectance_ratio, summary.reflectance_ratio_err or 0.0)
        yield f"reflectance of canopy over ground: {measure}"
    elif summary.reflectance_ratio_source == "assumed":
        yield (
            "note: the strip does not show the reflectance of canopy over ground (fewer than 100 pulses, all shared by "
            "both alike, or too different in energy); it was taken as 1, so 1 - share is a gap probability only if "
            "both reflect alike: give --reflectance-ratio"
        )
