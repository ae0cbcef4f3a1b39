"""Wang's residual loop and ASDF without a fit, on isolated echoes and close pairs."""

import json
from dataclasses import fields, replace

import naive
import numpy as np
import pytest
from commands import refuses
from given_echoes import known_noise, known_system, simulate_echoes

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.waveforms import Noise, WaveformBlock
from wavebatch.kernels.fit import render
from wavebatch.kernels.fit.closed_form import crlb
from wavebatch.kernels.fit.pulse_shape import GAUSSIAN
from wavebatch.stages.chain import STAGES, Step, parse_chain
from wavebatch.tools.simulate import Recording

RECORDING = Recording(n_samples=64, bits=16, baseline=20.0, baseline_spread=0.0)
SYSTEM = known_system(RECORDING)
STD = RECORDING.recorded_noise


def record(n, *echoes, seed=1, width=2.0):
    """Waveforms of noise 1 with echoes (amplitude, time), rounded; the noise known; a phase per waveform."""
    rng = np.random.default_rng(seed)
    phase = rng.uniform(-0.5, 0.5, n)
    amplitude, time = np.array(echoes, float).T
    block, _ = simulate_echoes(RECORDING, time + phase[:, None], amplitude, width, rng)
    return block, known_noise(RECORDING, n), phase


def decompose(name, block, noise, detector=None, **parameters):
    detector = detector or ("detect.asdf" if name == "asdf_only" else "detect.maximum")
    candidates = STAGES[detector].function(block, noise, SYSTEM)
    return STAGES[f"decompose.{name}"].function(block, noise, SYSTEM, candidates, **parameters)


def assert_same(a, b):
    for field in fields(EchoTable):
        if field.name != "attributes":
            np.testing.assert_array_equal(getattr(a, field.name), getattr(b, field.name), err_msg=field.name)


def test_the_loop_finds_the_echo_that_the_maximum_hides():
    block, noise, phase = record(400, (100, 28), (60, 32))
    assert (decompose("gaussian", block, noise).count(400) == 1).mean() > 0.9
    found = decompose("residual_loop", block, noise)
    two = found.count(400) == 2
    assert two.mean() > 0.9
    pair = found.time[two[found.waveform]].reshape(-1, 2) - phase[two][:, None]
    np.testing.assert_allclose(np.median(pair, axis=0), [28, 32], atol=0.05)


@pytest.mark.parametrize(("width", "lost"), [(2.0, 1.0), (3.0, 1.13), (4.0, 1.4)])
def test_asdf_without_a_fit_is_near_the_bound_and_says_its_errors(width, lost):
    n = 3000
    block, noise, phase = record(n, (160, 30), width=width)
    found = decompose("asdf_only", block, noise)
    assert (found.count(n) == 1).mean() > 0.99
    found = found.take(found.count(n)[found.waveform] == 1)
    error = found.time - 30 - phase[found.waveform]
    bound = crlb(np.array(160.0), np.array(width), STD, 1.0)[0]
    assert np.sqrt(np.mean(error**2)) / bound == pytest.approx(lost, rel=0.08)
    assert np.std(error / found.time_err) == pytest.approx(1.0, abs=0.1)
    assert np.std((found.amplitude - 160) / found.amplitude_err) == pytest.approx(1.0, abs=0.1)
    assert np.std((found.sigma - width) / found.sigma_err) == pytest.approx(1.0, abs=0.15)
    assert np.median(found.amplitude) == pytest.approx(160, rel=0.01)
    assert np.median(found.sigma) == pytest.approx(width, rel=0.02)
    # What five samples make of a broad echo misses it by more than noise does.
    assert 0.8 < np.median(found.residual) < (1.1 if width == 2 else 1.4)


def parse(detector, decomposer, **parameters):
    """A chain of this detector and decomposer; parameters of the detector have its name before them."""
    lines = {"detect": [f'stage = "{detector}"'], "decompose": [f'stage = "decompose.{decomposer}"']}
    for key, value in parameters.items():
        kind, name = key.split("__")
        lines[kind].append(f"{name} = {json.dumps(value)}")
    tables = (['stage = "noise.pooled"'], lines["detect"], lines["decompose"])
    return parse_chain("\n".join("[[chain]]\n" + "\n".join(table) for table in tables), "c")


