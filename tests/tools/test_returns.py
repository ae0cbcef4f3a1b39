"""Statistics of discrete returns, and waveforms that are made of them."""

import csv
import json
import math

import laspy
import numpy as np
import pytest
from batch_tools import read_cloud, run_one
from click.testing import CliRunner
from commands import refuses, succeed
from writer_tools import number_returns, write_points

from wavebatch.cli.clouds import SHOWN_AREAS, stats
from wavebatch.cli.strips import synthesize
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.geojson import Polygon
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying.inspect_strip import check_file
from wavebatch.tools.pairing import compare_clouds
from wavebatch.tools.return_stats import BINS, AreaGrid, DeadZone, PolygonSet, Separation, count_returns, find_dead_zone
from wavebatch.tools.simulate import DiscreteReceiver, StripOptions, returns, simulate_returns, simulate_strip
from wavebatch.tools.simulate.returns import Radar, SynthesisOptions, synthesize_strip


def write_cloud(path, time, z, number, total, *, flags=None, point_format=1):
    """Points above each other, 1 mm units."""
    fields = {"return_number": number, "number_of_returns": total}
    fields |= {} if point_format == 0 else {"gps_time": time}
    fields |= {} if flags is None else {"echo_flags": flags}
    extra = [] if flags is None else [("echo_flags", "u2")]
    xyz = np.stack([np.zeros(len(z)), np.zeros(len(z)), z], axis=1)
    write_points(path, xyz, point_format=point_format, extra=extra, **fields)
    return path


SMALL = {
    "time": np.array([1, 1, 1, 2, 3, 3, 4.0]),
    "z": np.array([9, 8.2, 7, 5, 9, 6, 1]),
    "number": np.array([1, 2, 3, 1, 1, 2, 1]),
    "total": np.array([3, 3, 3, 1, 2, 2, 2]),
}


def check_small(found, by):
    assert (found.points, found.pulses, found.incomplete, found.pulses_by) == (7, 4, 1, by)
    assert found.by_number == pytest.approx({1: 4 / 7, 2: 2 / 7, 3: 1 / 7})
    assert found.by_count == pytest.approx({1: 0.5, 2: 0.25, 3: 0.25})
    assert found.separations["1-2"] == Separation(2, pytest.approx(1.9), pytest.approx(0.8))
    assert found.separations["2-3"] == Separation(1, pytest.approx(1.2), pytest.approx(1.2))
    assert found.separations["all"] == Separation(3, pytest.approx(5.0 / 3), pytest.approx(0.8))
    assert math.isnan(found.dead_zone)


@pytest.mark.parametrize(("point_format", "by"), [(1, "gps_time"), (0, "return_number")])
def test_small_cloud_is_counted_by_times_or_rising_numbers(tmp_path, point_format, by):
    path = write_cloud(tmp_path / "c.las", **SMALL, point_format=point_format)
    for held in (400_000, 2):
        each, total = count_returns([path], in_memory=held)
        check_small(each[0], by)
        check_small(total, by)
    assert each[0].flags is None


@pytest.mark.parametrize("missing", [np.nan, 0.0])
def test_points_without_a_time_are_not_one_pulse(tmp_path, missing):
    # Ten times the small cloud at times of their own; the pulse of three returns has lost its time in each.
    parts = {name: np.tile(values, 10) for name, values in SMALL.items()}
    parts["time"] = parts["time"] + 10.0 * np.repeat(np.arange(10), 7)
    parts["time"][np.tile(np.arange(7) < 3, 10)] = missing
    (found,), _ = count_returns([write_cloud(tmp_path / "a.las", **parts)])
    assert (found.pulses, found.pulses_by) == (40, "gps_time") and found.by_count[3] == pytest.approx(0.25)
    assert found.warnings[0].startswith("points without GPS time (0 or NaN): 30;")
    (again,), _ = count_returns([tmp_path / "a.las"], in_memory=5)
    assert (again.by_count, again.warnings) == (found.by_count, found.warnings)


@pytest.mark.parametrize(("deep", "limited"), [(1, False), (40, True)])
def test_a_few_deep_pulses_are_no_limit_of_the_sensor(tmp_path, deep, limited):
    pulse, number, total = number_returns(np.r_[np.ones(50, int), np.full(deep, 4)])
    found = count_returns([write_cloud(tmp_path / "c.las", 1.0 + pulse, -2.0 * number, number, total)])[1]
    assert any(line.startswith("limit") for line in found.warnings) == limited


def test_flags_are_counted_and_points_without_echo_are_no_pair(tmp_path):
    flags = [0, EchoFlag.NO_ECHO, 0, EchoFlag.WEAK | EchoFlag.OVERLAPPED, EchoFlag.OVERLAPPED, 0, 0]
    found = count_returns([write_cloud(tmp_path / "c.las", **SMALL, flags=flags)])[1]
    assert {name: n for name, n in found.flags.items() if n} == {"NO_ECHO": 1, "WEAK": 1, "OVERLAPPED": 2}
    more = write_cloud(tmp_path / "d.las", **SMALL, flags=[EchoFlag.WEAK] * 7)
    assert count_returns([tmp_path / "c.las", more])[1].flags["WEAK"] == 8
    assert found.separations["all"].pairs == 1


