"""Predicted errors come true on what was simulated, whatever the pulse."""

from dataclasses import replace

import numpy as np
import pytest
from given_echoes import known_system
from helpers_scenes import make_block, make_scene
from scoring import score

from wavebatch.core.echoes import EchoTable
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import WaveformBlock
from wavebatch.stages.chain import load_profile
from wavebatch.surveying import survey_block
from wavebatch.surveying.choose_chain import COSTS
from wavebatch.surveying.predict_error import leave_out_false, predict_errors, simulate_again
from wavebatch.tools.simulate import find_pulse

CHAINS = {name: load_profile(name) for name in COSTS}


@pytest.mark.quick_cases("mixed")
@pytest.mark.parametrize(
    ("scene", "optimism"),
    [
        (make_scene("flat"), 0.95),
        (make_scene("flat", pulse=find_pulse("leica"), n_samples=100), 0.9),
        (make_scene("urban"), 0.68),
        (make_scene("mixed"), 0.5),
    ],
    ids=["flat", "flat leica", "urban", "mixed"],
)
def test_predictions_come_true(scene, optimism):
    """Of isolated echoes nearly exactly; pairs that no survey can resolve make the truth worse than predicted."""
    block, truth = make_block(scene, 6000, seed=3)
    system = survey_block(block).system
    for prediction in predict_errors(block, system, CHAINS):
        found = CHAINS[prediction.name].run(block, system)
        measured = score(found, truth, len(block), noise_std=scene.recording.recorded_noise)
        rmse = measured.errors["all"]["time"].rmse * HALF_C
        assert optimism * rmse < prediction.range_error < 1.1 * rmse, prediction
        assert prediction.completeness >= measured.completeness - 0.01


def test_the_bound_and_a_perfect_chain_agree_on_flat_ground():
    scene = make_scene("flat")
    block, _ = make_block(scene, 4000, seed=4)
    accurate = predict_errors(block, known_system(scene.recording), CHAINS)[-1]
    assert accurate.name == "accurate" and accurate.factor == pytest.approx(1.0, abs=0.06)
    assert accurate.range_error == accurate.bound * accurate.factor
    assert accurate.to_json()["range_error_m"] == pytest.approx(accurate.range_error, rel=1e-5)


@pytest.mark.slow
def test_false_echoes_are_predicted_as_often_as_they_come():
    """Chains of plain Gaussians take parts of a pulse with lobes for echoes; those that fit the pulse do not."""
    scene = make_scene("flat", pulse=find_pulse("riegl"), n_samples=100)
    block, truth = make_block(scene, 6000, seed=6)
    predictions = predict_errors(block, survey_block(block).system, CHAINS)
    for prediction in predictions:
        found = CHAINS[prediction.name].run(block, survey_block(block).system)
        false = 1 - score(found, truth, len(block), noise_std=scene.recording.recorded_noise).correctness
        assert prediction.false_share == pytest.approx(false, abs=0.06), prediction
        assert prediction.to_json()["false_share"] == pytest.approx(prediction.false_share, rel=1e-5)
    assert predictions[0].false_share > 0.1
    assert [one.name for one in leave_out_false(predictions)] == ["accurate"]
    assert leave_out_false(predictions[:1]) == predictions[:1] and leave_out_false([]) == []


def test_what_is_simulated_again_holds_the_echoes_noise_and_clipping():
    block = WaveformBlock.from_samples(np.zeros((4000, 60), np.uint8))
    system = known_system(make_scene("flat").recording)
    system = replace(system, noise=replace(system.noise, gain=0.05), saturation=200.0)
    waveform = np.arange(4000)
    echoes = EchoTable.build(waveform, np.full(4000, 30.0), np.where(waveform % 2, 100.0, 400.0), np.full(4000, 2.0))
    again, _ = simulate_again(block, system, echoes, 1)
    assert again.samples.dtype == np.uint8 and again.samples.max() == 200
    quiet, peak = again.samples[:, :15].astype(float), again.samples[1::2, 30].astype(float)
    assert quiet.mean() == pytest.approx(system.noise.baseline, abs=0.05)
    assert (quiet - quiet.mean(axis=1, keepdims=True)).std() == pytest.approx(system.noise.std, rel=0.06)
    assert peak.mean() == pytest.approx(system.noise.baseline + 100, abs=0.3)
    expected = np.sqrt(system.noise.std**2 + 0.05 * 100 + system.noise.baseline_spread**2)
    assert peak.std() == pytest.approx(expected, rel=0.06)


@pytest.mark.filterwarnings("error")
def test_samples_of_32_bits_are_clipped_at_their_largest_count():
    """2^32 - 1 is no number of single precision: 2^32, which is, became 0 or whatever the processor makes of it."""
    block = WaveformBlock.from_samples(np.zeros((3, 60), np.uint32), bits=32)
    echoes = EchoTable.build(np.arange(3), np.full(3, 30.0), np.full(3, 1e10), np.full(3, 2.0))
    again, _ = simulate_again(block, known_system(make_scene("flat").recording), echoes, 1)
    assert again.samples[:, 30].tolist() == [2**32 - 1] * 3
