"""What strips are run with: chosen by their survey, by a tolerance or from a file, and what reports say of it."""

import json
import re
from dataclasses import replace
from pathlib import Path

import kept_surveys
import pytest
from batch_tools import read_cloud
from commands import fail, run_command, succeed
from helpers_scenes import make_scene

from wavebatch.files.strip.reader import StripReader
from wavebatch.stages.chain import parse_chain
from wavebatch.surveying.choose_chain import COSTS, Request, make_choice, widest_chain
from wavebatch.surveying.predict_error import predict_errors
from wavebatch.tools.simulate import find_pulse, simulate_strip

pytestmark = pytest.mark.kept_surveys

EXAMPLES = Path(__file__).parents[2] / "examples"


def _run(*arguments):
    return run_command("run", *arguments)


def _report(folder, stem):
    return json.loads((folder / f"{stem}.report.json").read_text())


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    """A flat and a forest strip."""
    folder = tmp_path_factory.mktemp("strips")
    for scene in ("flat", "forest"):
        simulate_strip(scene, folder / f"{scene}.las", pulses=3000, seed=2)
    return folder


@pytest.fixture(scope="module")
def saved(strips):
    """SYSTEM.toml of the flat strip."""
    path = strips / "SYSTEM.toml"
    assert run_command("survey", strips / "flat.las", "-o", path).exit_code == 0
    return path


def test_auto_is_the_default_and_chooses_per_strip(strips, tmp_path):
    assert _run(strips, "-o", tmp_path, "-q").exit_code == 0
    flat, forest = _report(tmp_path, "flat"), _report(tmp_path, "forest")
    for report in (flat, forest):
        assert report["choice"]["by"] == report["request"]["chain"] == "auto"
        assert all(decision["reason"] for decision in report["choice"]["decisions"])
        assert parse_chain(report["chain"], "x")
        assert report["strip"]["survey"]["from"] == "strip" and report["strip"]["survey"]["waveforms"] > 2000
    out = {r["input"]["file"]: {d["part"] for d in r["choice"]["decisions"] if not d["needed"]} for r in (flat, forest)}
    assert "growth of fits" in out["flat.las"] and "growth of fits" not in out["forest.las"]
    assert "max_echoes = 1\n" in flat["chain"] and "max_echoes = 8\n" in forest["chain"]
    assert "microseconds_per_waveform" not in flat["timing"]


@pytest.mark.slow
def test_the_choice_depends_on_neither_jobs_nor_block_size(strips, tmp_path):
    for name, options in {"a": ["--jobs", 1], "b": ["--jobs", 2, "--block-size", 333]}.items():
        assert _run(strips, "-o", tmp_path / name, "-q", *options).exit_code == 0
    for stem in ("flat", "forest"):
        assert (tmp_path / "a" / f"{stem}.laz").read_bytes() == (tmp_path / "b" / f"{stem}.laz").read_bytes()
        a, b = (_report(tmp_path / name, stem) for name in "ab")
        a.pop("timing"), b.pop("timing")
        assert a == b


def test_a_strip_whose_pulse_is_undersampled_gets_no_widths(tmp_path):
    from helpers_scenes import make_scene

    from wavebatch.tools.simulate import PulseModel

    scene = make_scene("flat", pulse=PulseModel(sigma=0.7))
    simulate_strip(scene, tmp_path / "narrow.las", pulses=2500, seed=3)
    assert _run(tmp_path / "narrow.las", "-o", tmp_path / "out", "--format", "las", "-q").exit_code == 0
    cloud, _ = read_cloud(tmp_path / "out" / "narrow.las")
    assert "amplitude" in cloud.dtype.names and not {"echo_width", "echo_width_err"} & set(cloud.dtype.names)
    report = _report(tmp_path / "out", "narrow")
    assert "echo_width" not in report["output"]["columns"]
    assert any(d["part"] == "echo width" and not d["needed"] for d in report["choice"]["decisions"])


def test_a_saved_survey_is_used_as_it_is_and_the_report_says_whose_it_is(strips, saved, tmp_path):
    for stem in ("flat", "forest"):
        assert _run(strips / f"{stem}.las", "-o", tmp_path, "-q", "--system", saved).exit_code == 0
    flat, forest = _report(tmp_path, "flat"), _report(tmp_path, "forest")
    assert flat["strip"]["system"] == forest["strip"]["system"]
    assert flat["strip"]["survey"]["of_this_strip"] is True and forest["strip"]["survey"]["of_this_strip"] is False
    assert forest["strip"]["survey"]["strip"] == "flat.las" and forest["request"]["system"]
    assert flat["chain"] == forest["chain"]


