"""Where a strip's sensor was: real and simulated strips, trajectory files right and wrong, what nobody can know."""

import struct
from dataclasses import replace
from unittest.mock import ANY

import facet_strips
import laspy
import numpy as np
import pytest
from commands import refuses, run_command, succeed
from facet_strips import EAST, NORTH, START, Facet, Sensor, path_of, write_strip
from strips import place_header, true_sensor, write_positions

import wavebatch as wb
from wavebatch.core.errors import InputError
from wavebatch.core.trajectory import ADJUSTED, Trajectory
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import ReturnTable, WaveformBlock
from wavebatch.files.las.crs import CrsUnits
from wavebatch.files.strip.reader import MOST_SLICES, RAYS_PER_SLICE, RaySample, StripReader, measure_scale, sample_rays
from wavebatch.kernels.physics.radiometry import mean_haze
from wavebatch.surveying.sensor import (
    UNKNOWN,
    SensorRequest,
    SensorSource,
    _disagreement,
    estimate_path,
    find_sensor,
    find_turn,
)
from wavebatch.tools.simulate.render import START_TIME, FlightLine, trace_rays

pytestmark = pytest.mark.kept_surveys


def find(path, **request):
    with StripReader(path) as reader, reader.scan() as scan:
        return find_sensor(reader, scan, SensorRequest(**request))


@pytest.fixture(scope="module")
def found(wide_strip):
    return find(wide_strip)


def test_a_simulated_flight(found):
    time = START_TIME + np.linspace(0.0, 0.559, 200)
    assert found.kind == "direction vectors"
    assert np.abs(found.trajectory.at(time) - true_sensor(time)).max() < 0.01
    told = found.describe()
    assert told["speed_m_s"] == pytest.approx(60.0, abs=0.1)
    assert told["heading_deg"] == pytest.approx(90.0, abs=1.0)
    assert told["range_error_m"] < 0.005


@pytest.mark.parametrize(("strip", "height", "speed", "heading"), [
    ("riegl", 556.0, 55.8, pytest.approx(337.7, abs=1.0)), ("leica", 726.8, 60.4, ANY),
])  # fmt: skip
def test_real_flights(request, strip, height, speed, heading):
    told = find(request.getfixturevalue(strip)).describe()
    assert told["source"] == "direction vectors" and told["heading_deg"] == heading
    assert told["height_m"] == pytest.approx(height, abs=0.5) and told["speed_m_s"] == pytest.approx(speed, abs=0.5)
    assert told["range_error_m"] < 0.1 and (strip == "leica" or told["smoothness_m"] < 0.05)


def test_rays_meet_a_hand_in_front_of_the_origins_of_the_pulses_in_the_pulsewaves_file(riegl):
    """Independent of the LAS file's vectors: .pls has where the clock of each pulse starts."""
    source, content = find(riegl), riegl.with_suffix(".pls").read_bytes()
    start, number = struct.unpack_from("<qq", content, 176)
    scale, offset = struct.unpack_from("<dd", content, 224)
    places = np.frombuffer(content, "<f8", 6, 256)
    record = np.dtype([("time", "<i8"), ("wave", "<i8"), ("anchor", "<i4", 3), ("rest", "V20")])
    pulses = np.frombuffer(content, record, number, start)
    anchor = pulses["anchor"] * places[:3] + places[3:]
    cloud = laspy.read(riegl)
    order = np.argsort(pulses["time"])
    time = pulses["time"][order] * scale + offset
    at = np.clip(np.searchsorted(time, cloud.gps_time - 1e-6), 0, number - 1)
    assert np.abs(time[at] - cloud.gps_time).max() < 1e-6
    point = np.asarray(cloud.xyz)
    by_vectors = np.linalg.norm(point - source.trajectory.at(np.asarray(cloud.gps_time)), axis=1)
    off = by_vectors - np.linalg.norm(point - anchor[order][at], axis=1)
    # The facet of its mirror moves: rays meet in front of the origins, always by the same.
    assert off.mean() == pytest.approx(-0.071, abs=0.003) and off.std() < 0.004
    assert source.error < 0.01


@pytest.mark.parametrize("name", ["riegl", "leica"])
def test_every_waveform_of_a_real_file_has_a_sensor(request, name):
    path = request.getfixturevalue(name)
    with StripReader(path) as reader, reader.scan() as scan:
        source = find_sensor(reader, scan, SensorRequest())
        for block, _ in reader.read_blocks(reader.read_unit(0, scan), 500, owned_only=True):
            sensor = source.fill(block).sensor
            assert np.isfinite(sensor).all()
            ahead = block.origin - sensor
            cosine = (ahead * block.direction).sum(axis=1)
            cosine /= np.linalg.norm(ahead, axis=1) * np.linalg.norm(block.direction, axis=1)
            assert np.degrees(np.arccos(np.minimum(cosine, 1.0))).max() < 0.01


def write_trajectory(path, shift=0.0, off=(0.0, 0.0, 0.0), clock=0.0, stop=3.0):
    time = START_TIME + np.arange(-1.0, stop, 0.05)
    return write_positions(path, time + shift + clock, true_sensor(time) + off, "gps_time,x,y,z")


def test_a_trajectory_file(tmp_path, wide_strip, found):
    given = find(wide_strip, trajectory=write_trajectory(tmp_path / "t.csv", clock=ADJUSTED))
    assert given.kind == "trajectory"
    told = given.describe()
    assert told["clocks"] == "standard to adjusted GPS time"
    assert told["share_covered"] == 1.0
    assert told["angle_to_packet_vectors_deg"] < 0.01
    time = START_TIME + np.linspace(0.0, 0.559, 50)
    assert np.abs(given.trajectory.at(time) - found.trajectory.at(time)).max() < 0.02


