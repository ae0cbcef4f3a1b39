"""Shipped pulses: where they come from, when a small strip gets one, and that no other sensor does."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from helpers_scenes import make_block, make_scene
from strips import cut_strip
from writer_tools import data_file

from wavebatch.core.echoes import EchoFlag
from wavebatch.core.units import FWHM_PER_SIGMA
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying import survey_block, survey_blocks
from wavebatch.surveying.choose_chain import choose_chain, read_sample
from wavebatch.surveying.measuring.residuals import decompose_sample
from wavebatch.surveying.systems import known_systems as module
from wavebatch.surveying.systems.known_systems import (
    compare_pulses,
    doubt_survey,
    draw_pulse,
    find_likeness,
    find_source,
    known_systems,
)
from wavebatch.surveying.systems.survey_result import load_survey
from wavebatch.tools.simulate import PulseModel, find_pulse

KNOWN = {one.name: one for one in known_systems()}


def _survey(path):
    with StripReader(path) as reader, reader.scan() as scan:
        return survey_blocks(read_sample(reader, scan))


def _count_echoes(path, survey) -> int:
    chain, number = choose_chain(survey), 0
    with StripReader(path) as reader, reader.scan() as scan:
        for unit in range(reader.unit_count()):
            for block, _ in reader.read_blocks(reader.read_unit(unit, scan), 8192, owned_only=True):
                number += len(chain.run(block, survey.system))
    return number


def _half_width(system: SystemPulse) -> float:
    """Full width of a pulse at half of its height [ns]."""
    lag = np.arange(-40.0, 60.0, 0.01)
    height = draw_pulse(system, lag)
    return 0.01 * np.count_nonzero(height > 0.5 * height.max())


def test_what_is_shipped():
    assert {name: one.sensor for name, one in KNOWN.items()} == {
        "riegl-q680i": "RIEGL LMS-Q680i", "leica-als": "Leica ALS", "geolas-q560": "GeoLas (RIEGL LMS-Q560)",
        "nasa-lvis": "NASA LVIS", "neon-gemini": "Optech Gemini of NEON AOP",
    }  # fmt: skip
    folder = Path(module.__file__).parent
    for one in KNOWN.values():
        text = (folder / f"{one.name}.toml").read_text("utf-8")
        assert "wavebatch survey " in text and "licence" in text, "how it was made and what it may be used for"
        assert load_survey(folder / f"{one.name}.toml").survey.system == one.system, "--system takes it"
        assert one.spacing == (2.0 if one.name == "nasa-lvis" else 1.0)
        assert len(one.system.components) > 1 and find_source(one.system) is one
        assert find_source(replace(one.system, sigma_ref=1.01 * one.system.sigma_ref)) is None
    # The outgoing pulses of the flights that they were measured on, and the impulse response of the Gemini's receiver.
    for name, width in (("geolas-q560", 4.05), ("neon-gemini", 15.1)):
        assert _half_width(KNOWN[name].system) == pytest.approx(width, rel=0.03)
    assert _half_width(KNOWN["nasa-lvis"].system) == pytest.approx(6.6, rel=0.05)
    assert FWHM_PER_SIGMA * KNOWN["riegl-q680i"].system.sigma_ref == pytest.approx(4.55, rel=0.05)


@pytest.mark.quick_cases("*leica*")
@pytest.mark.parametrize(("strip", "name"), [("riegl", "riegl-q680i"), ("leica", "leica-als")])
def test_a_shipped_pulse_is_that_of_its_strip(strip, name, request):
    system = _survey(request.getfixturevalue(strip)).system
    likeness = find_likeness(system, 1.0)
    remedy = "the survey has changed: make the file again, as its comment says"
    assert likeness and likeness.known.name == name and likeness.difference < 0.02, remedy
    assert KNOWN[name].sensor in likeness.describe()


@pytest.mark.slow
def test_pulses_that_change_from_shot_to_shot_have_at_least_their_known_misfit():
    """Outgoing pulses of LVIS miss their mean by 3 %; of that its echoes have nothing in common, and add no echo."""
    system = _survey(data_file("lvis/lvis1.las")).system
    assert find_source(system).name == "nasa-lvis" and system.misfit >= KNOWN["nasa-lvis"].system.misfit == 0.027


@pytest.mark.slow
@pytest.mark.parametrize(("points", "error"), [(11, 0.03), (54, 0.03), (100, 0.03)])
def test_a_small_strip_has_the_echoes_of_the_whole_strip(riegl, tmp_path, points, error):
    """54 points are 53 packets. With a Gaussian they had 116 echoes, since each after-pulse became one."""
    path = cut_strip(riegl, tmp_path / "cut.las", points)
    small, whole = _survey(path), _survey(riegl)
    assert _count_echoes(path, small) == pytest.approx(_count_echoes(path, whole), rel=error)
    if small.figures.isolated_echoes < 20:
        assert find_source(small.system).name == "riegl-q680i"
        reason = next(one.reason for one in small.decisions if one.part == "sum of Gaussians")
        assert reason.startswith("riegl-q680i: ")


@pytest.mark.slow
@pytest.mark.parametrize("first", [317, 528])
def test_a_small_strip_finds_the_echoes_of_the_whole(first):
    """Fifty packets that take the shipped pulse, and fifty that a pulse of their own describes in 1,200 nats less."""
    with StripReader(data_file("geolas/geolas1.las")) as reader, reader.scan() as scan:
        blocks = read_sample(reader, scan)
    part = [block.rows(slice(first, first + 50)) for block in blocks[:1]]
    small, whole = survey_blocks(part), survey_blocks(blocks)
    assert len(part[0]) == 50
    found, right = (sum(len(choose_chain(one).run(block, one.system)) for block in part) for one in (small, whole))
    assert found == pytest.approx(right, rel=0.1)


def test_fifty_packets_with_hardly_an_isolated_echo_are_a_guess(leica, tmp_path):
    """Five Gaussians explained the fifty packets that they were learned from: 82 % more echoes, and no word."""
    small = _survey(cut_strip(leica, tmp_path / "cut.las", 50))
    assert [one.code for one in doubt_survey(small.system, small.figures, small.waveforms)] == ["pulse-guess"]


OTHERS = {
    "narrow": PulseModel(1.85), "wide": PulseModel(3.4), "skewed": PulseModel(1.9, kappa=-0.1),
    "very skewed": PulseModel(3.4, kappa=0.2), "simulated riegl": find_pulse("riegl"),
    "simulated leica": find_pulse("leica"), "ringing": PulseModel(1.85).with_ringing(0.04),
    "early after-pulse": PulseModel(1.85, 0.0, ((0.04, 8.0, 1.8),)), "tail": PulseModel(1.85, 0.0, ((0.05, 4.0, 4.0),)),
}  # fmt: skip


@pytest.mark.quick_cases("flat-wide")
@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("scene", ["flat", "urban"])
def test_a_small_strip_of_another_sensor_gets_no_known_pulse_in_silence(name, scene):
    for number, seed in ((20, 1), (20, 2), (40, 3)):
        block = make_block(make_scene(scene, pulse=OTHERS[name], n_samples=100), number, seed=seed)[0]
        survey = survey_block(block)
        doubts = [one.code for one in doubt_survey(survey.system, survey.figures, survey.waveforms)]
        source = find_source(survey.system)
        assert doubts == ["pulse-guess"] if source else find_likeness(survey.system, 1.0) is None


@pytest.mark.parametrize(("share", "delay"), [(0.04, 8.0), (0.06, 13.0)])
def test_after_pulses_of_an_unknown_sensor_are_no_echoes_or_flagged(share, delay):
    pulse = PulseModel(1.85, 0.0, ((share, delay, 1.8),))
    block = make_block(make_scene("flat", pulse=pulse, n_samples=100), 18, seed=5)[0]
    system = survey_block(block).system
    assert not system.components and 0.8 * share < system.ringing < 1.6 * share
    echoes = decompose_sample(block, system)
    first = np.r_[0, np.flatnonzero(np.diff(echoes.waveform)) + 1]
    strongest = np.maximum.reduceat(echoes.amplitude, first)
    after = echoes.amplitude < 0.1 * np.repeat(strongest, np.diff(np.r_[first, len(echoes)]))
    suspect = (echoes.flags[after] & int(EchoFlag.RINGING_SUSPECT)) != 0
    # Eighteen after-pulses: in 0.2 of them noise may be higher.
    assert np.count_nonzero(~suspect) <= 3 and (suspect.any() or system.tail_misfit)


def test_a_gaussian_of_a_small_strip_has_the_width_of_its_echoes():
    """It was 2 samples, a guess, with fewer than 20 isolated echoes."""
    survey = survey_block(make_block(make_scene("flat", pulse=PulseModel(3.4), n_samples=100), 12, seed=1)[0])
    assert survey.figures.isolated_echoes < 20
    assert survey.system.sigma_ref == pytest.approx(3.4, rel=0.05) and survey.system.ringing == 0


def test_pulses_are_compared_by_shape_alone():
    pulse = KNOWN["riegl-q680i"].system
    assert compare_pulses(pulse, pulse) < 1e-6
    a, b = SystemPulse(sigma_ref=2.0), SystemPulse(sigma_ref=2.04)
    assert compare_pulses(a, b) == pytest.approx(0.014, abs=0.001)
    assert compare_pulses(b, a) == pytest.approx(compare_pulses(a, b))
    assert find_likeness(SystemPulse(sigma_ref=pulse.sigma_ref), 1.0) is None, "any Gaussian of its width"
    assert find_likeness(pulse, 0.5) is None and find_likeness(pulse, 1.0).difference < 1e-6


@pytest.mark.parametrize("known", KNOWN.values(), ids=lambda one: one.name)
def test_shipped_files_say_how_unlike_a_gaussian_their_pulse_is(known):
    widths = known.system.sigma_ref * np.linspace(0.7, 1.5, 21)
    nearest = min(compare_pulses(known.system, SystemPulse(sigma_ref=float(width))) for width in widths)
    assert known.unlike_gaussian == pytest.approx(nearest, abs=1e-6)
