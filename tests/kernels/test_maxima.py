"""Levels, maxima and clusters of the compiled library against loops over one waveform."""

import naive
import numpy as np
import pytest
from commands import refuses

from wavebatch.kernels.fit.decompose import Candidates, cluster_candidates, explain_tails
from wavebatch.kernels.fit.pulse_shape import TAIL_STEP, PulseShape, pulse_tail
from wavebatch.kernels.library import Samples
from wavebatch.kernels.signal.filters import find_correlated, find_maxima, gaussian_taps, quiet_levels

GAIN_121 = np.sqrt(6.0) / 4.0


def record(rng, n, s, kind=np.uint8):
    """Waveforms with up to four echoes each, among them flat tops, constant ones and echoes at the ends."""
    x = np.arange(s)
    y = 12 + rng.standard_normal((n, s))
    for _ in range(4):
        height = np.where(rng.random(n) < 0.5, np.exp(rng.uniform(1, 6, n)), 0)[:, None]
        y += height * np.exp(-0.5 * ((x - rng.uniform(-3, s + 3, (n, 1))) / rng.uniform(1, 3, (n, 1))) ** 2)
    y[::7] = 40
    counts = np.clip(np.rint(y), 0, 200).astype(kind)
    level = rng.uniform(11, 13, n).astype(np.float32)
    return Samples(counts, level, rng.uniform(0.8, 1.2, n).astype(np.float32))


def with_gaps(rng, samples):
    return samples._replace(missing=rng.random(samples.counts.shape) < 0.1)


def above_level(samples, row):
    """Counts of a waveform above its level: 0 where they miss, the mean of both neighbours where one alone does."""
    y, missing = (samples.counts[row] - samples.baseline[row]).astype(np.float32), samples.missing[row]
    y[missing] = 0
    for i in range(1, len(y) - 1):
        if missing[i] and not missing[i - 1] and not missing[i + 1]:
            y[i] = np.float32(0.5) * (y[i - 1] + y[i + 1])
    return y


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, np.uint32, np.float32])
@pytest.mark.parametrize(("s", "reach", "recovery"), [(40, 3, 0), (60, 0, 0), (33, 4, 12), (1, 2, 0), (2, 0, 5)])
def test_quiet_levels(rng, kind, s, reach, recovery):
    samples = with_gaps(rng, record(rng, 60, s, kind))
    mean, number = quiet_levels(samples, 3.0, reach, recovery)
    for i in range(60):
        y = samples.counts[i].astype(np.float32) - samples.baseline[i]
        height = np.abs(naive.smooth_121(y))
        busy = naive.widen((height > np.float32(3))[:, None], reach)[:, 0]
        for at in np.flatnonzero(height > np.float32(9)):
            busy[at : at + recovery + 1] = True
        quiet = ~busy & ~samples.missing[i]
        assert number[i] == quiet.sum()
        assert mean[i] == pytest.approx(y[quiet].mean() if quiet.any() else 0, abs=1e-4)


@pytest.mark.parametrize("broad", [0.0, 2.5])
@pytest.mark.parametrize("s", [2, 5, 64])
def test_maxima(rng, broad, s):
    samples, ref = record(rng, 80, s), 2.0 + 3 * (broad > 0)
    taps = gaussian_taps(broad) if broad else None
    if broad:
        taps /= taps[0] + 2 * taps[1:].sum()
    waveform, time, amplitude, width = find_maxima(samples, 2.2, ref, broad, taps)
    assert (np.diff(waveform) >= 0).all()
    for i in range(80):
        y = (samples.counts[i] - samples.baseline[i]).astype(np.float32)
        smooth = naive.correlate_symmetric(y, taps) if broad else naive.smooth_121(y)
        even = smooth if broad else naive.smooth_121(smooth)
        found = naive.find_peaks(even[:, None], np.float32(2.2) * samples.std[i]) if np.ptp(samples.counts[i]) else []
        peaks = np.array([at for _, at in found], float)
        mine = waveform == i
        assert np.count_nonzero(mine) == len(peaks)
        gaps = np.r_[np.inf, np.diff(peaks), np.inf][: len(peaks) + 1]
        for at, t, a, w, gap in zip(peaks, time[mine], amplitude[mine], width[mine],
                                    np.minimum(gaps[:-1], gaps[1:]), strict=True):  # fmt: skip
            assert abs(t - at) <= (0.5 if gap < 4 * ref else 1.5)
            assert 0.7 * ref <= w <= 4 * ref and w <= max(0.5 * gap, 0.7 * ref) + 1e-9 and a > 0
            if gap > 4 * ref and not broad:
                height, place, wide = naive.log_parabola(smooth, int(at), ref)
                wide = np.clip(min(wide, 0.5 * gap), 0.7 * ref, 4 * ref)
                assert (a, t, w) == pytest.approx((height, place, wide), rel=1e-4)


