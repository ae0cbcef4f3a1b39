"""`plot section`, `plot profile`, `slice --cube` and `plot cube`: what is drawn equals a plain count."""

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from commands import fail, refuses, succeed
from commands import run_command as run
from plot_tools import write_cloud
from writer_tools import write_points

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.units import HALF_C
from wavebatch.files.strip.reader import StripReader
from wavebatch.tools.plots import sections
from wavebatch.tools.plots.sections import cut_section, measure_profile
from wavebatch.tools.scan_slices import ScanLine, Segment, read_scan_lines
from wavebatch.tools.slice_output import SegmentWriter, align_pulses, cut_cube, write_cube
from wavebatch.tools.voxels.grid import COLUMNS

LINE = (500_005.0, 5_400_003.0, 500_030.0, 5_400_020.0)


@pytest.fixture
def cloud(tmp_path):
    value = np.random.default_rng(4).normal(50, 10, 5000).astype("f4")
    value[:100] = -1
    return write_cloud(tmp_path / "c.las", amplitude=(value, np.array([-1.0]), None, "peak [DN]"))


@pytest.fixture
def voxels(tmp_path):
    rng = np.random.default_rng(5)
    index = rng.integers(0, 40, (3000, 3)).astype(np.int32)
    energy = rng.uniform(0, 100, 3000).astype("f4")
    np.savez(tmp_path / "v.npz", index=index, energy=energy, origin=np.array([10.0, 20.0, 100.0]), size=0.5, crs="",
             meta="{}")  # fmt: skip
    return tmp_path / "v.npz", np.array([10.0, 20.0, 100.0]) + 0.5 * (index + 0.5), energy


def test_a_section_has_the_points_beside_its_line(cloud):
    found = cut_section([cloud], "amplitude", line=LINE, width=3.0)
    las = laspy.read(cloud)
    places = np.stack([las.x, las.y], axis=1) - LINE[:2]
    value = np.array(las["amplitude"])
    step = np.subtract(LINE[2:], LINE[:2])
    length = np.hypot(*step)
    along, across = places @ step / length, (step[0] * places[:, 1] - step[1] * places[:, 0]) / length
    keep = (along >= 0) & (along <= length) & (np.abs(across) <= 1.5) & (value != -1)
    assert 100 < keep.sum() == found.inside == len(found.value)
    assert found.along == pytest.approx(along[keep], abs=1e-6)
    assert found.height == pytest.approx(np.array(las.z)[keep]) and np.array_equal(found.value, value[keep])
    assert found.total.no_data == 100 and (found.crs.name, found.crs.unit) == ("", "m")


def test_a_section_of_many_points_is_an_even_sample_that_says_so(cloud, tmp_path):
    found = cut_section([cloud], "z", line=LINE, width=10.0, most=300)
    assert len(found.value) <= 300 < found.inside
    sections.draw_section(found, tmp_path / "s.svg", aspect=2)
    text = (tmp_path / "s.svg").read_text("utf-8")
    assert "are drawn" in text and "heights 2 times exaggerated" in text


def test_without_a_line_the_longer_extent_is_cut(cloud):
    found = cut_section([cloud], "z")
    x0, y0, x1, y1 = found.line
    assert abs(y1 - y0) < 0.2 * (x1 - x0) and 38 < found.along.max() - found.along.min() <= 45
    assert found.width == pytest.approx(np.hypot(x1 - x0, y1 - y0) / 50)


def test_sections_of_voxels(voxels):
    path, place, energy = voxels
    found = cut_section([path], "energy", line=(10.0, 30.0, 30.0, 30.0), width=2.0)
    keep = np.abs(place[:, 1] - 30.0) <= 1.0
    assert found.voxel == 0.5 and found.inside == keep.sum() > 100
    assert found.along == pytest.approx(place[keep, 0] - 10.0) and found.value == pytest.approx(energy[keep])
    assert found.facts.unit == next(column.unit for column in COLUMNS if column.name == "energy")


def test_profiles_count_sum_and_average(cloud, voxels):
    las = laspy.read(cloud)
    height, value = np.array(las.z), np.array(las["amplitude"], np.float64)
    count = measure_profile([cloud], None, "count", size=2.0)
    assert count.values[0].tolist() == np.histogram(height, count.edges)[0].tolist()
    assert count.values.sum() + count.outside == 5000 and np.all(count.edges % 2.0 == 0)
    known = value != -1
    both = measure_profile([cloud, cloud], "amplitude", "mean", size=2.0, each=True)
    sums = np.histogram(height[known], both.edges, weights=value[known])[0]
    number = np.histogram(height[known], both.edges)[0]
    full = number > 0
    for row in both.values:
        assert row[full] == pytest.approx(sums[full] / number[full]) and np.isnan(row[~full]).all()
    path, place, energy = voxels
    found = measure_profile([path], "energy", "sum")
    expected = [energy[place[:, 2] == level].sum() for level in 100.25 + 0.5 * np.arange(40)]
    assert np.diff(found.edges) == pytest.approx(0.5), "a layer of voxels is a bin"
    assert found.values[0][: len(expected)] == pytest.approx(expected, rel=1e-5)


