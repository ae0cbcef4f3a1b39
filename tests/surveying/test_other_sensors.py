"""Surveys and chains of sensors that the simulator does not have: other pulses, noise and baselines, rendered here."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.files.text_file import write_text
from wavebatch.kernels.fit.pulse_shape import PulseShape, measure_pulse
from wavebatch.stages.chain import STAGES, load_profile
from wavebatch.surveying import Survey, survey_block, survey_blocks
from wavebatch.surveying.choose_chain import choose_chain
from wavebatch.surveying.measuring import choose_pulse
from wavebatch.surveying.measuring.choose_pulse import settle
from wavebatch.surveying.measuring.joint_pulse import learn_jointly
from wavebatch.surveying.measuring.judge import explain
from wavebatch.surveying.systems.survey_result import SavedSurvey, format_survey, load_survey, parse_survey


def flat_top(x):
    return np.exp(-0.5 * (np.abs(x) / 1.15) ** 4)


def skewed(x):
    """Log-normal with the steep side first; half width as that of a Gaussian of width 1, to 1 %."""
    return np.exp(-0.5 * (np.log(np.maximum(1 + 0.15 * x, 1e-9)) / 0.15) ** 2)


def gaussian(x):
    return np.exp(-0.5 * x * x)


def broaden(pulse, sigma):
    """The pulse convolved with a Gaussian of this width, peak 1 at 0."""
    x = np.arange(-30, 30, 0.02)
    kernel = np.exp(-0.5 * (np.arange(-6 * sigma, 6 * sigma, 0.02) / sigma) ** 2)
    wide = np.convolve(pulse(x), kernel, "same")
    top = np.argmax(wide)
    return lambda z: np.interp(z, x - x[top], wide / wide[top], left=0, right=0)


def record(pulse, seed, *, n=2500, s=80, width=2.0, noise=1.0, amplitude=(10, 200), wide=0.0, dtype="u1"):
    """One echo per waveform: block, times [samples], amplitudes. wide: share of echoes that targets widened."""
    rng = np.random.default_rng(seed)
    time = rng.uniform(0.3 * s, 0.6 * s, n)
    height = np.exp(rng.uniform(*np.log(amplitude), n))
    x = (np.arange(s) - time[:, None]) / width
    signal = pulse(x)
    rows = np.flatnonzero(rng.random(n) < wide)
    signal[rows] = broaden(pulse, 0.8)(x[rows])
    samples = 12.0 + height[:, None] * signal + noise * rng.standard_normal((n, s))
    top = np.iinfo(dtype).max
    return WaveformBlock.from_samples(np.clip(np.rint(samples), 0, top).astype(dtype)), time, height


def judge(block, time):
    """System, echoes, share of waveforms with exactly one echo, and those echoes' time errors less their median."""
    survey = survey_block(block)
    echoes = choose_chain(survey).run(block, survey.system)
    one = echoes.count(len(block)) == 1
    error = echoes.time[one[echoes.waveform]] - time[one]
    return survey.system, echoes, one.mean(), error - np.median(error)


@pytest.mark.quick_cases("2")
@pytest.mark.parametrize("seed", [1, 2])
def test_flat_tops_are_learned_and_found(seed):
    block, time, _ = record(flat_top, seed)
    system, _, whole, error = judge(block, time)
    assert system.noise.std == pytest.approx(1.04, rel=0.15)
    assert whole > 0.94 and np.std(error) < 0.12


@pytest.mark.quick_cases("0.2")
@pytest.mark.parametrize("noise", [0.0, 0.2])
def test_counts_that_hardly_scatter_do_not_spoil_the_pulse(noise):
    block, time, height = record(gaussian, 3, noise=noise, wide=0.3)
    system, echoes, whole, _ = judge(block, time)
    assert system.noise.std < 0.45 and system.sigma_ref == pytest.approx(2.0, rel=0.01)
    assert whole > 0.98
    alone = echoes.count(len(block))[echoes.waveform] == 1
    ratio = echoes.amplitude[alone] / height[echoes.waveform[alone]]
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [4, 5])
def test_noise_on_a_broad_top_is_no_echo(seed):
    block, time, _ = record(gaussian, seed, n=1500, s=300, width=10.0, wide=0.3)
    _, echoes, whole, _ = judge(block, time)
    assert whole > 0.985
    assert not (echoes.flags & int(EchoFlag.MERGED)).any()


