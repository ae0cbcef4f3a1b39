"""`wavebatch plot`: pictures of waveforms, histograms and maps; sections and profiles are in `sections`.

Reads options, calls `wavebatch.tools.plots` and prints one line. The modules that draw are imported only after all
else has succeeded: matplotlib takes long to import and may be missing.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import NearestGroup, answer, count, print_json, tell
from wavebatch.cli.plot.sections import cube, describe_picture, describe_tally, list_tally, profile, section, select
from wavebatch.cli.program.completion import complete_columns, complete_flags
from wavebatch.core.errors import ConfigError
from wavebatch.files.disk.publish import check_target
from wavebatch.files.figure_file import check_picture
from wavebatch.files.inputs import find_files
from wavebatch.files.text_file import write_text

_SHOWN = ("detector", "asdf", "wavelet", "correlation", "deconvolved", "derivative")
_output = shared.output_option("Picture to write: .png, .svg or .pdf.")

def _read_range(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[float, ...] | None:
    if text is None:
        return None
    low, high = shared.parse_floats(text, "LOW:HIGH")
    if not low < high or high - low == float("inf"):
        raise click.BadParameter(f"{text!r} does not go up from one finite number to another")
    return low, high


def _read_times(context: click.Context, parameter: click.Parameter, text: str | None) -> tuple[float, ...] | str | None:
    return "all" if text == "all" else _read_range(context, parameter, text)


@click.group(cls=NearestGroup)
def plot() -> None:
    """Draw waveforms, histograms, maps, sections and profiles as .png, .svg or .pdf.

    Needs matplotlib: pip install matplotlib. No screen is needed; the same input gives the same bytes.
    """


@plot.command()
@shared.strip_argument
@_output
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
@click.option("--times", "shown", callback=_read_times, metavar="LOW:HIGH|all",
              help="Part of the waveforms to show [ns].  [default: the part with signal, of each waveform]")
@click.option("--show", metavar="|".join(_SHOWN), help="Also draw the signal in which the detector searches, with its "
              "threshold; detector: that of the chain's own detector.")
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
    from wavebatch.tools.plots.packets import Wanted

    named = any(options[name] for name in ("packets", "point_numbers", "times"))
    for option in ("flags", "where"):
        if options[option] and (named or options["random"]):
            raise ConfigError(f"--{option} chooses the waveforms; leave out --packet, --point, --gps-time and --random")
    if options["random"] and named:
        raise ConfigError("--random chooses the waveforms; leave out --packet, --point and --gps-time")
    if options["sheet"] and (options["show"] or options["table"]):
        raise ConfigError("--sheet has no room for --show and --echoes; leave one of them out")
    tabular = output.suffix.lower() == ".csv"
    for name, option in (("sheet", "--sheet"), ("show", "--show"), ("shown", "--times")) if tabular else ():
        if options[name]:
            raise ConfigError(f"{option} is for pictures; leave it out, or name another file than {output}")
    (check_target if tabular else check_picture)(output, overwrite=options["overwrite"])
    flags = read_flags(options["flags"])
    wanted = shared.from_options(Wanted, options, points=options["point_numbers"], flags=flags)
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
    if options["sheet"]:
        from wavebatch.tools.plots.draw_sheet import draw_sheet

        draw_sheet(views, output, times=shown, **more)
        return
    from wavebatch.tools.plots.draw_waveform import draw_waveforms

    draw_waveforms(views, output, times=shown, table=options["table"], **more)


def _view(strip: Path, wanted: Any, options: dict[str, Any], *, ranges: bool) -> tuple[list[Any], str]:
    """The waveforms that are wanted, and the chain that they were run through, in words.

    ranges: compute the distances of the echoes from the sensor, too, if its position is known.
    """
    from wavebatch.batch.options import RunOptions
    from wavebatch.files.strip.reader import StripReader
    from wavebatch.surveying.prepare import Positions, prepare
    from wavebatch.tools.api.run import find_request
    from wavebatch.tools.plots.packets import find_places
    from wavebatch.tools.plots.waveform import add_ranges, describe_chain, read_views

    chain, request = find_request(shared.from_options(RunOptions, options))
    opened = StripReader(strip, direction=options["direction"], headerless=options["headerless"])
    with opened as reader, reader.scan() as scan:
        choice = prepare(reader, scan, chain, request, positions=Positions.NONE).choice
        system = choice.survey.system
        places = find_places(reader, scan, wanted, lambda block: choice.chain.run(block, system))
        run, fill = choice.chain, None
        if ranges:
            run, fill, error = add_ranges(choice.chain, reader, scan)
            system = system.with_radiometry(sensor_error=error)
        views = read_views(reader, scan, places, run, system, options["show"], fill)
        return views, describe_chain(choice.chain)


@plot.command()
@shared.clouds_argument
@shared.declared("recursive")
@_output
@click.option("--column", "columns", required=True, multiple=True, shell_complete=complete_columns,
              help="Extra dimension or standard field; echo_flags counts flags. May be repeated: columns of one unit "
              "share an axis, others get one of their own.")
@click.option("--by", metavar="COLUMN", shell_complete=complete_columns,
              help="Draw one line per value of this column, e.g. number_of_returns or classification.")
@click.option("--bins", type=click.IntRange(1, 10_000), metavar="N", help="Number of bins.  [default: by the spread]")
@click.option("--range", "limits", callback=_read_range, metavar="LOW:HIGH",
              help="Values to show.  [default: 5 to 95 % of each line, and 1.5 times that range on both sides; what "
              "lies outside is counted]")
@click.option("--log", is_flag=True, help="Use a logarithmic axis of counts.")
@click.option("--each", is_flag=True, help="Draw one line per cloud instead of one histogram of all.")
@click.option("--counts", is_flag=True, help="Draw numbers also for several lines, not shares of each line's values.")
@shared.selection_options
@shared.common_options("overwrite", "json")
def histogram(clouds: Sequence[Path], columns: tuple[str, ...], output: Path, **options: Any) -> None:
    """Draw histograms of columns of CLOUDs of any size.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line. Points without data are left
    out and counted. For a column with discrete values, each bin holds the same number of possible values.

    Several lines (of --column, --by or --each) are drawn as shares of their values, so that they can be compared.

    Exit code: 0 done, 1 a cloud cannot be read or the picture cannot be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.tools.plots.histogram import is_flags

    clouds = find_files(map(str, clouds), recursive=options["recursive"])
    check_picture(output, overwrite=options["overwrite"])
    columns = tuple(dict.fromkeys(columns))
    if any(is_flags(clouds[0], column) for column in columns):
        text, tallies = _draw_flags(clouds, columns, output, options)
    else:
        text, tallies = _draw_histograms(clouds, columns, output, options)
    tell(f"{output}: {text}")
    if options["as_json"]:
        drawn = [{"columns": list(names), **list_tally(tally)} for names, tally in tallies.items()]
        print_json({**describe_picture(output, clouds), "drawn": drawn})


