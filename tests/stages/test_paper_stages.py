"""Decomposers that reproduce what the papers compare with."""

import numpy as np
import pytest
from contract_tools import assert_same, record
from given_echoes import FINE, fine_recording, known_noise, known_system, simulate_echoes
from published import PULSE_SIGMA as SIGMA

from wavebatch.core.echoes import EchoFlag, EchoTable
from wavebatch.core.errors import ConfigError
from wavebatch.core.units import HALF_C
from wavebatch.core.waveforms import SystemPulse, WaveformBlock
from wavebatch.kernels.fit.closed_form import bound_time
from wavebatch.stages.chain import STAGES, Step, parse_chain
from wavebatch.stages.decompose.models import rebuild_waveforms

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
        assert_same(row[0], row[source])
        taken[source - 1] += 1
    assert taken.min() > 30
    with pytest.raises(ConfigError, match="decompose.none"):
        parse_chain(chain_text("asdf_mixed"), "c")


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
    block, noise = record(1, (100, [30.0]), std=0.0, s=60)
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
    block, noise = record(20, (150, np.linspace(30, 31, 20)))
    detector = "detect.asdf" if name == "asdf_mixed" else "detect.maximum"
    given = STAGES[detector].function(block, noise, SYSTEM)
    step = Step(STAGES[f"decompose.{name}"])
    found = step.stage.function(block, noise, SYSTEM, given)
    left = block.samples - noise.level - rebuild_waveforms(block, SYSTEM, step, found)
    assert np.abs(left).max() < (20 if name == "log_normal" else 8) * FINE
