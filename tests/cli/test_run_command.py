"""`wavebatch run` as a user sees it: output, exit codes, messages; other commands with several strips."""

import json
import os
import shutil
import subprocess
import sys

import pytest
from batch_tools import read_cloud
from commands import fail, run_command, succeed
from commands import run_command as run

from wavebatch.cli import COMMANDS
from wavebatch.tools.simulate import StripOptions, simulate_strip


def _run(*arguments):
    return run_command("run", *arguments)


def test_a_strip_is_written_and_said_in_one_line_on_stderr(tiny_strip, tmp_path):
    result = _run(tiny_strip, "-o", tmp_path / "new" / "folder", "--profile", "fast")
    assert result.exit_code == 0 and result.stdout == ""
    assert result.stderr.count("\n") == 1 and "tiny.las" in result.stderr and "waveforms" in result.stderr
    assert sorted(p.name for p in (tmp_path / "new" / "folder").iterdir()) == ["tiny.laz", "tiny.report.json"]


def test_some_failed_is_3_none_written_is_4(tiny_strip, tmp_path):
    bad = tmp_path / "bad.las"
    bad.write_bytes(b"LASF")
    some = _run(bad, tiny_strip, "-o", tmp_path / "out", "--profile", "fast", "-q")
    assert some.exit_code == 3
    assert some.stderr.count("\n") == 1 and "bad.las" in some.stderr and "Traceback" not in some.stderr
    none = _run(bad, "-o", tmp_path / "out")
    assert none.exit_code == 4
    assert sorted(p.name for p in (tmp_path / "out").iterdir()) == ["tiny.laz", "tiny.report.json"]


@pytest.mark.parametrize("more", [[], ["--dry-run"]])
def test_debug_shows_the_traceback(tmp_path, more):
    result = _run(tmp_path / "none.las", "-o", tmp_path / "out", "--debug", *more)
    assert result.exit_code == 4 and "Traceback" in result.stderr and "none.las" in result.stderr


@pytest.mark.parametrize("dry", [False, True])
@pytest.mark.parametrize(("names", "code"), [(["tiny"], 2), (["tiny", "none"], 4), (["none"], 4)])
def test_wrong_columns_give_a_dry_run_the_exit_code_of_a_run(tiny_strip, tmp_path, names, code, dry):
    strips = [tiny_strip.with_name(f"{name}.las") for name in names]
    result = _run(*strips, "-o", tmp_path / "out", "--where", "amplitud > 3", *["--dry-run"] * dry)
    assert result.exit_code == code and ("there is no column 'amplitud'" in result.stderr) == ("tiny" in names)


def test_dry_run_says_what_would_be_done_and_touches_nothing(tiny_strip, tmp_path):
    result = _run(tiny_strip, tmp_path / "none.las", "-o", tmp_path / "out", "--dry-run", "--columns", "+echo_time")
    assert result.exit_code == 3
    assert "tiny.las: write" in result.stdout and "echo_time" in result.stdout and "[[chain]]" in result.stdout
    assert result.stderr.count("\n") == 1 and "none.las" in result.stderr
    assert not (tmp_path / "out").exists()


def test_report_of_the_batch_to_a_file_and_to_stdout(tiny_strip, tmp_path):
    succeed("run", tiny_strip, "-o", tmp_path / "a", "--report", tmp_path / "batch.json", "--profile", "fast")
    document = json.loads((tmp_path / "batch.json").read_text())
    assert document["schema"] == "wavebatch.batch-report/1"
    assert [strip["status"] for strip in document["strips"]] == ["written"]
    again = succeed("run", tiny_strip, "-o", tmp_path / "a", "--report", "-", "--profile", "fast", "--resume", "-q")
    printed = json.loads(again.stdout)
    assert printed["counts"] == document["counts"] and printed["strips"][0]["status"] == "skipped"


def test_resume_says_why_a_cloud_is_made_again(tiny_strip, tmp_path):
    out = tmp_path / "a"
    words = ("-o", out, "--resume", "--profile")
    assert "made again" not in _run(tiny_strip, *words, "fast").stderr
    assert "tiny.las: is made again: changed since: chain\n" in _run(tiny_strip, *words, "balanced").stderr
    where = ("balanced", "--columns", "+echo_time", "--bbox", "0,0,1,1")
    assert "changed since: columns, selection\n" in _run(tiny_strip, *words, *where).stderr
    assert "changed since: bbox\n" in _run(tiny_strip, *words, *where[:-1], "0,0,1,2").stderr
    (out / "tiny.laz").unlink()
    assert "its cloud is missing or damaged\n" in _run(tiny_strip, *words, *where[:-1], "0,0,1,2").stderr
    (out / "tiny.report.json").write_text("{")
    assert "its report is damaged\n" in _run(tiny_strip, *words, "fast").stderr


