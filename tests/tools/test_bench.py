"""The benchmark on small numbers: what its documents hold, its processes and scenes; and what releases measure.

Figures of the benchmark: their errors are what repetitions show; bounds, Pareto front, lengths, promises.

`bench --all-methods`: one row for every detector and decomposer.
"""

import json
import os
import shutil
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import partial
from pathlib import Path

import naive
import numpy as np
import pytest
from bench import against, peers
from bench.cases import list_cases
from bench.promises import judge
from bench.release import format_release, measure_cases
from bench.stability import FAILURES
from bench_tools import time_here
from commands import refuses, succeed

import wavebatch
from wavebatch.batch.workers.futures import WorkerDied
from wavebatch.cli.options import parse_length
from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse
from wavebatch.kernels.fit.closed_form import crlb
from wavebatch.stages.chain import STAGES, load_profile
from wavebatch.surveying import Survey
from wavebatch.tools.bench import accuracy, command
from wavebatch.tools.sheets.sheet import list_lines
from wavebatch.tools.simulate import PULSES, Recording, find_scene, simulate_block, simulate_blocks, simulate_strip
from wavebatch.tools.simulate.render import paint_echoes
from wavebatch.tools.simulate.scenes import Scene

SMALL = command.BenchOptions(
    scenes=("flat",),
    waveforms=800,
    repeats=1,
    pulses=200,
    tolerance_cm=50.0,
)


@pytest.fixture(scope="module")
def document():
    """A small benchmark with everything in it, whose chains are timed in this process."""
    with pytest.MonkeyPatch.context() as patch:
        time_here(patch)
        return measure_small(replace(SMALL, waveforms=400))


@pytest.fixture(scope="module")
def timed_document():
    """The same, timed in processes of their own."""
    return measure_small()


def measure_small(options=SMALL):
    others = partial(peers.measure_peers, progress=lambda text: None, waveforms=20)
    found = command.run_bench(options, measure_others=others)
    return {**found, "promises": judge(found)}


def find_row(document, name):
    return next(row for row in document["scenes"][0]["rows"] if row["name"] == name)


@pytest.mark.slow
def test_document_has_a_row_per_chain_and_peer(timed_document):
    document = timed_document
    assert document["schema"] == command.SCHEMA
    names = [row["name"] for row in document["scenes"][0]["rows"]]
    assert names[:4] == ["fast", "balanced", "accurate", "auto"] and "scipy leastsq" in names
    for row in document["scenes"][0]["rows"]:
        assert row["kernels"]["median"] > 0
        figures = row["figures"]
        assert figures["completeness"]["value"] > 0.95 and 0 < figures["completeness"]["error"] < 0.1
        assert figures["time_ratio_overlapped"] == {"value": None, "error": None}
        if row["kind"] == "chain":
            assert row["file"]["repeats"] == 1 and row["survey_seconds"]["median"] > 0
            assert 2e7 < row["peak_bytes"] < 5e8
    assert {row["kind"] for row in document["scenes"][0]["rows"] if row["pareto"]} == {"chain"}
    assert document["scenes"][0]["cheapest"] in names


def test_document_is_plain_json_and_its_tables_show_all(document):
    assert json.loads(json.dumps(document, allow_nan=False)) == document
    text = "\n".join(list_lines(command.bench_sheet(document)))
    for row in document["scenes"][0]["rows"]:
        assert f"\n  {row['name']}" in text
    assert "cheapest chain with an error of 50 cm" in text
    assert f"{100 * find_row(document, 'fast')['figures']['exact_count']['value']:.2f} +-" in text


@pytest.mark.slow
def test_stiff_cases_count_failures_by_kind(document):
    cases = measure_cases(SMALL, list_cases(["H10"]), lambda text: None, waveforms=40)
    text = format_release({**document, "stability": cases})
    shown = "\n".join(list_lines(command.bench_sheet(document)))
    assert text.startswith(shown) and "isolated, time error / bound" in text
    assert "constant 0, 12 or 255" in text
    assert {row["case"] for row in cases} == {"constant 0, 12 or 255", "noise only"}
    assert any(row["is_auto"] for row in cases)
    for row in cases:
        assert row["failures"] == dict.fromkeys(FAILURES, 0) and row["waveforms"] == 40
        for name in ("completeness", "correctness", "wrong"):
            assert row["figures"][name]["value"] is None
        assert row["figures"]["false_alarms"]["value"] < 0.05 + (row["chain"] == "balanced")


