"""What every stage promises, every method of detection and decomposition, and those of the papers."""

from dataclasses import replace

import contract_tools
import numpy as np
import pytest
from commands import refuses
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes
from published import PULSE_SIGMA as SIGMA

from wavebatch import surveying
from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import Noise, ReceiverNoise, ReturnTable, SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.kernels.fit.pulse_shape import evaluate_pulse
from wavebatch.stages.chain import STAGES, Step, list_profiles, load_profile, parse_chain
from wavebatch.stages.decompose.models import rebuild_waveforms
from wavebatch.stages.pulse_tables import error_factors, pulse_shape

PROFILES = list_profiles()


def call(stage, block, system, given=None):
    noise, candidates, fitted = given or contract_tools.inputs(block, system)
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
    contract_tools.check_echoes(result, block, system, fitted)
    for name in stage.makes:
        assert len(result.attributes[name]) == len(result)


@pytest.mark.quick_cases("1-gaussian", "2-noise grows", "2-learned", "9-skewed", "9-short", "64-gaussian")
@pytest.mark.parametrize("system", contract_tools.SYSTEMS.values(), ids=contract_tools.SYSTEMS)
@pytest.mark.parametrize("s", [1, 2, 9, 64])
def test_every_stage_keeps_the_contract_on_any_waveforms(s, system):
    for name, samples in contract_tools.waveforms(s).items():
        block = contract_tools.make_block(samples)
        before = block.samples.copy()
        given = contract_tools.inputs(block, system)
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
    for name, samples in contract_tools.waveforms(s).items():
        block = contract_tools.make_block(samples)
        system = surveying.survey_block(block).system
        for chain in chains:
            try:
                table = chain.run(block, system)
                contract_tools.check_echoes(table, block, system, fitted=True)
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
    block = contract_tools.scene_blocks()[request.param]
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
        system = contract_tools.SYSTEMS[system_name]
    chain = load_profile(profile)
    whole = chain.run(block, system)
    parts = [(chain.run(block.rows(piece), system), piece.start) for piece in contract_tools.pieces(len(block), size)]
    assert len(whole) > 20
    contract_tools.assert_same(EchoTable.concatenate(parts), whole)


@pytest.mark.quick_cases("stiff-7", "mixed-1")
@pytest.mark.parametrize("size", [1, 7])
def test_stages_give_the_same_bits_for_any_block_size(scene, size):
    block, system = scene
    block = block.rows(slice(0, 30))
    cuts = contract_tools.pieces(len(block), size)
    parts = [(part, contract_tools.inputs(part, system)) for part in (block.rows(cut) for cut in cuts)]
    given = contract_tools.inputs(block, system)
    for stage in STAGES.values():
        whole = call(stage, block, system, given)
        results = [call(stage, part, system, part_given) for part, part_given in parts]
        if stage.kind == "noise":
            joined = Noise(np.concatenate([r.baseline for r in results]), np.concatenate([r.std for r in results]))
        else:
            joined = EchoTable.concatenate(zip(results, (cut.start for cut in cuts), strict=True))
        try:
            contract_tools.assert_same(joined, whole)
        except AssertionError as error:
            error.add_note(stage.name)
            raise


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_says_what_comes_out(name):
    stage = STAGES[name]
    assert stage.summary.endswith((".", ":"))
    assert all(parameter.meaning for parameter in stage.parameters.values())


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


def call_method(name, parameters, block, system):
    noise, candidates, _ = contract_tools.inputs(block, system)
    given = (candidates,) if name.startswith("decompose") else ()
    return STAGES[name].function(block, noise, system, *given, **parameters)


@pytest.mark.quick_cases("1-gaussian-*", "2-short-*", "40-gaussian-detect*", "40-gaussian-decompose.[!r]*")
@pytest.mark.parametrize(("name", "parameters"), VARIANTS)
@pytest.mark.parametrize("system", ["gaussian", "learned", "short"])
@pytest.mark.parametrize("s", [1, 2, 40])
def test_variants_keep_the_contract_on_any_waveforms(name, parameters, s, system):
    for samples in contract_tools.waveforms(s).values():
        block = contract_tools.make_block(samples)
        table = call_method(name, parameters, block, contract_tools.SYSTEMS[system])
        contract_tools.check_echoes(table, block, contract_tools.SYSTEMS[system], fitted=name.startswith("decompose"))


