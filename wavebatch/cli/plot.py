"""`wavebatch plot`: pictures of waveforms, histograms, maps, side views, heights, and slices of a data cube.

Reads options, calls `wavebatch.tools.plots` and prints one line.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.command import complete
from wavebatch.cli.messages import NearestGroup, answer, talk, tell
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import count
from wavebatch.files.figure_file import check_picture
from wavebatch.files.text_file import SUFFIXES, write_text

output_option = shared.output_option("Picture to write: .png, .svg or .pdf.")


def draws_clouds(
    *options_here: Callable, name: str | None = None, find: Callable[..., list[Path]] = shared.find_inputs
) -> Callable[[Callable[..., tuple[str, dict[str, Any]]]], click.Command]:
    """A command that draws clouds: with its options, and those that all such commands share.

    The function gets paths, picture and options, and gives what is printed and what --json adds. find: gives the paths
    from arguments and options.
    """

    def decorate(draw: Callable[..., tuple[str, dict[str, Any]]]) -> click.Command:
        @functools.wraps(draw)
        def command(clouds: Sequence[Path], output: Path, **options: Any) -> None:
            paths = find(clouds, options)
            check_picture(output, overwrite=options["overwrite"])
            text, found = draw(paths, output, options)
            from wavebatch.tools.cells import doubt_clouds

            # Of several lines each is of one cloud; segments and voxels have no counts.
            columns = [options["column"]] if options.get("column") and not options.get("each") else []
            talk(*(f"warning: {line}" for line in doubt_clouds(paths, columns)))
            tell(f"{output}: {text}")
            answer({"output": str(output), "clouds": [str(path) for path in paths], **found})

        common = shared.selection_options, shared.common_options("overwrite", "json")
        every = shared.clouds_argument, output_option, *options_here, *common
        return click.command(name or draw.__name__)(shared.together(*every)(command))

    return decorate


def choose_points(options: dict[str, Any]) -> Any:
    """The points that --flags, --drop-flags and --where choose."""
    from wavebatch.core.condition import read_flags
    from wavebatch.files.cloud.point_filter import PointFilter

    flags, dropped = read_flags(options["flags"]), read_flags(options["drop_flags"])
    return PointFilter(flags=flags, drop_flags=dropped, where=options["where"])


def describe_tally(tally: Any, outside: int, kind: str = "value") -> str:
    """How many points were drawn, and how many were not, for people."""
    left_out = f", {tally.left_out} left out" * bool(tally.left_out)
    return f"{count(tally.values, kind)}, {tally.no_data} without data{left_out}, {outside} outside the picture"


def read_range(text: str) -> tuple[float, ...]:
    """Two finite numbers that go up."""
    low, high = shared.parse_floats(text, "LOW:HIGH")
    if not low < high or high - low == float("inf"):
        raise click.BadParameter(f"{text!r} does not go up from one finite number to another")
    return low, high


@draws_clouds(
    click.option("--column", required=True, metavar="NAME", shell_complete=complete("columns"),
                 help="Extra dimension or standard field; echo_flags counts flags."),
    click.option("--by", metavar="COLUMN", shell_complete=complete("columns"),
                 help="Draw one line per value of this column, e.g. number_of_returns or classification."),
    click.option("--bins", type=click.IntRange(1, 10_000), metavar="N",
                 help="Number of bins.  [default: by the spread]"),
    click.option("--range", "limits", type=shared.Text("LOW:HIGH", read_range), metavar="LOW:HIGH",
                 help="Values to show.  [default: 5 to 95 % of each line, and 1.5 times that range on both sides; what "
                 "lies outside is counted]"),
    click.option("--log", is_flag=True, help="Use a logarithmic axis of counts."),
    click.option("--each", is_flag=True, help="Draw one line per cloud instead of one histogram of all."),
    click.option("--counts", is_flag=True,
                 help="Draw numbers also for several lines, not shares of each line's values."),
)  # fmt: skip
def histogram(clouds: Sequence[Path], output: Path, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Draw the histogram of a column of CLOUDs of any size.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line. Points without data are left
    out and counted. For a column with discrete values, each bin holds the same number of possible values.

    Several lines (of --by or --each) are drawn as shares of their values, so that they can be compared.

    Exit code: 0 done, 1 a cloud cannot be read or the picture cannot be written, 2 wrong usage.

    Examples:
      # ground only
      wavebatch plot histogram clouds/*.laz --column z --where "classification == 2" -o ground.png
      # widths of all clouds
      wavebatch plot histogram clouds/*.laz --column echo_width -o widths.png
    """  # fmt: skip
    from wavebatch.tools.cells import Clouds
    from wavebatch.tools.plots import draw_cloud

    column, selection = options["column"], choose_points(options)
    if Clouds(clouds, (column,), selection).facts.is_flags:
        for name in ("bins", "limits", "each", "by", "counts"):
            if options[name]:
                option = "--range" if name == "limits" else f"--{name}"
                raise ConfigError(f"{option} is of no use for flags, which are counted by name")
        flags = draw_cloud.count_points_by_flag(clouds, column, selection)
        draw_cloud.draw_flags(flags, output, log=options["log"], overwrite=options["overwrite"])
        names, rows, edges = flags.names, flags.counts.reshape(-1, 1), ()
        total, outside, text = flags.total, 0, f"{count(flags.total.values, 'point')}, {flags.clean} without a flag"
        text += f", {total.left_out} left out" * bool(total.left_out)
    else:
        how = {name: options[name] for name in ("bins", "limits", "each", "by")}
        found = draw_cloud.count_values(clouds, column, selection, **how)
        look = {name: options[name] for name in ("log", "counts", "overwrite")}
        draw_cloud.draw_cloud_histogram(found, output, **look)
        names, rows, edges = found.names, found.counts, found.edges.tolist()
        total, outside = found.total, int(found.below.sum() + found.above.sum())
        text = describe_tally(total, outside)
    series = [{"name": name, "values": row} for name, row in zip(names, rows.tolist(), strict=True)]
    return text, {"column": options["column"], **asdict(total), "outside": outside, "edges": edges, "series": series}