@pytest.mark.slow
@pytest.mark.parametrize("mirror", [1, -1])
def test_widened_echoes_of_skewed_pulses_stay_whole(mirror):
    """A target adds its own shape to a pulse; it does not stretch it."""
    block, time, _ = record(lambda x: skewed(mirror * x), 6, n=4000, amplitude=(30, 200), wide=0.4)
    _, _, whole, _ = judge(block, time)
    assert whole > 0.98


def test_half_widths_of_any_sum_rise_with_its_width():
    """Two Gaussians with a dip between them: narrower ones have a lower peak and therefore a larger half width."""
    lobes = ((0.86, 1.92, -0.33), (0.6, -1.54, -0.55), (-0.17, 3.23, -0.83), (-0.13, -2.65, -0.9))
    shape = PulseShape(components=lobes)
    table = measure_pulse(shape, 0.985, 4.7)
    assert (np.diff(table.half_width) > 0).all()
    plain = measure_pulse(PulseShape(components=((0.1, 5.0, 1.0),)), 0.7, 4.0)
    assert plain.half_width == pytest.approx(2.354820 * plain.width, rel=0.05)


def drifting(seed, *, drift, noise, n=3000, top=200):
    """A strip of Gaussian echoes whose baseline rises by `drift` counts from its first to its last waveform."""
    rng = np.random.default_rng(seed)
    time, height = rng.uniform(20, 50, n), np.exp(rng.uniform(np.log(10 * noise), np.log(top), n))
    base = 40 + drift * np.linspace(0, 1, n)
    signal = height[:, None] * gaussian((np.arange(80) - time[:, None]) / 2.0)
    samples = base[:, None] + signal + noise * rng.standard_normal((n, 80))
    return WaveformBlock.from_samples(np.clip(np.rint(samples), 0, 65535).astype(np.uint16)), time, base


@pytest.mark.quick_cases("2-0.4-200")
@pytest.mark.parametrize(("drift", "noise", "top"), [(20, 1.0, 200), (300, 3.0, 3000), (2, 0.4, 200)])
def test_baselines_that_drift_along_the_strip_hide_no_echo(drift, noise, top):
    block, time, base = drifting(7, drift=drift, noise=noise, top=top)
    system, _, whole, error = judge(block, time)
    assert system.noise.std == pytest.approx(np.hypot(noise, 0.289), rel=0.05)
    assert system.noise.baseline_spread == pytest.approx(drift / np.sqrt(12), rel=0.05)
    assert whole > 0.985
    found = STAGES["noise.pooled"].function(block, system).baseline - base
    assert np.sqrt(np.mean(found**2)) < 0.3 * np.hypot(noise, 0.289)


def digitized(block, index, **changes):
    """The block as another digitizer's."""
    return replace(block, digitizer=replace(block.digitizer, index=index, **changes))


def test_digitizers_that_record_otherwise_get_a_pulse_and_noise_of_their_own():
    wide = digitized(record(gaussian, 8, n=1500)[0], 1)
    narrow, time, _ = record(gaussian, 9, n=600, s=48, width=1.2, amplitude=(300, 9000), noise=8.0, dtype="u2")
    narrow = digitized(narrow, 4)
    low = digitized(WaveformBlock.from_samples(record(gaussian, 10, n=12)[0].samples + np.uint8(30)), 5)
    survey = survey_blocks([narrow, wide, low])
    system = survey.system
    assert set(system.digitizers) == {4, 5}
    assert system.sigma_ref == pytest.approx(2.0, rel=0.02) and system.of(wide) is system
    own = system.of(narrow)
    # Of the noise of 8 DN about a level of 12 DN, counts from 0 on keep 7.6: it is that before the cut.
    assert own.sigma_ref == pytest.approx(1.2, rel=0.02) and own.noise.std == pytest.approx(8.0, rel=0.02)
    # Twelve waveforms are too few for a pulse, but enough for a level.
    few = system.of(low)
    assert few.sigma_ref == system.sigma_ref and few.noise.baseline == pytest.approx(42, abs=0.3)
    echoes = choose_chain(survey).run(narrow, system.with_radiometry(divergence=0.5))
    single = echoes.count(len(narrow)) == 1
    assert single.mean() > 0.98
    assert np.std((echoes.time - time[echoes.waveform])[single[echoes.waveform]]) < 0.1
    assert system.with_radiometry(divergence=0.5).of(narrow).radiometry.divergence == 0.5
    assert survey.waveforms == 2112 and survey.figures.single_share > 0.98


