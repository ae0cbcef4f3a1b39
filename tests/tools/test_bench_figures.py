"""Figures of the benchmark: their errors are what repetitions show; bounds, Pareto front, lengths, promises."""

from dataclasses import replace

import naive
import numpy as np
import pytest
from bench.promises import format_promises, judge

from wavebatch.cli.options import parse_length
from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.kernels.fit.bounds import crlb
from wavebatch.tools.bench.accuracy import (
    SURVEY_SCATTER,
    Figure,
    choose_cheapest,
    describe_truth,
    effective_noise,
    find_bounds,
    find_front,
    find_hidden,
    median_range,
    root_mean_square,
    share_figure,
)
from wavebatch.tools.simulate import PULSES, PulseModel, Recording, simulate_blocks
from wavebatch.tools.simulate.render import paint_echoes


def draw_share(rng, by_group=0.0):
    """A share of 0.7 among 8 groups of 100 waveforms with one or two echoes each; groups differ by `by_group`."""
    group = np.repeat(np.arange(8), 100)
    whole = rng.integers(1, 3, 800)
    chance = 0.7 + by_group * rng.standard_normal(8)[group]
    return share_figure(rng.binomial(whole, np.clip(chance, 0, 1)), whole, group)


def test_error_of_a_share_is_what_repetitions_show(rng):
    figures = [draw_share(rng) for _ in range(400)]
    scatter = np.sqrt(2) * np.std([figure.value for figure in figures])
    stated = np.mean([figure.error for figure in figures])
    assert scatter < 1.05 * stated and stated < 1.6 * scatter
    assert abs(np.mean([figure.value for figure in figures]) - 0.7) < 0.01


def test_error_of_a_share_sees_what_groups_have_in_common(rng):
    figures = [draw_share(rng, by_group=0.1) for _ in range(300)]
    scatter = np.sqrt(2) * np.std([figure.value for figure in figures])
    assert 0.8 * scatter < np.mean([figure.error for figure in figures]) < 1.5 * scatter


def test_shares_of_nothing_keep_an_error():
    group = np.zeros(1000, int)
    none = share_figure(np.zeros(1000), np.ones(1000), group)
    every = share_figure(np.ones(1000), np.ones(1000), group)
    assert none.value == 0 and every.value == 1
    assert none.error == pytest.approx(every.error) and 0.001 < none.error < 0.003
    assert share_figure(np.zeros(5), np.zeros(5), np.zeros(5, int)).to_json() == {"value": None, "error": None}


def test_error_of_a_root_mean_square_is_what_repetitions_show(rng):
    waveform, group = np.arange(1000) // 2, np.arange(1000) // 125
    drawn = [
        root_mean_square(3 * np.repeat(rng.standard_normal(500), 2), waveform, group) for _ in range(300)
    ]  # both echoes of a waveform err alike
    scatter = np.sqrt(2) * np.std([figure.value for figure in drawn])
    stated = np.mean([figure.error for figure in drawn])
    assert scatter < 1.07 * stated and stated < 2.0 * scatter
    assert np.mean([figure.value for figure in drawn]) == pytest.approx(3, rel=0.01)
    assert root_mean_square(np.zeros(9), np.arange(9), np.zeros(9, int)) == Figure(0.0, 0.0)
    steady = root_mean_square(np.ones(100), np.arange(100), np.arange(100) % 8)
    one_off_by_ten, surveys = np.sqrt(2) - 1, np.sqrt(2 / 8) * SURVEY_SCATTER
    assert steady.value == 1 and steady.error == pytest.approx(np.hypot(one_off_by_ten, surveys))
    assert np.isnan(root_mean_square(np.ones(1), np.zeros(1, int), np.zeros(1, int)).value)


def test_median_and_range():
    assert median_range([3.0, 1.0, 2.0]) == {"median": 2.0, "min": 1.0, "max": 3.0, "repeats": 3}
    assert median_range([])["median"] is None


def table(*rows):
    """Waveform, time, amplitude, sigma of each echo."""
    return EchoTable.build(*np.array(rows, float).T)


def test_bounds_are_the_closed_forms():
    recording = Recording(noise_std=1.0)
    truth = table((0, 40.3, 50, 2.0), (1, 30.0, 80, 2.6), (1, 37.0, 40, 2.0))
    found = find_bounds(recording, truth, 3)
    alone = crlb(np.array([50.0]), np.array([2.0]), recording.recorded_noise, 1.0)
    assert found[0] == pytest.approx(np.array(alone)[:, 0], rel=2e-3)
    pair = naive.crlb_joint(
        np.array([[30.0], [37.0]]),
        np.array([[80.0], [40.0]]),
        np.array([[2.6], [2.0]]),
        recording.recorded_noise,
        1,
        80,
    )
    assert found[1:] == pytest.approx(np.stack([part[:, 0] for part in pair], axis=1), rel=2e-3)
    assert find_bounds(recording, EchoTable.empty(), 3).shape == (0, 3)


def test_bounds_know_clipping_and_noise_of_the_signal():
    truth = table((0, 40.3, 200, 2.0))
    plain, clipped, noisy = (
        find_bounds(replace(Recording(), **change), truth, 1)[0]
        for change in ({}, {"saturation": 112}, {"noise_gain": 0.1})
    )
    assert np.all(clipped[[0, 2]] > 1.1 * plain[[0, 2]]) and clipped[1] > 2 * plain[1]
    assert np.all(noisy > 2 * plain)
    lost = table((0, 40.3, 50, 2.0), (0, 40.3, 50, 2.0))
    assert np.isinf(find_bounds(Recording(), lost, 1)).all()


