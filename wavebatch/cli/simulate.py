"""`wavebatch simulate`, a strip with known echoes, and `wavebatch synthesize`, waveforms from discrete returns."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

import click

from wavebatch.cli.messages import counting, debug_option, print_json, report_errors, talk
from wavebatch.cli.options import json_option, overwrite_option, quiet_option
from wavebatch.tools.simulate import (
    CANOPIES,
    PULSES,
    SCENES,
    DiscreteReceiver,
    Scene,
    StripOptions,
    find_scene,
    shape_pulse,
    simulate_returns,
    simulate_strip,
)
from wavebatch.tools.simulate.from_returns import (
    INTENSITIES,
    Radar,
    SynthesisOptions,
    SynthesisSummary,
    synthesize_strip,
)

_STORAGE = ("point_format", "internal", "scale", "without_waveform", "keep_empty", "toward")
_RECORDING = {
    "bits": "bits",
    "samples": "n_samples",
    "spacing": "spacing",
    "noise": "noise_std",
    "baseline": "baseline",
    "rho": "rho",
    "noise_gain": "noise_gain",
    "saturation": "saturation",
}
_PLAIN = ("intensity", "gain", "width", "spacing", "baseline", "noise", "seed", "internal")
_RADAR = ("power", "aperture", "divergence", "efficiency", "attenuation")
_RECEIVER = {"dead_zone": "dead_zone", "threshold": "threshold", "most_returns": "most"}
_SCENE_LINES = "\n\n".join(
    [f"{name}: {scene.meaning}." for name, scene in SCENES.items()]
    + [f"canopy.{name}: {meaning}." for name, (meaning, _) in CANOPIES.items()]
)


@click.command(epilog="Scenes:\n\n" + _SCENE_LINES)
@click.argument("scene")
@click.option("-o", "--output", required=True, type=click.Path(path_type=Path), help="The strip: .las or .laz.")
@click.option(
    "--seed",
    type=click.IntRange(0),
    default=0,
    show_default=True,
    metavar="N",
    help="Pulse k of a scene and seed is always the same.",
)
@click.option("--pulses", default=100_000, show_default=True, metavar="N", help="Pulses to fire.")
@click.option("--truth", type=click.Path(path_type=Path), help="Write the true echoes to this .npz.")
@click.option("--bits", type=click.Choice(["8", "16", "32"]), help="Bits per sample.  [default: 8]")
@click.option("--samples", type=int, help="Samples per waveform.  [default: the scene's, 80 or 96]")
@click.option("--spacing", type=float, help="Time between samples [ns].  [default: 1]")
@click.option("--noise", type=float, help="Noise before rounding [DN].  [default: the scene's, 1 or 1.2]")
@click.option("--rho", type=float, help="Correlation of the noise of neighbours: 0, .5, .667, .75, .8.  [default: 0]")
@click.option("--noise-gain", type=float, help="Variance that the signal adds, per DN.  [default: 0]")
@click.option("--baseline", type=float, help="Level without signal [DN].  [default: 12]")
@click.option("--saturation", type=int, help="Count at which the receiver clips.  [default: the digitizer's largest]")
@click.option("--pulse", type=click.Choice(list(PULSES)), help="Shape of the system pulse.  [default: gaussian]")
@click.option("--sigma", type=float, help="Standard deviation of the pulse's main lobe [ns].  [default: the scene's]")
@click.option("--kappa", type=float, help="Skew of the main lobe.  [default: 0]")
@click.option("--ringing", default=0.0, help="Share of the amplitude in lobes 4 and 8 sigma behind the peak.")
@click.option("--point-format", type=click.Choice(["4", "5", "9", "10"]), default="4", show_default=True)
@click.option("--las-version", "version", type=click.Choice(["1.3", "1.4"]), help="[default: 1.3 for formats 4 and 5]")
@click.option("--internal/--external", default=True, help="Packets in the file or in a .wdp.  [default: internal]")
@click.option("--scale", default=0.001, show_default=True, help="Unit of the stored coordinates [m].")
@click.option("--without-waveform", default=0.01, show_default=True, help="Share of the pulses without a packet.")
@click.option("--keep-empty/--drop-empty", default=True, help="Keep or leave out pulses without echo.  [default: keep]")
@click.option("--toward/--away", default=True, help="Where the stored vectors point.  [default: toward the sensor]")
@click.option(
    "--sensor",
    type=click.Choice(["waveform", "discrete"]),
    default="waveform",
    show_default=True,
    help="What records: every waveform, or a receiver of discrete returns with a dead zone (no packets).",
)
@click.option("--dead-zone", type=float, help="Discrete: least distance of two returns [m].  [default: 0.65]")
@click.option("--threshold", type=float, help="Discrete: amplitude that fires a return [DN].  [default: 12]")
@click.option("--most-returns", type=int, help="Discrete: returns per pulse.  [default: 4]")
@overwrite_option
@json_option("Print the counts as JSON on stdout.")
@quiet_option
@debug_option
@report_errors()
def simulate(scene: str, output: Path, seed: int, pulses: int, truth: Path | None, **options) -> None:
    """Make a full-waveform strip of a SCENE, with known echoes.

    The points are what a vendor would deliver: a return per distinguishable echo, sharing packets, placed rightly but
    with a return location that is up to half a sample off. --truth keeps every true echo for `wavebatch compare`.
    --sensor discrete writes the returns of a receiver with a dead zone instead, in the point format without waveforms:
    1, 3, 6 or 8 in place of 4, 5, 9 or 10. Exit code: 0, 1 where the strip cannot be written, 2 wrong usage.
    """
    receiver = _build_receiver(truth, options)
    shaped = _shape_scene(find_scene(scene), options)
    storage = {name: options[name] for name in _STORAGE} | {"point_format": int(options["point_format"])}
    bar = counting("pulses", options["quiet"], pulses)
    common = {
        "pulses": pulses,
        "seed": seed,
        "options": StripOptions(version=options["version"], **storage),
        "overwrite": options["overwrite"],
        "progress": bar.update,
    }
    with bar:
        if receiver:
            summary = simulate_returns(shaped, output, receiver=receiver, **common)
        else:
            summary = simulate_strip(shaped, output, truth=truth, **common)
    if options["as_json"]:
        print_json(asdict(summary))
    if not options["quiet"]:
        rest = f"{summary.empty} without any" if receiver else f"{summary.packets} packets with {summary.echoes} echoes"
        talk(f"{output}: {summary.points} points of {summary.pulses} pulses, {rest}")


def _build_receiver(truth: Path | None, options: dict) -> DiscreteReceiver | None:
    """The discrete receiver that the options ask for, None for a sensor of waveforms."""
    given = {field: options[name] for name, field in _RECEIVER.items() if options[name] is not None}
    if options["sensor"] == "discrete":
        if truth:
            raise click.UsageError("--truth holds the echoes of waveforms; simulate them with --sensor waveform")
        if not options["internal"]:
            raise click.UsageError("--external is about packets, of which --sensor discrete has none")
        return DiscreteReceiver(**given)
    if given:
        raise click.UsageError("--dead-zone, --threshold and --most-returns need --sensor discrete")
    return None


def _shape_scene(scene: Scene, options: dict) -> Scene:
    """The scene with the recording that the options ask for."""
    given = {field: options[name] for name, field in _RECORDING.items() if options[name] is not None}
    if "bits" in given:
        given["bits"] = int(given["bits"])
    shape = {name: options[name] for name in ("pulse", "sigma", "kappa", "ringing")}
    return replace(
        scene, recording=replace(scene.recording, pulse=shape_pulse(scene.recording.pulse, **shape), **given)
    )


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
