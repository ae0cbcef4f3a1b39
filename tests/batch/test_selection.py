"""What `run` writes with --where and its like: the points of a full run, and all others counted."""

import json

import laspy
import numpy as np
import pytest
from commands import run_command, succeed

import wavebatch as wb
from wavebatch.batch.counts import LEFT_OUT
from wavebatch.core.condition import parse_condition
from wavebatch.core.echoes import EchoFlag
from wavebatch.core.errors import ConfigError
from wavebatch.files.cloud.cloud_reader import CloudReader
from wavebatch.files.cloud.point_filter import PointFilter


def _run(strip, folder, **options):
    """The records of the cloud of a run, its report, and the result."""
    result = wb.run(strip, folder, **{"chain": "balanced", **options})
    assert not result.failed, result.outcomes[0].error
    (path,) = [path for path in folder.iterdir() if path.suffix in (".laz", ".las")]
    report = json.loads((folder / f"{path.stem}.report.json").read_text())
    return laspy.read(path), report


@pytest.fixture(scope="module")
def full(riegl, tmp_path_factory):
    """All points of the strip, as records."""
    return _run(riegl, tmp_path_factory.mktemp("full"))


def _bits(las):
    return np.asarray(las["echo_flags"])


def _box(las):
    """A box around the middle half."""
    (west, south), (east, north) = (np.quantile(np.c_[las.x, las.y], q, axis=0) for q in (0.2, 0.8))
    return (float(west), float(south), float(east), float(north))


def _check_sums(report, written):
    counts = report["counts"]
    left = counts["left_out"]
    assert set(left) == set(LEFT_OUT)
    assert counts["points_out"] == written
    assert written + sum(left.values()) == counts["echoes"] + sum(counts["passed_through"].values())


def _area(path, box):
    west, south, east, north = box
    ring = [[west, south], [east, south], [east, north], [west, north], [west, south]]
    feature = {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}}
    path.write_text(json.dumps({"type": "FeatureCollection", "features": [feature]}))
    return path


def test_points_on_the_edge_of_a_box_are_in_it(riegl, full, tmp_path):
    las, _ = full
    x, y = np.asarray(las.x), np.asarray(las.y)
    some, report = _run(riegl, tmp_path, bbox=(x.min(), y.min(), x.max(), y.max()))
    assert len(some.points) == len(las.points) and report["counts"]["left_out"]["bbox"] == 0


def test_each_option_writes_points_of_the_full_run_and_counts_the_others(riegl, full, tmp_path):
    las, whole = full
    box = _box(las)
    width, x, y = np.asarray(las["echo_width"]), np.asarray(las.x), np.asarray(las.y)
    inside = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
    first = int(np.asarray(las.classification)[0])
    cases = {
        "where": (
            "echo_width < 4.5 and return_number == 1",
            (width < 4.5) & (width != -9999) & (las.return_number == 1),
        ),
        "bbox": (box, inside),
        "polygon": (_area(tmp_path / "a.geojson", box), inside),
        "classes": ([first, 77], np.asarray(las.classification) == first),
    }
    for name, (value, chosen) in cases.items():
        some, report = _run(riegl, tmp_path / name, **{name: value})
        if name == "polygon":  # points on the border may be on either side
            assert abs(len(some.points) - chosen.sum()) < 5
        else:
            np.testing.assert_array_equal(some.points.array, las.points.array[np.asarray(chosen)])
            assert report["counts"]["left_out"][name] == np.count_nonzero(~np.asarray(chosen))
        _check_sums(report, len(some.points))
        written = {flag.name: int(np.count_nonzero(_bits(some) & flag)) for flag in EchoFlag}
        assert report["counts"]["flags"] == written
        for same in ("echoes", "waveforms", "points_in", "no_data", "passed_through"):
            assert report["counts"][same] == whole["counts"][same]


