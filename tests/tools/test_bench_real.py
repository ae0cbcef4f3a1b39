"""`make bench-real` on simulated strips, where what it should report is known, and on the real ones."""

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import scipy  # its parts load when they are first asked for
from bench.real import pool, templates
from bench.real.__main__ import main
from bench.real.agreement import compare_models, compare_solvers, find_sensor
from bench.real.inject import add_signal, inject_echoes
from bench.real.measure import measure_real
from bench.real.noise import QuietNoise, measure_noise, unround
from bench.real.pool import Pool, Solver, find_fill, read_pool
from bench.real.report import format_report
from bench.real.templates import learn_templates
from strips import make_raw
from writer_tools import data_file

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import InputError
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.surveying import Survey, survey_blocks
from wavebatch.surveying.choose_chain import choose_chain
from wavebatch.surveying.systems.known_systems import Trial, find_source, known_systems, limit_surveys
from wavebatch.tools.simulate import simulate_strip


@pytest.fixture(scope="module")
def strip(tmp_path_factory):
    """Mostly single echoes, Gaussian pulse, white noise of 1 DN before rounding."""
    path = tmp_path_factory.mktemp("real") / "urban.las"
    simulate_strip("urban", path, pulses=3000, seed=3)
    return path


@pytest.fixture(scope="module")
def report(strip):
    return measure_real(strip)[0]


def correlated(n, s, rho=0.6, std=0.9, seed=1):
    """Values of first-order autoregressive noise."""
    white = np.random.default_rng(seed).normal(0, std * np.sqrt(1 - rho**2), (n, s + 50))
    return scipy.signal.lfilter([1], [1, -rho], white, axis=1)[:, 50:]


def make_pool(samples, path="made.las"):
    return Pool(path, (WaveformBlock.from_samples(samples),), ())


def level_solver(**system):
    survey = Survey(SystemPulse(**system), 0)
    return Solver(survey, choose_chain(survey))


@pytest.mark.slow
def test_strong_echoes_are_found_and_weak_ones_are_not(report):
    rows = {row.low: row for row in report.quiet_by_sigma}
    assert rows[10.0].recall > 0.99 and rows[20.0].recall > 0.99 and rows[5.0].recall > 0.95
    assert rows[3.0].recall < 0.97
    near = [row for row in report.near_by_separation if abs(row.apart[0]) >= 2 and row.low >= 10 and row.injected]
    assert sum(row.found for row in near) > 0.97 * sum(row.injected for row in near) > 100
    close = [row for row in report.near_by_separation if abs(row.apart[0]) == 0.5 and row.low == 5 and row.injected]
    assert sum(row.found for row in close) < 0.5 * sum(row.injected for row in close)
    assert report.split.extra < 0.02 * report.split.injected


@pytest.mark.slow
def test_reported_errors_are_right_where_the_noise_is_white(report):
    whole = [row for row in report.calibration if (row.where, row.high) == ("quiet", np.inf)][-1]
    assert whole.low == 8.0 and whole.echoes > 2000 and whole.gross < 0.01
    assert whole.ratio == pytest.approx((1, 1, 1), abs=0.1)
    assert np.abs(whole.bias) == pytest.approx(0, abs=0.1) and abs(whole.bias[0]) < 0.01


@pytest.mark.slow
def test_few_false_echoes(report):
    false = report.false_echoes
    assert false.correctness > 0.995 and false.before.length > 1e4
    for part in (false.before, false.after):
        assert part.echoes < 1e-4 * part.length + 3 and part.mirrored < 1e-4 * part.length + 3


@pytest.mark.slow
def test_noise_and_templates_are_those_that_were_simulated(report):
    assert report.noise.std == pytest.approx(np.hypot(1.0, 12**-0.5), rel=0.03)
    assert np.abs(report.noise.correlation).max() < 0.03
    assert report.templates.gain == pytest.approx(1, abs=0.01)
    assert report.templates.widened == pytest.approx(1, abs=0.02)
    assert report.templates.fwhm == pytest.approx(report.survey.fwhm, rel=0.05)


@pytest.mark.slow
def test_seed_decides_all_and_json_holds_it(strip):
    few = {"injections": 300, "waveforms": 1200}
    one, same, other = (replace(measure_real(strip, seed=seed, **few)[0], seconds={}) for seed in (1, 1, 2))
    texts = [json.dumps(asdict(each)) for each in (one, same)]  # as texts: classes without an echo hold NaN
    assert texts[0] == texts[1] and one.quiet_by_sigma != other.quiet_by_sigma
    assert json.loads(texts[0])["seed"] == 1
    assert "misses a goal" in format_report(one)