def test_asdf_only_keeps_the_echoes_of_the_detector_before_it():
    """The paper's rule loses echoes below 30 % of the strongest, a mean pulse as reference shifts times a little."""
    block, _, _ = record(300, (150, 20), (30, 45))
    plain = parse("detect.asdf", "asdf_only").run(block, SYSTEM)
    paper = parse("detect.asdf", "asdf_only", detect__rule="paper").run(block, SYSTEM)
    assert (plain.count(300) == 2).mean() > 0.99 and (paper.count(300) == 1).mean() > 0.9
    for rule, table in (("absolute", plain), ("paper", paper)):
        noise = STAGES["noise.pooled"].function(block, SYSTEM)
        given = STAGES["detect.asdf"].function(block, noise, SYSTEM, rule=rule)
        np.testing.assert_array_equal(table.time, given.time)
    pulse = " ".join(f"{np.exp(-0.5 * ((x - 7) / 2.4) ** 2):.6f}" for x in range(15))
    mean = parse("detect.asdf", "asdf_only", detect__reference="given", detect__pulse=pulse).run(block, SYSTEM)
    assert 0 < np.abs(mean.time - plain.time).max() < 0.2
    for detector in ("detect.correlation", "detect.matched_filter"):
        other = parse(detector, "asdf_only").run(block, SYSTEM)
        assert len(other) == len(plain) and not np.array_equal(other.time, plain.time)


@pytest.mark.parametrize("detector", ["maximum", "wavelet", "threshold", "second_derivative", "richardson_lucy"])
def test_asdf_only_refuses_detectors_without_a_reference(detector):
    refuses(ConfigError, "decompose.none", parse, f"detect.{detector}", "asdf_only")


def test_the_error_of_the_parabola_covers_its_bias():
    """Sigma 1 ns, strong echoes: the paper's parabola is wrong by 0.018 ns, eight times the bound."""
    recording = Recording(n_samples=64, bits=16, baseline=20.0, baseline_spread=0.0)
    rng = np.random.default_rng(5)
    time = 30 + rng.uniform(-0.5, 0.5, (2000, 1))
    block, _ = simulate_echoes(recording, time, np.array([500.0]), 1.0, rng)
    system, noise = replace(SYSTEM, sigma_ref=1.0), known_noise(recording, 2000)
    ratio = {}
    for kind in ("parabola", "log"):
        given = STAGES["detect.asdf"].function(block, noise, system, interpolation=kind)
        found = STAGES["decompose.asdf_only"].function(block, noise, system, given)
        error = found.time - time[found.waveform, 0]
        error = error[np.abs(error) < 1]
        ratio[kind] = np.sqrt(np.mean(error**2)) / np.median(found.time_err)
    assert ratio["parabola"] == pytest.approx(1.0, abs=0.1) and ratio["log"] == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("model", ["skewed", "generalized", "learned"])
def test_the_loop_knows_other_pulses_than_gaussians(model):
    """Single echoes that are no Gaussians: with their model nothing is added, with Gaussians an echo to most."""
    n, x = 300, np.arange(90.0)
    rng = np.random.default_rng(6)
    time = 30 + rng.uniform(-0.5, 0.5, n)
    system = replace(SYSTEM, skew=0.3)
    if model == "skewed":
        y = np.stack([naive.pulse(x, t, 2.0, 0.3) for t in time])
    elif model == "generalized":
        y = naive.power_pulse(x, time[:, None], 4.0, 4.0)
    else:
        system = replace(SYSTEM, components=((1.0, 0.0, 2.0), (0.15, 7.0, 2.0)))
        y = np.stack([naive.pulse(x, t, 2.0) + 0.15 * naive.pulse(x, t + 7, 2.0) for t in time])
    counts = np.rint(20 + 150 * y + rng.standard_normal(y.shape)).astype(np.uint16)
    block, noise = WaveformBlock.from_samples(counts), known_noise(RECORDING, n)
    candidates = STAGES["detect.maximum"].function(block, noise, system)
    loop = STAGES["decompose.residual_loop"].function
    counted = {one: loop(block, noise, system, candidates, model=one).count(n) for one in ("gaussian", model)}
    assert (counted["gaussian"] > 1).mean() > 0.5 and (counted[model] == 1).mean() > 0.95


@pytest.mark.parametrize(("given", "model"), [
    ({}, "gaussian"), ({"kappa": 0.3}, "skewed"), ({"components": ((1.0, 0.0, 2.0), (0.15, 7.0, 2.0))}, "learned"),
])  # fmt: skip
def test_the_loop_fits_the_pulse_of_the_survey_unless_told_otherwise(given, model):
    block, noise, _ = record(60, (100, 28), (60, 33))
    system = replace(SYSTEM, **given)
    candidates = STAGES["detect.maximum"].function(block, noise, system)
    stage = STAGES["decompose.residual_loop"]
    assert_same(stage.function(block, noise, system, candidates),
                stage.function(block, noise, system, candidates, model=model))  # fmt: skip
    step = Step(stage)
    assert stage.fits(system, step.effective()) == stage.fits(system, {**step.effective(), "model": model})


