"""Trajectories: files of every kind, the clock, gaps, interpolation, lever arm; every refusal in one line."""

import numpy as np
import pytest
from commands import refuses

from wavebatch.core.errors import InputError
from wavebatch.core.trajectory import ADJUSTED, WEEK, Trajectory, apply_lever_arm, solve_offset
from wavebatch.files.trajectory_file import SBET_RECORD, read_trajectory


def flight(rate=20.0, seconds=20.0, start=300_000_000.0):
    """Times and positions of a banked turn of 60 m/s, 2 m/s2."""
    time = start + np.arange(0.0, seconds, 1.0 / rate)
    turn = 0.03 * (time - start)
    xyz = np.stack([5e5 + 2000 * np.sin(turn), 5.4e6 + 2000 * np.cos(turn), 1000 + 3 * np.sin(turn * 5)], axis=1)
    return time, xyz


@pytest.mark.parametrize(("rate", "limit"), [(200.0, 1e-5), (1.0, 0.01)])
def test_interpolation_whatever_the_order_of_the_positions(rate, limit):
    time, xyz = flight(rate)
    mixed = np.random.default_rng(1).permutation(np.r_[np.arange(len(time)), 5, 6])
    path = Trajectory.build(time[mixed], xyz[mixed])
    asked, places = flight(997.0, 18.0)
    inside = (asked > path.time[2]) & (asked < path.time[-3])
    assert np.abs(path.at(asked[inside]) - places[inside]).max() < limit
    assert path.at(path.time) == pytest.approx(xyz, abs=1e-9)


def test_nothing_is_said_outside_and_in_gaps():
    time, xyz = flight()
    keep = (time < 300_000_005.0) | (time > 300_000_009.0)
    path = Trajectory.build(time[keep], xyz[keep])
    asked = 300_000_000.0 + np.array([-0.1, 2.0, 7.0, 12.0, 30.0])
    assert np.isfinite(path.at(asked)[:, 0]).tolist() == [False, True, False, True, False]
    (a, b), (c, d) = path.gaps(300_000_001.0, 300_000_030.0)
    assert (a, c, d) == pytest.approx((300_000_004.95, 300_000_019.95, 300_000_030.0))
    assert b == pytest.approx(300_000_009.0, abs=0.051)
    assert path.share_known(300_000_001.0, 300_000_004.0) == 1.0
    assert path.share_known(300_000_005.0, 300_000_009.0) == pytest.approx(0.0, abs=0.02)


@pytest.mark.parametrize(
    ("rate", "noise", "rows", "size"),
    [
        (200.0, 0.0, slice(700, 701), 30.0),
        (20.0, 0.0, slice(70, 90), 30.0),
        (20.0, 0.3, slice(70, 71), 30.0),
        (1.0, 0.0, slice(7, 8), 40.0),
        (20.0, 0.3, slice(0), 0.0),
        (1.0, 0.0, slice(0), 0.0),
        (20.0, 0.0, slice(370, 371), 0.0),  # after the strip
    ],
)
def test_positions_that_no_aircraft_takes_are_found(rate, noise, rows, size):
    """A damaged row put 5 % of the echoes 30 m off, or 5,000 km, with errors of 1 mm."""
    time, xyz = flight(rate)
    xyz += noise * np.random.default_rng(2).standard_normal(xyz.shape)
    xyz[rows] += [0.0, 0.0, size or 30.0]
    jump = Trajectory.build(time, xyz).find_jump(300_000_001.0, 300_000_016.0)
    assert (jump is not None) == (size > 0.0)
    if jump is not None:
        assert time[rows][0] <= jump[0] <= time[rows][-1] + 2.0 / rate
        assert 0.4 * size < jump[1] < 1.1 * size


@pytest.mark.parametrize("number", [0, 1])
def test_too_few_positions(number):
    refuses(InputError, "at least two are needed", Trajectory.build, np.arange(number), np.zeros((number, 3)))
    refuses(InputError, "at least two are needed", Trajectory.build, np.array([1.0, np.nan]), np.zeros((2, 3)))