@pytest.mark.parametrize(("scanners", "pulses"), [(1, 40), (2, 80)])
def test_points_beyond_the_number_of_returns_are_named_unless_scanners_tell_them_apart(tmp_path, scanners, pulses):
    """Points that are stored twice, and lasers that fire together, made pulses of twice as many returns in silence."""
    simulate_strip("forest", tmp_path / "a.las", pulses=40, seed=1, options=StripOptions(point_format=9))
    las = laspy.read(tmp_path / "a.las")
    twice = laspy.LasData(las.header)
    twice.points = las.points[np.repeat(np.arange(len(las.points)), 2)]
    twice.scanner_channel = np.arange(len(twice.points)) % scanners
    twice.write(tmp_path / "b.las")
    found = count_returns([tmp_path / "b.las"])[1]
    said = [line for line in found.warnings if line.startswith(("crowded", "incomplete"))]
    assert (found.points, found.pulses, len(said)) == (2 * len(las.points), pulses, scanners == 1)
    assert all(line.startswith("crowded: 40 of 40 pulses have more points") for line in said)


def test_counted_pulses_whose_points_are_missing_are_not_stored_twice(tmp_path):
    """Without times, runs of rising return numbers grow together where points are missing."""
    number = np.tile([1, 2, 3], 40)
    found = count_returns([write_cloud(tmp_path / "c.las", np.zeros(120), -2.0 * number, number, np.full(120, 2))])[1]
    assert found.incomplete and not any(line.startswith("crowded") for line in found.warnings)
    assert any(line.startswith("incomplete") for line in found.warnings)


@pytest.mark.parametrize(("points", "said"), [(3, "crowded: 5 of 1000 pulses"), (1, "incomplete: 5 of 1000 pulses")])
@pytest.mark.parametrize("begin", [1.0, -5e7], ids=["", "before September 2011"])
def test_half_a_percent_of_wrong_pulses_is_named(tmp_path, points, said, begin):
    """Points of flights with times below 0 were said to be missing where they are stored twice."""
    pulse, number, _ = number_returns(np.where(np.arange(1000) % 200, 2, points))
    path = write_cloud(tmp_path / "c.las", begin + pulse, -2.0 * number, number, np.full(len(pulse), 2))
    assert any(line.startswith(said) for line in count_returns([path])[1].warnings)


def test_a_cloud_that_cannot_be_read_is_named_and_the_others_are_counted(tmp_path):
    good, bad = write_cloud(tmp_path / "good.las", **SMALL), tmp_path / "bad.las"
    bad.write_bytes(b"LASF" + bytes(300))
    refuses(InputError, "bad.las", count_returns, [bad])
    result = CliRunner().invoke(stats, [str(bad), str(good), "--json"])
    assert result.exit_code == 1
    assert result.stderr.startswith(f"error: {bad}") and result.stderr.count("\n") == 1
    document = json.loads(result.stdout)
    assert [one["cloud"] for one in document["files"]] == [str(good)]
    assert document["total"]["pulses"] == 4 and document["total"]["dead_zone"] is None


def test_text_has_every_figure(tmp_path):
    path = write_cloud(tmp_path / "c.las", **SMALL, flags=[EchoFlag.WEAK] * 7)
    result = succeed("stats", path)
    wanted = ("pulses            4", "57.14%", "1-2", "1.900", "0.800", "WEAK", "warning           incomplete: 1 of 4")
    for text in wanted:
        assert text in result.stdout
    less = CliRunner().invoke(stats, [str(path), "--where", "return_number < 3"]).stdout
    assert "--where: 1 of 7 points are left out" in less and "incomplete" not in less  # what is left out is no tile's
    other = write_cloud(tmp_path / "d.las", **SMALL)
    table = tmp_path / "t.csv"
    assert "total" in CliRunner().invoke(stats, [str(path), str(other), "-o", str(table)]).stdout
    assert [line.split(",")[0] for line in table.read_text().splitlines()[1:]] == [str(path), str(other), "total"]
    assert "total" not in CliRunner().invoke(stats, [str(path), str(path)]).stdout  # one file counts once


def _write_pairs(path, zones, pairs, rng, duplicates=0):
    """Pulses of four returns; returns k and k + 1 are at least zones[k - 1] apart."""
    apart = np.asarray(zones) + rng.exponential(3.0, (pairs, 3))
    apart[:duplicates] = 0.0
    z = 500.0 - np.concatenate([np.zeros((pairs, 1)), np.cumsum(apart, axis=1)], axis=1)
    number = np.tile([1, 2, 3, 4], pairs)
    return write_cloud(path, np.repeat(1.0 + np.arange(pairs), 4), z.ravel(), number, np.full(4 * pairs, 4))


@pytest.mark.parametrize("pairs", [150, 3000, 40_000])
def test_dead_zones_by_return_number_are_those_of_the_receiver(tmp_path, rng, pairs):
    """The true distance lies between the size less three errors and the size."""
    zones = (0.64, 1.5, 2.2)
    duplicates = pairs // 3000
    found = count_returns([_write_pairs(tmp_path / "c.las", zones, pairs, rng, duplicates)])[1].dead_zones
    assert list(found) == ["all", "1-2", "2-3", "3-4"]
    for name, true in zip(found, (0.64, *zones), strict=True):
        one = found[name]
        assert one.pairs == (3 * pairs if name == "all" else pairs)
        assert one.size - 3 * one.error - 0.01 <= true <= one.size + 0.01
        assert len(f"{one.size!r}".split(".")[1]) <= 2 and len(f"{one.error!r}".split(".")[1]) <= 3  # as they are known
        assert one.error < max(100 / pairs, 0.03)


