"""The commands simulate, survey, voxelize and compare: their options and what they print."""

import csv
import json
import re

import laspy
import numpy as np
import pytest
from click.testing import CliRunner
from commands import run_command, succeed
from helpers_scenes import make_scene, simulated
from html_tools import Page
from strips import cut_strip

import wavebatch as wb
from wavebatch.cli.compare import compare
from wavebatch.cli.strips import simulate
from wavebatch.core.waveforms import SystemPulse
from wavebatch.files.disk.raw_bytes import take_fingerprint
from wavebatch.stages.chain import load_chain_file
from wavebatch.surveying import Survey
from wavebatch.surveying.calibrating.calibration_files import format_calibration
from wavebatch.surveying.calibration import Calibration
from wavebatch.surveying.choose_chain import chain_text, decide
from wavebatch.surveying.systems.figures import Figures, describe_figures
from wavebatch.surveying.systems.survey_result import Tried, load_survey
from wavebatch.tools.sheets.sheet import list_lines
from wavebatch.tools.sheets.survey import NOISE_KINDS, survey_sheet
from wavebatch.tools.simulate import SCENES, TruthReader, simulate_strip


def run(*arguments):
    return CliRunner().invoke(simulate, [str(argument) for argument in arguments])


def test_strip_and_truth_are_written_and_counted(tmp_path):
    options = ("--pulses", 500, "--truth", tmp_path / "t.npz", "--json")
    result = succeed("simulate", "urban", "-o", tmp_path / "s.laz", *options)
    summary = json.loads(result.stdout)
    with laspy.open(tmp_path / "s.laz", read_evlrs=False) as reader:
        assert reader.header.point_count == summary["points"]
        assert reader.header.point_format.id == 4
    with TruthReader(tmp_path / "t.npz") as truth:
        assert truth.meta["echoes"] == summary["echoes"]
        assert truth.meta["scene"] == "urban"
    assert summary["pulses"] == 500


def test_every_option_reaches_the_recording(tmp_path):
    succeed(
        "simulate",
        *("mixed", "-o", tmp_path / "s.las", "--truth", tmp_path / "t.npz", "--pulses", 300, "--seed", 9, "--bits", 16),
        *("--samples", 120, "--spacing", 2, "--noise", 3, "--rho", 0.667, "--noise-gain", 0.05, "--baseline", 200),
        *("--saturation", 900, "--pulse", "leica", "--kappa", 0.05, "--ringing", 0.02, "--point-format", 10),
        *("--external", "--scale", 0.01, "--without-waveform", 0.5, "--drop-empty", "--away"),
    )
    with TruthReader(tmp_path / "t.npz") as truth:
        meta = truth.meta
    recording = meta["recording"]
    expected = {"bits": 16, "n_samples": 120, "spacing": 2, "noise_std": 3, "rho": 0.667, "noise_gain": 0.05}
    expected |= {"baseline": 200, "saturation": 900}
    assert {name: recording[name] for name in expected} == expected
    assert recording["pulse"]["kappa"] == 0.05
    assert recording["pulse"]["sigma"] == 3.0
    assert len(recording["pulse"]["lobes"]) == 4
    assert meta["seed"] == 9
    cloud = laspy.read(tmp_path / "s.las")
    assert cloud.header.point_format.id == 10
    assert tuple(cloud.header.scales) == (0.01, 0.01, 0.01)
    assert np.asarray(cloud.z_t).min() < 0
    assert 0.35 < (np.asarray(cloud.wavepacket_index) == 0).mean() < 0.65
    assert (tmp_path / "s.wdp").stat().st_size == 60 + meta["packets"] * 240


def test_help_lists_every_scene():
    text = run("--help").output
    for name in SCENES:
        assert f"{name}:" in text


def _survey(*arguments):
    return run_command("survey", *arguments)


flat_strip = simulated("flat.las", "flat", pulses=2500, seed=1)
"""2,500 pulses over bare ground."""