@pytest.mark.slow
def test_figures_depend_on_the_seed_alone_and_move_by_no_more_than_they_say(timed_here):
    small = replace(SMALL, pulses=0, waveforms=1200)
    rows = [command.run_bench(replace(small, seed=seed))["scenes"][0]["rows"] for seed in (5, 5, 6)]
    for first, again, other in zip(*rows, strict=True):
        assert first["figures"] == again["figures"] != other["figures"]
        for name, figure in first["figures"].items():
            if figure["value"] is not None:
                assert abs(figure["value"] - other["figures"][name]["value"]) <= 3 * figure["error"], name


def test_nothing_to_measure():
    refuses(ConfigError, "--scene", command.run_bench, command.BenchOptions())
    refuses(ConfigError, "forest", command.run_bench, command.BenchOptions(scenes=("forrest",)))
    refuses(ConfigError, "H14", list_cases, ["H14"])


@pytest.mark.slow
def test_command_writes_what_it_prints(tmp_path, monkeypatch):
    monkeypatch.setattr(command, "has_matplotlib", lambda: False)
    options = "--scene flat --waveforms 800 --pulses 0 --repeat 1 --json"
    chain = tmp_path / "mine.toml"
    chain.write_text(
        "".join(f'[[chain]]\nstage = "{s}"\n' for s in ("noise.pooled", "detect.maximum", "decompose.none"))
    )
    result = succeed("bench", chain, "-o", tmp_path / "out", *options.split())
    document = json.loads((tmp_path / "out" / "bench.json").read_text())
    assert json.loads(result.stdout) == document
    mine = find_row(document, "mine")
    assert mine["figures"]["time_calibration_isolated"]["value"] is None and mine["file"]["median"] is None
    assert "pip install 'matplotlib>=3.8'" in result.stderr
    assert sorted(path.name for path in (tmp_path / "out").iterdir()) == ["bench.json", "bench.txt"]
    assert "accurate" in (tmp_path / "out" / "bench.txt").read_text()


def test_plot_is_written_where_matplotlib_is(tmp_path, document):
    lines = command.write_outputs(document, "text", tmp_path)
    assert lines == [f"{tmp_path}: bench.json, bench.txt, bench-flat.png"]
    assert (tmp_path / "bench-flat.png").read_bytes()[:4] == b"\x89PNG"


@pytest.mark.parametrize("rho", [0.0, 0.667])
def test_scene_is_shaped_like_the_strip(tmp_path, rho):
    recording = Recording(noise_std=1.6, rho=rho, baseline=30.0, bits=16, n_samples=64)
    scene = replace(find_scene("open"), recording=recording)
    simulate_strip(scene, tmp_path / "a.las", pulses=3000, seed=1)
    like = command.shape_scene(tmp_path / "a.las", load_profile("accurate"))
    shaped = like.recording
    assert (shaped.bits, shaped.n_samples) == (16, 64) and shaped.rho == pytest.approx(rho, abs=0.001)
    assert shaped.noise_std == pytest.approx(1.6, rel=0.05) and shaped.baseline == pytest.approx(30, abs=0.1)
    assert shaped.pulse.sigma == pytest.approx(2.0, rel=0.08)
    _, truth = simulate_block(scene, 4000, np.random.default_rng(1))
    _, drawn = simulate_block(like, 4000, np.random.default_rng(2))
    shares = [np.bincount(table.count(4000), minlength=8)[:8] / 4000 for table in (truth, drawn)]
    assert np.abs(shares[0] - shares[1]).max() < 0.05
    strong = [np.median(table.amplitude[table.amplitude > 15]) for table in (truth, drawn)]
    assert strong[1] == pytest.approx(strong[0], rel=0.15)
    again = simulate_block(like, 4000, np.random.default_rng(2))[1]
    assert np.array_equal(drawn.time, again.time)


def test_strip_too_short_to_resample(tmp_path):
    simulate_strip("flat", tmp_path / "short.las", pulses=50)
    refuses(InputError, "too few", command.shape_scene, tmp_path / "short.las", load_profile("fast"))


@pytest.mark.slow
def test_groups_differ_and_are_surveyed():
    groups = accuracy.make_groups(find_scene("flat"), 1600, 3)
    assert [len(group.block) for group in groups] == [200] * 8
    assert not np.array_equal(groups[0].block.samples, groups[1].block.samples)
    assert all(group.system.sigma_ref == pytest.approx(2.0, rel=0.05) for group in groups)


