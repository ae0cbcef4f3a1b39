"""The compiled decomposer against its slow twin: clusters grow to what their samples hold, whatever the candidates."""

import naive_fit
import numpy as np
import pytest
from commands import refuses
from fits import decompose, settings

from wavebatch.kernels.fit.decompose import Candidates, Clusters, Samples, decompose_clusters
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN, PulseShape, PulseTable
from wavebatch.kernels.signal.noise import whitening_filter

LENGTH = 48
GROWING = {"grow": True, "thorough": True, "prior_spread": 0.2, "tolerance": 1e-6, "max_iterations": 200}
LEARNED = PulseShape(components=((0.12, 3.0, 1.0),))


def bell(time, amplitude, width=2.0):
    return amplitude * np.exp(-0.5 * ((np.arange(LENGTH) - time) / width) ** 2)


def repeat(signal, times, amplitudes, seed=0):
    """The Solution of 200 waveforms that hold the same signal, each with the same candidates."""
    noise = np.random.default_rng(seed).standard_normal((200, LENGTH))
    start = np.stack([np.array(amplitudes), np.array(times), np.full(len(times), 2.0)])
    return decompose(np.rint(signal + noise), np.tile(start, (200, 1, 1)), std=1.04, grow=True)


def test_candidates_where_nothing_is_do_not_keep_others_out():
    """Two echoes that share a maximum, and a candidate in a dip: it is fitted to nothing, and then the second grows."""
    found = repeat(bell(16, 150) + bell(20, 80) - bell(30, 12, 3.0), [17.0, 30.0], [150.0, 5.0])
    apart = np.abs(found.parameters[:, 1, None] - [16, 20]).min(axis=1) < 0.7
    both = np.bincount(found.cluster, apart) == found.number
    assert np.count_nonzero(both & (found.number >= 2)) > 170


@pytest.mark.parametrize("apart", [1.5, 2.0])
def test_echoes_that_their_errors_do_not_tell_apart_are_not_kept(apart):
    """chi2 falls by more than the acceptance, but the pair is closer than its errors allow."""
    noise = np.random.default_rng(3).standard_normal((300, LENGTH))
    y = np.rint(bell(20, 100) + bell(20 + apart, 70) + noise)
    start = np.stack([y.max(axis=1), y.argmax(axis=1), np.full(300, 2.0)], axis=1)[:, :, None]
    found = decompose(y, start, grow=True, prior_spread=0.2, acceptance=4.0)
    for last, number in zip(np.cumsum(found.number), found.number, strict=True):
        rows = slice(last - number, last)
        assert naive_fit.is_resolved(found.parameters[rows, :3].T, found.errors[rows, :3].T)
    assert np.count_nonzero(found.number > 1) > 10


def test_an_echo_whose_amplitude_is_not_known_is_left_out():
    """Two candidates on one echo share its light as they like; the time that stays may be off by its move."""
    noise = np.random.default_rng(3).standard_normal((200, LENGTH))
    start = np.tile(np.array([[60.0, 60.0], [19.0, 21.5], [2.0, 2.0]]), (200, 1, 1))
    options = {"std": 1.04, "prior_spread": 0.2, "grow": False}
    two, one = (decompose(np.rint(bell(20, 100) + noise), start, known=known, **options) for known in (0.0, 3.0))
    assert (two.number == 2).mean() > 0.9 and (one.number == 1).mean() > 0.98
    first = np.cumsum(two.number) - two.number
    moved = [
        np.abs(two.parameters[first[i] : first[i] + two.number[i], 1] - time).min()
        for i, time in zip(one.cluster, one.parameters[:, 1], strict=True)
    ]
    assert (one.errors[:, 1] >= 0.999 * np.array(moved)).all()


def test_an_echo_that_chi2_proves_has_an_amplitude_of_two_errors():
    """Two echoes 1.25 widths apart: none is lost, and no error is more than half of its amplitude."""
    noise, x, height = np.random.default_rng(4).standard_normal((400, LENGTH)), np.array([20.0, 22.5]), [200.0, 100.0]
    y = np.rint(bell(x[0], height[0]) + bell(x[1], height[1]) + noise)
    start = np.tile(np.array([height, x, [2.0, 2.0]]), (400, 1, 1))
    plain, known = (decompose(y, start, std=1.04, prior_spread=0.2, known=known) for known in (0.0, 3.0))
    assert (plain.number == 2).all() and (known.number == 2).mean() > 0.98
    assert (known.parameters[:, 0] >= 1.9 * known.errors[:, 0]).all()
    assert (plain.parameters[:, 0] < 1.5 * plain.errors[:, 0]).mean() > 0.02

    off = known.parameters[:, 0] - np.where(known.parameters[:, 1] < x.mean(), *height)
    assert 0.7 < np.quantile(np.abs(off) / known.errors[:, 0], 0.683) < 1.2


