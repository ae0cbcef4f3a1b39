"""`wavebatch plot`: pictures of waveforms, histograms and maps."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from wavebatch.cli.messages import NearestGroup, debug_option, report_errors, talk
from wavebatch.cli.options import direction_option, headerless_option, overwrite_option, quiet_option, system_option

_output = click.option("-o", "--output", required=True, type=click.Path(dir_okay=False, path_type=Path), metavar="FILE",
                       help="The picture: .png, .svg or .pdf.")  # fmt: skip
_clouds = click.argument("clouds", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="CLOUD...")
_with = click.option("--flags-with", multiple=True, metavar="NAMES",
                     help="Only points with one of these flags of echo_flags, e.g. SATURATED,WEAK.")  # fmt: skip
_without = click.option("--flags-without", multiple=True, metavar="NAMES",
                        help="Only points with none of these flags.")  # fmt: skip


def _read_numbers(context: click.Context, parameter: click.Parameter, texts: tuple[str, ...]) -> tuple:
    """`7` or `5:20` as the first number and the one behind the last."""
    numbers = []
    for text in texts:
        found = re.fullmatch(r"(\d{1,18})(?::(\d{1,18}))?", text)
        if not found:
            raise click.BadParameter(f"{text!r} is neither a number nor FIRST:BEHIND")
        numbers.append((int(found[1]), int(found[2]) if found[2] else int(found[1]) + 1))
    return tuple(numbers)


def _read_range(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[float, float] | None:
    """`LOW:HIGH`."""
    if text is None:
        return None
    try:
        low, high = (float(part) for part in text.split(":"))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not LOW:HIGH") from None
    if not low < high or high - low == float("inf"):
        raise click.BadParameter(f"{text!r} does not go up from one finite number to another")
    return low, high


def _read_bounds(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[float, ...] | None:
    """`WEST,SOUTH,EAST,NORTH`."""
    if text is None:
        return None
    try:
        west, south, east, north = (float(part) for part in text.split(","))
    except ValueError:
        raise click.BadParameter(f"{text!r} is not WEST,SOUTH,EAST,NORTH") from None
    return west, south, east, north


@click.group(cls=NearestGroup)
def plot() -> None:
    """Pictures of waveforms, histograms and maps, as .png, .svg or .pdf.

    Needs matplotlib: pip install 'wavebatch[plot]'. No screen is needed; the same input gives the same bytes.
    """


@plot.command()
@click.argument("strip", type=click.Path(path_type=Path))
@_output
@click.option("--packet", "packets", multiple=True, callback=_read_numbers, metavar="N|FIRST:BEHIND",
              help="Number of a packet, from 0 on; more than once for several.  [default: six, spread over the strip]")
@click.option("--point", "points", multiple=True, type=int, metavar="N", help="The packet of a point of the file.")
@click.option("--gps-time", "times", multiple=True, type=float, metavar="T", help="The pulse nearest to a time [s].")
@click.option("--flags-with", multiple=True, metavar="NAMES",
              help="The first waveforms with an echo that has one of these flags, e.g. NOT_CONVERGED,AT_BOUND.")
@click.option("--most", type=click.IntRange(1, 24), default=6, show_default=True,
              help="Waveforms, where their number is not said.")
@click.option("--random", type=click.IntRange(1, 100), metavar="N", help="N packets at random in place of these.")
@click.option("--seed", type=click.IntRange(0), default=0, show_default=True, help="Of the random packets.")
@click.option("--sheet", is_flag=True, help="A contact sheet: up to 100 small pictures, cut to their echoes.")
@click.option("--times", "shown", callback=_read_range, metavar="LOW:HIGH",
              help="The part of the waveforms to show [ns].  [default: all]")
@click.option("-c", "--chain", "chain_file", type=click.Path(path_type=Path), metavar="FILE", help="Chain file (TOML).")
@click.option("--profile", metavar="auto|fast|balanced|accurate",
              help="A shipped chain; auto: what the strip's own survey says that it needs.  [default: auto]")
@system_option
@direction_option
@headerless_option
@overwrite_option
@quiet_option
@debug_option
@report_errors()
def waveform(strip: Path, output: Path, **options: Any) -> None:
    """Waveforms of STRIP with their fit, residual and echoes.

    Samples, baseline and noise, the fitted sum and the pulse of each echo, the residual in standard deviations of the
    noise, echoes with their errors, and where the returns of the file lie. The chain is chosen and run as `wavebatch
    run` does it. Exit code: 0, 1 where the strip cannot be read or the picture not be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.core.errors import ConfigError
    from wavebatch.files.figure_file import check_picture
    from wavebatch.tools.plots.packets import Wanted
    from wavebatch.tools.plots.values import read_flags

    if options["flags_with"] and (options["packets"] or options["points"] or options["times"]):
        raise ConfigError("--flags-with looks for waveforms itself; leave --packet, --point and --gps-time out")
    if options["random"] and (options["packets"] or options["points"] or options["times"] or options["flags_with"]):
        raise ConfigError("--random draws packets itself; leave --packet, --point, --gps-time and --flags-with out")
    check_picture(output, overwrite=options["overwrite"])
    wanted = Wanted(
        options["packets"], options["points"], options["times"], read_flags(options["flags_with"]), options["most"],
        options["random"] or 0, options["seed"], options["sheet"],
    )  # fmt: skip
    views, chain = _view(strip, wanted, options)
    from wavebatch.tools.plots.draw_sheet import draw_sheet
    from wavebatch.tools.plots.draw_waveform import draw_waveforms

    draw = draw_sheet if options["sheet"] else draw_waveforms
    draw(views, output, strip=strip.name, chain=chain, times=options["shown"], overwrite=options["overwrite"])
    if not options["quiet"]:
        talk(f"{output}: {len(views)} waveforms, {sum(len(view.echoes) for view in views)} echoes")


