"""PointFilter: every point that is left out counts for the first test that it does not meet."""

import pickle
from types import SimpleNamespace

import numpy as np
import pytest
from commands import refuses

from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.point_filter import EVERY, TESTS, PointFilter, check_bbox
from wavebatch.files.geojson import Polygon, find_inside

ROWS = {
    "x": np.array([0.0, 1.0, 2.0, 3.0, 4.0, np.nan]),
    "y": np.zeros(6),
    "echo_flags": np.array([0, 1, 2, 3, 0, 2], np.uint16),
    "classification": np.array([2, 2, 2, 2, 6, 2]),
    "amplitude": np.array([5.0, 9.0, 9.0, 9.0, 9.0, np.nan]),
}


def read(name):
    return lambda rows: rows[name]


def plan(chosen, *lacks):
    def find(name):
        if name not in ROWS:
            raise ConfigError(f"there is no {name!r}")
        return read(name)

    return chosen.plan({name: read(name) for name in ROWS if name not in lacks}, find, "c.las")


def reasons(chosen):
    return [("", *TESTS)[number] for number in plan(chosen).test(ROWS, 6).tolist()]


@pytest.mark.parametrize(
    ("chosen", "expected"),
    [
        (EVERY, [""] * 6),
        (PointFilter(drop_flags=1), ["", "drop_flags", "", "drop_flags", "", ""]),
        (PointFilter(flags=3), ["flags", "", "", "", "flags", ""]),
        (PointFilter(classes=(2, 5)), ["", "", "", "", "classes", ""]),
        (PointFilter(bbox=(1.0, -1.0, 3.0, 0.0)), ["bbox", "", "", "", "bbox", "bbox"]),
        (PointFilter.build(where="amplitude > 6"), ["where", "", "", "", "", "where"]),
        (PointFilter.build(where="not amplitude > 6"), ["", *["where"] * 5]),
        (
            PointFilter(drop_flags=1, classes=(2,), bbox=(0.0, 0.0, 2.5, 1.0), where=PointFilter.build(
                where="amplitude > 6").where),
            ["where", "drop_flags", "", "drop_flags", "classes", "bbox"],
        ),
    ],
)  # fmt: skip
def test_the_first_reason_counts(chosen, expected):
    assert reasons(chosen) == expected
    assert bool(chosen) == (chosen is not EVERY)


def test_points_lie_in_one_of_the_polygons():
    squares = [Polygon("", (np.array([(x, -1.0), (x + 1.5, -1.0), (x + 1.5, 1.0), (x, 1.0)]),)) for x in (0.5, 2.5)]
    assert reasons(PointFilter(polygons=tuple(squares))) == ["polygon", "", "polygon", "", "polygon", "polygon"]


def test_a_point_on_the_border_of_two_polygons_lies_in_one_of_them():
    low, high = (np.array([(0.0, y), (1.0, y), (1.0, y + 1), (0.0, y + 1)]) for y in (0.0, 1.0))
    left, beside = low - [1.0, 0.0], low + [1.0, 0.0]
    x, y = np.array([0.0, 1.0, 0.5]), np.array([0.5, 0.5, 1.0])
    found = np.stack([find_inside([ring], x, y) for ring in (left, low, beside, high)])
    assert found.sum(axis=0).tolist() == [1, 1, 1]


def test_columns_that_are_missing_are_named():
    with pytest.raises(ConfigError, match="--where: character 10: there is no 'high'"):
        plan(PointFilter.build(where="x > 1 or high > 2"))
    with pytest.raises(ConfigError, match=r"^c\.las: has no column echo_flags to select points by"):
        plan(PointFilter(flags=1), "echo_flags")
    assert plan(PointFilter(classes=(2,)), "echo_flags").test(ROWS, 6).any()


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"classes": []}, "--classes"),
        ({"classes": [256]}, "--classes"),
        ({"bbox": (1.0, 0.0, 1.0, 2.0)}, "--bbox"),
        ({"bbox": (0.0, 0.0, 1.0, np.inf)}, "--bbox"),
        ({"drop_flags": "NOTHING"}, "--drop-flags"),
        ({"where": "x >"}, "--where"),
        ({"polygon": "none.geojson"}, "none.geojson"),
    ],
)
def test_wrong_options_are_refused(options, words):
    refuses(ConfigError, words, PointFilter.build, **options)


@pytest.mark.parametrize(
    ("x", "y", "bbox", "words"),
    [
        ((5e5, 500900), (5400200, 5400300), (500100, 500900, 5400200, 5400300), "give 500100,5400200,500900,5400300"),
        ((9.0, 9.1), (48.7, 48.8), (9.02, 9.05, 48.7, 48.75), "give 9.02,48.7,9.05,48.75"),
        ((0, 2.4), (200, 426), (1, 1, 300, 410), None),
        ((0, 20), (50, 900), (10, 10, 400, 600), None),
        ((0, 20), (50, 900), (5, 10, 400, 600), None),
        ((0, 10), (200, 210), (5, 5, 205, 207), None),
        ((0, 10), (200, 210), (5, 7, 205, 205), None),
    ],
)
def test_a_box_in_another_order_is_told_from_a_large_one(x, y, bbox, words):
    extent = SimpleNamespace(mins=(x[0], y[0], 0), maxs=(x[1], y[1], 0))
    if words is None:
        assert check_bbox(bbox, "a.las", extent) is None
    else:
        refuses(ConfigError, words, check_bbox, bbox, "a.las", extent)


def test_a_filter_travels_between_processes():
    chosen = PointFilter.build(where="x > 1", classes=[6, 2, 2], bbox=(0, 0, 1, 1), drop_flags="weak,SATURATED")
    again = pickle.loads(pickle.dumps(chosen))
    assert again == chosen and again.describe() == chosen.describe()
    assert again.classes == (2, 6) and again.describe()["drop_flags"] == ["SATURATED", "WEAK"]