def test_shares_of_the_scene_are_those_of_all_digitizers():
    seen, empty = record(gaussian, 8, n=600)[0], record(gaussian, 9, n=200, amplitude=(0.1, 0.2))[0]
    found = survey_blocks([digitized(seen, 1), digitized(empty, 2, gain=0.1)], learn=False).figures
    assert found.empty_share == pytest.approx(0.25, abs=0.01) and found.single_share == pytest.approx(0.75, abs=0.01)


def test_a_digitizer_with_few_echoes_asks_of_weak_echoes_what_its_own_noise_does():
    """The main one's noise is a ten-thousandth of its echoes; the other's is a two-hundredth."""
    main = digitized(record(gaussian, 8, n=1500, amplitude=(5000, 20000), dtype="u2")[0], 1)
    few = digitized(record(gaussian, 9, n=12, amplitude=(150, 600), noise=3.0, dtype="u2")[0], 2, gain=0.1)
    system = survey_blocks([main, few]).system
    assert set(system.digitizers) == {2} and system.of(few).sigma_ref == system.sigma_ref
    assert system.faint_share < 0.01 < 0.013 < system.of(few).faint_share <= 0.02


@pytest.mark.slow
def test_digitizers_that_record_alike_share_what_is_learned():
    """As scanners do that write one descriptor per length of a waveform."""
    blocks = [digitized(record(skewed, seed, n=900, s=s)[0], index) for index, seed, s in ((1, 1, 80), (2, 2, 64))]
    assert survey_blocks(blocks).system.digitizers == {}


def test_systems_of_digitizers_are_saved(tmp_path):
    noise = ReceiverNoise(baseline=300.0, by_kind={"quiet": 8.0})
    own = SystemPulse(1.2, noise=noise, components=((1.0, 0.0, 1.2), (0.1, 5.0, 1.0)))
    survey = Survey(SystemPulse(2.0, digitizers={4: own, 9: SystemPulse(3.0)}), 5)
    path = tmp_path / "system.toml"
    write_text(path, format_survey(SavedSurvey(survey)), overwrite=False)
    assert load_survey(path).survey == survey
    text = path.read_text()
    wrong = {
        "index = 4\n": "index 4 has two tables",
        "index = 0\n": "index must lie between 1 and 255",
        "": "key 'index' is missing",
    }
    for new, words in wrong.items():
        with pytest.raises(ConfigError, match=rf"\[system\]: \[\[digitizers\]\] 2: {words}"):
            parse_survey(text.replace("index = 9\n", new), "x.toml")


@pytest.mark.slow
@pytest.mark.parametrize(("share", "seed"), [(0.12, 11), (0.2, 12)])
def test_after_pulses_of_every_echo_belong_to_the_pulse_however_high(share, seed):
    block, time, _ = record(lambda x: gaussian(x) + share * gaussian(x - 5.0), seed, amplitude=(15, 200))
    system, _, whole, _ = judge(block, time)
    assert system.ringing == pytest.approx(share, abs=0.01) and system.sigma_ref == pytest.approx(2.0, rel=0.01)
    assert whole > 0.985


def test_tails_far_below_a_thousandth_are_known_where_echoes_are_so_high():
    """1.5e-4 of 40,000 noises are six: 37 % of the waveforms had an echo there, 13 % have."""

    def tailed(x):
        return skewed(x) + 1.5e-4 * gaussian(x - 6.5)

    block, time, _ = record(tailed, 3, n=600, s=64, width=2.3, amplitude=(4e3, 4e4), dtype="u2")
    assert judge(block, time)[2] > 0.85