def naive_matches(y, missing, least, taps, ref):
    """(time, height, width) of the maxima of one correlated waveform outside of its gaps."""
    correlated = naive.correlate_symmetric(y, taps)
    for _, at in naive.find_peaks(correlated[:, None], least):
        time, height, three = at, correlated[at], correlated[max(at - 1, 0) : at + 2]
        if len(three) == 3 and at > 0 and (three > 0).all():
            a, b, c = np.log(three)
            time = at + 0.5 * (a - c) / (a - 2 * b + c)
            height = np.exp(b - 0.25 * (a - c) * (time - at))
        here = int(np.clip(np.floor(time), 0, len(y) - 1))
        after = min(here + 1, len(y) - 1)
        inside = missing[here] and (missing[after] or time == here)
        if not inside:
            yield time, height, np.clip(naive.log_parabola(naive.smooth_121(y), at, ref)[2], 0.8 * ref, 2 * ref)


@pytest.mark.parametrize("kind", [np.uint8, np.float32])
@pytest.mark.parametrize("s", [2, 5, 64])
def test_maxima_of_a_correlation(rng, kind, s):
    samples, ref = with_gaps(rng, record(rng, 80, s, kind)), 1.7
    taps = gaussian_taps(ref)
    waveform, time, height, width = find_correlated(samples, 6.0, ref, taps)
    assert (np.diff(waveform) >= 0).all()
    for i in range(80):
        y, missing = above_level(samples, i), samples.missing[i]
        found = list(naive_matches(y, missing, 6.0 * samples.std[i], taps, ref)) if np.ptp(samples.counts[i]) else []
        mine = np.stack([time, height, width], axis=1)[waveform == i]
        assert len(mine) == len(found)
        np.testing.assert_allclose(mine, np.reshape(found, (-1, 3)), rtol=1e-4, atol=1e-4)
    assert len(waveform) > 20


def test_an_echo_is_found_where_it_is(rng):
    x, t = np.arange(50.0), rng.uniform(20, 30, 200)
    y = 100 * np.exp(-0.5 * ((x - t[:, None]) / 2.0) ** 2)
    samples = Samples(y.astype(np.float32), np.zeros(200, np.float32), np.ones(200, np.float32))
    waveform, time, amplitude, width = find_maxima(samples, 2.0, 2.0)
    assert np.array_equal(waveform, np.arange(200))
    assert np.abs(time - t).max() < 0.02 and np.abs(amplitude - 100).max() < 2 and np.abs(width - 2).max() < 0.05


