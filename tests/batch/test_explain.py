"""What a report says of a strip as a whole: waveforms without echoes, returns that lie elsewhere."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from batch_tools import make_job, run_one
from commands import fail, refuses, run_command, succeed
from strips import cut_strip
from writer_tools import data_file

import wavebatch
from wavebatch.batch.counts import RunReport
from wavebatch.batch.report_file import LEAST_JUDGED, MOST_FAILED, find_remarks, find_warnings
from wavebatch.batch.unit import prepare_strip
from wavebatch.core.errors import WARNINGS, StripWarning
from wavebatch.files.las.header import read_header
from wavebatch.tools.simulate import simulate_strip


def remarks(strip, folder):
    assert run_one(strip, folder).status == "written"
    return json.loads((folder / f"{strip.stem}.report.json").read_text())["remarks"]


def change_packets(source, target, change):
    """A copy of an internal 8-bit strip with the samples behind the waveform record's header changed."""
    content = np.frombuffer(source.read_bytes(), np.uint8).copy()
    start = read_header(source).waveform_start + 60
    content[start:] = change(content[start:])
    target.write_bytes(content.tobytes())
    return target


def test_a_plain_strip_has_none(tiny_strip, tmp_path):
    assert remarks(tiny_strip, tmp_path) == []


@pytest.mark.parametrize(("every", "said"), [(5, True), (50, False)])
def test_haze_at_the_start_of_packets_is_said(tiny_strip, tmp_path, every, said):
    """All such echoes were false, in silence."""

    def change(samples):
        packets = samples.reshape(-1, 80)
        packets[::every] += np.rint(20 * np.exp(-np.arange(80) / 8.0)).astype(np.uint8)
        return packets.ravel()

    lines = remarks(change_packets(tiny_strip, tmp_path / "haze.las", change), tmp_path / "out")
    assert [line for line in lines if "NEAR_EDGE" in line] == lines and len(lines) == said


@pytest.mark.slow
def test_fits_that_fail_far_more_than_usual_are_said_with_quiet_too(leica, tiny_strip, tmp_path):
    """77 % of the fits of --profile fast did not converge, and nothing was said."""
    done = run_command("run", leica, "-o", tmp_path / "a", "-q", "--profile", "fast")
    (line,) = done.stderr.splitlines()
    assert "% of" not in line and "are NOT_CONVERGED, far more than usual" in line and "use --profile auto" in line
    done = run_command("run", tiny_strip, "-o", tmp_path / "b", "-q", "--profile", "fast")
    assert done.stderr == ""


@pytest.mark.parametrize(("factor", "every"), [(0.0, 1), (1e-3, 1), (-1.0, 3)], ids=["none", "ns for ps", "a third"])
def test_return_locations_that_are_not_those_of_echoes_are_doubted(tiny_strip, tmp_path, edit_points, factor, every):
    """Of a third that was wrong nothing was said."""

    def change(points):
        points["return_point_wave_location"][::every] *= factor

    (line,) = warn_quietly(edit_points(tiny_strip, tmp_path / "bad.las", change), tmp_path)
    assert "returns lie where their packet has an echo: the return locations" in line and "picoseconds" in line


def test_points_that_stand_twice_in_the_file_are_one_of_the_reasons(tiny_strip, tmp_path, edit_points):
    """Half of the returns had no echo of their own, and only wrong locations were named."""

    def treble(points):
        number = len(points) // 3
        points[number : 2 * number] = points[2 * number : 3 * number] = points[:number]

    (line,) = warn_quietly(edit_points(tiny_strip, tmp_path / "twice.las", treble), tmp_path)
    assert "returns lie where their packet has an echo" in line and line.endswith("or points stand in the file twice")


def test_packets_of_another_strip_warn_in_cron_too(riegl, tmp_path):
    strip = tmp_path / "mixed.las"
    shutil.copy(riegl, strip)
    shutil.copy(data_file("lvis/lvis1.wdp"), strip.with_suffix(".wdp"))
    line, *_ = warn_quietly(strip, tmp_path, "--force")
    assert "--force: mixed.wdp belongs to another strip" in line