@pytest.mark.parametrize(("apart", "least"), [(0.0, 0.98), (2.2, 0.7)])
def test_two_strong_echoes_that_a_change_of_shape_may_be_are_one(apart, least):
    """One changed by .5 % in its third derivative, or two echoes 1.1 widths apart: chi2 of 300 noises rises alike."""
    x, noise = np.arange(LENGTH), np.random.default_rng(5).standard_normal((200, LENGTH))
    z = (x - 20) / 2
    y = bell(20, 300) + bell(20 + apart, 300) if apart else bell(20, 400) * (1 + 0.005 * (z**3 - 3 * z))
    start = np.tile(np.array([[300.0, 100.0], [20.0, 22.2], [2.0, 2.0]]), (200, 1, 1))
    y = np.rint(y + noise)
    plain, known = (decompose(y, start, std=1.04, prior_spread=0.2, known=known) for known in (0.0, 3.0))
    assert (plain.number == 2).all() and (known.number == 1).mean() > least


def test_a_strong_echo_that_does_not_reach_a_pair_asks_no_more_of_it():
    """Its shape ends where the pair begins: by the energy of the window half of such pairs of 50 noises were one."""
    noise, x = np.random.default_rng(6).standard_normal((200, LENGTH)), np.array([10.0, 24.0, 27.0])
    height = [3000.0, 100.0, 50.0]
    y = np.rint(sum(bell(at, high) for at, high in zip(x, height, strict=True)) + noise)
    start = np.tile(np.array([height, x, [2.0, 2.0, 2.0]]), (200, 1, 1))
    known = decompose(y, start, std=1.04, prior_spread=0.2, known=3.0)
    assert (known.number == 3).mean() > 0.95


@pytest.mark.parametrize(("misfit", "number"), [(0.0, 2), (0.2, 1)])
def test_what_a_misfit_of_the_pulse_may_explain_is_no_echo(misfit, number):
    noise = np.random.default_rng(3).standard_normal((100, LENGTH))
    start = np.tile(np.array([150.0, 20.0, 2.0])[:, None], (100, 1, 1))
    found = decompose(np.rint(bell(20, 150) + bell(27, 12) + noise), start, misfit=misfit, **GROWING)
    assert (found.number == number).all()


@pytest.mark.parametrize("second", [100.0, 80.0])
def test_a_flat_top_is_split_into_two(second):
    """A candidate in the middle: no new echo beside it can flatten its top."""
    found = repeat(bell(20.5, 100) + bell(23.5, second), [22.0], [150.0])
    assert (found.number == 2).all()
    times = np.sort(found.parameters[:, 1].reshape(-1, 2), axis=1)
    np.testing.assert_allclose(np.median(times, axis=0), [20.5, 23.5], atol=0.2)


def test_no_broad_echo_bridges_two_others():
    """Strong echoes beside each other: chi2 has minima in which one broad echo stands for two, and its neighbours
    make up for it. No further echo leaves them (docs/algorithms.md 2.3)."""
    rng, m = np.random.default_rng(2), 300
    times = 8 + np.cumsum(rng.uniform(1.8, 6.0, (m, 4)) * 2, axis=1) * 0.9
    amplitudes = np.exp(rng.uniform(np.log(50), np.log(20000), (m, 4)))
    y = np.stack([sum(bell(t, a) for t, a in zip(*row, strict=True)) for row in zip(times, amplitudes, strict=True)])
    start = np.stack([amplitudes, times, np.full((m, 4), 2.0)], axis=1)[:, :, rng.permutation(4)[:2]]
    found = decompose(np.rint(y + rng.standard_normal(y.shape)), start, std=1.04, grow=True)
    assert np.mean(found.misfit > 2) <= 0.01


