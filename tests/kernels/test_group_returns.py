"""Which returns are one pulse, and which echo is which return."""

import naive
import numpy as np
import pytest
from commands import refuses

from wavebatch.kernels.geometry.group_returns import (
    LONGEST_PULSE,
    find_nearest,
    find_pulses,
    match_returns,
    number_returns,
    share_offsets,
)


def test_runs_of_equal_time_are_pulses():
    time = np.array([5.0, 5.0, 6.0, 5.0, 5.0, 5.0])
    assert find_pulses(time).tolist() == [0, 0, 2, 3, 3, 3]
    assert find_pulses(np.empty(0)).tolist() == []


@pytest.mark.parametrize("length", [LONGEST_PULSE - 1, LONGEST_PULSE])
def test_a_time_that_stays_says_nothing(length):
    pulse = find_pulses(np.full(length, 7.0))
    assert pulse.tolist() == ([0] * length if length < LONGEST_PULSE else list(range(length)))


def test_time_zero_says_nothing():
    assert find_pulses(np.array([0.0, 0.0, 1.0, 1.0])).tolist() == [0, 1, 2, 2]


def _pulses_by_loop(time):
    found = []
    for i, own in enumerate(time):
        first, last = i, i
        while first and time[first - 1] == own:
            first -= 1
        while last + 1 < len(time) and time[last + 1] == own:
            last += 1
        found.append(i if own == 0 or last - first + 1 >= LONGEST_PULSE else first)
    return found


def test_pulses_are_those_of_a_loop(rng):
    """Times of records lie apart in memory; one is no number."""
    for _ in range(20):
        length = rng.choice([1, 2, LONGEST_PULSE - 1, LONGEST_PULSE], 40)
        time = np.repeat(rng.choice([0.0, 1.0, 2.0, np.nan], 40), length)
        assert find_pulses(np.stack([time, time], axis=1)[:, 0]).tolist() == _pulses_by_loop(time)


def _nearest_by_loop(echo_waveform, echo_time, return_waveform, return_time):
    found = []
    for waveform, time in zip(echo_waveform, echo_time, strict=True):
        rows = [k for k in range(len(return_waveform)) if return_waveform[k] == waveform]
        rows.sort(key=lambda k: (abs(return_time[k] - time), return_time[k], k))
        found.append(rows[0] if rows else -1)
    return found


def test_nearest_return_is_that_of_a_loop(rng):
    for _ in range(50):
        m, k = rng.integers(0, 20, 2)
        echo_waveform = np.sort(rng.integers(0, 6, m)).astype(np.int32)
        return_waveform = rng.integers(0, 6, k).astype(np.int32)
        echo_time, return_time = rng.integers(0, 12, m) / 2.0, rng.integers(0, 12, k) / 1.0
        found = find_nearest(echo_waveform, echo_time, return_waveform, return_time)
        expected = _nearest_by_loop(echo_waveform, echo_time, return_waveform, return_time)
        for row, other, w, t in zip(found, expected, echo_waveform, echo_time, strict=True):
            assert (row < 0) == (other < 0)
            if row >= 0:
                assert return_waveform[row] == w
                assert return_time[row] == return_time[other], (w, t)


def test_numbers_follow_the_ray_of_the_pulse(rng):
    for _ in range(30):
        m = int(rng.integers(1, 30))
        pulse = rng.integers(0, 8, m) * 10
        rays = rng.normal(size=(100, 3))
        along = rng.permutation(m).astype(float)
        xyz = np.array([4e5, 5e6, 300.0]) + rays[pulse] * along[:, None]
        has_ray = rng.random(m) < 0.7
        direction = np.where(has_ray[:, None], rays[pulse], 0.0)
        number, total, known = number_returns(pulse, xyz, direction)
        for row in range(m):
            same = np.flatnonzero(pulse == pulse[row])
            assert known[row] == has_ray[same].any()
            assert total[row] == len(same)
            if known[row]:
                assert number[row] == 1 + np.count_nonzero(along[same] < along[row])


def test_numbers_of_nothing():
    assert [len(part) for part in number_returns(np.empty(0, int), np.empty((0, 3)), np.empty((0, 3)))] == [0, 0, 0]


def _offset_by_loop(difference, error):
    """Weighted mean, its error where the differences contradict each other, and whether there is one."""
    weight = [1.0 / max(spread if np.isfinite(spread) else 1.0, 1e-3) ** 2 for spread in map(float, error)]
    if not weight:
        return 0.0, 0.0, False
    mean = sum(w * d for w, d in zip(weight, difference, strict=True)) / sum(weight)
    scatter, others = sum(w * (d - mean) ** 2 for w, d in zip(weight, difference, strict=True)), len(weight) - 1
    return mean, np.sqrt(scatter / others / sum(weight)) if scatter > others > 0 else 0.0, True


