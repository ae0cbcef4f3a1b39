"""`wavebatch slice`: scan lines of a strip, surfaces in them, and the files they are written to."""

import csv
import json
import re
import struct
from dataclasses import replace

import numpy as np
import pytest
from click.testing import CliRunner
from commands import run_command, succeed
from helpers_scenes import simulated
from strips import cut_strip

from wavebatch.cli.geometry import slice_
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.las.header import read_header
from wavebatch.files.strip.reader import StripReader, StripScan
from wavebatch.tools import scan_slices as segments
from wavebatch.tools import slice_output as output
from wavebatch.tools.scan_slices import ScanLine, SliceOptions, cut_slice, find_segments, read_scan_lines
from wavebatch.tools.simulate import find_scene, simulate_strip
from wavebatch.tools.simulate.render import EAST, GROUND, NORTH, FlightLine

FLIGHT = FlightLine(pulse_rate=50_000, half_angle=12.0, look_ahead=0.0)
PULSES = 4000


strip = simulated("slope.las", replace(find_scene("slope"), flight=FLIGHT), pulses=PULSES, seed=6)
"""Four scan lines of 1000 pulses over facets of 0 to 40 degrees, 40 m wide."""


def read_all(path, unit_points=None, **sizes):
    with StripReader(path, unit_points=unit_points) as reader:
        return list(read_scan_lines(reader, reader.scan(), **sizes))