def test_echoes_that_a_fit_missed_are_searched_again():
    """Pulses hardly wider than a sample, of hundreds of noises: a step to one echo more ends far off, and three free
    parameters of each leave nothing of a new one between two (docs/algorithms.md 2.3)."""
    rng, m, width = np.random.default_rng(3), 600, 0.6
    number = rng.integers(4, 7, m)
    truth = [(np.exp(rng.uniform(4, 9, k)), 8 + np.cumsum(rng.uniform(1.0, 4.0, k))) for k in number]
    y = np.stack([sum(bell(t, a, width) for a, t in zip(*echoes, strict=True)) for echoes in truth])
    start = np.stack([y.max(axis=1), y.argmax(axis=1), np.full(m, width)], axis=1)[:, :, None]
    y = np.rint(y + rng.standard_normal(y.shape))
    options = {"width_ref": width, "width_low": 0.42, "width_high": 2.4, "prior_spread": 0.06, "max_echoes": 8}
    plain, found = (decompose(y, start, grow=True, thorough=thorough, **options) for thorough in (False, True))
    missed = plain.cost > 9 * 15 + LENGTH
    assert missed.mean() > 0.1 and np.mean(found.cost > 9 * 15 + LENGTH) < 0.01
    # Fits so stiff end at another minimum by a rounding: that of the twin is found as often.
    rows = np.flatnonzero(missed)[:2]
    twin = [naive_fit.decompose(y[i], 1.0, start[i], settings(grow=True, thorough=True, **options)) for i in rows]
    assert sum(chi2 < 9 * 15 + LENGTH for _, _, chi2 in twin) == 2
    assert sum(p.shape[1] == found.number[i] for (p, _, _), i in zip(twin, rows, strict=True)) == 2


def test_what_a_fit_leaves_is_counted_about_each_echo():
    """A target that no echo describes says nothing about another one far away in the same fit."""
    x = np.arange(LENGTH)
    y = np.rint(60 * (np.abs(x - 12) < 4) + bell(36, 80) + np.random.default_rng(4).standard_normal((100, LENGTH)))
    start = np.tile(np.array([[60.0, 80.0], [12.0, 36.0], [2.5, 2.0]]), (100, 1, 1))
    found = decompose(y, start, std=1.04, grow=False)
    amplitude, time, width, _ = found.parameters.reshape(100, 2, 4, 1).transpose(2, 0, 1, 3)
    left = y - (amplitude * np.exp(-0.5 * ((x - time) / width) ** 2)).sum(axis=1)
    near = np.abs(x - time) <= 4 * settings().width_ref
    expected = np.sqrt((near * left[:, None] ** 2).sum(axis=2) / near.sum(axis=2)) / 1.04
    np.testing.assert_allclose(found.misfit.reshape(100, 2), expected, rtol=1e-4)
    assert np.median(expected[:, 0]) > 4 and np.median(expected[:, 1]) < 1.1


def test_candidates_of_nothing_are_left_out():
    found = repeat(bell(20, 100) - bell(30, 8, 3.0), [20.0, 30.0], [100.0, 4.0])
    assert np.count_nonzero(found.number == 1) > 160
    assert (found.parameters[:, 0] > 0).all()


def test_one_broad_echo_is_taken_where_it_explains_as_much_as_several():
    """A slope under a wide beam; two echoes as far apart as it is broad stay two."""
    noise = np.random.default_rng(4).standard_normal((200, LENGTH))
    start = np.tile(np.array([[90.0, 90.0], [19.0, 29.0], [8.0, 8.0]]), (200, 1, 1))
    slope, pair = (decompose(np.rint(signal + noise), start, std=1.04, **GROWING)
                   for signal in (bell(24, 100, 10.0), bell(14, 100, 3.0) + bell(34, 100, 3.0)))  # fmt: skip
    assert (slope.number == 1).all() and not slope.at_bound.any()
    off = (slope.parameters[:, :3] - [100.0, 24.0, 10.0]) / slope.errors[:, :3]
    assert ((np.abs(off) < 1).mean(axis=0) > 0.5).all() and (np.abs(off.mean(axis=0)) < 0.3).all()
    assert (pair.number >= 2).all() and (pair.number == 2).mean() > 0.97