def test_a_trajectory_has_the_error_that_the_vectors_see(tmp_path, wide_strip):
    told = find(wide_strip, trajectory=write_trajectory(tmp_path / "t.csv")).describe()
    assert told["range_error_m"] < 0.01 and abs(told["farther_than_by_vectors_m"]) < 0.01
    given = find(wide_strip, trajectory=write_trajectory(tmp_path / "u.csv", off=(0.0, 0.0, 6.0)))
    told = given.describe()
    assert told["range_error_m"] == pytest.approx(6.0 * 0.97, rel=0.03) and given.error == pytest.approx(5.8, abs=0.2)
    assert told["farther_than_by_vectors_m"] == pytest.approx(5.8, abs=0.2)


def test_gaps_are_told(tmp_path, wide_strip):
    told = find(wide_strip, trajectory=write_trajectory(tmp_path / "t.csv", stop=0.3)).describe()
    assert told["share_covered"] == pytest.approx(0.45, abs=0.05)
    assert len(told["gaps_s"]) == 1


def test_haze_lies_between_ground_and_sensor():
    """By a trajectory it is known how high above the sea; else the ground lies there."""
    path = Trajectory.build(np.arange(3.0), np.arange(3.0)[:, None] * [60.0, 0, 0] + [0, 0, 1500])
    assert SensorSource("trajectory", path, distance=1000.0).haze == mean_haze(500.0, 1500.0)
    assert SensorSource("direction vectors", distance=1000.0).haze == mean_haze(0.0, 1000.0) > 0.9
    assert SensorSource("none").haze == 1.0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shift": 86_400.0}, "do not overlap on any clock"),
        ({"off": (300_000.0, 0.0, 0.0)}, "degrees off the packets' vectors"),
        ({"shift": -18.0, "stop": 30.0}, "clock is off by seconds"),
    ],
)
def test_a_trajectory_of_something_else_is_refused(tmp_path, wide_strip, change, message):
    with pytest.raises(InputError, match=message) as caught:
        find(wide_strip, trajectory=write_trajectory(tmp_path / "t.csv", **change))
    assert "t.csv" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("speed", "said"), [(0.0, "moves by 0.0 m"), (0.4, r"moves by \d+\.\d m"), (1.0, "")])
def test_a_trajectory_that_stands_still_is_refused_as_such(tmp_path, wide_strip, speed, said):
    """It was 9 m off "as if its clock were off by -1.4e11 s"."""
    time = START_TIME + np.arange(-1.0, 3.0, 0.05)
    slow = START_TIME + 0.28 + speed * (time - START_TIME - 0.28)
    path = write_positions(tmp_path / "t.csv", time, true_sensor(slow))
    if said:
        refuses(InputError, f"{said} during the strip, but the packets' vectors", find, wide_strip, trajectory=path)
    else:
        find(wide_strip, trajectory=path)


def test_pairs_of_returns():
    time = START_TIME + np.sort(np.random.default_rng(1).uniform(0.0, 3.0, 8000))
    rays = trace_rays(FlightLine(), "flat", (time - START_TIME) * 1e5)
    noise = 0.01 * np.random.default_rng(2).standard_normal((2, 8000, 3))
    first, last = rays.ground - 15 * rays.direction / HALF_C + noise[0], rays.ground + noise[1]
    apart = last - first
    found = estimate_path(RaySample(time, 0.5 * (first + last), apart, (apart**2).sum(axis=1)), "pairs of returns")
    off = np.linalg.norm(found.trajectory.at(time) - true_sensor(time), axis=1)
    assert np.sqrt(np.mean(off**2)) < 1.0
    assert 0.02 < found.error < 1.0


def test_rays_of_little_weight_say_nothing_of_where_rays_meet():
    """Returns close together, as of branches, point anywhere."""
    time = START_TIME + np.linspace(0.0, 3.0, 6000)
    rays = trace_rays(FlightLine(), "flat", (time - START_TIME) * 1e5)
    light = np.arange(6000) % 5 < 2
    weight = np.where(light, 1e-9, 1.0)
    aside = rays.direction + np.where(light, 0.2 * np.linalg.norm(rays.direction[0]), 0.0)[:, None] * [1.0, 0.0, 0.0]
    found = estimate_path(RaySample(time, rays.ground, aside, weight), "pairs of returns")
    assert np.abs(found.trajectory.at(time) - true_sensor(time)).max() < 0.1
    assert estimate_path(RaySample(time, rays.ground, aside, weight[::-1].copy()), "pairs of returns") is None