@pytest.mark.parametrize(("pairs", "mean"), [(400, 2.0), (5000, 20.0)])
def test_error_of_a_dead_zone_is_the_size_of_its_miss(rng, pairs, mean):
    """Over many samples the misses are as large as the errors say; of 5000 pairs the edge is the sixth distance."""
    misses = []
    for _ in range(300):
        distance = np.minimum(0.7 + rng.exponential(mean, pairs), 99.0)
        bins = np.bincount((100 * distance).astype(int), minlength=BINS)
        found = find_dead_zone(bins[: BINS])
        misses.append((found.size - 0.7) / found.error)
    assert 0.4 < np.sqrt(np.mean(np.square(misses))) < 1.6
    assert np.min(misses) > -1.01


def test_one_pair_of_a_thousand_may_lie_in_a_dead_zone():
    bins = np.zeros(BINS, np.int64)
    bins[50] = bins[90:1089] = 1
    assert find_dead_zone(bins) == DeadZone(1000, 0.9, 0.02)


def test_few_pairs_have_no_dead_zone_and_the_text_says_why(tmp_path, rng):
    path = _write_pairs(tmp_path / "c.las", (1, 1, 1), 40, rng)
    result = CliRunner().invoke(stats, [str(path), "--json"])
    zones = json.loads(result.stdout)["total"]["dead_zones"]
    assert zones["1-2"] == {"pairs": 40, "size": None, "error": None}
    assert zones["all"]["pairs"] == 120 and zones["all"]["size"] > 0.9
    text = CliRunner().invoke(stats, [str(path)]).stdout
    assert text.count("no-data: fewer than 100 pairs") == 3
    far = _write_pairs(tmp_path / "f.las", (150, 150, 150), 200, rng)
    assert CliRunner().invoke(stats, [str(far)]).stdout.count("no-data: nearly all 100 m or more apart") == 4
    zones = json.loads(CliRunner().invoke(stats, [str(far), "--json"]).stdout)["total"]["dead_zones"]
    assert zones["all"] == {"pairs": 600, "size": None, "error": None}


@pytest.mark.parametrize("near", [300, 20])
def test_hidden_pairs_are_those_that_as_many_as_just_above_the_zone_would_be(tmp_path, near):
    """Distances at least 1 m, 300 per metre up to 2 m and 100 per metre beyond: the zone hides 300 of 1000 pulses."""
    apart = np.concatenate([np.full(2, 1.0), np.linspace(1.0, 1.999, near - 2), np.linspace(2.01, 8.999, 1000 - near)])
    time, number = np.repeat(1.0 + np.arange(1000), 2), np.tile([1, 2], 1000)
    z = 100.0 - np.stack([np.zeros(1000), apart], axis=1).ravel()
    found = count_returns([write_cloud(tmp_path / "c.las", time, z, number, np.full(2000, 2))])[1]
    assert found.dead_zone == pytest.approx(1.0, abs=0.011)
    assert found.hidden == pytest.approx(near / 1000, abs=0.006)
    assert any(line.startswith("dead zone") and f"{found.hidden:.3f}" in line for line in found.warnings)


def make_cloud(path, n=800, seed=0, east=300_000.0):
    """Slanted pulses with 1 to 4 returns over 100 m x 60 m, shuffled: the pulse of every point, x y z, numbers."""
    rng = np.random.default_rng(seed)
    pulse, number, total = number_returns(rng.integers(1, 5, n))
    start = np.stack([rng.uniform(0, 100, n), rng.uniform(-30, 30, n), np.full(n, 50.0)], axis=1)
    step = np.stack([rng.uniform(-3, 3, n), rng.uniform(-3, 3, n), rng.uniform(-8, -1, n)], axis=1)
    xyz = np.round(start[pulse] + number[:, None] * step[pulse] + [east, 0, 0], 3)
    order = rng.permutation(len(pulse))
    pulse, xyz, number, total = pulse[order], xyz[order], number[order], total[order]
    fields = {"gps_time": 1e5 + pulse, "return_number": number, "number_of_returns": total}
    write_points(path, xyz, offsets=(east, 0, 0), **fields)
    return pulse, xyz, number


def count_naively(pulse, xyz, number, area_of):
    """Per area: points, pulses, points by number, pulses by count, separations, also by rank, and depths."""
    found = {}
    for one in np.unique(pulse):
        rows = np.flatnonzero(pulse == one)
        rows = rows[np.argsort(number[rows])]
        area = found.setdefault(area_of(*xyz[rows[0], :2]), [0, 0, {}, {}, [], {}, []])
        area[0] += len(rows)
        area[1] += 1
        area[3][len(rows)] = area[3].get(len(rows), 0) + 1
        for row in rows:
            area[2][number[row]] = area[2].get(number[row], 0) + 1
        for rank, (a, b) in enumerate(zip(rows[:-1], rows[1:], strict=True), 1):
            area[4].append(math.dist(xyz[a], xyz[b]))
            area[5].setdefault(f"{rank}-{rank + 1}", []).append(area[4][-1])
        area[6] += [xyz[rows[0], 2] - xyz[rows[-1], 2]] if len(rows) > 1 else []
    return found