def test_two_echoes_that_make_none_broader_than_others_may_be_stay_two():
    """As the fit found them: only what is broader is looked for as one."""
    noise = np.random.default_rng(4).standard_normal((100, LENGTH))
    start = np.tile(np.array([[90.0, 90.0], [19.0, 29.0], [5.0, 5.0]]), (100, 1, 1))
    assert decompose(np.rint(bell(24, 100, 6.0) + noise), start, std=1.04, **GROWING).number.mean() > 1.8


def test_a_misfit_of_the_pulse_joins_no_ground_to_a_canopy():
    """It may explain one fall of chi2, not one for each echo of the canopy."""
    noise = np.random.default_rng(5).standard_normal((100, LENGTH))
    height, time = [1500.0, 2800.0, 1500.0, 300.0], [10.0, 16.0, 22.0, 36.0]
    start = np.tile(np.array([height, time, [3.0, 3.0, 3.0, 1.0]]), (100, 1, 1))
    options = GROWING | {"width_ref": 1.0, "width_low": 0.7, "width_high": 4.0, "prior_spread": 0.1, "misfit": 0.03}
    found = decompose(np.rint(bell(16, 3000, 6.0) + bell(36, 300, 1.0) + noise), start, std=1.04, **options)
    assert len(np.unique(found.cluster[np.abs(found.parameters[:, 1] - 36) < 0.5])) > 95


def draw_random(rng):
    """One to three echoes of any strength and distance; one candidate."""
    k = rng.integers(1, 4)
    time = np.sort(rng.uniform(10, 38, k))
    return np.stack([np.exp(rng.uniform(2, 5.5, k)), time, rng.uniform(1.8, 2.8, k)])


def draw_stiff(rng):
    """Two echoes closer than their widths, of very unlike strength, or at the end of the window."""
    time = rng.choice([20.0, 1.0, 46.0]) + np.array([0.0, rng.uniform(1.0, 4.0)])
    return np.stack([np.array([rng.uniform(100, 230), np.exp(rng.uniform(1, 5))]), time, rng.uniform(1.5, 4.0, 2)])


def draw_crowd(rng):
    """Four echoes, some of them bridged by one at first."""
    return np.stack([np.exp(rng.uniform(4, 9, 4)), 8 + np.cumsum(rng.uniform(3.0, 9.0, 4)), np.full(4, 2.0)])


def draw_broad(rng):
    """A slope under a wide beam: broader than echoes beside others may be."""
    return np.array([[np.exp(rng.uniform(4, 6))], [24.0], [rng.uniform(9, 12)]])


@pytest.mark.quick_cases(
    "0.0-whitening0-None-draw_broad-inf-learned",
    "3.0-whitening2-None-draw_random-inf-learned",
    "0.0-whitening3-0.7-draw_random-200.0-gaussian",
    "0.0-whitening0-None-draw_stiff-200.0-gaussian",
)  # fmt: skip
@pytest.mark.parametrize("shape", [GAUSSIAN, LEARNED], ids=["gaussian", "learned"])
@pytest.mark.parametrize(
    ("draw", "clip"),
    [(draw_random, np.inf), (draw_random, 200.0), (draw_stiff, np.inf), (draw_stiff, 200.0), (draw_crowd, np.inf),
     (draw_broad, np.inf)],
)
@pytest.mark.parametrize(
    ("known", "whitening", "level_err"),
    [(0.0, (), None), (3.0, (), None), (3.0, (1.1, -0.4), None), (0.0, (), 0.7), (3.0, (1.1, -0.4), 0.7)],
)
def test_clusters_grow_as_those_of_the_twin(shape, draw, clip, known, whitening, level_err):
    rng, m = np.random.default_rng(5), {draw_crowd: 20, draw_broad: 1}.get(draw, 30)  # the twin takes long
    truth = [draw(rng) for _ in range(m)]
    y = np.stack([naive_fit.naive.model(p, np.arange(float(LENGTH)), components=shape.components) for p in truth])
    noise = rng.standard_normal(y.shape)
    if whitening:
        noise = np.linalg.solve(naive_fit.whiten(LENGTH, np.zeros(LENGTH, bool), *whitening), noise.T).T
    errors = None if level_err is None else level_err * rng.uniform(0.3, 3, m)
    if errors is not None:
        noise = noise + errors[:, None] * rng.standard_normal((m, 1))
    y = np.minimum(np.rint(y + noise), clip)
    peak = y.argmax(axis=1).astype(float)
    start = np.stack([y.max(axis=1), peak, np.full(m, 2.0)], axis=1)[:, :, None]
    options = GROWING | {"shape": shape, "clip": clip if np.isfinite(clip) else None, "known": known}
    options |= {"whitening": whitening_filter(whitening)} if whitening else {}
    found = decompose(y, start, level_err=errors, **options)
    ends, same, near, alike = np.cumsum(found.number), 0, 0, 0
    for i in range(m):
        white = naive_fit.whiten(LENGTH, y[i] >= clip, *whitening) if whitening else None
        if errors is not None:
            white = naive_fit.free_level(np.eye(LENGTH) if white is None else white, y[i] >= clip, errors[i])
        twin = naive_fit.decompose(y[i], 1.0, start[i], settings(**options), clip, white, components=shape.components)
        p, spread, chi2 = twin
        if p.shape[1] != found.number[i]:
            continue
        same += 1
        own = slice(ends[i] - found.number[i], ends[i])
        order = np.argsort(found.parameters[own, 1])
        ours, theirs = (part[own, :3][order].T for part in (found.parameters, found.errors))
        p, spread = p[:, np.argsort(p[1])], spread[:, np.argsort(p[1])]
        alike += bool(np.allclose(theirs, spread, rtol=0.1))
        near += bool(np.abs((ours - p) / spread).max() < 0.1 and abs(found.cost[i] - chi2) < 0.1)
    assert same >= 0.9 * m
    assert near >= 0.9 * same
    assert alike >= (0.8 if np.isfinite(clip) else 0.9) * same