def test_offsets_are_those_of_a_loop(rng):
    waveform = np.sort(rng.integers(0, 40, 90)).astype(np.int32)
    time, match = rng.uniform(0, 80, 90), np.where(rng.random(90) < 0.8, rng.permutation(90), -1)
    error = rng.choice([0.0, 0.02, 0.3, np.nan, np.inf], 90).astype(np.float32)
    return_time, matched = np.empty(90), match >= 0
    return_time[match[matched]] = (time + 0.4 + rng.choice([0.0, 0.5], 90))[matched]
    found = share_offsets(41, waveform, time, error, match, return_time)
    for w in range(41):
        rows = np.flatnonzero((waveform == w) & (match >= 0))
        expected = _offset_by_loop(time[rows] - return_time[match[rows]], error[rows])
        assert [column[w] for column in found] == pytest.approx(expected, rel=1e-9)
    assert 3 < np.count_nonzero(found[1]) < np.count_nonzero(found[2]) < 41
    refuses(ValueError, "no return or waveform", share_offsets, 41, waveform, time, error, match, return_time[:1])


def draw(rng, n, most, step=None):
    """Sorted waveforms and times of up to `most` members per waveform; `step` puts times on a grid."""
    count = rng.integers(0, most + 1, n)
    waveform = np.repeat(np.arange(n), count)
    time = rng.uniform(-5, 60, len(waveform))
    if step:
        time = np.rint(time / step) * step
    order = np.lexsort((time, waveform))
    return waveform[order].astype(np.int32), time[order]


@pytest.mark.parametrize("tolerance", [0.0, 0.5, 3.0, 100.0])
@pytest.mark.parametrize("seed", range(4))
def test_matches_equal_greedy_pairing(seed, tolerance):
    rng = np.random.default_rng(seed)
    echo, found = draw(rng, 60, 5)
    ret, located = draw(rng, 60, 4)
    if tolerance == 0:
        located[::3] = np.resize(found, len(located[::3]))
    matched = match_returns(echo, found, ret, located, tolerance)
    np.testing.assert_array_equal(matched, naive.match_returns(echo, found, ret, located, tolerance))


@pytest.mark.parametrize("seed", range(4))
def test_ties_still_match_one_to_one_and_as_many(seed):
    rng = np.random.default_rng(seed)
    echo, found = draw(rng, 60, 5, step=2.0)
    ret, located = draw(rng, 60, 4, step=2.0)
    matched = match_returns(echo, found, ret, located, 4.0)
    pairs = np.flatnonzero(matched >= 0)
    rows = matched[pairs]
    assert len(np.unique(rows)) == len(rows)
    np.testing.assert_array_equal(echo[pairs], ret[rows])
    assert np.abs(found[pairs] - located[rows]).max() <= 4.0
    # Nothing that could still be paired is left over.
    for i in np.flatnonzero(matched < 0):
        free = np.setdiff1d(np.flatnonzero(ret == echo[i]), rows)
        assert (np.abs(located[free] - found[i]) > 4.0).all()


def test_the_closer_of_two_echoes_takes_the_return():
    matched = match_returns(np.array([0, 0]), np.array([9.0, 10.4]), np.array([0]), np.array([10.0]), 2.0)
    assert matched.tolist() == [-1, 0]


def test_an_echo_passed_over_takes_what_is_left():
    echoes, returns = np.array([10.0, 10.5]), np.array([10.4, 12.0])
    none = np.zeros(2, int)
    assert match_returns(none, echoes, none, returns, 2.0).tolist() == [1, 0]
    assert match_returns(none, echoes, none, returns, 1.9).tolist() == [-1, 0]


def test_neighbouring_waveforms_never_share_a_return():
    matched = match_returns(np.array([0, 1]), np.array([50.0, -3.0]), np.array([1]), np.array([-50.0]), 60.0)
    assert matched.tolist() == [-1, 0]


@pytest.mark.parametrize(("m", "k"), [(0, 0), (0, 3), (3, 0)])
def test_nothing_to_match(m, k):
    assert match_returns(np.arange(m), np.zeros(m), np.arange(k), np.zeros(k), 1.0).tolist() == [-1] * m


def test_many_waveforms_lose_no_precision():
    n = 500_000
    waveform = np.arange(n)
    matched = match_returns(waveform, np.full(n, 30.0), waveform, np.full(n, 30.0 + 1e-7), 2e-7)
    assert (matched == waveform).all()
