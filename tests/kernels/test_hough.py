"""Straight lines in slices, and points that lie on two lines."""

import numpy as np
import pytest
from commands import refuses
from published import paint_slice

from wavebatch.kernels.geometry.normals import Gap, Surroundings, measure_normals
from wavebatch.kernels.geometry.planes import in_two_lines
from wavebatch.kernels.geometry.slice_lines import LAG, THETA_STEP, _Accumulator, find_lines, find_sweeps


def detect(image, sigma=8.0, **options):
    roi = image > 2 * image.std()
    row, column = np.nonzero(roi)
    return find_lines(column.astype(float), row.astype(float), image[roi], sigma=sigma, **options)


@pytest.mark.quick_cases("0.0", "1.0", "-0.7")
@pytest.mark.parametrize("slope", [0.0, 0.1, 0.2, 0.5, 1.0, -0.7])
def test_position_and_angle_meet_the_acceptance(slope):
    off, turn = [], []
    for seed in range(4):
        rng = np.random.default_rng(1000 + seed)
        column = 200 + rng.uniform(-3, 3)
        (line,) = detect(paint_slice(rng, [(column, slope, 0, 320)]))
        x, y = np.add(line.start, line.end) / 2
        off.append((x - slope * (y - 160) - column) / np.hypot(1, slope))
        turn.append((line.theta - np.degrees(np.arctan2(-slope, 1)) + 90) % 180 - 90)
        assert line.start[0] * np.cos(np.radians(line.theta)) + line.start[1] * np.sin(
            np.radians(line.theta)
        ) == pytest.approx(line.rho, abs=1e-9)
    assert np.sqrt(np.mean(np.square(off))) < 0.05
    assert np.sqrt(np.mean(np.square(turn))) < 0.1


def test_segments_of_one_line_are_separated_by_their_gap(rng):
    image = paint_slice(rng, [(200, 0.1, 0, 140), (200, 0.1, 180, 320)])
    lines = detect(image)
    assert sorted(round(line.length / 10) for line in lines) == [14, 14]
    assert len(detect(image, gap=60.0)) == 1


def test_crossing_lines_are_both_found(rng):
    lines = detect(paint_slice(rng, [(200, 0.6, 0, 320), (200, -0.6, 0, 320)]))
    angles = sorted(line.theta for line in lines[:2])
    assert angles == pytest.approx([-30.96, 30.96], abs=0.6)


def test_short_pieces_and_noise_are_no_segments(rng):
    assert detect(paint_slice(rng, [(200, 0.0, 100, 112)])) == []
    assert detect(rng.standard_normal((100, 100)), sigma=2.0, gap=3.0) == []
    assert find_lines(np.empty(0), np.empty(0), np.empty(0), sigma=1.0) == []
    assert find_lines(np.ones(3), np.ones(3), np.ones(3), sigma=1.0) == []


def test_pixels_belong_to_one_segment_and_coordinates_may_lie_anywhere(rng):
    image = paint_slice(rng, [(100, 0.0, 0, 320), (300, 0.0, 0, 320)])
    roi = image > 2 * image.std()
    row, column = np.nonzero(roi)
    lines = find_lines(column + 5.4e6, row + 5e5, image[roi], sigma=8.0)
    assert len(lines) == 2
    rows = np.concatenate([line.rows for line in lines])
    assert len(np.unique(rows)) == len(rows)
    assert sorted(line.start[0] - 5.4e6 for line in lines) == pytest.approx([100, 300], abs=0.5)


def test_most_limits_the_segments(rng):
    image = paint_slice(rng, [(100, 0.0, 0, 320), (300, 0.0, 0, 320)])
    assert len(detect(image, most=1)) == 1


def test_votes_are_split_between_bins_and_can_be_taken_back(rng):
    points = rng.uniform(-20, 20, (50, 2))
    weight = rng.uniform(1, 2, 50)
    sheet = _Accumulator(points)
    sheet.vote(np.arange(50), weight)
    assert sheet._sums.sum(axis=1) == pytest.approx(np.full(round(180 / THETA_STEP), weight.sum()))
    centre = sheet._sums @ (np.arange(sheet._width) - sheet._reach)
    assert centre[180] == pytest.approx(weight @ points[:, 0])
    sheet.vote(np.arange(50), -weight)
    assert np.abs(sheet._sums).max() < 1e-9