def test_locations_that_fit_no_echo_warn_in_cron_too(tmp_path, edit_points):
    source = data_file("lvis/lvis1.las")
    strip = edit_points(source, tmp_path / "zero.las", return_point_wave_location=0)
    shutil.copy(source.with_suffix(".wdp"), strip.with_suffix(".wdp"))
    lines = warn_quietly(strip, tmp_path)
    text = "returns lie where their packet has an echo: zero.wdp belongs to another strip, or"
    assert any(text in line for line in lines)


def test_inverted_and_empty_waveforms_are_told(tiny_strip, tmp_path):
    inverted = change_packets(tiny_strip, tmp_path / "down.las", lambda samples: 255 - samples)
    (line,) = remarks(inverted, tmp_path)
    assert "the signal goes down, its counts are mirrored" in line


def warn_quietly(strip, folder, *options, code=0):
    """Lines of `run --quiet` on stderr; the strip is written."""
    done = run_command("run", strip, "-o", folder, "--quiet", *options)
    assert done.exit_code == code, done.stderr
    lines = done.stderr.splitlines()
    report = json.loads((folder / f"{strip.stem}.report.json").read_text())
    for line in lines:
        texts = [one["text"] for one in report["warnings"]]
        assert line.startswith(f"{strip}: warning: ") and line.split(": warning: ")[1] in texts
    return [line.split(": warning: ")[1] for line in lines]


def test_a_strip_without_any_echo_or_waveform_warns_in_cron_too(tiny_strip, tmp_path, edit_points):
    constant = change_packets(tiny_strip, tmp_path / "flat.las", lambda samples: 0 * samples + 12)
    (line,) = warn_quietly(constant, tmp_path / "flat")
    assert "holds an echo: nothing rises" in line

    (line,) = warn_quietly(edit_points(tiny_strip, tmp_path / "bare.las", wavepacket_index=0), tmp_path / "bare")
    assert "none of " in line and "points has a waveform" in line


def test_points_whose_packets_are_lost_warn_in_cron_too(tiny_strip, tmp_path, edit_points):
    def break_some(points):
        points["wavepacket_offset"][::3] = 1 << 40

    (line,) = warn_quietly(edit_points(tiny_strip, tmp_path / "cut.las", break_some), tmp_path, code=3)
    assert "with a packet past the end of the waveform data" in line


def test_a_pulse_that_is_a_guess_warns_in_cron_too(tiny_strip, tmp_path):
    short = cut_strip(tiny_strip, tmp_path / "short.las", 5)
    (line,) = warn_quietly(short, tmp_path)
    assert "the system pulse is a guess" in line and "--system" in line
    assert run_command("survey", tiny_strip, "-o", tmp_path / "long.toml").exit_code == 0
    assert warn_quietly(short, tmp_path / "again", "--system", str(tmp_path / "long.toml")) == []


@pytest.mark.slow
def test_a_known_pulse_is_no_guess_but_its_noise_may_be(tmp_path):
    neon, known = data_file("neon/neon_harv_a.las"), tmp_path / "known.toml"
    assert run_command("survey", neon, "-o", known).exit_code == 0
    known.write_text(re.sub("echoes_in_doubt = .*", "echoes_in_doubt = 0.08", known.read_text()))
    (line,) = warn_quietly(neon, tmp_path / "out", "--system", str(known))
    assert "found 8 % of the echoes in doubt" in line
    assert "in doubt: the noise of 5.45 DN is a guess, as is the pulse's misfit of 0 % of the amplitude, and" in line
    assert "--system" in line


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("echoes_in_doubt", 0.1, ()),
        ("echoes_in_doubt", 0.2, ("20 % of the echoes in doubt: the system pulse is a guess", "give --system")),
        # Packets that begin in their canopy: a fifth of their echoes depends on it, and none was in doubt.
        ("quiet", 0.0, ("found too few samples without signal: the noise is a guess", "--system")),
        ("false_in_noise_share", 0.06, ("found that noise made 6 of 100 echoes: the noise is a guess", "level: draw")),
        ("false_in_noise_share", 0.02, ()),
        ("placed_share", 0.05, ("found that 5 of 100 echoes repeat beside stronger ones", "a layer of the scene")),
        ("placed_share", 0.02, ()),
        ("baseline_dn", -1.5, ("most of the noise below count 0: the noise is a guess",)),
    ],
)
def test_what_a_system_doubts_warns_in_cron_too(tiny_strip, tmp_path, key, value, said):
    system = tmp_path / "system.toml"
    assert run_command("survey", tiny_strip, "-o", system).exit_code == 0
    sure = re.sub("echoes_in_doubt = .*", "echoes_in_doubt = 0.0", system.read_text())
    system.write_text(re.sub(f"{key} = .*", f"{key} = {value}", sure))
    lines = warn_quietly(tiny_strip, tmp_path, "--system", str(system))
    assert len(lines) == bool(said) or key == "baseline_dn"
    assert all(any(text in line for line in lines) for text in said)


