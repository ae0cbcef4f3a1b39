"""`wavebatch plot histogram` and `map`: what is drawn equals a plain count, whatever the cloud, and says so."""

import json
import sys

import laspy
import numpy as np
import pytest
from commands import refuses, run_command
from hypothesis import example, given
from hypothesis import strategies as st
from plot_tools import POINTS, write_cloud

from wavebatch.core.condition import read_flags
from wavebatch.core.echoes import COLUMNS, EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.cloud.cloud_reader import ColumnReader
from wavebatch.files.cloud.point_filter import PointFilter
from wavebatch.tools import cells
from wavebatch.tools.cells import grid_values, robust_limits
from wavebatch.tools.plots.draw_cloud import count_points_by_flag, count_values, place_edges
from wavebatch.tools.plots.sections import cut_section


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """A cloud with columns of ours, of which some values are no data, flags, and a scaled one of a vendor."""
    rng = np.random.default_rng(5)
    amplitude = rng.gamma(2.0, 30.0, POINTS).astype("f4")
    amplitude[rng.random(POINTS) < 0.1] = -9999.0
    flags = rng.choice([0, 0, 8, 16, 24], POINTS).astype("u2")
    width = rng.integers(38, 60, POINTS).astype("u2")
    path = tmp_path_factory.mktemp("plot") / "cloud.laz"
    return write_cloud(
        path,
        amplitude=(amplitude, np.array([-9999.0]), None, "peak above the baseline [DN]"),
        echo_flags=(flags, None, None, "flags: docs/columns.md [bits]"),
        **{"Pulse width": (width, None, 0.1, "Full width at half maximum [ns]")},
        comment=(rng.normal(size=POINTS).astype("f8"), None, None, "no unit here"),
    )


def read_plainly(path):
    """x, y and columns of a cloud, no-data as NaN."""
    las = laspy.read(path)
    amplitude = np.array(las.points.array["amplitude"], np.float64)
    amplitude[amplitude == -9999.0] = np.nan
    return np.array(las.x), np.array(las.y), amplitude, np.array(las["echo_flags"])


def run(*words):
    return run_command("plot", *words)


def test_histogram_is_that_of_numpy(cloud, tmp_path):
    found = count_values([cloud], "amplitude", bins=37, limits=(5.0, 120.0))
    _, _, amplitude, flags = read_plainly(cloud)
    good = amplitude[~np.isnan(amplitude)]
    counts, edges = np.histogram(good, 37, (5.0, 120.0))
    assert np.array_equal(found.counts, counts[None]) and np.allclose(found.edges, edges, rtol=1e-12)
    assert (found.below[0], found.above[0]) == (np.sum(good < 5), np.sum(good > 120))
    assert (found.total.points, found.total.no_data, found.total.values) == (POINTS, POINTS - len(good), len(good))
    assert np.array_equal(found.percentiles[0], np.percentile(good, (5, 50, 95)))
    assert found.facts.label == "amplitude: peak of the echo above the baseline [DN]"
    assert found.facts.unit == COLUMNS["amplitude"].unit
    words = ("histogram", cloud, "-o", tmp_path / "h.png", "--overwrite", "--json", "-q", "--column")
    shown = json.loads(run(*words, "amplitude", "--bins", 37, "--range", "5:120").stdout)
    assert shown["series"] == [{"name": cloud.name, "values": counts.tolist()}]
    assert shown["values"] == len(good) and shown["outside"] == len(good) - counts.sum() > 0
    assert np.allclose(shown["edges"], edges, rtol=1e-12)
    shown = json.loads(run(*words, "echo_flags").stdout)
    assert {"name": "SATURATED", "values": [int(np.count_nonzero(flags & EchoFlag.SATURATED))]} in shown["series"]


@example(low=0.0, span=5e-324, step=0.0, bins=None)
@example(low=1e-310, span=9e-301, step=0.0, bins=None)
@example(low=0.0, span=1e-299, step=0.0, bins=None)
@given(
    low=st.floats(-1e9, 1e9),
    span=st.floats(0, 1e9),
    step=st.sampled_from([0.0, 0.001, 0.006, 0.1, 1.0]),
    bins=st.sampled_from([None, 1, 7, 1000]),
)
def test_edges_rise_and_hold_the_range(low, span, step, bins):
    high = low + span
    sample = np.linspace(low, high, 11)
    edges = place_edges(sample, low, high, step, bins)
    assert np.all(np.diff(edges) > 0) and len(edges) >= 2
    slack = 1e-9 * max(abs(low), abs(high), step)
    assert edges[0] <= low + 0.5 * step + slack and edges[-1] >= high - 0.5 * step - slack
    if bins:
        assert len(edges) - 1 <= bins


