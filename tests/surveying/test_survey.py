"""The survey finds what was simulated, and on real strips what is known of them."""

from dataclasses import replace

import numpy as np
import pytest
from helpers_scenes import make_block, make_scene

from wavebatch.core.waveforms import WaveformBlock
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying import join_digitizers, survey_block, survey_blocks
from wavebatch.surveying.choose_chain import choose_chain, read_sample
from wavebatch.surveying.measuring.noise_and_width import FIRST_LOOK
from wavebatch.surveying.measuring.residuals import decompose_again, decompose_sample
from wavebatch.tools.simulate import PulseModel, find_pulse


@pytest.mark.quick_cases("4.0")
@pytest.mark.parametrize("sigma", [0.5, 0.64, 0.85, 1.0, 1.4, 4.0, 10.0, 14.0])
def test_the_width_is_found_however_far_from_the_first_guess(sigma):
    scene = make_scene("flat", pulse=PulseModel(sigma=sigma), n_samples=max(80, int(20 * sigma)))
    system = survey_block(make_block(scene, 3000, seed=3)[0]).system
    # Half a sample is less than a width can be measured with (0.85): there it only has to be found.
    assert system.sigma_ref == pytest.approx(sigma, rel=0.03 if sigma > 0.5 else 0.1)
    assert system.noise.std == pytest.approx(scene.recording.recorded_noise, rel=0.02)


@pytest.mark.slow
@pytest.mark.parametrize("spacing", [0.5, 2.0])
def test_widths_are_in_ns_whatever_the_spacing(spacing):
    scene = make_scene("flat", spacing=spacing, n_samples=160)
    survey = survey_block(make_block(scene, 2500, seed=3)[0])
    assert survey.system.sigma_ref == pytest.approx(2.0, rel=0.02) and survey.figures.spacing_ns == spacing


@pytest.mark.quick_cases("leica-learned")
@pytest.mark.parametrize(
    ("pulse", "kind"), [("gaussian", "gaussian"), ("skewed", "skewed"), ("riegl", "learned"), ("leica", "learned")]
)
def test_the_simplest_pulse_that_serves_is_chosen(pulse, kind):
    scene = make_scene("flat", pulse=find_pulse(pulse), n_samples=100)
    survey = survey_block(make_block(scene, 4000, seed=4)[0])
    system = survey.system
    found = "learned" if system.components else "skewed" if system.kappa else "gaussian"
    assert found == kind
    if kind == "skewed":
        assert system.kappa == pytest.approx(0.1, abs=0.005)
    if pulse == "riegl":
        delays = [(delay, weight) for weight, delay, _ in system.components]
        after = min(delays, key=lambda pair: abs(pair[0] - 10.5))
        assert after[0] == pytest.approx(10.5, abs=0.5) and after[1] == pytest.approx(0.04, abs=0.01)
        assert system.ringing == pytest.approx(0.04, abs=0.01)
    needed = {decision.part: decision.needed for decision in survey.decisions}
    assert needed["sum of Gaussians"] is (kind == "learned") and needed["skewed pulse"] is (kind == "skewed")


@pytest.mark.slow
def test_signal_dependent_noise_and_clipping_are_found():
    scene = make_scene("urban", noise_gain=0.1, saturation=150)
    survey = survey_block(make_block(scene, 6000, seed=5)[0])
    assert survey.system.noise.gain == pytest.approx(0.1, rel=0.25)
    assert survey.system.saturation == 150 and 0 < survey.figures.saturated_share < 0.1
    assert survey.figures.largest_count == 150 and survey.figures.least_count >= 0
    needed = {decision.part: decision.needed for decision in survey.decisions}
    assert needed["censored fit"] and needed["signal-dependent weights"]


def test_the_range_of_counts_is_the_recorded_one_though_a_pattern_is_taken_off():
    block = make_block(make_scene("flat", baseline=3.0), 2000, seed=5)[0]
    samples = block.samples + np.where(np.arange(block.samples.shape[1]) % 2, 2, 0).astype(block.samples.dtype)
    block = replace(block, samples=samples)
    for survey in (survey_block(block), survey_blocks([block])):
        assert survey.system.defects.pattern
        counts = survey.figures.least_count, survey.figures.largest_count
        assert counts == (samples.min(), samples.max()) and samples.min() == 0