def test_wide_slices_have_coarse_steps_and_the_same_lines(rng):
    image = paint_slice(rng, [(200, 0.1, 0, 320)])
    roi = image > 2 * image.std()
    row, column = np.nonzero(roi)
    far_x, far_y = np.append(column, 90_000.0), np.append(row, 0.0)
    weight = np.append(image[roi], 0.1)
    assert _Accumulator(np.stack([far_x, far_y], axis=1))._sums.nbytes < 200e6
    (line,) = find_lines(far_x, far_y, weight, sigma=8.0)
    (near,) = detect(image)
    assert line.theta == pytest.approx(near.theta, abs=0.02)
    assert line.start == pytest.approx(near.start, abs=0.1)


def zigzag(lines, pulses):
    up = np.linspace(-0.4, 0.4, pulses)
    return np.concatenate([up if number % 2 == 0 else up[::-1] for number in range(lines)])


def test_scan_lines_end_where_the_mirror_turns(rng):
    angle = zigzag(6, 200) + 1e-4 * rng.standard_normal(1200)
    found = find_sweeps(angle, np.arange(1200) * 1e-5)
    assert found[0] == 0 and len(found) == 6
    assert np.abs(found[1:] - np.arange(200, 1200, 200)).max() <= 2


def test_scan_lines_of_a_noisy_angle_end_at_the_turn(rng):
    """Noise may turn the direction around for some pulses just before the mirror turns."""
    angle = zigzag(40, 200) + 0.02 * rng.standard_normal(8000)
    found = find_sweeps(angle, np.arange(8000) * 1e-5)
    assert len(found) == 40
    assert np.abs(found[1:] - np.arange(200, 8000, 200)).max() <= 12


def test_scan_lines_end_where_the_mirror_jumps_back_or_pauses():
    angle = np.tile(np.linspace(0.4, -0.4, 150), 4)
    assert find_sweeps(angle, np.arange(600.0)).tolist() == [0, 150, 300, 450]
    time = np.arange(600.0)
    time[40:] += 500
    assert find_sweeps(np.linspace(0, 1, 600), time).tolist() == [0, 40]
    time[300:] -= 800
    assert find_sweeps(np.linspace(0, 1, 600), time).tolist() == [0, 40, 300]
    # 60 usual steps but a tenth of the range, and three steps but a third of it, are no jumps.
    shifted = np.linspace(0, 1, 600) + 0.1 * (np.arange(600) > 299)
    for angle in (shifted, np.r_[0:4, 6:10].astype(float)):
        assert find_sweeps(angle, np.arange(float(len(angle)))).tolist() == [0]


def test_a_sinusoidal_mirror_and_lost_pulses(rng):
    phase = np.sort(rng.choice(4000, 3200, replace=False))
    found = find_sweeps(np.sin(phase / 4000 * 10 * np.pi + 0.3), phase * 1e-5)
    turns = np.searchsorted(phase, (np.arange(10) + 0.5) * 400 - 0.3 * 400 / np.pi)
    assert len(found) == 11
    assert np.abs(found[1:] - turns).max() < LAG


def test_few_or_constant_angles_are_one_line():
    assert find_sweeps(np.empty(0), np.empty(0)).tolist() == []
    assert find_sweeps(np.zeros(1), np.zeros(1)).tolist() == [0]
    assert find_sweeps(np.zeros(500), np.arange(500.0)).tolist() == [0]
    assert find_sweeps(np.zeros(500), np.zeros(500)).tolist() == [0]


DOWN = np.array([0.0, 0.0, -1.0])


def lines(rng, number, *, apart=1.2, turned=0.0, jitter=0.03, n=16, sets=300):
    """u, v and set of points on parallel lines."""
    along = rng.uniform(-1.5, 1.5, (sets, n))
    across = apart * (np.arange(n) % number) + rng.normal(0, jitter, (sets, n))
    a, b = np.cos(turned), np.sin(turned)
    return (a * along - b * across).ravel(), (b * along + a * across).ravel(), np.repeat(np.arange(sets), n)