def test_scan_lines_are_those_of_the_flight(strip):
    found = read_all(strip)
    assert [line.number for line in found] == [0, 1, 2, 3]
    for line in found:
        number = np.rint((line.gps_time - 300_000_000.0) * FLIGHT.pulse_rate).astype(int)
        assert set(number // 1000) == {line.number}
        assert len(line) > 970
        assert line.row[-1] == len(line) - 1 and len(line.value) == len(line.row) == len(line.time)
        assert line.time.max() == 79.0


def test_lines_do_not_depend_on_units_and_samples_are_those_of_the_strip(strip):
    whole = read_all(strip)
    parts = read_all(strip, 700)
    assert len(parts) == len(whole)
    for one, other in zip(whole, parts, strict=True):
        for name in ("point", "gps_time", "origin", "direction", "row", "time", "value"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name
    with StripReader(strip) as reader:
        unit = reader.read_unit(0, reader.scan())
        block, _ = next(reader.read_blocks(unit, 5, True))
    first = whole[0].value[whole[0].row == 0]
    assert np.diff(first) == pytest.approx(np.diff(block.samples[0].astype(float)))


def test_long_lines_are_cut_and_short_ones_left_out(strip, monkeypatch):
    assert max(len(line) for line in read_all(strip, most=300)) == 300
    with monkeypatch.context() as patch:  # so that long waveforms need no more memory
        patch.setattr("wavebatch.tools.scan_slices.MOST_SAMPLES", 16_000)
        lines = read_all(strip)
    assert 15_000 < max(len(line.value) for line in lines) <= 16_000
    assert sum(map(len, lines)) == sum(map(len, read_all(strip)))
    assert min(len(line) for line in read_all(strip, most=300, least=250)) >= 250


def facet_slopes(y):
    """Slope [deg] of the ground along y where it lies."""
    number = np.floor((y - NORTH) / 80.0)
    return 10.0 * (number % 5) * np.where((y - NORTH) - 80.0 * number < 40.0, 1, -1)


def test_facets_are_found_with_their_slope_and_place(strip):
    options = SliceOptions()
    line = read_all(strip)[1]
    segments = find_segments(cut_slice(line, options), options)
    long = [segment for segment in segments if segment.length > 30]
    assert len(long) >= 5
    for segment in long:
        middle = np.add(segment.start, segment.end) / 2
        rising = segment.slope if segment.end[1] > segment.start[1] else -segment.slope
        assert rising == pytest.approx(facet_slopes(middle[1]), abs=0.8)
        assert abs(middle[0] - EAST - FLIGHT.speed * 0.03) < 2
        assert segment.residual < 0.35
        steep = np.tan(np.radians(abs(facet_slopes(middle[1]))))
        across = (middle[1] - NORTH) % 80.0
        assert middle[2] - GROUND == pytest.approx(steep * min(across, 80.0 - across), abs=0.3)
        assert 0 <= segment.first_pulse < segment.last_pulse < len(line)
        assert line.point[segment.first_pulse] == segment.first_point


def make_line(origin, direction, time, *, samples=80, spacing=1.0, height=60.0, width=2.0, rng=None, number=0):
    """A scan line of pulses with an echo each, at these times [ns]; with rng in noise of one count."""
    n = len(time)
    row, sample = np.repeat(np.arange(n), samples), spacing * np.tile(np.arange(samples), n)
    value = height * np.exp(-0.5 * ((sample - np.asarray(time)[row]) / width) ** 2)
    value += 0.0 if rng is None else rng.standard_normal(n * samples)
    direction = np.broadcast_to(direction, (n, 3))
    place = (np.arange(n), np.arange(n) * 1e-5, origin, direction)
    return ScanLine(number, *place, spacing, row, sample, value.astype(np.float32))


def fly_over(height, rng, step, half=40.0, altitude=600.0):
    """A scan line over a surface of the given height(place) [m], pulses `step` m apart, scatter 2 cm."""
    place = np.arange(-half, half, step)
    n, angle = len(place), np.arctan(place / altitude)
    direction = 0.149896 * np.stack([np.sin(angle), np.zeros(n), -np.cos(angle)], axis=1)
    ground = np.stack([place, np.zeros(n), height(place) + 0.02 * rng.standard_normal(n)], axis=1)
    time = 30 + rng.uniform(-5, 5, n)
    return make_line(ground - direction * time[:, None], direction, time, rng=rng)


@pytest.mark.parametrize("degrees", [3, 8, 20])
@pytest.mark.parametrize("step", [0.3, 1.0])
def test_a_shallow_gable_is_two_slopes(degrees, step):
    """Both slopes lie within the band of one line through them: it was level, or of a slope between."""
    rise = np.tan(np.radians(degrees))
    line = fly_over(lambda x: np.where(np.abs(x) < 6, 5 + rise * (6 - np.abs(x)), 0), np.random.default_rng(1), step)
    options = SliceOptions()
    roof = [s for s in find_segments(cut_slice(line, options), options) if min(s.start[2], s.end[2]) > 3]
    assert sorted(s.slope for s in roof) == pytest.approx([-degrees, degrees], abs=0.5)
    for segment in roof:
        assert segment.residual < 0.04 and segment.length > 3.9
        assert max(segment.start[0], segment.end[0]) < 0.6 or min(segment.start[0], segment.end[0]) > -0.6


@pytest.mark.parametrize("bend", [lambda x: -(x**2) / 2000, lambda x: 0.1 * np.sin(x / 3), lambda x: 0.15 * (x > 0)])
def test_a_hill_a_wave_and_a_step_stay_one_line(bend):
    options = SliceOptions()
    line = fly_over(bend, np.random.default_rng(2), 0.5)
    (segment,) = find_segments(cut_slice(line, options), options)
    assert segment.length > 78


def test_time_geometry_finds_a_line_over_pulses_and_places_it_in_space():
    n = 200
    origin = np.stack([0.6 * np.arange(n), np.zeros(n), np.full(n, 100.0)], axis=1)
    line = make_line(origin, [0, 0, -0.15], 10 + 0.05 * np.arange(n), spacing=0.5, height=50, number=4)
    options = SliceOptions(geometry="time")
    (segment,) = find_segments(cut_slice(line, options), options)
    assert (segment.line, segment.first_pulse, segment.last_pulse) == (4, 0, 199)
    for time, pulse in segment.ends:
        assert time == pytest.approx(10 + 0.05 * pulse, abs=0.05)
    for place, (time, pulse) in zip((segment.start, segment.end), segment.ends, strict=True):
        assert place == pytest.approx((0.6 * np.clip(pulse, 0, n - 1), 0, 100 - 0.15 * time), abs=1e-6)
    assert segment.residual < 0.1


def run(*arguments):
    return CliRunner().invoke(slice_, [str(argument) for argument in arguments])


def test_csv_and_geojson_hold_the_same_segments(strip, tmp_path):
    result = succeed("slice", strip, "-o", tmp_path / "s.csv", "--lines", "1:3", "--json")
    counts = json.loads(result.stdout)
    assert counts["lines"] == 2 and 1.7 < counts["sigma"] < 2.6
    rows = list(csv.DictReader((tmp_path / "s.csv").read_text().splitlines()))
    assert len(rows) == counts["segments"] > 8
    assert {row["line"] for row in rows} == {"1", "2"}
    arguments = ("--geojson-crs", "keep", "--lines", "1:3", "-q")
    assert run(strip, "-o", tmp_path / "s.geojson", *arguments).output == ""
    features = json.loads((tmp_path / "s.geojson").read_text())["features"]
    assert len(features) == len(rows)
    for row, feature in zip(rows, features, strict=True):
        ends = feature["geometry"]["coordinates"]
        assert [float(row[name]) for name in ("x1", "y1", "z1")] == pytest.approx(ends[0])
        assert float(row["length"]) == pytest.approx(np.linalg.norm(np.subtract(*ends)), rel=1e-3)


def test_picture_of_a_slice(strip, tmp_path):
    for geometry in ("plane", "time"):
        target = tmp_path / f"{geometry}.png"
        assert run(strip, "--png", target, "--lines", "2", "--geometry", geometry).exit_code == 0
        assert target.read_bytes().startswith(b"\x89PNG")


def test_units_of_long_waveforms_are_small_and_give_the_same_segments(strip, tmp_path, monkeypatch):
    """50,000 waveforms of 1,000 samples took 2.3 GB."""
    succeed("slice", strip, "-o", tmp_path / "a.csv")
    read = []

    class Reader(StripReader):
        def read_blocks(self, unit, *more):
            read.append(len(unit.points))
            return super().read_blocks(unit, *more)

    monkeypatch.setattr("wavebatch.cli.geometry.StripReader", Reader)
    monkeypatch.setattr("wavebatch.cli.geometry.MOST_SAMPLES", 80 * 1000)
    succeed("slice", strip, "-o", tmp_path / "b.csv")
    assert len(read) > 3 and max(read) < 1100
    monkeypatch.setattr("wavebatch.cli.geometry.UNIT_POINTS", 500)  # of short ones they are no larger than usual
    read.clear()
    succeed("slice", strip, "-o", tmp_path / "c.csv")
    assert max(read) < 600
    assert (tmp_path / "a.csv").read_bytes() == (tmp_path / "b.csv").read_bytes()


def test_a_shuffled_strip_says_what_to_do(tiny_strip, tmp_path, edit_points, rng):
    shuffled = edit_points(tiny_strip, tmp_path / "s.las", lambda points: rng.permutation(points))
    result = run(shuffled, "-o", tmp_path / "s.csv")
    assert result.exit_code == 1
    assert "order of time" in result.stderr


def test_real_strip(riegl, tmp_path):
    result = succeed("slice", riegl, "-o", tmp_path / "s.csv", "--json")
    counts = json.loads(result.stdout)
    assert counts["lines"] > 50 and counts["segments"] > 50


def ground_line(starts, n=240, spacing=0.5, tilt=0.0):
    """A scan line over level ground 30 m below its highest sample; windows open `starts` [ns] after that height."""
    angle = np.radians(np.linspace(-6, 6, n) + tilt)
    direction = 0.15 * np.stack([np.sin(angle), np.zeros(n), -np.cos(angle)], axis=1)
    sensor = np.array([0.0, 0.0, 700.0])
    top = sensor + direction * ((700.0 - 30.0) / -direction[:, 2])[:, None]
    origin = top + direction * starts[:, None]
    return make_line(origin, direction, origin[:, 2] / -direction[:, 2], samples=90, spacing=spacing, width=1.5,
                     rng=np.random.default_rng(1))  # fmt: skip


@pytest.mark.parametrize("tilt", [0.0, 25.0])
def test_windows_that_open_at_different_heights_keep_the_relief(tilt):
    """Counted from their own first samples, level ground was scattered over the image: no segment, or many."""
    options = SliceOptions(geometry="time", sigma=1.5)
    rng = np.random.default_rng(2)
    # The ground lies 200 to 216 ns below the highest sample, so windows of 45 ns open 165 to 195 ns below it.
    starts = rng.uniform(165, 195, 240)
    starts[7] = 0.0
    line = ground_line(starts, tilt=tilt)
    segments = find_segments(cut_slice(line, options), options)
    assert max(segment.pulses for segment in segments) > 100
    for segment in segments:
        assert segment.residual < (1.0 if tilt == 0 else 2.5)
        for end in (segment.start, segment.end):
            assert end[2] == pytest.approx(0.0, abs=0.35 if tilt == 0 else 1.0)
        # What is drawn is what is placed: the time on the axis of the slice leads to the same height.
        assert abs(segment.start[0] - segment.end[0]) > 2.5


def test_the_axis_of_time_does_not_depend_on_where_windows_open():
    options = SliceOptions(geometry="time", sigma=1.5)
    starts = np.full(240, 170.0), np.r_[0.0, np.full(239, 170.0)]
    together, apart = (cut_slice(ground_line(one), options) for one in starts)
    # One pulse that sees 25 m higher moves the beginning of the axis for all, not the pulses against each other.
    shift = apart.x[apart.line.row > 0] - together.x[together.line.row > 0]
    assert shift == pytest.approx(np.full(len(shift), 170.0 / 0.5), abs=4) and np.ptp(shift) < 2.5
    assert together.start.min() == pytest.approx(0.0, abs=1e-9)


def test_both_geometries_find_the_ground_of_a_strip(tmp_path_factory):
    path = tmp_path_factory.mktemp("village") / "village.las"
    simulate_strip("village", path, pulses=4000, seed=3)
    found = {}
    for geometry in ("plane", "time"):
        options = SliceOptions(geometry=geometry, sigma=0.65)
        found[geometry] = [s for line in read_all(path) for s in find_segments(cut_slice(line, options), options)]
    assert len(found["time"]) >= 0.8 * len(found["plane"]) > 10
    level = [segment for segment in found["time"] if abs(segment.slope) < 1 and segment.length > 10]
    assert len(level) > 5


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.0])
def test_the_residual_of_a_time_slice_is_the_scatter_of_times(slope):
    """Echoes `slope` samples later per pulse and 0.6 ns early and late in turn: the residual is 0.6 ns at any slope."""
    n, off = 60, 0.6
    time = 20.0 + slope * np.arange(n) + off * np.where(np.arange(n) % 2, 1.0, -1.0)
    origin = np.stack([0.5 * np.arange(n), np.zeros(n), np.full(n, 100.0)], axis=1)
    line = make_line(origin, [0.0, 0.0, -0.149896], time, samples=100, height=100)
    options = SliceOptions(geometry="time", sigma=2.0)
    (segment,) = find_segments(cut_slice(line, options), options)
    # Only samples above the threshold count, which draws the centroids together a little.
    assert segment.residual == pytest.approx(off, rel=0.1) and segment.pulses == n


