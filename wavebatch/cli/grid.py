"""`wavebatch grid`: columns of clouds as a GeoTIFF.

Reads options, calls `wavebatch.tools.rasters` once and prints a line. rasterio (extra `gis`) is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.messages import answer, talk, tell
from wavebatch.cli.plot import choose_points, find_clouds
from wavebatch.cli.program.command import complete_columns
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import count
from wavebatch.tools.rasters.grid import ForestOptions, GridOptions, GridResult, write_grid

FEW_CELLS = 1_000_000
"""Cells of a raster up to which it may be nearly empty without a warning."""


@click.command()
@shared.clouds_argument
@shared.declared("recursive")
@click.option("--column", "columns", multiple=True, metavar="NAME", shell_complete=complete_columns,
              help="Extra dimension or standard field; repeated: a band each. Not needed for count and density.")
@shared.options_of(GridOptions, "statistic", "size")
@click.option("--forest", is_flag=True, help="Metrics of voxels that voxelize --forest made, in place of columns: "
              "cover, heights of light, leaf area index and density, with errors.")
@shared.options_of(ForestOptions)
@shared.output_option("Raster to write: .tif.", "X.tif")
@shared.bbox_option("Write")
@shared.selection_options
@shared.options_of(GridOptions, "crs", "no_data")
@shared.common_options("overwrite", "json")
def grid(clouds: Sequence[Path], columns: tuple[str, ...], output: Path, **options: Any) -> None:
    """Write columns of CLOUDs as a GeoTIFF, of clouds of any size.

    CLOUD is a LAS or LAZ file, a glob, a folder, or @list.txt with one of these per line. The raster is tiled,
    compressed and has the CRS of the clouds, a no-data value, and name and unit of every band; it has at most 10^11
    cells. Memory does not grow; large clouds need room in TMPDIR. Needs rasterio: pip install rasterio.

    With --forest the bands are cover (the part of the light that plants catch), light_height_25, 50, 75 and 95 (the
    height below which plants caught 25 % of their light, ...), leaf_area_index, and leaf_area_density of each layer;
    cover_err and the like are standard deviations. Leaves and wood count alike. The last band, no_data_reason, says why
    a cell has no data: 1 fewer than 10 rays, 2 no light on the ground.

    Exit code: 0 done, 1 a cloud cannot be read or the raster cannot be written, 2 wrong usage.

    Examples:
      # two bands for GIS
      wavebatch grid clouds/ --column amplitude --column echo_width --statistic median --size 1 -o x.tif
      # points per square metre
      wavebatch grid clouds/ --statistic density --size 5 -o density.tif
      # without points of noise
      wavebatch grid clouds/ --column z --statistic max --where 'classification != 7' -o top.tif
    """  # fmt: skip
    from wavebatch.files.geotiff_file import check_raster

    if options["forest"] and columns:
        raise ConfigError("--forest and --column exclude each other; give one of them")
    paths = find_clouds(clouds, options)
    check_raster(output, overwrite=options["overwrite"])
    forest = shared.from_options(ForestOptions, options) if options["forest"] else None
    how = shared.from_options(GridOptions, options, columns=columns, chosen=choose_points(options), forest=forest)
    found = write_grid(paths, output, how, overwrite=options["overwrite"])
    layout = found.layout
    if layout.crs is None:
        talk(f"warning: {output}: the clouds have no CRS, so the raster has none; give it with --crs EPSG:n")
    if found.unnamed:
        some = f"{found.unnamed[0]}" + f" and {len(found.unnamed) - 1} more" * (len(found.unnamed) > 1)
        talk(f"warning: {some}: without a CRS; taken to be in that of the other clouds; say so with --crs")
    cells = layout.columns * layout.rows
    if found.filled < cells / 1000 and cells > FEW_CELLS:
        share = f"{100 * found.filled / cells:.1g} % of the cells have a value"
        talk(f"warning: {output}: only {share}: if clouds lie far apart, make a raster of each")
    tell(f"{output}: {_summarise(found, columns)}")
    statistic = None if forest else options["statistic"]
    answer({"output": str(output), "clouds": [str(path) for path in paths], "statistic": statistic,
            **_describe(found, columns)})  # fmt: skip


def _summarise(found: GridResult, columns: Sequence[str]) -> str:
    layout = found.layout
    used = found.points - found.left_out - found.outside
    if found.reasons:
        known, few, dark = found.reasons
        return (
            f"{count(found.points, 'voxel')}, {found.outside} outside; {layout.columns} x {layout.rows} cells of "
            f"{layout.size:g} {layout.unit}: {known} with metrics, {few} with fewer than 10 rays, "
            f"{dark} without light on the ground"
        )
    parts = [f"{name or 'points'} {values} values, {used - values} without data"
             for name, values in zip(columns or ("",), found.values, strict=True)]  # fmt: skip
    return (
        f"{count(found.points, 'point')}, {found.left_out} left out, {found.outside} outside; "
        f"{'; '.join(parts)}; {layout.columns} x {layout.rows} cells of {layout.size:g} {layout.unit}, {found.filled} "
        "with a value"
    )


def _describe(found: GridResult, columns: Sequence[str]) -> dict[str, Any]:
    """The raster and the counts as plain values."""
    layout = found.layout
    used = sum(found.reasons) or found.points - found.left_out - found.outside
    if found.reasons:
        columns = [""] * len(found.bands)
    bands = [{"column": name or None, "description": band.description, "unit": band.unit, "values": values,
              "no_data": used - values}
             for name, band, values in zip(columns or ("",), found.bands, found.values, strict=True)]  # fmt: skip
    east, south = layout.west + layout.columns * layout.size, layout.north - layout.rows * layout.size
    cells = {"columns": layout.columns, "rows": layout.rows, "size": layout.size, "filled": found.filled}
    return {"points": found.points, "left_out": found.left_out, "outside": found.outside, "bands": bands, **cells,
            "bounds": [layout.west, south, east, layout.north], "unit": layout.unit, "crs": layout.crs,
            "no_data_value": layout.no_data}  # fmt: skip
