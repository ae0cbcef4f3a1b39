"""`wavebatch grid`: every cell equals a plain count, in bounded memory; GDAL reads place, CRS, units and no-data."""

import json
import os
import subprocess
import sys

import laspy
import numpy as np
import pytest
import rasterio
from commands import run_command, succeed
from strips import place_header
from writer_tools import write_points

from wavebatch.files.las.crs import read_crs_definition
from wavebatch.files.las.header import read_header
from wavebatch.tools.cells import compute_cells, grid_values

pytestmark = pytest.mark.filterwarnings("ignore:Use `@` matmul:PendingDeprecationWarning")  # inside rasterio

UTM = (
    'PROJCS["WGS 84 / UTM zone 33N",GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["metre",1],AUTHORITY["EPSG","32633"]]'
)


def _cloud(path, rng, n=4000, *, wkt=UTM, west=500_000.0, south=5_400_000.0, epsg=None):
    """A cloud over 700 m x 300 m; a tenth of the heights have no data."""
    vlrs = [laspy.vlrs.known.WktCoordinateSystemVlr(wkt)] if wkt else []
    if epsg:
        keys = np.array([1, 1, 0, 2, 1024, 0, 1, 1, 3072, 0, 1, epsg], "<u2").tobytes()
        vlrs.append(laspy.VLR("LASF_Projection", 34735, "", keys))
    xyz = np.stack([west + rng.uniform(0, 700, n), south + rng.uniform(0, 300, n), np.zeros(n)], axis=1)
    values = rng.normal(10, 3, n).astype(np.float32)
    values[::10] = -9999
    extra = [("height", "f4", -9999.0, None, "over ground [m]")]
    las = write_points(path, xyz, offsets=(west, 5_400_000.0, 0.0), extra=extra, vlrs=vlrs,
                       gps_time=1e9 + np.arange(n) * 1e-5, height=values)  # fmt: skip
    return np.asarray(las.x), np.asarray(las.y), np.where(values == -9999, np.nan, values.astype(np.float64))


def _run(*arguments, code=0):
    result = run_command("grid", *arguments)
    assert result.exit_code == code, (result.stderr, result.exception)
    return result


def _naive(statistic, values, area):
    values = values[~np.isnan(values)]
    if not len(values) or statistic == "std" and len(values) < 2:
        return np.nan
    if statistic in ("count", "density"):
        return len(values) / (area if statistic == "density" else 1)
    return np.std(values, ddof=1) if statistic == "std" else getattr(np, statistic)(values)


@pytest.mark.parametrize("statistic", ["mean", "median", "min", "max", "std", "count", "density"])
def test_every_statistic_equals_its_definition(rng, statistic):
    cell, values = rng.integers(0, 50, 300), rng.normal(1e6, 1, 300)
    values[rng.random(300) < 0.2] = np.nan
    found = compute_cells(statistic, cell, values, 60, 4.0)
    np.testing.assert_allclose(found, [_naive(statistic, values[cell == n], 4.0) for n in range(60)], rtol=1e-9)


def test_the_epsg_code_of_geotiff_keys_and_wkt_is_found(rng, tmp_path):
    for name, given, wanted in (("k.las", {"wkt": None, "epsg": 25832}, "EPSG:25832"), ("w.las", {}, UTM),
                                ("n.las", {"wkt": None}, None)):  # fmt: skip
        _cloud(tmp_path / name, rng, 10, **given)
        assert read_crs_definition(tmp_path / name, read_header(tmp_path / name)) == wanted


@pytest.mark.parametrize("statistic", ["median", "mean", "max", "count"])
def test_cells_are_those_of_a_plain_count(rng, tmp_path, statistic):
    x, y, height = _cloud(tmp_path / "a.las", rng)
    result = _run(tmp_path / "a.las", "--column", "height", "--column", "gps_time", "--statistic", statistic,
                  "--size", 2, "-o", tmp_path / "x.tif")  # fmt: skip
    assert "4000 points" in result.stderr and "height 3600 values, 400 without data" in result.stderr
    with rasterio.open(tmp_path / "x.tif") as found:
        assert found.crs.to_epsg() == 32633 and found.nodata == -9999
        assert found.block_shapes == [(256, 256)] * 2
        assert found.descriptions == (f"{statistic} of height", f"{statistic} of gps_time")
        assert found.units == (("", "") if statistic == "count" else ("m", "s")) or found.units == (None, None)
        raster = found.read(1, masked=True).filled(np.nan)
        rows, columns = rasterio.transform.rowcol(found.transform, x, y)
        if statistic != "count":
            assert found.dtypes[1] == "float64" and abs(found.read(2, masked=True).max() - 1e9) < 1
    rows, columns = np.array(rows, int), np.array(columns, int)
    for place in {*zip(rows[:300].tolist(), columns[:300].tolist(), strict=True)}:
        inside = (rows == place[0]) & (columns == place[1])
        np.testing.assert_allclose(raster[place], _naive(statistic, height[inside], 4), rtol=1e-6)
    filled = {*zip(rows[~np.isnan(height)].tolist(), columns[~np.isnan(height)].tolist(), strict=True)}
    assert np.isfinite(raster).sum() == len(filled)