def test_bins_of_stepped_columns_hold_whole_steps(cloud):
    found = count_values([cloud], "echo_width")
    assert found.facts.name == "Pulse width" and found.facts.step == pytest.approx(0.1)
    stride = np.diff(found.edges) / 0.1
    assert np.allclose(stride, round(stride[0])) and np.allclose(found.edges[0] / 0.1 % 1, 0.5)
    values = np.rint(np.array(laspy.read(cloud)["Pulse width"]) / 0.1).astype(int)
    assert np.array_equal(found.counts[0], np.bincount(values - 38, minlength=len(found.counts[0])))
    wide = count_values([cloud], "Pulse width", bins=5)
    assert len(wide.counts[0]) <= 5 and wide.counts.sum() == POINTS
    number = count_values([cloud], "return_number")
    assert number.edges.tolist() == [0.5, 1.5, 2.5, 3.5]


@pytest.mark.parametrize(
    ("asked", "name", "unit"),
    [
        ("amplitude", "amplitude", "DN"),
        ("AMPLITUDE", "amplitude", "DN"),
        ("pulse_width", "Pulse width", "ns"),
        ("echo_width", "Pulse width", "ns"),
        ("comment", "comment", "-"),
        ("z", "z", "m"),
        ("gps time", "gps_time", "s"),
        ("scan_angle", "scan_angle", "deg"),
        ("classification", "classification", "-"),
    ],
)
def test_columns_are_found_by_any_of_their_names(cloud, asked, name, unit):
    with ColumnReader(cloud, asked) as reader:
        assert (reader.facts[0].name, reader.facts[0].unit) == (name, unit)


def test_standard_fields_have_their_values(cloud, tmp_path):
    las = laspy.read(cloud)
    for name, expected in (("x", las.x), ("z", las.z), ("scan_angle", las.scan_angle * 0.006), ("intensity", None)):
        with ColumnReader(cloud, name) as reader:
            found = np.concatenate(list(reader.read_pieces()))
        assert np.array_equal(found["values"][:, 0], las.intensity if expected is None else expected)
        assert np.array_equal(found["x"], las.x)
    old = write_cloud(tmp_path / "old.las", n=20, point_format=1)
    with ColumnReader(old, "scan_angle") as reader:
        assert reader.facts[0].name == "scan_angle_rank"


def test_ours_comes_before_the_vendors_but_the_vendors_own_name_wins(tmp_path):
    stored = np.arange(30)
    path = write_cloud(
        tmp_path / "both.las", n=30,
        Amplitude=(stored.astype("u2"), None, 0.01, "Echo signal amplitude [dB]"),
        wb_amplitude=(stored.astype("f4"), None, None, "peak above the baseline [DN]"),
        amplitude_err=(stored.astype("f4"), None, None, "1 sigma [DN]"),
    )  # fmt: skip
    for asked, unit in (("amplitude", "DN"), ("Amplitude", "dB")):
        with ColumnReader(path, asked) as reader:
            assert reader.facts[0].unit == unit
    with ColumnReader(path, "Amplitude") as reader:
        assert next(reader.read_pieces())["values"][:, 0] == pytest.approx(stored * 0.01)
    for asked in ("amp", "amplitde"):  # the name of ours, not that of its error or of the vendor's
        refuses(ConfigError, f"no column '{asked}'; did you mean 'amplitude'", ColumnReader, path, asked)


