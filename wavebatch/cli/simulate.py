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

from wavebatch.cli import options as shared
from wavebatch.cli.command import complete_scenes
from wavebatch.cli.messages import counting, print_summary
from wavebatch.core.schema import declared_options
from wavebatch.core.units import count
from wavebatch.tools import simulate as simulation
from wavebatch.tools.simulate.render import Recording
from wavebatch.tools.simulate.returns import EQUAL, Radar, SynthesisOptions, SynthesisSummary, synthesize_strip

_SEEN = 0.001
"""Share of the energy that is worth a note where it is not of echoes."""

_SCENE_LINES = "\n\n".join(
    [f"{name}: {scene.meaning}." for name, scene in simulation.SCENES.items()]
    + [f"{name}: another name of {scene}." for name, scene in simulation.OTHER_NAMES.items()]
    + [f"canopy.{name}: {meaning}." for name, (meaning, _) in simulation.CANOPIES.items()]
)

_output = shared.output_option("Strip to write: .las or .laz.")


@click.command(epilog="Scenes:\n\n" + _SCENE_LINES)
@click.argument("scene", shell_complete=complete_scenes)
@_output
@shared.output_option("Write the true echoes to this .npz file.", "FILE", "--truth", required=False)
@click.option("--pulses", default=100_000, show_default=True, metavar="N", help="Number of pulses.")
@shared.seed_option("Seed of the random numbers; pulse k of a scene and a seed is always the same.")
@shared.options_of(Recording, default=None)
@click.option("--pulse", type=click.Choice(list(simulation.PULSES)),
              help="Shape of the system pulse.  [default: gaussian]")
@click.option("--sigma", type=float, help="Standard deviation of the pulse's main lobe [ns].  [default: the scene's]")
@click.option("--kappa", type=float, help="Skew of the main lobe.  [default: 0]")
@click.option("--ringing", default=0.0, help="Share of the amplitude in lobes 4 and 8 sigma after the peak.")
@shared.options_of(simulation.StripOptions)
@click.option("--sensor", type=click.Choice(["waveform", "discrete"]), default="waveform", show_default=True,
              help="waveform: record every waveform; discrete: record only returns, by a receiver with a dead zone.")
@shared.options_of(simulation.DiscreteReceiver, default=None)
@shared.common_options("overwrite", "json")
def simulate(scene: str, output: Path, seed: int, pulses: int, truth: Path | None, **options: Any) -> None:
    """Simulate a full-waveform strip of a SCENE with known echoes.

    The points are what a vendor would deliver: one return per distinguishable echo, at its true position, with return
    locations that are up to half a sample off; returns of one pulse share a packet. --truth writes every true echo,
    for `wavebatch compare`. --sensor discrete writes returns without waveforms, in point format 1, 3, 6 or 8 instead
    of 4, 5, 9 or 10.

    Exit code: 0 done, 1 the strip cannot be written, 2 wrong usage.

    Examples:
      # a strip with known echoes
      wavebatch simulate forest -o forest.laz --pulses 50000 --truth truth.npz
    """  # fmt: skip
    receiver = _build_receiver(truth, options)
    found = simulation.find_scene(scene)
    given = shared.given_options(options, declared_options(Recording))  # the others are those of the scene
    shape = {name: options[name] for name in ("pulse", "sigma", "kappa", "ringing")}
    pulse = simulation.shape_pulse(found.recording.pulse, **shape)
    shaped = replace(found, recording=replace(found.recording, pulse=pulse, **given))
    bar = counting("pulses", options["quiet"], pulses)
    common = {
        "pulses": pulses,
        "seed": seed,
        "options": shared.from_options(simulation.StripOptions, options),
        "overwrite": options["overwrite"],
        "progress": bar.update,
    }
    with bar:
        if receiver:
            summary = simulation.simulate_returns(shaped, output, receiver=receiver, **common)
            rest = f"{summary.empty} without any"
        else:
            summary = simulation.simulate_strip(shaped, output, truth=truth, **common)
            rest = f"{count(summary.packets, 'packet')} with {count(summary.echoes, 'echo')}"
    points = f"{count(summary.points, 'point')} of {count(summary.pulses, 'pulse')}"
    print_summary(summary, [f"{output}: {points}, {rest}"])


def _build_receiver(truth: Path | None, options: dict[str, Any]) -> simulation.DiscreteReceiver | None:
    """The discrete receiver of the options; None for a sensor that records waveforms."""
    if options["sensor"] == "discrete":
        if truth:
            raise click.UsageError("--truth holds the echoes of waveforms; simulate them with --sensor waveform")
        if not options["internal"]:
            raise click.UsageError("--external is about packets; --sensor discrete writes none")
        return shared.from_options(simulation.DiscreteReceiver, options)
    if shared.given_options(options, declared_options(simulation.DiscreteReceiver)):
        raise click.UsageError("--dead-zone, --threshold and --most-returns need --sensor discrete")
    return None


@click.command()
@click.argument("cloud", type=shared.INPUT)
@_output
@shared.options_of(SynthesisOptions, "intensity", "gain", "width", "widths", "shares", "spacing", "bits", "baseline",
                   "noise")
@shared.seed_option("Seed of the noise and of the first sample's time.")
@shared.options_of(SynthesisOptions, "internal")
@shared.options_of(Radar, default=None)
@shared.common_options("overwrite", "json")
def synthesize(cloud: Path, output: Path, **options: Any) -> None:
    """Model waveforms from the discrete returns of CLOUD: one Gaussian per return, from its range and intensity.

    The strip has the points of CLOUD and one packet per pulse; `wavebatch run` can read it. A pulse is a run of points
    with equal GPS time. With --intensity reflectance a wide echo is lower, with the same energy, and a return that
    takes a share of the footprint returns that share of the light.

    Exit code: 0 done, 1 the cloud cannot be read or the strip cannot be written, 2 wrong usage.

    Examples:
      # waveforms from the returns of a cloud
      wavebatch synthesize cloud.laz -o strip.las
      # by the lidar equation, with partial footprints
      wavebatch synthesize cloud.laz -o strip.las --intensity reflectance --sensor-height 1200 --shares equal
    """  # fmt: skip
    settings = shared.from_options(SynthesisOptions, options, radar=_build_radar(options))
    with counting("points", options["quiet"]) as bar:
        summary = synthesize_strip(cloud, output, settings, overwrite=options["overwrite"], progress=bar.update)
    lines = _list_lines(output, summary, settings)
    print_summary(summary.to_json() if options["as_json"] else summary, lines)


def _build_radar(options: dict[str, Any]) -> Radar | None:
    """The figures of the lidar equation; None if intensities are peaks."""
    if options["intensity"] == "peak":
        if shared.given_options(options, (*declared_options(Radar), "shares")):
            raise click.UsageError("the options of the lidar equation and --shares need --intensity reflectance")
        return None
    if options["height"] is None:
        raise click.UsageError("--intensity reflectance needs --sensor-height")
    return shared.from_options(Radar, options)


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
