"""Matching against a naive twin, and scores that are known by construction."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_scenes import make_block, make_scene
from hypothesis import given
from hypothesis import strategies as st
from scoring import score

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.kernels.fit.closed_form import crlb
from wavebatch.stages.score import ErrorStats, find_isolated_echoes, list_pairs, match_echoes


def match_naively(found, truth, tolerance):
    """Slow twin: all pairs of a waveform in order of distance, each echo once."""
    pairs = []
    for i in range(len(found)):
        for j in range(len(truth)):
            gap = abs(found.time[i] - truth.time[j])
            if found.waveform[i] == truth.waveform[j] and gap <= tolerance:
                pairs.append((gap, j, i))
    taken_i, taken_j, kept = set(), set(), []
    for _, j, i in sorted(pairs):
        if i not in taken_i and j not in taken_j:
            taken_i.add(i)
            taken_j.add(j)
            kept.append((j, i))
    return sorted(kept)


def table(rows):
    rows = np.array(rows, float).reshape(-1, 2)
    return EchoTable.build(rows[:, 0], rows[:, 1], np.full(len(rows), 50.0), np.full(len(rows), 2.0))


echoes = st.lists(st.tuples(st.integers(0, 4), st.integers(-20, 60).map(lambda k: k / 4)), max_size=25)


@given(echoes, echoes, st.sampled_from([0.25, 1.0, 1.5, 6.0]))
def test_matching_equals_the_naive_twin(found, truth, tolerance):
    """Times on a grid, so that ties are common."""
    found, truth = table(found), table(truth)
    match = match_echoes(found, truth, tolerance)
    assert list(zip(match.truth.tolist(), match.found.tolist(), strict=True)) == match_naively(found, truth, tolerance)


def test_closest_pair_wins_and_waveforms_do_not_mix():
    found = table([(0, 10.0), (0, 11.0), (1, 50.0)])
    truth = table([(0, 10.9), (2, 50.0)])
    match = match_echoes(found, truth, 1.5)
    assert match.found.tolist() == [1]
    assert match.truth.tolist() == [0]
    assert len(match_echoes(found, EchoTable.empty(), 1.5).found) == 0
    assert len(match_echoes(EchoTable.empty(), truth, 1.5).found) == 0


def test_tolerance_is_inclusive_and_exact_in_far_waveforms():
    for waveform in (0, 2_000_000):
        for gap, expected in ((1.5, 1), (1.5000001, 0)):
            match = match_echoes(table([(waveform, 70.0 + gap)]), table([(waveform, 70.0)]), 1.5)
            assert len(match.found) == expected


def test_pairs_are_every_pair_within_the_tolerance():
    rng = np.random.default_rng(2)
    group_a, group_b = rng.integers(0, 5, 60), rng.integers(0, 5, 70)
    a, b = rng.uniform(-100, 100, 60), rng.uniform(-100, 100, 70)
    left, right = list_pairs(group_a, a, group_b, b, 7.0)
    expected = {(i, j) for i in range(60) for j in range(70) if group_a[i] == group_b[j] and abs(a[i] - b[j]) <= 7.0}
    assert set(zip(left.tolist(), right.tolist(), strict=True)) == expected
    assert len(left) == len(expected)


def test_bounds_follow_the_spacing():
    scene = make_scene("flat", spacing=2.0)
    block, truth = make_block(scene, 5000)
    noise = scene.recording.recorded_noise
    bounds = crlb(truth.amplitude, truth.sigma.astype(float), noise, 2.0)
    scatter = np.random.default_rng(4).standard_normal((3, len(truth)))
    columns = [
        getattr(truth, name) + bound * one
        for name, bound, one in zip(("time", "amplitude", "sigma"), bounds, scatter, strict=True)
    ]
    found = EchoTable.build(truth.waveform, *columns)
    result = score(found, truth, len(block), noise_std=noise, spacing=2.0)
    assert result.errors["isolated"]["time"].rms_per_bound == pytest.approx(1.0, rel=0.03)


def test_shares_count_what_they_say():
    truth = table([(0, 10.0), (1, 10.0), (1, 30.0), (2, 10.0)])
    found = table([(0, 10.1), (0, 20.0), (1, 10.1), (2, 10.2), (3, 5.0)])
    result = score(found, truth, 5, noise_std=1.0)
    assert (result.waveforms, result.true, result.found, result.matched) == (5, 4, 5, 3)
    assert result.completeness == 3 / 4
    assert result.correctness == 3 / 5
    assert result.exact_count == 2 / 5
    assert result.false_splits == 1 / 2
    assert result.false_alarms == 1 / 2


def test_isolated_means_alone_inside_and_not_clipped():
    truth = EchoTable.build([0, 0, 1, 1, 2], [10, 21.9, 10, 22.0, 10], [50] * 5, [2] * 5)
    assert find_isolated_echoes(truth).tolist() == [False, False, True, True, True]
    for flag in (EchoFlag.NEAR_EDGE, EchoFlag.SATURATED, EchoFlag.OVERLAPPED):
        assert not find_isolated_echoes(truth.with_flags(flag, np.ones(5, bool))).any()
    wide = replace(truth, sigma=np.array([2, 2, 2, 2.1, 2], np.float32))
    assert find_isolated_echoes(wide).tolist() == [False, False, False, False, True]


def test_statistics_of_known_errors():
    stats = ErrorStats.compute(np.array([1.0, -1.0, 3.0]), np.array([0.5, 0.5, 0.5]), np.array([2.0, np.nan, 2.0]))
    assert stats.number == 3
    assert stats.bias == pytest.approx(1.0)
    assert stats.rmse == pytest.approx(np.sqrt(11 / 3))
    assert stats.nmad == pytest.approx(1.4826 * 2)
    assert stats.rms_per_bound == pytest.approx(2 * np.sqrt(11 / 3))
    assert stats.calibration == pytest.approx(np.sqrt(5) / 2)