@pytest.fixture(scope="module")
def surveyed(flat_strip, tmp_path_factory):
    """Folder with SYSTEM.toml and CHAIN.toml, and what was printed."""
    folder = tmp_path_factory.mktemp("surveyed")
    result = succeed("survey", flat_strip, "-o", folder / "SYSTEM.toml", "--chain", folder / "CHAIN.toml")
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
    shown = _survey(riegl).stdout
    assert any(line.startswith("sensor") and used in line for line in shown.splitlines())
    assert "system pulse      sum of 5 Gaussians; " in shown, "it was not learned here"
    assert json.loads(_survey(riegl, "--json").stdout)["looks_like"]["taken"] is True
    small = _survey(cut_strip(riegl, tmp_path / "small.las", 11)).stdout
    assert used in small and "riegl-q680i: " in small
    assert "looks like" not in _survey(flat_strip).stdout
    assert sentence in succeed("info", "-v", riegl).stdout
    assert json.loads(succeed("info", "-v", "--json", riegl).stdout)["pulse"]["sensor"] == "RIEGL LMS-Q680i"
    assert "pulse   " not in run_command("info", riegl).stdout
    other = json.loads(run_command("info", "-v", "--json", flat_strip).stdout)
    assert other["pulse"]["sensor"] is None and other["pulse"]["full_width_ns"] == pytest.approx(4.71, rel=0.03)


def voxelize(*arguments):
    return run_command("voxelize", *arguments)


strip = simulated("urban.las", "urban", pulses=600, seed=5)
"""600 pulses over streets and houses."""


def test_counts_go_to_stdout_and_talk_to_stderr(strip, tmp_path):
    result = succeed("voxelize", strip, "--size", 1, "-o", tmp_path / "v.npz", "--json")
    counts = json.loads(result.stdout)
    with np.load(tmp_path / "v.npz") as file:
        assert counts["voxels"] == len(file["index"]) > 300
        assert counts["origin"] == file["origin"].tolist() and file["size"] == counts["size"] == 1.0
        assert json.loads(str(file["meta"]))["strip"] == "urban.las"
    assert counts["method"] == "richardson_lucy" and 4.4 < counts["pulse_fwhm"] < 5.2
    assert f"{counts['voxels']} voxels of 1 m" in result.stderr
    quiet = voxelize(strip, "--size", 1, "-o", tmp_path / "w.npz", "-q")
    assert quiet.exit_code == 0 and quiet.output == ""
    assert (tmp_path / "w.npz").read_bytes() == (tmp_path / "v.npz").read_bytes()


def test_a_folder_gets_points_where_grid_reads_them(strip, tmp_path):
    for words in ((), ("--forest",)):
        succeed("voxelize", strip, "--size", 5, "-o", tmp_path, "-q", *words)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["urban.laz", "urban.npz"]


def test_a_saved_survey_gives_the_same_voxels(strip, tmp_path):
    system = tmp_path / "SYSTEM.toml"
    assert run_command("survey", strip, "-o", system).exit_code == 0
    for name, more in (("a.npz", ()), ("b.npz", ("--system", system))):
        assert voxelize(strip, "--size", 0.5, "-o", tmp_path / name, *more).exit_code == 0
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_every_method_and_option_changes_the_result(strip, tmp_path):
    variants = [
        (), ("--iterations", 5), ("--method", "gold"), ("--method", "wiener"), ("--method", "wiener", "--snr", 5),
        ("--threshold", 12), ("--all-crossed",), ("--all-crossed", "--headroom", 30),
    ]  # fmt: skip
    made = set()
    for number, variant in enumerate(variants):
        succeed("voxelize", strip, "--size", 1, "-o", tmp_path / f"{number}.npz", *variant)
        with np.load(tmp_path / f"{number}.npz") as file:
            made.add(b"".join(file[name].tobytes() for name in ("index", "energy", "rays")))
    assert len(made) == len(variants)


def test_calibrated_strips_have_cross_sections(strip, tmp_path):
    path = tmp_path / "CAL.toml"
    path.write_text(format_calibration(Calibration(2.5e-8, 0.03, 0.22, divergence=0.5)))
    result = succeed("voxelize", strip, "--size", 2, "-o", tmp_path / "v.npz", "--calibration", path, "--json")
    assert json.loads(result.stdout)["sensor"] == "direction vectors"
    with np.load(tmp_path / "v.npz") as file:
        assert (file["cross_section"] > 0).all()


def test_help_says_what_a_voxel_holds():
    text = voxelize("--help").output
    for word in ("energy", "cross_section", "rays", "path", "light", "share", "--all-crossed", "--headroom", "DN ns"):
        assert word in text


NAMES = ("median", "mean", "rms", "nmad")


@pytest.fixture(scope="module")
def strips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("strips")
    for name, seed in (("a", 1), ("b", 2)):
        simulate_strip("mixed", folder / f"{name}.las", pulses=600, seed=seed, truth=folder / f"{name}.npz")
    return folder


def compare_files(*arguments):
    return CliRunner().invoke(compare, [str(argument) for argument in arguments])