def search_misfit(monkeypatch, cost, loud, change, whitening=()):
    """Misfit and doubt where a misfit at a place costs so much, and the places that were looked at."""
    scatter, looked = np.resize([1.0, -1.0], 100), []

    def explain_between(block, system, changes, found, place):
        explained = SimpleNamespace(place=place, echoes=range(100 + int(max(place, 0))))
        return choose_pulse.Looked(explained, (np.empty(0), np.empty(0)))

    def describe(block, system, explained, changes, left):
        looked.append(explained.place)
        here = np.interp(explained.place, list(cost), list(cost.values()))
        return [np.full(100, here / 100) + (5.0 if explained.place == loud else 0.3) * scatter]

    monkeypatch.setattr(choose_pulse, "describe_waveforms", describe)
    monkeypatch.setattr(choose_pulse, "_explain_between", explain_between)
    block, system = record(gaussian, 5, n=100)[0], SystemPulse(2.0, noise=ReceiverNoise(whitening=whitening))
    found, doubt, _ = choose_pulse._choose_misfit(block, lambda misfit: replace(system, misfit=misfit), 0.0, change)
    return found.misfit, doubt, looked


def test_no_misfit_is_looked_for_below_none(monkeypatch):
    """Its neighbours may describe shorter, but by less than one error: then it is none, not one beyond the largest."""
    cost = {0: 0, 1: -5, 2: -12, 3: -13, 4: 0, 6: 0, 8: 40}
    misfit, doubt, looked = search_misfit(monkeypatch, cost, 3, 0.0)
    assert misfit == 0.0 and doubt == pytest.approx(4 / 103)
    assert set(looked) <= set(cost)


def test_none_is_taken_only_where_it_was_looked_at(monkeypatch):
    """From a change of 1 % on it begins above; what is looked at last may make the least of these as good as any."""
    cost = {0: 900, 1: 700, 2: 500, 3: 40, 4: 40, 5: -5, 6: 0, 7: 20, 8: 60}
    misfit, _, looked = search_misfit(monkeypatch, cost, 5, 0.01)
    assert choose_pulse.MISFITS[2] < misfit <= choose_pulse.MISFITS[3] and 2 in looked


def test_the_least_misfit_is_looked_for_between_those_that_are_doublings(monkeypatch):
    """A description falls from misfit to misfit as it likes: a curve through coarse ones was off by a third."""
    cost = {0: 300, 1: 200, 2: 100, 3: 30, 3.5: 28, 3.75: 1, 4: 0, 5: 40, 6: 60, 8: 200}
    misfit, _, looked = search_misfit(monkeypatch, cost, None, 0.0)
    assert {3.5, 3.75} <= set(looked)
    assert 3.5 < np.log2(misfit / choose_pulse.MISFITS[0]) <= 3.75
    whitened = search_misfit(monkeypatch, cost, None, 0.0, (0.6, 0.0))[0]
    assert whitened == choose_pulse.MISFITS[4], "less than the shortest makes echoes of what the pulse lacks"


@pytest.mark.parametrize(
    ("errors", "echoes", "known", "answered", "taken"),
    [
        (1.0, 100, False, 100, False), (2.0, 100, False, 100, True),  # as many, in place of a learned pulse: HINT
        (2.0, 103, False, 100, False), (4.0, 103, False, 100, True),  # some more: SURE
        (2.0, 90, False, 90, True), (1.0, 90, False, 90, False),  # fewer, in place of a learned pulse: HINT
        (2.0, 90, True, 90, False),  # in place of a known one
        (4.0, 110, True, 100, False), (5.0, 110, True, 100, True),  # more: both
        (4.0, 160, True, 140, False), (2.0, 160, True, 160, True),  # the first one sees 71 and 62 % of the waveforms
        (3.0, 110, True, 16, True), (2.7, 110, True, 16, False),  # 16 waveforms with an echo cannot show more
    ],
)  # fmt: skip
def test_a_pulse_with_more_echoes_must_describe_shorter_by_more(errors, echoes, known, answered, taken):
    """Two pulses as simple: the second is described shorter by so many standard errors."""
    spread = 0.5 * np.resize([1.0, -1.0], 400)
    seen = min(answered, 100)
    first = choose_pulse.Candidate("first", SystemPulse(2.0), 0.0, 50 + 0 * spread, 100, seen, known, 2, 0.0)
    length = first.length - errors * 0.5 / np.sqrt(400) + spread
    second = choose_pulse.Candidate("second", SystemPulse(2.2), 0.0, length, echoes, answered, True, 3, 0.0)
    assert second.name == choose_pulse._decide([first, second]).best.name or not taken
    assert taken or choose_pulse._decide([first, second]).best.name == "first"


