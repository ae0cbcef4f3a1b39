"""`wavebatch voxelize`: what came back from every voxel of a 3D grid, by deconvolution."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli.messages import counting, debug_option, print_json, report_errors, talk
from wavebatch.cli.options import (
    direction_option,
    headerless_option,
    json_option,
    overwrite_option,
    quiet_option,
    read_sensor,
    sensor_options,
    system_option,
)

if TYPE_CHECKING:
    from wavebatch.tools.voxels import VoxelSummary

_SENSOR = ("trajectory", "lever_arm", "crs", "flight_height")


@click.command()
@click.argument("strip", type=click.Path(path_type=Path))
@click.option("--size", required=True, type=float, metavar="M", help="Edge of a voxel; faces lie at multiples of it.")
@click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
              help="The voxels: .npz, or .las or .laz with a point at the centre of each.")
@click.option("--method", type=click.Choice(["richardson_lucy", "gold", "wiener"]), default="richardson_lucy",
              show_default=True, help="How waveforms are deconvolved with the system pulse.")
@click.option("--iterations", type=click.IntRange(1, 10_000), metavar="N",
              help="More separate closer surfaces, and take longer.  [default: 40, of gold 100]")
@click.option("--snr", type=click.FloatRange(0, min_open=True), metavar="RATIO",
              help="Amplitude over noise that the filter of --method wiener is made for.  [default: 20]")
@click.option("--threshold", type=click.FloatRange(0), default=4.27, show_default=True, metavar="STD",
              help="Less signal in a row than a lone echo of this many standard deviations is noise, and left out.")
@click.option("--headroom", type=click.FloatRange(0, 100_000), metavar="M",
              help="Count rays over this length before their first sample, too: they crossed it, whether recorded or "
                   "not.  [default: up to the highest return near them]")
@click.option("--all-crossed", is_flag=True, help="Write voxels that rays crossed without any signal, too.")
@system_option
@click.option("--calibration", "calibration_file", type=click.Path(path_type=Path), metavar="FILE",
              help="Of `wavebatch calibrate`, with divergence: adds the cross section in m2.")
@sensor_options
@direction_option
@headerless_option
@overwrite_option
@json_option("Print the counts as JSON on stdout.")
@quiet_option
@debug_option
@report_errors()
def voxelize(strip: Path, output: Path, **options: Any) -> None:
    """What came back from every voxel of a 3D grid: the waveforms of STRIP, deconvolved and put along their rays.

    \b
    Per voxel with signal:
      energy         integral of the signal that came from it [DN ns]
      cross_section  backscatter cross section [m2], with --calibration
      rays           rays that crossed it and had light left
      path           way of these rays inside it [m]
      light          what was left of them, a whole ray being 1
      share          share of that light that came back from it; 1 - share is its transmittance

    Every sample is spread over its own way, so that voxels smaller than a sample's 15 cm have no holes. A ray ends at
    its last signal: what lies behind is not seen. What is not in the file was not seen, or (without --all-crossed)
    seen to be empty. An .npz holds index (n, 3), a column per value, origin, size, crs and meta; voxel i lies between
    origin + i size and origin + (i + 1) size. Memory does not grow with the strip; TMPDIR needs room for large ones.
    Where the sensor was matters to cross sections only.

    Exit code: 0, 1 where the strip cannot be read or the output not be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.surveying.calibration import load_calibration
    from wavebatch.surveying.system_file import load_survey
    from wavebatch.tools.voxels import Deconvolution, VoxelOptions, voxelize_strip

    _check_options(options)
    sensor = read_sensor(options)
    deconvolution = Deconvolution(
        options["method"], options["iterations"], options["snr"], options["threshold"]
    )
    settings = VoxelOptions(options["size"], deconvolution, options["headroom"], options["all_crossed"])
    calibration_file, system_file = options["calibration_file"], options["system_file"]
    with counting("waveforms", options["quiet"]) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done)

        summary = voxelize_strip(
            strip,
            output,
            settings,
            system=load_survey(system_file) if system_file else None,
            calibration=load_calibration(calibration_file) if calibration_file else None,
            sensor=sensor,
            direction=options["direction"],
            headerless=options["headerless"],
            overwrite=options["overwrite"],
            progress=show,
        )
    if options["as_json"]:
        print_json(asdict(summary))
    if not options["quiet"]:
        for line in _list_lines(summary):
            talk(line)


def _check_options(options: dict[str, Any]) -> None:
    """Refuses options that would do nothing."""
    if options["snr"] is not None and options["method"] != "wiener":
        raise click.UsageError("--snr needs --method wiener")
    if options["iterations"] is not None and options["method"] == "wiener":
        raise click.UsageError("--method wiener has no --iterations")
    for name in _SENSOR:
        if options[name] is not None and options["calibration_file"] is None:
            raise click.UsageError(f"--{name.replace('_', '-')} is of no use without --calibration")


def _list_lines(summary: VoxelSummary) -> list[str]:
    x, y, z = summary.shape
    lines = [
        f"{summary.output}: {summary.voxels} voxels of {summary.size:g} m in {x} x {y} x {z}, "
        f"{summary.energy:.6g} DN ns from {summary.with_signal} of {summary.waveforms} waveforms"
    ]
    loose = summary.with_signal - summary.anchored
    if loose:
        lines.append(f"note: {loose} waveforms have no return at their signal; placed by the raw location")
    if summary.clipped:
        lines.append(f"note: {summary.clipped} waveforms are saturated: their energy is too low")
    if summary.outside:
        lines.append(f"note: {summary.outside} waveforms are left out: their position is no number, or far off")
    if summary.unknown:
        lines.append(f"note: the cross section of {summary.unknown} waveforms is not known")
    return lines