def test_a_point_counts_for_the_first_reason_that_leaves_it_out(riegl, full, tmp_path):
    las, _ = full
    box = _box(las)
    some, report = _run(riegl, tmp_path, where="z < 0", bbox=box, drop_flags="weak")
    weak = (_bits(las) & EchoFlag.WEAK) > 0
    # As numbers: laspy compares its views by rounded record values, in which a point beyond a border may lie on it.
    x, y = np.asarray(las.x), np.asarray(las.y)
    inside = (x >= box[0]) & (x <= box[2]) & (y >= box[1]) & (y <= box[3])
    expected = {"drop_flags": weak.sum(), "bbox": (~weak & ~inside).sum(), "where": (~weak & inside).sum()}
    assert {name: n for name, n in report["counts"]["left_out"].items() if n} == expected
    assert len(some.points) == 0
    assert any("no point is written" in one["text"] for one in report["warnings"])
    _check_sums(report, 0)


def test_dropped_flags_are_no_echoes_of_their_pulse(riegl, full, tmp_path):
    las, _ = full
    some, report = _run(riegl, tmp_path, drop_flags="OVERLAPPED,WEAK")
    kept = (_bits(las) & (EchoFlag.OVERLAPPED | EchoFlag.WEAK)) == 0
    assert 0 < report["counts"]["left_out"]["drop_flags"] == np.count_nonzero(~kept)
    for name in ("X", "Y", "Z", "echo_width", "gps_time"):
        np.testing.assert_array_equal(some.points.array[name], las.points.array[name][kept])
    # The numbers of a pulse count from 1 without a gap, up to the number of its points that are left.
    known = _whole_times(las)
    for time in known:
        rows = np.asarray(some.gps_time) == time
        numbers = np.sort(np.asarray(some.return_number)[rows])
        np.testing.assert_array_equal(numbers, np.arange(len(numbers)) + 1)
        assert set(np.asarray(some.number_of_returns)[rows]) <= {len(numbers)}
    renumbered = np.asarray(las.number_of_returns)[kept] != np.asarray(some.number_of_returns)
    assert renumbered.sum() > 10


def _whole_times(las):
    """Times of pulses with as many points as they say; points far apart in the file are different pulses."""
    times, pulse, size = np.unique(np.asarray(las.gps_time), return_inverse=True, return_counts=True)
    wrong = np.unique(pulse[size[pulse] != np.asarray(las.number_of_returns)])
    return np.delete(times, wrong)


def test_where_sees_the_numbers_without_dropped_echoes(riegl, full, tmp_path):
    some, _ = _run(riegl, tmp_path, drop_flags="OVERLAPPED", where="number_of_returns == 1")
    assert len(some.points) and set(np.asarray(some.number_of_returns)) == {1}
    times, sizes = np.unique(np.asarray(some.gps_time), return_counts=True)
    assert sizes[np.isin(times, _whole_times(full[0]))].max() == 1


@pytest.mark.parametrize("names", ["wavebatch", "riegl", "asprs"])
def test_columns_that_are_not_written_or_in_other_units_decide_all_the_same(riegl, full, tmp_path, names):
    las, _ = full
    where = "echo_width < 4.5 and amplitude >= 100"
    some, _ = _run(riegl, tmp_path, where=where, names=names, columns="amplitude")
    chosen = find_keep_mask(las, where)
    np.testing.assert_array_equal(some.points.array["Z"], las.points.array["Z"][chosen])
    assert "echo_width" not in some.point_format.dimension_names


def find_keep_mask(las, text):
    condition = parse_condition(text)
    values = {}
    for name in condition.columns:
        stored = f"wb_{name}" if f"wb_{name}" in las.point_format.dimension_names else name
        values[name] = np.where(np.asarray(las[stored]) == -9999, np.nan, las[stored])
    return condition.choose(values)


