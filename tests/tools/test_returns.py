"""`wavebatch stats`: return numbers, separations and flags against hand counts, whatever the order of the points."""

import json
import math

import numpy as np
import pytest
from click.testing import CliRunner

from wavebatch.cli.stats import stats
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import InputError
from wavebatch.files.disk import temp_store
from wavebatch.files.disk.publish import publish_together
from wavebatch.files.las.extra_bytes import ExtraRecord, build_dtype
from wavebatch.files.las.header import LasHeader
from wavebatch.files.las.write_points import PointFile
from wavebatch.tools import return_stats as returns
from wavebatch.tools.return_stats import count_returns
from wavebatch.tools.simulate import DiscreteReceiver, simulate_returns


def write_cloud(path, time, z, number, total, *, flags=None, point_format=1):
    """A LAS file of points above each other, 1 mm units."""
    records = [] if flags is None else [ExtraRecord.build("echo_flags", "u2", "bits")]
    dtype = build_dtype(point_format, records)
    rows = np.zeros(len(z), dtype)
    rows["Z"] = np.rint(np.multiply(z, 1000))
    rows["bit_fields"] = np.asarray(number) | np.asarray(total) << 3
    if "gps_time" in dtype.names:
        rows["gps_time"] = time
    if flags is not None:
        rows["echo_flags"] = flags
    header = LasHeader((1, 2), point_format, 0, (0.001,) * 3, (0.0,) * 3)
    file = PointFile(path, header, dtype, records, overwrite=True)
    file.write(rows)
    file.finish_points()
    file.finish()
    publish_together([file.draft])
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
    assert found.separations["1-2"] == returns.Separation(2, pytest.approx(1.9), pytest.approx(0.8))
    assert found.separations["2-3"] == returns.Separation(1, pytest.approx(1.2), pytest.approx(1.2))
    assert found.separations["all"] == returns.Separation(3, pytest.approx(5.0 / 3), pytest.approx(0.8))
    assert math.isnan(found.dead_zone)


def test_small_cloud_is_counted(tmp_path):
    each, total = count_returns([write_cloud(tmp_path / "c.las", **SMALL)])
    check_small(each[0], "gps_time")
    check_small(total, "gps_time")
    assert each[0].flags is None


def test_order_of_points_does_not_matter(tmp_path, rng):
    order = rng.permutation(7)
    shuffled = {name: values[order] for name, values in SMALL.items()}
    check_small(count_returns([write_cloud(tmp_path / "c.laz", **shuffled)])[1], "gps_time")


def test_without_times_rising_numbers_make_a_pulse(tmp_path, monkeypatch):
    path = write_cloud(tmp_path / "c.las", **SMALL, point_format=0)
    check_small(count_returns([path])[1], "return_number")
    pieces = returns.CloudReader.read_pieces
    monkeypatch.setattr(returns.CloudReader, "read_pieces", lambda self, size=2: pieces(self, 2))
    check_small(count_returns([path])[1], "return_number")


def test_times_that_are_all_alike_are_not_used(tmp_path):
    many = {name: np.tile(values, 60) for name, values in SMALL.items()} | {"time": np.zeros(420)}
    found = count_returns([write_cloud(tmp_path / "c.las", **many)])[1]
    assert (found.pulses, found.pulses_by) == (240, "return_number")


@pytest.mark.parametrize("missing", [np.nan, 0.0])
def test_points_without_a_time_are_not_one_pulse(tmp_path, missing, monkeypatch):
    # Ten times the small cloud at times of their own; the pulse of three returns has lost its time in each.
    parts = {name: np.tile(values, 10) for name, values in SMALL.items()}
    parts["time"] = parts["time"] + 10.0 * np.repeat(np.arange(10), 7)
    parts["time"][np.tile(np.arange(7) < 3, 10)] = missing
    (found,), _ = count_returns([write_cloud(tmp_path / "a.las", **parts)])
    assert (found.pulses, found.pulses_by) == (40, "gps_time") and found.by_count[3] == pytest.approx(0.25)
    assert found.warnings[0].startswith("points without GPS time (0 or NaN): 30;")
    monkeypatch.setattr(temp_store, "BUCKET_ROWS", 5)
    (again,), _ = count_returns([tmp_path / "a.las"])
    assert again.by_count == found.by_count


def test_buckets_and_pieces_change_nothing(tmp_path, monkeypatch):
    receiver = DiscreteReceiver(most=3)
    simulate_returns("canopy.orion-22", tmp_path / "c.laz", pulses=3000, receiver=receiver)
    whole = count_returns([tmp_path / "c.laz"])[1]
    monkeypatch.setattr(temp_store, "BUCKET_ROWS", 500)
    parts = count_returns([tmp_path / "c.laz"])[1]
    assert parts.by_count == whole.by_count and parts.incomplete == whole.incomplete == 0
    assert parts.separations["1-2"].least == whole.separations["1-2"].least
    assert parts.separations["1-2"].mean == pytest.approx(whole.separations["1-2"].mean, rel=1e-12)
    assert any(line.startswith("limit") for line in whole.warnings)