def test_coloured_noise_counts_for_more():
    for rho, factor in ((0.0, 1.0), (0.5, 1.29), (0.667, 1.39), (0.8, 1.48)):
        stated = effective_noise(Recording(noise_std=100.0, rho=rho))
        assert stated == pytest.approx(100 * factor, rel=0.005)


@pytest.mark.parametrize("pulse", ["gaussian", "skewed", "riegl", "leica"])
def test_truth_is_described_as_the_painted_pulse_is(pulse):
    recording = Recording(n_samples=4000, spacing=0.02, pulse=PULSES[pulse])
    for wider in (1.0, 1.5):
        raw = table((0, 30.0, 100, wider * recording.pulse.sigma))
        told = describe_truth(raw, recording.pulse)
        y = paint_echoes(recording, 1, np.zeros(1, int), raw.time, raw.amplitude, raw.sigma.astype(float))[0]
        above = np.flatnonzero(y > 0.5 * y.max())
        assert told.time[0] == raw.time[0]
        assert told.sigma[0] * 2.354820 == pytest.approx(0.02 * (above[-1] - above[0] + 1), abs=0.05)
    gaussian = simulate_blocks("urban", 50, seed=1)
    truth = next(gaussian)[1]
    same = describe_truth(truth, PulseModel())
    assert np.array_equal(same.time, truth.time) and np.array_equal(same.sigma, truth.sigma)


def test_hidden_neighbours_are_those_of_a_loop(rng):
    m = 300
    waveform = np.sort(rng.integers(0, 90, m))
    time, sigma = rng.uniform(0, 60, m), rng.uniform(1, 4, m)
    order = np.lexsort((time, waveform))
    truth = EchoTable.build(waveform[order], time[order], np.ones(m), sigma[order])
    matched = rng.random(m) < 0.7
    expected = [
        matched[i]
        and any(
            not matched[j]
            and truth.waveform[j] == truth.waveform[i]
            and abs(truth.time[j] - truth.time[i]) < 6 * max(truth.sigma[i], truth.sigma[j])
            for j in range(m)
        )
        for i in range(m)
    ]
    np.testing.assert_array_equal(find_hidden(truth, matched), expected)
    assert 20 < np.sum(expected) < 200
    assert not find_hidden(truth.take(np.zeros(0, int)), matched[:0]).any()


def test_front_holds_what_nothing_beats():
    costs = np.array([[1.0, 9.0], [2.0, 5.0], [2.0, 5.0], [3.0, 6.0], [9.0, 1.0], [0.5, np.nan]])
    assert find_front(costs).tolist() == [True, True, True, False, True, False]
    assert find_front(np.empty((0, 2))).tolist() == []


@pytest.mark.parametrize(("text", "cm"), [("0.02m", 2.0), ("2cm", 2.0), (" 20 mm ", 2.0), (".5cm", 0.5), ("1.m", 100)])
def test_lengths(text, cm):
    assert parse_length(text) == pytest.approx(cm)


@pytest.mark.parametrize("text", ["", "2", "cm", "-1cm", "0m", "2 km", "1e3mm", "nan m"])
def test_no_lengths(text):
    with pytest.raises(ConfigError, match="2cm"):
        parse_length(text)


def make_row(name, microseconds, rmse, error=0.1, **figures):
    known = {"rmse_isolated_cm": rmse, "rmse_all_cm": rmse, **figures}
    times = {"median": microseconds}
    return {
        "name": name,
        "figures": {key: {"value": value, "error": error} for key, value in known.items()},
        "kernels": times,
        "file": times,
    }


def test_cheapest_is_the_fastest_that_meets_the_tolerance_with_its_error():
    rows = [make_row("fast", 5, 2.0), make_row("slow", 50, 1.0), make_row("middle", 20, 1.5), make_row("?", 1, None)]
    assert choose_cheapest(rows, 2.2)["name"] == "fast"
    assert choose_cheapest(rows, 2.05)["name"] == "middle"
    assert choose_cheapest(rows, 1.0) is None


def judged(microseconds, **figures):
    shares = {"exact_count": 0.95, "completeness": 0.95, "correctness": 0.99, "false_splits": 0.001} | figures
    rows = [make_row(name, microseconds, 1.5, time_ratio_isolated=1.01, **shares) for name in ("balanced", "auto")]
    rows.append(make_row("gdecomp", 100, 2.0, completeness=0.9, correctness=0.96))
    row = {"hazard": "H7", "case": "ringing 1%", "chain": "auto", "is_auto": True, "failures": {"negative": 0}}
    return {
        "scenes": [{"scene": "mixed", "rows": rows}],
        "stability": [{**row, "figures": {"false_splits": {"value": 0.03, "error": 0.0}}}],
        "system": {
            "start_seconds": {"median": 0.1},
            "memory": [{"waveforms": 10, "peak_bytes": 2e8}, {"waveforms": 1000, "peak_bytes": 3e8}],
            "jobs": {"1": {"median": 4.0}, "2": {"median": 2.1}},
        },
    }


def test_promises_are_met_or_short():
    rows = {row["what"]: row for row in judge(judged(5.0))}
    assert rows["mixed: auto, kernels"]["met"] and rows["mixed: auto, kernels"]["measured"] == pytest.approx(200_000)
    assert rows["mixed: auto is faster than gdecomp"]["measured"] == pytest.approx(20)
    assert not rows["H7 ringing 1%: auto, false_splits"]["met"]
    assert not rows["memory of the long strip over the short"]["met"]
    assert rows["stiff cases: failures of all chains"]["met"] and rows["start-up of wavebatch --help"]["met"]
    slow = {row["what"]: row for row in judge(judged(500.0, completeness=0.5))}
    assert not slow["mixed: auto, kernels"]["met"] and not slow["mixed: auto, completeness"]["met"]
    text = format_promises(list(slow.values()))
    assert "short" in text and "met" in text and "<= 0.3" in text
