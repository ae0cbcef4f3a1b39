"""What every registered stage and every shipped chain must hold, whatever the waveforms: found by walking STAGES."""

from dataclasses import replace

import numpy as np
import pytest
from contract_tools import SYSTEMS, assert_same, check_echoes, inputs, make_block, pieces, scene_blocks, waveforms

from wavebatch import surveying
from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, ReturnTable, WaveformBlock
from wavebatch.stages.chain import STAGES, list_profiles, load_profile

PROFILES = list_profiles()


def call(stage, block, system, given=None):
    noise, candidates, fitted = given or inputs(block, system)
    arguments = {
        "noise": (block, system),
        "detect": (block, noise, system),
        "decompose": (block, noise, system, candidates),
        "attribute": (block, noise, system, fitted),
    }
    return stage.function(*arguments[stage.kind])


def check_noise(noise, block, system):
    assert noise.baseline.dtype == noise.std.dtype == np.float32
    assert noise.baseline.shape == noise.std.shape == (len(block),)
    assert np.isfinite(noise.baseline).all()
    assert (noise.std >= np.float32(1 / np.sqrt(12))).all()
    assert np.isfinite(noise.std).all()


def check(stage, result, block, system):
    if stage.kind == "noise":
        check_noise(result, block, system)
        return
    fitted = stage.kind in ("decompose", "attribute") and stage.name != "decompose.none"
    check_echoes(result, block, system, fitted)
    for name in stage.makes:
        assert len(result.attributes[name]) == len(result)


@pytest.mark.quick_cases("1-gaussian", "2-noise grows", "2-learned", "9-skewed", "9-short", "64-gaussian")
@pytest.mark.parametrize("system", SYSTEMS.values(), ids=SYSTEMS)
@pytest.mark.parametrize("s", [1, 2, 9, 64])
def test_every_stage_keeps_the_contract_on_any_waveforms(s, system):
    for name, samples in waveforms(s).items():
        block = make_block(samples)
        before = block.samples.copy()
        given = inputs(block, system)
        for stage in STAGES.values():
            try:
                check(stage, call(stage, block, system, given), block, system)
            except Exception as error:
                error.add_note(f"{stage.name} on {name}")
                raise
        np.testing.assert_array_equal(block.samples, before)


@pytest.mark.quick_cases("1", "5")
@pytest.mark.parametrize("s", [1, 2, 5, 40, 150])
def test_every_chain_keeps_the_contract_after_its_own_survey(s):
    chains = [load_profile(profile) for profile in PROFILES]
    for name, samples in waveforms(s).items():
        block = make_block(samples)
        system = surveying.survey_block(block).system
        for chain in chains:
            try:
                table = chain.run(block, system)
                check_echoes(table, block, system, fitted=True)
                assert set(chain.makes) <= set(table.attributes)
            except Exception as error:
                error.add_note(f"{chain.name} on {name}")
                raise


@pytest.mark.parametrize("level", [0, 12, 255])
def test_constant_waveforms_have_no_echo(level):
    block = WaveformBlock.from_samples(np.full((20, 80), level, np.uint8))
    measured = surveying.survey_block(block).system
    assert np.isfinite(measured.sigma_ref)
    other = replace(measured, noise=replace(measured.noise, baseline=float(level), std=0.3), sigma_ref=3.0)
    for profile in PROFILES:
        for system in (measured, other):
            assert len(load_profile(profile).run(block, system)) == 0, profile


@pytest.fixture(scope="module", params=["mixed", "stiff"])
def scene(request):
    """A block with returns near its echoes, and its survey."""
    block = scene_blocks()[request.param]
    system = surveying.survey_block(block).system
    # A survey of so few clear echoes may not know their skew; some stages need one.
    system = replace(system, skew=system.skew or 0.0)
    echoes = load_profile("fast").run(block, system)
    returns = ReturnTable(echoes.waveform, echoes.time - 0.3, np.arange(len(echoes)), np.zeros((len(echoes), 3)))
    return replace(block, returns=returns), system


@pytest.mark.quick_cases("mixed-*-survey-1", "stiff-*-learned-7", "stiff-*-survey-100")
@pytest.mark.parametrize(
    ("system_name", "size"), [("survey", 1), ("survey", 7), ("survey", 100), ("learned", 7), ("skewed", 7)]
)
@pytest.mark.parametrize("profile", PROFILES)
def test_chains_give_the_same_bits_for_any_block_size(scene, profile, size, system_name):
    block, system = scene
    block = block.rows(slice(0, 40 if size == 1 else 110))
    if system_name != "survey":
        system = SYSTEMS[system_name]
    chain = load_profile(profile)
    whole = chain.run(block, system)
    parts = [(chain.run(block.rows(piece), system), piece.start) for piece in pieces(len(block), size)]
    assert len(whole) > 20
    assert_same(EchoTable.concatenate(parts), whole)


@pytest.mark.quick_cases("stiff-7", "mixed-1")
@pytest.mark.parametrize("size", [1, 7])
def test_stages_give_the_same_bits_for_any_block_size(scene, size):
    block, system = scene
    block = block.rows(slice(0, 30))
    cuts = pieces(len(block), size)
    parts = [(part, inputs(part, system)) for part in (block.rows(cut) for cut in cuts)]
    given = inputs(block, system)
    for stage in STAGES.values():
        whole = call(stage, block, system, given)
        results = [call(stage, part, system, part_given) for part, part_given in parts]
        if stage.kind == "noise":
            joined = Noise(np.concatenate([r.baseline for r in results]), np.concatenate([r.std for r in results]))
        else:
            joined = EchoTable.concatenate(zip(results, (cut.start for cut in cuts), strict=True))
        try:
            assert_same(joined, whole)
        except AssertionError as error:
            error.add_note(stage.name)
            raise


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_says_what_comes_out(name):
    stage = STAGES[name]
    assert stage.summary.endswith((".", ":"))
    assert all(parameter.meaning for parameter in stage.parameters.values())
