"""Chains against chains, clouds and the vendor's returns on one strip: loops, known truth, Wagner's tables (T6)."""

import json

import naive
import numpy as np
import pytest
from commands import run_command

from wavebatch.core.errors import InputError
from wavebatch.core.system import ReceiverNoise
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.chain import STAGES, Chain, Step
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.choose_chain import read_sample
from wavebatch.tools.compare import chains
from wavebatch.tools.compare.chains import ChainRun, Contender, find_contender, match_chains, match_sides
from wavebatch.tools.compare.clouds import compare_clouds


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


def wagner_waveforms(n, seed):
    """The waveforms of the reproduction in docs/algorithms.md 1.1."""
    rng, x = np.random.default_rng(seed), np.arange(120.0)
    y = np.zeros((n, 120))
    for w, k in enumerate(1 + rng.choice(5, n, p=[0.58, 0.30, 0.09, 0.025, 0.005])):
        sigma = 2 * np.sqrt(1 + (0.105 if k == 1 else 0.35) * np.abs(rng.standard_normal(k)))
        amplitude = np.clip(25 * np.exp(0.8 * rng.standard_normal(k)), 5, 230)
        y[w] = sum(a * naive.pulse(x, t, s) for a, t, s in zip(amplitude, rng.uniform(10, 110, k), sigma, strict=True))
    return WaveformBlock.from_samples(np.rint(20 + y + rng.standard_normal(y.shape)).astype(np.uint16))


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


def test_two_chains_as_a_loop_over_waveforms_finds_it(mixed, monkeypatch):
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
    spread = between.differences["time"]
    assert spread.median == pytest.approx(np.median(differences), abs=1e-9)
    assert spread.rms == pytest.approx(np.sqrt(np.mean(np.square(differences))), rel=1e-9)
    nmad = 1.4826 * np.median(np.abs(differences - np.median(differences)))
    assert spread.nmad == pytest.approx(nmad, rel=1e-6)
    assert between.gain == pytest.approx(len(a) / len(b) - 1)
    assert result.returns == len(block.returns)
    monkeypatch.setattr(chains, "_BLOCK", 97)
    parts = match_sides(mixed / "s.las", *sides)
    assert parts.between.differences["time"].rms == pytest.approx(spread.rms, rel=1e-12)
    assert parts.vendor["b"].missed_by == result.vendor["b"].missed_by
    assert parts.fit["a"]["multi"].median == result.fit["a"]["multi"].median
    assert parts.fit["b"]["all"].mean == pytest.approx(result.fit["b"]["all"].mean, rel=1e-12)


@pytest.mark.parametrize("seed", [11, 12])
def test_tables_of_wagner_et_al(seed):
    """T6: Gaussian decomposition with ASDF: 80 % and more identical, |median| < 0.002 ns, rms 0.10 to 0.16 ns."""
    block = wagner_waveforms(4000, seed)
    system = SystemPulse(2.0, noise=ReceiverNoise(baseline=20.0, std=1.04))
    chains = make_chain("maximum", "gaussian"), make_chain("asdf", "none", rule="paper", interpolation="parabola")
    runs = {key: ChainRun(chain, system, 1.0) for key, chain in zip("ab", chains, strict=True)}
    found = match_chains(iter([block.rows(slice(0, 2500)), block.rows(slice(2500, None))]), runs, ("GD", "ASDF"), 1.0)
    assert found.identical >= 0.80
    assert abs(found.differences["time"].median) < 0.002
    assert 0.10 < found.differences["time"].rms < 0.16
    assert found.differences["time"].nmad < 0.02
    assert sum(found.counts_a.values()) == sum(found.counts_b.values()) == 4000
    assert runs["b"].fit.result() == {}
    fit = runs["a"].fit.result()
    assert 0.9 < fit["single"].mean / fit["single"].floor_mean < 1.05


def test_a_fit_with_the_right_number_of_echoes_is_at_the_noise_floor(mixed):
    fit = match_sides(mixed / "s.las", find_contender("fast"), find_contender("accurate")).fit
    assert fit["b"]["all"].mean == pytest.approx(fit["b"]["all"].floor_mean, rel=0.1)
    assert fit["a"]["multi"].mean > 1.5 * fit["a"]["multi"].floor_mean
    assert fit["a"]["both"].waveforms == fit["b"]["both"].waveforms <= fit["a"]["all"].waveforms


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


def test_the_vendors_returns_as_a_cloud_has_them(mixed):
    for profile in ("fast", "accurate"):
        cloud = compare_clouds(mixed / profile / "s.laz", mixed / "s.las")
        alone = match_sides(mixed / "s.las", find_contender(profile))
        for one in (alone.between, alone.vendor["a"]):
            # A cloud's positions are rounded to its scale: a pair at the very tolerance may be one there only.
            assert abs(one.matched - cloud.matched) <= 2
            assert one.matched + one.missed == cloud.matched + cloud.missed == alone.returns
            assert one.matched + one.extra == cloud.matched + cloud.extra
        assert alone.between.b == str(mixed / "s.las")
        flags = alone.between.extra_by["flag"]
        assert flags["ADDED"][0] == flags["ADDED"][1] <= alone.between.extra
        missed = alone.between.missed_by
        assert sum(number for number, _ in missed["return"].values()) == alone.between.missed
        assert sum(of for _, of in missed["amplitude"].values()) == alone.returns
        assert alone.fit["a"]["both"].waveforms == 0


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


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["fast", "accurate"], "--strip STRIP"),
        (["none.toml", "s.las"], "--strip STRIP"),
        (["s.las", "s.las", "--limit", 5], "--limit is for chains"),
        (["s.las", "s.las", "--system", "x.toml"], "--system is for chains"),
        (["fast", "--strip", "s.las", "--truth", "t.npz"], "--truth is for a cloud"),
        (["fast", "fast/s.laz", "--strip", "s.las", "--limit", 5], "leave --limit out"),
        (["fast/s.laz", "--strip", "s.las"], "without --strip"),
        (["fast/s.laz", "accurate/s.laz", "--strip", "s.las"], "without --strip"),
        (["fast", "none.toml", "--strip", "s.las"], "none.toml"),
        (["fast", "none.las", "--strip", "s.las"], "none.las"),
        (["fast", "accurate", "--strip", "none.las"], "none.las"),
        (["fast", "accurate", "--strip", "fast/s.laz"], "s.laz"),
        (["fast", "accurate", "--strip", "s.las", "--tolerance", 0], "tolerance"),
    ],
)
def test_wrong_use_is_one_line_and_exit_code_2(mixed, monkeypatch, arguments, words):
    monkeypatch.chdir(mixed)
    result = call("compare", *arguments, code=2)
    assert words in result.stderr.splitlines()[-1]


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
