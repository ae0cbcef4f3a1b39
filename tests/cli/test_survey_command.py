"""`wavebatch survey` as a user types it: what it prints, what it writes, and that `run` takes it."""

import json

import pytest
from commands import run_command
from helpers_scenes import make_scene
from strips import cut_strip

from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.stages.chain import load_chain_file
from wavebatch.surveying import Survey
from wavebatch.surveying.choose_chain import chain_text, decide
from wavebatch.surveying.systems.figures import Figures, describe_figures
from wavebatch.surveying.systems.survey_result import Tried, load_survey
from wavebatch.tools.sheets.sheet import list_lines
from wavebatch.tools.sheets.survey import NOISE_KINDS, survey_sheet
from wavebatch.tools.simulate import simulate_strip


def _survey(*arguments):
    return run_command("survey", *arguments)


@pytest.fixture(scope="module")
def flat_strip(tmp_path_factory):
    """2,500 pulses over bare ground."""
    path = tmp_path_factory.mktemp("flat") / "flat.las"
    simulate_strip("flat", path, pulses=2500, seed=1)
    return path


@pytest.fixture(scope="module")
def surveyed(flat_strip, tmp_path_factory):
    """Folder with SYSTEM.toml and CHAIN.toml, and what was printed."""
    folder = tmp_path_factory.mktemp("surveyed")
    result = _survey(flat_strip, "-o", folder / "SYSTEM.toml", "--chain", folder / "CHAIN.toml")
    assert result.exit_code == 0, result.output
    return folder, result


def test_the_text_has_every_measure_and_every_decision(flat_strip, surveyed):
    folder, result = surveyed
    lines = result.stdout.splitlines()
    for name in ("strip", "samples", "ADC range", "vectors", "baseline", "noise", "signal noise", "system pulse",
                 "pulses tried", "false echoes", "kappa", "ringing", "acceptance", "saturation", "waveforms",
                 "amplitudes", "widths", "decisions"):  # fmt: skip
        assert any(line.startswith(name) for line in lines), name
    found = load_survey(folder / "SYSTEM.toml").survey
    for kind, value in found.system.noise.by_kind.items():
        end = f"{value:.3f} DN" if value > 0 else "not known: too few samples"
        assert any(line.startswith(f"  {NOISE_KINDS[kind]} ") and line.endswith(end) for line in lines), kind
    for decision in decide(found):
        word = "yes" if decision.needed else "no"
        assert any(line.startswith(f"  {word}") and decision.part in line and decision.reason in line for line in lines)
    assert any("s_ref 2.0" in line for line in lines) and any(line.endswith("  chosen") for line in lines)
    assert str(folder / "SYSTEM.toml") in result.stderr and str(folder / "CHAIN.toml") in result.stderr


@pytest.mark.parametrize(("longer_by", "said"), [(-13.5, True), (4.2, False)])
def test_a_pulse_that_describes_shorter_and_is_not_chosen_has_its_reason(longer_by, said):
    tried = [Tried("all echoes", 4.45, 3, 0.003, 86.2, longer_by, 1.117, False),
             Tried("riegl-q680i", 4.43, 5, 0.003, 87.2, 0.0, 1.116, True)]  # fmt: skip
    sheet = survey_sheet(Survey(SystemPulse(1.9), waveforms=0, candidates=tuple(tried)), {"decisions": []})
    assert ("saves too little per echo, or needs more echoes" in "\n".join(list_lines(sheet))) == said


def test_the_files_say_the_same(flat_strip, surveyed):
    folder, _ = surveyed
    saved = load_survey(folder / "SYSTEM.toml")
    assert {one.part: one.needed for one in decide(saved.survey)}.items() <= {
        one.part: one.needed for one in saved.survey.decisions
    }.items()  # what is written are the decisions of the chain, not those of the survey before them
    assert saved.strip == "flat.las" and saved.fingerprint == take_fingerprint(flat_strip)
    assert (folder / "CHAIN.toml").read_text() == chain_text(saved.survey)
    assert "# growth of fits: no: " in (folder / "CHAIN.toml").read_text()
    assert load_chain_file(folder / "CHAIN.toml").steps[2].effective()["max_echoes"] == 1


def test_a_run_with_the_files_writes_the_cloud_of_a_run_that_surveys(flat_strip, surveyed, tmp_path):
    folder, _ = surveyed
    by_files = ["--system", folder / "SYSTEM.toml", "--chain", folder / "CHAIN.toml"]
    reports = {}
    for name, options in {"auto": [], "files": by_files, "system": by_files[:2]}.items():
        arguments = ["run", flat_strip, "-o", tmp_path / name, "--format", "las", "-q", *options]
        assert run_command(*arguments).exit_code == 0
        reports[name] = json.loads((tmp_path / name / "flat.report.json").read_text())
    assert reports["auto"]["chain"] == reports["files"]["chain"] == reports["system"]["chain"]
    assert reports["auto"]["strip"]["system"] == reports["files"]["strip"]["system"]
    assert reports["auto"]["counts"] == reports["files"]["counts"] == reports["system"]["counts"]
    assert reports["auto"]["quality"] == reports["files"]["quality"]
    assert reports["auto"]["strip"]["survey"]["from"] == "strip"
    assert reports["files"]["strip"]["survey"]["from"] == "file"
    assert reports["files"]["strip"]["survey"]["of_this_strip"] is True
    assert reports["auto"]["choice"]["by"] == reports["system"]["choice"]["by"] == "auto"
    assert reports["files"]["choice"]["by"] == "user"


