"""Calibration of several strips and channels together, against an independent simulator."""

import json
from dataclasses import replace

import laspy
import numpy as np
import pytest
from commands import fail, succeed
from commands import run_command as call

import wavebatch as wb
from tests.facet_strips import FARMLAND, START, Sensor, compare_fields, write_field, write_strip
from wavebatch.core.order import group_medians
from wavebatch.surveying.calibrating.adjust_flight import TIE, VIEW, Anchors, Ties, adjust_constants, measure_ties
from wavebatch.surveying.calibrating.calibrate_flight import find_trend, fit_swath
from wavebatch.surveying.calibrating.calibration_files import load_calibration

GAINS = {("a", 1): 1.0, ("b", 1): 1.08, ("c", 1): 0.95, ("c", 2): 0.4275}
"""Of each strip and channel: strips drift, and channel 2 has 0.45 of the gain of channel 1."""
LIGHT = 1.2e8
TRUE = 4.0 / (LIGHT * 2.0)
SLOPE = (0.02, 0.01)


@pytest.fixture(scope="module")
def flight(tmp_path_factory):
    """Three strips that overlap; the only target lies on a and c, and c has two channels. Strip d overlaps none."""
    folder = tmp_path_factory.mktemp("flight")
    ground = [replace(facet, slope=SLOPE) for facet in FARMLAND]
    base = {"speed": 30.0, "rate": 20_000.0, "half_angle": 8.0}
    sensors = {
        "a": Sensor(**base, light=LIGHT),
        "b": Sensor(**base, light=1.08 * LIGHT, start=(110, 90), heading=270.0, time=START + 600),
        "c": Sensor(**base, light=0.95 * LIGHT, start=(0, -100), gains={1: 1.0, 2: 0.45}, time=START + 900),
        "d": Sensor(**base, light=LIGHT, start=(5000, 0), time=START + 1200),
    }
    for seed, (name, sensor) in enumerate(sensors.items()):
        write_strip(folder / f"{name}.las", ground, sensor, 40_000, seed=seed)
    write_field(folder / "t.csv")
    strips = [folder / f"{name}.las" for name in sensors]
    options = ("--targets", folder / "t.csv", "-o", folder / "cal.toml", "--divergence", 0.5)
    outputs = ("--report", folder / "cal.json", "--html", folder / "cal.html")
    done = succeed("calibrate", *strips, *options, *outputs)
    return folder, done.stderr


@pytest.mark.slow
def test_strips_and_channels_without_a_target_get_their_constants_by_ties(flight):
    folder, _ = flight
    rows = {(row.strip[0], row.digitizer): row for row in load_calibration(folder / "cal.toml").strips}
    assert rows.keys() == GAINS.keys()
    for key, row in rows.items():
        assert row.constant * GAINS[key] / TRUE == pytest.approx(1.0, abs=0.002), key
        assert row.relative_error == pytest.approx(0.03, abs=0.002)
        assert row.ties > 100
    mean = np.mean([-np.log(GAINS[name, 1]) for name in "abc"])
    for name in "abc":
        assert rows[name, 1].drift == pytest.approx(np.exp(-np.log(GAINS[name, 1]) - mean) - 1, abs=0.002)
        assert 0 < rows[name, 1].drift_error < 0.002


@pytest.mark.slow
def test_a_channel_has_the_mean_constant_and_an_error_that_holds_the_drift(flight):
    first, second = load_calibration(flight[0] / "cal.toml").channels
    assert first.relative_error == pytest.approx(np.hypot(0.03, np.std(np.log([1, 1.08, 0.95]), ddof=1)), rel=0.02)
    assert second.constant * 0.4275 / TRUE == pytest.approx(1.0, abs=0.002)
    assert second.relative_error == pytest.approx(first.relative_error, rel=0.02)


@pytest.mark.slow
def test_a_strip_that_nothing_ties_is_named_and_has_no_constant(flight):
    folder, said = flight
    assert "warning: d.las: has no constant: no target lies on it" in said
    assert all(row.strip != "d.las" for row in load_calibration(folder / "cal.toml").strips)


@pytest.mark.slow
def test_drifts_and_overlaps_are_told_reported_and_drawn(flight):
    folder, said = flight
    assert "b.las: its constant is -6." in said
    (row,) = [line.split() for line in said.splitlines() if line.startswith("  b.las over a.las ")]
    assert row[4].startswith("+8.") and row[5].startswith("+0.0")
    report = json.loads((folder / "cal.json").read_text())
    pair = next(row for row in report["pairs"] if (row["a"], row["b"]) == ("b.las", "a.las"))
    assert pair["ratio"] == pytest.approx(1.08, abs=0.003) and pair["after"] == pytest.approx(1.0, abs=0.002)
    assert abs(pair["height"]) < 0.003
    assert "Calibrated light of the first over the second" in (folder / "cal.html").read_text("utf-8")


