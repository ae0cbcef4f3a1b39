"""`wavebatch voxelize`: deconvolved waveforms in a 3D grid.

Only reads options and prints; the work is in `wavebatch.tools.voxels`.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import count, counting, print_summary

if TYPE_CHECKING:
    from wavebatch.tools.voxels.strip import VoxelSummary

_SENSOR = ("trajectory", "lever_arm", "crs", "flight_height")


@click.command()
@shared.strip_argument
@shared.output_option("Voxels to write: .npz, or .las or .laz with a point at the centre of each.")
@click.option("--size", required=True, type=float, metavar="M",
              help="Edge of a voxel [m]; the faces of voxels lie at multiples of it.")
@click.option("--method", type=click.Choice(["richardson_lucy", "gold", "wiener"]), default="richardson_lucy",
              show_default=True, help="How waveforms are deconvolved with the system pulse.")
@click.option("--iterations", type=click.IntRange(1, 10_000), metavar="N",
              help="Iterations: more resolve closer surfaces, but take longer.  [default: 40; gold: 100]")
@click.option("--snr", type=click.FloatRange(0, min_open=True), metavar="RATIO",
              help="wiener: amplitude over noise for which the filter is designed.  [default: 20]")
@click.option("--threshold", type=click.FloatRange(0), default=4.27, show_default=True, metavar="STD",
              help="Ignore signal weaker than a single echo of this many standard deviations of the noise.")
@click.option("--headroom", type=click.FloatRange(0, 100_000), metavar="M",
              help="Count each ray from this distance before its first sample [m], whether recorded or not.  [default: "
              "from the highest return near it]")
@click.option("--all-crossed", is_flag=True, help="Also write voxels that rays crossed without any signal.")
@shared.system_option
@shared.calibration_option
@shared.sensor_options
@shared.strip_options
@shared.common_options("overwrite", "json", "quiet")
def voxelize(strip: Path, output: Path, **options: Any) -> None:
    """Deconvolve the waveforms of STRIP and sum them in the voxels of a 3D grid.

    \b
    Each voxel with signal has:
      energy         integral of the signal from it [DN ns]
      cross_section  backscatter cross section [m2], with --calibration
      rays           number of rays that crossed it and had light left
      path           length of these rays inside it [m]
      light          light that was left in them, in units of whole rays
      share          share of that light that came back from it; 1 - share is its transmittance

    Each sample is spread over its length along the ray, so that voxels smaller than a sample (15 cm) have no holes. A
    ray ends at its last signal; voxels after it were not seen. A voxel that is not in the file was not seen, or
    (without --all-crossed) was seen to be empty.

    An .npz file holds index (n, 3), one array per value, origin, size, crs and meta; voxel i lies between origin + i
    size and origin + (i + 1) size. Memory does not grow with the strip; large strips need room in TMPDIR. The options
    for the sensor position are for cross sections only.

    Exit code: 0 done, 1 the strip cannot be read or the output cannot be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.tools.voxels.profile import Deconvolution
    from wavebatch.tools.voxels.strip import VoxelOptions, voxelize_strip

    _check_options(options)
    sensor = shared.read_sensor(options)
    settings = shared.from_options(VoxelOptions, options, deconvolution=shared.from_options(Deconvolution, options))
    with counting("waveforms", options["quiet"]) as bar:

        def show(done: int, total: int) -> None:
            bar.total = total
            bar.update(done)

        summary = voxelize_strip(
            strip,
            output,
            settings,
            system=shared.read_system(options),
            calibration=shared.read_calibration(options),
            sensor=sensor,
            progress=show,
            **{name: options[name] for name in ("direction", "headerless", "overwrite", "force")},
        )
    print_summary(options, summary, _list_lines(summary))


def _check_options(options: dict[str, Any]) -> None:
    """Refuses options that would have no effect."""
    for name in _SENSOR:
        if options[name] is not None and options["calibration_file"] is None:
            raise click.UsageError(f"--{name.replace('_', '-')} is of no use without --calibration")


def _list_lines(summary: VoxelSummary) -> Iterator[str]:
    x, y, z = summary.shape
    yield (
        f"{summary.output}: {count(summary.voxels, 'voxel')} of {summary.size:g} m in {x} x {y} x {z}, "
        f"{summary.energy:.6g} DN ns from {summary.with_signal} of {count(summary.waveforms, 'waveform')}"
    )
    notes = {
        "without a return at the signal; placed by the raw return location": summary.with_signal - summary.anchored,
        "saturated; the energy is too low": summary.clipped,
        "left out: the position is not a number or far outside": summary.outside,
        "without a known cross section": summary.unknown,
    }
    for text, number in notes.items():
        if number:
            yield f"note: {count(number, 'waveform')} {text}"
