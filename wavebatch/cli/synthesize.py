"""`wavebatch synthesize`: waveforms modelled from discrete returns."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

import click

from wavebatch.cli.common import debug_option, print_json, report_errors, talk
from wavebatch.cli.options import json_option, overwrite_option, quiet_option
from wavebatch.cli.progress import counting
from wavebatch.synthesize import INTENSITIES, Radar, SynthesisOptions, SynthesisSummary, synthesize_strip

_PLAIN = ("intensity", "gain", "width", "spacing", "baseline", "noise", "seed", "internal")
_RADAR = ("power", "aperture", "divergence", "efficiency", "attenuation")


@click.command()
@click.argument("cloud", type=click.Path(path_type=Path))
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="The strip: .las or .laz.")
@click.option(
    "--intensity",
    type=click.Choice(INTENSITIES),
    default="peak",
    show_default=True,
    help="What intensities are: peak amplitudes, or reflectances (65535 is 1) that the lidar equation weakens.",
)
@click.option("--gain", type=float, help="DN per unit of intensity, or per W.  [default: fills 80 % of the digitizer]")
@click.option("--width", default=4.7, show_default=True, help="FWHM of an echo [ns]; a column echo_width comes first.")
@click.option("--spacing", default=1.0, show_default=True, help="Time between samples [ns].")
@click.option("--bits", type=click.Choice(["8", "16", "32"]), default="8", show_default=True, help="Bits per sample.")
@click.option("--baseline", default=12.0, show_default=True, help="Level without signal [DN].")
@click.option("--noise", default=0.0, show_default=True, help="Noise before rounding [DN].")
@click.option(
    "--seed", type=click.IntRange(0), default=0, show_default=True, help="Of noise and of the samples' phase."
)
@click.option("--sensor-height", type=float, help="Reflectance: height of the sensor, as the cloud's heights [m].")
@click.option("--power", type=float, help="Reflectance: peak power of the pulse [W].  [default: 1]")
@click.option("--aperture", type=float, help="Reflectance: diameter of the receiver [m].  [default: 0.1]")
@click.option("--divergence", type=float, help="Reflectance: full angle of the beam [mrad].  [default: 0.5]")
@click.option("--efficiency", type=float, help="Reflectance: of the optics.  [default: 0.5]")
@click.option("--attenuation", type=float, help="Reflectance: of the air [dB/km].  [default: 0.22]")
@click.option("--internal/--external", default=True, help="Packets in the file or in a .wdp.  [default: internal]")
@overwrite_option
@json_option("Print the counts as JSON on stdout.")
@quiet_option
@debug_option
@report_errors()
def synthesize(cloud: Path, output: Path, **options) -> None:
    """Model waveforms from the discrete returns of CLOUD: a Gaussian per return, from range and intensity.

    The strip has the cloud's points, and a packet per pulse; `wavebatch run` reads it. Pulses are points of equal gps
    time in a row. Exit code: 0, 1 where the cloud cannot be read or the strip not be written, 2 wrong usage.
    """
    settings = SynthesisOptions(
        bits=int(options["bits"]), radar=_build_radar(options), **{name: options[name] for name in _PLAIN}
    )
    with counting("points", options["quiet"]) as bar:
        summary = synthesize_strip(cloud, output, settings, overwrite=options["overwrite"], progress=bar.update)
    if options["as_json"]:
        print_json(asdict(summary))
    if not options["quiet"]:
        for line in _list_lines(output, summary):
            talk(line)


def _build_radar(options: dict) -> Radar | None:
    """The lidar equation's figures, or None where intensities are peaks."""
    given = {name: options[name] for name in _RADAR if options[name] is not None}
    height = options["sensor_height"]
    if options["intensity"] == "peak":
        if given or height is not None:
            raise click.UsageError("the lidar equation's options need --intensity reflectance")
        return None
    if height is None:
        raise click.UsageError("--intensity reflectance needs --sensor-height")
    if "divergence" in given:
        given["divergence"] *= 1e-3
    return Radar(height, **given)


def _list_lines(output: Path, summary: SynthesisSummary) -> list[str]:
    lines = [f"{output}: {summary.points} points, {summary.packets} packets, gain {summary.gain:.4g}"]
    if summary.without_packet:
        lines.append(f"note: {summary.without_packet} points have no packet: their pulses last too long")
    if summary.saturated:
        lines.append(f"note: {summary.saturated} returns are stronger than the digitizer's range; lower --gain")
    if summary.scattered:
        lines.append(
            f"note: {summary.scattered} pulses are not whole in the cloud; where it is not in the order of time, sort "
            "it by gps time first"
        )
    return lines