@pytest.mark.slow
def test_every_strip_is_run_with_its_own_constant(tmp_path, flight):
    folder, _ = flight
    done = call("run", folder / "b.las", folder / "c.las", "-o", tmp_path, "--calibration", folder / "cal.toml")
    assert done.exit_code == 0 and "warning" not in done.stderr, done.output
    for name in "bc":
        cloud = wb.read_cloud(tmp_path / f"{name}.laz")
        off, good = compare_fields(cloud, cloud["backscatter_coefficient"] / 4)
        assert np.median(off[good]) == pytest.approx(0.0, abs=0.02)


def make_ties(rng, constants, cells, outliers=0.0):
    """Ties of sources that each see half of the cells."""
    bright = rng.normal(-1, 0.4, cells)
    seen = np.argsort(rng.random((cells, len(constants))), axis=1)[:, :2]
    cell = np.repeat(np.arange(cells), 2)
    source = seen.ravel()
    value = bright[cell] - np.asarray(constants)[source] + rng.normal(0, 0.01, 2 * cells)
    value[rng.random(2 * cells) < outliers] += 0.7
    centre = np.column_stack([5.0 * cell, np.zeros(2 * cells)])
    zero = np.zeros(2 * cells)
    return Ties(cell, source, value, np.full(2 * cells, 0.005), zero, zero, centre, 5.0)


def test_the_adjustment_is_not_pulled_by_wet_or_moved_cells(rng):
    constants = np.array([0.0, 0.3, -0.2, 0.1])
    ties = make_ties(rng, constants, 2000, outliers=0.1)
    given = np.array([0.0, np.nan, np.nan, np.nan])
    found = adjust_constants(ties, Anchors(given, np.full(4, 0.01)))
    assert np.abs(found.value - constants).max() < 0.01


@pytest.mark.slow
def test_the_errors_of_the_adjustment_hold_its_errors(rng):
    constants = np.array([0.0, 0.3, -0.2])
    ratios = []
    for _ in range(60):
        ties = make_ties(rng, constants, 120)
        given = np.array([rng.normal(0, 0.01), np.nan, rng.normal(-0.2, 0.02)])
        found = adjust_constants(ties, Anchors(given, np.array([0.01, np.nan, 0.02])))
        ratios += list((found.value - constants) / found.error)
    assert 0.55 < np.mean(np.abs(ratios) < 1) < 0.8


@pytest.mark.parametrize(("strips", "is_told"), [("abc", True), ("ab", False), ("ac", False)])
def test_strips_of_three_headings_tell_light_that_falls_from_side_to_side(rng, strips, is_told):
    """a and c fly east, b flies back between them: light falls by a tenth to the right of each."""
    heading, middle = zip(*({"a": (1, 0.0), "b": (-1, 60.0), "c": (1, 100.0)}[name] for name in strips), strict=True)
    place = rng.uniform(-100, 200, 3000)
    angle = np.stack([sign * (place - at) / 1000 for sign, at in zip(heading, middle, strict=True)])
    seen = np.abs(angle) < 0.1
    source, cell = np.nonzero(seen & (seen.sum(axis=0) > 1))
    view = np.zeros(len(cell), VIEW)
    view["angle"] = angle[source, cell]
    zero = np.zeros(len(cell))
    # A strip sees light / constant: where the constant grows by exp(c u), the light falls by it.
    value = rng.normal(-1, 0.4, 3000)[cell] - view["angle"] + rng.normal(0, 0.01, len(cell))
    ties = Ties(cell, source, value, zero + 0.01, zero, zero, np.stack([place[cell], zero], axis=1), 5.0, view)
    anchors = Anchors(np.zeros(len(strips)), np.full(len(strips), 0.01), None)
    at_targets, one = np.zeros(len(strips), VIEW), np.zeros(len(strips), int)
    adjusted, (most, square, fourth, side), edge, left_open = fit_swath(ties, anchors, at_targets, one)
    assert most == pytest.approx(0.1, abs=0.001) and 0.0 < edge < 0.05
    if is_told:
        assert side == pytest.approx(0.1, abs=0.01) and abs(square + fourth) < 0.02 and left_open is None
        assert np.abs(adjusted.value).max() < 0.02
    else:
        assert side == 0 and 0.03 < left_open < 0.2
    # Without a term, strips of one heading differ in their constants: light may fall by as much, or they drift.
    _, swath, edge, left_open = fit_swath(ties, anchors, at_targets, one, asked=False)
    assert swath == () and edge == 0.0
    assert left_open == (None if is_told else pytest.approx(0.05 * (strips == "ac"), abs=0.02))


def test_one_block_of_ties_proves_no_trend(rng):
    """All its resamples are the same: of overlaps of 40 cells, 49 of 60 sound pairs changed with the scan angle."""
    zero, cell, source = np.zeros(80), np.repeat(np.arange(40), 2), np.tile([0, 1], 40)
    anchors, named = Anchors(np.array([0.0, np.nan]), np.array([0.03, np.nan]), None), 0
    for _ in range(20):
        place = rng.uniform(0, 49, (40, 2))[cell]
        view = np.zeros(80, VIEW)
        view["angle"] = np.where(source, 40 - place[:, 1], place[:, 1]) / 700
        value = rng.normal(0, 0.3, 40)[cell] + rng.normal(0, 0.05, 80)
        ties = Ties(cell, source, value, zero + 0.01, zero, zero, place, 5.0, view)
        named += find_trend(ties, anchors, np.zeros(2, VIEW), adjust_constants(ties, anchors)) is not None
    assert named < 4


