"""`wavebatch stats`: return numbers, separations and flags of clouds; `wavebatch grid`: their columns as a GeoTIFF.

Reads options and writes text, CSV and JSON; counting is in `wavebatch.tools.return_stats`, rasters are made in
`wavebatch.tools.raster`, which needs rasterio (extra `gis`).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click

from wavebatch.cli import options as shared
from wavebatch.cli.command import complete
from wavebatch.cli.messages import answer, talk, tell
from wavebatch.cli.plot import choose_points
from wavebatch.core.errors import InputError
from wavebatch.core.units import HALF_C, count
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.files.geojson import load_polygons
from wavebatch.files.text_file import write_text
from wavebatch.files.toml_file import describe_record
from wavebatch.tools import return_stats as returns
from wavebatch.tools.cells import doubt_clouds
from wavebatch.tools.raster import ForestOptions, GridOptions, write_grid
from wavebatch.tools.sheets.sheet import Fact, Note, Sheet, SheetPart, Table, format_csv, list_facts

EXIT_UNREADABLE = 1
"""A cloud could not be read; the others were counted."""

SHOWN_AREAS = 20
"""Areas of a cloud that are printed: about a screen; -o and --json have all of them."""

_COUNTED = ("by_number", "by_count")
"""Shares by return number, and of pulses by their number of returns."""


@click.command()
@shared.clouds_argument
@click.option("--area", "size", type=float, metavar="SIZE",
              help="Also count in square cells with sides of SIZE, in the unit of the coordinates.")
@shared.declared("polygon", "Also count in the polygons of this GeoJSON file, in WGS 84, in the CRS that the file "
                 "names, or in the coordinates of the clouds; where polygons overlap, the first one counts.")
@shared.where_option("Count only points")
@shared.output_option("Write a table with one row per cloud and area.", "FILE.csv", required=False)
@shared.common_options("overwrite", "json")
def stats(clouds: tuple[Path, ...], output: Path | None, **options: Any) -> None:
    """Count how many returns the pulses of CLOUDs have, how far apart they are, and which flags they have.

    CLOUD is a LAS or LAZ file with points in any order, a glob, a folder, or @list.txt with one of these per line. A
    pulse belongs, with all its returns, to the area of its first return. Warnings say what the dead zone and the
    largest number of returns of the sensor hide.

    Exit code: 0 done, 1 a cloud cannot be read (the others are counted), 2 wrong usage.

    Examples:
      # return numbers, separations and flags of clouds
      wavebatch stats clouds/*.laz
    """  # fmt: skip
    files, size, polygon = shared.find_inputs(clouds, options), options["size"], options["polygon"]
    divisions = [] if size is None else [returns.AreaGrid(size)]
    divisions += [] if polygon is None else [returns.PolygonSet(load_polygons(polygon))]
    failed: list[InputError] = []

    def skip(error: InputError) -> None:
        if options["debug"]:
            raise error
        failed.append(error)
        talk(f"error: {error}")

    selection = PointFilter(where=options["where"])
    each, total = returns.count_returns(files, skip, divisions=divisions, selection=selection)
    if output is not None and failed:
        talk(f"error: {output}: not written, because {count(len(failed), 'cloud')} of {len(files)} cannot be read")
    elif output is not None:
        every = [*each, total] if len(each) > 1 else each
        parts = [(one.cloud, part) for one in every for part in (one, *one.areas)]
        most = [max((max(getattr(part, name), default=0) for _, part in parts), default=0) for name in _COUNTED]
        rows = [_table_row(cloud, part, *most) for cloud, part in parts]
        write_text(output, format_csv(list(rows[0]), (row.values() for row in rows)), overwrite=options["overwrite"])
    shown = [*each, total] if len(files) > 1 else each
    document = {"files": list(map(asdict, each)), "total": asdict(total)}
    sheets = [_sheet(one) for one in shown]
    answer(document, Sheet("stats", [*sheets[0].parts, *sheets[1:]]) if sheets else None)
    sys.exit(EXIT_UNREADABLE if failed else 0)


def _sheet(found: returns.ReturnStats) -> Sheet:
    """The result of one cloud."""
    numbers = sorted({*found.by_number, *found.by_count})
    shares = [(k, found.by_number.get(k, 0.0), found.by_count.get(k, 0.0)) for k in numbers]
    apart = [(name, one.pairs, one.mean, one.least) for name, one in found.separations.items()]
    parts: list[SheetPart] = [Note(found.cloud), Fact("points", found.points)]
    each = f" (by {found.pulses_by}), {found.returns_per_pulse:.3f} returns each" if found.pulses else ""
    parts += [Fact("pulses", f"{found.pulses}{each}"), Table(("k", "return k", "k returns"), shares, ".2%")]
    if found.separations["all"].pairs:
        zones = []
        for name, one in found.dead_zones.items():
            few = one.pairs < returns.LEAST_PAIRS
            far = f"nearly all {returns.BIN * returns.BINS:g} m or more apart"
            why = f"fewer than {returns.LEAST_PAIRS} pairs" if few else far
            why = f"no-data: {why}" if math.isnan(one.size) else ""
            zones.append((name, one.pairs, one.size, one.error, one.size / HALF_C, why))
        parts += [Table(("separation", "pairs", "mean m", "least m"), apart, ".3f"),
                  Table(("dead zone", "pairs", "size m", "error m", "ns", ""), zones, (*[".2f"] * 4, ".1f", ""))]
    if found.several:
        pulses = count(found.several, "pulse")
        words = f"{found.depth:.3f} m, mean height of the first above the last return of {pulses}"
        parts.append(Fact("first to last", words))
    parts += list_facts(found)
    parts += [Fact(f"  {name}", number) for name, number in (found.flags or {}).items() if number]
    parts += [Note(words, "warning") for words in found.warnings]
    number = range(1, max((max(area.by_count) for area in found.areas), default=0) + 1)
    rows = [(area.name, area.pulses, area.returns_per_pulse, *(area.by_count.get(k, 0.0) for k in number), area.pairs,
             area.mean, area.least) for area in found.areas]  # fmt: skip
    head = ("area", "pulses", "each", *(f"{k} of pulse" for k in number), "pairs", "mean m", "least m")
    forms = ("", "", ".3f", *[".2%"] * len(number), "", ".3f", ".3f")
    return Sheet(found.cloud, [*parts, Table(head, rows, forms, shown=SHOWN_AREAS)])


def _table_row(cloud: str, part: returns.PulseStats, most_number: int, most_count: int) -> dict[str, Any]:
    """Values of a cloud or an area by column; most_...: largest return number and number of returns of the table."""
    is_area = isinstance(part, returns.AreaStats)
    place = (part.kind, part.name, part.x, part.y) if is_area else ("cloud", "", math.nan, math.nan)
    found: dict[str, Any] = dict(zip(("cloud", "kind", "area", "x", "y"), (cloud, *place), strict=True))
    found |= {"points": part.points, "pulses": part.pulses, "returns_per_pulse": part.returns_per_pulse}
    found |= {f"return_{k}": part.by_number.get(k, 0.0) for k in range(1, 1 + most_number)}
    found |= {f"pulses_with_{k}": part.by_count.get(k, 0.0) for k in range(1, 1 + most_count)}
    ends = ["", *(f"_{pair.replace('-', '_').rstrip('_')}" for pair in returns.AREA_RANKS)]
    # AREA_RANKS ends with all pairs above the third return; a cloud counts each of them, so they are added up here.
    unknown = returns.Separation(0, math.nan, math.nan)
    apart = {pair: part.separations.get(pair, unknown) for pair in returns.AREA_RANKS[:-1]}
    rest = [one for name, one in part.separations.items() if name not in (*apart, "all") and one.pairs]
    pairs, least = sum(one.pairs for one in rest), min((one.least for one in rest), default=math.nan)
    others = returns.describe_pairs(pairs, sum(one.pairs * one.mean for one in rest), least)
    every = part if is_area else part.separations["all"]
    for end, one in zip(ends, [every, *apart.values(), others], strict=True):
        found |= {f"pairs{end}": one.pairs, f"mean_m{end}": one.mean, f"least_m{end}": one.least}
    found |= describe_record(part)
    # Distances are collected per cloud only: a histogram per area would need too much memory.
    zones = {} if is_area else part.dead_zones
    for end, name in zip(ends, ("all", *returns.AREA_RANKS), strict=True):
        zone = zones.get(name, returns.DeadZone(0, math.nan, math.nan))
        found |= {f"dead_zone_m{end}": zone.size, f"dead_zone_err_m{end}": zone.error}
    return found


FEW_CELLS = 1_000_000
"""Cells of a raster up to which it may be nearly empty without a warning."""


@click.command()
@shared.clouds_argument
@click.option("--column", "columns", multiple=True, metavar="NAME", shell_complete=complete("columns"),
              help="Extra dimension or standard field; repeated: a band each. Not needed for count and density.")
@shared.options_of(GridOptions)
@click.option("--forest", is_flag=True, help="Metrics of voxels that voxelize --forest made, in place of columns: "
              "cover, heights of light, leaf area index and density, with errors.")
@shared.options_of(ForestOptions)
@shared.output_option("Raster to write: .tif.", "X.tif")
@shared.bbox_option("Write")
@shared.selection_options
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

    paths = shared.find_inputs(clouds, options)
    check_raster(output, overwrite=options["overwrite"])
    forest = shared.from_options(ForestOptions, options) if options["forest"] else None
    how = shared.from_options(GridOptions, options, columns=columns, selection=choose_points(options), forest=forest)
    found = write_grid(paths, output, how, overwrite=options["overwrite"])
    layout = found.layout
    talk(*(f"warning: {line}" for line in doubt_clouds(paths, columns)))
    if layout.crs is None:
        talk(f"warning: {output}: the clouds have no CRS, so the raster has none; give it with --crs EPSG:n")
    if found.unnamed:
        some = f"{found.unnamed[0]}" + f" and {len(found.unnamed) - 1} more" * (len(found.unnamed) > 1)
        talk(f"warning: {some}: without a CRS; taken to be in that of the other clouds; say so with --crs")
    cells = layout.columns * layout.rows
    if found.filled < cells / 1000 and cells > FEW_CELLS:
        share = f"{100 * found.filled / cells:.1g} % of the cells have a value"
        talk(f"warning: {output}: only {share}: if clouds lie far apart, make a raster of each")
    extent = f"{layout.columns} x {layout.rows} cells of {layout.size:g} {layout.unit}"
    if found.reasons:
        known, few, dark = found.reasons
        text = (
            f"{count(found.points, 'voxel')}, {found.outside} outside; {extent}: {known} with metrics, {few} with "
            f"fewer than 10 rays, {dark} without light on the ground"
        )
    else:
        used = found.points - found.left_out - found.outside
        parts = [f"{name or 'points'} {values} values, {used - values} without data"
                 for name, values in zip(columns or ("",), found.values, strict=True)]  # fmt: skip
        text = (
            f"{count(found.points, 'point')}, {found.left_out} left out, {found.outside} outside; {'; '.join(parts)}; "
            f"{extent}, {found.filled} with a value"
        )
    tell(f"{output}: {text}")
    statistic = None if forest else options["statistic"]
    used = sum(found.reasons) or found.points - found.left_out - found.outside
    names = [""] * len(found.bands) if found.reasons else columns or ("",)
    bands = [{"column": name or None, "description": band.description, "unit": band.unit, "values": values,
              "no_data": used - values}
             for name, band, values in zip(names, found.bands, found.values, strict=True)]  # fmt: skip
    east, south = layout.west + layout.columns * layout.size, layout.north - layout.rows * layout.size
    answer({"output": str(output), "clouds": [str(path) for path in paths], "statistic": statistic,
            "points": found.points, "left_out": found.left_out, "outside": found.outside, "bands": bands,
            "columns": layout.columns, "rows": layout.rows, "size": layout.size, "filled": found.filled,
            "bounds": [layout.west, south, east, layout.north], "unit": layout.unit, "crs": layout.crs,
            "no_data_value": layout.no_data})  # fmt: skip