@pytest.mark.parametrize("filled", [0.1, 0.4, 0.7])
def test_the_level_is_that_without_signal_where_signal_fills_most_of_the_waveform(filled):
    """A wall of echoes fills up to 70 % of the samples: values above the level are those of the signal."""
    samples = np.full((3, 100), 12, np.uint8)
    samples[:, 100 - round(100 * filled) :] = 60
    block = WaveformBlock.from_samples(samples, bits=8, spacing=1.0)
    values = segments._shape(block)[1]["value"].reshape(3, 100)
    assert values[:, 0].tolist() == [0.0] * 3 and values[:, -1].tolist() == [48.0] * 3


def test_the_scan_of_each_strip_is_closed(strip, tmp_path, monkeypatch):
    """It holds temporary files, which stayed until the end of the command."""
    closed, close = [], StripScan.close
    monkeypatch.setattr(StripScan, "close", lambda scan: closed.append(scan) or close(scan))
    assert run(strip, "-o", tmp_path / "s.csv", "--lines", "1", "-q").exit_code == 0 and len(closed) == 1


def test_noise_holds_no_surface(tmp_path, rng):
    # Water and sky: every waveform is noise. Two standard deviations of such a slice are two of the noise.
    strip = tmp_path / "noise.las"
    simulate_strip("flat", strip, pulses=1500, seed=2)
    content = np.frombuffer(strip.read_bytes(), np.uint8).copy()
    start = read_header(strip).waveform_start + 60
    content[start:] = np.rint(rng.normal(20, 1, len(content) - start))
    strip.write_bytes(content.tobytes())
    for more in ([], ["--sigma", "2"], ["--geometry", "time"]):
        done = run_command("slice", strip, "-o", tmp_path / "x.csv", "--overwrite", *more)
        assert done.exit_code == 0 and f"{strip}: 0 segments in " in done.stderr, done.stderr