ADJUSTED_START = 300_000_000.0
WEEK_START = (ADJUSTED_START + ADJUSTED) % WEEK


@pytest.mark.parametrize(
    ("own", "strip", "clocks"),
    [
        (ADJUSTED_START, ADJUSTED_START, "the same clock"),
        (ADJUSTED_START + ADJUSTED, ADJUSTED_START, "standard to adjusted"),
        (ADJUSTED_START, ADJUSTED_START + ADJUSTED, "adjusted to standard"),
        (WEEK_START, ADJUSTED_START, "seconds of the week to adjusted"),
        (WEEK_START, ADJUSTED_START + ADJUSTED, "seconds of the week to standard"),
        (ADJUSTED_START, WEEK_START, "GPS time to seconds of the week"),
        (ADJUSTED_START + ADJUSTED, WEEK_START, "GPS time to seconds of the week"),
    ],
)
def test_the_clock_is_solved_from_the_data(own, strip, clocks):
    path = Trajectory.build(*flight(start=own))
    offset, words = solve_offset(path, strip + 2.0, strip + 12.0)
    assert clocks in words
    assert own + offset == pytest.approx(strip, abs=1e-3)


def test_a_trajectory_of_another_day_is_refused():
    path = Trajectory.build(*flight())
    refuses(InputError, "do not overlap on any clock", solve_offset, path, 300_086_400.0, 300_086_500.0)


def test_lever_arm():
    level = np.zeros((1, 3))
    xyz = np.array([[10.0, 20.0, 30.0]])
    arm = (1.0, 2.0, 3.0)
    assert apply_lever_arm(xyz, level, arm)[0] == pytest.approx([12.0, 21.0, 27.0])
    east = np.array([[0.0, 0.0, np.pi / 2]])
    assert apply_lever_arm(xyz, east, arm)[0] == pytest.approx([11.0, 18.0, 27.0])
    nose_up = np.array([[0.0, np.pi / 2, 0.0]])
    assert apply_lever_arm(xyz, nose_up, (1.0, 0.0, 0.0))[0] == pytest.approx([10.0, 20.0, 31.0])
    right_wing_down = np.array([[np.pi / 2, 0.0, 0.0]])
    assert apply_lever_arm(xyz, right_wing_down, (0.0, 1.0, 0.0))[0] == pytest.approx([10.0, 20.0, 29.0])


def write_text(path, head, mark, order, time, xyz, extra=()):
    columns = {"t": time, "x": xyz[:, 0], "y": xyz[:, 1], "z": xyz[:, 2], **dict(extra)}
    rows = np.stack([columns[name] for name in order], axis=1)
    path.write_text(head + "\n" + "\n".join(mark.join(f"{value:.6f}" for value in row) for row in rows) + "\n")
    return path


@pytest.mark.parametrize(
    ("head", "mark", "order"),
    [
        ("time,x,y,z", ",", "txyz"),
        ("GPSTime[s];Easting[m];Northing[m];Altitude[m]", ";", "txyz"),
        ("# made by someone\n#gps_time x y z", " ", "txyz"),
        ("z\ty\tx\tGPS Time (s)", "\t", "zyxt"),
        ('"H (m)","N (m)","E (m)","sow"\n(m),(m),(m),(s)', ",", "zyxt"),
        ("time,status,x,y,z", ",", "tzxyz"),
        ('"time","x","y","z"', '","', "txyz"),
        ("  TIME, EASTING, NORTHING, ELLIPSOID HEIGHT\n (sec), (m), (m), (m)", ",", "txyz"),
    ],
)
def test_text_with_headers(tmp_path, head, mark, order):
    time, xyz = flight(seconds=3.0)
    found = read_trajectory(write_text(tmp_path / "t.txt", head, mark, order, time, xyz))
    np.testing.assert_allclose(found.time, time, atol=1e-6)
    np.testing.assert_allclose(found.xyz, xyz, atol=1e-6)