def test_the_unit_of_the_loops_threshold():
    """2 % of the largest sample is 4 counts here; noise is 1.04: the same threshold in all units adds the same."""
    block, noise, _ = record(300, (200, 28), (14, 40))
    top = np.median((block.samples - 20.0).max(axis=1))
    tables = [
        decompose("residual_loop", block, noise, t_diff=value, t_unit=unit).count(300)
        for unit, value in (("noise", 5.0), ("count", 5.0 * STD), ("amplitude", 5.0 * STD / top))
    ]
    np.testing.assert_array_equal(tables[0], tables[1])
    assert (tables[0] == tables[2]).mean() > 0.9
    never = decompose("residual_loop", block, noise, t_diff=1.0, t_unit="amplitude")
    assert_same(never, decompose("gaussian", block, noise, tolerance=0.1))


def test_widths_stay_in_their_box():
    """Eq. 4: an echo of 12 ns, six widths of the pulse, is cut off at 4 of them unless the chain allows more.

    `adaptive` takes it whole in place of several."""
    block, noise, _ = record(200, (300, 32), width=12.0)
    for name in ("gaussian", "residual_loop", "adaptive", "closed_form", "generalized_gaussian"):
        usual = decompose(name, block, noise)
        alone = (usual.flags & EchoFlag.MERGED) == 0
        if name == "adaptive":
            assert np.median(usual.sigma[usual.amplitude > 200]) == pytest.approx(12, abs=0.5)
            continue
        assert usual.sigma[alone].max() <= 4 * 2.0 * (1 + 1e-5)
        wide = decompose(name, block, noise, most_width=10.0)
        strongest = wide.take(wide.amplitude > 200)
        assert np.median(strongest.sigma) == pytest.approx(12, abs=0.5), name
        bound = usual.take(usual.amplitude > 100)
        assert (bound.flags & EchoFlag.AT_BOUND).astype(bool).mean() > 0.5, name
        narrow = decompose(name, *record(50, (300, 32), width=1.0)[:2], least_width=0.3)
        assert np.median(narrow.sigma[narrow.amplitude > 200]) == pytest.approx(1.0, abs=0.1), name


@pytest.mark.parametrize("shape", [GAUSSIAN, GAUSSIAN._replace(components=((0.2, 9.0, 1.5), (-0.05, -4.0, -0.2)))])
def test_long_waveforms_are_rendered_in_pieces_that_do_not_depend_on_other_waveforms(shape):
    rng = np.random.default_rng(5)
    s, m = 3 * render.COLUMNS + 1, 300
    waveform = np.sort(rng.integers(0, 4, m)).astype(np.int32)
    columns = (rng.uniform(0, s, m), rng.uniform(5, 200, m), rng.uniform(1, 4, m))
    whole = render.render_echoes(shape, 4, s, waveform, *columns)
    x = np.arange(s, dtype=np.float32)
    for row in range(4):
        own = np.flatnonzero(waveform == row)
        time, height, width = (values[own].astype(np.float32)[:, None] for values in columns)
        dense = (render.evaluate_pulse(shape, x, time, width)[0] * height).sum(axis=0)
        np.testing.assert_allclose(whole[row], dense, rtol=1e-4, atol=1e-3)
        alone = render.render_echoes(shape, 1, s, np.zeros(len(own), np.int32), *(values[own] for values in columns))
        np.testing.assert_array_equal(alone[0], whole[row])


def test_the_loop_stops_at_its_number_of_echoes():
    rng = np.random.default_rng(3)
    block = WaveformBlock.from_samples(rng.integers(0, 256, (50, 80)).astype(np.uint8))
    noise = Noise(np.full(50, 20, np.float32), np.ones(50, np.float32))
    for most in (1, 3):
        start = decompose("gaussian", block, noise, tolerance=0.1).count(50)
        number = decompose("residual_loop", block, noise, max_echoes=most).count(50)
        assert (number <= np.maximum(start, most) + 1).all()


@pytest.mark.parametrize("std", [1.0, 4.0])
def test_the_stop_rule_in_counts_does_not_depend_on_the_noise(std):
    """A second echo of 20 counts is added by a limit of 14 counts, whatever the noise is said to be, and not by 26."""
    recording = replace(RECORDING, noise_std=0.1)
    block, _ = simulate_echoes(recording, np.tile([20.0, 32.0], (40, 1)), np.array([200.0, 20.0]), 2.0,
                               np.random.default_rng(1))  # fmt: skip
    noise = replace(known_noise(recording, 40), std=np.full(40, std, np.float32))
    first = EchoTable.build(np.arange(40), np.full(40, 20.0), np.full(40, 200.0), np.full(40, 2.0))
    loop = STAGES["decompose.residual_loop"].function
    for limit, expected in ((14.0, 2), (26.0, 1)):
        found = loop(block, noise, SYSTEM, first, t_diff=limit, t_unit="count", significance=0.0)
        assert (found.count(40) == expected).all(), limit