@pytest.mark.parametrize("height", [30.0, 100.0])
def test_a_flat_top_is_split_whatever_the_level(height):
    """Two equal echoes 1.5 widths apart from one start: with free levels fits looked for it in rows without pulses."""
    noise = np.random.default_rng(1).standard_normal((300, LENGTH))
    start = np.tile(np.array([1.2 * height, 23.5, 2.0])[:, None], (300, 1, 1))
    options = GROWING | {"known": 3.0}
    y = bell(22, height) + bell(25, height) + noise
    split = [np.mean(decompose(y, start, level_err=error, **options).number == 2) for error in (None, 0.3, 3.0)]
    assert split[0] > (0.95 if height > 50 else 0.2) and min(split[1:]) > 0.8 * split[0]


@pytest.mark.parametrize("whitening", [(), (1.1, -0.4)])
@pytest.mark.parametrize("level_err", [None, 0.2])
def test_the_promise_of_one_more_echo_is_that_of_the_twin(whitening, level_err):
    rng, m, x = np.random.default_rng(6), 30, np.arange(float(LENGTH))
    p = np.stack([rng.uniform(50, 150, m), rng.uniform(16, 30, m), rng.uniform(1.8, 2.4, m)], axis=1)
    y = np.stack([bell(t, a, w) + bell(t + 5, 0.2 * a) for a, t, w in p]) + rng.standard_normal((m, LENGTH))
    rows, one = np.arange(m), np.ones(m, int)
    options = settings(free_levels=True, whitening=whitening_filter(whitening) if whitening else None)
    samples = Samples(y.astype(np.float32), np.zeros(m, np.float32), np.ones(m, np.float32))
    samples = samples._replace(level_err=None if level_err is None else np.full(m, level_err, np.float32))
    clusters = Clusters(rows, 0 * one, LENGTH * one, rows, one)
    promised = naive_fit.promise_echoes(samples, Candidates(rows, p[:, 1], p[:, 0], p[:, 2]), clusters, options)
    clipped = np.zeros(LENGTH, bool)
    white = naive_fit.whiten(LENGTH, clipped, *whitening) if whitening else np.eye(LENGTH)
    white = white if level_err is None else naive_fit.free_level(white, clipped, level_err)
    for i in range(m):
        residual = white @ (y[i] - bell(p[i, 1], p[i, 0], p[i, 2]))
        expected = naive_fit.propose(p[i][:, None], x, residual, 1.0, options, {}, white)[1]
        assert promised[i] == pytest.approx(expected, rel=0.01)


