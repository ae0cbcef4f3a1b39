"""What every registered stage and every shipped chain must hold, whatever the waveforms: found by walking STAGES."""

from dataclasses import fields, replace

import numpy as np
import pytest

from wavebatch import surveying
from wavebatch.core.echoes import EchoTable
from wavebatch.core.waveforms import Noise, ReturnTable, SystemPulse, WaveformBlock
from wavebatch.simulate import simulate_block
from wavebatch.stages.chain import STAGES
from wavebatch.stages.chain_file import list_profiles, load_profile

PROFILES = list_profiles()
CORE = [field.name for field in fields(EchoTable) if field.name != "attributes"]
DTYPES = {"waveform": np.int32, "time": np.float64, "flags": np.uint16}
SYSTEMS = {
    "gaussian": SystemPulse(2.0, baseline=12.0, baseline_spread=0.4, noise_std=1.0, saturation=255.0),
    "skewed": SystemPulse(2.0, baseline=12.0, noise_std=1.0, kappa=0.1),
    "learned": SystemPulse(
        2.0, baseline=12.0, noise_std=1.0, components=((1.0, 0.0, 2.0), (0.1, 5.0, 2.0), (-0.03, 10.0, 3.0))
    ),
    "noise grows": SystemPulse(2.0, baseline=12.0, noise_std=1.0, noise_gain=0.05),
    "short": SystemPulse(0.6, baseline=12.0, noise_std=0.3),
    "long": SystemPulse(15.0, baseline=12.0, noise_std=2.0),
}


def gauss(s, amplitude, width):
    return amplitude * np.exp(-0.5 * ((np.arange(s) - 0.45 * s) / width) ** 2)