@pytest.mark.slow
def test_a_wrong_survey_is_seen(strip, report, monkeypatch):
    def deaf(blocks):
        survey = survey_blocks(blocks)
        noise = replace(survey.system.noise, std=4 * survey.system.noise.std)
        return replace(survey, system=replace(survey.system, noise=noise))

    monkeypatch.setattr(pool, "survey_blocks", deaf)
    found = measure_real(strip, injections=2000)[0]
    rows = [{row.low: row.recall for row in each.quiet_by_sigma} for each in (report, found)]
    assert rows[0][6.0] > 0.99 and rows[1][6.0] < 0.5
    assert found.noise.std == pytest.approx(report.noise.std, rel=0.06)


def test_values_before_rounding_keep_variance_and_correlation():
    true = 20 + correlated(400, 120)
    counts = np.rint(true).astype(np.uint8)
    autocovariance = [np.mean((true[:, k:] - 20) * (true[:, : 120 - k] - 20)) for k in range(5)]
    std = float(np.sqrt(autocovariance[0] + 1 / 12))
    noise = QuietNoise(std, tuple(value / std**2 for value in autocovariance[1:]), counts.size)
    drawn = unround(counts, np.full(counts.shape, 20.0), noise, np.random.default_rng(2))
    assert np.abs(drawn - counts).max() <= 0.5
    again = [np.mean((drawn[:, k:] - 20) * (drawn[:, : 120 - k] - 20)) for k in range(5)]
    assert again == pytest.approx(autocovariance, rel=0.04)


def test_noise_of_short_quiet_stretches_is_not_too_small():
    samples = np.rint(20 + correlated(3000, 8)).astype(np.uint8)
    made = make_pool(samples)
    found = measure_noise(made, level_solver(sigma_ref=2.0, noise=ReceiverNoise(baseline=20.0)), [EchoTable.empty()])
    assert found.std == pytest.approx(np.hypot(0.9, 12**-0.5), rel=0.12)
    assert found.correlation[0] == pytest.approx(0.6 * 0.81 / (0.81 + 1 / 12), abs=0.1)


def test_signal_is_added_as_if_the_digitizer_had_seen_it():
    rng = np.random.default_rng(4)
    exact = 20 + rng.normal(0, 1, (2000, 40))
    samples = np.rint(exact).astype(np.uint8)
    signal = np.where(np.arange(40) < 20, 0.0, 3.3) * np.ones((2000, 1))
    added = add_signal(samples, exact, signal, 255.0)
    assert np.array_equal(added[:, :20], samples[:, :20])
    assert added[:, 20:].mean() == pytest.approx(23.3, abs=0.02)
    assert added[:, 20:].std() == pytest.approx(np.hypot(1, 12**-0.5), rel=0.01)
    clipped = add_signal(samples, exact, 400 * signal, 60.0)
    assert clipped.max() == 60


@pytest.mark.slow
def test_gaps_of_fill_are_seen_and_left_alone(strip):
    samples = np.rint(20 + correlated(50, 100)).astype(np.uint8)
    samples[:25, 40:60] = 0
    fill = find_fill(samples)
    assert fill[:25, 40:60].all() and fill.sum() == 25 * 20
    assert not find_fill(np.zeros((3, 50), np.uint8)).any()
    assert not find_fill((samples > 30).astype(np.uint8) + 5).any()

    whole = read_pool(strip)
    solver = Solver.of_blocks(whole.surveyed)
    echoes = [solver.run(block) for block in whole.blocks]
    noise = measure_noise(whole, solver, echoes)
    made_of = learn_templates(whole, solver, echoes, noise.std, np.random.default_rng(1))
    counts = whole.blocks[0].samples[:200].copy()
    counts[:, :] = np.rint(12 + correlated(200, counts.shape[1]))
    counts[:, 25:] = 0
    gapped = WaveformBlock.from_samples(counts)
    gapped = replace(gapped, digitizer=whole.blocks[0].digitizer)
    none = EchoTable.empty()
    made = inject_echoes(
        replace(whole, blocks=(gapped,)), solver, [none], made_of, noise, 300, np.random.default_rng(3)
    )
    assert 0 < len(made) <= 150 and not made.near.any()


@pytest.mark.slow
def test_clipped_echoes_are_injected_where_the_strip_has_some(strip, report, tmp_path):
    assert report.clipped is None
    path = tmp_path / "shore.las"
    simulate_strip("shore", path, pulses=2000, seed=3)
    found = measure_real(path, injections=3000)[0]
    assert found.clipped.injected > 50 and found.clipped.recall > 0.98
    assert found.clipped.extra < 0.05 * found.clipped.injected


@pytest.mark.slow
def test_surveys_of_parts_and_in_any_order_agree(strip, report):
    assert [row.parts for row in report.agreement[:2]] == ["even/odd", "first/last"]
    whole = read_pool(strip)
    rng = np.random.default_rng(3)
    shuffled = Solver.of_blocks([block.rows(rng.permutation(len(block))) for block in whole.surveyed])
    solver = Solver.of_blocks(whole.surveyed)
    for row in (*report.agreement, compare_solvers("in order/shuffled", solver, shuffled, whole.blocks)):
        assert row.differ < 0.02 and row.apart < 0.02 and abs(row.amplitude_ratio - 1) < 0.005
        assert row.packets == len(whole)
    assert "even/odd" in format_report(report)


