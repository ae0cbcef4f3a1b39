"""Which way packet vectors point and how long they are: decided, reported, overridden, refused."""

import numpy as np
import pytest
from strips import TOWARD, make_raw, read_all

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.strip import shared_packets
from wavebatch.files.strip.reader import StripReader


def scan_of(path, **options):
    with StripReader(path, **options) as reader, reader.scan() as scan:
        return scan


def turn(raw, factor):
    for name in ("x_t", "y_t", "z_t"):
        raw.points[name] *= np.float32(factor)


@pytest.mark.parametrize("toward", [True, False])
@pytest.mark.parametrize("most_returns", [1, 3])
def test_either_sign_gives_the_same_rays(tmp_path, toward, most_returns):
    raw = make_raw(toward=toward, most_returns=most_returns)
    path = raw.write(tmp_path / "a.las")
    scan = scan_of(path)
    assert scan.vectors.direction == ("toward" if toward else "away")
    assert scan.vectors.ratio == pytest.approx(np.linalg.norm(TOWARD) * 1000 / 0.149896229)
    assert scan.warnings == ()
    for _, _, origin, direction in read_all(path).values():
        assert origin[2] == pytest.approx(500, abs=2e-3)
        np.testing.assert_allclose(direction, -1000 * TOWARD, rtol=1e-6)


def test_witnesses_that_contradict_each_other_are_refused_unless_overridden(tmp_path):
    """The pulses go up: shared packets say toward, heights say away."""
    raw = make_raw()
    raw.scales = (0.001, 0.001, -0.001)
    turn_z = raw.points["z_t"]
    turn_z *= -1
    path = raw.write(tmp_path / "a.las")
    with pytest.raises(InputError, match=r"a\.las: packet vectors contradict each other: .*pass --direction"):
        scan_of(path)
    scan = scan_of(path, direction="toward")
    assert (scan.vectors.direction, scan.problems) == ("toward", ())
    assert "--direction toward overrides" in scan.warnings[0]
    assert scan_of(path, direction="away").vectors.direction == "away"


def test_vectors_that_say_nothing_are_refused_unless_overridden(tmp_path):
    raw = make_raw(most_returns=1)
    raw.points["z_t"][::2] *= -1
    path = raw.write(tmp_path / "a.las")
    with pytest.raises(InputError, match="is not clear.*--direction toward or away"):
        scan_of(path)
    assert scan_of(path, direction="away").vectors.direction == "away"


def test_heights_that_vary_do_not_matter_where_packets_are_shared(tmp_path):
    raw = make_raw(60, most_returns=3, toward=False)
    pulse = np.round((raw.points["gps_time"] - 1000) * 1e5).astype(int)
    start = np.stack([pulse * 0.5, 0 * pulse, 0 * pulse + 500.0], axis=1)
    vector = np.where((pulse % 2 == 0)[:, None], TOWARD, -TOWARD)
    xyz = start - raw.points["return_point_wave_location"][:, None].astype(float) * vector
    for axis, name in enumerate("XYZ"):
        raw.points[name] = np.rint(xyz[:, axis] / 0.001)
        raw.points[("x_t", "y_t", "z_t")[axis]] = -vector[:, axis]
    assert scan_of(raw.write(tmp_path / "a.las")).vectors.direction == "away"


def test_a_given_direction_that_the_file_denies_is_used_and_said(tmp_path):
    path = make_raw().write(tmp_path / "a.las")
    scan = scan_of(path, direction="away")
    assert scan.vectors.direction == "away"
    assert "overrides the evidence of the file" in scan.warnings[0]
    assert scan_of(path, direction="toward").warnings == ()


def test_an_unknown_direction_is_a_config_error(tmp_path):
    with pytest.raises(ConfigError, match="'up'.*auto, toward, away"):
        StripReader(make_raw().write(tmp_path / "a.las"), direction="up")


@pytest.mark.parametrize("factor", [0.5, 1.1, 30.0])
def test_odd_lengths_are_used_as_stored_and_said(tmp_path, factor):
    raw = make_raw(most_returns=1)
    turn(raw, factor)
    path = raw.write(tmp_path / "a.las")
    scan = scan_of(path)
    assert scan.vectors.form == "stored"
    assert "times c/2 long" in scan.warnings[0]
    direction = next(iter(read_all(path).values()))[3]
    np.testing.assert_allclose(direction, -1000 * TOWARD * factor, rtol=1e-5)


def test_yellowscan_length_is_no_reason_to_warn(tmp_path):
    raw = make_raw(most_returns=1)
    turn(raw, 0.965)
    assert scan_of(raw.write(tmp_path / "a.las")).warnings == ()


@pytest.mark.parametrize("most_returns", [1, 3])
def test_vectors_as_long_as_the_path_are_divided_by_minus_the_location(tmp_path, most_returns):
    raw = make_raw(most_returns=most_returns)
    for name in ("x_t", "y_t", "z_t"):
        raw.points[name] *= -raw.points["return_point_wave_location"]
    path = raw.write(tmp_path / "a.las")
    scan = scan_of(path)
    assert (scan.vectors.form, scan.vectors.direction) == ("range", "toward")
    assert scan.vectors.ratio == pytest.approx(0.9997, abs=0.01)
    assert "divided by minus the return location" in scan.warnings[0]
    for _, _, origin, direction in read_all(path).values():
        assert origin[2] == pytest.approx(500, abs=2e-3)
        np.testing.assert_allclose(direction, -1000 * TOWARD, rtol=1e-5)


def test_returns_that_meet_only_far_apart_still_vote(tmp_path, monkeypatch):
    """Heights say nothing here, and no two returns of a packet lie in one unit or window."""
    raw = make_raw(300, most_returns=2)
    pulse = np.round((raw.points["gps_time"] - 1000) * 1e5).astype(int)
    start = np.stack([pulse * 0.5, 0 * pulse, 0 * pulse + 500.0], axis=1)
    vector = np.where((pulse % 2 == 0)[:, None], TOWARD, -TOWARD)
    xyz = start - raw.points["return_point_wave_location"][:, None].astype(float) * vector
    for axis, name in enumerate("XYZ"):
        raw.points[name] = np.rint(xyz[:, axis] / 0.001)
        raw.points[("x_t", "y_t", "z_t")[axis]] = vector[:, axis]
    raw.points = raw.points[np.argsort(raw.points["bit_fields"], kind="stable")]
    monkeypatch.setattr(shared_packets, "WINDOW", 64)
    assert scan_of(raw.write(tmp_path / "a.las")).vectors.direction == "toward"