def known_group(n=300) -> accuracy.Group:
    scene = find_scene("flat")
    ((block, truth),) = simulate_blocks(scene, n, seed=2, size=n)
    return accuracy.make_group(scene, 0, block, truth, Survey(SystemPulse(2.0, noise=ReceiverNoise(std=1.04)), n))


def shift(group, errors):
    """The true echoes later by some bounds of their times."""
    return replace(group.truth, time=group.truth.time + errors * group.bounds[:, 0])


def widen(group):
    """Echoes whose widths are right in their column and twice as large in the table."""
    width = np.float32(2.354820) * group.truth.sigma
    found = replace(group.truth, sigma=2 * group.truth.sigma)
    return found.with_attributes(echo_width=width, echo_width_err=0.1 * width)


def flag(group):
    """Every second echo is flagged and off by three of its errors, the others by one."""
    flagged, n = np.arange(len(group.truth)) % 2 == 1, len(group.truth)
    found = replace(group.truth, time=group.truth.time + np.where(flagged, 0.03, 0.01), time_err=np.full(n, 0.01, "f4"))
    return found.with_flags(EchoFlag.OVERLAPPED, flagged)


def split(group):
    """Every third echo is two."""
    third = group.truth.take(np.arange(0, len(group.truth), 3))
    both = EchoTable.concatenate([group.truth, replace(third, time=third.time + 1)])
    return both.take(np.lexsort((both.time, both.waveform)))


@pytest.mark.parametrize(
    ("find", "figures"),
    [
        (lambda group: group.truth, {"completeness": 1, "correctness": 1, "exact_count": 1, "wrong": 0,
                                     "rmse_all_cm": 0, "false_splits": 0}),
        (lambda group: EchoTable.empty(), {"completeness": 0, "wrong": 1, "rmse_all_cm": np.nan}),
        (partial(shift, errors=2), {"time_ratio_isolated": 2, "gross_isolated": 0}),
        (partial(shift, errors=20), {"gross_isolated": 1}),
        (widen, {"sigma_ratio_isolated": 0}),
        (flag, {"time_calibration_flagged": 3, "time_calibration_not_flagged": 1, "hidden": 0,
                "time_calibration_hidden": np.nan, "time_calibration_not_hidden": np.sqrt(5)}),
        (split, {"completeness": 1, "correctness": 0.75, "exact_count": 2 / 3, "false_splits": 1 / 3, "wrong": 1 / 7}),
    ],
)  # fmt: skip
def test_figures_are_those_of_what_was_found(find, figures):
    group, tally = known_group(), accuracy.AccuracyTally()
    tally.add(group, find(group))
    found = tally.figures()
    for name, value in figures.items():
        assert found[name].value == pytest.approx(value, rel=5e-3, abs=1e-4, nan_ok=True), name
    if find is flag:  # time errors of .01 ns
        for part in ("value", "error"):
            scaled = getattr(found["time_calibration_not_hidden"], part)
            assert getattr(found["rmse_all_cm"], part) == pytest.approx(0.01 * accuracy.CM_PER_NS * scaled, rel=1e-3)
            assert scaled > 0


def test_worker_answers_raises_and_dies():
    with command.Worker() as worker:
        assert worker.call(os.getenv, "OPENBLAS_NUM_THREADS") == "1"
        assert worker.call(os.getpid) != os.getpid()
        refuses(FileNotFoundError, "", worker.call, os.stat, "/no/such/file")
        memory = worker.call(command.peak_memory)
        assert memory is None or 5e6 < memory < 1e9
    with command.Worker() as worker:
        for _ in range(2):  # a dead process takes no further call
            refuses(WorkerDied, "", worker.call, os._exit, 3)


def test_closing_a_worker_ends_a_call_that_hangs():
    with ThreadPoolExecutor(1) as caller, command.Worker() as worker:
        worker.call(os.getpid)
        call = caller.submit(worker.call, time.sleep, 600)
    assert isinstance(call.exception(), WorkerDied)


@pytest.fixture
def checkout(tmp_path):
    """A copy of this wavebatch under another path."""
    root = tmp_path / "copy"
    shutil.copytree(Path(wavebatch.__file__).parent, root / "wavebatch", ignore=shutil.ignore_patterns("__pycache__"))
    return root