@pytest.mark.parametrize("strip", ["riegl", "leica"])
def test_a_good_strip_is_no_guess(strip, request, tmp_path):
    short = cut_strip(request.getfixturevalue(strip), tmp_path / "short.las", 120)
    assert not [line for line in warn_quietly(short, tmp_path) if "is a guess" in line]


def test_a_residual_threshold_below_the_noise_is_said(tiny_strip, tmp_path):
    stages = ("noise.pooled", "detect.maximum", "decompose.residual_loop")
    text = "\n".join(f'[[chain]]\nstage = "{name}"' for name in stages)
    rest = '[[chain]]\nstage = "attribute.position"\n'
    for t_diff, unit, raised in ((0.1, "count", True), (50.0, "count", False), (0.1, "noise", False)):
        chain = tmp_path / f"{t_diff}-{unit}.toml"
        chain.write_text(f'{text}\nt_diff = {t_diff}\nt_unit = "{unit}"\n{rest}')
        folder = tmp_path / f"out-{t_diff}-{unit}"
        succeed("run", tiny_strip, "-o", folder, "-c", chain)
        told = json.loads((folder / f"{tiny_strip.stem}.report.json").read_text())["remarks"]
        assert any("lies below the noise of" in line and "raised" in line for line in told) == raised


@pytest.fixture
def prepared(tiny_strip):
    found = prepare_strip(make_job(tiny_strip))
    found.scan.close()
    return found


@pytest.mark.parametrize(
    ("number", "share", "judged"),
    [(LEAST_JUDGED - 1, 1.0, False), (LEAST_JUDGED, 0.25, True), (LEAST_JUDGED, MOST_FAILED, False)],
)
def test_few_waveforms_and_usual_shares_of_failed_fits_are_not_judged(prepared, number, share, judged):
    seen = dict.fromkeys(("points_in", "waveforms", "points_out"), number)
    failed = RunReport(counts={**seen, "echoes": number}, flags={"AT_BOUND": int(share * number)})
    enough = number >= LEAST_JUDGED
    for report, code, expected in ((failed, "failed-fits", judged), (RunReport(counts=seen), "empty", enough)):
        codes = [one.code for one in find_warnings(prepared, report, (), {})]
        assert codes == [code] * expected


def test_a_forced_survey_and_records_that_are_lost_have_their_codes(prepared):
    counts = dict.fromkeys(("points_in", "waveforms", "echoes"), 1)
    forced = replace(prepared, forced="its noise is 3 DN")
    found = find_warnings(forced, RunReport(counts=counts), (), {"GDAL 7": "too long"})
    assert [one.code for one in found] == ["forced-system", "dropped-records"]


@pytest.mark.parametrize(("scene", "kind", "said"), [("forest", 2, True), ("forest", 0, False), ("flat", 2, False)])
def test_echoes_beside_points_of_the_ground_alone_are_said_to_have_its_class(scene, kind, said, tmp_path, edit_points):
    """Who keeps class 2 only has no crowns among the points, but in the packets.

    kind: the class of all points, or 0 for those of the scene.
    """
    strip = tmp_path / "strip.las"
    simulate_strip(scene, strip, pulses=1500, seed=2)
    edit_points(strip, strip, **({"raw_classification": kind} if kind else {}))
    report = run_one(strip, tmp_path / "out").report
    assert (report.ground_points == report.count("points_in")) == bool(kind)
    lines = [one.text for one in report.warnings if one.code == "ground"]
    assert len(lines) == said and all(f"{report.flags['ADDED']} added echoes" in line for line in lines)