def about(axis, degrees):
    """Matrix of a rotation about axis 0, 1 or 2."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    turn = np.eye(3)
    turn[np.ix_(*2 * [[(axis + 1) % 3, (axis + 2) % 3]])] = [[c, -s], [s, c]]
    return turn


def flight_of_turned_vectors(turn, view=30.0, pairs=400, along=0.0):
    """A flight over hills of 20 m, and others `along` it, 700 m high, in centimetres, and some pairs of returns."""
    rng = np.random.default_rng(9)
    time = START_TIME + np.sort(rng.uniform(0.0, 3.0, 8000))
    seconds = time - START_TIME
    across = np.tan(np.radians(view / 2)) * (1.0 - 2.0 * (50.0 * seconds % 1.0))
    unit = np.stack([np.full(8000, 0.05), across, np.full(8000, -1.0)], axis=1)
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    distance = (700.0 + 20.0 * np.sin(30.0 * across) + along * np.sin(7.0 * seconds)) / -unit[:, 2]
    ground = np.stack([60.0 * seconds, 0.0 * seconds, 700.0 + 0.0 * seconds], 1) + distance[:, None] * unit
    vector = unit @ turn.T
    some = np.sort(rng.choice(8000, pairs, replace=False))
    apart = np.round(ground[some], 2) - np.round(ground[some] - 9.0 * unit[some], 2)
    return (
        RaySample(time, np.round(ground, 2), vector, np.ones(8000)),
        RaySample(time[some], ground[some] - 4.5 * unit[some], apart, (apart**2).sum(axis=1), vector[some]),
    )


@pytest.mark.quick_cases("0.0-0", "0.05-1", "-0.1-2", "0.3-0")
@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("degrees", [0.0, 0.05, -0.1, 0.3])
def test_vectors_that_are_turned_against_their_points_are_found(axis, degrees):
    """Nothing but pairs of returns was looked at, where vectors met, and no line named them."""
    turn = about(axis, degrees)
    for pairs in (400, 0):
        vectors, two = flight_of_turned_vectors(turn, pairs=pairs)
        true = np.degrees(np.sqrt(np.mean(((vectors.direction - vectors.direction @ turn) ** 2).sum(axis=1))))
        found = estimate_path(vectors, "direction vectors", two)
        facts = dict(found.facts)
        assert abs(facts["turned_deg"] - true) < 2.0 * facts["turned_error_deg"] + 0.01 * true
        assert bool(found.doubt()) == facts["is_turned"]
        assert facts["is_turned"] == (true > 0.03) if pairs else not (facts["is_turned"] and true < 0.03)
        assert facts["turned_error_deg"] < (0.002 if pairs else 0.1)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("degrees", [0.0, 0.3])
def test_rolling_ground_shows_a_turn_about_any_axis_and_ranges_are_right_then(axis, degrees):
    """A turn across the flight was taken for a shift of the sensor, and ranges were off by metres, or their errors."""
    vectors, none = flight_of_turned_vectors(about(axis, degrees), pairs=0, along=15.0)
    found = estimate_path(vectors, "direction vectors", none)
    facts = dict(found.facts)
    assert facts["is_turned"] == bool(degrees)
    assert abs(facts["turned_deg"] - degrees) < 1.5 * facts["turned_error_deg"] < 0.12
    seconds = vectors.time - START_TIME
    off = np.linalg.norm(vectors.point - found.trajectory.at(vectors.time), axis=1) - np.linalg.norm(
        vectors.point - np.stack([60.0 * seconds, 0.0 * seconds, 700.0 + 0.0 * seconds], axis=1), axis=1
    )
    assert np.sqrt(np.mean(off**2)) < found.error + 0.01 < 0.15


@pytest.mark.parametrize(("degrees", "named"), [(0.0, False), (0.01, False), (0.3, True), (-1.0, True)])
def test_vectors_that_roll_along_the_strip_are_named_and_in_the_errors(degrees, named):
    """A roll that grows is no drift of the aircraft: 26 to 40 % of the angles were within their errors."""
    vectors, none = flight_of_turned_vectors(np.eye(3), pairs=0)
    roll = np.radians(degrees) * (vectors.time - START_TIME) / 3.0
    x, y, z = vectors.direction.T
    rolled = np.stack([x, y * np.cos(roll) - z * np.sin(roll), z * np.cos(roll) + y * np.sin(roll)], axis=1)
    found = estimate_path(vectors._replace(direction=rolled), "direction vectors", none)
    assert ("turned against the points" in found.doubt()) == named
    assert (0.4 * abs(degrees) if named else 0.0) < found.turned < max(abs(degrees), 0.03)


@pytest.mark.parametrize("degrees", [0.0, 0.05, 0.3])
@pytest.mark.parametrize("axis", [0, 1])
def test_vectors_that_swing_fast_are_in_the_errors_where_pairs_show_them(axis, degrees):
    """In windows of 1.5 s a swing of 3 s is a drift of the sensor: .3 degrees had an error of .007."""
    swung, vectors, pairs = np.radians(degrees), *flight_of_turned_vectors(np.eye(3))
    vectors, pairs = (
        one._replace(**{name: rays + np.cross(np.eye(3)[axis] * (swung * np.sin(2 * one.time))[:, None], rays)})
        for one, name, rays in ((vectors, "direction", vectors.direction), (pairs, "vector", pairs.vector))
    )
    found = dict(estimate_path(vectors, "direction vectors", pairs).facts)
    rms = np.degrees(np.std(swung * np.sin(2 * pairs.time)))
    assert 1.0 * rms < found["turned_error_deg"] < 1.6 * rms + 0.003


@pytest.mark.parametrize("step", [0.0, 20.0])
@pytest.mark.parametrize("lines", [1, 2, 3])
def test_sound_lines_over_level_ground_are_not_called_turned(lines, step):
    """Rounded coordinates turned windows by radians about the axis that level ground does not show."""
    rng = np.random.default_rng(7)
    second = np.sort(rng.uniform(0.0, 3.0, 8000))
    across = np.tan(np.radians(15.0)) * (1.0 - 2.0 * (50.0 * second % 1.0))
    ahead = np.stack([np.full(8000, 0.05), across, np.full(8000, -1.0)], axis=1)
    ground = ahead * (700.0 - step * (second > 1.5))[:, None] + np.stack([60.0 * second, 0 * second, 0 * second], 1)
    unit = ahead / np.linalg.norm(ahead, axis=1)[:, None]
    parts = []
    for line in range(lines):
        back = about(2, 180.0 * line if lines == 2 else 90.0 * line)
        parts.append((START_TIME + 300 * line + second, np.round(ground @ back.T, 2), unit @ back.T, np.ones(8000)))
    rays = RaySample(*(np.concatenate(values) for values in zip(*parts, strict=True)))
    found = estimate_path(rays, "direction vectors", RaySample(*(values[:0] for values in rays)))
    assert not found.doubt() and dict(found.facts)["turned_error_deg"] < 0.105


@pytest.mark.parametrize(("degrees", "error"), [(0.3, 0.0242), (1.0, 0.0309)])
def test_how_large_turns_are_is_found_with_them_and_scanners_set_a_floor(degrees, error):
    """A first round alone gave 0.971 of 1 degree; mirrors have one floor in all windows, relief one in each."""
    vectors, none = flight_of_turned_vectors(about(1, degrees), pairs=0, along=8.0)
    facts = dict(estimate_path(vectors, "direction vectors", none).facts)
    assert facts["turned_deg"] == pytest.approx(degrees, abs=0.008 + 0.006 * degrees)
    assert facts["turned_error_deg"] == pytest.approx(error, abs=0.0006)


@pytest.mark.parametrize("lift", [0.0, 30.0])
def test_a_part_of_the_strip_at_another_height_is_said_and_in_the_error(lift):
    """A quarter of the ranges was off by up to 30 m, with an error of 4 mm, in silence."""
    vectors, none = flight_of_turned_vectors(np.eye(3), pairs=0, along=8.0)
    time = vectors.time - vectors.time[0]
    lifted = np.where(time > time[-1] / 2, lift, 0.0)
    vectors.point[:, 2] += lifted
    found = estimate_path(vectors, "direction vectors", none)
    assert bool(lift) == bool(found.doubt()) == ("jump_m" in dict(found.facts))
    assert np.abs(found.trajectory.at(vectors.time)[:, 2] - 700.0 - lifted).max() < 2.0 * found.error < lift + 4.0


def test_vectors_of_which_nothing_is_known_may_be_turned_as_far_as_a_mounting():
    vectors, pairs = flight_of_turned_vectors(about(0, 0.5), pairs=15)
    facts, turned, off = find_turn(vectors, pairs, [])
    assert off == facts["turned_deg"] == 0.0 and not turned.any() and not facts["is_turned"]
    assert facts["turned_error_deg"] == pytest.approx(np.degrees(0.0025), abs=0.01)


def test_flights_with_a_break_have_no_positions_in_it():
    rng = np.random.default_rng(3)
    time = START_TIME + np.sort(np.r_[rng.uniform(0, 2, 4000), rng.uniform(60, 62, 4000)])
    rays = trace_rays(FlightLine(), "flat", (time - START_TIME) * 1e5)
    found = estimate_path(RaySample(time, rays.ground, rays.direction, np.ones(8000)), "direction vectors")
    assert np.abs(found.trajectory.at(time) - true_sensor(time)).max() < 0.02
    assert np.isnan(found.trajectory.at(START_TIME + np.array([30.0]))).all()


@pytest.mark.parametrize("seconds", [0.0, 3.0])
def test_rays_that_say_nothing(seconds):
    time = np.linspace(0.0, seconds, 500)
    down = np.tile([0.0, 0.0, -1.0], (500, 1))
    assert estimate_path(RaySample(time, np.zeros((500, 3)), down, np.ones(500)), "direction vectors") is None
    nothing = RaySample(np.empty(0), np.empty((0, 3)), np.empty((0, 3)), np.empty(0))
    assert estimate_path(nothing, "direction vectors") is None


def test_height_is_the_last_resort():
    block = WaveformBlock.from_samples(np.zeros((4, 8), np.uint8))
    slanted = np.tile([0.0, np.sin(0.5), -np.cos(0.5)], (4, 1)) * HALF_C
    slanted[3] = [0.0, 0.0, HALF_C]
    block = replace(block, direction=slanted)
    sensor = SensorSource("flight height", height=800.0).fill(block).sensor
    assert sensor[:3, 2] == pytest.approx(800.0)
    assert np.linalg.norm(sensor[:3], axis=1) == pytest.approx(800.0 / np.cos(0.5))
    assert np.isnan(sensor[3]).all()
    xyz = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, -14.0], [0.0, 0.0, -5.0]])
    returns = ReturnTable(np.array([0, 0, 2], np.int32), np.array([10.0, 90.0, 30.0]), np.arange(3), xyz)
    above = SensorSource("flight height", height=800.0).fill(replace(block, returns=returns)).sensor
    assert above[:3, 2] == pytest.approx([786.0, 800.0, 795.0])
    assert UNKNOWN.fill(block).sensor is None


@pytest.mark.parametrize(
    ("units", "ratio", "message"),
    [
        (CrsUnits("geographic"), 1.0, "coordinates are degrees"),
        (CrsUnits("geocentric"), 1.0, "coordinates are geocentric"),
        (CrsUnits("projected", 1200 / 3937), 3.2804, "coordinates are US survey feet, so ranges"),
        (CrsUnits("projected", 1.0, 0.3048), 1.0, "coordinates are metres with heights in international feet"),
        (CrsUnits("projected", np.nan), 1.0, "coordinates are an unknown unit"),
        (CrsUnits(None), 3.2798, "packet vectors are 3.280 times c/2 long, as in feet"),
    ],
)
def test_what_is_not_in_metres_is_refused(wide_strip, units, ratio, message):
    with StripReader(wide_strip) as reader, reader.scan() as scan:
        reader.facts = replace(reader.facts, units=(CrsUnits("projected", 1.0), units))
        with pytest.raises(InputError, match=message) as caught:
            find_sensor(reader, replace(scan, vectors=replace(scan.vectors, ratio=ratio)), SensorRequest())
    assert "\n" not in str(caught.value) and "project the strip" in str(caught.value)


def test_a_damaged_row_of_a_trajectory_is_refused(tmp_path):
    flight = Sensor(rate=5000.0, n_samples=40)
    trajectory = facet_strips.write_trajectory(tmp_path / "t.csv", flight, 2.0)
    strip = write_strip(tmp_path / "a.las", [Facet(0.3)], flight, 8000)
    find(strip, trajectory=trajectory)
    lines = trajectory.read_text().splitlines()
    time, x, y, z = lines[60].split(",")
    trajectory.write_text("\n".join([*lines[:60], f"{time},{x},{y},{float(z) + 30.0}", *lines[61:]]))
    refuses(InputError, "jumps by 30 m at 3000000", find, strip, trajectory=trajectory)


def test_times_rounded_to_seconds_make_no_pairs_of_returns(tmp_path, edit_points):
    """Neighbouring pulses of one time were taken for returns of one: ranges were 383 m off, with errors of 2.5 m."""

    def round_times(points):
        points["gps_time"] = np.round(points["gps_time"])
        return points

    flight = Sensor(rate=10_000.0, n_samples=40, line_rate=100.0, half_angle=14.6, speed=33.0, height=429.0)
    strip = write_strip(tmp_path / "a.las", [Facet(0.3, slope=(-0.08, -0.03))], flight, 12_000)
    assert find(edit_points(strip, tmp_path / "b.las", round_times)).kind != "pairs of returns"


@pytest.mark.parametrize(
    ("change", "turned"),
    [
        (lambda x, y, z: (x, y, z), (0.0, 0.15)),
        (lambda x, y, z: (y, x, z), (4.0, 15.0)),
        (lambda x, y, z: (0 * x, 0 * y, z.mean() + 0 * z), (89.0, 91.0)),
    ],
    ids=["right", "swapped", "vertical"],
)
def test_vectors_that_do_not_meet_prove_no_angle(tmp_path, edit_points, change, turned):
    """Angles by normals were up to 3 degrees off, with errors of .14."""

    def edit(points):
        points["x_t"], points["y_t"], points["z_t"] = change(points["x_t"], points["y_t"], points["z_t"])
        return points

    flight = Sensor(rate=10_000.0, n_samples=40, line_rate=100.0, heading=60.0, speed=33.0)
    strip = write_strip(tmp_path / "a.las", [Facet(0.3, slope=(0.1, -0.05))], flight, 12_000)
    strip = edit_points(strip, tmp_path / "b.las", edit)
    assert turned[0] <= find(strip).turned <= turned[1]
    columns = "+incidence_angle_normals,+incidence_angle_normals_err"
    succeed("run", strip, "-o", tmp_path / "out", "--profile", "fast", "--columns", columns)
    angle = wb.read_cloud(tmp_path / "out" / "b.laz")["incidence_angle_normals"]
    assert np.isfinite(angle).mean() == pytest.approx(float(turned[1] < 1.0), abs=0.1)


def test_vectors_that_are_wrong_in_a_stretch_give_no_angle_there(tmp_path, edit_points):
    """Angles of such echoes were up to 14 degrees off, with errors of .1; ranges of the others were right."""
    flight, wrong = Sensor(rate=10_000.0, n_samples=40, line_rate=100.0, heading=60.0, speed=33.0), slice(6000, 6400)
    write_strip(tmp_path / "a.las", [Facet(0.3, slope=(0.1, -0.05))], flight, 12_000)

    def swap(points):
        points["x_t"][wrong], points["y_t"][wrong] = points["y_t"][wrong].copy(), points["x_t"][wrong].copy()

    strip = edit_points(tmp_path / "a.las", tmp_path / "b.las", swap)
    columns = "range,range_error,incidence_angle_normals,incidence_angle_normals_err"
    for path in (strip.with_stem("a"), strip):
        succeed("run", path, "-o", tmp_path / "out", "--profile", "fast", "--columns", columns)
    right, found = (wb.read_cloud(tmp_path / "out" / f"{name}.laz") for name in "ab")
    angle, error = found["incidence_angle_normals"], found["incidence_angle_normals_err"]
    assert np.isfinite(found["range"]).all() and np.isnan(angle[wrong]).mean() > 0.95
    known = np.isfinite(angle)
    assert known.mean() > 0.9
    # Swapped, eight rays between north and east are still within .01 rad of the path.
    off = np.abs(angle - right["incidence_angle_normals"])[known]
    assert off.max() < 0.6 and np.sum(off > error[known]) < 10


@pytest.mark.parametrize("change", ["off by less than rays miss the path", "path not known"])
def test_vectors_that_nothing_contradicts_keep_their_angles(tmp_path, edit_points, change):
    """Beside a gap in time, where the path is not known, good vectors lost their angles."""
    flight, part = Sensor(rate=10_000.0, n_samples=40, line_rate=100.0, heading=60.0, speed=33.0), slice(11_880, None)
    write_strip(tmp_path / "a.las", [Facet(0.3, slope=(0.1, -0.05))], flight, 12_000)

    def spoil(points):
        if change == "path not known":
            points["gps_time"][part] += 3.0
        else:
            points["x_t"][part] += 0.006 * points["z_t"][part]

    strip = edit_points(tmp_path / "a.las", tmp_path / "b.las", spoil)
    succeed("run", strip, "-o", tmp_path / "out", "--profile", "fast", "--columns", "range,incidence_angle_normals")
    found = wb.read_cloud(tmp_path / "out" / "b.laz")
    assert np.isnan(found["range"][part]).any() == (change == "path not known")
    assert np.isfinite(found["incidence_angle_normals"][part]).mean() > 0.9


@pytest.mark.quick_cases("apart0-True-2", "apart1-False-4", "apart2-False-0")
@pytest.mark.parametrize("turns", [0, 2, 4])
@pytest.mark.parametrize(("apart", "meets"), [((0, 0, 0), True), ((30, 0, 0), False), ((0, 0, 150), False)])
def test_rays_of_two_sensors_with_the_same_times_do_not_meet(monkeypatch, tmp_path, apart, meets, turns):
    """Two flights of one time of the week: a path half way between them was 14 and 79 m off, with errors of 3 and 4.

    Where they take turns, every eighth pulse is of one of them.
    """
    trajectory = facet_strips.write_trajectory(tmp_path / "t.csv", Sensor(), 2.0)
    first = (np.arange(8000) % turns < turns // 2 if turns else np.random.default_rng(3).random(8000) < 0.4)[:, None]
    monkeypatch.setattr(facet_strips, "path_of", lambda sensor, seconds: path_of(sensor, seconds) + first * apart)
    strip = write_strip(tmp_path / "a.las", [Facet(0.3)], Sensor(rate=5000.0, n_samples=40), 8000)
    assert (find(strip).kind == "direction vectors") == meets
    if apart[0]:
        refuses(InputError, "or to a part of this one", find, strip, trajectory=trajectory)


def test_a_digitizer_whose_vectors_contradict_a_trajectory_is_named(tmp_path, edit_points):
    def turn(points):
        points["x_t"][points["wavepacket_index"] == 3] += 1.5e-5

    flight = Sensor(rate=5000.0, n_samples=40, gains={1: 1.0, 3: 1.0})
    trajectory = facet_strips.write_trajectory(tmp_path / "t.csv", flight, 2.0)
    strip = write_strip(tmp_path / "a.las", [Facet(0.3)], flight, 8000)
    find(strip, trajectory=trajectory)
    strip = edit_points(strip, tmp_path / "b.las", turn)
    with pytest.raises(InputError, match="vectors of digitizer 3 are off the trajectory's rays, those of the others"):
        find(strip, trajectory=trajectory)


@pytest.mark.parametrize(
    ("second", "message"),
    [
        (slice(0), "a tenth of the trajectory's rays"),
        (slice(100, 301, 200), "a tenth of the trajectory's rays"),
        (slice(0, 700, 2), "a tenth of the trajectory's rays"),
        (slice(700, None, 30), "a tenth of the trajectory's rays"),
        (slice(0, None, 2), "vectors of digitizer 1 are off"),
    ],
    ids=["no other", "two rays", "at other times", "ten rays", "at all times"],
)
def test_vectors_are_wrong_only_where_enough_others_agree_at_that_time(second, message):
    """Two rays of a rare digitizer made good vectors wrong, where the trajectory was wrong for 30 % of the strip."""
    vector = np.tile([0.0, 0.1, -1.0], (1000, 1))
    ahead, digitizer = 700.0 * vector, np.ones(1000, np.uint8)
    digitizer[second] = 7
    ahead[(np.arange(1000) >= 700) & (digitizer == 1)] += [60.0, 0.0, 0.0]
    rays = RaySample(np.arange(1000.0), ahead, vector, np.ones(1000), vector, digitizer)
    refuses(InputError, message, _disagreement, ahead, np.linalg.norm(ahead, axis=1), rays)


def fly_level(view, height, *, seed=9, number=8000, degrees=0.0):
    """Times, points, unit vectors and distances of one sensor; its roll drifts by `degrees`, vectors do not say so."""
    time = START + np.sort(np.random.default_rng(seed).uniform(0.0, 3.0, number))
    seconds = time - START
    across = np.tan(np.radians(view / 2) * (1.0 - 2.0 * (50.0 * seconds % 1.0)))
    unit = np.stack([np.full(number, 0.05), across, np.full(number, -1.0)], axis=1)
    unit /= np.linalg.norm(unit, axis=1)[:, None]
    far = height / -unit[:, 2]
    ground = np.outer(seconds, [60.0, 0.0, 0.0]) + [0.0, 0.0, height] + far[:, None] * unit
    roll = np.radians(degrees) * np.sin(2.7 * seconds + 1.0)
    return time, ground, unit + np.cross(np.outer(roll, [1.0, 0.0, 0.0]), unit), far


def true_and_stated(rays, ground, far):
    found = estimate_path(rays, "pairs of returns")
    off = np.linalg.norm(ground - found.trajectory.at(rays.time), axis=1) - far
    return np.sqrt(np.mean(off**2)), found.error


@pytest.mark.parametrize(("view", "height", "number"), [(60, 700, 8000), (75, 1500, 8000), (75, 1500, 20_000)])
def test_wide_views_of_one_sensor_show_no_heights(view, height, number):
    """Errors of directions miss by more the farther the ground is: ranges .2 m off had errors of 2.8 m."""
    time, ground, unit, far = fly_level(view, height, number=number)
    noise = 0.01 * np.random.default_rng(9).standard_normal((2, number, 3))
    first, last = ground - 9.0 * unit + noise[0], ground + noise[1]
    apart = last - first
    rays = RaySample(time, 0.5 * (first + last), apart, (apart**2).sum(axis=1))
    true, stated = true_and_stated(rays, ground, far)
    assert true < stated < 0.7


def test_noise_and_drifts_of_one_sensor_show_no_heights():
    """By chance noise grows with the angle, too; a roll that drifts looks like sensors a few decimetres apart."""
    for seed in range(4):
        time, ground, unit, _ = fly_level(30, 700, seed=seed, number=2000)
        unit += 3e-3 * np.random.default_rng(seed).standard_normal((2000, 3))
        assert 0.8 < estimate_path(RaySample(time, ground, unit, np.ones(2000)), "direction vectors").error < 1.1
    time, ground, unit, far = fly_level(30, 700, degrees=0.05)
    true, stated = true_and_stated(RaySample(time, ground, unit, np.ones(8000)), ground, far)
    assert true < stated < 1.6 * true


@pytest.mark.parametrize(("above", "share"), [(20.0, 0.5), (20.0, 0.2), (20.0, 0.08), (5.0, 0.3), (0.0, 0.5)])
def test_errors_hold_two_sensors_above_each_other(monkeypatch, tmp_path, above, share):
    """Their rays hardly miss a path between them: ranges were 10 m off with errors of 1 m, or 20 m with .00."""
    second = np.random.default_rng(5).random(8000) < share
    lift = np.outer(second, [0.0, 0.0, above])
    monkeypatch.setattr(facet_strips, "path_of", lambda sensor, seconds: path_of(sensor, seconds) + lift)
    flight = Sensor(rate=5000.0, n_samples=40)
    found = find(write_strip(tmp_path / "a.las", [Facet(0.3)], flight, 8000))
    if above == 20.0 and share > 0.1:
        assert found.kind == "none" and dict(found.facts)["do_not_meet_deg"]
        return
    seconds = np.arange(8000) / flight.rate
    off = found.trajectory.at(START + seconds) - path_of(flight, seconds) - lift - [EAST, NORTH, 0.0]
    high = np.sqrt(np.nanmean(off[:, 2] ** 2))
    assert 0.7 * high < found.error < 1.5 * high if above else found.error < 0.1


def test_a_strip_that_is_sorted_by_place_has_the_sensor_at_all_times(tmp_path, edit_points):
    """Points of tiles, one tile after the other: each place of the file has rays of a short time."""
    flight, pulses = Sensor(rate=1000.0, n_samples=40), 40_000
    strip = write_strip(tmp_path / "time.las", [Facet(0.3)], flight, pulses)

    def sort(points):
        along, across = points["X"] - points["X"].min(), points["Y"] - points["Y"].min()
        return points[np.lexsort((along, across, across // 80_000, along // 80_000))]

    sorted_by_place = edit_points(strip, tmp_path / "place.las", sort)
    time = START + np.arange(pulses) / flight.rate
    positions = find(sorted_by_place).trajectory.at(time)
    assert np.isfinite(positions).all()
    true = path_of(flight, time - START) + [EAST, NORTH, 0.0]
    assert np.sqrt(np.mean((positions - true) ** 2)) < 0.1


def test_a_few_rays_of_every_place(wide_strip):
    with StripReader(wide_strip) as reader, reader.scan() as scan:
        vectors, _ = sample_rays(reader, scan)
        again, _ = sample_rays(reader, scan)
    assert 500 < len(vectors.time) <= MOST_SLICES * RAYS_PER_SLICE
    assert (np.diff(vectors.time) >= 0).all()
    np.testing.assert_array_equal(vectors.direction, again.direction)


def test_a_sample_of_rays_is_no_smaller_than_asked(tmp_path):
    """Steps that are no whole numbers took a tenth fewer; a strip of one place is read at both ends."""
    strip = write_strip(tmp_path / "a.las", [Facet(0.3)], Sensor(rate=5000.0, n_samples=40), 2048)
    with StripReader(strip) as reader, reader.scan() as scan:
        vectors, _ = sample_rays(reader, scan)
    assert 2 * RAYS_PER_SLICE <= len(vectors.time) < 2.2 * RAYS_PER_SLICE


def wobble(rng, level):
    """Motion of an aircraft besides its course: sinusoids of 0.03 to 2 Hz; the slow ones are `level` m large."""
    frequency = np.geomspace(0.03, 2, 24)
    size = level * rng.rayleigh(1, (3, 24)) / np.sqrt(24) * (frequency / 0.1) ** -1.67
    phase = rng.uniform(0, 2 * np.pi, (3, 24))
    angle = 2 * np.pi * frequency[:, None]
    return lambda time: (size[:, :, None] * np.sin(angle * time + phase[:, :, None])).sum(axis=1).T


def drift(rng, time, memory):
    """Values of spread 1 that are alike for `memory` seconds."""
    steps = np.arange(time[0], time[-1] + memory, memory / 20)
    values, keep = [rng.standard_normal()], np.exp(-1 / 20)
    for shock in np.sqrt(1 - keep**2) * rng.standard_normal(len(steps) - 1):
        values.append(keep * values[-1] + shock)
    return np.interp(time, steps, values)


def fly_roughly(rng, *, seconds=5.0, level=0.0, mounting=0.0, attitude=0.0, view=60.0, rounding=0.01):
    """Rays of a flight 1000 m high as a file holds them, and how far their ranges by the vectors are off [m]."""
    time = np.sort(rng.uniform(0, seconds, int(4000 * seconds)))
    sensor = np.stack([60 * time, 0 * time, 1000 + 0 * time], axis=1) + wobble(rng, level)(time)
    angle = np.radians(view / 2) * (4 * np.abs(time * 50 % 1 - 0.5) - 1)
    x, y, z = np.zeros(len(time)), np.sin(angle), -np.cos(angle)
    ground = sensor + np.stack([x, y, z], axis=1) * (sensor[:, 2] / -z)[:, None]
    roll, pitch = np.full((2, len(time)), mounting)
    if attitude:
        roll, pitch = (1e-4 * drift(rng, time, attitude) for _ in range(2))
    turned = np.stack([x + pitch * z, y - roll * z, z + roll * y - pitch * x], axis=1)
    vectors = (turned * 1.4986e-4).astype(np.float32).astype(np.float64)
    rays = RaySample(time, np.round(ground / rounding) * rounding, vectors, np.ones(len(time)))
    found = estimate_path(rays, "direction vectors")
    far = np.linalg.norm(ground - found.trajectory.at(time), axis=1) - np.linalg.norm(ground - sensor, axis=1)
    seen = found.error**2
    return float(np.sqrt(seen)), float(np.sqrt(np.nanmean(far**2)))


@pytest.mark.quick_cases("{'level': 0.3}", "{'mounting':*", "{'attitude': 5.0}")
@pytest.mark.parametrize(
    "flight",
    [
        {},
        {"rounding": 0.001},
        {"seconds": 0.3},
        {"level": 0.3},
        {"level": 1.0, "rounding": 0.001},
        {"level": 1.0, "view": 20.0},
        {"mounting": 1e-4},
        {"mounting": 1e-4, "seconds": 0.3},
        {"attitude": 0.05},
        {"attitude": 0.5},
        {"attitude": 5.0},
    ],
    ids=str,
)
def test_the_error_of_the_position_covers_what_it_is(flight):
    """It was 3 to 22 times too small where the aircraft moves, its mounting is turned or its attitude drifts."""
    claimed, true = np.array([fly_roughly(np.random.default_rng(seed), **flight) for seed in range(4)]).T
    assert np.sqrt(np.mean(true**2) / np.mean(claimed**2)) < 1.3
    assert np.median(true / claimed) > 0.2


def test_few_windows_assume_what_an_aircraft_does_in_turbulent_air():
    claimed, true = fly_roughly(np.random.default_rng(1), seconds=1.4, level=0.3, rounding=0.001)
    still, _ = fly_roughly(np.random.default_rng(1), seconds=1.4, rounding=0.001)
    assert still > 0.003 and claimed > 0.6 * true


@pytest.mark.parametrize("time", [0.0, 123.0])
def test_a_trajectory_is_of_no_use_to_points_without_times(tmp_path, tiny_strip, edit_points, time):
    """The advice was to give --trajectory, which was given."""

    strip = edit_points(tiny_strip, tmp_path / "still.las", gps_time=time)
    with pytest.raises(InputError, match="no GPS times, or all the same; give --flight-height instead"):
        find(strip, trajectory=write_trajectory(tmp_path / "t.csv"))
    assert find(strip, height=800.0).kind == "flight height"


@pytest.mark.parametrize(("shown", "code"), [("echo_width", 0), ("range", 4), ("incidence_angle_normals", 4)])
def test_heights_above_the_ground_are_refused_where_slopes_or_ranges_are_asked_for(
    tmp_path, wide_strip, edit_points, shown, code
):
    """Normalised heights made slopes 6 to 16 degrees wrong, with errors of 0.1 to 1, without a line."""

    def normalise(points):
        points["Z"][(points["raw_classification"] & 31) == 2] = 0
        points["Z"][::10] += 20  # what lies between the points that the ground was made of

    strip = edit_points(wide_strip, tmp_path / "s.las", normalise)
    done = run_command("run", strip, "-o", tmp_path / "out", "--columns", f"+{shown}", "--profile", "fast")
    assert done.exit_code == code
    assert ("(class 2) have the height 0: heights count from the ground" in done.stderr) == (code > 0)


def test_ground_that_is_level_at_0_is_no_normalised_strip(tmp_path, edit_points):
    """Its rays meet. Simulated towns and fields stand at 0, and were refused."""
    succeed("simulate", "flat", "-o", tmp_path / "in.las", "--pulses", "3000", "-q")
    strip = edit_points(tmp_path / "in.las", tmp_path / "s.las", Z=0)
    place_header(strip, lambda fields: np.r_[fields[:5], 0.0, fields[6:]])
    with StripReader(strip) as reader, reader.scan() as scan:
        assert measure_scale(reader, scan).level
        assert find_sensor(reader, scan, SensorRequest()).kind == "direction vectors"


@pytest.mark.parametrize(("step", "level"), [(0.01, True), (0.1, False)])
def test_steps_of_heights_that_make_a_polder_level_are_no_normalisation(tmp_path, wide_strip, edit_points, step, level):
    """Ground within .05 m of the sea was refused, where heights are stored in steps of .1 m."""
    strip = edit_points(wide_strip, tmp_path / "s.las", Z=0)
    place_header(strip, lambda fields: np.r_[fields[:2], step, fields[3:]])
    with StripReader(strip) as reader, reader.scan() as scan:
        assert measure_scale(reader, scan).level == level


@pytest.mark.quick_cases("vectors", "unit")
@pytest.mark.parametrize("wrong", ["vectors", "unit", ""])
def test_a_crs_in_metres_does_not_vouch_for_vectors_and_unit(tmp_path, edit_points, wrong):
    """With one, as all LAS 1.4 strips have it, neither rays beside the returns nor feet were looked for."""
    simulate = "simulate", "forest", "-o", tmp_path / "in.las", "--point-format", "9", "--pulses", "3000", "-q"
    succeed(*simulate)

    def change(points):
        if wrong == "vectors":
            points["z_t"] = np.sqrt(sum(points[name] ** 2 for name in ("x_t", "y_t", "z_t")))
            points["x_t"] = points["y_t"] = 0.0
        elif wrong == "unit":
            for axis in "XYZ":
                points[axis] = np.rint(points[axis] / 0.3048)

    strip = edit_points(tmp_path / "in.las", tmp_path / "s.las", change)
    done = run_command("run", strip, "-o", tmp_path / "out", "--quiet")
    assert done.exit_code == (4 if wrong == "unit" else 0)
    checked = run_command("check", strip)
    voxels = run_command("voxelize", strip, "--size", "2", "-o", tmp_path / "v.npz", "--quiet")
    assert checked.exit_code == bool(wrong) and voxels.exit_code == (wrong == "unit")
    for said in (done.stderr, checked.stdout, voxels.stderr):
        assert ("the second lies off its ray" in said) == (wrong == "vectors")
        assert ("coordinates are in feet, packet vectors in metres" in said) == (wrong == "unit")
