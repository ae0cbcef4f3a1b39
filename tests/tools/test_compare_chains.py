"""Chains against chains and clouds on one strip: loops, known truth, Wagner's tables (T6).

Goodness of fit against loops, Wang's tables (T7), and the model of every decomposer.
"""

import json

import naive
import numpy as np
import pytest
from commands import run_command

from wavebatch.core.echoes import EchoTable
from wavebatch.core.errors import InputError
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.stages.decompose.models import fitted_pulse, rebuild_waveforms
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.choose_chain import read_sample
from wavebatch.tools.compare_chains import Contender, FitQuality, find_contender, match_sides, measure_fit


def make_chain(detector, decomposer, **parameters):
    steps = (Step(STAGES["noise.pooled"]), Step(STAGES[f"detect.{detector}"], parameters))
    return Chain((*steps, Step(STAGES[f"decompose.{decomposer}"])), f"{detector}+{decomposer}")


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """A strip of 900 pulses, and the clouds of two profiles."""
    folder = tmp_path_factory.mktemp("mixed")
    call("simulate", "mixed", "-o", folder / "s.las", "--pulses", 900, "--seed", 5)
    for profile in ("fast", "accurate"):
        call("run", folder / "s.las", "-o", folder / profile, "--profile", profile, "-q")
    return folder


def call(*arguments, code=0):
    result = run_command(*arguments)
    assert result.exit_code == code, result.output
    return result


def pair_naively(a, b, tolerance):
    """Greedy pairs of times, nearest first."""
    every = sorted((abs(x - y), j, i) for i, x in enumerate(a) for j, y in enumerate(b) if abs(x - y) <= tolerance)
    pairs, used_a, used_b = [], set(), set()
    for _, j, i in every:
        if i not in used_a and j not in used_b:
            pairs.append((i, j))
            used_a.add(i)
            used_b.add(j)
    return pairs


def test_two_chains_as_a_loop_over_waveforms_finds_it(mixed):
    sides = find_contender("fast"), find_contender("accurate")
    result = match_sides(mixed / "s.las", *sides)
    with StripReader(mixed / "s.las") as reader, reader.scan() as scan:
        system = survey_blocks(read_sample(reader, scan)).system
        ((block, _),) = list(reader.read_blocks(reader.read_unit(0, scan), 5000, owned_only=True))
    a, b = (side.chain.run(block, system) for side in sides)
    differences, exact, counts = [], 0, ({}, {})
    for w in range(len(block)):
        times = [table.time[table.waveform == w] for table in (a, b)]
        differences += [times[0][i] - times[1][j] for i, j in pair_naively(*times, 1.0)]
        exact += len(times[0]) == len(times[1])
        for side in (0, 1):
            counts[side][len(times[side])] = counts[side].get(len(times[side]), 0) + 1
    between = result.between
    assert between.matched_by == "waveform" and result.waveforms == between.pulses == len(block)
    assert (between.matched, between.missed, between.extra) == (
        len(differences), len(b) - len(differences), len(a) - len(differences)
    )  # fmt: skip
    assert between.exact_count == exact / len(block)
    assert (between.counts_a, between.counts_b) == tuple(dict(sorted(one.items())) for one in counts)
    assert "echo_time" not in between.differences  # would be the same figures
    spread = between.differences["time"]
    assert spread.median == pytest.approx(np.median(differences), abs=1e-9)
    assert spread.rms == pytest.approx(np.sqrt(np.mean(np.square(differences))), rel=1e-9)
    nmad = 1.4826 * np.median(np.abs(differences - np.median(differences)))
    assert spread.nmad == pytest.approx(nmad, rel=1e-6)
    assert between.gain == pytest.approx(len(a) / len(b) - 1)
    assert result.returns == len(block.returns)
    parts = match_sides(mixed / "s.las", *sides, block_size=97)
    assert parts.between.differences["time"].rms == pytest.approx(spread.rms, rel=1e-12)
    assert parts.vendor["b"].missed_by == result.vendor["b"].missed_by
    assert parts.fit["a"]["multi"].median == result.fit["a"]["multi"].median
    assert parts.fit["b"]["all"].mean == pytest.approx(result.fit["b"]["all"].mean, rel=1e-12)


def test_a_chain_and_its_own_cloud_are_identical(mixed):
    cloud = mixed / "accurate" / "s.laz"
    for sides in (("accurate", str(cloud)), (str(cloud), "accurate")):
        result = match_sides(mixed / "s.las", *map(find_contender, sides))
        assert result.between.matched_by == "gps_time"
        assert (result.between.missed, result.between.extra) == (0, 0)
        assert result.between.differences["echo_width"].rms < 1e-6
        chain, other = ("a", "b") if sides[0] == "accurate" else ("b", "a")
        assert result.fit[other] == {} and result.fit[chain]["all"].waveforms > 600
        assert set(result.vendor) == {chain}