def test_sources_without_ties_stay_unknown(rng):
    ties = make_ties(rng, np.zeros(2), 5)
    found = adjust_constants(ties, Anchors(np.array([0.0, np.nan, 0.4]), np.full(3, 0.01)))
    assert np.isfinite(found.value).tolist() == [True, False, True]


def test_channels_without_any_tie_have_the_constants_of_their_targets():
    nothing = measure_ties(np.zeros(0, TIE), 5.0)
    found = adjust_constants(nothing, Anchors(np.array([0.1, np.nan, 0.4]), np.array([0.01, np.nan, 0.02])))
    assert found.value[[0, 2]].tolist() == pytest.approx([0.1, 0.4], rel=1e-9) and np.isnan(found.value[1])
    assert found.error[[0, 2]] == pytest.approx([0.01, 0.02], rel=0.35)
    anchors, seen = Anchors(np.zeros(2), np.full(2, 0.01)), np.zeros(2, VIEW)
    assert fit_swath(nothing, anchors, seen, np.array([4, 8]), asked=False)[1:] == ((), 0.0, None)


def test_cells_that_are_rough_or_seen_in_one_line_tie_nothing(rng):
    def rows(source, xy, z):
        out = np.zeros(len(xy), TIE)
        out["xyz"] = np.column_stack([xy, z])
        out["ray"], out["light"], out["source"] = (0.0, 0.0, -1.0), 2.0, source
        return out

    def spread(n, x=0.0):
        return rng.uniform(0, 5, (n, 2)) + [x, 0]

    line = np.column_stack([rng.uniform(10, 15, 30), np.full(30, 2.0)])
    parts = []
    for source in (0, 1):
        parts += [rows(source, spread(20), rng.normal(0, 0.01, 20))]
        parts += [rows(source, spread(20, 5.0), rng.uniform(0, 2, 20))]
        parts += [rows(source, line, rng.normal(0, 0.01, 30)), rows(source, spread(3, 20.0), np.zeros(3))]
    ties = measure_ties(np.concatenate(parts), 5.0)
    assert set(map(tuple, ties.centre)) == {(2.5, 2.5)}
    assert np.exp(ties.value) == pytest.approx([0.5, 0.5], rel=1e-3)


@pytest.fixture(scope="module")
def clouds(flight, tmp_path_factory):
    """Clouds of strips a and b with the flight's calibration, and of b with that of a."""
    folder, out = flight[0], tmp_path_factory.mktemp("clouds")
    text = (folder / "cal.toml").read_text()
    # Without the rows of the strips both get the mean constant of the channel, and their drifts show.
    (out / "mean.toml").write_text(text[: text.index("[[flight_strip]]")])
    for name, cal in (("own", folder / "cal.toml"), ("mean", out / "mean.toml")):
        succeed("run", folder / "a.las", folder / "b.las", "-o", out / name, "--calibration", cal)
    return out


def read_cells(path):
    """Median gamma, taken to a facing surface by the scan angle, and median height of cells of 5 m."""
    cloud = laspy.read(path)
    alone = np.array(cloud.number_of_returns) <= 1
    gamma = np.array(cloud.backscatter_coefficient) / np.cos(np.radians(0.006 * np.array(cloud.scan_angle)))
    keys, cell = np.unique(np.floor(cloud.xyz[alone, :2] / 5.0), axis=0, return_inverse=True)
    light, height = (group_medians(values[alone], cell.ravel())[0] for values in (gamma, np.array(cloud.z)))
    return dict(zip(map(tuple, keys), zip(light, height, strict=True), strict=True))


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "ratio"), [("own", 0.0), ("mean", 1 / 1.08 - 1)])
def test_overlapping_clouds_differ_as_their_constants(clouds, kind, ratio):
    a, b = (read_cells(clouds / kind / f"{name}.laz") for name in "ab")
    pairs = np.array([(*a[cell], *b[cell]) for cell in sorted(a.keys() & b.keys())])
    assert len(pairs) > 100
    assert np.median(pairs[:, 0] / pairs[:, 2]) - 1 == pytest.approx(ratio, abs=0.01)
    assert np.median(pairs[:, 1] - pairs[:, 3]) == pytest.approx(0, abs=0.003)


@pytest.mark.slow
def test_a_strip_in_a_folder_is_never_replaced(flight, tmp_path):
    folder, _ = flight
    strip = tmp_path / "a.las"
    strip.write_bytes((folder / "a.las").read_bytes())
    for options, reason in ((("-o", strip), "must end in .toml; choose another name"),
                            (("-o", tmp_path / "cal.toml", "--report", strip), "would replace this input")):
        fail(2, reason, "calibrate", tmp_path, "--targets", folder / "t.csv", *options, "--overwrite")
    assert strip.read_bytes() == (folder / "a.las").read_bytes()