def test_waveforms_of_several_lengths_are_surveyed_together():
    flat, other = make_block("flat", 1000, seed=6)[0], make_block(make_scene("flat", n_samples=40), 1500, seed=6)[0]
    ends = [(other, 0, 700), (flat, 0, 600), (other, 700, 1500), (flat, 600, 1000)]
    parts = [block.rows(slice(start, stop)) for block, start, stop in ends]
    (joined,) = join_digitizers(parts)
    long = np.r_[700:1300, 2100:2500]
    assert joined.samples.shape == (2500, 80) and np.array_equal(joined.samples[long], flat.samples)
    assert not joined.missing[long].any() and joined.missing[:700, 40:].all() and not joined.missing[:700, :40].any()
    both, alone = survey_blocks(parts), survey_blocks([flat])
    assert both.waveforms == 2500 and both.system.digitizers == {}
    assert both.system.sigma_ref == pytest.approx(alone.system.sigma_ref, rel=0.01)
    assert both.system.noise.std == pytest.approx(alone.system.noise.std, rel=0.02)
    assert join_digitizers([]) == [] and survey_blocks([]).waveforms == 0


@pytest.mark.slow
@pytest.mark.quick_cases("0.2")
@pytest.mark.parametrize("gain", [0.0, 0.03, 0.2])
def test_the_growth_of_noise_is_not_what_the_fit_leaves_of_it(gain):
    scene = make_scene("flat", noise_gain=gain, pulse=find_pulse("leica"), n_samples=100)
    found = [survey_block(make_block(scene, 3000, seed=seed)[0]).system.noise.gain for seed in (6, 7, 8)]
    assert np.mean(found) == pytest.approx(gain, rel=0.15)


@pytest.mark.quick_cases("3.5-0.18")
@pytest.mark.parametrize(("width", "least"), [(1.2, 0.15), (2.0, 0.18), (3.5, 0.18)])
def test_noise_that_grows_most_where_the_fit_takes_most_is_put_back(rng, width, least):
    """In the middle of narrow echoes; 0.12 to 0.18 was found where 0.2 is true."""
    n, x = 4096, np.arange(80)
    light = 2 * rng.uniform(20, 80, (n, 1)) * np.exp(-0.5 * ((x - rng.uniform(15, 65, (n, 1))) / width) ** 2)
    samples = np.rint(100 + light + rng.standard_normal((n, 80)) * np.sqrt(4 + 0.2 * light))
    found = survey_block(WaveformBlock.from_samples(samples.astype(np.uint16)))
    assert least < found.system.noise.gain < 0.22


