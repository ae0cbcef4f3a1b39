"""One survey of all strips of a flight: the same for any order, and strips of other sensors are found."""

import itertools
from dataclasses import replace

import pytest
from commands import refuses
from helpers_scenes import make_scene
from strips import cut_strip

from wavebatch.core.errors import ConfigError
from wavebatch.files.strip.reader import StripReader
from wavebatch.surveying import survey_blocks
from wavebatch.surveying.flight import compare_flight, read_samples, survey_flight
from wavebatch.surveying.look import read_flight, surveys_agree
from wavebatch.surveying.systems.survey_result import SavedSurvey, format_survey, parse_survey
from wavebatch.tools.simulate import PulseModel, find_pulse, simulate_strip

PULSE = find_pulse("riegl")
STRIPS = {
    "flat": ("flat", {}), "urban": ("urban", {}), "forest": ("forest", {}),
    "level": ("flat", {"baseline": 13.5}), "noise": ("flat", {"noise_std": 1.6}),
    "wide": ("flat", {"pulse": PulseModel(2.6)}), "narrow": ("urban", {"pulse": PulseModel(1.6)}),
    "gaussian": ("flat", {"pulse": PulseModel(2.0)}), "spacing": ("flat", {"spacing": 0.5}),
    "clipped": ("urban", {"saturation": 120}), "calm": ("flat", {"noise_std": 0.68}),
    "other": ("flat", {"pulse": PulseModel(1.6), "bits": 16, "baseline": 13.5}),
}  # fmt: skip
"""Scene and what its recording has otherwise; the first three are of one flight."""
FLIGHT = ("flat", "urban", "forest")


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """Paths by name; names and content are in different orders."""
    folder, paths = tmp_path_factory.mktemp("flight"), {}
    for number, (name, (scene, recording)) in enumerate(STRIPS.items()):
        paths[name] = folder / f"{name}.las"
        scene = make_scene(scene, **{"pulse": PULSE, "n_samples": 100, **recording})
        simulate_strip(scene, paths[name], pulses=900, seed=number)
    return paths


@pytest.fixture(scope="module")
def flight(strips):
    return survey_flight(read_samples([strips[name] for name in FLIGHT], waveforms=2400))


def test_strips_of_one_sensor_belong_together_whatever_their_scene(flight):
    assert [strip.reason for strip in flight.strips] == ["", "", ""] and flight.misfits == []
    system = flight.saved.survey.system
    assert system.components and system.ringing == pytest.approx(0.04, abs=0.01)
    assert flight.saved.survey.waveforms == 2400 and flight.saved.strip == "3 strips"
    assert all(strip.waveforms == 800 for strip in flight.strips)


@pytest.mark.slow
def test_the_order_of_the_strips_does_not_matter(strips, flight):
    for names in itertools.islice(itertools.permutations(FLIGHT), 1, 6, 2):
        again = survey_flight(read_samples([strips[name] for name in names], waveforms=2400))
        assert format_survey(again.saved) == format_survey(flight.saved) and again.strips == flight.strips


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("level", "its level is 13."),
        ("noise", "its noise is 1."),
        ("wide", "steep slopes widen echoes as well"),
        ("narrow", "ns wide (Gaussian sigma), those of the flight"),
        ("gaussian", "the flight's pulse misses its strong echoes by"),
        ("spacing", "samples 0.5 ns apart; that of the flight has samples 1 ns apart"),
        ("clipped", "it is clipped at 120 DN"),
        ("other", "ns; its descriptor 1 has 16 bits; that of the flight has 8 bits"),
    ],
)
def test_a_strip_of_another_sensor_does_not_belong_to_them(strips, flight, name, words):
    """Compared with the flight as it is kept in a file, as a strip that comes later is; the pulse is named first."""
    kept = parse_survey(format_survey(flight.saved), "x")
    with StripReader(strips[name]) as reader, reader.scan() as scan:
        assert words in compare_flight(reader, scan, kept)


def test_a_stranger_does_not_give_a_descriptor_its_meaning(strips):
    """Each sensor had most waveforms of one of two descriptors: no strip fitted both, and nothing was surveyed."""
    samples = []
    for name, numbers in ("flat", (600, 60)), ("other", (100, 200)):
        parts = [read_samples([strips[name]], waveforms=number)[0] for number in numbers]
        blocks = [replace(part.blocks[0], digitizer=replace(part.blocks[0].digitizer, index=index))
                  for index, part in enumerate(parts, 1)]  # fmt: skip
        samples.append(replace(parts[0], blocks=tuple(blocks)))
    found = survey_flight(samples)
    assert [strip.path for strip in found.misfits] == [strips["other"]] and found.saved.survey.waveforms == 660