@pytest.fixture(scope="module")
def mixed():
    """A block and its survey."""
    block = contract_tools.scene_blocks()["mixed"].rows(slice(0, 60))
    return block, surveying.survey_block(block).system


@pytest.mark.quick_cases("detect.a*", "detect.c*", "decompose.asdf*", "decompose.adaptive*", "*reference-*18")
@pytest.mark.parametrize(("name", "parameters"), VARIANTS)
def test_variants_give_the_same_bits_for_any_block_size(mixed, name, parameters):
    block, system = mixed[0].rows(slice(0, 29)), mixed[1]
    whole = call_method(name, parameters, block, system)
    assert len(whole) > 15
    for size in (1, 7):
        cuts = contract_tools.pieces(len(block), size)
        parts = [(call_method(name, parameters, block.rows(cut), system), cut.start) for cut in cuts]
        contract_tools.assert_same(EchoTable.concatenate(parts), whole)


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


SYSTEM = known_system(fine_recording(1.0, SIGMA))


def test_mixed_fits_only_where_detectors_disagree():
    recording = fine_recording(1.0, 2.0, n_samples=64)
    system, rng = known_system(recording), np.random.default_rng(2)
    phase = rng.uniform(-0.5, 0.5, (60, 1))
    one, _ = simulate_echoes(recording, 20 + phase, 60 * FINE, 2.0, rng)
    two, _ = simulate_echoes(recording, np.array([20, 26.0]) + phase, FINE * np.array([100.0, 60.0]), 2.0, rng)
    block = WaveformBlock.from_samples(np.concatenate([one.samples, two.samples]))
    noise = known_noise(recording, 120)
    quick, fitted = (
        STAGES[decomposer].function(block, noise, system, STAGES[detector].function(block, noise, system))
        for decomposer, detector in (("decompose.asdf_only", "detect.asdf"), ("decompose.gaussian", "detect.maximum"))
    )
    given = STAGES["detect.asdf"].function(block, noise, system)
    mixed = STAGES["decompose.asdf_mixed"].function(block, noise, system, given)
    taken = np.zeros(2, int)
    for w in range(120):
        row = [table.take(np.flatnonzero(table.waveform == w)) for table in (mixed, quick, fitted)]
        source = 1 if np.array_equal(row[0].time, row[1].time) else 2
        contract_tools.assert_same(row[0], row[source])
        taken[source - 1] += 1
    assert taken.min() > 30
    refuses(ConfigError, "decompose.none", parse_chain, chain_text("asdf_mixed"), "c")


def chain_text(decomposer, *lines):
    names = ("noise.pooled", "detect.maximum", f"decompose.{decomposer}")
    return "\n".join([*(f'[[chain]]\nstage = "{name}"' for name in names), *lines, ""])


@pytest.mark.parametrize(("millimetres", "ratio", "metres"), [
    (2.10, 20.4, 0.216), (3.49, 12.0, 0.207), (1.46, 30.6, 0.236), (2.07, 21.4, 0.232)])  # fmt: skip
def test_gauss_newton_reaches_the_bound_at_fifty_picoseconds(millimetres, ratio, metres):
    """T8: the pulses of Jutzi and Stilla's table 1; standard deviations of range and sigma over the bound."""
    n, spacing, sigma = 300, 0.05, metres / HALF_C
    recording = fine_recording(1.0, sigma, n_samples=320, spacing=spacing)
    rng = np.random.default_rng(int(100 * ratio))
    time = 8 + rng.uniform(-0.025, 0.025, (n, 1))
    block, _ = simulate_echoes(recording, time, ratio * FINE, sigma, rng)
    start = EchoTable.build(np.arange(n), time[:, 0] + 0.3, np.full(n, 0.9 * ratio * FINE), np.full(n, 1.2 * sigma))
    found = STAGES["decompose.gauss_newton"].function(block, known_noise(recording, n), SystemPulse(sigma), start)
    assert found.waveform.tolist() == list(range(n))
    assert not (found.flags & EchoFlag.NOT_CONVERGED).any()
    bound = 1000 * HALF_C * float(bound_time(np.array(ratio), np.array(sigma), 1.0, spacing))
    assert bound == pytest.approx(millimetres, rel=0.005)
    for name, values in (("time", found.time - time[:, 0]), ("sigma", found.sigma - sigma)):
        assert 1000 * HALF_C * np.std(values) / bound == pytest.approx(1, abs=0.13)
        assert np.std(values / getattr(found, f"{name}_err")) == pytest.approx(1, abs=0.13)