def test_any_waveforms_can_be_surveyed(rng):
    noise = rng.integers(0, 256, (50, 30)).astype(np.uint8)
    for samples in (noise, noise[:1], noise[:, :3], np.full((FIRST_LOOK // 12 + 9, 12), 255, np.uint8)):
        survey = survey_block(WaveformBlock.from_samples(samples))
        assert np.isfinite([survey.system.sigma_ref, survey.system.noise.std]).all()
        assert choose_chain(survey).steps


def _survey_file(path):
    with StripReader(path) as reader, reader.scan() as scan:
        return survey_blocks(read_sample(reader, scan))


def test_riegl_is_what_is_known_of_it(riegl):
    """R1, R3 and R4 of docs/algorithms.md 8: s_ref 1.86 ns, +4 % after-pulse at +10.5 ns; noise of a pulse 1.7 DN."""
    survey = _survey_file(riegl)
    system = survey.system
    assert len(system.components) >= 3 and system.kappa == 0
    assert system.sigma_ref == pytest.approx(1.86, abs=0.05)
    # The after-pulse, whichever Gaussians make it: a maximum of 2 to 6 % of the peak, 10.5 ns after it.
    lag = np.arange(6.0, 15.0, 0.1)
    after = sum(w * np.exp(-0.5 * ((lag - delay) / sigma) ** 2) for w, delay, sigma in system.components)
    after /= sum(w * np.exp(-0.5 * (delay / sigma) ** 2) for w, delay, sigma in system.components)
    assert 9.5 < lag[np.argmax(after)] < 11.5 and 0.02 < after.max() < 0.07
    assert system.ringing == pytest.approx(0.044, abs=0.01)
    assert system.noise.std == pytest.approx(1.66, abs=0.15) and 1.7 < system.noise.baseline < 2.8
    misfits = survey.figures
    assert misfits.misfit_gaussians[3] < 0.5 * misfits.misfit_gaussians[1]
    assert abs(misfits.kappa) < 0.19 and misfits.misfit_skewed > 0.8 * misfits.misfit_gaussians[1]
    tried = {one.name: one.nats for one in survey.candidates}
    assert tried["riegl-q680i"] < min(misfits.gaussian_nats or np.inf, tried["one echo per cluster"] + 1.0)


@pytest.mark.slow
def test_leica_is_what_is_known_of_it(leica):
    """A strong skew, which the skewed pulse halves and a learned one brings near the noise."""
    survey = _survey_file(leica)
    system, misfits = survey.system, survey.figures
    assert len(system.components) >= 2 and 0.2 < misfits.kappa < 0.4
    assert system.sigma_ref == pytest.approx(3.15, abs=0.1)
    assert misfits.misfit_gaussians[3] < 0.5 * misfits.misfit_skewed < 0.5 * misfits.misfit_gaussians[1]
    # Coloured noise (.6, .55, .4 ...): what it does to the amplitude of a pulse is twice the noise of a sample.
    assert system.noise.std == pytest.approx(1.7, abs=0.15) and misfits.empty_share == 0
    assert system.noise.correlation[:3] == pytest.approx((0.6, 0.54, 0.36), abs=0.08)


def test_a_sample_is_decomposed_again_only_where_it_has_other_echoes():
    block = make_block("mixed", 200)[0]
    system = survey_block(block).system
    echoes = decompose_sample(block, system)
    noise = replace(system.noise, by_kind={**system.noise.by_kind, "core": 9.0})
    assert decompose_again(block, replace(system, noise=noise, faint_share=0.5), system, echoes) is echoes
    noise = replace(system.noise, by_kind={**system.noise.by_kind, "quiet": 0.5 * system.noise.quiet})
    others = [replace(system, **change) for change in (
        {"misfit": 0.1}, {"significance": 6.0}, {"noise": noise}, {"tail_misfit": ((9.0, 0.1),)}
    )]  # fmt: skip
    for other in others:
        found, expected = decompose_again(block, other, system, echoes), decompose_sample(block, other)
        assert found is not echoes
        assert np.array_equal(found.amplitude_err, expected.amplitude_err)
    learned = replace(system, components=((0.1, 4.0, 1.0),))
    faint = replace(learned, faint_share=0.5)
    assert decompose_again(block, faint, learned, echoes) is not echoes


def test_a_survey_depends_on_the_samples_only():
    block = make_block("urban", 3000, seed=7)[0]
    moved = replace(block, origin=block.origin + 5, first=9, point=block.point[::-1])
    assert survey_block(block) == survey_block(moved)


@pytest.mark.slow
@pytest.mark.parametrize(("times", "number"), [(22, 3), (60, 1), (28, 15)])
def test_a_few_retro_reflectors_do_not_hide_the_ground(times, number):
    """Ground below 8 % of the largest count was no clear echo: no pulse was learned, and its tail became echoes."""
    rng = np.random.default_rng(41)
    height = 60.0 * rng.uniform(0.8, 1.2, 4000)
    height[rng.choice(4000, number, replace=False)] *= times
    lag = np.arange(80) - 25 - rng.uniform(0, 1, (4000, 1))
    pulse = np.exp(-0.5 * (lag / 2) ** 2) + 0.25 * np.exp(-0.5 * ((lag - 9) / 3) ** 2)
    samples = np.rint(20 + height[:, None] * pulse + rng.normal(0, 0.6, lag.shape)).astype(np.uint16)
    survey = survey_block(WaveformBlock.from_samples(samples, spacing=1.0, bits=16))
    assert survey.figures.echoes_per_waveform < 1.01 and survey.figures.isolated_echoes > 1000
    delays = [(weight, delay) for weight, delay, _ in survey.system.components]
    assert min(abs(weight - 0.25) + abs(delay - 9) for weight, delay in delays) < 0.1