def test_a_strip_that_lacks_a_descriptor_has_a_vote_in_the_others(strips):
    """Descriptor 2 is decided first; a strip that has none says what descriptor 1 means."""
    samples = []
    for name, index, gain in ("flat", 2, 1.0), ("urban", 2, 1.0), ("forest", 1, 2.0):
        (sample,) = read_samples([strips[name]], waveforms=300)
        block = sample.blocks[0]
        block = replace(block, digitizer=replace(block.digitizer, index=index, gain=gain))
        samples.append(replace(sample, blocks=(block,)))
    assert survey_flight(samples).misfits == []


@pytest.mark.parametrize("name", [*FLIGHT, "calm"])
def test_a_later_strip_of_the_sensor_belongs_to_them(strips, flight, name):
    kept = replace(parse_survey(format_survey(flight.saved), "x"), fingerprint={})
    assert read_flight(kept.survey) == read_flight(flight.saved.survey)
    with StripReader(strips[name]) as reader, reader.scan() as scan:
        assert compare_flight(reader, scan, kept) == ""


def test_only_strips_whose_echoes_were_compared_are_not_compared_again(strips, flight):
    """Else a strip of too few echoes would keep a pulse that it was never compared with."""
    kept = parse_survey(format_survey(flight.saved), "x")
    surveyed = kept.fingerprint["strips"]
    assert len(surveyed) == 3 and all(strip["compared"] for strip in surveyed)
    wider = replace(kept.survey.figures, look=replace(kept.survey.figures.look, width=9.0))
    wrong = replace(kept, survey=replace(kept.survey, figures=wider))
    with StripReader(strips["flat"]) as reader, reader.scan() as scan:
        assert compare_flight(reader, scan, wrong) == ""
        for others in ({}, {"strips": "none"}, {"strips": [{**strip, "compared": False} for strip in surveyed]}):
            assert "those of the flight 9.00 ns" in compare_flight(reader, scan, replace(wrong, fingerprint=others))


@pytest.mark.parametrize("waveforms", [30, 900])
def test_a_share_with_too_few_echoes_or_waveforms_is_no_comparison(strips, waveforms):
    """By 64 waveforms of roofs, a receiver that clips and a pulse 10 % narrower were not seen."""
    few = survey_flight(read_samples([strips[name] for name in FLIGHT], waveforms=waveforms))
    assert few.misfits == [] and not any(strip["compared"] for strip in few.saved.fingerprint["strips"])


@pytest.mark.slow
def test_strangers_do_not_change_the_survey_of_the_others(strips, flight):
    names = ("wide", "flat", "level", "urban", "spacing", "forest")
    found = survey_flight(read_samples([strips[name] for name in names], waveforms=4800))
    assert {strip.path.stem for strip in found.misfits} == {"wide", "level", "spacing"}
    assert found.saved.survey.system == flight.saved.survey.system
    told = {strip["strip"]: strip for strip in (one.to_json() for one in found.strips)}
    assert told[str(strips["wide"])]["fits"] is False and told[str(strips["wide"])]["reason"]
    assert told[str(strips["flat"])]["fits"] is True and told[str(strips["flat"])]["points"] >= 900


def test_a_strip_that_cannot_be_read_is_left_out(strips, tmp_path):
    errors = []
    paths = [strips["flat"], tmp_path / "none.las"]
    samples = read_samples(paths, waveforms=200, on_error=lambda path, error: errors.append(path))
    assert [sample.path for sample in samples] == paths[:1] and errors == paths[1:]


def test_a_survey_of_one_strip_is_none_of_a_flight(strips):
    with StripReader(strips["flat"]) as reader, reader.scan() as scan:
        survey = survey_blocks(reader.sample_blocks(scan, 300))
        refuses(ConfigError, "holds no survey of a flight", compare_flight, reader, scan, SavedSurvey(survey))


@pytest.mark.slow
def test_surveys_that_agree(strips):
    surveys = {}
    for name in ("flat", "urban", "wide", "level"):
        with StripReader(strips[name]) as reader, reader.scan() as scan:
            surveys[name] = survey_blocks(reader.sample_blocks(scan, 900))
    assert surveys_agree([surveys["flat"], surveys["urban"]])
    for name in ("wide", "level"):
        assert not surveys_agree([surveys["flat"], surveys["urban"], surveys[name]])
    assert not surveys_agree([surveys["flat"]])


@pytest.mark.slow
def test_parts_of_real_strips_belong_to_them(riegl, leica, tmp_path):
    for path, other in ((riegl, leica), (leica, riegl)):
        part = cut_strip(path, tmp_path / path.name, 400)
        found = survey_flight(read_samples([path, part, other]))
        assert [strip.path for strip in found.misfits] == [other]
