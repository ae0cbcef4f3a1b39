"""Goodness of fit against loops, Wang's tables (T7), and the model of every decomposer."""

import naive
import numpy as np
import pytest

from wavebatch.core.echoes import EchoTable
from wavebatch.core.system import ReceiverNoise
from wavebatch.core.waveforms import Noise, SystemPulse, WaveformBlock
from wavebatch.stages.chain import STAGES, Step
from wavebatch.stages.decompose.models import fitted_pulse, rebuild_waveforms
from wavebatch.tools.compare.chains import FitQuality, measure_fit

FINE = 100.0
LEARNED = ((1.0, 0.0, 2.0), (0.12, 7.0, 2.0))


def record(y, std):
    block = WaveformBlock.from_samples(np.rint(2000 + FINE * y).astype(np.uint16))
    return block, Noise(np.full(len(y), 2000, np.float32), np.full(len(y), FINE * std, np.float32))


def decompose(name, block, noise, system, **parameters):
    step = Step(STAGES[f"decompose.{name}"], parameters)
    candidates = STAGES["detect.maximum"].function(block, noise, system)
    return step, step.stage.function(block, noise, system, candidates, **parameters)


def test_every_decomposer_says_what_it_fits():
    steps = [Step(stage) for stage in STAGES.values() if stage.kind == "decompose"]
    unfitted = {step.stage.name for step in steps if fitted_pulse(step, SystemPulse(2.0), 1.0) is None}
    assert unfitted == {"decompose.none"}


CASES = [(name, {}, {}) for name in ("closed_form", "gaussian", "residual_loop", "asdf_only")]
CASES += [("adaptive", {}, {}), ("adaptive", {}, {"components": LEARNED}), ("reference", {}, {"components": LEARNED})]
CASES += [("reference", {"model": "stretched"}, {"components": LEARNED})]
CASES += [("generalized_gaussian", {}, {}), ("residual_loop", {"model": "generalized"}, {})]
CASES += [("residual_loop", {"model": "learned"}, {"components": LEARNED})]
CASES += [("residual_loop", {"model": "skewed"}, {"kappa": 0.12}), ("skewed", {"kappa": "free"}, {"kappa": 0.12})]
CASES += [("skewed", {}, {"kappa": 0.12}), ("skewed", {"kappa": 0.12}, {}), ("adaptive", {}, {"kappa": 0.12})]


@pytest.mark.parametrize(("name", "parameters", "shape"), CASES)
def test_clean_echoes_are_rebuilt_as_they_are(name, parameters, shape):
    """A wrong model would leave 0.002 (kappa 0.12) or more; ASDF takes its width from samples."""
    x, kappa = np.arange(80.0), shape.get("kappa", parameters.get("kappa", 0.0))
    y = np.stack([100 * naive.pulse(x, t, 2.0, kappa) for t in np.linspace(30, 31, 7)])
    if "components" in shape:
        y += 0.12 * np.stack([100 * naive.pulse(x, t + 7, 2.0) for t in np.linspace(30, 31, 7)])
    block, noise = record(y, std=0.05)
    system = SystemPulse(2.0, noise=ReceiverNoise(std=5.0), **shape)
    step, found = decompose(name, block, noise, system, **parameters)
    misfit, _ = measure_fit(block, noise, system, step, found)
    assert misfit.shape == (7,) and misfit.max() < (2e-3 if name == "asdf_only" else 2e-4)


def test_what_was_not_fitted_is_no_data():
    x = np.arange(80.0)
    block, noise = record(100 * naive.pulse(x, 30.0, 2.0)[None], std=0.05)
    step, found = decompose("none", block, noise, SystemPulse(2.0))
    assert len(found) and rebuild_waveforms(block, SystemPulse(2.0), step, found) is None
    misfit, floor = measure_fit(block, noise, SystemPulse(2.0), step, found)
    assert np.isnan(misfit).all() and np.isnan(floor).all()
    quality = FitQuality()
    quality.add(misfit, floor, found.count(1), np.ones(1, bool))
    assert quality.result() == {}