def test_each_cloud_has_its_series_and_all_together_are_their_sum(cloud, tmp_path):
    other = write_cloud(tmp_path / "other.las", seed=9, amplitude=(np.full(POINTS, 50, "f4"), None, None, "[DN]"))
    both = count_values([cloud, other], "amplitude", each=True, bins=30, limits=(0.0, 200.0))
    assert both.names == ("cloud.laz", "other.las") and both.counts.shape == (2, 30)
    one = count_values([cloud, other], "amplitude", bins=30, limits=(0.0, 200.0))
    assert np.array_equal(one.counts[0], both.counts.sum(axis=0)) and one.total == both.total
    _, _, amplitude, _ = read_plainly(cloud)
    every = np.append(amplitude[~np.isnan(amplitude)], np.full(POINTS, 50.0))
    assert np.array_equal(one.percentiles[0], np.percentile(every, (5, 50, 95)))
    assert both.percentiles[1].tolist() == [50.0, 50.0, 50.0]
    late = write_cloud(tmp_path / "late.las", wb_amplitude=(np.full(POINTS, 50, "f4"), None, None, "[DN]"))
    for clouds in ([late, other], [other, late]):
        assert count_values(clouds, "amplitude", each=True).facts.name == "amplitude"
    wrong = write_cloud(tmp_path / "dB.las", amplitude=(np.ones(POINTS, "f4"), None, None, "of the echo [dB]"))
    refuses(ConfigError, r"dB.las.*\[dB\].*cloud.laz.*\[DN\]", count_values, [cloud, wrong], "amplitude")


def test_groups_are_series_of_one_histogram(tmp_path):
    n = 4000
    rng = np.random.default_rng(5)
    a, b = rng.normal(5, 1, n).astype("f4"), rng.normal(8, 1, n).astype("f4")
    a[7] = -1
    path = write_cloud(tmp_path / "g.las", n=n, width=(a, np.array([-1.0]), None, "w [ns]"),
                       other=(b, None, None, "o [ns]"))  # fmt: skip
    las = laspy.read(path)
    las.classification = rng.choice([2, 5], n)
    las.write(path)
    kind = np.array(las.classification)
    whole = {"bins": 30, "limits": (0.0, 12.0)}
    found = count_values([path], "width", by="classification", **whole)
    assert found.names == ("classification 2 (ground)", "classification 5 (high vegetation)")
    known = a != -1
    for series, code in enumerate((2, 5)):
        mine = a[(kind == code) & known].astype(np.float64)
        assert found.counts[series].tolist() == np.histogram(mine, found.edges)[0].tolist()
        assert found.values[series] == len(mine) and found.means[series] == pytest.approx(mine.mean())
        assert found.percentiles[series][1] == pytest.approx(np.median(mine))
    assert (found.total.values, found.total.no_data, found.total.points) == (n - 1, 1, n)
    refuses(ConfigError, "more than 12 different values", count_values, [path], "width", by="other")


def test_points_without_data_in_the_column_of_groups_are_a_group(tmp_path):
    group = np.array([1, 1, 2, -9, -9], "f4")
    path = write_cloud(tmp_path / "n.las", n=5, group=(group, np.array([-9.0]), None, "g"))
    found = count_values([path], "z", by="group")
    assert found.names == ("no group", "group 1", "group 2") and found.values.tolist() == [2, 2, 1]


def test_rare_far_values_are_outside_and_counted(tmp_path):
    values = np.random.default_rng(3).normal(10, 1, 20_000)
    values[:10] = 1000.0
    path = write_cloud(tmp_path / "far.las", n=20_000, a=(values, None, None, "a"))
    found = count_values([path], "a")
    low, high = values[10:].min(), values[10:].max()
    width = found.edges[1] - found.edges[0]
    assert abs(found.edges[0] - low) <= width and abs(found.edges[-1] - high) <= width
    assert found.above[0] >= 10 and found.below[0] + found.above[0] + found.counts.sum() == 20_000
    # A rare class is no outlier, and a small group sets limits of its own.
    rare = write_cloud(tmp_path / "rare.las", n=20_000)
    las = laspy.read(rare)
    las.classification = np.where(np.arange(20_000) < 3, 18, 2)
    las.write(rare)
    assert count_values([rare], "classification").above[0] == 0