def test_a_pulse_that_another_one_had_replaced_may_beat_its_successor():
    """The first needs fewer echoes than the shortest, by too few errors; a blind one beats it, and is beaten itself."""
    spread = 0.5 * np.resize([1.0, -1.0], 400)
    rows = ("shortest", 0 * spread, 200, 150), ("blind", 0.05 + spread, 80, 60), ("first", 0.2 + 2 * spread, 180, 140)
    found = [
        choose_pulse.Candidate(name, SystemPulse(2.0), 0.0, 50 + more, echoes, answered, False, 1, 0.0)
        for name, more, echoes, answered in rows
    ]
    assert choose_pulse._decide(found).best.name == "shortest"
    assert choose_pulse._decide([found[0], found[2]]).best.name == "first"


def test_a_known_pulse_gives_way_to_what_beats_it_itself():
    """A wide one beats it, by half a nat; one as wide as the known one saves a nat of the two that are asked for."""
    spread = 0.1 * np.resize([1.0, -1.0], 400)
    rows = ("known", 1.0, 2.0, True, 2), ("wide", 0.5, 2.4, False, 6), ("near", 0.0, 2.05, False, 6)
    found = [
        choose_pulse.Candidate(name, SystemPulse(width), 0.0, 50 + more + k * spread, 400, 400, known, gaussians, 0.0)
        for k, (name, more, width, known, gaussians) in enumerate(rows)
    ]
    assert choose_pulse._decide(found).best.name == "known"
    assert choose_pulse._decide(found[:2]).best.name == "wide" and choose_pulse._decide(found[1:]).best.name == "near"


@pytest.mark.parametrize(("answered", "doubted"), [(16, True), (100, False)])
def test_fewer_echoes_that_lose_for_want_of_waveforms_are_a_doubt(answered, doubted):
    """By 4 errors: many waveforms would have asked for 4.5, which so few cannot show."""
    spread = 0.5 * np.resize([1.0, -1.0], 400)
    wide, short = (
        choose_pulse.Candidate("", SystemPulse(width), 0.0, 50 + more, each * answered, answered, False, 1, 0.0)
        for width, more, each in ((2.2, 0.1 + spread, 1), (2.0, 0 * spread, 2))
    )
    choice = choose_pulse._decide([wide, short])
    assert choice.best is (short if doubted else wide) and choice.doubt == pytest.approx(0.5 if doubted else 1.0)


@pytest.mark.parametrize(("errors", "small", "doubt"), [(6, True, 0.1), (6, False, 0.0), (8, True, 0.0)])
def test_a_pulse_looks_too_good_to_the_waveforms_that_taught_it(errors, small, doubt):
    """One that needs a tenth fewer echoes loses by so many standard errors."""
    spread = 0.5 * np.resize([1.0, -1.0], 400)
    learned, other = (
        choose_pulse.Candidate("", SystemPulse(2.0), 0.0, 50 + more, echoes, 100, False, 1, 0.0)
        for more, echoes in ((0 * spread, 100), (errors * 0.5 / np.sqrt(400) + spread, 90))
    )
    choice = choose_pulse._decide([learned, other], small=small)
    assert choice.best is learned and choice.doubt == pytest.approx(doubt)


