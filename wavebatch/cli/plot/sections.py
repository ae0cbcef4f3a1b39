"""`wavebatch plot section`, `plot profile` and `plot cube`: side views, heights, and slices of a data cube.

Reads options, calls `wavebatch.tools.plots` and `wavebatch.tools.slices`, and prints one line.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, tell
from wavebatch.cli.plot.clouds import choose_points, describe_tally, draws_clouds, list_tally, output_option
from wavebatch.cli.program.completion import complete_columns
from wavebatch.core.errors import ConfigError
from wavebatch.files.figure_file import check_picture
from wavebatch.files.inputs import SUFFIXES


def _find(clouds: Sequence[Path], options: dict[str, Any], *, or_segments: bool = False) -> list[Path]:
    """Clouds, one file of voxels, or files of segments: these from a folder or pattern where it has no clouds."""
    from wavebatch.tools.slices.output import SEGMENT_SUFFIXES
    from wavebatch.tools.slices.read_segments import check_alone, is_segments

    kinds = (SUFFIXES, SEGMENT_SUFFIXES) if or_segments else (SUFFIXES,)
    paths = shared.find_inputs(clouds, recursive=options["recursive"], kinds=kinds)
    segments = [path for path in paths if is_segments(path)]
    voxels = [path for path in paths if path.suffix.lower() == ".npz"]
    if segments and or_segments:
        check_alone(paths, options)
    elif segments:
        raise ConfigError(f"{segments[0]}: segments have no side view; use `plot profile`, or `slice --overview`")
    if voxels and options["where"] is not None:
        raise ConfigError(f"{voxels[0]}: --where is for points; give it to `wavebatch voxelize`")
    return paths


@draws_clouds(
    shared.floats_option("--line", "X0,Y0,X1,Y1", "Ends of the section, in the coordinates of the clouds.  [default: "
                         "along the longer extent]"),
    click.option("--width", type=float, metavar="W",
                 help="Show what lies within half of W from the line.  [default: a fiftieth of its length]"),
    click.option("--column", shell_complete=complete_columns,
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
    """  # fmt: skip
    from wavebatch.tools.plots.sections import cut_section

    column = options["column"] or ("energy" if paths[0].suffix.lower() == ".npz" else "z")
    found = cut_section(paths, column, choose_points(options), line=options["line"], width=options["width"])
    from wavebatch.tools.plots.sections import draw_section

    draw_section(found, output, aspect=options["aspect"], overwrite=options["overwrite"])
    kind = "voxel" if found.voxel else "point"
    place = {"line": list(found.line), "width": found.width, "unit": found.crs.unit, "crs": found.crs.name or None}
    more = {"inside": found.inside, "drawn": len(found.value), "voxel": found.voxel or None, **place}
    text = f"{found.inside} of {describe_tally(found.total, found.outside, kind)}"
    return text, {"column": column, **list_tally(found.total), **more, "outside": found.outside}


@draws_clouds(
    click.option("--column", shell_complete=complete_columns, help="Column for --statistic sum and mean, e.g. energy."),
    click.option("--statistic", type=click.Choice(["count", "sum", "mean"]), default=None,
                 help="Of the points or voxels of a height.  [default: sum with --column, else count]"),
    click.option("--size", type=float, metavar="M", help="Height of a bin.  [default: about a sixtieth of all]"),
    click.option("--each", is_flag=True, help="Draw one line per cloud instead of one of all."),
    click.option("--log", is_flag=True, help="Use a logarithmic axis of values."),
    find=functools.partial(_find, or_segments=True),
)  # fmt: skip
def profile(paths: Sequence[Path], output: Path, options: dict[str, Any]) -> tuple[str, dict[str, Any]]:
    """Draw how many points, or how much of a column, of CLOUDs, voxels or segments lie at each height.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line; or one .npz of `wavebatch
    voxelize`; or .csv or .geojson files of `wavebatch slice` (a folder gives these where it has no clouds), whose
    segments count in each bin by the share of their height there (columns: length, slope, residual, pulses, weight).
    Heights are those of the coordinates, not above ground. Far outliers in height are left out and counted.

    Exit code: 0 done, 1 a cloud cannot be read or the picture cannot be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.tools.plots.sections import measure_profile
    from wavebatch.tools.slices.read_segments import is_segments, profile_segments

    column = options["column"]
    statistic = options["statistic"] or ("count" if column is None else "sum")
    how = {"size": options["size"], "each": options["each"]}
    if segments := is_segments(paths[0]):
        found = profile_segments(paths, column, statistic, **how)
    else:
        found = measure_profile(paths, column, statistic, choose_points(options), **how)
    from wavebatch.tools.plots.sections import draw_profile

    draw_profile(found, output, log=options["log"], overwrite=options["overwrite"])
    series = [{"name": name, "values": row} for name, row in zip(found.names, found.values.tolist(), strict=True)]
    more = {"statistic": statistic, "outside": found.outside, "edges": found.edges.tolist(), "series": series}
    text = describe_tally(found.total, found.outside, "segment" if segments else "value")
    return text, {"column": column, **list_tally(found.total), **more, "unit": found.unit}


@click.command()
@click.argument("cube_file", type=shared.INPUT, metavar="CUBE.npz")
@output_option
@click.option("--x", type=click.IntRange(0), metavar="N", help="Slice across the lines at pulse N of each.")
@click.option("--y", type=click.IntRange(0), metavar="N", help="Slice along scan line N.")
@click.option("--t", type=float, metavar="NS", help="Slice of all pulses at one time [ns].")
@shared.common_options("overwrite", "json")
def cube(cube_file: Path, output: Path, **options: Any) -> None:
    """Draw slices of a data cube of `wavebatch slice --cube`: x (pulse), y (scan line) and t (time).

    Each given option adds a slice; without any, the middle ones are drawn, and the time with the most signal.

    Exit code: 0 done, 1 the cube cannot be read or the picture cannot be written, 2 wrong usage.
    """  # fmt: skip
    from wavebatch.tools.slices.cube import cut_cube

    check_picture(output, overwrite=options["overwrite"])
    slices = cut_cube(cube_file, {name: options[name] for name in "xyt"})
    from wavebatch.tools.slices.draw import draw_cube

    draw_cube(slices, output, name=cube_file.name, overwrite=options["overwrite"])
    tell(f"{output}: {', '.join(one.title for one in slices)}")
    drawn = [{"title": one.title, "rows": one.image.shape[0], "columns": one.image.shape[1],
              "extent": list(one.extent), "across": one.across, "up": one.up} for one in slices]  # fmt: skip
    answer({"output": str(output), "cube": str(cube_file), "slices": drawn})