def on_two_lines(u, v):
    """Whether coordinates across one of 24 directions have hardly more than two values, or hardly any breadth."""
    least = np.inf
    for angle in np.pi * np.arange(24) / 24:
        across = np.cos(angle) * (u - u.mean()) + np.sin(angle) * (v - v.mean())
        variance = np.mean(across**2)
        least = min(least, np.mean(across**4) / variance**2 - np.mean(across**3) ** 2 / variance**3 - 1)
    narrow, long = np.linalg.eigvalsh(np.cov(u, v, bias=True))
    return least < 0.1 or narrow < 0.01 * long


def test_sets_on_two_lines_are_those_of_a_loop(rng):
    n = rng.integers(4, 20, 400)
    number, group = np.repeat(rng.integers(1, 5, 400), n), np.repeat(np.arange(400), n)
    turned = np.repeat(rng.uniform(0, np.pi, 400), n)
    along, across = rng.uniform(-1.5, 1.5, n.sum()), rng.integers(0, number) + rng.normal(0, 0.1, n.sum())
    u, v = np.cos(turned) * along - np.sin(turned) * across, np.sin(turned) * along + np.cos(turned) * across
    found = in_two_lines(u, v, group, 401)  # the last set has no point
    expected = [on_two_lines(u[group == one], v[group == one]) for one in range(400)]
    assert found.tolist() == [*expected, False]
    assert 50 < sum(expected) < 350
    refuses(ValueError, "no set", in_two_lines, u, v, group, 399)


@pytest.mark.parametrize("degrees", range(0, 180, 13))
def test_two_lines_are_found_in_any_direction_and_three_are_not(rng, degrees):
    assert in_two_lines(*lines(rng, 2, turned=np.radians(degrees)), 300).mean() > 0.98
    for number in (3, 4, 7):
        assert in_two_lines(*lines(rng, number, turned=np.radians(degrees)), 300).mean() < 0.01


@pytest.mark.parametrize("degrees", range(0, 180, 13))
def test_one_line_is_found_in_any_direction(rng, degrees):
    assert in_two_lines(*lines(rng, 1, turned=np.radians(degrees)), 300).all()


def test_one_scan_line_has_no_plane(rng):
    """Level ground, seen by one sweep: the plane through its noise stood upright, 70 degrees off with an error of 4."""
    along, across = np.arange(300) * 0.2, np.full(300, 0.0)
    points = np.stack([along, across + 2e-3 * rng.standard_normal(300), 0.02 * rng.standard_normal(300)], axis=1)
    ray = np.tile([0.0, 0.25, -1.0], (300, 1))
    _, gap = measure_normals(points, ray, Surroundings(points), radius=1.5, min_points=8, max_error=5.0)
    assert (gap == Gap.FEW_NEIGHBOURS).mean() > 0.9 and not (gap == Gap.KNOWN).any()


@pytest.mark.parametrize(("n", "most"), [(8, 0.04), (10, 0.01), (16, 0.001)])
def test_points_at_random_are_rarely_two_lines(rng, n, most):
    u, v = rng.uniform(-1, 1, (2, 5000 * n))
    assert in_two_lines(u, v, np.repeat(np.arange(5000), n), 5000).mean() <= most


def gable(spacing):
    """Points on a roof of 40 degrees, in scan lines along its ridge, 0.3 m apart in them; the rest is far away."""
    x, y = (part.ravel() for part in np.meshgrid(np.arange(-8.5, 9) * spacing, np.arange(-30, 31) * 0.3))
    return np.stack([x, y, -np.abs(x) * np.tan(np.radians(40))], axis=1)


def test_the_lines_on_both_sides_of_a_ridge_are_no_level_plane():
    points = gable(1.2)
    inner = np.abs(points[:, 1]) < 6
    ridge = points[inner & (np.abs(points[:, 0]) < 1)]
    (angle, error), gap = measure_normals(
        ridge, np.tile(DOWN, (len(ridge), 1)), Surroundings(points), radius=1.5, min_points=8, max_error=5.0
    )
    known = gap == Gap.KNOWN
    assert (np.abs(angle[known] - 40) < 5 * error[known]).all(), "it was level, with an error below a degree"
    wide = points[inner & (np.abs(points[:, 0]) > 3) & (np.abs(points[:, 0]) < 6)]
    (angle, error), gap = measure_normals(
        wide, np.tile(DOWN, (len(wide), 1)), Surroundings(points), radius=2.5, min_points=8, max_error=5.0
    )
    assert (gap == Gap.KNOWN).all() and angle == pytest.approx(40, abs=0.5)