def test_strips_too_short_for_a_scan_line_say_so(tiny_strip, tmp_path):
    short = cut_strip(tiny_strip, tmp_path / "short.las", 5)
    done = run_command("slice", short, "-o", tmp_path / "x.csv")
    assert done.exit_code == 1 and re.search(r"has \d pulses, a scan line to find surfaces in needs 8", done.stderr)
    none = cut_strip(tiny_strip, tmp_path / "none.las", 0)
    assert "none.las: has no waveform, so no scan line\n" in succeed("slice", none, "-o", tmp_path / "y.csv").stderr


def test_lines_with_as_many_segments_as_allowed_are_counted_and_said(riegl, tmp_path):
    words = ["slice", str(riegl), "--lines", "0:6", "-o", str(tmp_path / "s.csv"), "--json", "--overwrite", "--most"]
    few, many = (run_command(*words, most) for most in ("1", "50"))
    found = json.loads(few.stdout)
    assert found["full"] == found["segments"] > 0 and f"{found['full']} scan lines may have more" in few.stderr
    assert json.loads(many.stdout)["full"] == 0 and "may have more" not in many.stderr


def test_fill_between_recordings_is_no_sample():
    samples = np.full((5, 60), 12, np.uint8)
    samples[:, 20] = 90
    missing = np.zeros((5, 60), bool)
    missing[:, 30:40] = True
    block = replace(WaveformBlock.from_samples(samples, bits=8, spacing=2.0), missing=missing)
    line = segments._build_line(0, *segments._shape(block))
    assert len(line.value) == 5 * 50 and sorted(set(line.time)) == [2.0 * k for k in range(60) if not 30 <= k < 40]


