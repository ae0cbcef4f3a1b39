"""`wavebatch plot`: pictures of waveforms; those of clouds are in `clouds` and `sections`.

Reads options, calls `wavebatch.tools.plots` and prints one line. The modules that draw are imported only after all
else has succeeded: matplotlib takes long to import and may be missing.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import NearestGroup, answer, count, tell
from wavebatch.cli.plot.clouds import histogram, map_, output_option, read_range
from wavebatch.cli.plot.sections import cube, profile, section
from wavebatch.cli.program.completion import complete_flags
from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.publish import check_target
from wavebatch.files.figure_file import check_picture
from wavebatch.files.text_file import write_text

_SHOWN = ("detector", "asdf", "wavelet", "correlation", "deconvolved", "derivative")


def _read_times(text: str) -> tuple[float, ...] | str:
    return "all" if text == "all" else read_range(text)


@click.group(cls=NearestGroup)
def plot() -> None:
    """Draw waveforms, histograms, maps, sections and profiles as .png, .svg or .pdf.

    Needs matplotlib: pip install matplotlib. No screen is needed; the same input gives the same bytes.
    """


@plot.command()
@shared.strip_argument
@output_option
@click.option("--packet", "packets", multiple=True, metavar="N|FIRST:END",
              callback=lambda context, parameter, texts: tuple(map(shared.parse_span, texts)),
              help="Draw these packets, counted from 0; END is not included; may be repeated.  [default: six, spread "
              "over the strip]")
@click.option("--point", "point_numbers", multiple=True, type=int, metavar="N",
              help="Draw the packet of this point, counted from 0; may be repeated.")
@click.option("--gps-time", "times", multiple=True, type=float, metavar="T",
              help="Draw the pulse nearest to this GPS time [s]; may be repeated.")
@click.option("--flags", multiple=True, metavar="NAMES", shell_complete=complete_flags,
              help="Draw the first waveforms with an echo that has one of these flags, e.g. NOT_CONVERGED,AT_BOUND.")
@shared.where_option("Draw the first waveforms with echoes")
@click.option("--most", type=click.IntRange(1, 100), metavar="N",
              help="Most waveforms of --flags, --where or of the default.  [default: 6; with --sheet: 100]")
@click.option("--random", type=click.IntRange(1, 100), metavar="N", help="Draw N random packets.")
@shared.seed_option("Seed of the random packets.")
@click.option("--sheet", is_flag=True, help="Draw a contact sheet: up to 100 small pictures, cut to their echoes.")
@click.option("--times", "shown", type=shared.Text("LOW:HIGH|all", _read_times), metavar="LOW:HIGH|all",
              help="Part of the waveforms to show [ns].  [default: the part with signal, of each waveform]")
@click.option("--show", metavar="|".join(_SHOWN), help="Also draw the signal in which the detector searches, with its "
              "threshold; detector: that of the chain's detector.")
@click.option("--echoes", "table", is_flag=True,
              help="List amplitude, time, width, range and errors of all echoes below; -o FILE.csv writes only them.")
@shared.chain_options
@shared.system_option
@shared.strip_options
@shared.common_options("overwrite", "json")
def waveform(strip: Path, output: Path, **options: Any) -> None:
    """Draw waveforms of STRIP with their fit, residual and echoes; or write the echoes as a table.

    Shows samples, baseline and noise, the fitted sum, the pulse of each echo, the residual in standard deviations of
    the noise, echoes with their errors, and the returns of the file. The chain is chosen and run as by `wavebatch run`.

    Exit code: 0 done, 1 the strip cannot be read or the picture cannot be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.core.condition import read_flags
    from wavebatch.files.cloud.point_filter import PointFilter
    from wavebatch.tools.plots.packets import Wanted

    named = any(options[name] for name in ("packets", "point_numbers", "times"))
    for option in ("flags", "where"):
        if options[option] and (named or options["random"]):
            raise ConfigError(f"--{option} chooses the waveforms; leave out --packet, --point, --gps-time and --random")
    if options["random"] and named:
        raise ConfigError("--random chooses the waveforms; leave out --packet, --point and --gps-time")
    if options["most"] and (named or options["random"]):
        raise ConfigError("--most is for --flags, --where and the default; leave it out, or leave out the numbers")
    if options["sheet"] and (options["show"] or options["table"]):
        raise ConfigError("--sheet has no room for --show and --echoes; leave one of them out")
    tabular = output.suffix.lower() == ".csv"
    for name, option in (("sheet", "--sheet"), ("show", "--show"), ("shown", "--times")) if tabular else ():
        if options[name]:
            raise ConfigError(f"{option} is for pictures; leave it out, or name another file than {output}")
    (check_target if tabular else check_picture)(output, overwrite=options["overwrite"])
    chosen = PointFilter(flags=read_flags(options["flags"]), where=options["where"])
    wanted = shared.from_options(Wanted, options, points=options["point_numbers"], chosen=chosen)
    views, chain = _view(strip, wanted, options, ranges=tabular or options["table"])
    if tabular:
        from wavebatch.tools.plots.echo_table import format_echoes

        write_text(output, format_echoes(views), overwrite=options["overwrite"])
    else:
        _draw_waveforms(views, output, strip.name, chain, options)
    echoes = sum(len(view.echoes) for view in views)
    tell(f"{output}: {count(len(views), 'waveform')}, {count(echoes, 'echo')}")
    answer({"output": str(output), "chain": chain, "waveforms": len(views), "echoes": echoes})