def _draw_flags(
    clouds: Sequence[Path], columns: tuple[str, ...], output: Path, options: dict[str, Any]
) -> tuple[str, dict[tuple[str, ...], Any]]:
    """Draws the counts of flags; returns a summary, and the counts by columns."""
    from wavebatch.tools.plots.histogram import count_flags

    if len(columns) > 1:
        raise ConfigError(f"flags are counted by name, not by value: draw {', '.join(columns)} one by one")
    _refuse_for_flags(options)
    counted = count_flags(clouds, select(columns[0], options))
    from wavebatch.tools.plots.draw_cloud import draw_flags

    names = tuple(path.name for path in clouds)
    draw_flags(counted, output, names=names, log=options["log"], overwrite=options["overwrite"])
    text = f"{count(counted.total.values, 'point')}, {counted.clean} without a flag"
    text += f", {counted.total.left_out} left out" * bool(counted.total.left_out)
    return text, {columns: counted.total}


def _draw_histograms(
    clouds: Sequence[Path], columns: tuple[str, ...], output: Path, options: dict[str, Any]
) -> tuple[str, dict[tuple[str, ...], Any]]:
    """Draws histograms, those of one unit in one axis; returns a summary, and the counts by columns."""
    from wavebatch.tools.plots.histogram import count_values
    from wavebatch.tools.plots.values import Clouds

    panels: dict[str, list[Any]] = {}
    for column in columns:
        selection = select(column, options)
        panels.setdefault(Clouds(clouds, selection).facts.unit, []).append(selection)
    how = {name: options[name] for name in ("bins", "limits", "each", "by")}
    if len(panels) > 1 and options["limits"]:
        raise ConfigError(f"--range is for one unit; {', '.join(columns)} are in {', '.join(panels)}")
    every = [count_values(clouds, selections, **how) for selections in panels.values()]
    from wavebatch.tools.plots.draw_cloud import draw_histograms

    how = {name: options[name] for name in ("log", "counts", "overwrite")}
    draw_histograms(every, output, **how)
    texts = [describe_tally(found.total, int(found.below.sum() + found.above.sum())) for found in every]
    names = [tuple(one.column for one in selections) for selections in panels.values()]
    return "; ".join(texts), {columns: found.total for columns, found in zip(names, every, strict=True)}