@pytest.mark.parametrize(
    ("counts", "said"),
    [({}, ""), ({"UNCERTAIN": 3}, "none of 3 echoes has one; more"),
     ({"UNCERTAIN": 2, "NO_LEVEL": 1}, "none of 3 echoes has one; 2 of them: more")],
)  # fmt: skip
def test_an_empty_column_is_said_with_the_reason_of_most_echoes(prepared, counts, said):
    lines, _ = find_remarks(prepared, RunReport(no_data={"amplitude": counts}))
    assert bool(said) == any(line.startswith(f"amplitude: {said}") for line in lines)


def test_every_warning_has_a_listed_code():
    """Codes are for programs: those of the code, of the list and of the documentation are the same."""
    package = Path(wavebatch.__file__).parent
    text = "\n".join(path.read_text() for path in package.rglob("*.py") if path.name != "errors.py")
    used = re.findall(r'(?:StripWarning|StripWarning\.of|warn)\(\s*"([^"]+)"|code, guess = "([^"]+)"', text)
    used = {one or other for one, other in used} | {"header", "lost-packets", "lost-samples", "packets", "repeated"}
    page = (package.parent / "docs" / "json.md").read_text()
    listed = dict(re.findall(r"(?m)^\| `([a-z-]+)` \| ([^|]+) \|$", page.split("### Codes of warnings")[1]))
    assert used == set(WARNINGS) and {code: listed[code] for code in WARNINGS} == WARNINGS
    refuses(ValueError, "no code", StripWarning, "nonsense", "")


@pytest.fixture
def many(tiny_strip, tmp_path):
    """Five strips, the fourth without any echo, and the name of their folder."""
    folder = tmp_path / "in"
    folder.mkdir()
    for name in "abce":
        shutil.copy(tiny_strip, folder / f"{name}.las")
    change_packets(tiny_strip, folder / "d.las", lambda samples: 0 * samples + 12)
    return folder


def test_summary_and_page_have_the_warnings_of_every_strip(many, tmp_path):
    page, out = tmp_path / "page.html", tmp_path / "out"
    task = ["run", str(many), "-o", str(out), "-q", "--profile", "fast", "--json", "--html", str(page)]
    first = succeed(*task, "--fail-on", "nothing-selected")
    again = run_command(*task, "--resume", "--fail-on", "lost-packets,empty")
    assert again.exit_code == 3 and "--fail-on" in again.stderr and "d.las" in again.stderr
    before, after = (json.loads(done.stdout)["strips"] for done in (first, again))
    assert {one["status"] for one in after} == {"skipped"}
    assert [one["warnings"] for one in before] == [one["warnings"] for one in after]
    found = {Path(one["strip"]).stem: one["warnings"] for one in after}
    assert "empty" in [one["code"] for one in found["d"]]
    text = page.read_text().split('id="strips"')[1]
    rows = re.findall(r"<tr><td[^>]*>(?:<a[^>]*>)?([a-e]).las", text)
    doubted = sum(map(bool, found.values()))
    assert {*rows[:doubted]} == {name for name, warnings in found.items() if warnings}
    for one in found["d"]:
        assert one["code"] in text and one["text"][:30] in text
    fail(2, "did you mean 'empty'?", *task, "--resume", "--fail-on", "emtpy")


def test_survey_prints_the_doubts_of_a_run(many):
    shown = run_command("survey", many / "d.las", "--json")
    (one,) = [one for one in json.loads(shown.stdout)["warnings"] if one["code"] == "pulse-guess"]
    assert f"warning           {one['text']}" in run_command("survey", many / "d.las").stdout
    together = run_command("survey", many / "a.las", many / "b.las", "--json")
    assert all("warnings" in strip for strip in json.loads(together.stdout)["strips"])


def test_no_data_of_the_strip_in_added_echoes_is_said(riegl, tmp_path):
    (line,) = [line for line in remarks(riegl, tmp_path) if "added echoes have for no-data" in line]
    cloud = wavebatch.read_cloud(tmp_path / f"{riegl.stem}.laz")
    added = (cloud["echo_flags"] & int(wavebatch.EchoFlag.ADDED)) != 0
    assert added.sum() > 100 and line.split(" added echoes")[0].endswith(str(added.sum()))
    assert "Amplitude 377.68, Pulse width 3776.8: " in line  # as programs show it, not as it is stored
    wavebatch.run(riegl, tmp_path / "none", profile="fast", drop_flags="ADDED")
    assert "added echoes have" not in (tmp_path / "none" / f"{riegl.stem}.report.json").read_text()