@pytest.mark.parametrize(("held", "size"), [(64, 0.5), (64, 5000.0), (3000, 0.5)])
def test_tiles_do_not_depend_on_the_points_in_memory(rng, tmp_path, held, size):
    """64: more buckets than tiles, and buckets that do not fit, tile by tile in groups of cells."""
    _cloud(tmp_path / "a.las", rng)
    for statistic in ("median", "mean", "max", "count"):
        whole, parts = (grid_values([tmp_path / "a.las"], "height", statistic, size=size, in_memory=most).values
                        for most in (2_000_000, held))  # fmt: skip
        np.testing.assert_array_equal(parts, whole)


def test_rasters_of_neighbours_and_bounds_fit_the_same_grid(rng, tmp_path):
    x, _, _ = _cloud(tmp_path / "a.las", rng)
    _run(tmp_path / "a.las", "--statistic", "count", "--size", 7, "--bbox", "500100,5400100,500200.5,5400150", "-o",
         tmp_path / "x.tif")  # fmt: skip
    with rasterio.open(tmp_path / "x.tif") as found:
        assert all(abs(edge / 7 - round(edge / 7)) < 1e-9 for edge in found.bounds)
        assert found.bounds.left <= 500_100 and found.bounds.right >= 500_200.5
        west, east = found.bounds.left, found.bounds.right
        part = found.read(1, masked=True).sum()
    _run(tmp_path / "a.las", "--column", "y", "--size", 7, "-o", tmp_path / "z.tif")
    with rasterio.open(tmp_path / "z.tif") as found:
        assert found.dtypes == ("float64",), "float32 holds half metres of a northing"
    _run(tmp_path / "a.las", "--statistic", "count", "--size", 7, "-o", tmp_path / "y.tif")
    with rasterio.open(tmp_path / "y.tif") as found:
        whole = found.read(1, masked=True)
        assert whole.sum() == len(x)
        window = rasterio.windows.from_bounds(west, 5_400_094, east, 5_400_150, found.transform).round()
        assert found.read(1, window=window, masked=True).sum() >= part > 0


def test_a_point_on_the_border_of_two_boxes_is_in_one_of_them(tmp_path):
    write_points(tmp_path / "a.las", np.array([[x, y, 0.0] for x in (10.0, 20.0, 30.0) for y in (5.0, 6.0, 7.0)]))
    counts = []
    for number, box in enumerate(("10,5,20,7", "20,5,30,7", "10,7,20,8")):
        path = tmp_path / f"{number}.tif"
        _run(tmp_path / "a.las", "--statistic", "count", "--size", 1, "--bbox", box, "-o", path)
        with rasterio.open(path) as found:
            counts.append(found.read(1, masked=True).sum())
    assert counts == [2, 2, 1]
    for box in ("11,5,20,8", "10,2,30,5"):  # all points lie on its eastern, or northern, border
        done = _run(tmp_path / "a.las", "--statistic", "count", "--size", 1, "--bbox", box, "-o",
                    tmp_path / "x.tif", code=1)  # fmt: skip
        assert "no point has a position within --bbox" in done.stderr


def test_clouds_far_apart_take_little_room_and_a_damaged_coordinate_is_refused(rng, tmp_path):
    _cloud(tmp_path / "a.las", rng, 500)
    _cloud(tmp_path / "b.las", rng, 500, west=600_000.0)
    result = _run(tmp_path / "*.las", "--statistic", "density", "-o", tmp_path / "x.tif")
    assert "of the cells have a value: if clouds lie far apart, make a raster of each" in result.stderr
    assert (tmp_path / "x.tif").stat().st_size < 1_000_000
    with rasterio.open(tmp_path / "x.tif") as found:
        assert found.width > 100_000 and found.units == ("1/m2",)
    result = _run(tmp_path / "*.las", "--statistic", "count", "--size", 1e-4, "-o", tmp_path / "y.tif", code=2)
    assert "are too many" in result.stderr
    _cloud(tmp_path / "c.las", rng, 500, west=900_000.0, south=5_900_000.0)
    result = _run(tmp_path / "*.las", "--statistic", "count", "-o", tmp_path / "y.tif", code=2)
    assert "are too many (at most 1e+11)" in result.stderr and "points lie from 50000" in result.stderr