def _draw_waveforms(views: list[Any], output: Path, strip: str, chain: str, options: dict[str, Any]) -> None:
    """Draws the waveforms as small multiples or as a contact sheet."""
    shown, more = options["shown"], {"strip": strip, "chain": chain, "overwrite": options["overwrite"]}
    if shown == "all":
        last = max(float(view.time[-1] + 0.5 * view.spacing) for view in views)
        shown = (min(-0.5 * view.spacing for view in views), last)
    if shown and all(view.time[-1] < shown[0] or shown[1] < 0 for view in views):
        end = max(view.time[-1] for view in views)
        raise ConfigError(f"--times {shown[0]:g}:{shown[1]:g}: no sample lies there; the waveforms end at {end:g} ns")
    if options["sheet"]:
        from wavebatch.tools.plots.draw_sheet import draw_waveform_sheet

        draw_waveform_sheet(views, output, times=shown, **more)
        return
    from wavebatch.tools.plots.draw_waveform import draw_waveform_panels

    draw_waveform_panels(views, output, times=shown, table=options["table"], **more)


def _view(strip: Path, wanted: Any, options: dict[str, Any], *, ranges: bool) -> tuple[list[Any], str]:
    """The waveforms that are wanted, and the chain that they were run through, in words.

    ranges: compute the distances of the echoes from the sensor, too, if its position is known.
    """
    from wavebatch.batch.options import RunOptions
    from wavebatch.files.strip.reader import StripReader
    from wavebatch.surveying.prepare import Positions, prepare
    from wavebatch.tools.api.run import find_request
    from wavebatch.tools.plots.packets import find_places
    from wavebatch.tools.plots.waveform import add_ranges, name_chain, read_views

    chain, request = find_request(shared.from_options(RunOptions, options))
    opened = StripReader(strip, direction=options["direction"], headerless=options["headerless"])
    with opened as reader, reader.scan(force=options["force"]) as scan:
        choice = prepare(reader, scan, chain, request, positions=Positions.NONE).choice
        system = choice.survey.system
        places = find_places(reader, scan, wanted, lambda block: choice.chain.run(block, system))
        run, fill = choice.chain, None
        if ranges:
            run, fill, error = add_ranges(choice.chain, reader, scan)
            system = system.with_radiometry(sensor_error=error)
        views = read_views(reader, scan, places, run, system, options["show"], fill)
        return views, name_chain(choice.chain)


for command in (histogram, map_, section, profile, cube):
    plot.add_command(command)
