"""Commands that write strips: `wavebatch import` and `export`, `simulate` and `synthesize`.

import: PulseWaves files as strips; export: strips for other programs; simulate: a strip with known echoes; synthesize:
waveforms from discrete returns. Only reads options and prints; the work is in `wavebatch.tools`: `import_file`,
`export_strip` and `simulate`. Most options have the names of the fields that they fill (see `from_options`), so that a
renamed field needs a renamed option here.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.command import complete, complete_files
from wavebatch.cli.messages import answer, counting, print_summary, talk, tell
from wavebatch.core.schema import declared_options
from wavebatch.core.units import count
from wavebatch.tools import simulate as simulation
from wavebatch.tools.cells import doubt_clouds
from wavebatch.tools.export_strip import SUFFIXES as WRITTEN
from wavebatch.tools.export_strip import ExportSummary, export_strip
from wavebatch.tools.import_file import SUFFIXES, ImportOptions, ImportSummary, import_file
from wavebatch.tools.simulate.render import Recording
from wavebatch.tools.simulate.returns import EQUAL, Radar, SynthesisOptions, SynthesisSummary, synthesize_strip

EXIT_SOME, EXIT_NONE = 3, 4
"""Exit codes of `wavebatch run`: some files failed; no file was written."""


@click.command("import")
@click.argument("files", nargs=-1, required=True, metavar="FILE...", shell_complete=complete_files)
@shared.declared("recursive")
@shared.output_option("Strip to write, .las or .laz, or a folder.  [default: X.las beside each X.pls]", "FILE|DIR",
                      required=False, folder=None)
@shared.options_of(ImportOptions)
@shared.common_options("overwrite", "json")
def import_(files: tuple[str, ...], output: Path | None, **options: Any) -> None:
    """Import PulseWaves FILEs (.pls with the .wvs beside it) as LAS 1.4 strips of point format 9.

    FILE is a .pls, a glob, a folder, or @list.txt with one of these per line. A strip has the energy and the height of
    every outgoing pulse as extra bytes, and X.system.toml beside it has the shape of these pulses. A file that is
    damaged or cut gives one line and no output.

    Exit code: 0 all written, 2 wrong usage, 3 some files failed, 4 no file was written.

    Examples:
      # flight.las and flight.wdp, and flight.system.toml
      wavebatch import flight.pls -o flight.las
      # all files of a folder; go on after an interruption
      wavebatch import archive/ -o strips --resume
    """  # fmt: skip
    paths = shared.find_inputs(files, options, kinds=(SUFFIXES,))
    if output is None:
        targets = {path: path.with_suffix(".las") for path in paths}
    else:
        if output.suffix.lower() not in (".las", ".laz"):
            output.mkdir(parents=True, exist_ok=True)
        targets = shared.name_outputs(paths, output, (".las", ".laz"), ".las")
    chosen = shared.from_options(ImportOptions, options)

    def work(path: Path) -> ImportSummary:
        with counting("pulses", options["quiet"]) as bar:
            summary = import_file(path, targets[path], chosen, bar.update)
        place = summary.output
        if summary.skipped:
            tell(f"{place}: is up to date, skipped")
            return summary
        parts = (summary.points, "point"), (summary.packets, "packet"), (summary.pulses, "pulse")
        points, packets, pulses = (count(*part) for part in parts)
        tell(f"{place}: {points} and {packets} of {pulses}")
        sent = summary.outgoing
        if sent is not None:
            spread, error = 100 * sent["energy_scatter"], 100 * sent["energy_error"]
            width = f" {sent['fwhm_ns']:.3f} ns wide at half maximum," if math.isfinite(sent["fwhm_ns"]) else ":"
            tell(f"{place}: outgoing pulses{width} energies vary by {spread:.2f} %, known to {error:.2f} %")
        for note in summary.notes:
            tell(f"{place}: {note}")
        return summary

    # A single file that fails is one line too, with the exit code of a batch.
    results, failed = shared.for_each(paths, work, debug=options["debug"], alone=True)
    answer({"files": [asdict(one) for one in results], "failed": failed})
    sys.exit(0 if not failed else EXIT_SOME if results else EXIT_NONE)


@click.command()
@shared.strips_argument
@shared.output_option("File to write: .las or .laz with a .wdp beside it, or .npz; or a folder, which gets STEM.las "
                      "for each strip.", "FILE|DIR", folder=None)
@shared.strip_options
@shared.common_options("overwrite", "json")
def export(strips: tuple[str, ...], output: Path, **options: Any) -> None:
    """Write STRIPs as other programs need them: LAS with repaired packets, or waveforms as arrays.

    \b
    LAS, LAZ: packets without compression, of 8, 16 or 32 bits, with descriptors of their true length; vectors toward
              the sensor in metres per picosecond; true counts and bounds. Points whose packet cannot be used have
              none. A record of the file says what was repaired.
    NPZ:      arrays samples and missing, of all waveforms behind each other; waveform p has count[p] of them from
              first[p] on, at origin[p] + t direction[p] with t = 0, spacing[p], ... ns; its returns are those with
              return_waveform p.

    Exit code: 0 done, 1 a strip cannot be read or an output cannot be written (the others are made), 2 wrong usage.

    Examples:
      # packets as the LAS specification has them
      wavebatch export strip.las -o repaired.laz
      # waveforms with their geometry as arrays
      wavebatch export strip.las -o strip.npz
    """  # fmt: skip
    paths = shared.find_inputs(strips, options)
    targets = shared.name_outputs(paths, output, WRITTEN, ".las")

    def work(path: Path) -> ExportSummary:
        with counting("waveforms", options["quiet"]) as bar:
            names = ("direction", "headerless", "overwrite")
            summary = export_strip(path, targets[path], progress=bar.update, **{name: options[name] for name in names})
        numbers = f"{count(summary.points, 'point')} and {count(summary.waveforms, 'waveform')}"
        tell(f"{summary.output}: {numbers}")
        for line in summary.repaired:
            tell(f"{summary.output}: {'' if line.startswith('warning: ') else 'repaired: '}{line}")
        return summary

    summaries, failed = shared.for_each(paths, work, debug=options["debug"])
    answer(summaries)
    sys.exit(1 if failed else 0)


_SEEN = 0.001
"""Share of the energy that is worth a note where it is not of echoes."""

_SCENE_LINES = "\n\n".join(
    [f"{name}: {scene.meaning}." for name, scene in simulation.SCENES.items()]
    + [f"{name}: another name of {scene}." for name, scene in simulation.OTHER_NAMES.items()]
    + [f"canopy.{name}: {meaning}." for name, (meaning, _) in simulation.CANOPIES.items()]
)

_output = shared.output_option("Strip to write: .las or .laz.")


@click.command(epilog="Scenes:\n\n" + _SCENE_LINES)
@click.argument("scene", shell_complete=complete("scenes"))
@_output
@shared.output_option("Write the true echoes.", "FILE.npz", "--truth", required=False)
@click.option("--pulses", default=100_000, show_default=True, metavar="N", help="Number of pulses.")
@shared.seed_option("Seed of the random numbers; pulse k of a scene and a seed is always the same.")
@shared.options_of(Recording, default=None)
@click.option("--pulse", type=click.Choice(list(simulation.PULSES)),
              help="Shape of the system pulse.  [default: gaussian]")
@click.option("--sigma", type=float, metavar="NS",
              help="Standard deviation of the pulse's main lobe [ns].  [default: the scene's]")
@click.option("--kappa", type=float, metavar="KAPPA", help="Skew of the main lobe.  [default: 0]")
@click.option("--ringing", default=0.0, metavar="SHARE",
              help="Share of the amplitude in lobes 4 and 8 sigma after the peak.")
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
    receiver = None
    if options["sensor"] == "discrete":
        if truth:
            raise click.UsageError("--truth holds the echoes of waveforms; simulate them with --sensor waveform")
        if not options["internal"]:
            raise click.UsageError("--external is about packets; --sensor discrete writes none")
        receiver = shared.from_options(simulation.DiscreteReceiver, options)
    elif shared.given_options(options, declared_options(simulation.DiscreteReceiver)):
        raise click.UsageError("--dead-zone, --threshold and --most-returns need --sensor discrete")
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


@click.command()
@click.argument("cloud", type=shared.INPUT)
@_output
@shared.options_of(SynthesisOptions)
@shared.seed_option("Seed of the noise and of the first sample's time.")
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
    radar = None
    if options["intensity"] != "peak":  # by the lidar equation
        if options["height"] is None:
            raise click.UsageError("--intensity reflectance needs --sensor-height")
        radar = shared.from_options(Radar, options)
    elif shared.given_options(options, (*declared_options(Radar), "shares")):
        raise click.UsageError("the options of the lidar equation and --shares need --intensity reflectance")
    settings = shared.from_options(SynthesisOptions, options, radar=radar)
    with counting("points", options["quiet"]) as bar:
        summary = synthesize_strip(cloud, output, settings, overwrite=options["overwrite"], progress=bar.update)
    talk(*(f"{output}: warning: {line}" for line in doubt_clouds([cloud])))
    lines = _list_lines(output, summary, settings)
    print_summary(summary.to_json() if options["as_json"] else summary, lines)


def _list_lines(output: Path, summary: SynthesisSummary, settings: SynthesisOptions) -> Iterator[str]:
    yield f"{output}: {count(summary.points, 'point')}, {count(summary.packets, 'packet')}, gain {summary.gain:.4g}"
    if summary.without_packet:
        yield f"note: {count(summary.without_packet, 'point')} without a packet: the pulse lasts too long"
    if summary.saturated:
        yield f"note: {count(summary.saturated, 'return')} above the digitizer's range; lower --gain"
    if summary.scattered:
        yield f"note: {count(summary.scattered, 'pulse')} incomplete in the cloud; sort the cloud by GPS time if needed"
    packed = summary.energy - summary.energy_without_packet
    share = f" ({summary.energy_recorded / packed:.1%})" if packed else ""
    without = f", {summary.energy_without_packet:.4g} DN ns without a packet" * bool(summary.without_packet)
    yield f"energy: {packed:.4g} DN ns modelled, {summary.energy_recorded:.4g} DN ns in the samples{share}{without}"
    if abs(summary.energy_of_level) > _SEEN * packed:
        yield (
            f"note: samples without an echo hold {summary.level:.4g} DN on average, not the baseline of "
            f"{settings.baseline:g} DN: about {summary.energy_of_level:+.2g} DN ns in the samples are not of echoes; "
            "give a whole --baseline of 3 times --noise or more"
        )
    light = summary.light
    if light.own_width:
        yield f"widths: {light.own_width} of the cloud, {summary.points - light.own_width} of the pulse"
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