def test_columns_of_a_second_pass_decide_after_it(riegl, tmp_path):
    """Normals are those of all points; selection comes after them."""
    columns = "+incidence_angle_normals"
    las, _ = _run(riegl, tmp_path / "all", columns=columns)
    chosen = find_keep_mask(las, "incidence_angle_normals < 20")
    assert 0 < chosen.sum() < len(chosen)
    for name, more in (("a", {"columns": columns}), ("b", {"columns": "amplitude"})):
        some, report = _run(riegl, tmp_path / name, where="incidence_angle_normals < 20", **more)
        np.testing.assert_array_equal(some.points.array["Z"], las.points.array["Z"][chosen])
        assert report["counts"]["left_out"]["where"] == np.count_nonzero(~chosen)
        last = np.asarray(las.return_number) == np.asarray(las.number_of_returns)
        lost = int(np.count_nonzero(last & ~chosen))
        assert report["quality"]["last_echoes_left_out"] == lost
        told = [line for line in report["remarks"] if f"--where: {lost} of the {np.count_nonzero(~chosen)}" in line]
        assert len(told) == (lost > 0)
        _check_sums(report, int(chosen.sum()))
    first, _ = _run(riegl, tmp_path / "c", where="incidence_angle_normals < 20", columns=columns)
    np.testing.assert_array_equal(first["incidence_angle_normals"], las["incidence_angle_normals"][chosen])


def test_resume_redoes_a_cloud_of_another_selection(riegl, tmp_path):
    area = _area(tmp_path / "a.geojson", (0.0, 0.0, 1e7, 1e7))

    def status(**options):
        return wb.run(riegl, tmp_path / "out", chain="fast", resume=True, **options).outcomes[0].status

    assert status(where="z > 0") == "written"
    assert status(where="z > 0") == "skipped"
    assert status(where="z > 1") == "written"
    assert status() == "written"
    assert status(polygon=area) == "written"
    assert status(polygon=area) == "skipped"
    _area(area, (0.0, 0.0, 2e7, 1e7))
    assert status(polygon=area) == "written"


def test_the_summary_says_what_is_left_out(riegl, tmp_path):
    words = ["run", str(riegl), "-o", str(tmp_path), "--profile", "fast", "--where", "z > 1e6", "--drop-flags", "WEAK"]
    result = succeed(*words)
    assert "-> 0 points; left out: " in result.output and " by --drop-flags, " in result.output
    assert "no point is written" in run_command(*words, "--overwrite", "--quiet").output


def test_the_workers_of_a_cluster_need_not_see_the_polygons(tiny_strip, tmp_path, monkeypatch):
    """They are read before anything starts, and may lie on this machine alone; files of the work must be there."""

    def refuse(address, folder, files):
        seen.extend(files)
        raise ConfigError("stop")

    seen = []
    monkeypatch.setattr("wavebatch.batch.workers.dask_cluster.Cluster", refuse)
    path, energy = tmp_path / "path.txt", tmp_path / "energy.txt"
    path.write_text("time x y z\n0 0 0 900\n1 9 9 900\n")
    energy.write_text("time energy\n0 1\n1 1\n")
    with pytest.raises(ConfigError, match="stop"):
        wb.run(tiny_strip, tmp_path, polygon=_area(tmp_path / "a.json", (0, 0, 1, 1)), energy=energy,
               trajectory=path, scheduler="tcp://there:8786")  # fmt: skip
    assert sorted(seen) == sorted([tiny_strip, path, energy])


@pytest.mark.parametrize(
    ("names", "where"),
    [("wavebatch", "echo_width < 4.5"), ("riegl", "'Echo Width' < 4.65"), ("pdal", "AMPLITUDE > 30 and z > 0")],
)
def test_conditions_of_a_cloud_read_as_those_of_its_run(full, riegl, tmp_path, names, where):
    """One grammar and one resolution of names: `stats --where` takes what `run --where` would have written."""
    some, _ = _run(riegl, tmp_path / "some", where=where, names=names)
    _run(riegl, tmp_path / "all", names=names)
    path = next((tmp_path / "all").glob("*.laz"))
    with CloudReader(path) as reader:
        keep = reader.plan(PointFilter.build(where=where))
    raw = laspy.read(path).points.array
    assert 0 < len(some.points) == np.count_nonzero(keep.test(raw, len(raw)) == 0)
