"""`run --survey flight`: one survey of all strips, kept beside the clouds, and what happens when it changes."""

import json
import re

import numpy as np
import pytest
from batch_tools import read_cloud, read_outputs
from commands import run_command, succeed
from helpers_scenes import make_scene

import wavebatch as wb
from wavebatch.surveying.systems.survey_result import format_survey, load_survey
from wavebatch.tools.simulate import find_pulse, simulate_strip


def _run(*arguments):
    return run_command("run", *arguments)


def _report(folder, name):
    return json.loads((folder / f"{name}.report.json").read_text())


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """Three strips of a flight, and one whose level is another."""
    folder = tmp_path_factory.mktemp("strips")
    for number, (name, scene, baseline) in enumerate(
        [("a", "flat", 12.0), ("b", "urban", 12.0), ("c", "flat", 12.0), ("odd", "flat", 14.0)]
    ):
        recording = {"pulse": find_pulse("riegl"), "n_samples": 100, "baseline": baseline}
        simulate_strip(make_scene(scene, **recording), folder / f"{name}.las", pulses=700, seed=number)
    return {path.stem: path for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def flown(strips, tmp_path_factory):
    """Clouds of a, b and the odd one with one survey, and what was said."""
    folder = tmp_path_factory.mktemp("flown")
    result = succeed("run", *(strips[name] for name in ("a", "b", "odd")), "-o", folder, "--survey", "flight")
    return folder, result


def test_all_strips_have_the_pulse_of_the_flight(strips, flown):
    folder, result = flown
    saved = load_survey(folder / "flight.system.toml")
    assert saved.strip == "2 strips" and len(saved.fingerprint["strips"]) == 2
    for name in ("a", "b"):
        document = _report(folder, name)
        assert document["strip"]["system"]["sigma_ref_ns"] == saved.survey.system.sigma_ref
        source = document["strip"]["survey"]
        assert source["from"] == "flight" and source["strips"] == 2
        assert source["flight"] == {"fits": True, "reason": None}
        assert re.fullmatch("[0-9a-f]{64}", document["request"]["system"]) and document["request"]["survey"] == "flight"
        assert len(read_cloud(folder / f"{name}.laz")[0]) == document["counts"]["points_out"]


def test_a_strip_that_does_not_fit_is_named_once_and_gets_its_own_survey(strips, flown):
    folder, result = flown
    lines = [line for line in result.stderr.splitlines() if "does not belong to the flight" in line]
    assert len(lines) == 1 and "odd.las" in lines[0] and "its level is 14." in lines[0]
    document = _report(folder, "odd")
    assert document["strip"]["survey"]["from"] == "strip"
    assert document["strip"]["survey"]["flight"]["fits"] is False
    assert document["strip"]["survey"]["flight"]["reason"] in document["remarks"][0]
    assert document["strip"]["system"]["baseline_dn"] == pytest.approx(14.0, abs=0.5)


def test_resume_takes_the_kept_survey_also_for_later_strips(strips, flown, tmp_path):
    folder, _ = flown
    before = read_outputs(folder)
    result = _run(*(strips[name] for name in ("a", "b", "odd", "c")), "-o", folder, "--survey", "flight", "--resume")
    assert result.exit_code == 0 and result.stderr.count("skipped") == 3
    after = read_outputs(folder)
    assert {name: after[name] for name in before} == before
    assert _report(folder, "c")["request"] == _report(folder, "a")["request"]
    later = _run(strips["c"], "-o", folder, "--survey", "flight")
    assert later.exit_code == 4 and "exists already" in later.stderr


@pytest.mark.slow
def test_the_order_and_the_jobs_do_not_matter(strips, flown, tmp_path):
    folder, _ = flown
    succeed("run", *(strips[name] for name in ("odd", "b", "a")), "-o", tmp_path, "--survey", "flight", "--jobs", 2)
    expected = read_outputs(folder).items()
    assert read_outputs(tmp_path) == {name: content for name, content in expected if not name.startswith("c.")}


def test_a_changed_survey_is_not_trusted_in_silence(strips, tmp_path):
    assert _run(strips["a"], strips["b"], "-o", tmp_path, "--survey", "flight").exit_code == 0
    path = tmp_path / "flight.system.toml"
    text = path.read_text()
    path.write_text(re.sub("acceptance = .*", "acceptance = 20.0", text))
    result = _run(strips["a"], "-o", tmp_path, "--survey", "flight", "--resume")
    assert result.exit_code == 0 and "skipped" not in result.stderr
    assert _report(tmp_path, "a")["strip"]["system"]["acceptance"] == 20.0
    assert _report(tmp_path, "b")["strip"]["system"]["acceptance"] == 15.0
    path.write_text(text.split("[figures]")[0])
    broken = _run(strips["a"], "-o", tmp_path, "--survey", "flight", "--resume")
    assert broken.exit_code == 2 and "holds no survey of a flight" in broken.stderr and broken.stderr.count("\n") == 1
    again = _run(strips["a"], strips["b"], "-o", tmp_path, "--survey", "flight", "--overwrite")
    assert again.exit_code == 0 and path.read_text() == text


def test_a_dry_run_writes_nothing_and_knows_what_is_done(strips, flown, tmp_path):
    folder, _ = flown
    done = _run(strips["a"], "-o", folder, "--survey", "flight", "--resume", "--dry-run")
    assert done.exit_code == 0 and ": skip " in done.stdout
    new = _run(strips["a"], "-o", tmp_path / "new", "--survey", "flight", "--dry-run")
    assert new.exit_code == 0 and ": write " in new.stdout and not (tmp_path / "new").exists()


def test_a_gain_that_no_digitizer_has_does_not_stop_the_flight(strips, tmp_path):
    data = bytearray(strips["a"].read_bytes())
    place = data.index(b"LASF_Spec\0") + 52  # body of the first descriptor
    assert data[place] == 8 and data.count(b"LASF_Spec\0") >= 1
    data[place + 10 : place + 18] = np.float64(1e300).tobytes()
    (tmp_path / "a.las").write_bytes(data)
    result = _run(tmp_path / "a.las", "-o", tmp_path / "out", "--survey", "flight", "--profile", "fast")
    assert result.exit_code == 0 and "descriptor 1 has gain 1e+300 V" in result.stderr
    load_survey(tmp_path / "out" / "flight.system.toml")


def test_a_survey_that_could_not_be_read_again_is_not_written(strips, tmp_path, monkeypatch):
    monkeypatch.setattr("wavebatch.batch.run.format_survey", lambda saved: format_survey(saved) + "\n[unknown]\n")
    result = _run(strips["a"], "-o", tmp_path / "out", "--survey", "flight", "--profile", "fast")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1
    assert list((tmp_path / "out").iterdir()) == []


def test_a_survey_of_which_no_cloud_comes_is_not_kept(strips, flown, tmp_path):
    """The next run may be of other strips, and would take it."""
    wrong = ("--survey", "flight", "--where", "nonsense > 3", "--profile", "fast")
    result = _run(strips["a"], strips["b"], "-o", tmp_path / "out", *wrong)
    assert result.exit_code == 2 and list((tmp_path / "out").iterdir()) == []
    folder, before = flown[0], read_outputs(flown[0])
    assert _run(strips["c"], "-o", folder, *wrong).exit_code in (2, 4) and read_outputs(folder) == before


def test_a_survey_of_an_interrupted_run_is_kept_for_the_next(strips, tmp_path):
    def interrupt(event):
        if event["event"] == "start":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        wb.run(strips["a"], tmp_path, survey="flight", chain="fast", on_event=interrupt)
    assert [path.name for path in tmp_path.iterdir()] == ["flight.system.toml"]


def test_a_batch_whose_surveys_agree_says_so_in_its_report_and_with_v(strips, tmp_path):
    report = tmp_path / "batch.json"
    quiet = _run(strips["a"], strips["c"], "-o", tmp_path / "1", "--report", report)
    assert "--survey flight" not in quiet.stderr and "--survey flight" in json.loads(report.read_text())["advice"]
    told = _run(strips["a"], strips["c"], "-o", tmp_path / "2", "-v")
    assert told.stderr.count("--survey flight") == 1
    apart = _run(strips["a"], strips["odd"], "-o", tmp_path / "3", "-v", "--report", report)
    assert "--survey flight" not in apart.stderr and "advice" not in json.loads(report.read_text())