def test_as_a_loop_does_it(rng):
    """Waveforms with 0 to 3 Gaussian echoes, some clipped: E, E0, means and medians of the classes."""
    n, s, top = 300, 64, 255
    count = rng.integers(0, 4, n)
    waveform = np.repeat(np.arange(n), count)
    time, amplitude, sigma = (rng.uniform(*ends, len(waveform)) for ends in ((5, 59), (10, 300), (1.5, 3)))
    order = np.lexsort((time, waveform))
    echoes = EchoTable.build(waveform[order], time[order], amplitude[order], sigma[order])
    baseline, std = rng.uniform(8, 12, n).astype("f4"), rng.uniform(0.5, 2, n).astype("f4")
    x = np.arange(float(s))
    samples = np.zeros((n, s), np.uint8)
    naive_e, naive_floor = np.full(n, np.nan), np.full(n, np.nan)
    for w in range(n):
        mine = np.flatnonzero(waveform == w)
        f = sum((amplitude[m] * naive.pulse(x, time[m], sigma[m]) for m in mine), np.zeros(s))
        samples[w] = np.clip(np.rint(baseline[w] + f + std[w] * rng.standard_normal(s)), 0, top)
        used = samples[w] < top
        if len(mine):
            naive_e[w] = ((f - (samples[w] - float(baseline[w])))[used] ** 2).sum() / (f[used] ** 2).sum()
            naive_floor[w] = used.sum() * float(std[w]) ** 2 / (f[used] ** 2).sum()
    assert (samples == top).any()
    block = WaveformBlock.from_samples(samples)
    step = Step(STAGES["decompose.gaussian"])
    misfit, floor = measure_fit(block, Noise(baseline, std), SystemPulse(2.0), step, echoes)
    np.testing.assert_allclose(misfit, naive_e, rtol=1e-4)
    np.testing.assert_allclose(floor, naive_floor, rtol=1e-5)
    quality, both = FitQuality(), (count > 0) & (rng.random(n) < 0.5)
    for part in np.array_split(np.arange(n), 7):
        quality.add(misfit[part], floor[part], count[part], both[part])
    found = quality.result()
    for name, rows in (("all", count > 0), ("single", count == 1), ("multi", count > 1), ("both", both)):
        assert found[name].waveforms == rows.sum()
        assert found[name].mean == pytest.approx(naive_e[rows].mean(), rel=1e-4)
        assert found[name].median == pytest.approx(np.median(naive_e[rows]), rel=1e-4)
        assert found[name].floor_mean == pytest.approx(naive_floor[rows].mean(), rel=1e-4)
        assert found[name].floor_median == pytest.approx(np.median(naive_floor[rows]), rel=1e-4)


WANG = [(0.104, 0.0214, 0.0089, 0.0069), (0.184, 0.0158, 0.0100, 0.0037), (0, 0.0097, 0.0014, 0.0014)]
WANG += [(0.05, 0.0186, 0.0058, 0.0052)]


@pytest.mark.parametrize(("kappa", "noise_share", "gaussian", "log_normal"), WANG)
def test_tables_of_wang_et_al(kappa, noise_share, gaussian, log_normal):
    """T7: mean E of Gaussian and log-normal fits for Leica ground, tree, Riegl ground, tree, within 10 %."""
    n, x, sigma = 400, np.arange(60.0), 5 / 2.354820045
    rng = np.random.default_rng(int(1e4 * noise_share) + 1)
    time, std = 30 + rng.uniform(-0.5, 0.5, n), 100 * noise_share
    y = np.stack([100 * naive.pulse(x, t, sigma, kappa) for t in time]) + std * rng.standard_normal((n, 60))
    block, noise = record(y, std)
    system = SystemPulse(sigma, kappa=kappa)
    for name, published in (("gaussian", gaussian), ("skewed", log_normal)):
        step, found = decompose(name, block, noise, system)
        misfit, floor = measure_fit(block, noise, system, step, found)
        alone = found.count(n) == 1
        assert alone.mean() > 0.95
        assert misfit[alone].mean() == pytest.approx(published, rel=0.10), name
        assert floor[alone].mean() == pytest.approx(60 * noise_share**2 / (np.sqrt(np.pi) * sigma), rel=0.03)


def test_the_floor_is_that_of_single_samples_where_noise_is_coloured():
    """Thresholds use what noise does to a pulse: E0 was .116 on a strip whose fits leave .024."""
    block, noise = record(100 * naive.pulse(np.arange(60.0), 30.0, 2.0)[None], std=1.0)
    echo = EchoTable.build(np.zeros(1), np.array([30.0]), np.array([100 * FINE]), np.array([2.0]))
    step = Step(STAGES["decompose.gaussian"])
    plain = measure_fit(block, noise, SystemPulse(2.0, noise=ReceiverNoise(std=1.6)), step, echo)[1]
    system = SystemPulse(2.0, noise=ReceiverNoise(std=1.6, by_kind={"quiet": 0.8}))
    coloured = measure_fit(block, noise, system, step, echo)[1]
    assert coloured == pytest.approx(plain / 4, rel=1e-5)


def test_floor_of_the_specification():
    """0.00159 for 60 samples, amplitude over noise 100, sigma 2.123."""
    block, noise = record(100 * naive.pulse(np.arange(60.0), 30.0, 2.123)[None], std=1.0)
    echo = EchoTable.build(np.zeros(1), np.array([30.0]), np.array([100 * FINE]), np.array([2.123]))
    misfit, floor = measure_fit(block, noise, SystemPulse(2.123), Step(STAGES["decompose.gaussian"]), echo)
    assert floor[0] == pytest.approx(0.00159, abs=1e-5)
    assert misfit[0] < 1e-6


def test_many_waveforms_are_thinned_evenly():
    quality, step = FitQuality(1000), 137
    misfit = np.random.default_rng(3).permutation(20_000) / 20_000
    for begin in range(0, 20_000, step):
        part = misfit[begin : begin + step]
        quality.add(part, 2 * part, np.ones(len(part), int), np.ones(len(part), bool))
    found = quality.result()["single"]
    assert found.waveforms == 20_000 and found.mean == pytest.approx(misfit.mean())
    assert found.median == pytest.approx(0.5, abs=0.06) and found.floor_median == 2 * found.median