@pytest.mark.slow
def test_two_checkouts_take_turns(tmp_path, checkout):
    options = ["--scene", "flat", "--pulses", "300", "--repeat", "2", "-o", str(tmp_path / "out")]
    refuses(InputError, "holds no wavebatch that Python can import", against.main, [str(tmp_path), *options])
    against.main([str(checkout), *options])
    (ratios,) = json.loads((tmp_path / "out" / "against.json").read_text())["strips"].values()
    for name in ("cpu", "wall", "peak"):
        middle, low, high = ratios[name]
        assert 0 < low <= middle <= high
    assert "flat" in (tmp_path / "out" / "against.txt").read_text()


def draw_share(rng, by_group=0.0):
    """A share of 0.7 among 8 groups of 100 waveforms with one or two echoes each; groups differ by `by_group`."""
    group = np.repeat(np.arange(8), 100)
    whole = rng.integers(1, 3, 800)
    chance = 0.7 + by_group * rng.standard_normal(8)[group]
    return accuracy.share_figure(rng.binomial(whole, np.clip(chance, 0, 1)), whole, group)


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
    none = accuracy.share_figure(np.zeros(1000), np.ones(1000), group)
    every = accuracy.share_figure(np.ones(1000), np.ones(1000), group)
    assert none.value == 0 and every.value == 1
    assert none.error == pytest.approx(every.error) and 0.001 < none.error < 0.003
    assert accuracy.share_figure(np.zeros(5), np.zeros(5), np.zeros(5, int)).to_json() == {"value": None, "error": None}


def test_error_of_a_root_mean_square_is_what_repetitions_show(rng):
    waveform, group = np.arange(1000) // 2, np.arange(1000) // 125
    drawn = [
        accuracy.root_mean_square(3 * np.repeat(rng.standard_normal(500), 2), waveform, group) for _ in range(300)
    ]  # both echoes of a waveform err alike
    scatter = np.sqrt(2) * np.std([figure.value for figure in drawn])
    stated = np.mean([figure.error for figure in drawn])
    assert scatter < 1.07 * stated and stated < 2.0 * scatter
    assert np.mean([figure.value for figure in drawn]) == pytest.approx(3, rel=0.01)
    assert accuracy.root_mean_square(np.zeros(9), np.arange(9), np.zeros(9, int)) == accuracy.Estimate(0.0, 0.0)
    steady = accuracy.root_mean_square(np.ones(100), np.arange(100), np.arange(100) % 8)
    one_off_by_ten, surveys = np.sqrt(2) - 1, np.sqrt(2 / 8) * accuracy.SURVEY_SCATTER
    assert steady.value == 1 and steady.error == pytest.approx(np.hypot(one_off_by_ten, surveys))
    assert np.isnan(accuracy.root_mean_square(np.ones(1), np.zeros(1, int), np.zeros(1, int)).value)


def table(*rows):
    """Waveform, time, amplitude, sigma of each echo."""
    return EchoTable.build(*np.array(rows, float).T)


def test_bounds_are_the_closed_forms():
    recording = Recording(noise_std=1.0)
    truth = table((0, 40.3, 50, 2.0), (1, 30.0, 80, 2.6), (1, 37.0, 40, 2.0))
    found = accuracy.find_bounds(recording, truth, 3)
    alone = crlb(np.array([50.0]), np.array([2.0]), recording.recorded_noise, 1.0)
    assert found[0] == pytest.approx(np.array(alone)[:, 0], rel=2e-3)
    pair = np.array([[80.0, 40.0], [30.0, 37.0], [2.6, 2.0]])
    expected, _ = naive.fisher_errors(pair, np.arange(80.0), recording.recorded_noise)
    assert found[1:] == pytest.approx(expected[[1, 0, 2]].T, rel=2e-3)
    assert accuracy.find_bounds(recording, EchoTable.empty(), 3).shape == (0, 3)


def test_bounds_know_clipping_and_noise_of_the_signal():
    truth = table((0, 40.3, 200, 2.0))
    plain, clipped, noisy = (
        accuracy.find_bounds(replace(Recording(), **change), truth, 1)[0]
        for change in ({}, {"saturation": 112}, {"noise_gain": 0.1})
    )
    assert np.all(clipped[[0, 2]] > 1.1 * plain[[0, 2]]) and clipped[1] > 2 * plain[1]
    assert np.all(noisy > 2 * plain)
    lost = table((0, 40.3, 50, 2.0), (0, 40.3, 50, 2.0))
    assert np.isinf(accuracy.find_bounds(Recording(), lost, 1)).all()


def test_coloured_noise_counts_for_more():
    one = table((0, 40.3, 50, 2.0))
    white = accuracy.find_bounds(Recording(noise_std=100.0), one, 1)
    for rho, factor in ((0.5, 1.29), (0.667, 1.39), (0.8, 1.48)):
        bounds = accuracy.find_bounds(Recording(noise_std=100.0, rho=rho), one, 1)
        assert bounds == pytest.approx(factor * white, rel=0.005)