def test_no_survey_is_made_where_one_is_given(strips, saved, tmp_path, monkeypatch):
    monkeypatch.setattr(kept_surveys, "active", False)
    monkeypatch.setattr("wavebatch.surveying.survey.survey_blocks", lambda *a, **k: pytest.fail("surveyed"))
    assert _run(strips / "flat.las", "-o", tmp_path, "-q", "--system", saved, "--debug").exit_code == 0


def test_resume_makes_anew_what_another_request_asked_for(strips, saved, tmp_path):
    strip, text = strips / "flat.las", saved.read_text()
    other = tmp_path / "OTHER.toml"
    other.write_text(text.replace("acceptance = 15.0", "acceptance = 16.0"))
    assert other.read_text() != text
    for options in ([], ["--system", saved], ["--system", other], ["--profile", "accurate"], ["--tolerance", "1m"]):
        run = [strip, "-o", tmp_path / "out", "--resume", *options]
        assert "is up to date, skipped" not in _run(*run).stderr
        assert "is up to date, skipped" in _run(*run).stderr


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("sigma_ref_ns", "sigma_ref", "did you mean 'sigma_ref_ns'"),
        ("noise_std_dn = ", "noise_std_dn = -", "noise_std_dn must lie between"),
    ],
)
def test_a_wrong_system_file_is_wrong_usage(strips, saved, tmp_path, old, new, words):
    bad = tmp_path / "bad.toml"
    bad.write_text(saved.read_text().replace(old, new, 1))
    result = _run(strips, "-o", tmp_path / "out", "--system", bad)
    assert result.exit_code == 2 and words in result.stderr and result.stderr.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_a_tolerance_takes_the_cheapest_chain_that_meets_it(strips, tmp_path):
    """Fast does for flat ground at 2 cm, forest needs more at 5 cm; nothing does at 1 mm."""
    strip = strips / "flat.las"
    assert _run(strip, "-o", tmp_path, "-q", "--tolerance", "0.02m").exit_code == 0
    choice = _report(tmp_path, "flat")["choice"]
    assert choice["chain"] == "profile fast" and choice["tolerance_m"] == 0.02
    assert [told["chain"] for told in choice["predictions"]] == ["fast", "balanced", "accurate"]
    assert choice["predictions"][0]["range_error_m"] == pytest.approx(0.005, abs=0.001)
    assert _run(strips / "forest.las", "-o", tmp_path, "-q", "--tolerance", "3.8 cm").exit_code == 0
    forest = _report(tmp_path, "forest")["choice"]
    fast, balanced, accurate = (told["range_error_m"] for told in forest["predictions"])
    assert fast > balanced > 0.038 > accurate and forest["chain"] == "profile accurate"


def test_no_chain_that_meets_the_tolerance_is_2_and_one_line(strips, saved, tmp_path):
    result = _run(strips / "forest.las", "-o", tmp_path, "--tolerance", "1mm")
    assert result.exit_code == 2 and result.stderr.count("\n") == 1
    assert "no shipped chain meets a tolerance of 0.001 m" in result.stderr and "accurate 0.0" in result.stderr
    fail(2, "no shipped chain", "run", strips / "flat.las", "-o", tmp_path, "--tolerance", "1mm", "--system", saved)
    assert list(tmp_path.iterdir()) == []
    some = _run(strips, "-o", tmp_path, "-q", "--tolerance", "1.5cm")
    assert some.exit_code == 3 and (tmp_path / "flat.laz").exists() and not (tmp_path / "forest.laz").exists()


def test_a_dry_run_says_that_the_strip_decides(strips, tmp_path):
    result = _run(strips, "-o", tmp_path, "--dry-run")
    assert result.exit_code == 0 and "chosen per strip (auto)" in result.stdout
    assert "decompose.adaptive" in result.stdout and list(tmp_path.iterdir()) == []