def test_progress_as_json_lines(tiny_strip, tmp_path):
    result = _run(tiny_strip, tmp_path / "none.las", "-o", tmp_path / "a", "--progress", "json", "-q")
    events = [json.loads(line) for line in result.stdout.splitlines()]
    assert [event["event"] for event in events] == ["start", "unit", "written", "failed"]
    assert events[1]["done"] == events[1]["of"] == 1
    assert "none.las" in events[3]["error"]


def test_a_bar_on_request(tiny_strip, tmp_path):
    """Into a folder that is there, whatever its name."""
    (tmp_path / "out.las").mkdir()
    result = _run(tiny_strip, "-o", tmp_path / "out.las", "--progress", "bar", "--profile", "fast")
    assert result.exit_code == 0 and "100%" in result.stderr


def test_verbose_says_what_the_automatic_chain_leaves_out_and_why(tiny_strip, tmp_path):
    loud = _run(tiny_strip, "-o", tmp_path / "v", "-v")
    assert "growth of fits: yes: of the " in loud.stderr and "censored fit: no: " in loud.stderr
    assert "censored fit" not in _run(tiny_strip, "-o", tmp_path / "w").stderr


def test_quiet_says_nothing_and_verbose_more(tiny_strip, tmp_path):
    assert _run(tiny_strip, "-o", tmp_path / "q", "-q", "--profile", "fast").output == ""
    loud = _run(tiny_strip, "-o", tmp_path / "v", "-v", "--profile", "fast")
    assert "NO_WAVEFORM" in loud.stderr and "s elapsed" in loud.stderr


def test_options_reach_the_cloud(tiny_strip, tmp_path):
    options = ["--format", "las", "--point-format", "6", "--names", "asprs", "--columns", "echo_width,echo_flags",
               "--points", "returns", "--direction", "toward", "--memory", "400M", "--block-size", "50"]  # fmt: skip
    assert _run(tiny_strip, "-o", tmp_path, *options).exit_code == 0
    cloud, _ = read_cloud(tmp_path / "tiny.las")
    assert {"classification_flags", "pulse width", "echo_flags"} <= set(cloud.dtype.names)
    assert "amplitude" not in cloud.dtype.names


def test_the_wrong_direction_puts_echoes_elsewhere(tiny_strip, tmp_path):
    warned = {}
    for sign in ("toward", "away"):
        result = succeed("run", tiny_strip, "-o", tmp_path / sign, "--direction", sign, "--profile", "fast")
        warned[sign] = [line for line in result.stderr.splitlines() if ": warning: " in line]
    assert warned["toward"] == []
    (line,) = warned["away"]
    assert line.startswith(f"{tiny_strip}: warning: --direction away overrides the evidence of the file: ")
    quiet = _run(tiny_strip, "-o", tmp_path / "away", "--direction", "away", "--profile", "fast", "--overwrite", "-q")
    assert quiet.exit_code == 0 and quiet.stderr == ""
    report = json.loads((tmp_path / "away" / "tiny.report.json").read_text())
    assert report["strip"]["direction"]["sign"] == "away"


def test_a_headerless_wdp_is_refused_unless_forced(tmp_path):
    strip = tmp_path / "x.las"
    simulate_strip("flat", strip, pulses=50, options=StripOptions(internal=False))
    packets = strip.with_suffix(".wdp")
    packets.write_bytes(b"\0" * 60 + packets.read_bytes()[60:])
    fail(4, "headerless", "run", strip, "-o", tmp_path / "a")
    assert _run(strip, "-o", tmp_path / "a", "--headerless").exit_code == 0


PAGES = "wavebatch.tools.sheets.page wavebatch.tools.plots matplotlib"
SURVEYS = "wavebatch.surveying.survey wavebatch.surveying.flight wavebatch.surveying.predict_error"


@pytest.mark.parametrize(
    "command, unused",
    [
        ("--help", "numpy laspy scipy tqdm lazrs matplotlib"),
        ("plot map --help", "laspy matplotlib"),
        ("info STRIP", "laspy scipy wavebatch.stages wavebatch.surveying.survey"),
        ("run STRIP -o OUT --system SYSTEM", f"{SURVEYS} laspy pyproj requests urllib3 numpy.ma scipy dask {PAGES}"),
        ("survey STRIP", f"wavebatch.batch.run laspy pyproj numpy.ma numpy.random scipy {PAGES}"),
    ],
)
def test_commands_import_only_what_they_use(tmp_path, tiny_strip, command, unused):
    """laspy imports an HTTP client, which took a sixth of the start of every process; the others a tenth each."""
    places = {"STRIP": tiny_strip, "OUT": tmp_path / "out", "SYSTEM": tmp_path / "a.toml"}
    assert run_command("survey", tiny_strip, "-o", places["SYSTEM"]).exit_code == 0
    words = [str(places.get(word, word)) for word in command.split()]
    code = (
        f"import sys\nfrom wavebatch.cli import main\n"
        f"try:\n    main({words!r})\nexcept SystemExit as end:\n    assert not end.code\n"
        f"print(sorted(set({unused.split()!r}) & sys.modules.keys()))"
    )
    plain = {name: value for name, value in os.environ.items() if not name.startswith("WAVEBATCH_")}
    plain |= {"WAVEBATCH_RUN_JOBS": "1", "WAVEBATCH_JOBS": "1"}  # that `info` and `survey` read neither is no surprise
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=plain)
    assert done.stdout.splitlines()[-1] == "[]"
    assert command != "--help" or all(f"  {name}" in done.stdout for name in COMMANDS)


