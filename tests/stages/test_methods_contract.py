"""The contract of all stages, held by the methods with parameters other than their defaults."""

import numpy as np
import pytest
from contract_tools import SYSTEMS, assert_same, check_echoes, inputs, make_block, pieces, scene_blocks, waveforms

from wavebatch import surveying
from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.stages.chain import STAGES
from wavebatch.stages.pulse_tables import error_factors, pulse_shape

PULSE = "0 0.1 0.4 0.9 0.8 0.5 0.2 0.1"
VARIANTS = [
    ("detect.threshold", {"correct_walk": False}),
    ("detect.correlation", {"reference": "given", "pulse": PULSE}),
    ("detect.asdf", {"rule": "paper", "interpolation": "parabola"}),
    ("detect.asdf", {"reference": "system"}),
    ("detect.asdf", {"reference": "given", "pulse": PULSE}),
    ("detect.zero_crossing", {"derivative": "second"}),
    ("detect.wavelet", {"wavelet": "mexican_hat"}),
    ("detect.wavelet", {"scale": 4.0}),
    ("detect.richardson_lucy", {"reference": "given", "pulse": PULSE, "iterations": 3}),
    ("decompose.asdf_only", {"describe": "detector"}),
    ("decompose.log_normal", {"origin": "waveform"}),
    ("decompose.skewed", {"kappa": 0.2}),
    ("decompose.skewed", {"kappa": "free"}),
    ("decompose.residual_loop", {"model": "skewed"}),
    ("decompose.residual_loop", {"model": "generalized"}),
    ("decompose.residual_loop", {"model": "learned", "t_diff": 0.1, "t_unit": "amplitude"}),
    ("decompose.adaptive", {"least_width": 0.7, "most_width": 12.0}),
    ("decompose.reference", {"model": "stretched"}),
    ("decompose.reference", {"model": "given", "pulse": PULSE}),
]


def call(name, parameters, block, system):
    noise, candidates, _ = inputs(block, system)
    given = (candidates,) if name.startswith("decompose") else ()
    return STAGES[name].function(block, noise, system, *given, **parameters)


@pytest.mark.quick_cases("1-gaussian-*", "2-short-*", "40-gaussian-detect*", "40-gaussian-decompose.[!r]*")
@pytest.mark.parametrize(("name", "parameters"), VARIANTS)
@pytest.mark.parametrize("system", ["gaussian", "learned", "short"])
@pytest.mark.parametrize("s", [1, 2, 40])
def test_variants_keep_the_contract_on_any_waveforms(name, parameters, s, system):
    for samples in waveforms(s).values():
        block = make_block(samples)
        table = call(name, parameters, block, SYSTEMS[system])
        check_echoes(table, block, SYSTEMS[system], fitted=name.startswith("decompose"))


@pytest.fixture(scope="module")
def mixed():
    """A block and its survey."""
    block = scene_blocks()["mixed"].rows(slice(0, 60))
    return block, surveying.survey_block(block).system


@pytest.mark.quick_cases("detect.a*", "detect.c*", "decompose.asdf*", "decompose.adaptive*", "*reference-*18")
@pytest.mark.parametrize(("name", "parameters"), VARIANTS)
def test_variants_give_the_same_bits_for_any_block_size(mixed, name, parameters):
    block, system = mixed[0].rows(slice(0, 29)), mixed[1]
    whole = call(name, parameters, block, system)
    assert len(whole) > 15
    for size in (1, 7):
        cuts = pieces(len(block), size)
        parts = [(call(name, parameters, block.rows(cut), system), cut.start) for cut in cuts]
        assert_same(EchoTable.concatenate(parts), whole)


@pytest.mark.parametrize("name", sorted(name for name in STAGES if name.startswith(("detect.", "decompose."))))
@pytest.mark.parametrize("s", [1, 2, 80])
def test_a_constant_waveform_holds_no_echo(name, s):
    """H10, T15: whatever its level, whatever a filter makes of its ends or a loop of its residual, and its company."""
    level = np.repeat(np.array([0, 12, 40, 255], np.uint8)[:, None], s, axis=1)
    pulse = 12 + np.rint(80 * np.exp(-0.5 * ((np.arange(s) - 0.6 * s) / 2) ** 2)).astype(np.uint8)
    block = WaveformBlock.from_samples(np.insert(level, [1, 3], pulse, axis=0))
    system = SystemPulse(2.0, noise=ReceiverNoise(baseline=12, std=1.0))
    noise = Noise(np.full(6, 12, np.float32), np.ones(6, np.float32))
    given = (STAGES["detect.maximum"].function(block, noise, system),) if name.startswith("decompose") else ()
    table = STAGES[name].function(block, noise, system, *given)
    assert set(table.waveform.tolist()) <= {1, 4}
    assert s < 80 or set(table.waveform.tolist()) == {1, 4}


@pytest.mark.parametrize("kappa", [0.0, 0.9])
@pytest.mark.parametrize("spacing", [0.001, 1.0, 4000.0])
def test_factors_of_coloured_noise_are_bounded_for_any_spacing(spacing, kappa):
    """A pulse on one sample has no derivatives, and one of 10,000 samples no table that fits into memory."""
    receiver = ReceiverNoise(baseline=12.0, std=1.0, correlation=(0.5, 0.2, -0.1))
    system = SystemPulse(sigma_ref=2.0, noise=receiver, kappa=kappa)
    factors = error_factors(system, spacing, np.array([0.7, 1.0, 4.0]) * 2.0 / spacing)
    assert np.isfinite(factors).all() and (factors > 0.05).all() and (factors < 3).all()


@pytest.mark.parametrize("kappa", [0.0, 0.4])
@pytest.mark.parametrize("correlation", [(), (0.6, 0.3, 0.1)])
def test_a_wrong_level_moves_echoes_as_far_as_their_errors_say(kappa, correlation):
    n, std, wrong = 300, 100.0, 50.0
    time = np.random.default_rng(4).uniform(20, 24, n)
    system = SystemPulse(2.0, kappa=kappa, noise=ReceiverNoise(baseline=1000.0, std=std, correlation=correlation))
    pulse = evaluate_pulse(pulse_shape(system, 1.0), np.arange(48.0)[:, None], time, np.full(n, 2.0))[0].T
    block = WaveformBlock.from_samples(np.rint(1000 + 20_000 * pulse).astype(np.uint16), bits=16)
    found = []
    for level in (1000, 1000 - wrong):
        noise = Noise(np.full(n, level, np.float32), np.full(n, std, np.float32))
        candidates = STAGES["detect.maximum"].function(block, noise, system)
        found.append(STAGES["decompose.adaptive"].function(block, noise, system, candidates))
    plain, both = (error_factors(system, 1.0, np.full(n, 2.0), err) for err in (None, np.full(n, wrong / std)))
    added = np.sqrt(both**2 - plain**2) / plain
    for column, name in enumerate(("amplitude", "time", "sigma")):
        moved = np.abs(getattr(found[1], name) - getattr(found[0], name)) / getattr(found[0], f"{name}_err")
        assert np.median(moved) == pytest.approx(np.median(added[:, column]), rel=0.1, abs=0.04)