@pytest.mark.parametrize("pulse", ["gaussian", "skewed", "riegl", "leica"])
def test_truth_is_described_as_the_painted_pulse_is(pulse):
    recording = Recording(n_samples=4000, spacing=0.02, pulse=PULSES[pulse])
    for wider in (1.0, 1.5):
        raw = table((0, 30.0, 100, wider * recording.pulse.sigma))
        told = accuracy.make_group(Scene("", "", recording=recording), 0, range(1), raw, None).truth
        y = paint_echoes(recording, 1, np.zeros(1, int), raw.time, raw.amplitude, raw.sigma.astype(float))[0]
        above = np.flatnonzero(y > 0.5 * y.max())
        assert told.time[0] == raw.time[0]
        assert told.sigma[0] * 2.354820 == pytest.approx(0.02 * (above[-1] - above[0] + 1), abs=0.05)
    gaussian = simulate_blocks("urban", 50, seed=1)
    truth = next(gaussian)[1]
    same = accuracy.make_group(Scene("", ""), 0, range(50), truth, None).truth
    assert np.array_equal(same.time, truth.time) and np.array_equal(same.sigma, truth.sigma)


def test_a_hidden_echo_lies_within_six_widths_of_one_that_was_not_found():
    rows = [(0, 10.0, 1, 2.0), (0, 21.9, 1, 1.0), (0, 34.0, 1, 1.0), (0, 39.9, 1, 0.5), (1, 22.0, 1, 2.0)]
    truth = table(*rows, (2, 10.0, 1, 0.5), (2, 16.0, 1, 0.5))  # beyond their own six widths, within the widest ones
    cases = ((1,), {0}), ((0,), {1}), ((2,), {3}), ((3,), {2}), ((4,), set()), ((1, 2), {0, 3}), ((5,), set())
    for lost, hidden in cases:
        matched = ~np.isin(np.arange(len(truth)), lost)
        assert set(np.flatnonzero(accuracy.find_hidden(truth, matched)).tolist()) == hidden
    assert not accuracy.find_hidden(truth.take(np.zeros(0, int)), matched[:0]).any()


def test_front_holds_what_nothing_beats():
    costs = np.array([[1.0, 9.0], [2.0, 5.0], [2.0, 5.0], [3.0, 6.0], [9.0, 1.0], [0.5, np.nan]])
    assert accuracy.find_front(costs).tolist() == [True, True, True, False, True, False]
    assert accuracy.find_front(np.empty((0, 2))).tolist() == []


@pytest.mark.parametrize(("text", "m"), [("0.02m", 0.02), ("2cm", 0.02), ("20 mm", 0.02), (".5 cm", 0.005), ("1.m", 1)])
def test_lengths(text, m):
    assert parse_length(text) == m


@pytest.mark.parametrize("text", ["", "2", "cm", "-1cm", "0m", "2 km", "1e3mm", "nan m"])
def test_no_lengths(text):
    refuses(ConfigError, "2cm", parse_length, text)


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
    assert accuracy.choose_cheapest(rows, 2.2)["name"] == "fast"
    assert accuracy.choose_cheapest(rows, 2.05)["name"] == "middle"
    assert accuracy.choose_cheapest(rows, 1.0) is None


def test_every_method_has_a_chain():
    methods = command.list_methods()
    kinds = {name for name, stage in STAGES.items() if stage.kind in ("detect", "decompose")}
    assert set(methods) == kinds - {"decompose.none"}
    for name, chain in methods.items():
        stages = [step.stage.name for step in chain.steps]
        assert name in stages
        before = "detect.asdf" if name.startswith("decompose.asdf") else "detect.maximum"
        assert stages[1] == (name if name.startswith("detect") else before)


@pytest.mark.slow
def test_all_methods_stand_in_one_table(timed_here):
    options = "--scene flat --waveforms 600 --pulses 0 --repeat 1 --all-methods --json"
    result = succeed("bench", *options.split())
    rows = {row["name"]: row for row in json.loads(result.stdout)["scenes"][0]["rows"]}
    assert set(command.list_methods()) | {"fast", "balanced", "accurate"} <= set(rows)
    for name in ("detect.maximum", "detect.asdf", "decompose.gaussian", "decompose.reference"):
        assert rows[name]["figures"]["completeness"]["value"] > 0.98, name