def test_a_part_of_the_strip_and_a_saved_survey(mixed, tmp_path):
    call("survey", mixed / "s.las", "-o", tmp_path / "system.toml")
    text = call("compare", "--strip", mixed / "s.las", "fast", "auto", "--limit", 200, "--system",
                tmp_path / "system.toml", "--json").stdout  # fmt: skip
    document = json.loads(text)
    assert document["waveforms"] == document["pulses"] == 200
    assert document["fit"]["a"]["both"]["mean"] > 0 and document["vendor"]["b"]["missed"] >= 0
    assert document["b"] == "auto" and "NaN" not in text


def test_text_has_every_table(mixed):
    out = " ".join(call("compare", "--strip", mixed / "s.las", "fast", mixed / "accurate" / "s.laz").stdout.split())
    for words in ("identical, of all", "more points", "missed, of B's", "extra, of A's", "return 1 of 2", "flag ",
                  "/waveform", "mean E0", "A single", "B no-data"):  # fmt: skip
        assert words in out, words
    call("compare", "--strip", mixed / "s.las", "fast", "accurate", "--min-completeness", 1.0, code=1)


@pytest.mark.slow
def test_what_the_readme_says_of_the_real_strip(riegl):
    """The after-pulse of nearly every echo is a second maximum: the ASDF passes over it, the pulse explains it."""
    chains = {
        "maxima": make_chain("maximum", "gaussian"),
        "asdf": make_chain("asdf", "asdf_only"),
        "adaptive": make_chain("maximum", "adaptive"),
    }
    one = match_sides(riegl, *(Contender(name, chains[name]) for name in ("maxima", "asdf")))
    two = match_sides(riegl, *(Contender(name, chains[name]) for name in ("maxima", "adaptive")))
    assert one.between.counts_a[2] > 0.55 * 2375 and one.between.counts_b[1] > 0.9 * 2375
    for result in (one, two):
        number, of = result.between.extra_by["flag"]["RINGING_SUSPECT"]
        assert number > 0.97 * of and number > 0.75 * result.between.extra
        assert result.between.completeness > 0.9 and result.between.differences["time"].nmad < 0.02
    assert two.vendor["b"].missed < one.vendor["a"].missed < one.vendor["b"].missed
    assert two.fit["b"]["all"].median < two.fit["a"]["all"].median < 0.5 * one.fit["b"]["all"].median
    assert (one.waveforms, one.returns) == (2375, 2535)
    assert two.vendor["b"].completeness > 0.99 and 0.03 < two.vendor["b"].gain < 0.12
    with pytest.raises(InputError):
        match_sides(riegl, Contender("auto"), find_contender(str(riegl.with_suffix(".wdp"))))


FINE = 100.0
LEARNED = ((1.0, 0.0, 2.0), (0.12, 7.0, 2.0))


def record(y, std):
    block = WaveformBlock.from_samples(np.rint(2000 + FINE * y).astype(np.uint16))
    return block, Noise(np.full(len(y), 2000, np.float32), np.full(len(y), FINE * std, np.float32))


def decompose(name, block, noise, system, **parameters):
    step = Step(STAGES[f"decompose.{name}"], parameters)
    candidates = STAGES["detect.maximum"].function(block, noise, system)
    return step, step.stage.function(block, noise, system, candidates, **parameters)


def test_every_decomposer_says_what_it_fits():
    steps = [Step(stage) for stage in STAGES.values() if stage.kind == "decompose"]
    unfitted = {step.stage.name for step in steps if fitted_pulse(step, SystemPulse(2.0), 1.0) is None}
    assert unfitted == {"decompose.none"}


CASES = [(name, {}, {}) for name in ("closed_form", "gaussian", "residual_loop", "asdf_only")]
CASES += [("adaptive", {}, {}), ("adaptive", {}, {"components": LEARNED}), ("reference", {}, {"components": LEARNED})]
CASES += [("reference", {"model": "stretched"}, {"components": LEARNED})]
CASES += [("generalized_gaussian", {}, {}), ("residual_loop", {"model": "generalized"}, {})]
CASES += [("residual_loop", {"model": "learned"}, {"components": LEARNED})]
CASES += [("residual_loop", {"model": "skewed"}, {"kappa": 0.12}), ("skewed", {"kappa": "free"}, {"kappa": 0.12})]
CASES += [("skewed", {}, {"kappa": 0.12}), ("skewed", {"kappa": 0.12}, {}), ("adaptive", {}, {"kappa": 0.12})]