@pytest.mark.parametrize(
    ("repeated", "known", "echoes", "answered", "errors", "taken", "spread"),
    [(1.0, False, 390, 400, 0, "half", 0.5**0.5), (1.0, False, 390, 400, 1, "half", 0.614),
     (1.05, False, 390, 400, 2.9, "half", 0.12), (2.0, False, 390, 400, 0, "right", 0),
     (0.92, False, 390, 400, 2, "right", 0), (2.0, False, 390, 100, 0, "half", 0.5**0.5),
     (2.0, False, 390, 400, 4, "half", 0), (2.0, True, 390, 400, 0, "half", 0.5**0.5),
     (2.0, True, 410, 400, 0, "right", 0), (1.0, True, 410, 400, 0, "right", 0.5**1.5)],
)  # fmt: skip
def test_a_pulse_whose_echoes_repeat_another_width_must_be_shorter_for_sure(
    repeated, known, echoes, answered, errors, taken, spread
):
    """Than one whose echoes agree with it, and that sees them. Widths of others count as likely as they are. In a
    canopy echoes of a known pulse may all be wider: it is taken, but makes no other one a guess."""
    more = 0.5 * np.resize([1.0, -1.0], 400)
    half, right = (
        choose_pulse.Candidate(name, SystemPulse(width), 0.0, 50 + more, number, seen, of_other, 1, 0.0, own)
        for name, width, more, number, seen, of_other, own in (
            ("half", 1.0, 0 * more, echoes, 400, known, repeated),
            ("right", 2.0, errors * 0.025 + more, 400, answered, False, 1.0),
        )
    )  # fmt: skip
    choice = choose_pulse._decide([half, right])
    assert choice.best.name == taken and choice.spread == pytest.approx(spread, abs=0.005) and len(choice.tried) == 2


@pytest.mark.quick_cases("160-2-gaps1-6-5-3", "40-*")
@pytest.mark.parametrize(
    ("n", "seed", "gaps", "echoes", "number", "taken"),
    [(160, 2, (1.2, 2.5), 3, 10, 9), (160, 2, (1.2, 2.5), 6, 5, 3), (40, 10, (1.2, 2.5), 3, 4, 3)],
)
def test_rounds_of_all_echoes_go_on_while_each_surely_saves(n, seed, gaps, echoes, number, taken):
    """At most eight further ones, by a quarter of a nat per echo and 1.5 errors; of them the shortest is taken."""
    rng, x = np.random.default_rng(seed), np.arange(120)
    samples, time = 12.0 + rng.standard_normal((n, 120)), rng.uniform(20, 30, (n, 1))
    for _ in range(echoes):
        samples += np.exp(rng.uniform(*np.log((20, 200)), (n, 1))) * skewed((x - time) / 2.5)
        time += 2.5 * rng.uniform(*gaps, (n, 1))
    block = WaveformBlock.from_samples(np.rint(np.maximum(samples, 0)).astype(np.uint16))
    taught, held = block.rows(slice(0, None, 2)), block.rows(slice(1, None, 2))
    judge_pulse = partial(choose_pulse._judge, held, change=choose_pulse.CHANGES[1], known=False)
    begin = judge_pulse("gaussian", SystemPulse(3.5, noise=ReceiverNoise(baseline=12.0, std=1.04)))
    rounds = [judge_pulse(*one) for one in choose_pulse._list_rounds(taught, begin)][1:]
    is_worth = True
    while is_worth and len(rounds) < 10:
        before, last = rounds[-2:]
        saved = len(held) * (before.typical - last.typical) / before.echoes
        is_worth = saved > 0.25 and before.exceeds(last) > 1.5
        if is_worth:
            explained = explain(taught, choose_pulse.bear(last.system, begin.change))
            system = learn_jointly(taught, last.system, explained, begin.change, choose_pulse.COUNTED)
            rounds.append(judge_pulse("", system))
    lengths = [one.typical for one in rounds]
    assert len(rounds) == number and int(np.argmin(lengths[1:])) + 1 == taken
    found = choose_pulse._learn(taught, held, begin)
    assert [one.typical for one in found[1:]] == [lengths[0], lengths[taken]]


def test_a_joint_pulse_that_teaches_no_other_stands_for_itself():
    """Twelve echoes are too few for a round."""
    block = record(gaussian, 5, n=12)[0]
    system = replace(survey_block(block, learn=False).system, components=((1.0, 0.0, 2.0), (0.02, 5.0, 2.0)))
    choice = choose_pulse.choose_pulse(block, {choose_pulse.JOINTLY: system})
    assert choice.best.name == choose_pulse.JOINTLY and choice.best.system.components == system.components