def naive_clusters(samples, candidates, margin, reach, most, tail):
    """Clusters as (waveform, low, high, first, number), by loops."""
    s, found = samples.counts.shape[1], []
    for row in np.unique(candidates.waveform):
        smooth, level = naive.smooth_121(above_level(samples, row)), 2 * GAIN_121 * samples.std[row]
        members = np.flatnonzero(candidates.waveform == row)
        at = [int(np.rint(np.clip(candidates.time[i], 0, s - 1))) for i in members]
        runs = [run[1:] for run in naive.find_runs(smooth[:, None], [level])]
        extents = []
        for i, place in zip(members, at, strict=True):
            low, high = next((run for run in runs if run[0] <= place < run[1]), (place, place + 1))
            extents.append((low, max(high, place + (tail[i] if tail is not None else 0))))
        furthest, parts = 0, []
        for k, (low, high) in enumerate(extents):
            if k and (low < furthest or at[k] - at[k - 1] < reach) and len(parts[-1]) < most:
                parts[-1].append(k)
            else:
                parts.append([k])
            furthest = max(furthest, high)
        windows, reached = [], 0
        for part in parts:
            reached = max(reached, *(extents[k][1] for k in part))
            low = max(min(extents[part[0]][0] - margin, at[part[0]] - reach), 0)
            windows.append([low, min(max(reached + margin, at[part[-1]] + 1 + reach), s), reached])
        for k in range(len(parts) - 1):
            here, there = at[parts[k][-1]], at[parts[k + 1][0]]
            begin = extents[parts[k + 1][0]][0]
            middle = (begin + windows[k][2] if begin >= windows[k][2] else there + here + 1) // 2
            middle = int(np.clip(middle, here + 1, max(there, here + 1)))
            windows[k][1], windows[k + 1][0] = min(windows[k][1], middle), max(windows[k + 1][0], middle)
        for part, (low, high, _) in zip(parts, windows, strict=True):
            found.append((row, min(low, at[part[0]]), high, members[part[0]], len(part)))
    return np.array(found).reshape(-1, 5)


@pytest.mark.parametrize("most", [1, 2, 6])
@pytest.mark.parametrize("tails", [False, True])
def test_clusters(rng, most, tails):
    samples = with_gaps(rng, record(rng, 60, 70))
    waveform, time, amplitude, width = find_maxima(samples, 1.5, 1.5)
    time = time + rng.uniform(-3, 3, len(time))
    time = time[np.lexsort((time, waveform))]
    candidates = Candidates(waveform, time, amplitude, width)
    tail = rng.integers(0, 9, len(time)) if tails else None
    found = cluster_candidates(samples, candidates, margin=2, reach=5, most=most, tail=tail)
    np.testing.assert_array_equal(np.stack(found, axis=1), naive_clusters(samples, candidates, 2, 5, most, tail))


def naive_tails(candidates, std, tail, most, quiet):
    """Candidates as (kept, reach): tails of all others added up, and looked through from their far ends."""
    lags, found = tail.first + TAIL_STEP * np.arange(len(tail.value)), []
    for i, (row, time, amplitude) in enumerate(zip(*candidates[:3], strict=True)):
        near = [k for k in np.flatnonzero(candidates.waveform == row) if 0 < abs(k - i) <= most]
        places = [np.flatnonzero(np.abs(lags - (time - candidates.time[k])) <= TAIL_STEP / 2) for k in near]
        expected = sum(candidates.amplitude[k] * tail.value[at].sum() for k, at in zip(near, places, strict=True))
        beyond = 2.2 * std[row] + 0.5 * expected < amplitude - expected
        seen = lags[np.abs(tail.value) * amplitude > std[row]]
        found.append((beyond or expected <= quiet * std[row], np.ceil(max([0, *(seen[seen >= 0] + TAIL_STEP)]))))
    return np.array(found)


def test_tails(rng):
    tail = pulse_tail(PulseShape(components=((0.1, 12.0, 0.5), (0.03, 20.0, 2.0), (-0.01, -9.0, 0.0))), 1.7)
    waveform = np.sort(rng.integers(0, 60, 400))
    time = rng.uniform(0, 70, 400)
    time = time[np.lexsort((time, waveform))]
    candidates = Candidates(waveform, time, 10 ** rng.uniform(0, 3, 400), np.ones(400))
    std = rng.uniform(0.5, 2, 60).astype(np.float32)
    found = explain_tails(candidates, std, tail, 2, 0.5)
    np.testing.assert_array_equal(np.stack(found, axis=1), naive_tails(candidates, std, tail, 2, 0.5))
    assert 40 < found[0].sum() < 360 and len(np.unique(found[1])) > 5
    refuses(ValueError, "no waveform", explain_tails, candidates, std[:9], tail, 2, 0.5)