def check_areas(found, naive, key):
    assert {key(area) for area in found} == set(naive) and len(found) == len(naive)
    for area in found:
        points, pulses, by_number, by_count, apart, ranks, depths = naive[key(area)]
        assert (area.points, area.pulses, area.pairs) == (points, pulses, len(apart))
        assert area.returns_per_pulse == points / pulses
        assert area.by_number == pytest.approx({k: n / points for k, n in by_number.items()})
        assert area.by_count == pytest.approx({k: n / pulses for k, n in by_count.items()})
        assert list(area.separations) == sorted(ranks) and area.several == len(depths)
        for one, each in ((area, apart), *((area.separations[name], ranks[name]) for name in ranks)):
            mean, least = (np.mean(each), min(each)) if each else (math.nan, math.nan)
            assert (one.pairs, one.mean, one.least) == pytest.approx((len(each), mean, least), nan_ok=True)
        assert area.depth == pytest.approx(np.mean(depths) if depths else math.nan, nan_ok=True)


def check_sum(areas, total):
    """Areas together have what the cloud has."""
    assert sum(area.points for area in areas) == total.points
    assert sum(area.pulses for area in areas) == total.pulses
    assert sum(area.pairs for area in areas) == total.separations["all"].pairs
    for kind, whole in (("by_number", "points"), ("by_count", "pulses")):
        for k, share in getattr(total, kind).items():
            number = sum(getattr(area, kind).get(k, 0) * getattr(area, whole) for area in areas)
            assert number == pytest.approx(share * getattr(total, whole))
    assert min(area.least for area in areas if area.pairs) == total.separations["all"].least
    assert sum(area.several for area in areas) == total.several
    depths = [area.depth * area.several for area in areas if area.several]
    assert sum(depths) == pytest.approx(total.depth * total.several)


@pytest.mark.parametrize("size", [7.5, 40.0, 1000.0])
@pytest.mark.parametrize("held", [400_000, 150])
def test_cells_as_a_loop_over_pulses_counts_them(tmp_path, size, held):
    points = make_cloud(tmp_path / "c.las")
    (one,), total = count_returns([tmp_path / "c.las"], divisions=[AreaGrid(size)], in_memory=held)
    naive = count_naively(*points, lambda x, y: (math.floor(x / size) * size, math.floor(y / size) * size))
    check_areas(one.areas, naive, lambda area: (area.x, area.y))
    check_sum(one.areas, one)
    check_sum(one.areas, total)
    assert all(area.kind == "cell" for area in one.areas)
    places = [(area.x, area.y) for area in one.areas]
    assert places == sorted(places) == [(area.x, area.y) for area in total.areas]


def square(x, y, side, name="s"):
    return Polygon(name, (np.array([[x, y], [x + side, y], [x + side, y + side], [x, y + side]], float),))


def test_polygons_first_come_and_what_is_outside(tmp_path):
    points = make_cloud(tmp_path / "c.las")
    hole = square(300_010, -20, 40, "big").rings + square(300_020, -10, 10).rings
    polygons = [Polygon("big", hole), square(300_000, -30, 30, "corner"), square(0, 0, 1, "far")]

    def area_of(x, y):
        if 300_010 <= x < 300_050 and -20 <= y < 20 and not (300_020 <= x < 300_030 and -10 <= y < 0):
            return "big"
        return "corner" if 300_000 <= x < 300_030 and -30 <= y < 0 else "outside"

    (one,), _ = count_returns([tmp_path / "c.las"], divisions=[PolygonSet(polygons)])
    check_areas(one.areas, count_naively(*points, area_of), lambda area: area.name)
    assert [area.name for area in one.areas] == ["big", "corner", "outside"]
    check_sum(one.areas, one)
    (one,), _ = count_returns([tmp_path / "c.las"], divisions=[PolygonSet(polygons[2:])])
    assert "lies outside the strip" in one.warnings[0] and [area.name for area in one.areas] == ["outside"]


@pytest.mark.parametrize("scale", [float("nan"), 1e300, float("inf")])
def test_damaged_coordinates_are_counted_outside(tmp_path, scale):
    make_cloud(tmp_path / "c.las", n=50)
    content = bytearray((tmp_path / "c.las").read_bytes())
    content[131:139] = np.float64(scale).tobytes()
    (tmp_path / "d.las").write_bytes(content)
    result = CliRunner().invoke(stats, [str(tmp_path / "d.las"), "--area", "10", "--json"])
    if result.exit_code:
        assert result.stderr.startswith("error: ") and result.stderr.count("\n") == 1
        return
    found = json.loads(result.stdout)["total"]
    assert sum(area["pulses"] for area in found["areas"]) == found["pulses"] == 50


def test_places_that_are_none_are_outside():
    x = np.array([5.0, np.nan, np.inf, 1e300, 1.0, -1e300])
    y = np.array([5.0, 1.0, 1.0, 1.0, np.nan, -np.inf])
    for division in (AreaGrid(10), PolygonSet([square(0, 0, 10)])):
        found = division.find(x, y)
        assert (found[1:] == -1).all() and found[0] != -1
        assert division.describe(-1).name == "outside"
    assert AreaGrid(0.25).describe(int(AreaGrid(0.25).find(np.array([-0.1]), np.array([0.3]))[0])).name == "-0.25 0.25"


@pytest.mark.slow
def test_too_many_cells_are_one_line(tmp_path):
    make_cloud(tmp_path / "c.las", 50_200)
    many = CliRunner().invoke(stats, [str(tmp_path / "c.las"), "--area", "0.005"])
    assert many.exit_code == 2 and "more than 50000 areas hold" in many.stderr and many.stderr.count("\n") == 1
    make_cloud(tmp_path / "d.las")
    with pytest.raises(ConfigError, match="more than 50000 areas with it"):
        count_returns([tmp_path / "d.las", tmp_path / "c.las"], divisions=[AreaGrid(0.05)])


def write_features(path, *features):
    path.write_text(json.dumps({"type": "FeatureCollection", "features": list(features)}))
    return path


