"""Errors hold neighbours that are too close to be found, as far as the strip's pairs tell."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from commands import run_command, succeed

from wavebatch.core.echoes import UNCLEAN, EchoTable
from wavebatch.core.waveforms import SystemPulse
from wavebatch.stages.chain import load_profile
from wavebatch.stages.decompose.merge import cover_hidden
from wavebatch.stages.score import match_echoes
from wavebatch.surveying import survey_block
from wavebatch.surveying.measuring.choose_pulse import bear
from wavebatch.tools.simulate import find_scene, simulate_block

ACCURATE = load_profile("accurate")


def scaled_errors(scene, system, block, truth):
    """Errors of clear echoes over the reported ones, of time, amplitude, energy and width: without flags, and with."""
    found = ACCURATE.run(block, system)
    match = match_echoes(found, truth)
    clear = truth.amplitude[match.truth] > 10 * find_scene(scene).recording.recorded_noise
    found, at = found.take(match.found[clear]), match.truth[clear]
    energy = found.amplitude * found.sigma
    scaled = np.stack([
        (found.time - truth.time[at]) / found.time_err,
        (found.amplitude - truth.amplitude[at]) / found.amplitude_err,
        (1 - truth.amplitude[at] * truth.sigma[at] / energy) / found.relative_energy_err,
        (found.sigma - truth.sigma[at]) / found.sigma_err,
    ])  # fmt: skip
    flagged = (found.flags & np.uint16(UNCLEAN)) != 0
    return scaled[:, ~flagged], scaled[:, flagged]


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


def test_what_is_hidden_changes_errors_and_no_echo():
    block, _ = simulate_block("forest", 3000, np.random.default_rng(3))
    system = survey_block(block).system
    found, bare = (ACCURATE.run(block, one) for one in (system, replace(system, hidden=())))
    for name in ("time", "amplitude", "sigma", "flags"):
        assert np.array_equal(getattr(found, name), getattr(bare, name)), name
    for name in ("time_err", "amplitude_err", "relative_energy_err", "sigma_err"):
        more = getattr(found, name) - getattr(bare, name)
        assert (more >= 0).all() and more.max() > 0, name
    # An echo of two lies nearer to the brighter one: the light of the other one is less than half of all.
    assert 0.5 < max(share for _, *shares in system.hidden_light for share in shares) < 1.3


@pytest.mark.quick_cases("forest-3000")
@pytest.mark.parametrize(("scene", "pulses"), [("canopy.corn", 6000), ("forest", 3000)])
def test_errors_of_widths_hold_what_hidden_neighbours_add(scene, pulses):
    """Widths of the strip hold them too: pairs drawn from these said too little (lone echoes of corn: 47 %)."""
    block, truth = simulate_block(scene, pulses, np.random.default_rng(12))
    plain, _ = scaled_errors(scene, survey_block(block).system, block, truth)
    assert 0.68 < np.mean(np.abs(plain[3]) < 1) < 0.85


def test_a_survey_of_an_earlier_version_is_named(tmp_path):
    """It has no `hidden_light` and `hidden_width`, so that errors are too small in forests: nothing said so."""
    strip, system = tmp_path / "f.las", tmp_path / "f.toml"
    for words in (("simulate", "forest", "-o", strip, "--pulses", 2000), ("survey", strip, "-o", system)):
        assert run_command(*words).exit_code == 0
    said = {}
    for name, text in {"new": system.read_text(), "old": re.sub("(?m)^hidden_.*\n", "", system.read_text())}.items():
        (tmp_path / f"{name}.toml").write_text(text)
        succeed("run", strip, "-o", tmp_path / name, "--system", tmp_path / f"{name}.toml")
        remarks = json.loads((tmp_path / name / "f.report.json").read_text())["remarks"]
        said[name] = [line for line in remarks if "an earlier version made this file" in line]
    assert not said["new"] and "without hidden_light and hidden_width" in said["old"][0]


@pytest.mark.slow
@pytest.mark.parametrize("scene", ["forest", "mixed", "urban"])
def test_errors_cover_hidden_neighbours(scene):
    """Over three strips, since each survey knows its strip's pairs to a fifth only."""
    bare, covered = [], []
    for seed in (5, 6, 7):
        block, truth = simulate_block(scene, 5000, np.random.default_rng(seed))
        system = survey_block(block).system
        bare.append(scaled_errors(scene, replace(system, hidden=()), block, truth))
        covered.append(scaled_errors(scene, system, block, truth))
    bare, covered = ([np.hstack(kind) for kind in zip(*pairs, strict=True)] for pairs in (bare, covered))
    assert min(rms(kind[0]) for kind in bare) > 2
    assert 0.7 < rms(covered[0][0]) < 1.2
    assert 0.8 < rms(covered[1][0]) < 1.3
    for kind, before in zip(covered, bare, strict=True):
        within = np.mean(np.abs(kind[1:]) < 1, axis=1)
        assert (within > 0.6).all() and (within < 0.8).all()
        assert all(rms(kind[row]) <= rms(before[row]) for row in (1, 2, 3))


