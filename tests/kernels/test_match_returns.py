"""Echoes matched with returns: against greedy pairing by a loop, and the cases that a loop would get right by luck."""

import naive
import numpy as np
import pytest

from wavebatch.kernels.geometry.group_returns import match_returns


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