def test_no_number_of_echoes_is_too_many():
    """Memory by need: 60 echoes of one cluster, and growth by as many as the setting allows."""
    times = 10.0 + 12.0 * np.arange(60)
    y = sum(80.0 * np.exp(-0.5 * ((np.arange(740) - t) / 2.0) ** 2) for t in times)[None]
    start = np.stack([np.full(60, 70.0), times + 0.3, np.full(60, 2.0)])[None]
    given = decompose(y, start)
    np.testing.assert_allclose(given.parameters[:, 1], times, atol=1e-2)
    grown = decompose(y, start[:, :, :1], grow=True, max_echoes=60, width_high=2.5)
    np.testing.assert_allclose(np.sort(grown.parameters[:, 1]), times, atol=1e-2)


@pytest.mark.parametrize(("length", "number"), [(480, 3), (481, 1)])
def test_a_window_wider_than_the_most_echoes_side_by_side_does_not_grow(length, number):
    """Six echoes at most, five widths to both sides, 8 samples wide: 480 samples."""
    times = np.array([30.0, 60.0, 90.0])
    y = sum(80.0 * np.exp(-0.5 * ((np.arange(length) - t) / 2.0) ** 2) for t in times)[None]
    start = np.array([[[70.0], [30.0], [2.0]]])
    assert decompose(y, start, grow=True, width_high=8.0, max_echoes=6).number.tolist() == [number]


@pytest.mark.parametrize("stretch", [20, 33, 100])
def test_a_wide_pulse_finds_the_echoes_of_a_narrow_one(stretch):
    """From 32 samples on new echoes are looked for in sums of samples; noise of each is `stretch` times stronger."""
    times, amplitudes = np.array([12.0, 16.5, 31.0, 35.0]), np.array([150.0, 60.0, 90.0, 120.0])
    noise = np.random.default_rng(stretch).standard_normal((1, LENGTH * stretch))
    middle = stretch * (times + 0.5) - 0.5
    bells = np.exp(-0.5 * ((np.arange(LENGTH * stretch)[:, None] - middle) / (2.0 * stretch)) ** 2)
    y = bells @ amplitudes + noise
    start = np.array([[[150.0], [middle[0]], [2.0 * stretch]]])
    found = decompose(y, start, grow=True, width_ref=2.0 * stretch, width_low=stretch, width_high=8.0 * stretch)
    order = np.argsort(found.parameters[:, 1])
    assert found.number.tolist() == [4]
    np.testing.assert_allclose(found.parameters[order, 1], middle, atol=5 * found.errors[:, 1].max())
    assert found.errors[:, 1].max() < 0.1 * stretch


def test_a_cluster_alone_gives_the_same_bits_as_among_others():
    rng = np.random.default_rng(8)
    truth = np.stack([draw_random(rng)[:, :1] for _ in range(40)])
    y = np.rint(np.stack([bell(t, a, w) for a, t, w in truth[:, :, 0]]) + rng.standard_normal((40, LENGTH)))
    whole = decompose(y, truth, grow=True)
    ends = np.cumsum(whole.number)
    for i in (0, 7, 39):
        alone = decompose(y[i : i + 1], truth[i : i + 1], grow=True)
        np.testing.assert_array_equal(alone.parameters, whole.parameters[ends[i] - whole.number[i] : ends[i]])
        np.testing.assert_array_equal(alone.errors, whole.errors[ends[i] - whole.number[i] : ends[i]])


@pytest.mark.parametrize("seed", range(4))
def test_hostile_problems_give_finite_echoes(seed):
    """Any counts, candidates anywhere, gaps, widths out of all proportion."""
    rng = np.random.default_rng(seed)
    for kind in (np.uint8, np.uint16, np.uint32):
        m, s, k = 20, int(rng.integers(1, 90)), int(rng.integers(1, 9))
        y = (rng.random((m, s)) ** rng.choice([0.1, 1, 9]) * np.iinfo(kind).max).astype(kind)
        missing = rng.random((m, s)) < rng.choice([0, 0.5, 1])
        amplitude, width = 10 ** rng.uniform(-6, 9, (m, k)), 10 ** rng.uniform(-3, 4, (m, k))
        start = np.stack([amplitude, rng.uniform(-1e3, 1e3, (m, k)), width], axis=1)
        options = {
            "shape": (GAUSSIAN, LEARNED, PulseShape(kappa=-0.4), PulseShape(power=4.0))[rng.choice(4)],
            "clip": float(np.iinfo(kind).max),
            "noise_gain": rng.choice([0, 2.0]),
        }
        widths = {"width_low": 1e-3, "width_high": 1e4}
        found = decompose(y, start, missing=missing, std=10 ** rng.uniform(-3, 3), **options, **widths, **GROWING)
        for field in found:
            assert np.isfinite(field).all()
        assert found.number.sum() == len(found.parameters)