def _view(strip: Path, wanted: Any, options: dict[str, Any]) -> tuple[list[Any], str]:
    """The waveforms that are wanted, and the name of the chain that they were run through."""
    from wavebatch.cli.run import choose_chain
    from wavebatch.files.strip.reader import StripReader
    from wavebatch.surveying.choose_chain import make_choice
    from wavebatch.tools.plots.packets import find_places
    from wavebatch.tools.plots.waveform import read_views

    chain, request = choose_chain({**options, "tolerance": None})
    opened = StripReader(strip, direction=options["direction"], headerless=options["headerless"])
    with opened as reader, reader.scan() as scan:
        choice = make_choice(reader, scan, chain, request)
        system = choice.survey.system
        places = find_places(reader, scan, wanted, lambda block: choice.chain.run(block, system))
        return read_views(reader, scan, places, choice.chain, system), choice.chain.name


@plot.command()
@_clouds
@click.option("--column", required=True, help="An extra dimension or a standard field; echo_flags counts flags.")
@_output
@click.option("--bins", type=click.IntRange(1, 10_000), metavar="N", help="How many bins.  [default: by the spread]")
@click.option("--range", "limits", callback=_read_range, metavar="LOW:HIGH",
              help="Values to show.  [default: all but far outliers]")
@click.option("--log", is_flag=True, help="A logarithmic axis of counts.")
@click.option("--each", is_flag=True, help="A line per cloud in place of one histogram of all.")
@_with
@_without
@overwrite_option
@quiet_option
@debug_option
@report_errors()
def histogram(clouds: Sequence[Path], column: str, output: Path, **options: Any) -> None:
    """How often which values of a column occur in CLOUDs of any size.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt. Points without data are left out and counted. Bins of a
    column of whole steps hold the same number of steps each. Exit code: 0, 1 where a cloud cannot be read or the
    picture not be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.files.figure_file import check_picture
    from wavebatch.files.inputs import find_files
    from wavebatch.tools.plots.histogram import count_flags, count_values, is_flags

    check_picture(output, overwrite=options["overwrite"])
    clouds = find_files(map(str, clouds))
    selection = _select(column, options)
    how = {"log": options["log"], "overwrite": options["overwrite"]}
    if is_flags(clouds[0], column):
        _refuse_for_flags(options)
        counted = count_flags(clouds, selection)
        from wavebatch.tools.plots.draw_cloud import draw_flags

        draw_flags(counted, output, names=tuple(path.name for path in clouds), **how)
        told = f"{counted.total.values} points, {counted.clean} without a flag"
    else:
        found = count_values(
            clouds, selection, bins=options["bins"], limits=options["limits"], each=options["each"]
        )
        from wavebatch.tools.plots.draw_cloud import draw_histogram

        draw_histogram(found, output, **how)
        total = found.total
        told = f"{total.values} values, {total.no_data} without data, {total.left_out} left out by flags"
    if not options["quiet"]:
        talk(f"{output}: {told}")


def _select(column: str | None, options: dict[str, Any]) -> Any:
    from wavebatch.tools.plots.values import Selection, read_flags

    return Selection(column, read_flags(options["flags_with"]), read_flags(options["flags_without"]))


def _refuse_for_flags(options: dict[str, Any]) -> None:
    from wavebatch.core.errors import ConfigError

    for name, option in (("bins", "--bins"), ("limits", "--range"), ("each", "--each")):
        if options[name]:
            raise ConfigError(f"{option} is of no use for flags, which are counted by name")


@plot.command(name="map")
@_clouds
@click.option("--column", help="An extra dimension or a standard field; count and density need none.")
@_output
@click.option("--size", type=float, metavar="M", help="Side of a cell [m].  [default: a few points in each]")
@click.option("--statistic", type=click.Choice(["mean", "median", "min", "max", "count", "density"]), default="mean",
              show_default=True, help="Of the values in a cell; density is points per square metre.")
@click.option("--bounds", callback=_read_bounds, metavar="W,S,E,N", help="The part to show [m].  [default: all]")
@_with
@_without
@overwrite_option
@quiet_option
@debug_option
@report_errors()
def map_(clouds: Sequence[Path], column: str | None, output: Path, **options: Any) -> None:
    """A map of a column of CLOUDs of any size, over x and y.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt. Colours lie between the 2nd and the 98th percentile of
    the cells. Exit code: 0, 1 where a cloud cannot be read or the picture not be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.core.errors import ConfigError
    from wavebatch.files.figure_file import check_picture
    from wavebatch.files.inputs import find_files
    from wavebatch.tools.plots.raster import grid_values

    check_picture(output, overwrite=options["overwrite"])
    statistic = options["statistic"]
    if column is None and statistic not in ("count", "density"):
        raise ConfigError(f"--statistic {statistic} needs a --column; count and density do without")
    clouds = find_files(map(str, clouds))
    found = grid_values(
        clouds, _select(column, options), statistic, size=options["size"], bounds=options["bounds"]
    )
    from wavebatch.tools.plots.draw_cloud import draw_map

    draw_map(found, output, names=tuple(path.name for path in clouds), overwrite=options["overwrite"])
    if not options["quiet"]:
        grid, total = found.grid, found.total
        talk(f"{output}: {total.values} values, {total.no_data} without data, {found.outside} outside; "
             f"{grid.columns} x {grid.rows} cells of {grid.size:g} m")  # fmt: skip