def test_maps_say_their_crs_and_refuse_two(tmp_path, riegl, cloud):
    found = grid_values([riegl], "z")
    assert "UTM" in found.crs.name and found.crs.unit == "m"
    assert run("map", riegl, "--column", "z", "-o", tmp_path / "r.svg").exit_code == 0
    assert f"CRS: {found.crs.name}" in (tmp_path / "r.svg").read_text("utf-8")
    feet = 'PROJCS["feet",GEOGCS["g"],PROJECTION["x"],UNIT["US survey foot",0.304800609601219]]'
    other = write_cloud(tmp_path / "feet.las")
    las = laspy.read(other)
    las.header.vlrs.append(laspy.vlrs.known.WktCoordinateSystemVlr(feet))
    las.header.global_encoding.wkt = True
    las.write(other)
    assert grid_values([other], "z").crs.unit == "us-ft"
    assert grid_values([other], None, "density").label == "points per area [1/us-ft2]"
    refuses(ConfigError, "its CRS is", grid_values, [riegl, other], None, "density")
    for count in (grid_values, count_values):  # heights in feet and metres were one histogram
        refuses(ConfigError, r"z is in \[us-ft\], z of .* in \[m\]", count, [riegl, other], "z")
    count_values([riegl, cloud], "z")
    assert grid_values([cloud], "z").crs.name == ""


def test_clouds_far_apart_are_refused(tmp_path, cloud):
    away = write_cloud(tmp_path / "away.las")
    las = laspy.read(away)
    las.x = np.array(las.x) + 3000.0
    las.write(away)
    with pytest.raises(ConfigError, match=r"away.las: lies 3000.* from .*cloud.laz.*one by one, or give --bbox"):
        grid_values([cloud, away], "z")
    with pytest.raises(ConfigError, match=r"away.las: lies 3000.* from .*cloud.laz.*one by one, or give --line"):
        cut_section([cloud, away], "z")
    assert cut_section([cloud, away], "z", line=(500_000.0, 5_400_010.0, 503_040.0, 5_400_010.0)).inside
    bounds = (500_000.0, 5_400_000.0, 500_040.0, 5_400_025.0)
    assert grid_values([cloud, away], "z", bounds=bounds).total.values == 2 * POINTS
    las.x = np.array(las.x) - 2900.0
    las.write(away)
    assert grid_values([cloud, away], "z").outside == 0


def test_flags_select_and_are_counted(cloud):
    _, _, amplitude, flags = read_plainly(cloud)
    counted = count_points_by_flag([cloud], "echo_flags")
    for name, count in zip(counted.names, counted.counts, strict=True):
        assert count == np.sum((flags & int(EchoFlag[name])) != 0)
    assert counted.clean == np.sum(flags == 0)
    bits = read_flags(["saturated, OVERLAPPED"])
    assert bits == 24
    chosen = count_values([cloud], "amplitude", PointFilter(flags=8, drop_flags=16), bins=4)
    keep = ((flags & 8) != 0) & ((flags & 16) == 0)
    assert chosen.total.values == np.sum(keep & ~np.isnan(amplitude)) and chosen.total.left_out == np.sum(~keep)
    refuses(ConfigError, "SATURATED", read_flags, ["SATURATD"])
    refuses(ConfigError, "bits", count_values, [cloud], "echo_flags")


@pytest.mark.parametrize("statistic", ["mean", "median", "min", "max", "count", "density"])
def test_map_is_that_of_a_loop_over_cells(cloud, statistic):
    found = grid_values([cloud], "amplitude", statistic, size=2.5, in_memory=700)
    x, y, amplitude, _ = read_plainly(cloud)
    grid = found.grid
    west, _, south, _ = grid.extent
    assert (west % 2.5, south % 2.5) == (0, 0) and found.values.shape == (grid.rows, grid.columns)
    known = ~np.isnan(amplitude)
    row, column = np.floor((y - south) / 2.5).astype(int), np.floor((x - west) / 2.5).astype(int)
    whole = {"mean": np.mean, "median": np.median, "min": np.min, "max": np.max}
    for r in range(grid.rows):
        for c in range(grid.columns):
            cell = amplitude[known & (row == r) & (column == c)]
            if not len(cell):
                assert np.isnan(found.values[r, c])
            elif statistic in whole:
                assert found.values[r, c] == pytest.approx(whole[statistic](cell), rel=1e-12)
            else:
                assert found.values[r, c] == len(cell) / (6.25 if statistic == "density" else 1)
    assert found.outside == 0
    assert found.shown == tuple(np.percentile(found.values[~np.isnan(found.values)], (2, 98)))