@draws_clouds(
    click.option("--column", metavar="NAME", shell_complete=complete("columns"),
                 help="Extra dimension or standard field; not needed for count and density."),
    click.option("--statistic", type=click.Choice(["mean", "median", "min", "max", "count", "density"]),
                 default="mean", show_default=True,
                 help="Statistic of the values in a cell; density is points per square metre."),
    click.option("--size", type=float, metavar="M",
                 help="Side of a cell, in the unit of the coordinates.  [default: gives a few points per cell]"),
    shared.bbox_option("Show"), name="map",
)  # fmt: skip
def map_(clouds: Sequence[Path], output: Path, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Draw a map of a column of CLOUDs of any size, over x and y.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line. Colours range from the 2nd to
    the 98th percentile of the cells.

    Exit code: 0 done, 1 a cloud cannot be read or the picture cannot be written, 2 wrong usage.

    Examples:
      # mean amplitude in cells of 1 m
      wavebatch plot map clouds/ --column amplitude --size 1 -o map.png
    """  # fmt: skip
    from wavebatch.tools.cells import grid_values

    column, statistic = options["column"], options["statistic"]
    found = grid_values(clouds, column, statistic, choose_points(options), size=options["size"], bounds=options["bbox"])
    from wavebatch.tools.plots.draw_cloud import draw_cloud_map

    draw_cloud_map(found, output, overwrite=options["overwrite"])
    grid = found.grid
    more = {"statistic": statistic, "outside": found.outside, "columns": grid.columns, "rows": grid.rows,
            "size": grid.size, "unit": found.crs.unit}  # fmt: skip
    cells = f"{grid.columns} x {grid.rows} cells of {grid.size:g} {found.crs.unit}"
    text = f"{describe_tally(found.total, found.outside)}; {cells}"
    return text, {"column": column, **asdict(found.total), **more}


def _find(clouds: Sequence[Path], options: dict[str, Any], *, or_segments: bool = False) -> list[Path]:
    """Clouds, one file of voxels, or files of segments: these from a folder or pattern where it has no clouds."""
    from wavebatch.tools.slice_output import SEGMENT_SUFFIXES, is_segments

    kinds = (SUFFIXES, SEGMENT_SUFFIXES) if or_segments else (SUFFIXES,)
    paths = shared.find_inputs(clouds, options, kinds=kinds)
    segments = [path for path in paths if is_segments(path)]
    voxels = [path for path in paths if path.suffix.lower() == ".npz"]
    if segments and not or_segments:
        raise ConfigError(f"{segments[0]}: segments have no side view; use `plot profile`, or `slice --overview`")
    if segments and len(segments) < len(paths):
        others = [path for path in paths if not is_segments(path)]
        raise ConfigError(f"{others[0]}: segments are drawn without clouds; draw these in another picture")
    for name in ("flags", "drop_flags", "where") if segments else ():
        if options[name]:
            raise ConfigError(f"{segments[0]}: --{name.replace('_', '-')} selects points; segments have none")
    if voxels and options["where"] is not None:
        raise ConfigError(f"{voxels[0]}: --where is for points; give it to `wavebatch voxelize`")
    return paths


_ENDS = "X0,Y0,X1,Y1"


@draws_clouds(
    click.option("--line", type=shared.Text(_ENDS, lambda text: shared.parse_floats(text, _ENDS)), metavar=_ENDS,
                 help="Ends of the section, in the coordinates of the clouds.  [default: along the longer extent]"),
    click.option("--width", type=float, metavar="W",
                 help="Show what lies within half of W from the line.  [default: a fiftieth of its length]"),
    click.option("--column", metavar="NAME", shell_complete=complete("columns"),
                 help="Column for the colours.  [default: z; energy for voxels]"),
    click.option("--aspect", type=click.FloatRange(0.01, 1000.0), default=1.0, show_default=True, metavar="F",
                 help="Exaggerate heights F times."),
    find=_find,
)  # fmt: skip
def section(paths: Sequence[Path], output: Path, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Draw a side view of CLOUDs or voxels along a line.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line; or one .npz of `wavebatch
    voxelize`. Scales are equal without --aspect. Of more than 200,000 points an even sample is drawn. The few points
    that lie far above or below all others are left out and counted as outside.

    Exit code: 0 done, 1 a cloud cannot be read or the picture cannot be written, 2 wrong usage.

    Examples:
      # 2 m wide, along the longer extent
      wavebatch plot section clouds/ --width 2 --column echo_width -o side.png
    """  # fmt: skip
    from wavebatch.tools.plots.sections import cut_section, draw_section

    column = options["column"] or ("energy" if paths[0].suffix.lower() == ".npz" else "z")
    found = cut_section(paths, column, choose_points(options), line=options["line"], width=options["width"])
    draw_section(found, output, aspect=options["aspect"], overwrite=options["overwrite"])
    kind = "voxel" if found.voxel else "point"
    place = {"line": list(found.line), "width": found.width, "unit": found.crs.unit, "crs": found.crs.name or None}
    more = {"inside": found.inside, "drawn": len(found.value), "voxel": found.voxel or None, **place}
    text = f"{found.inside} of {describe_tally(found.total, found.outside, kind)}"
    return text, {"column": column, **asdict(found.total), **more, "outside": found.outside}


@draws_clouds(
    click.option("--column", metavar="NAME", shell_complete=complete("columns"),
                 help="Column for --statistic sum and mean, e.g. energy."),
    click.option("--statistic", type=click.Choice(["count", "sum", "mean"]), default=None,
                 help="Of the points or voxels of a height.  [default: sum with --column, else count]"),
    click.option("--size", type=float, metavar="M", help="Height of a bin.  [default: about a sixtieth of all]"),
    click.option("--each", is_flag=True, help="Draw one line per cloud instead of one of all."),
    click.option("--log", is_flag=True, help="Use a logarithmic axis of values."),
    find=functools.partial(_find, or_segments=True),
)  # fmt: skip
def profile(paths: Sequence[Path], output: Path, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Draw points, voxels or segments, or a column, by height.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line; or one .npz of `wavebatch
    voxelize`; or .csv or .geojson files of `wavebatch slice` (a folder gives these where it has no clouds), whose
    segments count in each bin by the share of their height there (columns: length, slope, residual, pulses, weight).
    Heights are those of the coordinates, not above ground. Far outliers in height are left out and counted.

    Exit code: 0 done, 1 a cloud cannot be read or the picture cannot be written, 2 wrong usage.

    Examples:
      # energy by height
      wavebatch plot profile voxels.npz --column energy -o heights.png
      # length of surface lines by height
      wavebatch plot profile lines.csv --column length -o lines.png
    """  # fmt: skip
    from wavebatch.tools.plots.sections import draw_profile, measure_profile

    column = options["column"]
    statistic = options["statistic"] or ("count" if column is None else "sum")
    how = {"size": options["size"], "each": options["each"]}
    found = measure_profile(paths, column, statistic, choose_points(options), **how)
    draw_profile(found, output, log=options["log"], overwrite=options["overwrite"])
    series = [{"name": name, "values": row} for name, row in zip(found.names, found.values.tolist(), strict=True)]
    more = {"statistic": statistic, "outside": found.outside, "edges": found.edges.tolist(), "series": series}
    text = describe_tally(found.total, found.outside, found.noun.removesuffix("s"))
    return text, {"column": column, **asdict(found.total), **more, "unit": found.unit}


@click.command()
@click.argument("cube_file", type=shared.INPUT, metavar="CUBE.npz")
@output_option
@click.option("--x", type=click.IntRange(0), metavar="N", help="Slice across the lines at pulse N of each.")
@click.option("--y", type=click.IntRange(0), metavar="N", help="Slice along scan line N.")
@click.option("--t", type=float, metavar="NS", help="Slice of all pulses at one time [ns].")
@shared.common_options("overwrite", "json")
def cube(cube_file: Path, output: Path, **options: Any) -> None:
    """Draw slices of a data cube of `wavebatch slice --cube`.

    A cube has the axes x (pulse), y (scan line) and t (time). Each given option adds a slice; without any, the middle
    ones are drawn, and the time with the most signal.

    Exit code: 0 done, 1 the cube cannot be read or the picture cannot be written, 2 wrong usage.

    Examples:
      # scan line 3, and all pulses at 250 ns
      wavebatch plot cube cube.npz --y 3 --t 250 -o slices.png
    """  # fmt: skip
    from wavebatch.tools.slice_output import cut_cube, draw_cube

    check_picture(output, overwrite=options["overwrite"])
    slices = cut_cube(cube_file, {name: options[name] for name in "xyt"})
    draw_cube(slices, output, name=cube_file.name, overwrite=options["overwrite"])
    tell(f"{output}: {', '.join(one.title for one in slices)}")
    drawn = [{"title": one.title, "rows": one.image.shape[0], "columns": one.image.shape[1],
              "extent": list(one.extent), "across": one.across, "up": one.up} for one in slices]  # fmt: skip
    answer({"output": str(output), "cube": str(cube_file), "slices": drawn})


_SHOWN = ("detector", "asdf", "correlation", "deconvolved", "derivative", "wavelet")


@click.group(cls=NearestGroup)
def plot() -> None:
    """Draw waveforms, histograms, maps, sections and profiles as .png, .svg or .pdf.

    Needs matplotlib: pip install matplotlib. No screen is needed; the same input gives the same bytes.
    """


@plot.command()
@shared.strip_argument
@shared.output_option("Picture to write: .png, .svg or .pdf; or a table of the echoes: .csv.")
@click.option("--packet", "packets", multiple=True, metavar="N|FIRST:END",
              callback=lambda context, parameter, texts: tuple(map(shared.parse_span, texts)),
              help="Draw these packets, counted from 0; END is not included; may be repeated.  [default: six, spread "
              "over the strip]")
@click.option("--point", "point_numbers", multiple=True, type=int, metavar="N",
              help="Draw the packet of this point, counted from 0; may be repeated.")
@click.option("--gps-time", "times", multiple=True, type=float, metavar="T",
              help="Draw the pulse nearest to this GPS time [s]; may be repeated.")
@click.option("--flags", multiple=True, metavar="NAMES", shell_complete=complete("flags"),
              help="Draw the first waveforms with an echo that has one of these flags, e.g. NOT_CONVERGED,AT_BOUND.")
@shared.where_option("Draw the first waveforms with echoes")
@click.option("--most", type=click.IntRange(1, 100), metavar="N",
              help="Most waveforms of --flags, --where or of the default.  [default: 6; with --sheet: 100]")
@click.option("--random", type=click.IntRange(1, 100), metavar="N", help="Draw N random packets.")
@shared.seed_option("Seed of the random packets.")
@click.option("--sheet", is_flag=True, help="Draw a contact sheet: up to 100 small pictures, cut to their echoes.")
@click.option("--times", "shown", metavar="LOW:HIGH|all",
              type=shared.Text("LOW:HIGH|all", lambda text: text if text == "all" else read_range(text)),
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
    """Draw waveforms of STRIP with their fit, or write their echoes.

    Shows samples, baseline and noise, the fitted sum, the pulse of each echo, the residual in standard deviations of
    the noise, echoes with their errors, and the returns of the file. The chain is chosen and run as by `wavebatch run`.

    Exit code: 0 done, 1 the strip cannot be read or the picture cannot be written, 2 wrong usage.

    Examples:
      # six waveforms, spread over the strip
      wavebatch plot waveform strip.las -o fits.png
      # fits to look at
      wavebatch plot waveform strip.las -o bad.svg --flags NOT_CONVERGED,AT_BOUND
      # a sheet of 100 random waveforms
      wavebatch plot waveform strip.las -o sheet.png --random 100 --sheet
    """  # fmt: skip
    from wavebatch.batch.options import RunOptions
    from wavebatch.core.condition import read_flags
    from wavebatch.files.cloud.point_filter import PointFilter
    from wavebatch.files.strip.reader import StripReader
    from wavebatch.surveying.prepare import Positions, prepare
    from wavebatch.tools.api import find_request
    from wavebatch.tools.cells import doubt_clouds
    from wavebatch.tools.plots.waveform import Wanted, add_ranges, describe_step, find_places, format_echoes, read_views

    tabular = output.suffix.lower() == ".csv"
    for key, option in (("sheet", "--sheet"), ("show", "--show"), ("shown", "--times")) if tabular else ():
        if options[key]:
            raise ConfigError(f"{option} is for pictures; leave it out, or name another file than {output}")
    if not tabular:
        check_picture(output, overwrite=options["overwrite"])
    selection = PointFilter(flags=read_flags(options["flags"]), where=options["where"])
    wanted = shared.from_options(Wanted, options, points=options["point_numbers"], selection=selection)
    # The waveforms, and the chain that they are run through.
    chain, request = find_request(shared.from_options(RunOptions, options))
    opened = StripReader(strip, direction=options["direction"], headerless=options["headerless"])
    with opened as reader, reader.scan(force=options["force"]) as scan:
        setup = prepare(reader, scan, chain, request, positions=Positions.NONE)
        choice, system = setup.choice, setup.system  # which knows how exactly returns were placed, as that of a run
        places = find_places(reader, scan, wanted, lambda block: choice.chain.run(block, system))
        run, fill = choice.chain, None
        if tabular or options["table"]:  # the distances of the echoes from the sensor, too, if its position is known
            run, fill, error = add_ranges(choice.chain, reader, scan)
            system = system.with_radiometry(sensor_error=error)
        views = read_views(reader, scan, places, run, system, options["show"], fill)
    detector, decomposer = map(describe_step, choice.chain.steps[1:3])
    name = f"{choice.chain.name.removeprefix('profile ') or 'chain'}: {detector}, {decomposer}"
    if tabular:
        write_text(output, format_echoes(views), overwrite=options["overwrite"])
    else:
        from wavebatch.tools.plots.draw_waveform import draw_waveform_panels, draw_waveform_sheet

        shown, more = options["shown"], {"strip": strip.name, "chain": name, "overwrite": options["overwrite"]}
        if shown == "all":
            last = max(float(view.time[-1] + 0.5 * view.spacing) for view in views)
            shown = (min(-0.5 * view.spacing for view in views), last)
        if shown and all(view.time[-1] < shown[0] or shown[1] < 0 for view in views):
            end = max(view.time[-1] for view in views)
            span = f"{shown[0]:g}:{shown[1]:g}"
            raise ConfigError(f"--times {span}: no sample lies there; the waveforms end at {end:g} ns")
        if options["sheet"]:
            draw_waveform_sheet(views, output, times=shown, **more)
        else:
            draw_waveform_panels(views, output, times=shown, table=options["table"], **more)
    talk(*(f"warning: {line}" for line in doubt_clouds([strip])))
    echoes = sum(len(view.echoes) for view in views)
    tell(f"{output}: {count(len(views), 'waveform')}, {count(echoes, 'echo')}")
    answer({"output": str(output), "chain": name, "waveforms": len(views), "echoes": echoes})


for command in (histogram, map_, section, profile, cube):
    plot.add_command(command)