@pytest.fixture(scope="module")
def ringing(tmp_path_factory):
    """A flat strip whose pulse has after-pulses, and its saved survey."""
    folder = tmp_path_factory.mktemp("ringing")
    scene = make_scene("flat", pulse=find_pulse("riegl"), n_samples=100)
    simulate_strip(scene, folder / "ringing.las", pulses=3000, seed=4)
    arguments = ["survey", str(folder / "ringing.las"), "-o", str(folder / "SYSTEM.toml")]
    assert run_command(*arguments).exit_code == 0
    return folder


@pytest.mark.slow
@pytest.mark.parametrize("options", [["--profile", "fast"], ["--chain", EXAMPLES / "urban.toml"]])
@pytest.mark.parametrize("saved", [False, True])
def test_a_chain_that_does_not_fit_the_pulse_is_named_and_its_false_echoes_counted(ringing, tmp_path, options, saved):
    options = [*options, *(["--system", ringing / "SYSTEM.toml"] if saved else [])]
    result = succeed("run", ringing / "ringing.las", "-o", tmp_path, "-q", *options)
    report = _report(tmp_path, "ringing")
    line, ground = result.stderr.splitlines()  # false echoes beside points that are all ground are ground too
    assert [one["code"] for one in report["warnings"]] == ["false-echoes", "ground"] and "added echoes" in ground
    assert line.endswith(f"warning: {report['warnings'][0]['text']}")
    found = re.search(r"pulse, .* about (\d+) of its (\d+) echoes are false .* use --profile auto", line)
    assert int(found[2]) == report["counts"]["echoes"]
    false = report["choice"]["predictions"][0]["false_share"]
    assert false > 0.1 and int(found[1]) == round(false * int(found[2]))
    assert report["choice"]["by"] == "user"


@pytest.mark.quick_cases("options2")
@pytest.mark.parametrize(
    "options", [["--profile", "accurate"], ["--profile", "auto"], ["--chain", EXAMPLES / "forest.toml"]]
)
def test_chains_that_fit_the_pulse_are_not_doubted(ringing, tmp_path, options):
    result = _run(ringing / "ringing.las", "-o", tmp_path, "-q", *options)
    assert (result.exit_code, result.stderr) == (0, "")
    assert "predictions" not in _report(tmp_path, "ringing")["choice"]


@pytest.mark.slow
def test_a_tolerance_leaves_out_chains_that_do_not_fit_the_pulse(ringing, tmp_path):
    assert _run(ringing / "ringing.las", "-o", tmp_path, "-q", "--tolerance", "10m").exit_code == 0
    choice = _report(tmp_path, "ringing")["choice"]
    assert choice["chain"] == "profile accurate"
    assert [one["chain"] for one in choice["predictions"] if one["range_error_m"] <= 10] == list(COSTS)
    result = _run(ringing / "ringing.las", "-o", tmp_path / "b", "--tolerance", "0.1mm")
    assert result.exit_code == 2 and re.search(r"fast [\d.]+ m \(\d+ % of its echoes would be false\)", result.stderr)


def test_a_choice_travels_between_processes(strips):
    import pickle

    for request in (Request(auto=True), Request(tolerance=0.1)):
        with StripReader(strips / "flat.las") as reader, reader.scan() as scan:
            choice = make_choice(reader, scan, widest_chain(request), request)
        again = pickle.loads(pickle.dumps(choice))
        assert again.survey == choice.survey and again.decisions == choice.decisions
        assert again.predictions == choice.predictions


def test_the_digitizer_with_most_waveforms_predicts_the_errors(strips, monkeypatch):
    """Whichever has the lower number: the other is hardly known."""
    used = []

    def note(block, *others):
        used.append(block.digitizer.index)
        return predict_errors(block, *others)

    monkeypatch.setattr("wavebatch.surveying.predict_error.predict_errors", note)
    request = Request(tolerance=0.1)
    with StripReader(strips / "flat.las") as reader, reader.scan() as scan:
        blocks = list(reader.sample_blocks(scan, 1000))
        for few in (1, 9):
            some = blocks[0].rows(slice(60))
            some = replace(some, digitizer=replace(some.digitizer, index=few))
            many = [replace(block, digitizer=replace(block.digitizer, index=5)) for block in blocks]
            monkeypatch.setattr(StripReader, "sample_blocks", lambda *_, sample=(some, *many): iter(sample))
            make_choice(reader, scan, widest_chain(request), request)
    assert used == [5, 5]
