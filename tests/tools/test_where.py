"""--where of stats, plot, compare and voxelize: the same points as a selection by hand, and all of them counted."""

import json

import laspy
import numpy as np
import pytest
from batch_tools import run_one
from commands import fail, run_command, succeed
from strips import voxel_job

from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.cloud_reader import ColumnReader
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.tools.pairing import compare_clouds
from wavebatch.tools.plots.draw_cloud import count_values
from wavebatch.tools.return_stats import count_returns
from wavebatch.tools.voxels.rays import Deconvolution
from wavebatch.tools.voxels.strip import VoxelOptions, voxelize_strip

TEXT = "number_of_returns >= 2 and echo_width < 5"
CHOSEN = PointFilter.build(where=TEXT)


@pytest.fixture(scope="module")
def cloud(riegl, tmp_path_factory):
    """A cloud with columns, of a real strip."""
    folder = tmp_path_factory.mktemp("cloud")
    assert run_one(riegl, folder, profile="balanced").error is None
    return folder / f"{riegl.stem}.laz"


@pytest.fixture(scope="module")
def split(cloud, tmp_path_factory):
    """The points that meet TEXT as a file of their own, and how many points there are."""
    las = laspy.read(cloud)
    width = np.asarray(las["echo_width"])
    las.points = las.points[(np.asarray(las.number_of_returns) >= 2) & (width < 5) & (width != -9999)]
    path = tmp_path_factory.mktemp("split") / "part.las"
    las.write(path)
    return path, len(las.points), laspy.read(cloud).header.point_count


def test_readers_give_the_points_that_meet_it(cloud, split):
    path, number, total = split
    assert 50 < number < total - 50
    with ColumnReader(cloud, "z") as some, ColumnReader(path, "z") as other:
        some.select(CHOSEN)
        rows = np.concatenate(list(some.read_pieces(999)))
        np.testing.assert_array_equal(rows, np.concatenate(list(other.read_pieces())))
        assert some.left_out == total - number


def test_histograms_count_them(cloud, split):
    path, number, total = split
    found = count_values([cloud], "amplitude", CHOSEN, bins=20)
    wanted = count_values([path], "amplitude", bins=20)
    assert (found.total.points, found.total.left_out) == (total, total - number)
    assert found.total.values == wanted.total.values
    np.testing.assert_array_equal(found.counts, wanted.counts)


@pytest.mark.quick_cases("100")
@pytest.mark.parametrize("unit_points", [None, 100])
def test_voxels_are_of_waveforms_with_such_a_return(tiny_strip, tmp_path, edit_points, unit_points):
    """Both parts make the whole, also where the second return of a packet stands in a later unit."""
    strip = tiny_strip
    if unit_points:
        order = lambda points: points[np.argsort(points["bit_fields"] & 7, kind="stable")]  # noqa: E731
        strip = edit_points(tiny_strip, tmp_path / "s.las", order)
    whole, several, single, second, none = (
        voxelize_strip(voxel_job(strip, unit_points=unit_points, selection=PointFilter.build(where=where)),
                       tmp_path / f"{number}.npz", VoxelOptions(2.0, Deconvolution(iterations=2)))
        for number, where in enumerate((None, "number_of_returns >= 2", "number_of_returns < 2", "return_number == 2",
                                        "z > 1e6"))
    )  # fmt: skip
    assert 0 < several.waveforms < whole.waveforms == several.waveforms + several.left_out
    assert several.waveforms + single.waveforms == whole.waveforms and second.waveforms == several.waveforms
    assert several.energy + single.energy == pytest.approx(whole.energy, rel=1e-6)
    assert (none.waveforms, none.voxels) == (0, 0) and none.left_out == whole.waveforms


def test_an_unknown_column_is_named_with_its_place_and_the_nearest(cloud):
    for work in (
        lambda chosen: count_returns([cloud], selection=chosen),
        lambda chosen: compare_clouds(cloud, cloud, selection=chosen),
    ):
        with pytest.raises(
            ConfigError, match=r"^--where: character 12: .*no column 'ecko_width'; did you mean 'echo_width'"
        ):
            work(PointFilter.build(where="z > 0 and (ecko_width < 5)"))


def test_plots_and_stats_take_it_on_the_command_line(cloud, split, tmp_path):
    _, number, total = split
    result = run_command("stats", cloud, "--where", TEXT, "--json")
    assert json.loads(result.stdout)["files"][0]["points"] == number
    for kind in ("histogram", "map"):
        words = ["plot", kind, str(cloud), "--column", "z", "--where", TEXT, "-o", str(tmp_path / f"{kind}.png")]
        assert f"{total - number} left out" in succeed(*words).output
    words = ["plot", "map", str(cloud), "--column", "z", "--where", "z > 1e6", "-o", str(tmp_path / "none.png")]
    fail(1, f"{total} of {total} points are left out by --where", *words)


def test_grids_are_of_them(cloud, split, tmp_path):
    rasterio = pytest.importorskip("rasterio", reason="rasterio (extra gis) is not installed")
    path, number, total = split
    for source, name, more in ((cloud, "some", ["--where", TEXT]), (path, "same", [])):
        words = ["grid", source, "--column", "amplitude", "--size", 3, "-o", tmp_path / f"{name}.tif", "--json", *more]
        result = succeed(*words)
        found = json.loads(result.stdout)
        assert found["points"] - found["left_out"] == number and found["left_out"] == (total - number) * bool(more)
    with rasterio.open(tmp_path / "some.tif") as some, rasterio.open(tmp_path / "same.tif") as same:
        np.testing.assert_array_equal(some.read(), same.read())
        assert some.transform == same.transform  # the extent, too, is that of the chosen points


@pytest.mark.parametrize(("where", "words"), [
    ("echo_width > 900", "no raster: no point has a position and what --where asks for"),
    ("echo_wdth > 9", "character 1: "),
])  # fmt: skip
def test_a_grid_of_no_point_says_why(cloud, tmp_path, where, words):
    target = tmp_path / "x.tif"
    result = run_command("grid", cloud, "--column", "z", "--where", where, "-o", target)
    assert result.exit_code in (1, 2) and words in result.stderr and not target.exists()


def test_stats_counts_them_and_what_is_left_out(cloud, split):
    path, number, total = split
    (found,), _ = count_returns([cloud], selection=CHOSEN)
    (wanted,), _ = count_returns([path])
    assert (found.points, found.left_out) == (number, total - number)
    assert (found.by_number, found.separations, found.flags) == (wanted.by_number, wanted.separations, wanted.flags)
    assert any(line.startswith(f"--where: {total - number} of {total} points") for line in found.warnings)


def test_clouds_are_compared_at_them(cloud, split):
    path, number, total = split
    found = compare_clouds(cloud, path, selection=CHOSEN)
    assert (found.matched, found.missed, found.extra) == (number, 0, 0)
    assert (found.left_out_a, found.left_out_b) == (total - number, 0)