def test_a_cloud_without_a_crs_beside_others_is_named(rng, tmp_path):
    _cloud(tmp_path / "a.las", rng, 500)
    _cloud(tmp_path / "b.las", rng, 500, wkt=None)
    result = _run(tmp_path / "*.las", "--statistic", "count", "-o", tmp_path / "x.tif")
    assert f"warning: {tmp_path / 'b.las'}: without a CRS; taken to be in that of the other clouds" in result.stderr
    result = _run(tmp_path / "*.las", "--statistic", "count", "--crs", "EPSG:32632", "-o", tmp_path / "y.tif")
    assert "without a CRS" not in result.stderr


@pytest.mark.parametrize("degree", ["1e308", "0"])
def test_a_crs_that_gdal_reads_but_cannot_write_is_one_line(rng, tmp_path, degree):
    _cloud(tmp_path / "a.las", rng, 50, wkt=UTM.replace("0.0174532925199433", degree))
    result = _run(tmp_path / "a.las", "--statistic", "count", "-o", tmp_path / "x.tif", code=2)
    assert "the CRS cannot be" in result.stderr and result.stderr.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["a.las"]


def test_clouds_of_two_systems_are_refused_and_a_missing_one_is_said(rng, tmp_path):
    _cloud(tmp_path / "a.las", rng, 50)
    _cloud(tmp_path / "b.las", rng, 50, wkt=None, epsg=25832)
    result = _run(tmp_path / "*.las", "--statistic", "count", "-o", tmp_path / "x.tif", code=2)
    assert "has another CRS than" in result.stderr
    _cloud(tmp_path / "c.las", rng, 50, wkt=None)
    said = _run(tmp_path / "c.las", "--statistic", "count", "-q", "-o", tmp_path / "x.tif").stderr
    assert "have no CRS" in said and "have a value" not in said, "50 of 210,000 cells: the raster is small"


@pytest.mark.parametrize("crs", [(), ("--crs", "EPSG:32633")])
def test_geocentric_coordinates_are_no_map(rng, tmp_path, crs):
    """The raster of such a cloud was seen along the axis of the Earth, with distances from its equator for heights."""
    xyz = np.array([4_373_387.0, 893_637.0, 4_540_743.0]) + rng.uniform(0, 20, (200, 3))
    write_points(tmp_path / "a.las", xyz, offsets=(4e6, 9e5, 4e6), extra=[], vlrs=[])
    result = _run(tmp_path / "a.las", "--column", "z", *crs, "-o", tmp_path / "x.tif", code=2)
    assert "coordinates are geocentric" in result.stderr and result.stderr.count("\n") == 1


RIPROCESS = (
    'PROJCS["UTM_North zone 33",GEOGCS["UTM_North zone 33",DATUM["WGS84",SPHEROID["WGS84",6378137.000,298.257223563]],'
    'PRIMEM["Greenwich",0],UNIT["degree",0.0174532925199433]],PROJECTION["Transverse_Mercator"],'
    'PARAMETER["latitude_of_origin",0],PARAMETER["central_meridian",15],PARAMETER["scale_factor",0.9996],'
    'PARAMETER["false_easting",500000],PARAMETER["false_northing",0],UNIT["Meter",1],AXIS["Easting",EAST],'
    'AXIS["Northing",NORTH],AXIS["Height [up]",UP]]'
)
"""As RIEGL writes it: a projected CRS with three axes."""


AXES = 'AXIS["Easting",EAST],AXIS["Northing",NORTH],AXIS["Height",UP]'


@pytest.mark.parametrize(
    ("wkt", "code"), [(RIPROCESS, 32633), (UTM.replace('AUTHORITY["EPSG","32633"]', AXES), None)]
)
def test_a_crs_with_an_axis_of_height_is_in_the_file_itself(rng, tmp_path, wkt, code):
    # GDAL wrote it to an .aux.xml of the temporary file's name, so the raster had no CRS and the folder a stray file.
    _cloud(tmp_path / "a.las", rng, 100, wkt=wkt)
    _run(tmp_path / "a.las", "--column", "height", "-o", tmp_path / "x.tif")
    assert {path.name for path in tmp_path.iterdir()} == {"a.las", "x.tif"}
    with rasterio.open(tmp_path / "x.tif") as found:
        assert found.crs.is_projected and "Transverse_Mercator" in found.crs.to_wkt() and found.descriptions[0]
        assert code is None or found.crs.to_epsg() == code