def test_python_m_wavebatch_is_the_command():
    done = subprocess.run([sys.executable, "-m", "wavebatch", "--version"], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("wavebatch ")


def test_what_lies_under_the_output_is_made(tiny_strip, tmp_path):
    """README's line for cron was refused: folder `new` does not exist."""
    new = tmp_path / "new"
    words = ["run", str(tiny_strip), "-o", str(new), "-q", "--profile", "fast"]
    done = run_command(*words, "--report", new / "sub" / "sum.json", "--html", new / "p.html")
    assert done.exit_code == 0 and (new / "sub" / "sum.json").exists() and (new / "p.html").exists(), done.stderr


@pytest.fixture
def folder(tiny_strip, tmp_path):
    """A folder with a strip in capitals, one in a subfolder, one in a hidden folder, and a file that is none."""
    folder = tmp_path / "strips"
    for name in ("A.LAS", "sub/b.Las", ".hidden/c.las"):
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(tiny_strip, folder / name)
    (folder / "bad.laz").write_bytes(b"LASX")
    (tmp_path / "list.txt").write_text("strips\n")
    return folder


SEVERAL = {
    "info": ([], None),
    "check": ([], None),
    "survey": ([], None),
    "run": (["-o", "out", "--profile", "fast", "-q"], ["A.laz", "A.report.json", "b.laz", "b.report.json"]),
    "voxelize": (["-o", "out", "--size", "5", "-q"], ["A.npz", "b.npz"]),
    "slice": (["-o", "out", "-q"], ["A.csv", "b.csv"]),
}


@pytest.mark.quick_cases("info-folder", "survey-folder", "run-list", "slice-list")
@pytest.mark.parametrize("form", ["folder", "list"])
@pytest.mark.parametrize("command", SEVERAL)
def test_folders_and_lists_with_a_bad_file(folder, tmp_path, monkeypatch, command, form):
    monkeypatch.chdir(tmp_path)
    options, expected = SEVERAL[command]
    result = run(command, folder if form == "folder" else "@list.txt", "--recursive", *options)
    assert result.exit_code == (3 if command == "run" else 1), result.output
    problem = result.stdout if command == "check" else result.stderr
    assert "bad.laz: not a LAS or LAZ file" in problem and ".hidden" not in result.output
    if expected:
        assert sorted(path.name for path in (tmp_path / "out").iterdir()) == expected
    flat = run(command, folder, *[option.replace("out", "flat") for option in options])
    assert "b.Las" not in flat.output
    if expected:
        assert not list((tmp_path / "flat").glob("b.*")) and list((tmp_path / "flat").glob("A.*"))


@pytest.mark.parametrize("command", ["voxelize", "slice"])
def test_one_file_for_several_strips_and_two_of_one_name_are_refused(folder, tmp_path, command):
    options = ["--size", "5"] if command == "voxelize" else []
    name = "x.npz" if command == "voxelize" else "x.csv"
    (folder / "bad.laz").unlink()
    result = run(command, folder, "--recursive", "-o", tmp_path / name, *options)
    assert result.exit_code == 2 and f"{name}: one file for 2 strips; give a folder" in result.stderr
    (folder / "sub" / "b.Las").rename(folder / "sub" / "A.las")
    fail(2, "two strips have the same name", command, folder, "--recursive", "-o", tmp_path / "out", *options)


@pytest.mark.parametrize("command", ["info", "voxelize", "slice"])
def test_json_is_an_object_for_one_strip_and_a_list_for_several(folder, tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    options = {"info": [], "voxelize": ["-o", "v.npz", "--size", "5"], "slice": ["-o", "s.csv"]}[command]
    one = json.loads(run(command, folder / "A.LAS", "--json", *options, *(["--overwrite"] if options else [])).stdout)
    assert isinstance(one, dict)
    more = ["--overwrite"] if options else []
    many = json.loads(run(command, folder, "--recursive", "--json", *_folder(options), *more).stdout)
    assert isinstance(many, list) and len(many) == 2


def _folder(options):
    """The options with a folder as the output."""
    return [f"{option[0]}_folder" if option in ("v.npz", "s.csv") else option for option in options]