def waveforms(s):
    """Name -> raw counts (n, s): everything that a file may hold, those of one type in one block."""
    rng = np.random.default_rng(s)
    i = np.arange(s)
    noisy = 12 + gauss(s, 80, 2) + rng.standard_normal((6, s))
    hard = [
        noisy[:1],
        np.zeros((2, s)),
        np.full((2, s), 12),
        np.full((2, s), 255),
        12 + gauss(s, 900, 3),  # a flat top
        gauss(s, 9000, 0.2 * s + 1),  # all saturated but the ends
        np.where(i == np.array([[0], [s // 2], [s - 1]]), 200, 12),  # spikes
        np.stack([i, i[::-1]]),
        np.where(i < np.array([[s // 2], [s // 3]]), 12, 90),  # steps
        np.where((i + np.array([[0], [1]])) % 2, 255, 0),
        rng.integers(0, 256, (60, s)),
        12 + rng.standard_normal((60, s)),
    ]
    return {
        "none": np.zeros((0, s), np.uint8),
        "one": np.rint(noisy[:1]).astype(np.uint8),
        "bytes": np.clip(np.rint(np.concatenate([np.atleast_2d(part) for part in hard])), 0, 255).astype(np.uint8),
        "two bytes": np.concatenate([np.rint(40 * noisy), rng.integers(0, 65536, (20, s))]).astype(np.uint16),
        "four bytes": np.concatenate([np.rint(1000 * noisy), rng.integers(0, 2**32, (20, s))]).astype(np.uint32),
    }


def make_block(samples, returns=True):
    """A block with geometry, and with two returns per waveform."""
    n, s = samples.shape
    block = WaveformBlock.from_samples(samples)
    if not returns:
        return block
    waveform = np.repeat(np.arange(n, dtype=np.int32), 2)
    time = np.tile([0.45 * s, 0.8 * s], n)
    xyz = np.zeros((2 * n, 3)) + time[:, None]
    return replace(block, returns=ReturnTable(waveform, time, np.arange(2 * n), xyz))


def freeze(table):
    """The same table with every array read-only, so that a stage which writes into it fails."""
    arrays = {name: getattr(table, name).copy() for name in CORE}
    attributes = {name: values.copy() for name, values in table.attributes.items()}
    for array in (*arrays.values(), *attributes.values()):
        array.flags.writeable = False
    return EchoTable(**arrays, attributes=attributes)


def inputs(block, system):
    """Data arguments for a stage of every kind, all read-only: noise, candidates, echoes with every attribute."""
    noise = STAGES["noise.pooled"].function(block, system)
    noise = Noise(noise.baseline.copy(), noise.std.copy())
    noise.baseline.flags.writeable = noise.std.flags.writeable = False
    candidates = freeze(STAGES["detect.maximum"].function(block, noise, system))
    fitted = STAGES["decompose.gaussian"].function(block, noise, system, candidates)
    for stage in STAGES.values():
        if stage.kind == "attribute" and not stage.needs:
            fitted = stage.function(block, noise, system, fitted)
    return noise, candidates, freeze(fitted)


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


def check_echoes(table, block, system, fitted):
    n, s = block.samples.shape
    for name in CORE:
        values = getattr(table, name)
        assert values.dtype == DTYPES.get(name, np.float32), name
        assert values.shape == (len(table),), name
    if not len(table):
        return
    assert table.waveform.min() >= 0
    assert table.waveform.max() < n
    step = np.diff(table.waveform)
    assert (step >= 0).all()
    assert (np.diff(table.time)[step == 0] >= 0).all()
    names = ["time", "amplitude", "sigma"]
    if fitted:
        names += ["time_err", "amplitude_err", "sigma_err", "residual"]
    for name in names:
        assert np.isfinite(getattr(table, name)).all(), name
    assert (table.amplitude >= 0).all()
    assert (table.sigma >= np.float32(0.7 * system.sigma_ref * (1 - 1e-5))).all()
    assert table.time.min() >= -0.5 * table.sigma.max() - 1
    assert table.time.max() <= (s - 1) * block.spacing + 0.5 * table.sigma.max() + 1
    for name, values in table.attributes.items():
        assert values.shape[:1] == (len(table),), name


def check(stage, result, block, system):
    if stage.kind == "noise":
        check_noise(result, block, system)
        return
    fitted = stage.kind in ("decompose", "attribute") and stage.name != "decompose.none"
    check_echoes(result, block, system, fitted)
    for name in stage.makes:
        assert len(result.attributes[name]) == len(result)


def assert_same(a, b):
    """Bit for bit."""
    if isinstance(a, Noise):
        np.testing.assert_array_equal(a.baseline, b.baseline)
        np.testing.assert_array_equal(a.std, b.std)
        return
    for name in CORE:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)
    assert list(a.attributes) == list(b.attributes)
    for name, values in a.attributes.items():
        np.testing.assert_array_equal(values, b.attributes[name], err_msg=name)


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


@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("level", [0, 12, 255])
@pytest.mark.parametrize("system", ["of the file", "of another file"])
def test_constant_waveforms_have_no_echo(profile, level, system):
    block = WaveformBlock.from_samples(np.full((20, 80), level, np.uint8))
    measured = surveying.survey_block(block).system
    assert np.isfinite(measured.sigma_ref)
    if system == "of another file":
        measured = replace(measured, baseline=float(level), noise_std=0.3, sigma_ref=3.0)
    assert len(load_profile(profile).run(block, measured)) == 0


def scene_blocks():
    stiff, _ = simulate_block("stiff", 260, np.random.default_rng(1))
    mixed, _ = simulate_block("mixed", 301, np.random.default_rng(2))
    return {"mixed": mixed, "stiff": stiff}


@pytest.fixture(scope="module", params=["mixed", "stiff"])
def scene(request):
    """A block with returns near its echoes, and its survey."""
    block = scene_blocks()[request.param]
    system = surveying.survey_block(block).system
    echoes = load_profile("fast").run(block, system)
    returns = ReturnTable(echoes.waveform, echoes.time - 0.3, np.arange(len(echoes)), np.zeros((len(echoes), 3)))
    return replace(block, returns=returns), system


def pieces(n, size):
    return [slice(start, min(start + size, n)) for start in range(0, n, size)]


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


@pytest.mark.parametrize("profile", PROFILES)
def test_permuted_waveforms_give_permuted_echoes(scene, profile):
    block, system = scene
    order = np.random.default_rng(4).permutation(len(block))
    chain = load_profile(profile)
    whole, mixed = chain.run(block, system), chain.run(block.rows(order), system)
    back = replace(mixed, waveform=order[mixed.waveform].astype(np.int32))
    assert_same(back.take(np.argsort(back.waveform, kind="stable")), whole)


def test_the_same_waveforms_twice_give_the_same_bits(scene):
    block, system = scene
    for profile in PROFILES:
        assert_same(load_profile(profile).run(block, system), load_profile(profile).run(block, system))


@pytest.mark.parametrize("name", STAGES)
def test_every_stage_says_what_comes_out(name):
    stage = STAGES[name]
    assert stage.summary.endswith((".", ":"))
    assert all(parameter.meaning for parameter in stage.parameters.values())
