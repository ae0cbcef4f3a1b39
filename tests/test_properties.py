"""What must hold for any waveforms: shifts of level and time, scaling; drawn by hypothesis."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.waveforms import Noise, ReceiverNoise, SystemPulse, WaveformBlock
from wavebatch.stages.chain import STAGES, list_profiles, load_profile

CORE = ("waveform", "time", "amplitude", "sigma", "time_err", "amplitude_err", "sigma_err", "residual", "flags")
N_SAMPLES = 72
SYSTEM = SystemPulse(2.0, noise=ReceiverNoise(baseline=40.0, std=1.5))
DECOMPOSERS = ["none", "closed_form", "gaussian", "adaptive"]

echoes = st.tuples(st.floats(25, 3000), st.floats(22, 50), st.floats(1.6, 4.5))
scenes = st.tuples(st.lists(st.lists(echoes, max_size=4), min_size=1, max_size=5), st.integers(0, 2**32 - 1))
fast = settings(max_examples=15, deadline=None, derandomize=True)


def record(scene, n_samples=N_SAMPLES, later=0):
    """Two-byte samples with the scene's echoes (amplitude, time, sigma) on a level of 40 counts."""
    waveforms, seed = scene
    rng = np.random.default_rng(seed)
    y = 40 + 1.4 * rng.standard_normal((len(waveforms), n_samples))
    for row, found in zip(y, waveforms, strict=True):
        for amplitude, time, sigma in found:
            row += amplitude * np.exp(-0.5 * ((np.arange(n_samples) - time - later) / sigma) ** 2)
    return np.rint(np.clip(y, 0, 16000)).astype(np.uint16)


def run(samples, decomposer, system=SYSTEM, spacing=1.0):
    block = WaveformBlock.from_samples(samples, spacing=spacing)
    n = len(block)
    noise = Noise(np.full(n, system.noise.baseline, np.float32), np.full(n, system.noise.std, np.float32))
    candidates = STAGES["detect.maximum"].function(block, noise, system)
    return STAGES[f"decompose.{decomposer}"].function(block, noise, system, candidates)


def assert_same(a, b, names=CORE):
    for name in names:
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize("decomposer", DECOMPOSERS)
@fast
@given(scene=scenes, level=st.integers(1, 20_000))
def test_a_constant_added_to_samples_and_baseline_leaves_the_echoes(decomposer, scene, level):
    samples = record(scene)
    system = replace(SYSTEM, noise=replace(SYSTEM.noise, baseline=40.0 + level))
    shifted = run(samples + np.uint16(level), decomposer, system)
    assert_same(shifted, run(samples, decomposer))


@pytest.mark.parametrize("decomposer", DECOMPOSERS)
@fast
@given(scene=scenes, power=st.integers(1, 6))
def test_scaled_samples_scale_amplitudes_only(decomposer, scene, power):
    samples = record(scene).astype(np.uint32)
    factor = 2**power
    plain = run(samples, decomposer)
    system = replace(SYSTEM, noise=replace(SYSTEM.noise, baseline=40.0 * factor, std=1.5 * factor))
    scaled = run(samples * np.uint32(factor), decomposer, system)
    np.testing.assert_array_equal(scaled.waveform, plain.waveform)
    # Starts come from logarithms, which do not scale to the last bit.
    reach = 0.05 * np.nan_to_num(plain.time_err, nan=1.0) + 1e-4
    assert (np.abs(scaled.time - plain.time) <= reach).all()
    assert (np.abs(scaled.sigma - plain.sigma) <= reach).all()
    near = 0.05 * np.nan_to_num(plain.amplitude_err, nan=1.0) + 1e-4 * plain.amplitude
    assert (np.abs(scaled.amplitude / factor - plain.amplitude) <= near).all()


@pytest.mark.parametrize("decomposer", DECOMPOSERS)
@fast
@given(scene=scenes, shift=st.integers(1, 12))
def test_a_shift_by_whole_samples_shifts_times_only(decomposer, scene, shift):
    """The same signal cut `shift` samples later, with echoes that no edge comes near."""
    long = record(scene, 132, later=30)
    early, late = run(long[:, :120], decomposer), run(long[:, shift : shift + 120], decomposer)
    # A fit that stopped early ends somewhere between start and minimum, and its neighbours with it.
    stopped = np.concatenate([t.waveform[(t.flags & np.uint16(EchoFlag.NOT_CONVERGED)) != 0] for t in (early, late)])
    early, late = (t.take((t.amplitude > 20) & ~np.isin(t.waveform, stopped)) for t in (early, late))
    np.testing.assert_array_equal(late.waveform, early.waveform)
    # Starts differ in their last bits, and a fit ends within a tenth of its errors of the minimum.
    for name, moved in (("time", shift), ("amplitude", 0), ("sigma", 0)):
        error = np.nan_to_num(getattr(early, f"{name}_err"), nan=1e-3)
        difference = getattr(late, name) + moved - getattr(early, name)
        assert (np.abs(difference) <= 0.2 * error + 1e-5).all(), name


@pytest.mark.parametrize("decomposer", DECOMPOSERS)
@fast
@given(scene=scenes, spacing=st.sampled_from([0.25, 0.5, 2.0, 4.0]))
def test_spacing_scales_times_and_widths(decomposer, scene, spacing):
    samples = record(scene)
    plain = run(samples, decomposer)
    scaled = run(samples, decomposer, replace(SYSTEM, sigma_ref=2.0 * spacing), spacing)
    assert_same(scaled, plain, ("waveform", "amplitude", "amplitude_err", "residual", "flags"))
    for name in ("time", "sigma", "time_err", "sigma_err"):
        np.testing.assert_array_equal(getattr(scaled, name), getattr(plain, name) * spacing, err_msg=name)


@pytest.mark.quick_cases("fast-uint8", "balanced-uint16", "accurate-uint32")
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.uint32])
@pytest.mark.parametrize("profile", list_profiles())
@fast
@given(scene=scenes)
def test_the_type_of_the_samples_does_not_matter(profile, dtype, scene):
    """Below the largest count of the smallest type, which would be taken for clipped."""
    samples = np.minimum(record(scene), 254)
    chain = load_profile(profile)
    assert_same(
        chain.run(WaveformBlock.from_samples(samples.astype(dtype)), SYSTEM),
        chain.run(WaveformBlock.from_samples(samples), SYSTEM),
    )


@fast
@given(scene=scenes)
def test_reflected_waveforms_reflect_the_echoes(scene):
    """Nothing in a Gaussian fit knows the direction of time."""
    samples = record(scene)
    plain, back = run(samples, "closed_form"), run(samples[:, ::-1].copy(), "closed_form")
    alone = plain.take(plain.count(len(samples))[plain.waveform] == 1)
    other = back.take(np.isin(back.waveform, alone.waveform))
    if len(other) == len(alone):
        np.testing.assert_allclose(N_SAMPLES - 1 - other.time, alone.time, atol=0.05)