def test_what_was_not_fitted_is_no_data():
    x = np.arange(80.0)
    block, noise = record(100 * naive.pulse(x, 30.0, 2.0)[None], std=0.05)
    step, found = decompose("none", block, noise, SystemPulse(2.0))
    assert len(found) and rebuild_waveforms(block, SystemPulse(2.0), step, found) is None
    misfit, floor = measure_fit(block, noise, SystemPulse(2.0), step, found)
    assert np.isnan(misfit).all() and np.isnan(floor).all()
    quality = FitQuality()
    quality.add(misfit, floor, found.count(1), np.ones(1, bool))
    assert quality.result() == {}


def test_as_a_loop_does_it(rng):
    """Waveforms with 0 to 3 Gaussian echoes, some clipped: E, E0, means and medians of the classes."""
    n, s, top = 300, 64, 255
    count = rng.integers(0, 4, n)
    waveform = np.repeat(np.arange(n), count)
    time, amplitude, sigma = (rng.uniform(*ends, len(waveform)) for ends in ((5, 59), (10, 300), (1.5, 3)))
    order = np.lexsort((time, waveform))
    echoes = EchoTable.build(waveform[order], time[order], amplitude[order], sigma[order])
    baseline, std = rng.uniform(8, 12, n).astype("f4"), rng.uniform(0.5, 2, n).astype("f4")
    x = np.arange(float(s))
    samples = np.zeros((n, s), np.uint8)
    naive_e, naive_floor = np.full(n, np.nan), np.full(n, np.nan)
    for w in range(n):
        mine = np.flatnonzero(waveform == w)
        f = sum((amplitude[m] * naive.pulse(x, time[m], sigma[m]) for m in mine), np.zeros(s))
        samples[w] = np.clip(np.rint(baseline[w] + f + std[w] * rng.standard_normal(s)), 0, top)
        used = samples[w] < top
        if len(mine):
            naive_e[w] = ((f - (samples[w] - float(baseline[w])))[used] ** 2).sum() / (f[used] ** 2).sum()
            naive_floor[w] = used.sum() * float(std[w]) ** 2 / (f[used] ** 2).sum()
    assert (samples == top).any()
    block = WaveformBlock.from_samples(samples)
    step = Step(STAGES["decompose.gaussian"])
    misfit, floor = measure_fit(block, Noise(baseline, std), SystemPulse(2.0), step, echoes)
    np.testing.assert_allclose(misfit, naive_e, rtol=1e-4)
    np.testing.assert_allclose(floor, naive_floor, rtol=1e-5)
    quality, both = FitQuality(), (count > 0) & (rng.random(n) < 0.5)
    for part in np.array_split(np.arange(n), 7):
        quality.add(misfit[part], floor[part], count[part], both[part])
    found = quality.result()
    for name, rows in (("all", count > 0), ("single", count == 1), ("multi", count > 1), ("both", both)):
        assert found[name].waveforms == rows.sum()
        assert found[name].mean == pytest.approx(naive_e[rows].mean(), rel=1e-4)
        assert found[name].median == pytest.approx(np.median(naive_e[rows]), rel=1e-4)
        assert found[name].floor_mean == pytest.approx(naive_floor[rows].mean(), rel=1e-4)
        assert found[name].floor_median == pytest.approx(np.median(naive_floor[rows]), rel=1e-4)


WANG = [(0.104, 0.0214, 0.0089, 0.0069), (0.184, 0.0158, 0.0100, 0.0037), (0, 0.0097, 0.0014, 0.0014)]
WANG += [(0.05, 0.0186, 0.0058, 0.0052)]


def test_the_floor_is_that_of_single_samples_where_noise_is_coloured():
    """Thresholds use what noise does to a pulse: E0 was .116 on a strip whose fits leave .024."""
    block, noise = record(100 * naive.pulse(np.arange(60.0), 30.0, 2.0)[None], std=1.0)
    echo = EchoTable.build(np.zeros(1), np.array([30.0]), np.array([100 * FINE]), np.array([2.0]))
    step = Step(STAGES["decompose.gaussian"])
    plain = measure_fit(block, noise, SystemPulse(2.0, noise=ReceiverNoise(std=1.6)), step, echo)[1]
    system = SystemPulse(2.0, noise=ReceiverNoise(std=1.6, by_kind={"quiet": 0.8}))
    coloured = measure_fit(block, noise, system, step, echo)[1]
    assert coloured == pytest.approx(plain / 4, rel=1e-5)


def test_floor_of_the_specification():
    """0.00159 for 60 samples, amplitude over noise 100, sigma 2.123."""
    block, noise = record(100 * naive.pulse(np.arange(60.0), 30.0, 2.123)[None], std=1.0)
    echo = EchoTable.build(np.zeros(1), np.array([30.0]), np.array([100 * FINE]), np.array([2.123]))
    misfit, floor = measure_fit(block, noise, SystemPulse(2.123), Step(STAGES["decompose.gaussian"]), echo)
    assert floor[0] == pytest.approx(0.00159, abs=1e-5)
    assert misfit[0] < 1e-6