@pytest.mark.slow
def test_models_that_were_not_chosen_are_compared(strip):
    whole = read_pool(strip, 500)
    chosen = Solver.of_blocks(whole.blocks)
    skewed = Solver(replace(chosen.survey, system=replace(chosen.system, kappa=0.3)), chosen.chain)
    (row,) = compare_models(whole, skewed, "")
    assert row.parts == "as it is/at most 2 Gaussians" and row.surveys[0].model == "skewed 0.300"
    assert compare_models(whole, chosen, "") == []


@pytest.mark.slow
def test_errors_and_further_echoes_are_given_by_separation(report):
    near = [row for row in report.near_by_separation if abs(row.apart[0]) >= 1.5 and row.low >= 10 and row.found > 50]
    assert len(near) > 4 and all(0.75 < row.ratio[0] < 1.35 and row.extra < 0.03 * row.injected for row in near)
    names = ("found %", "further echoes %", "time error / reported")
    text = format_report(replace(report, left_out="nasa-lvis"))
    assert all(f"{name} near the strongest" in text for name in names)
    assert "as an unknown sensor: without nasa-lvis" in text


def test_a_stranger_has_no_shipped_pulse(strip):
    lvis = next(known for known in known_systems() if known.name == "nasa-lvis")
    solver = Solver.of_blocks(read_pool(strip, 500).blocks)
    assert find_sensor(solver) == ""
    assert find_sensor(Solver(replace(solver.survey, system=lvis.system), solver.chain)) == "nasa-lvis"
    with limit_surveys(Trial("nasa-lvis", 2)):
        assert lvis not in known_systems() and len(known_systems()) == 4
        assert find_source(lvis.system) is None
    assert lvis in known_systems()


@pytest.mark.slow
def test_a_strip_without_clear_echoes_has_the_other_figures(strip, monkeypatch):
    monkeypatch.setattr(templates, "LEAST_SNR", 1e6)
    (found,) = measure_real(strip, waveforms=300)
    assert found.templates is None and not found.quiet_by_sigma and found.false_echoes.echoes > 0
    text = format_report(found)
    assert "nothing injected" in text and "first/last" in text and "found %" not in text


@pytest.mark.slow
def test_a_real_stranger_is_measured_as_one():
    # Its survey takes the shipped pulse; on RIEGL's and GeoLas's the strip's own is shorter to describe.
    known, stranger = measure_real(data_file("leica-als/simple1_3_full_internal.las"), injections=1000)
    assert (known.left_out, stranger.left_out) == ("", "leica-als")
    assert known.survey.fwhm == pytest.approx(7.42, rel=0.03) == stranger.survey.fwhm
    assert {row.parts for row in known.agreement} >= {"even/odd", "as it is/at most 2 Gaussians"}


def test_agreement_sees_a_survey_that_is_off(strip):
    whole = read_pool(strip, 500)
    one = Solver.of_blocks(whole.blocks)
    wide = replace(one.survey, system=replace(one.system, noise=replace(one.system.noise, std=8.0), acceptance=120.0))
    row = compare_solvers("made", one, Solver(wide, one.chain), whole.blocks)
    assert row.differ > 0.01 and row.surveys[1].noise == 8.0
    assert compare_solvers("same", one, one, whole.blocks).differ == 0


def test_a_strip_of_five_packets_gives_one_line(tmp_path):
    small = make_raw(5, n_samples=60).write(tmp_path / "five.las")
    with pytest.raises(InputError, match="too few to inject from; at least 16"):
        measure_real(small)


@pytest.mark.slow
def test_command_measures_strips_and_goes_on_after_one_that_fails(strip, tmp_path, capsys):
    small = make_raw(5, n_samples=60).write(tmp_path / "five.las")
    assert main([str(small), str(strip), "-o", str(tmp_path / "out")]) == 1
    text, said = capsys.readouterr()
    assert "== urban.las" in text and "error / reported error" in text
    assert said.count("five.las") == 1 and "name a larger strip" in said
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"real-urban.json", "real-urban.txt"} <= names
    document = json.loads((tmp_path / "out" / "real-urban.json").read_text("utf-8"))
    assert document["false_echoes"]["echoes"] > 0 and document["strip"] == "urban.las"


@pytest.mark.slow
def test_real_strips(riegl, leica):
    for path in (riegl, leica):
        found = measure_real(path, injections=3000)[0]
        strong = [row for row in found.quiet_by_count if row.low >= 9]
        assert sum(row.found for row in strong) > 0.99 * sum(row.injected for row in strong) > 500
        assert 0.5 < found.noise.std < 1.5 and found.noise.correlation[0] > 0.3
        assert found.false_echoes.correctness > 0.95