def test_a_strip_with_itself_is_identical(strips):
    limits = ("--min-completeness", 1, "--min-correctness", 1, "--max-rmse", 0)
    result = succeed("compare", strips / "a.las", strips / "a.las", *limits)
    shown = result.stdout.splitlines()
    assert {"missed            0", "extra             0", "completeness      1.0000"} <= set(shown)


def test_json_holds_every_figure_and_no_nan(strips):
    result = succeed("compare", strips / "a.las", "--truth", strips / "a.npz", "--json")
    assert "NaN" not in result.stdout
    figures = json.loads(result.stdout)
    assert figures["missed"] == figures["echoes_b"] - figures["matched"]
    assert figures["errors"]["isolated"]["time"]["number"] > 200
    assert figures["errors"]["isolated"]["amplitude"]["rmse"] is None
    assert sum(figures["counts_b"].values()) == figures["pulses"]
    assert figures["tolerance_ns"] == 1.5


@pytest.mark.parametrize(
    ("option", "value", "code"),
    [
        ("--min-completeness", 0.7, 0),
        ("--min-completeness", 0.97, 1),
        ("--min-correctness", 0.99, 0),
        ("--min-exact", 0.5, 0),
        ("--min-exact", 0.98, 1),
        ("--max-rmse", 0.1, 0),
        ("--max-rmse", 0.0001, 1),
        ("--max-nmad", 0.0001, 1),
        ("--max-median", 0.01, 0),
    ],
)
def test_thresholds_set_the_exit_code(strips, option, value, code):
    result = compare_files(strips / "a.las", "--truth", strips / "a.npz", option, value)
    assert result.exit_code == code, result.output
    assert (option in result.stderr) == bool(code)


def test_a_figure_that_does_not_exist_meets_no_threshold(strips):
    result = compare_files(strips / "a.las", "--truth", strips / "b.npz", "--within", 1e-6, "--max-rmse", 5)
    assert result.exit_code == 1
    assert "has nan" in result.stderr


def test_text_table_and_page_have_the_classes_and_the_numbers_of_echoes(strips, tmp_path):
    """Ground and plants of two simulated strips: the same figures everywhere."""
    files = ("-o", tmp_path / "t.csv", "--html", tmp_path / "p.html")
    result = succeed("compare", strips / "a.las", strips / "b.las", "--json", *files)
    document = json.loads(result.stdout)
    text = compare_files(strips / "a.las", strips / "b.las").stdout
    shown = Page(tmp_path / "p.html").check()
    assert "does not add up" not in (tmp_path / "p.html").read_text()
    with (tmp_path / "t.csv").open(newline="") as file:
        rows = {tuple(row.values())[:5]: row["value"] for row in csv.DictReader(file)}
    assert "A - B by class " in text and "A - B by echoes" in text
    for kind, groups in document["differences_by"].items():
        assert len(groups) > 1 and sum(one["time"]["number"] for one in groups.values()) == document["matched"]
        for group, quantities in groups.items():
            one = quantities["time"]
            title = group if kind == "class" else f"{group} of the pulse"
            (line,) = [line for line in text.splitlines() if re.match(rf"  {title} +time ns ", line)]
            values = [str(one["number"]), *(f"{one[name]:.4f}" for name in NAMES)]
            assert line.split() == [*title.split(), "time", "ns", *values]
            assert rows[f"differences by {kind}", "", group, "time", "number"] == str(one["number"])
            row = next(row for row in shown.rows if row[:2] == [title, "time ns"])
            assert row[2] == f"{one['number']:,}"


def test_a_truth_says_whose_times_it_tests(strips):
    wb.run([strips / "a.las"], strips / "out", columns="+echo_time", profile="fast", overwrite=True)
    for cloud, said in ((strips / "a.las", True), (strips / "out" / "a.laz", False)):
        shown = compare_files(cloud, "--truth", strips / "a.npz").stdout
        assert ("`run --columns +echo_time` adds" in shown) is said
        assert bool(re.search("  isolated +echo_time", shown)) is not said


def test_a_truth_is_compared_at_the_chosen_points(strips):
    whole, some = (
        json.loads(compare_files(strips / "a.las", "--truth", strips / "a.npz", "--json", *more).stdout)
        for more in ((), ("--where", "return_number == 1"))
    )
    assert some["echoes_b"] == whole["echoes_b"] and some["left_out_a"] > 0 == whole["left_out_a"]
    assert 0 < some["echoes_a"] < whole["echoes_a"]
    assert some["correctness"] >= whole["correctness"] - 0.01 and some["completeness"] < whole["completeness"]