def feature(kind, coordinates, **properties):
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}


def test_table_text_and_json_say_the_same(tmp_path):
    make_cloud(tmp_path / "c.las")
    path = write_features(tmp_path / "p.json", feature("Polygon", [[[300_000, -30], [300_050, -30], [300_050, 30]]],
                                                       name="a, \"b\""))  # fmt: skip
    arguments = [str(tmp_path / "c.las"), "--area", "12", "--polygon", str(path), "-o", str(tmp_path / "t.csv")]
    document = json.loads(CliRunner().invoke(stats, [*arguments, "--json"]).stdout)
    found = document["files"][0]["areas"]
    with open(tmp_path / "t.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert rows[0]["kind"] == "cloud" and int(rows[0]["pulses"]) == document["total"]["pulses"] == 800
    assert len(rows) == 1 + len(found)
    for row, area in zip(rows[1:], found, strict=True):
        assert (row["kind"], row["area"]) == (area["kind"], area["name"])
        each = area["points"] / area["pulses"]
        assert area["returns_per_pulse"] == each == pytest.approx(float(row["returns_per_pulse"]))
        for name, key in (("points", "points"), ("mean_m", "mean"), ("least_m", "least"), ("x", "x")):
            assert float(row[name] or "nan") == pytest.approx(
                float("nan") if area[key] is None else area[key], nan_ok=True
            )
        ranks = {pair: int(row[f"pairs_{pair}"]) for pair in ("1_2", "2_3", "3_4", "4")}
        assert sum(ranks.values()) == area["pairs"] and int(row["pulses_with_several"]) == area["several"]
        for pair, number in ranks.items():
            one = area["separations"].get(pair.replace("_", "-"), {})
            assert number == one.get("pairs", 0)
            assert float(row[f"mean_m_{pair}"] or 0) == pytest.approx(one.get("mean", 0))
        for k in range(1, 5):
            assert float(row[f"return_{k}"]) == pytest.approx(area["by_number"].get(str(k), 0), abs=1e-9)
            assert float(row[f"pulses_with_{k}"]) == pytest.approx(area["by_count"].get(str(k), 0), abs=1e-9)
    for pair, name in (("", "all"), ("_1_2", "1-2"), ("_2_3", "2-3"), ("_3_4", "3-4"), ("_4", "4-")):
        zone = document["files"][0]["dead_zones"].get(name, {"size": None, "error": None})
        for column, key in (("dead_zone_m", "size"), ("dead_zone_err_m", "error")):
            assert rows[0][column + pair] == ("" if zone[key] is None else f"{zone[key]:.10g}")
            assert rows[1][column + pair] == ""  # areas have none
    again = CliRunner().invoke(stats, arguments)
    assert again.exit_code != 0 and "exists already" in again.stderr
    out = CliRunner().invoke(stats, [*arguments, "--overwrite"]).stdout
    assert f"and {len(found) - SHOWN_AREAS} more; --json has all of them" in out and found[0]["name"] in out


def test_an_empty_cloud_has_no_area(tmp_path):
    make_cloud(tmp_path / "c.las", n=1)
    cloud = laspy.read(tmp_path / "c.las")
    cloud.points = cloud.points[:0]
    cloud.write(tmp_path / "e.las")
    (one,), total = count_returns([tmp_path / "e.las"], divisions=[AreaGrid(10)])
    assert one.areas == total.areas == ()
    result = CliRunner().invoke(stats, [str(tmp_path / "e.las"), "--area", "10", "-o", str(tmp_path / "e.csv")])
    assert result.exit_code == 0 and (tmp_path / "e.csv").read_text().count("\n") == 2


@pytest.fixture(scope="module")
def cloud(tmp_path_factory):
    """Returns of 2000 pulses in trees, at least 2 m apart."""
    path = tmp_path_factory.mktemp("synthesize") / "cloud.las"
    simulate_returns("canopy.gemini-24", path, pulses=2000, seed=8, receiver=DiscreteReceiver(2.0))
    return path


def read_blocks(path):
    with StripReader(path) as reader:
        scan = reader.scan()
        unit = reader.read_unit(0, scan)
        return [block for block, _ in reader.read_blocks(unit, 100_000, True)]


@pytest.mark.quick_cases("1.0")
@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_run_finds_the_returns_again(cloud, noise, tmp_path):
    summary = synthesize_strip(cloud, tmp_path / "s.laz", SynthesisOptions(noise=noise))
    assert summary.packets == 2000 and summary.without_packet == summary.scattered == 0
    assert check_file(tmp_path / "s.laz").is_clean
    assert run_one(tmp_path / "s.laz", tmp_path / "out", profile="balanced").error is None
    result = compare_clouds(tmp_path / "out" / "s.laz", cloud)
    assert result.completeness > 0.97 and result.correctness > 0.97
    assert abs(result.differences["time"].median) < 0.02
    assert result.differences["time"].nmad < 0.1


def test_samples_are_gaussians_at_the_returns(cloud, tmp_path):
    options = SynthesisOptions(gain=0.05, width=6.0, bits=16, baseline=300.0, spacing=0.5)
    synthesize_strip(cloud, tmp_path / "s.las", options)
    intensity = read_cloud(cloud)[0]["intensity"].astype(float)
    xyz = read_cloud(cloud)[1]
    lengths = set()
    for block in read_blocks(tmp_path / "s.las"):
        lengths.add(block.samples.shape[1])
        assert np.linalg.norm(block.direction, axis=1) == pytest.approx(np.full(len(block), 0.149896229), rel=1e-6)
        returns = block.returns
        time = np.arange(block.samples.shape[1]) * 0.5
        model = np.full(block.samples.shape, 300.0)
        waves = (
            0.05
            * intensity[returns.point][:, None]
            * np.exp(-0.5 * ((time - returns.time[:, None]) / (6.0 / 2.35482)) ** 2)
        )
        np.add.at(model, returns.waveform, waves)
        assert np.abs(block.samples - model).max() < 0.51
        place = block.origin[returns.waveform] + returns.time[:, None] * block.direction[returns.waveform]
        assert np.abs(place - xyz[returns.point]).max() < 0.02
        assert returns.time.min() > 5 * 6.0 / 2.35482
        assert (time[-1] - returns.time).min() > 5 * 6.0 / 2.35482
    assert len(lengths) > 1


def test_lone_returns_take_the_direction_of_their_scan_angle(cloud, tmp_path):
    synthesize_strip(cloud, tmp_path / "s.las")
    points = read_cloud(tmp_path / "s.las")[0]
    lone = points["bit_fields"] >> 3 & 7 == 1
    y, z = points["y_t"][lone], points["z_t"][lone]
    assert lone.sum() > 100
    assert -y / z == pytest.approx(np.tan(np.radians(points["scan_angle_rank"][lone])), abs=0.03)
    assert points["x_t"][lone] / z == pytest.approx(np.full(lone.sum(), -4 / 57.3), abs=0.02)


def test_measured_widths_come_first(cloud, tmp_path):
    synthesize_strip(cloud, tmp_path / "s.las", SynthesisOptions(width=8.0, bits=16, gain=5.0))
    run_one(tmp_path / "s.las", tmp_path / "out", profile="balanced")
    synthesize_strip(tmp_path / "out" / "s.laz", tmp_path / "again.las", SynthesisOptions(width=3.0, bits=16, gain=5.0))
    (wide,) = {block.samples.shape[1] for block in read_blocks(tmp_path / "again.las")} & {128}
    block = next(block for block in read_blocks(tmp_path / "again.las") if block.samples.shape[1] == wide)
    peak = block.samples[block.returns.waveform].max(axis=1).astype(float) - 12
    above = (block.samples - 12.0 > 0.5 * (block.samples.max(axis=1) - 12.0)[:, None]).sum(axis=1)
    assert peak.max() > 500
    assert np.percentile(above, 10) >= 7


@pytest.mark.quick_cases("1-4", "6-9")
@pytest.mark.parametrize(("given", "expected"), [(1, 4), (3, 5), (6, 9), (7, 10)])
def test_points_are_those_of_the_cloud_and_pieces_cut_no_pulse(cloud, given, expected, tmp_path):
    las = laspy.convert(laspy.read(cloud), point_format_id=given)
    las.user_data[:] = np.arange(len(las)) % 251
    las.write(tmp_path / "c.las")
    summary = synthesize_strip(tmp_path / "c.las", tmp_path / "s.laz", SynthesisOptions(gain=0.1), piece=37)
    assert summary.packets == 2000 and summary.scattered == 0 and check_file(tmp_path / "s.laz").is_clean
    with laspy.open(tmp_path / "s.laz", read_evlrs=False) as reader:
        assert reader.header.point_format.id == expected
    before, after = read_cloud(tmp_path / "c.las")[0], read_cloud(tmp_path / "s.laz")[0]
    assert len(np.unique(after["wavepacket_offset"])) == 2000
    for field in before.dtype.names:
        assert np.array_equal(before[field], after[field]), field


def test_reflectances_are_weakened_with_range(tmp_path):
    simulate_returns("flat", tmp_path / "c.las", pulses=300)
    radar = {height: Radar(height, power=4000.0) for height in (620.0, 1120.0)}
    peaks = []
    for height, figures in radar.items():
        options = SynthesisOptions("reflectance", 1e11, figures, bits=16)
        synthesize_strip(tmp_path / "c.las", tmp_path / f"{height}.las", options)
        (block,) = read_blocks(tmp_path / f"{height}.las")
        peaks.append(block.samples.max(axis=1) - 12.0)
    assert np.median(peaks[0] / peaks[1]) == pytest.approx(4 * 10 ** (2 * 0.5 * 0.22 / 10), rel=0.02)
    points = read_cloud(tmp_path / "c.las")[0]
    distance = 500.0 / np.cos(np.radians(points["scan_angle_rank"].astype(float)))
    # Of a surface that fills the footprint, without the beam's divergence.
    power = 4000.0 * 0.1**2 * points["intensity"] / 65535 * 0.5 * 10 ** (-0.22e-4 * 2 * distance) / (4 * distance**2)
    assert np.median(peaks[0] / (1e11 * power)) == pytest.approx(0.99, abs=0.01)  # samples are beside the peak
    with pytest.raises(InputError, match="above the sensor"):
        synthesize_strip(tmp_path / "c.las", tmp_path / "x.las", SynthesisOptions("reflectance", 1.0, Radar(100.0)))


def run(*arguments):
    return CliRunner().invoke(synthesize, [str(argument) for argument in arguments])


def test_command_line(cloud, tmp_path):
    target = tmp_path / "s.las"
    assert json.loads(run(cloud, "-o", target, "--json", "-q").stdout)["packets"] == 2000
    again = run(cloud, "-o", target)
    assert again.exit_code == 1 and again.stderr.count("\n") == 1 and "exists already" in again.stderr
    strong = run(cloud, "-o", target, "--overwrite", "--gain", "10")
    assert strong.exit_code == 0 and "above the digitizer" in strong.stderr
    figures = ("--intensity", "reflectance", "--sensor-height", "920", "--divergence", "0.7")
    succeed("synthesize", cloud, "-o", tmp_path / "r.las", *figures)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["r.las", "s.las"]


FIGURES = {"gain": 1e11, "radar": Radar(1200.0, power=4000.0), "bits": 16, "spacing": 0.5, "width": 5.0}


def add_columns(path, target, **columns):
    """The cloud with extra bytes; a name with a unit in brackets gets it as its description."""
    cloud = laspy.read(path)
    for name, values in columns.items():
        cloud.add_extra_dim(laspy.ExtraBytesParams(name.split("[")[0], "f4", description=name))
        cloud[name.split("[")[0]] = values
    cloud.write(target)
    return target


def energies(path, spacing=0.5, baseline=12.0):
    """Energy of each pulse's samples above the baseline by GPS time [DN ns]."""
    found = {}
    for block in read_blocks(path):
        found |= dict(zip(block.gps_time.tolist(), spacing * (block.samples - baseline).sum(axis=1), strict=True))
    return np.array([found[key] for key in sorted(found)])


def pulses_of(path):
    """Pulse of each point, from 0 in the order of the times, and returns per pulse."""
    times = np.unique(laspy.read(path).gps_time, return_inverse=True)[1]
    return times, np.bincount(times)


def test_each_return_sends_back_its_share_of_the_light(cloud, tmp_path):
    """Energies of pulses with shares are those sums of the energies of the returns alone."""
    pulse, number = pulses_of(cloud)
    share = np.random.default_rng(1).uniform(0.2, 0.9, len(pulse)).astype("f4") / number[pulse]
    given = add_columns(cloud, tmp_path / "c.las", footprint=share)
    whole = synthesize_strip(given, tmp_path / "w.las", SynthesisOptions("reflectance", **FIGURES))
    part = synthesize_strip(given, tmp_path / "s.las", SynthesisOptions("reflectance", shares="footprint", **FIGURES))
    even = synthesize_strip(given, tmp_path / "e.las", SynthesisOptions("reflectance", shares="equal", **FIGURES))
    ones = number == 1
    ratio = energies(tmp_path / "s.las")[ones] / energies(tmp_path / "w.las")[ones]
    assert ratio == pytest.approx(share[ones[pulse]], rel=0.02)
    assert energies(tmp_path / "e.las") == pytest.approx(energies(tmp_path / "w.las") / number, rel=0.02)
    assert part.light.own_share == len(pulse) and part.light.assumed_share == part.light.over_one == 0
    assert part.light_used == pytest.approx(np.bincount(pulse, share).mean()) and even.light_used == pytest.approx(1)
    assert np.isnan(whole.light_used)
    for summary, name in ((whole, "w"), (part, "s"), (even, "e")):
        assert summary.saturated == 0
        assert summary.energy_recorded == pytest.approx(energies(tmp_path / f"{name}.las").sum(), rel=1e-9)
        assert summary.energy_recorded == pytest.approx(summary.energy, rel=0.003)


def test_shares_of_a_pulse_are_at_most_one_and_gaps_take_the_rest():
    starts = np.array([0, 2, 5, 7, 8, 10])
    share = np.array([0.3, np.nan, 0.2, np.nan, np.nan, 0.9, 0.6, np.nan, 1.0, np.nan, 1.00005])
    filled, over = returns.fill_shares(share, starts)
    assert filled == pytest.approx([0.3, 0.7, 0.2, 0.4, 0.4, 0.6, 0.4, 1.0, 1.0, 0.0, 1.0])
    assert over == 1  # float32 dust above 1 is none
    rng = np.random.default_rng(0)
    count = rng.integers(1, 6, 500)
    starts = np.cumsum(count) - count
    share = np.where(rng.random(count.sum()) < 0.3, np.nan, rng.random(count.sum()))
    filled, _ = returns.fill_shares(share, starts)
    assert filled.min() >= 0 and np.add.reduceat(filled, starts).max() < 1 + 1e-12
    for start, n in zip(starts, count, strict=True):
        part = share[start : start + n]
        known = part[~np.isnan(part)]
        if len(known) == n and known.sum() <= 1:
            assert filled[start : start + n] == pytest.approx(part)


def test_a_wide_echo_is_lower_and_has_the_same_energy(cloud, tmp_path):
    pulse, number = pulses_of(cloud)
    width = np.where(pulse % 2, 10.0, 5.0).astype("f4")
    width[::7] = np.nan  # those of the pulse
    given = add_columns(cloud, tmp_path / "c.las", **{"their width[ns]": width})
    synthesize_strip(given, tmp_path / "p.las", SynthesisOptions("reflectance", **FIGURES))
    options = SynthesisOptions("reflectance", widths="their width", **FIGURES)
    summary = synthesize_strip(given, tmp_path / "w.las", options)
    assert energies(tmp_path / "w.las") == pytest.approx(energies(tmp_path / "p.las"), rel=0.02)
    assert summary.light.own_width == np.isfinite(width).sum() and summary.light.limited_width == 0
    peaks = {}
    for name in ("p", "w"):
        for block in read_blocks(tmp_path / f"{name}.las"):
            top = block.samples.max(axis=1) - 12.0
            peaks |= {(name, time): height for time, height in zip(block.gps_time.tolist(), top, strict=True)}
    times = np.unique(laspy.read(cloud).gps_time)
    ratio = np.array([peaks["w", time] / peaks["p", time] for time in times.tolist()])
    lone = number == 1
    expected = np.where(width[lone[pulse]] == 10.0, 0.5, 1.0)
    assert ratio[lone] == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(
    ("baseline", "noise", "level"), [(0.0, 2.0, 0.7), (3.0, 2.0, 3.03), (12.4, 0.0, 12.0), (12.4, 1.0, 12.4)]
)
def test_energy_that_is_not_of_echoes_is_shown(cloud, tmp_path, baseline, noise, level):
    """Noise that is cut off at 0, or a fraction of a count, moves every sample without an echo."""
    words = ("--baseline", baseline, "--noise", noise, "--gain", 0.01, "--bits", 16)
    result = succeed("synthesize", cloud, "-o", tmp_path / "s.las", *words, "--json")
    document = json.loads(result.stdout)
    samples = np.concatenate([block.samples[:, :4].ravel() for block in read_blocks(tmp_path / "s.las")])
    error = 5 * max(samples.std(), 1e-6) / np.sqrt(samples.size)
    assert document["level"] == pytest.approx(level, abs=0.12) and document["level"] == pytest.approx(
        samples.mean(), abs=error
    )
    excess = document["energy_recorded"] - document["energy"]
    assert excess == pytest.approx(document["energy_of_level"], rel=0.4, abs=0.01 * document["energy"])
    is_off = abs(document["energy_of_level"]) > 0.001 * document["energy"]
    assert is_off == (abs(level - baseline) > 0.01)
    assert ("are not of echoes" in result.stderr) == is_off, result.stderr


def test_the_ratio_of_energies_leaves_out_echoes_without_a_packet(tmp_path, cloud):
    las = laspy.read(cloud)
    first = np.flatnonzero(las.return_number == 1)[las.number_of_returns[las.return_number == 1] > 1][:300]
    las.z[first] = las.z[first] + 3000.0  # no waveform is so long
    las.write(tmp_path / "far.las")
    result = run(tmp_path / "far.las", "-o", tmp_path / "s.las", "--bits", 16, "--gain", 5, "--json")
    document = json.loads(result.stdout)
    assert document["without_packet"] >= 600 and document["energy_without_packet"] > 0.1 * document["energy"]
    packed = document["energy"] - document["energy_without_packet"]
    assert document["energy_recorded"] == pytest.approx(packed, rel=0.003)
    assert f"({document['energy_recorded'] / packed:.1%})" in result.stderr
    assert f"{document['energy_without_packet']:.4g} DN ns without a packet" in result.stderr


@pytest.mark.parametrize("gain", [(), ("--gain", "0.05")])
def test_widths_of_which_most_are_possible_are_taken_as_nanoseconds(cloud, tmp_path, gain):
    points = len(laspy.read(cloud))
    some = np.full(points, 5.0)
    some[: int(0.4 * points)] = 4000.0
    given = add_columns(cloud, tmp_path / "c.las", some=some)
    result = run(given, "-o", tmp_path / "s.las", "--widths", "some", *gain)
    assert result.exit_code == 0 and "some states no unit; its values were taken as nanoseconds" in result.stderr
    some[: int(0.6 * points)] = 4000.0
    given = add_columns(cloud, tmp_path / "d.las", some=some)
    assert "values are outside of" in run(given, "-o", tmp_path / "t.las", "--widths", "some", *gain).stderr


def test_shares_above_one_together_are_scaled_and_counted(cloud, tmp_path):
    given = add_columns(cloud, tmp_path / "c.las", footprint=np.full(len(laspy.read(cloud)), 0.9))
    figures = ("--intensity", "reflectance", "--sensor-height", "1200", "-o", tmp_path / "s.las")
    over = run(given, *figures, "--shares", "footprint")
    assert "with shares above 1 together, scaled to 1" in over.stderr and "energy: " in over.stderr
    document = json.loads(run(given, *figures, "--shares", "footprint", "--json", "-q", "--overwrite").stdout)
    assert document["light"]["over_one"] == np.count_nonzero(pulses_of(cloud)[1] > 1)
    assert document["light_used"] < 1


def test_equal_shares_count_the_returns_that_a_thinned_cloud_lacks(cloud, tmp_path):
    """First returns alone keep the energy that they have in the whole cloud."""
    las = laspy.read(cloud)
    las.points = las.points[np.array(las.return_number) == 1]
    las.write(tmp_path / "first.las")
    options = SynthesisOptions("reflectance", shares="equal", **FIGURES)
    whole = synthesize_strip(cloud, tmp_path / "w.las", options)
    first = synthesize_strip(tmp_path / "first.las", tmp_path / "f.las", options)
    number = np.array(las.number_of_returns)
    assert whole.light_used == pytest.approx(1) and first.light_used == pytest.approx(np.mean(1 / number))
    assert first.scattered == np.count_nonzero(number > 1)
    words = ("-o", tmp_path / "x.las", "--intensity", "reflectance", "--sensor-height", 1200, "--overwrite")
    said = run(tmp_path / "first.las", *words, "--shares", "equal")
    assert "equal shares use number_of_returns, including missing returns" in said.stderr
    assert "shares of incomplete pulses" not in said.stderr  # they are not those of the points that are there
    given = add_columns(tmp_path / "first.las", tmp_path / "g.las", footprint=np.full(len(las.points), 0.3))
    said = run(given, *words, "--shares", "footprint")
    assert "shares of incomplete pulses are those of the points that are there" in said.stderr