def test_chosen_cells_hold_a_few_points_each(cloud):
    found = grid_values([cloud], None, "count")
    assert 2 < np.nanmean(found.values) < 4 * cells.POINTS_PER_CELL
    assert np.nansum(found.values) == POINTS and found.label == "points per cell [-]"


def test_a_far_point_does_not_squeeze_the_map(tmp_path):
    path = write_cloud(tmp_path / "far.las")
    las = laspy.read(path)
    las.points.array["X"][7] = 2_000_000_000
    las.write(path)
    found = grid_values([path], "z")
    assert found.outside == 1 and found.grid.columns * found.grid.size < 100
    part = grid_values([path], "z", bounds=(500_010.0, 5_400_005.0, 500_020.0, 5_400_010.0), size=1.0)
    assert part.grid.extent == (500_010.0, 500_021.0, 5_400_005.0, 5_400_011.0)
    x, y = np.array(las.x), np.array(las.y)
    inside = (x >= 500_010) & (x < 500_021) & (y >= 5_400_005) & (y < 5_400_011)
    assert part.total.values - part.outside == inside.sum()


def test_limits_ignore_outliers_only():
    plain = np.linspace(0, 1, 1001)
    assert robust_limits(plain, 0.0, 1.0) == (0.0, 1.0)
    low, high = robust_limits(np.append(plain, 1e9), 0.0, 1e9)
    assert low == 0.0 and 1.0 <= high < 1.3
    assert robust_limits(np.full(10, 3.0), 3.0, 3.0) == (3.0, 3.0)


def test_the_size_that_is_proposed_does(cloud):
    found = grid_values([cloud], "amplitude", size=0.02)
    assert found.grid.rows * found.grid.columns <= cells.MOST_CELLS


def test_one_point_and_one_value_can_be_drawn(tmp_path):
    one = write_cloud(tmp_path / "one.las", n=1, amplitude=(np.array([7.0], "f4"), None, None, "peak [DN]"))
    for kind in ("histogram", "map"):
        assert run(kind, one, "--column", "amplitude", "-o", tmp_path / f"{kind}.png").exit_code == 0
    assert grid_values([one], "amplitude").values.tolist() == [[7.0]]


COMMANDS = {
    "histogram": ["histogram", "--column", "amplitude", "--log"],
    "flags": ["histogram", "--column", "echo_flags"],
    "map": ["map", "--column", "amplitude", "--statistic", "median"],
    "density": ["map", "--statistic", "density"],
    "groups": ["histogram", "--column", "z", "--by", "return_number"],
}


@pytest.mark.quick_cases(".png-*", ".svg-*")
@pytest.mark.parametrize(("suffix", "start"), [(".png", b"\x89PNG"), (".svg", b"<?xml"), (".pdf", b"%PDF")])
def test_pictures_have_the_same_bytes_each_time(tmp_path, cloud, suffix, start):
    target, made = tmp_path / f"a{suffix}", set()
    words = COMMANDS[{".png": "map", ".svg": "histogram", ".pdf": "flags"}[suffix]]
    for _ in range(2):
        assert run(*words, cloud, "-o", target, "--overwrite", "-q").output == ""
        made.add(target.read_bytes())
    assert len(made) == 1 and made.pop().startswith(start) and len(list(tmp_path.iterdir())) == 1


def test_pictures_say_what_they_show(tmp_path, cloud):
    expected = {
        "histogram": ["cloud.laz", "amplitude: peak of the echo above the baseline [DN]", "without data", "median"],
        "flags": ["cloud.laz", "SATURATED", "no flag", "5,000 points"],
        "map": ["x [m]", "y [m]", "median of amplitude: peak of the echo above the baseline [DN]"],
        "density": ["points per area [1/m2]"],
        "groups": ["z [m]", "return_number 3: ", "share of the series", "mean"],
    }
    for name, words in COMMANDS.items():
        target = tmp_path / f"{name}.svg"
        result = run(*words, cloud, "-o", target)
        assert result.exit_code == 0 and (name != "groups" or "outside the picture" in result.stderr)
        for text in expected[name]:
            assert text in target.read_text("utf-8"), (name, text)


