"""`wavebatch simulate`: a strip with known echoes; `wavebatch synthesize`: waveforms from discrete returns.

Only reads options and prints; the work is in `wavebatch.tools.simulate`. Most options have the names of the fields that
they fill (see `from_options`), so that a renamed field needs a renamed option here.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import count, counting, print_summary
from wavebatch.cli.options import common_options, from_options, given_options, output_option, seed_option
from wavebatch.cli.program.completion import complete_scenes
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
from wavebatch.tools.simulate.from_returns import SynthesisSummary, synthesize_strip
from wavebatch.tools.simulate.render import LEAST_SPACING, MOST_NOISE, MOST_NOISE_GAIN, MOST_SPACING
from wavebatch.tools.simulate.return_light import (
    EQUAL,
    INTENSITIES,
    MOST_GAIN,
    MOST_HEIGHT,
    MOST_WIDTH,
    RADAR_LIMITS,
    Radar,
    SynthesisOptions,
)

_RECORDING = ("n_samples", "spacing", "noise_std", "baseline", "rho", "noise_gain", "saturation")
"""Options that change the recording of the scene."""

_SPACING = {"type": click.FloatRange(LEAST_SPACING, MOST_SPACING), "metavar": "NS"}
_NOISE = {"type": click.FloatRange(0.0, MOST_NOISE), "metavar": "DN"}
_RADAR = ("power", "aperture", "divergence", "efficiency", "attenuation")
_SEEN = 0.001
"""Share of the energy that is worth a note where it is not of echoes."""

_SCENE_LINES = "\n\n".join(
    [f"{name}: {scene.meaning}." for name, scene in SCENES.items()]
    + [f"canopy.{name}: {meaning}." for name, (meaning, _) in CANOPIES.items()]
)

_output = output_option("Strip to write: .las or .laz.")
_internal = click.option("--internal/--external", default=True,
                         help="Store packets in the file or in a .wdp file.  [default: internal]")  # fmt: skip


@click.command(epilog="Scenes:\n\n" + _SCENE_LINES)
@click.argument("scene", shell_complete=complete_scenes)
@_output
@output_option("Write the true echoes to this .npz file.", "FILE", "--truth", required=False)
@click.option("--pulses", default=100_000, show_default=True, metavar="N", help="Number of pulses.")
@seed_option("Seed of the random numbers; pulse k of a scene and a seed is always the same.")
@click.option("--bits", type=click.Choice(["8", "16", "32"]), help="Bits per sample.  [default: 8]")
@click.option("--samples", "n_samples", type=int, help="Samples per waveform.  [default: the scene's, 80 or 96]")
@click.option("--spacing", **_SPACING, help="Time between samples [ns].  [default: 1]")
@click.option("--baseline", type=float, help="Level without signal [DN].  [default: 12]")
@click.option("--noise", "noise_std", **_NOISE,
              help="Standard deviation of the noise before rounding [DN].  [default: the scene's, 1 or 1.2]")
@click.option("--rho", type=float,
              help="Correlation of the noise of neighbouring samples: 0, .5, .667, .75 or .8.  [default: 0]")
@click.option("--noise-gain", type=click.FloatRange(0.0, MOST_NOISE_GAIN), metavar="DN",
              help="Noise variance that the signal adds [DN2 per DN].  [default: 0]")
@click.option("--saturation", type=int,
              help="Count at which the receiver saturates [DN].  [default: the largest that the bits can hold]")
@click.option("--pulse", type=click.Choice(list(PULSES)), help="Shape of the system pulse.  [default: gaussian]")
@click.option("--sigma", type=float, help="Standard deviation of the pulse's main lobe [ns].  [default: the scene's]")
@click.option("--kappa", type=float, help="Skew of the main lobe.  [default: 0]")
@click.option("--ringing", default=0.0, help="Share of the amplitude in lobes 4 and 8 sigma after the peak.")
@click.option("--point-format", type=click.Choice(["4", "5", "9", "10"]), default="4", show_default=True,
              help="LAS point format.")
@click.option("--las-version", "version", type=click.Choice(["1.3", "1.4"]),
              help="LAS version.  [default: 1.3 for point formats 4 and 5, else 1.4]")
@_internal
@click.option("--scale", default=0.001, show_default=True, help="Unit of the stored coordinates [m].")
@click.option("--without-waveform", default=0.01, show_default=True, help="Share of the pulses without a packet.")
@click.option("--keep-empty/--drop-empty", default=True,
              help="Keep or leave out pulses without an echo.  [default: keep]")
@click.option("--toward/--away", default=True,
              help="Direction of the packet vectors: toward or away from the sensor.  [default: toward]")
@click.option("--sensor", type=click.Choice(["waveform", "discrete"]), default="waveform", show_default=True,
              help="waveform: record every waveform; discrete: record only returns, by a receiver with a dead zone.")
@click.option("--dead-zone", type=click.FloatRange(0.0, 1e6, min_open=True), metavar="M",
              help="Discrete: least distance of two returns [m].  [default: 0.65]")
@click.option("--threshold", type=click.FloatRange(0.0, 1e10), metavar="DN",
              help="Discrete: amplitude that triggers a return [DN].  [default: 12]")
@click.option("--most-returns", "most", type=int, help="Discrete: most returns per pulse.  [default: 4]")
@common_options("overwrite", "json")
def simulate(scene: str, output: Path, seed: int, pulses: int, truth: Path | None, **options: Any) -> None:
    """Simulate a full-waveform strip of a SCENE with known echoes.

    The points are what a vendor would deliver: one return per distinguishable echo, at its true position, with return
    locations that are up to half a sample off; returns of one pulse share a packet. --truth writes every true echo,
    for `wavebatch compare`. --sensor discrete writes returns without waveforms, in point format 1, 3, 6 or 8 instead
    of 4, 5, 9 or 10.

    Exit code: 0 done, 1 the strip cannot be written, 2 wrong usage.
    """  # fmt: skip
    receiver = _build_receiver(truth, options)
    shaped = _shape_scene(find_scene(scene), options)
    bar = counting("pulses", options["quiet"], pulses)
    common = {
        "pulses": pulses,
        "seed": seed,
        "options": from_options(StripOptions, options, point_format=int(options["point_format"])),
        "overwrite": options["overwrite"],
        "progress": bar.update,
    }
    with bar:
        if receiver:
            summary = simulate_returns(shaped, output, receiver=receiver, **common)
            rest = f"{summary.empty} without any"
        else:
            summary = simulate_strip(shaped, output, truth=truth, **common)
            rest = f"{count(summary.packets, 'packet')} with {count(summary.echoes, 'echo')}"
    points = f"{count(summary.points, 'point')} of {count(summary.pulses, 'pulse')}"
    print_summary(summary, [f"{output}: {points}, {rest}"])


def _build_receiver(truth: Path | None, options: dict[str, Any]) -> DiscreteReceiver | None:
    """The discrete receiver of the options; None for a sensor that records waveforms."""
    if options["sensor"] == "discrete":
        if truth:
            raise click.UsageError("--truth holds the echoes of waveforms; simulate them with --sensor waveform")
        if not options["internal"]:
            raise click.UsageError("--external is about packets; --sensor discrete writes none")
        return from_options(DiscreteReceiver, options)
    if given_options(options, ("dead_zone", "threshold", "most")):
        raise click.UsageError("--dead-zone, --threshold and --most-returns need --sensor discrete")
    return None


def _shape_scene(scene: Scene, options: dict[str, Any]) -> Scene:
    """The scene with the recording of the options."""
    given = given_options(options, _RECORDING)
    if options["bits"]:
        given["bits"] = int(options["bits"])
    shape = {name: options[name] for name in ("pulse", "sigma", "kappa", "ringing")}
    pulse = shape_pulse(scene.recording.pulse, **shape)
    return replace(scene, recording=replace(scene.recording, pulse=pulse, **given))


@click.command()
@click.argument("cloud", type=click.Path(path_type=Path))
@_output
@click.option("--intensity", type=click.Choice(INTENSITIES), default="peak", show_default=True,
              help="Meaning of the intensities: peak amplitudes, or reflectances (65535 is 1), from which the lidar "
              "equation computes amplitudes.")
@click.option("--gain", type=click.FloatRange(0.0, MOST_GAIN, min_open=True), metavar="DN",
              help="DN per unit of intensity, or per W.  [default: fills 80 % of the digitizer]")
@click.option("--width", type=click.FloatRange(0.0, MOST_WIDTH, min_open=True), metavar="NS",
              default=4.7, show_default=True,
              help="Full width of the pulse at half maximum [ns], and of echoes without a width of their own.")
@click.option("--widths", metavar="COLUMN",
              help="Column with the full width of each echo at half maximum [ns].  [default: echo_width, if present]")
@click.option("--shares", metavar="COLUMN|equal",
              help="Reflectance: column with the share of the footprint that each return takes, 0 to 1, or equal. "
              "Returns without data take evenly what the others of their pulse leave; shares above 1 together are "
              "scaled to 1.  [default: each return fills it]")
@click.option("--spacing", **_SPACING, default=1.0, show_default=True, help="Time between samples [ns].")
@click.option("--bits", type=click.Choice(["8", "16", "32"]), default="8", show_default=True, help="Bits per sample.")
@click.option("--baseline", default=12.0, show_default=True, help="Level without signal [DN].")
@click.option("--noise", **_NOISE, default=0.0, show_default=True,
              help="Standard deviation of the noise before rounding [DN].")
@seed_option("Seed of the noise and of the first sample's time.")
@_internal
@click.option("--sensor-height", type=click.FloatRange(-MOST_HEIGHT, MOST_HEIGHT), metavar="M",
              help="Reflectance: height of the sensor, in the heights of CLOUD [m].")
@click.option("--power", type=click.FloatRange(*RADAR_LIMITS["power"]), metavar="W",
              help="Reflectance: peak power of the pulse [W].  [default: 1]")
@click.option("--aperture", type=click.FloatRange(*RADAR_LIMITS["aperture"]), metavar="M",
              help="Reflectance: diameter of the receiver [m].  [default: 0.1]")
@click.option("--divergence", type=click.FloatRange(0.001, 100.0), metavar="MRAD",
              help="Reflectance: full angle of the beam [mrad].  [default: 0.5]")
@click.option("--efficiency", type=click.FloatRange(*RADAR_LIMITS["efficiency"]), metavar="SHARE",
              help="Reflectance: efficiency of the optics.  [default: 0.5]")
@click.option("--attenuation", type=click.FloatRange(*RADAR_LIMITS["attenuation"]), metavar="DB_KM",
              help="Reflectance: attenuation of the air [dB/km].  [default: 0.22]")
@common_options("overwrite", "json")
def synthesize(cloud: Path, output: Path, **options: Any) -> None:
    """Model waveforms from the discrete returns of CLOUD: one Gaussian per return, from its range and intensity.

    The strip has the points of CLOUD and one packet per pulse; `wavebatch run` can read it. A pulse is a run of points
    with equal GPS time. With --intensity reflectance a wide echo is lower, with the same energy, and a return that
    takes a share of the footprint returns that share of the light.

    Exit code: 0 done, 1 the cloud cannot be read or the strip cannot be written, 2 wrong usage.
    """  # fmt: skip
    settings = from_options(SynthesisOptions, options, bits=int(options["bits"]), radar=_build_radar(options))
    with counting("points", options["quiet"]) as bar:
        summary = synthesize_strip(cloud, output, settings, overwrite=options["overwrite"], progress=bar.update)
    lines = _list_lines(output, summary, settings)
    print_summary(summary.to_json() if options["as_json"] else summary, lines)


def _build_radar(options: dict[str, Any]) -> Radar | None:
    """The figures of the lidar equation; None if intensities are peaks."""
    given = given_options(options, _RADAR)
    height = options["sensor_height"]
    if options["intensity"] == "peak":
        if given or height is not None or options["shares"] is not None:
            raise click.UsageError("the options of the lidar equation and --shares need --intensity reflectance")
        return None
    if height is None:
        raise click.UsageError("--intensity reflectance needs --sensor-height")
    if "divergence" in given:
        given["divergence"] *= 1e-3
    return Radar(height, **given)


def _list_lines(output: Path, summary: SynthesisSummary, settings: SynthesisOptions) -> Iterator[str]:
    yield f"{output}: {count(summary.points, 'point')}, {count(summary.packets, 'packet')}, gain {summary.gain:.4g}"
    if summary.without_packet:
        yield f"note: {count(summary.without_packet, 'point')} without a packet: the pulse lasts too long"
    if summary.saturated:
        yield f"note: {count(summary.saturated, 'return')} above the digitizer's range; lower --gain"
    if summary.scattered:
        yield f"note: {count(summary.scattered, 'pulse')} incomplete in the cloud; sort the cloud by GPS time if needed"
    packed = summary.energy_in_packets
    share = f" ({summary.energy_recorded / packed:.1%})" if packed else ""
    without = f", {summary.energy_without_packet:.4g} DN ns without a packet" * bool(summary.without_packet)
    yield f"energy: {packed:.4g} DN ns modelled, {summary.energy_recorded:.4g} DN ns in the samples{share}{without}"
    if abs(summary.energy_of_level) > _SEEN * packed:
        yield (
            f"note: samples without an echo hold {summary.level:.4g} DN on average, not the baseline of "
            f"{settings.baseline:g} DN: about {summary.energy_of_level:+.2g} DN ns in the samples are not of echoes; "
            "give a whole --baseline of 3 times --noise or more"
        )
    yield from _list_light(summary, settings)


def _list_light(summary: SynthesisSummary, settings: SynthesisOptions) -> Iterator[str]:
    """What was assumed about widths and shares."""
    light, points = summary.light, summary.points
    if light.own_width:
        yield f"widths: {light.own_width} of the cloud, {points - light.own_width} of the pulse"
    if light.assumed_unit:
        yield f"note: column {settings.widths} states no unit; its values were taken as nanoseconds"
    if light.limited_width:
        yield f"note: {count(light.limited_width, 'width')} outside of half a sample to 118 ns, set to that limit"
    if light.pulses:
        found = f"{light.own_share} of the cloud, {light.assumed_share} assumed"
        yield f"shares: {found}; the returns of a pulse take {summary.light_used:.1%} of its light on average"
    if settings.shares == EQUAL and summary.scattered:
        yield "note: equal shares use number_of_returns, including missing returns"
    elif light.pulses and summary.scattered:
        yield "note: shares of incomplete pulses are those of the points that are there in a row"
    if light.over_one:
        yield f"note: {count(light.over_one, 'pulse')} with shares above 1 together, scaled to 1"