def build_cube(path, lines):
    write_cube(path, lines, {}, None, overwrite=False)
    with np.load(path) as file:
        return dict(file)


def test_the_cube_has_every_sample_on_one_axis_of_time(riegl, tmp_path):
    with StripReader(riegl) as reader, reader.scan() as scan:
        lines = list(read_scan_lines(reader, scan))[:6]
    cube = build_cube(tmp_path / "c.npz", lines)
    values, time, spacing = cube["values"], cube["time"], lines[0].spacing
    others = [lines[0], replace(lines[1], spacing=2 * spacing)]
    refuses(InputError, "differ in their spacing", build_cube, tmp_path / "d.npz", others)
    columns = align_pulses(lines)
    assert values.shape == (6, 1 + max(map(max, columns)), len(time)) and np.diff(time) == pytest.approx(spacing)
    assert np.isfinite(values).sum() == sum(len(line.row) for line in lines)
    for i, line in enumerate(lines):
        for pulse in (0, len(line) // 2, len(line) - 1):
            mine, column = line.row == pulse, columns[i][pulse]
            there = np.flatnonzero(np.isfinite(values[i, column]))
            assert np.array_equal(values[i, column, there], line.value[mine])
            # Where a sample lies in space follows from its time alone: all pulses start at one plane.
            at = time[there] + cube["offset"][i, column] - line.time[mine]
            assert np.ptp(at) < 1e-4 and abs(cube["offset"][i, column]) <= 0.51 * spacing
    starts = [line.origin[0] - at for line, at in zip(lines, _starts(cube, lines), strict=True)]
    mean = np.mean(
        [line.direction.mean(axis=0) / np.linalg.norm(line.direction.mean(axis=0)) for line in lines], axis=0
    )
    assert np.ptp([start @ mean for start in starts]) < 0.02, "windows that open at other heights keep the relief"
    begins, at = np.array([0.0, 0.03, 0.07, 5.26]), np.array([0.0, 0.1, 0.2, 0.3, 0.6, 0.7])
    down, row = np.tile([0.0, 0.0, -HALF_C], (4, 1)), np.arange(4)
    origin = [0.0, 0.0, 100.0] + down * begins[:, None]
    line = ScanLine(0, row, row * 1e-5, origin, down, 0.1, np.repeat(row, 6), np.tile(at, 4), np.ones(24, "f4"))
    cube = build_cube(tmp_path / "e.npz", [line])
    for pulse, begin in enumerate(begins):
        there = np.isfinite(cube["values"][0, pulse])
        assert cube["time"][there] + cube["offset"][0, pulse] == pytest.approx(begin + at, abs=1e-6)


def _starts(cube, lines):
    """Way from the common plane to sample 0 of the first pulse of each line [m]."""
    for i, line in enumerate(lines):
        column = align_pulses(lines)[i][0]
        first = np.flatnonzero(np.isfinite(cube["values"][i, column]))[0]
        yield (cube["time"][first] + cube["offset"][i, column] - line.time[0]) * line.direction[0]


def _sweep(number, angles):
    """A scan line of one sample per pulse, which holds the scan angle [deg], under a sensor 100 m above the ground."""
    n, turn = len(angles), np.radians(angles)
    direction = HALF_C * np.stack([np.sin(turn), np.zeros(n), -np.cos(turn)], axis=1)
    origin = np.tile([0.0, 5.0 * number, 100.0], (n, 1))
    row = np.arange(n)
    return ScanLine(number, row, row * 1e-5, origin, direction, 1.0, row, np.zeros(n), np.asarray(angles, "f4"))


def test_lines_of_an_oscillating_mirror_are_aligned_by_scan_angle(tmp_path):
    """To and fro, with steps that shrink at the turns; one line begins late, one ends early."""
    swing = 15 * np.sin(np.linspace(-0.45, 0.45, 61) * np.pi)
    lines = [_sweep(0, swing), _sweep(1, swing[::-1]), _sweep(2, swing[20:]), _sweep(3, swing[:35][::-1])]
    values = build_cube(tmp_path / "c.npz", lines)["values"].max(axis=2)
    for column, angle in enumerate(swing):
        known = values[np.isfinite(values[:, column]), column]
        assert len(known) == 2 + (column >= 20) + (column < 35) and np.abs(known - angle).max() < 1e-4
    assert values.shape == (4, 61)
    level = [_sweep(0, np.zeros(5)), _sweep(1, np.zeros(3))]
    assert [column.tolist() for column in align_pulses(level)] == [[0, 1, 2, 3, 4], [0, 1, 2]]


def test_slices_of_the_cube(tmp_path):
    values = np.arange(2 * 3 * 4, dtype=np.float32).reshape(2, 3, 4)
    path = tmp_path / "c.npz"
    np.savez(path, values=values, time=np.arange(4) * 0.5, line=np.array([7, 9]))
    x, y, t = cut_cube(path, {"x": 2, "y": 9, "t": 1.01})
    assert np.array_equal(x.image, values[:, 2].T) and np.array_equal(y.image, values[1].T)
    assert np.array_equal(t.image, values[:, :, 2]) and t.title == "t = 1 ns" and (x.down, t.down) == (True, False)
    assert len(cut_cube(path, dict.fromkeys("xyt"))) == 3
    for wrong, message in (({"y": 8}, "scan lines 7 to 9"), ({"x": 3}, "0 to 2"), ({"t": 9.0}, "0 to 1.5 ns")):
        refuses(ConfigError, message, cut_cube, path, {"x": None, "y": None, "t": None, **wrong})
    refuses(InputError, "no scan line", build_cube, tmp_path / "empty.npz", [])
    np.savez(path, values=values, time=-np.arange(4.0), line=np.array([7, 9]))
    refuses(InputError, "times do not ascend", cut_cube, path, dict.fromkeys("xyt"))


def test_slice_writes_cube_and_overview_once(riegl, tmp_path):
    words = ("slice", riegl, "--lines", "0:5", "--shortest", 10, "--cube", tmp_path / "c.npz", "--overview")
    assert run(*words, tmp_path / "o.png").exit_code == 0
    first = (tmp_path / "c.npz").read_bytes()
    fail(1, "--overwrite", *words, tmp_path / "o.png")
    assert run(*words, tmp_path / "o.png", "--overwrite").exit_code == 0
    assert (tmp_path / "c.npz").read_bytes() == first, "the same input gives the same bytes"
    assert sorted(path.name for path in Path(tmp_path).iterdir()) == ["c.npz", "o.png"]


def _write_segments(path, heights, lengths):
    """Segments as `wavebatch slice` writes them."""
    segments = [
        Segment(line=0, segment=n, start=(0.0, 0.0, float(a)), end=(1.0, 1.0, float(b)), ends=((0, 0), (1, 1)),
                length=float(length), slope=0.0, residual=0.1, pulses=5, first_pulse=0, last_pulse=4, first_point=0,
                theta=0.0, rho=0.0, weight=2.0)
        for n, ((a, b), length) in enumerate(zip(heights, lengths, strict=True))
    ]  # fmt: skip
    with SegmentWriter(path, overwrite=True) as writer:
        writer.write(segments)
        writer.commit()
    return path


@pytest.mark.parametrize("suffix", [".csv", ".geojson"])
def test_segments_count_at_their_heights(tmp_path, suffix):
    """A segment gives each bin the share of its height: as many small pieces of it would."""
    rng = np.random.default_rng(2)
    low = rng.uniform(100, 140, 300)
    heights = np.stack([low, low + rng.choice([0.0, 0.0, 0.3, 7.0, -5.0], 300)], axis=1).round(4)
    lengths = rng.uniform(1, 9, 300).round(5)
    path = _write_segments(tmp_path / f"s{suffix}", heights, lengths)
    found = measure_profile([path], None, "count", size=2.0)
    fine = (np.arange(4000) + 0.5) / 4000
    pieces = heights[:, :1] + fine * (heights[:, 1] - heights[:, 0])[:, None]
    expected = np.histogram(pieces.ravel(), found.edges)[0] / 4000
    assert found.values[0] == pytest.approx(expected, abs=0.02) and found.values.sum() == pytest.approx(300)
    assert found.label == "segments per 2 units of height" and found.outside == 0
    sums = measure_profile([path], "length", "sum", size=2.0)
    expected = np.histogram(pieces.ravel(), found.edges, weights=np.repeat(lengths, 4000))[0] / 4000
    assert sums.values[0] == pytest.approx(expected, abs=0.1)
    mean = measure_profile([path, path], "length", "mean", size=2.0, each=True)
    full = found.values[0] > 0.1
    for row in mean.values:
        assert row[full] == pytest.approx((sums.values / found.values)[0][full])


def test_profile_of_the_segments_of_a_strip(riegl, tmp_path):
    assert run("slice", riegl, "-o", tmp_path / "s.csv", "--lines", "0:20", "-q").exit_code == 0
    result = run("plot", "profile", tmp_path / "s.csv", "--column", "length", "-o", tmp_path / "p.svg")
    number = (tmp_path / "s.csv").read_text().count("\n") - 1
    assert result.exit_code == 0 and f"{number} segments" in result.stderr, result.output
    assert "sum of length" in (tmp_path / "p.svg").read_text("utf-8")


@pytest.mark.parametrize("given", ["s*.csv", "segs", "@list.txt", "segs/*.*", "segs/s.csv segs/../segs/t.csv"])
def test_segments_are_found_as_clouds_are(tmp_path, monkeypatch, given):
    """By pattern, folder and list, each file once; a folder with clouds gives these."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "segs").mkdir()
    for folder in (tmp_path, tmp_path / "segs"):
        for name in ("s.csv", "t.csv" if folder.name == "segs" else "s2.csv"):
            _write_segments(folder / name, [(1, 2), (3, 4)], [1, 2])
    (tmp_path / "list.txt").write_text("s*.csv\n")
    result = succeed("plot", "profile", *given.split(), "-o", "p.png", "--json", "-q")
    document = json.loads(result.stdout)
    assert len(document["clouds"]) == 2 and document["values"] == 4


def test_a_folder_with_clouds_and_tables_gives_the_clouds(cloud, tmp_path):
    _write_segments(tmp_path / "s.csv", [(1, 2), (3, 4)], [1, 2])
    result = run("plot", "profile", tmp_path, "-o", tmp_path / "p.png", "--json", "-q")
    assert json.loads(result.stdout)["clouds"] == [str(cloud)]


@pytest.mark.parametrize("many", [40, 3000])
def test_far_points_leave_the_frame_of_a_section_and_are_counted(tmp_path, many):
    """One point 116 m below pressed the others into a line; what is near the others stays."""
    rng = np.random.default_rng(1)
    height = rng.normal(350.0, 0.3, many)
    height[0], height[1] = 353.0, 234.0
    write_points(tmp_path / "c.las", np.stack([np.linspace(0.0, 80.0, many), rng.uniform(0, 1, many), height], axis=1))
    for most in (200_000, many // 2 + 20):
        found = cut_section([tmp_path / "c.las"], "z", line=(0, 0.5, 80, 0.5), width=2.0, most=most)
        assert (found.inside, found.outside) == (many, 1) and len(found.value) <= most
        assert found.height.min() > 345 and (most < many or found.height.max() == pytest.approx(353.0))
    result = run("plot", "section", tmp_path / "c.las", "-o", tmp_path / "s.svg")
    assert "1 outside" in result.stderr and "1 outside" in (tmp_path / "s.svg").read_text("utf-8")


def test_a_tower_and_a_few_points_stay_in_the_section():
    ground = np.random.default_rng(1).normal(0, 0.2, 2000)
    for heights, far in ((np.linspace(0, 90, 30), 0), ([9.0], 0), ([90.0, -90.0], 2)):
        every = np.append(ground, heights)
        low, high = sections.choose_frame(every, 100.0)
        assert np.count_nonzero((every < low) | (every > high)) == far
    assert sections.choose_frame(np.append(ground[:15], 90.0), 100.0) == (-np.inf, np.inf)


def test_logarithmic_profiles_have_plain_labels(cloud, tmp_path):
    """Math text is off, so that a $ in a name is a $: powers of ten would show as source text."""
    assert run("plot", "profile", cloud, "--log", "-o", tmp_path / "p.svg").exit_code == 0
    text = (tmp_path / "p.svg").read_text("utf-8")
    assert "mathdefault" not in text and ">100<" in text.replace("\n", "")


def test_level_segments_on_an_edge_lie_above_it(tmp_path):
    """As points do: a bin holds its lower edge."""
    heights = [(100.0, 100.0), (102.0, 102.0), (104.0, 104.0), (104.0, 106.0)]
    found = measure_profile([_write_segments(tmp_path / "s.csv", heights, [1, 2, 4, 8])], "length", "sum", size=2.0)
    sums = dict(zip(found.edges[:-1].tolist(), found.values[0].tolist(), strict=True))
    assert [sums[edge] for edge in (100.0, 102.0, 104.0)] == pytest.approx([1, 2, 12])
    assert found.values.sum() == pytest.approx(15)


def test_tails_of_voxels_are_not_drawn(voxels):
    """Less than 2 % of the scale would look as solid as the ground."""
    from types import SimpleNamespace

    from wavebatch.tools.plots import sections

    found = cut_section([voxels[0]], "energy", line=(10.0, 30.0, 30.0, 30.0), width=0.5)
    value = np.where(np.arange(len(found.value)) % 2, 50.0, 0.5)
    axes = SimpleNamespace(grid=lambda **_: None, imshow=lambda image, **_: image)
    for name, faint in (("energy", False), ("count", True)):
        facts = replace(found.facts, name=name)
        image, _ = sections._draw_voxels(axes, replace(found, value=value, facts=facts, shown=(0.0, 60.0)))
        assert bool((image == 0.5).any()) is faint and (image == 50.0).any()
    assert any("below 2 %" in part for part in sections._parts(found, 1.0))
