"""`wavebatch plot histogram` and `plot map`, and what all pictures of clouds share.

Reads options, calls `wavebatch.tools.plots` and prints one line.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, count, tell
from wavebatch.cli.program.completion import complete_columns
from wavebatch.core.errors import ConfigError
from wavebatch.files.figure_file import check_picture

output_option = shared.output_option("Picture to write: .png, .svg or .pdf.")


def find_clouds(clouds: Sequence[Path], options: dict[str, Any]) -> list[Path]:
    """The files that the arguments name."""
    return shared.find_inputs(clouds, recursive=options["recursive"])


def draws_clouds(
    *options_here: Callable, name: str | None = None, find: Callable[..., list[Path]] = find_clouds
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
            tell(f"{output}: {text}")
            answer({"output": str(output), "clouds": [str(path) for path in paths], **found})

        common = shared.selection_options, shared.common_options("overwrite", "json")
        every = shared.clouds_argument, shared.declared("recursive"), output_option, *options_here, *common
        return click.command(name or draw.__name__)(shared.together(*every)(command))

    return decorate


def choose_points(options: dict[str, Any]) -> Any:
    """The points that --flags, --drop-flags and --where choose."""
    from wavebatch.core.condition import read_flags
    from wavebatch.files.cloud.point_filter import PointFilter

    flags, dropped = read_flags(options["flags"]), read_flags(options["drop_flags"])
    return PointFilter(flags=flags, drop_flags=dropped, where=options["where"])


def list_tally(tally: Any) -> dict[str, int]:
    """How many points were drawn, and how many were not, for --json."""
    return {name: getattr(tally, name) for name in tally.__slots__}


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
    click.option("--column", required=True, shell_complete=complete_columns,
                 help="Extra dimension or standard field; echo_flags counts flags."),
    click.option("--by", metavar="COLUMN", shell_complete=complete_columns,
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
    """  # fmt: skip
    from wavebatch.tools.plots.histogram import count_points_by_flag, count_values
    from wavebatch.tools.plots.values import Clouds

    column, chosen = options["column"], choose_points(options)
    if Clouds(clouds, (column,), chosen).facts.is_flags:
        for name in ("bins", "limits", "each", "by", "counts"):
            if options[name]:
                option = "--range" if name == "limits" else f"--{name}"
                raise ConfigError(f"{option} is of no use for flags, which are counted by name")
        flags = count_points_by_flag(clouds, column, chosen)
        from wavebatch.tools.plots.draw_cloud import draw_flags

        draw_flags(flags, output, log=options["log"], overwrite=options["overwrite"])
        total, text = flags.total, f"{count(flags.total.values, 'point')}, {flags.clean} without a flag"
        text += f", {total.left_out} left out" * bool(total.left_out)
    else:
        how = {name: options[name] for name in ("bins", "limits", "each", "by")}
        found = count_values(clouds, column, chosen, **how)
        from wavebatch.tools.plots.draw_cloud import draw_cloud_histogram

        draw_cloud_histogram(found, output, **{name: options[name] for name in ("log", "counts", "overwrite")})
        total, text = found.total, describe_tally(found.total, int(found.below.sum() + found.above.sum()))
    return text, {"column": options["column"], **list_tally(total)}


@draws_clouds(
    click.option("--column", shell_complete=complete_columns,
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
    """  # fmt: skip
    from wavebatch.tools.plots.raster import grid_values

    column, statistic = options["column"], options["statistic"]
    found = grid_values(clouds, column, statistic, choose_points(options), size=options["size"], bounds=options["bbox"])
    from wavebatch.tools.plots.draw_cloud import draw_cloud_map

    draw_cloud_map(found, output, overwrite=options["overwrite"])
    grid = found.grid
    more = {"statistic": statistic, "outside": found.outside, "columns": grid.columns, "rows": grid.rows,
            "size": grid.size, "unit": found.crs.unit}  # fmt: skip
    cells = f"{grid.columns} x {grid.rows} cells of {grid.size:g} {found.crs.unit}"
    text = f"{describe_tally(found.total, found.outside)}; {cells}"
    return text, {"column": column, **list_tally(found.total), **more}