def test_text_with_a_lever_arm(tmp_path):
    time, xyz = flight(seconds=3.0)
    turned = {"r": np.zeros(len(time)), "p": np.zeros(len(time)), "h": np.full(len(time), 90.0)}
    path = write_text(tmp_path / "t.csv", "time,x,y,z,roll,pitch,heading", ",", "txyzrph", time, xyz, turned.items())
    found = read_trajectory(path, lever_arm=(2.0, 0.0, 0.0))
    np.testing.assert_allclose(found.xyz, xyz + [2.0, 0.0, 0.0], atol=1e-6)
    with pytest.raises(InputError, match="has no roll, pitch, heading"):
        read_trajectory(write_text(tmp_path / "u.csv", "time,x,y,z", ",", "txyz", time, xyz), lever_arm=(1, 0, 0))


def write_sbet(path, latitude=48.0, number=400):
    records = np.zeros(number, SBET_RECORD)
    records["time"] = 259_200.0 + 0.005 * np.arange(number)
    records["latitude"] = np.radians(latitude) + 1e-7 * np.arange(number)
    records["longitude"] = np.radians(11.0)
    records["height"] = 1500.0
    records.tofile(path)
    return path


def test_sbet_without_pyproj_or_crs_is_refused(tmp_path, monkeypatch):
    path = write_sbet(tmp_path / "s.sbet")
    refuses(InputError, "but the strip has no CRS", read_trajectory, path)
    monkeypatch.setitem(__import__("sys").modules, "pyproj", None)
    refuses(InputError, r"pip install 'pyproj>=3.6'", read_trajectory, path, crs="EPSG:32632")


def test_bytes_that_are_no_sbet(tmp_path):
    path = tmp_path / "s.out"
    np.random.default_rng(1).normal(0, 1e6, 17 * 50).astype("<f8").tofile(path)
    refuses(InputError, "not an SBET", read_trajectory, path, crs="EPSG:32632")


@pytest.mark.parametrize(("heading", "wander"), [(np.inf, np.inf), (1e308, -1e308), (np.nan, 0.0)])
def test_a_damaged_record_of_an_sbet_is_left_out_without_a_warning(tmp_path, heading, wander):
    path = write_sbet(tmp_path / "s.sbet")
    sound = read_trajectory(path, crs="EPSG:32633", lever_arm=(1.0, 0.0, 0.0))
    records = np.fromfile(path, SBET_RECORD)
    records["heading"][7], records["wander"][7], records["latitude"][9] = heading, wander, 1e308
    records.tofile(path)
    found = read_trajectory(path, crs="EPSG:32633", lever_arm=(1.0, 0.0, 0.0))
    assert np.array_equal(found.time, np.delete(sound.time, [7, 9])) and np.isfinite(found.xyz).all()


def test_sbet_is_projected(tmp_path):
    found = read_trajectory(write_sbet(tmp_path / "s.sbet"), crs="EPSG:32632")
    # UTM zone 32: 11 E, 48 N by Snyder's series.
    assert found.xyz[0] == pytest.approx([649_168.5, 5_318_366.0, 1500.0], abs=200.0)
    assert found.velocity[200, 1] == pytest.approx(127.0, abs=2.0)
    refuses(InputError, "needs metres", read_trajectory, tmp_path / "s.sbet", crs="EPSG:4326")
    refuses(InputError, "CRS of the strip is not understood", read_trajectory, tmp_path / "s.sbet", crs="nonsense")


def test_positions_beyond_all_places_are_dropped():
    """Their squares overflow."""
    time = np.array([0.0, 1.0, 2.0, 1e300, 4.0])
    xyz = np.zeros((5, 3))
    xyz[1] = 1e308
    assert Trajectory.build(time, xyz).time.tolist() == [0.0, 2.0, 4.0]


def test_positions_at_almost_the_same_time_are_dropped():
    """Velocities of half of them overflow."""
    time, xyz = np.array([0.0, 5e-324, 1.0, 1.0 + 2e-10, 2.0]), np.arange(15.0).reshape(5, 3)
    built = Trajectory.build(time, xyz)
    assert built.time.tolist() == [0.0, 1.0, 2.0] and np.isfinite(built.velocity).all()