def test_arrays_that_the_library_would_read_beyond_are_refused():
    samples = Samples(np.zeros((2, 8), np.uint8), np.zeros(2, np.float32), np.ones(2, np.float32))
    good = Clusters(*(np.array([value]) for value in (0, 0, 8, 0, 1)))
    start = Candidates(*(np.array([value]) for value in (0, 3.0, 5.0, 2.0)))
    assert decompose_clusters(samples, start, good, settings()).number.tolist() == [1]
    wrong = {"waveform": (2, -1), "high": (9,), "low": (8, -1), "first": (1,), "number": (2, 0)}
    for name, value in ((name, value) for name, values in wrong.items() for value in values):
        with pytest.raises(ValueError):
            decompose_clusters(samples, start, good._replace(**{name: np.array([value])}), settings())
    for name, value in (("time", np.nan), ("amplitude", np.inf), ("width", np.nan)):
        with pytest.raises(ValueError):
            decompose_clusters(samples, start._replace(**{name: np.array([value])}), good, settings())
    for name, value in (
        ("std", np.zeros(2, np.float32)),
        ("std", np.ones(3, np.float32)),
        ("baseline", np.full(2, np.nan, np.float32)),
        ("counts", np.zeros((2, 8))),
        ("missing", np.zeros((2, 7), bool)),
        ("counts", np.full((2, 8), np.nan, np.float32)),
    ):
        refuses(ValueError, "", decompose_clusters, samples._replace(**{name: value}), start, good, settings())
    shorter = (samples, start._replace(width=np.empty(0)), good), (samples, start, good._replace(low=np.zeros(2, int)))
    for wrong in shorter:
        refuses(ValueError, "differ in length", decompose_clusters, *wrong, settings())
    few = PulseShape(table=PulseTable(-1.0, 1.0, np.ones(1, np.float32), np.ones(1, np.float32), 0.0))
    for options in ({"shape": few}, {"width_ref": np.nan}, {"width_ref": np.inf}, {"width_ref": 0.0}):
        reason = "the table of a pulse must have" if "shape" in options else "the width of the pulse must be above 0"
        refuses(ValueError, reason, decompose_clusters, samples, start, good, settings()._replace(**options))


def test_samples_that_are_missing_may_be_anything():
    gap = np.arange(16).reshape(2, 8) == 5
    samples = Samples(np.where(gap, np.nan, 3).astype(np.float32), np.zeros(2, np.float32), np.ones(2, np.float32), gap)
    start, clusters = Candidates(*(np.array([value]) for value in (0, 3.0, 5.0, 2.0))), (0, 0, 8, 0, 1)
    found = decompose_clusters(samples, start, Clusters(*(np.array([value]) for value in clusters)), settings())
    assert np.isfinite(found.parameters).all()


def test_a_width_out_of_proportion_takes_no_memory():
    """Three widths of a new echo would be 24 TB."""
    y = np.rint(bell(20, 100) + bell(27, 60))[None].astype(np.float32)
    samples = Samples(y, np.zeros(1, np.float32), np.ones(1, np.float32))
    start, clusters = Candidates(*(np.array([value]) for value in (0, 20.0, 90.0, 2.0))), (0, 0, LENGTH, 0, 1)
    broad = settings(**GROWING)._replace(width_ref=1e12)
    assert decompose_clusters(samples, start, Clusters(*(np.array([v]) for v in clusters)), broad).number[0] >= 1


def test_no_clusters_give_no_echoes():
    none = np.empty(0, int)
    samples = Samples(np.zeros((0, 8), np.uint8), np.zeros(0, np.float32), np.ones(0, np.float32))
    found = decompose_clusters(samples, Candidates(*(none,) * 4), Clusters(*(none,) * 5), settings())
    assert found.parameters.shape == (0, 4) and not len(found.number)