def test_a_crs_that_no_geotiff_can_hold_is_refused(rng, tmp_path, monkeypatch):
    _cloud(tmp_path / "a.las", rng, 100, wkt=RIPROCESS)
    monkeypatch.setattr("wavebatch.files.geotiff_file._flatten", lambda crs: crs)
    result = _run(tmp_path / "a.las", "--column", "height", "-o", tmp_path / "x.tif", code=2)
    assert "cannot hold the CRS" in result.stderr and "--crs EPSG:n" in result.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["a.las"]


@pytest.mark.skipif(os.name == "nt", reason="limits of POSIX systems")
def test_a_full_disk_is_one_line_without_those_of_gdal(rng, tmp_path):
    _cloud(tmp_path / "a.las", rng)
    code = (
        "import resource, signal; from wavebatch.cli import main; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (3000,) * 2); main()"
    )
    arguments = [sys.executable, "-c", code, "grid", "a.las", "--column", "height", "--size", "0.5", "-o", "x.tif"]
    done = subprocess.run(arguments, capture_output=True, text=True, cwd=tmp_path, timeout=300)
    assert done.returncode == 1 and done.stderr.count("\n") == 1, done.stderr
    assert done.stderr.startswith("error: x.tif: cannot be written: ") and "previous exception" not in done.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["a.las"]


def test_cells_in_metres_are_refused_on_degrees(rng, tmp_path):
    degrees = 'GEOGCS["WGS 84",DATUM["WGS_1984",SPHEROID["WGS 84",6378137,298.257]],UNIT["degree",0.0174532925]]'
    _cloud(tmp_path / "d.las", rng, wkt=degrees)
    place_header(tmp_path / "d.las", lambda _: (1e-8, 1e-8, 0.001, 15, 48, 0, 15.1, 15, 48.1, 48, 1, 0))
    words = (tmp_path / "d.las", "--column", "height", "-o", tmp_path / "d.tif")
    assert "coordinates are degrees, and cells of 1 degrees are larger" in _run(*words, code=2).stderr
    _run(*words, "--size", "1e-05")


def test_counts_of_two_digitizers_in_one_raster_are_named(tmp_path):
    """Means of 8-bit and 16-bit amplitudes were written without a word."""
    for name, bits in (("a", 8), ("b", 16), ("c", 8)):
        run_command("simulate", "urban", "-o", tmp_path / f"{name}.las", "--pulses", 1500, "--bits", bits)
        assert run_command("run", tmp_path / f"{name}.las", "-o", tmp_path / "out", "-q").exit_code == 0

    def grid(column, *names):
        clouds = [tmp_path / "out" / f"{name}.laz" for name in names]
        done = succeed("grid", *clouds, "--column", column, "-o", tmp_path / "x.tif", "--size", 5, "--overwrite")
        return " ".join(done.stderr.split())

    said = grid("amplitude", "a", "b")
    assert "warning: amplitude: counts of" in said and "(8 bits, 1 ns apart)" in said and "(16 bits, 1 ns" in said
    assert "counts of" not in grid("amplitude", "a", "c") + grid("echo_width", "a", "b")


@pytest.mark.parametrize(("first", "named"), [(12, False), (8, True)])
def test_counts_of_two_digitizers_are_named(rng, tmp_path, first, named):
    """A cloud of two runs has the counts of the last one; before it another strip may have been the input."""
    for name, bits in (("a.las", (8, first)), ("b.las", (16, 12))):
        texts = [json.dumps({"survey": {"figures": {"bits": one, "spacing_ns": 1.0}}}).encode() for one in bits]
        runs = [laspy.VLR("wavebatch", number, "", text) for number, text in enumerate(texts, 1)]
        write_points(tmp_path / name, rng.uniform(0, 50, (99, 3)), extra=[("high", "f4", -9999.0, None, "peak [DN]")],
                     vlrs=runs, high=np.ones(99, np.float32))  # fmt: skip
    result = _run(tmp_path / "a.las", tmp_path / "b.las", "--column", "high", "--size", 5, "-o", tmp_path / "x.tif")
    words = f"warning: high: counts of {tmp_path / 'a.las'} (8 bits, 1 ns apart) and {tmp_path / 'b.las'} (12 bits"
    assert (words in result.stderr) == named and ("do not compare" in result.stderr) == named
    for kind, more in (("histogram", ()), ("map", ("--size", 5)), ("histogram", ("--each",))):
        picture = succeed("plot", kind, tmp_path / "a.las", tmp_path / "b.las", "--column", "high", *more,
                          "-o", tmp_path / "x.svg", "--overwrite")  # fmt: skip
        assert (words in picture.stderr) == (named and more != ("--each",)), kind