def _refuse_for_flags(options: dict[str, Any]) -> None:
    for name, option in (
        ("bins", "--bins"), ("limits", "--range"), ("each", "--each"), ("by", "--by"), ("counts", "--counts"),
    ):  # fmt: skip
        if options[name]:
            raise ConfigError(f"{option} is of no use for flags, which are counted by name")


@plot.command(name="map")
@shared.clouds_argument
@shared.declared("recursive")
@_output
@click.option("--column", shell_complete=complete_columns,
              help="Extra dimension or standard field; not needed for count and density.")
@click.option("--statistic", type=click.Choice(["mean", "median", "min", "max", "count", "density"]), default="mean",
              show_default=True, help="Statistic of the values in a cell; density is points per square metre.")
@click.option("--size", type=float, metavar="M",
              help="Side of a cell, in the unit of the coordinates.  [default: gives a few points per cell]")
@shared.bbox_option("Show")
@shared.selection_options
@shared.common_options("overwrite", "json")
def map_(clouds: Sequence[Path], column: str | None, output: Path, **options: Any) -> None:
    """Draw a map of a column of CLOUDs of any size, over x and y.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line. Colours range from the 2nd to
    the 98th percentile of the cells.

    Exit code: 0 done, 1 a cloud cannot be read or the picture cannot be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.tools.plots.raster import grid_values

    clouds = find_files(map(str, clouds), recursive=options["recursive"])
    check_picture(output, overwrite=options["overwrite"])
    statistic = options["statistic"]
    if column is None and statistic not in ("count", "density"):
        raise ConfigError(f"--statistic {statistic} needs a --column; only count and density need none")
    selection = select(column, options)
    found = grid_values(clouds, selection, statistic, size=options["size"], bounds=options["bbox"])
    from wavebatch.tools.plots.draw_cloud import draw_map

    draw_map(found, output, names=tuple(path.name for path in clouds), overwrite=options["overwrite"])
    grid = found.grid
    cells = f"{grid.columns} x {grid.rows} cells of {grid.size:g} {found.crs.unit}"
    tell(f"{output}: {describe_tally(found.total, found.outside)}; {cells}")
    if options["as_json"]:
        more = {"statistic": statistic, "outside": found.outside, "columns": grid.columns, "rows": grid.rows,
                "size": grid.size, "unit": found.crs.unit}  # fmt: skip
        print_json({**describe_picture(output, clouds), "column": column, **list_tally(found.total), **more})


plot.add_command(section)
plot.add_command(profile)
plot.add_command(cube)