def test_a_strip_of_lone_echoes_has_the_errors_of_the_fit():
    block, _ = simulate_block("slope", 3000, np.random.default_rng(5))
    assert survey_block(block).system.hidden == ()


def test_the_cover_is_that_of_a_loop(rng):
    system = SystemPulse(
        1.5,
        hidden=((0.1, 0.2, 0.05), (0.4, 0.3, 0.1), (1.6, 0.1, 0.02)),
        hidden_light=((0.2, 0.02, 0.1), (0.8, 0.3, 0.01)),
        hidden_width=((0.3, 0.1, 0.2), (0.9, 0.2, 0.05)),
    )
    waveform = np.sort(rng.integers(0, 40, 60)).astype(np.int32)
    sigma = rng.uniform(1.2, 3.5, 60)
    errors = {"time_err": rng.uniform(0, 0.1, 60), "sigma_err": rng.uniform(0, 0.2, 60)}
    errors |= {"amplitude_err": rng.uniform(0, 2, 60), "relative_energy_err": rng.uniform(0, 0.1, 60)}
    table = EchoTable.build(waveform, rng.uniform(0, 50, 60), np.full(60, 40.0), sigma, **errors)
    covered = cover_hidden(table, system, 40)
    lone, others = 0, 0
    for i in range(60):
        variance, its_error = float(table.sigma[i]) ** 2, 2 * float(table.sigma[i]) * float(table.sigma_err[i])
        excess = max((variance - its_error) / 1.5**2 - 1, 0)
        alone = np.count_nonzero(waveform == waveform[i]) == 1
        lone, others = lone + alone, others + (not alone)
        share = np.interp(excess, [0.1, 0.4, 1.6], [0.2, 0.3, 0.1] if alone else [0.05, 0.1, 0.02])
        expected = np.sqrt(float(table.time_err[i]) ** 2 + share * excess * 1.5**2)
        assert covered.time_err[i] == pytest.approx(expected, rel=1e-5)
        light = np.sqrt(excess) * np.interp(excess, [0.2, 0.8], [0.02, 0.3] if alone else [0.1, 0.01])
        height, energy = table.amplitude_err[i], table.relative_energy_err[i]
        assert covered.amplitude_err[i] == pytest.approx(np.hypot(height, light * 40.0), rel=1e-5)
        assert covered.relative_energy_err[i] == pytest.approx(np.hypot(energy, light), rel=1e-5)
        wide = np.sqrt(excess) * np.interp(excess, [0.3, 0.9], [0.1, 0.2] if alone else [0.2, 0.05])
        expected = np.hypot(float(table.sigma_err[i]), wide * float(table.sigma[i]))
        assert covered.sigma_err[i] == pytest.approx(expected, rel=1e-5)
    assert lone and others
    old = replace(system, hidden_light=(), hidden_width=())  # a survey of an earlier version
    earlier = cover_hidden(table, old, 40)
    assert np.array_equal(earlier.time_err, covered.time_err)
    assert all(np.array_equal(getattr(earlier, name), getattr(table, name)) for name in ("amplitude_err", "sigma_err"))
    assert cover_hidden(table, replace(system, hidden=()), 40) is table


def test_pulses_are_judged_without_what_is_hidden():
    """Errors that hold neighbours belong to one pulse of a survey: with them another pulse is not compared alike."""
    known = {"hidden": ((1.0, 0.1),), "hidden_light": ((1.0, 0.1, 0.2),), "hidden_width": ((1.0, 0.1, 0.2),)}
    borne = bear(SystemPulse(sigma_ref=2.0, **known), 0.05)
    assert (borne.hidden, borne.hidden_light, borne.hidden_width) == ((), (), ()) and borne.misfit > 0