def test_json_for_programs(flat_strip, surveyed):
    folder, _ = surveyed
    result = _survey(flat_strip, "--json")
    told, saved = json.loads(result.stdout), load_survey(folder / "SYSTEM.toml")
    assert told["system"]["sigma_ref_ns"] == saved.survey.system.sigma_ref
    assert told["figures"] == describe_figures(saved.survey.figures) and told["waveforms"] == saved.survey.waveforms
    assert told["chain"] == chain_text(saved.survey)
    assert {decision["part"] for decision in told["decisions"]} >= {decision.part for decision in decide(saved.survey)}
    assert told["direction"]["sign"] == "toward"


def test_fewer_waveforms_on_request(flat_strip):
    assert json.loads(_survey(flat_strip, "--json", "--waveforms", 300).stdout)["waveforms"] == 300


def test_too_few_echoes_for_a_pulse_are_said(tmp_path):
    path = tmp_path / "short.las"
    simulate_strip("flat", path, pulses=15, seed=1)
    result = _survey(path)
    assert result.exit_code == 0 and "too few isolated echoes, " in result.stdout


def test_figures_have_the_digits_that_they_deserve():
    survey = Survey(SystemPulse(2.0, misfit=0.00154777), 9, Figures(kappa=-1e-6))
    lines = list(list_lines(survey_sheet(survey, {"decisions": []})))
    assert any(line.split() == ["kappa", "0.0000"] for line in lines)
    assert any(line.startswith("misfit            0.15 % ") for line in lines)
    figures = Figures(n_samples=254.0, bits=8.0, spacing_ns=1.0, descriptors_pooled=14.0)
    assert figures.samples == "up to 254 of 8 bits, 1 ns apart" and Figures().samples == ""


def test_strips_of_a_flight_are_surveyed_together(flat_strip, tmp_path):
    other, odd = tmp_path / "b.las", tmp_path / "odd.las"
    simulate_strip("urban", other, pulses=1200, seed=2)
    simulate_strip(make_scene("flat", baseline=15.0), odd, pulses=1200, seed=3)
    result = _survey(flat_strip, tmp_path, "-o", tmp_path / "1.toml", "--waveforms", 2400)
    assert result.exit_code == 1, "a strip does not belong to the others"
    lines = result.stdout.splitlines()
    assert lines[0].startswith("strips") and "2 of 3 belong together" in lines[0]
    assert lines[1].strip().startswith(f"{odd}: does not belong to them: its level is 1")
    saved = load_survey(tmp_path / "1.toml")
    assert saved.strip == "2 strips" and saved.survey.waveforms == 1600
    listed = tmp_path / "list.txt"
    listed.write_text(f"b.las\n{flat_strip}\n")
    again = _survey(f"@{listed}", odd, "--json", "--waveforms", 2400, "-o", tmp_path / "2.toml")
    assert (tmp_path / "2.toml").read_text() == (tmp_path / "1.toml").read_text()
    told = json.loads(again.stdout)
    assert told["points"] == sum(strip["points"] for strip in told["strips"] if strip["fits"]), "of those that belong"
    assert [(strip["strip"], strip["fits"]) for strip in told["strips"]] == [
        (str(other), True), (str(flat_strip), True), (str(odd), False)
    ]  # fmt: skip
    assert told["misfits"] == [str(odd)] and told["failed"] == [] and told["looks_like"] is None
    good = _survey(flat_strip, other, "--waveforms", 1600)
    assert good.exit_code == 0 and "2 of 2 belong together" in good.stdout and good.stderr == ""


def test_a_strip_of_a_flight_that_cannot_be_read_is_one_line(flat_strip, tmp_path):
    result = _survey(flat_strip, tmp_path / "none.las", "--waveforms", 600)
    assert result.exit_code == 1 and "1 of 1 belong together" in result.stdout
    assert result.stderr.count("\n") == 1 and "none.las" in result.stderr
    none = _survey(tmp_path / "none.las", tmp_path / "nor.las")
    assert none.exit_code == 1 and none.stdout == "" and "none of 2 strips can be surveyed" in none.stderr


def test_the_sensor_that_a_pulse_looks_like_is_named(riegl, flat_strip, tmp_path):
    sentence = "this strip's pulse looks like RIEGL LMS-Q680i; it differs by "
    used = "RIEGL LMS-Q680i: its shipped pulse is used"
    assert any(line.startswith("sensor") and used in line for line in _survey(riegl).stdout.splitlines())
    assert "system pulse      sum of 5 Gaussians; " in _survey(riegl).stdout, "it was not learned here"
    small = _survey(cut_strip(riegl, tmp_path / "small.las", 11)).stdout
    assert used in small and "riegl-q680i: " in small
    assert "looks like" not in _survey(flat_strip).stdout
    told = run_command("info", "-v", riegl)
    assert told.exit_code == 0 and sentence in told.stdout
    assert "pulse   " not in run_command("info", riegl).stdout
    other = json.loads(run_command("info", "-v", "--json", flat_strip).stdout)
    assert other["pulse"]["sensor"] is None and other["pulse"]["full_width_ns"] == pytest.approx(4.71, rel=0.03)