@pytest.mark.parametrize(("off", "least", "most"), [(0.5, 1, 1), (1.0, 1, 1), (2.0, 0, 0)])
@pytest.mark.parametrize("width", [0.8, 2.0, 3.0])
def test_basin_of_undamped_steps(off, width, least, most):
    """s = 2, SNR 100: from up to one sigma off every fit converges, from two none (docs/algorithms.md 1.3)."""
    n, recording = 100, fine_recording(1.0, 2.0, n_samples=60)
    block, _ = simulate_echoes(recording, np.full((n, 1), 30.0), 100 * FINE, 2.0, np.random.default_rng(3))
    start = EchoTable.build(np.arange(n), np.full(n, 30 + 2 * off), np.full(n, 100 * FINE), np.full(n, width))
    system = known_system(recording)
    found = STAGES["decompose.gauss_newton"].function(block, known_noise(recording, n), system, start)
    right = ((found.flags & EchoFlag.NOT_CONVERGED) == 0) & (np.abs(found.time - 30) < 0.2)
    assert least <= right.sum() / n <= most


def test_lost_fits_give_their_start_back_with_a_flag():
    block, noise = contract_tools.record(1, (100, [30.0]), std=0.0, s=60)
    start = EchoTable.build(np.zeros(1), np.array([35.0]), np.array([100 * FINE]), np.array([SIGMA]))
    found = STAGES["decompose.gauss_newton"].function(block, noise, SYSTEM, start)
    assert found.time.tolist() == [35.0]
    assert (found.flags & EchoFlag.NOT_CONVERGED).all()


@pytest.mark.parametrize(("origin", "low", "high"), [("segment", 0.1, 0.4), ("waveform", 0.05, 0.09)])
def test_the_printed_formula_has_the_skew_of_its_origin(origin, low, high):
    """The width over the distance of the peak from the origin, whatever the pulse is."""
    rng, n = np.random.default_rng(7), 200
    recording = fine_recording(1.0, 2.4, n_samples=80)
    block, _ = simulate_echoes(recording, 36 + rng.uniform(-0.5, 0.5, (n, 1)), 150 * FINE, 2.4, rng)
    system = known_system(recording)
    chain = parse_chain(chain_text("log_normal", f'origin = "{origin}"', "[[chain]]", 'stage = "attribute.skew"'), "c")
    found = chain.run(block, system)
    skew = found.attributes["skew"]
    assert low < np.median(skew) < high
    if origin == "waveform":
        np.testing.assert_allclose(skew, found.sigma / (found.time + 1.0), rtol=1e-4)
    for refused in ("pulse_deviation", "incidence_angle"):
        with pytest.raises(ConfigError, match="fits another shape|skew per echo"):
            parse_chain(chain_text("log_normal", "[[chain]]", 'stage = "attribute.position"', "[[chain]]",
                                   f'stage = "attribute.{refused}"'), "c")  # fmt: skip


@pytest.mark.parametrize("name", ["gauss_newton", "log_normal", "asdf_mixed"])
def test_what_was_fitted_is_drawn(name):
    block, noise = contract_tools.record(20, (150, np.linspace(30, 31, 20)))
    detector = "detect.asdf" if name == "asdf_mixed" else "detect.maximum"
    given = STAGES[detector].function(block, noise, SYSTEM)
    step = Step(STAGES[f"decompose.{name}"])
    found = step.stage.function(block, noise, SYSTEM, given)
    left = block.samples - noise.level - rebuild_waveforms(block, SYSTEM, step, found)
    assert np.abs(left).max() < (20 if name == "log_normal" else 8) * FINE