def test_names_from_files_are_text_and_no_formulas(tmp_path):
    path = write_cloud(
        tmp_path / "a$\\frac{b$\u4e2d.las", n=40, odd=(np.arange(40.0), None, None, "$\\x$ \x01<b> & \u4e2d")
    )
    assert run("histogram", path, "--column", "odd", "-o", tmp_path / "p.svg").exit_code == 0
    text = (tmp_path / "p.svg").read_text("utf-8")
    assert "a$\\frac{b$" in text and "&lt;b&gt; &amp;" in text


def test_a_matplotlib_that_does_not_work_is_one_line(cloud, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.backends.backend_agg", None)
    result = run("histogram", cloud, "--column", "z", "-o", tmp_path / "p.png")
    assert result.exit_code == 2 and "matplotlib cannot be imported" in result.stderr
    assert len(result.stderr.splitlines()) == 1 and not list(tmp_path.iterdir())


def test_unreadable_values_do_not_count(tmp_path):
    stored = np.array([1.0, np.nan, np.inf, -np.inf, 1e300, 2.0])
    path = write_cloud(tmp_path / "odd.las", n=6, odd=(stored, None, None, "odd"))
    found = count_values([path], "odd")
    assert (found.total.values, found.total.no_data) == (2, 4)
    with pytest.raises(InputError, match="left out"):
        grid_values([write_cloud(tmp_path / "f.las", n=3, echo_flags=(np.zeros(3, "u2"), None, None, ""))],
                    "z", selection=PointFilter(flags=1))  # fmt: skip


def test_real_clouds(riegl, leica, tmp_path):
    found = count_values([riegl], "Pulse width")
    assert found.total.values == 2535 and found.percentiles[0][1] == pytest.approx(4.4)
    assert cells.Clouds([riegl], ["amplitude"]).facts.unit == "dB"
    assert run("map", riegl, "--column", "z", "--statistic", "max", "-o", tmp_path / "r.png").exit_code == 0
    assert grid_values([leica], "intensity").total.values == 999


@pytest.mark.parametrize("few", [2, 6, 19, 20])
def test_groups_of_few_values_are_points(tmp_path, monkeypatch, few):
    """A line of two values would be two needles of 50 %, and one of six needles of 17 %."""
    from matplotlib.axes import Axes

    from wavebatch.tools.plots import draw_cloud

    group = np.repeat([1, 2, 3], [4000, 1000 - few, few]).astype("u1")
    found = count_values([write_cloud(tmp_path / "c.las", n=5000, group=(group, None, None, "-"))], "z",
                         by="group", limits=(-1e6, 1e6))  # fmt: skip
    assert found.names == ("group 1", "group 2", "group 3") and found.values.tolist() == [4000, 1000 - few, few]
    points, plot = [], Axes.plot
    keep = lambda axes, x, y, *look, **more: points.append(y) or plot(axes, x, y, *look, **more)  # noqa: E731
    monkeypatch.setattr(Axes, "plot", keep)
    draw_cloud.draw_cloud_histogram(found, tmp_path / "h.png")
    # At the foot of the axes: a share of two values is a half, which would press the other series down.
    assert [set(heights) for heights in points] == ([{0.02}] if few < 20 else [])


def test_more_than_six_groups_have_axes_of_their_own(tmp_path):
    matplotlib = pytest.importorskip("matplotlib")
    from matplotlib.figure import Figure

    from wavebatch.tools.plots import draw_cloud

    group = np.repeat(np.arange(8), 625).astype("u1")
    path = write_cloud(tmp_path / "c.las", n=5000, group=(group, None, None, "-"))
    found = count_values([path], "z", by="group")
    parts = draw_cloud._split_series(found)
    assert [part.names for part in parts] == [(f"group {number}",) for number in range(8)]
    assert [part.total.values for part in parts] == [625] * 8 and found.total.values == 5000
    assert all((part.counts == found.counts[row]).all() for row, part in enumerate(parts))
    drawn = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", lambda figure, *args, **more: drawn.extend(figure.axes) or args[0].write(b"x"))
        draw_cloud.draw_cloud_histogram(found, tmp_path / "h.png")
    assert len(drawn) == 8 and matplotlib
    few = count_values([path], "z", by=None)
    assert draw_cloud._split_series(few) == [few]