@pytest.mark.parametrize(("deep", "limited"), [(1, False), (40, True)])
def test_a_few_deep_pulses_are_no_limit_of_the_sensor(tmp_path, deep, limited):
    count = np.r_[np.ones(50, int), np.full(deep, 4)]
    number = np.concatenate([np.arange(1, n + 1) for n in count])
    total, time = np.repeat(count, count), np.repeat(1.0 + np.arange(len(count)), count)
    found = count_returns([write_cloud(tmp_path / "c.las", time, -2.0 * number, number, total)])[1]
    assert any(line.startswith("limit") for line in found.warnings) == limited


def test_flags_are_counted_and_points_without_echo_are_no_pair(tmp_path):
    flags = [0, EchoFlag.NO_ECHO, 0, EchoFlag.WEAK | EchoFlag.OVERLAPPED, EchoFlag.OVERLAPPED, 0, 0]
    found = count_returns([write_cloud(tmp_path / "c.las", **SMALL, flags=flags)])[1]
    assert {name: n for name, n in found.flags.items() if n} == {"NO_ECHO": 1, "WEAK": 1, "OVERLAPPED": 2}
    assert found.separations["all"].pairs == 1


def test_total_is_the_sum_of_the_files(tmp_path):
    path = write_cloud(tmp_path / "a.las", **SMALL)
    other = write_cloud(tmp_path / "b.las", **SMALL, flags=[EchoFlag.WEAK] * 7)
    total = count_returns([path, other])[1]
    assert (total.points, total.pulses, total.incomplete) == (14, 8, 2)
    assert total.flags["WEAK"] == 7
    assert total.separations["1-2"].pairs == 4


def test_clouds_without_pairs_and_without_points(tmp_path):
    single = {name: values[3:4] for name, values in SMALL.items()}
    found = count_returns([write_cloud(tmp_path / "c.las", **single)])[1]
    assert found.separations["all"].pairs == 0 and found.warnings == ()
    none = {name: values[:0] for name, values in SMALL.items()}
    found = count_returns([write_cloud(tmp_path / "d.las", **none)])[1]
    assert (found.points, found.pulses) == (0, 0) and math.isnan(found.returns_per_pulse)


def test_real_file(riegl):
    found = count_returns([riegl])[1]
    assert (found.points, found.pulses) == (2535, 2368)
    assert found.by_number[1] == pytest.approx(0.9329, abs=1e-4)


def test_a_cloud_that_cannot_be_read_is_named_and_the_others_are_counted(tmp_path):
    good, bad = write_cloud(tmp_path / "good.las", **SMALL), tmp_path / "bad.las"
    bad.write_bytes(b"LASF" + bytes(300))
    with pytest.raises(InputError, match="bad.las"):
        count_returns([bad])
    result = CliRunner().invoke(stats, [str(bad), str(good), "--json"])
    assert result.exit_code == 1
    assert result.stderr.startswith(f"error: {bad}") and result.stderr.count("\n") == 1
    document = json.loads(result.stdout)
    assert [one["cloud"] for one in document["files"]] == [str(good)]
    assert document["total"]["pulses"] == 4 and document["total"]["dead_zone"] is None


def test_text_has_every_figure(tmp_path):
    path = write_cloud(tmp_path / "c.las", **SMALL, flags=[EchoFlag.WEAK] * 7)
    result = CliRunner().invoke(stats, [str(path)])
    assert result.exit_code == 0
    wanted = ("pulses            4", "57.14%", "1-2", "1.900", "0.800", "WEAK", "warning           incomplete: 1 of 4")
    for text in wanted:
        assert text in result.stdout
    other = write_cloud(tmp_path / "d.las", **SMALL)
    assert "total" in CliRunner().invoke(stats, [str(path), str(other)]).stdout
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
        bins = np.bincount((100 * distance).astype(int), minlength=returns.BINS)
        found = returns.find_dead_zone(bins[: returns.BINS])
        misses.append((found.size - 0.7) / found.error)
    assert 0.4 < np.sqrt(np.mean(np.square(misses))) < 1.6
    assert np.min(misses) > -1.01


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


def test_hidden_pairs_are_those_that_as_many_as_just_above_the_zone_would_be(tmp_path):
    """Distances at least 1 m, 300 per metre up to 2 m and 100 per metre beyond: the zone hides 300 of 1000 pulses."""
    apart = np.concatenate([np.linspace(1.0, 1.999, 300), np.linspace(2.0, 8.999, 700)])
    time, number = np.repeat(1.0 + np.arange(1000), 2), np.tile([1, 2], 1000)
    z = 100.0 - np.stack([np.zeros(1000), apart], axis=1).ravel()
    found = count_returns([write_cloud(tmp_path / "c.las", time, z, number, np.full(2000, 2))])[1]
    assert found.dead_zone == pytest.approx(1.0, abs=0.011)
    assert found.hidden == pytest.approx(0.3, abs=0.006)
    assert any(line.startswith("dead zone") and "0.30" in line for line in found.warnings)