def test_a_picture_of_a_slice_ends_near_the_signal(strip):
    line = read_all(strip)[2]
    piece = cut_slice(line, SliceOptions(geometry="time"))
    image, extent = output._paint(piece)
    loud = line.value > line.value.std()
    low, high = piece.x[loud].min() * piece.pixel, piece.x[loud].max() * piece.pixel
    every = np.ptp(piece.x) * piece.pixel
    assert extent[0] < low and high < extent[1] and extent[1] - extent[0] < min(1.4 * (high - low), 0.95 * every)
    assert np.isfinite(image).any(axis=1).all()


def test_packets_of_one_pulse_are_one_pulse(tmp_path, edit_points):
    """A forest whose waveforms are cut into two packets of 40 samples each, of canopy and ground."""
    whole = tmp_path / "whole.las"
    simulate_strip("forest", whole, pulses=600, seed=4)

    def halve(points):
        late = points["return_point_wave_location"] >= 40_000
        points["wavepacket_offset"][late] += 40
        points["return_point_wave_location"][late] -= 40_000
        points["wavepacket_size"] = np.minimum(points["wavepacket_size"], 40)

    cut = edit_points(whole, tmp_path / "cut.las", halve)
    content, old = cut.read_bytes(), struct.pack("<BBII", 8, 0, 80, 1000)
    assert content.count(old) == 1
    cut.write_bytes(content.replace(old, struct.pack("<BBII", 8, 0, 40, 1000)))
    both = 0
    for one, other in zip(read_all(whole), read_all(cut), strict=True):
        assert np.array_equal(one.gps_time, other.gps_time)
        for row in range(len(one)):
            times, found = one.time[one.row == row], other.time[other.row == row]
            if len(found) > 40:
                both += 1
                place = np.searchsorted(times, found - 0.5)
                assert found == pytest.approx(times[place], abs=0.02) and np.all(np.diff(found) > 0.9)
    assert both > 100
    done = run_command("slice", cut, "-o", tmp_path / "cut.csv", "--json")
    assert json.loads(done.stdout)["pulses"] == sum(map(len, read_all(whole)))