@pytest.mark.parametrize("name", [choose_pulse.OF_ALL, *choose_pulse.ROUNDS])
def test_what_was_learned_again_is_learned_from_all_waveforms_too(name):
    block = record(gaussian, 5, n=60)[0]
    system = survey_block(block, learn=False).system
    one = choose_pulse.Candidate(name, system, 0.0, np.ones(60), 60, 60, False, 1, 0.0)
    first, again = (replace(one, name=name + end) for end in ("", choose_pulse.AGAIN))
    learned = choose_pulse._learn_from_all(block, first).system
    assert choose_pulse._learn_from_all(block, again).system == learned != system


def test_the_misfit_is_at_least_what_the_pulse_misses_of_the_stack():
    block = record(gaussian, 5, n=400)[0]
    system = survey_block(block, learn=False).system
    for missed in (0.0, 0.02):
        found, _, _ = settle(block, system, EchoTable.build([], [], [], []), 0.0, missed)
        assert found.misfit == missed


@pytest.mark.slow
def test_what_is_left_of_few_echoes_is_learned_too():
    """A tail of 1.5 % of the amplitude, from about a hundred clear echoes."""

    def tailed(x):
        return gaussian(x) + 0.06 * gaussian((x - 5.5) / 1.2) + 0.015 * gaussian((x - 12) / 3)

    assert np.mean([judge(*record(tailed, seed, n=300)[:2])[2] for seed in range(20, 26)]) > 0.993


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "most"), [(13, 0.985), (14, 0.94)])
def test_echoes_that_the_receiver_compresses_stay_whole(seed, most):
    """R5: above two thirds of the range the pulse flattens, and fits like two. Few echoes are so high: their splits are
    hardly longer to describe, and the second strip keeps 6 % of them.
    """
    time, height = (np.random.default_rng(seed).uniform(low, high, 3000) for low, high in ((20, 50), (2.5, 5.3)))
    height = np.exp(height)
    signal = height[:, None] * gaussian((np.arange(80) - time[:, None]) / 2.0)
    noise = np.random.default_rng(seed + 100).standard_normal(signal.shape)
    block = WaveformBlock.from_samples(np.rint(12 + 250 * np.tanh(signal / 250) + noise).astype(np.uint8))
    system, echoes, whole, _ = judge(block, time)
    assert system.misfit <= 0.033 and system.acceptance <= 18
    strong = height > 150
    assert whole > most and (echoes.count(len(block)) == 1)[strong].mean() > (0.95 if most > 0.95 else 0.4)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [15, 16])
def test_pairs_of_strong_echoes_are_no_misfit(seed):
    """A quarter of all echoes are two targets, 1.5 to 2 widths apart: they are still two."""
    rng = np.random.default_rng(seed)
    n = 3000
    time, height, double = rng.uniform(20, 50, n), rng.uniform(15, 180, n), rng.random(n) < 0.25
    x = (np.arange(80) - time[:, None]) / 2.0
    signal = gaussian(x) + 0.7 * double[:, None] * gaussian(x - rng.uniform(1.5, 2.0, (n, 1)))
    counts = 12 + height[:, None] * signal + rng.standard_normal(x.shape)
    block = WaveformBlock.from_samples(np.clip(np.rint(counts), 0, 511).astype(np.uint16))
    survey = survey_block(block)
    number = choose_chain(survey).run(block, survey.system).count(n)
    assert survey.system.misfit < 0.005  # half the noise of the highest
    assert (number[double & (height > 60)] == 2).mean() > 0.95 and (number[~double] == 1).mean() > 0.98


def test_amplitudes_of_32_bits_are_not_split():
    """No echo was higher than 1e9 counts: 14 % extra echoes at 4e9; and single precision is coarser than this noise."""
    rng = np.random.default_rng(3)
    time, height = rng.uniform(25, 50, (1200, 1)), np.exp(rng.uniform(np.log(4e7), np.log(3.6e9), (1200, 1)))
    exact = 110 + height * np.exp(-0.5 * ((np.arange(80) - time) / 2) ** 2) + rng.normal(0, 1, (1200, 80))
    block = WaveformBlock.from_samples(np.rint(exact).astype(np.uint32))
    system = survey_block(block).system
    echoes = load_profile("accurate").run(block, system)
    assert system.sigma_ref == pytest.approx(2.0, rel=1e-3)
    assert len(echoes) == pytest.approx(1200, rel=0.002)
    assert echoes.amplitude.max() == pytest.approx(height.max(), rel=1e-3)
