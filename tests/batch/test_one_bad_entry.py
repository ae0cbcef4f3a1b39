"""One bad name, folder, disk or output never stops the other strips of a batch, and never changes what they end as."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from batch_tools import make_job, run_one
from commands import refuses, run_command

from wavebatch.batch.options import RunOptions
from wavebatch.batch.run import run_batch
from wavebatch.core.errors import InputError
from wavebatch.files.disk import publish
from wavebatch.files.text_file import find_strips
from wavebatch.stages.chain import effective, load_profile
from wavebatch.tools.simulate import simulate_strip
from wavebatch.tools.simulate.strip import StripOptions

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="names and errors of POSIX systems")


@pytest.fixture
def place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    simulate_strip("flat", tmp_path / "good.las", pulses=200, seed=1, options=StripOptions(internal=False))
    return tmp_path


def _run(*arguments):
    return run_command("run", *arguments, "-o", "out", "--profile", "fast")


def _is_fine(result, code, *words):
    assert result.exit_code == code, result.stderr
    assert "Traceback" not in result.stderr and "bug" not in result.stderr
    errors = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1 and all(word in errors[0] for word in words), result.stderr
    assert Path("out/good.laz").exists() and Path("out/good.report.json").exists()
    assert not list(Path("out").glob(".*"))


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("x" * 300 + ".las", "File name too long"),
        ("x" * 300 + "/a.las", "File name too long"),
        ("loop.las", "levels of symbolic links"),
        ("loop.las/a.las", "levels of symbolic links"),
        ("nul\0name.las", "null"),
        ("good.las/inside.las", "Not a directory"),
        ("x" * 249 + ".las", "File name too long"),  # its report has a longer name than the strip and the cloud
    ],
)
@pytest.mark.parametrize("listed", [False, True])
def test_a_bad_name_fails_alone(place, name, words, listed):
    os.symlink("loop.las", "loop.las")
    if len(name) == 253:
        (place / name).write_bytes(Path("good.las").read_bytes())
        os.link("good.wdp", place / name.replace(".las", ".wdp"))
    if listed:
        (place / "list.txt").write_text(f"{name}\ngood.las\n")
        result = _run("@list.txt")
    else:
        result = _run(name, "good.las")
    _is_fine(result, 3, words)
    assert len(list(Path("out").iterdir())) == 2


def test_a_folder_that_cannot_be_read_fails_alone(place, monkeypatch):
    (place / "closed").mkdir()
    for name in ("listdir", "scandir"):
        function = getattr(os, name)
        monkeypatch.setattr(os, name, lambda path=".", *more, f=function: _refuse(f, path, *more))
    assert find_strips(["closed", "good.las"]) == [Path("closed"), Path("good.las")]
    _is_fine(_run("closed", "good.las"), 3, "closed", "Permission denied")


def _refuse(function, path, *more):
    if Path(str(path)).name == "closed":
        raise PermissionError(errno.EACCES, "Permission denied", str(path))
    return function(path, *more)


@pytest.mark.parametrize("command", ["run", "info", "check", "survey", "voxelize"])
@pytest.mark.parametrize("number", [errno.EACCES, errno.EIO, errno.ESTALE])
def test_a_packet_file_that_cannot_be_read_is_one_line(place, monkeypatch, command, number):
    import builtins

    simulate_strip("flat", place / "bad.las", pulses=200, seed=2, options=StripOptions(internal=False))
    real = builtins.open

    def refuse(path, *more, **options):
        if str(path).endswith("bad.wdp"):
            raise OSError(number, os.strerror(number), str(path))
        return real(path, *more, **options)

    monkeypatch.setattr(builtins, "open", refuse)
    if command == "run":
        _is_fine(_run("bad.las", "good.las"), 3, "bad.wdp", os.strerror(number))
        return
    more = {"voxelize": ["-o", "v.npz", "--size", "1"]}.get(command, [])
    result = run_command(command, "bad.las", *more)
    said = result.stdout + result.stderr
    assert result.exit_code == 1 and os.strerror(number) in said and "bug" not in said and "Traceback" not in said


def test_a_disk_error_anywhere_is_one_line_with_its_file(place, monkeypatch):
    from wavebatch.batch import strip_task

    def fail(self):
        if self.job.path.name == "bad.las":
            raise OSError(errno.EIO, "Input/output error", "bad.las")
        return stat(self)

    stat = strip_task.StripTask._stat
    monkeypatch.setattr(strip_task.StripTask, "_stat", fail)
    (place / "bad.las").write_bytes(Path("good.las").read_bytes())
    os.link("good.wdp", "bad.wdp")
    _is_fine(_run("bad.las", "good.las"), 3, "bad.las: Input/output error; check disk")


def test_a_summary_that_cannot_be_written_is_told_and_is_not_a_failure_of_the_strips(place, monkeypatch):
    (place / "reports").mkdir()
    result = _run("good.las", "--report", place / "reports" / ("x" * 300))
    _is_fine(result, 1, "--report", "File name too long")
    again = _run("good.las", "none.las", "--resume", "--report", place / "reports" / ("x" * 300))
    assert again.exit_code == 3 and again.stderr.count("error: ") == 2


@pytest.mark.quick_cases("full-options0")
@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")
@pytest.mark.parametrize("options", [["--report", "-"], ["--progress", "json"]])
@pytest.mark.parametrize("target", ["full", "gone", "closed"])
def test_stdout_that_cannot_be_written_does_not_change_the_clouds(place, options, target):
    command = [sys.executable, "-m", "wavebatch", "run", "good.las", "-o", "out", "--profile", "fast", *options]
    if target == "full":
        with open("/dev/full", "wb") as stdout:
            done = subprocess.run(command, stdout=stdout, stderr=subprocess.PIPE, text=True)
    elif target == "closed":
        done = subprocess.run(["sh", "-c", 'exec "$@" >&-', "sh", *command], stderr=subprocess.PIPE, text=True)
    else:
        reader, writer = os.pipe()
        os.close(reader)
        done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, text=True)
        os.close(writer)
    errors = [line for line in done.stderr.splitlines() if line.startswith("error: ")]
    if target == "closed" and not errors:  # Python has no stdout then, and click prints nothing
        assert done.returncode == 0
    else:
        assert done.returncode == 1 and len(errors) == 1 and "stdout" in errors[0], done.stderr
    assert "Traceback" not in done.stderr and "Exception ignored" not in done.stderr
    assert json.loads(Path("out/good.report.json").read_text())["output"]["file"] == "good.laz"


@pytest.mark.parametrize("overwrite", [False, True])
def test_a_report_that_cannot_be_published_takes_its_cloud_back_or_says_what_is_there(place, monkeypatch, overwrite):
    def refuse(source, target):
        if str(target).endswith(".report.json"):
            raise OSError(errno.EIO, "Input/output error")
        return real(source, target)

    if overwrite:
        run_one("good.las", "out")
    name = "replace" if overwrite else "link"
    real = getattr(os, name)
    monkeypatch.setattr(publish.os, name, refuse)
    outcome = run_one("good.las", "out", batch={"overwrite": overwrite})
    assert outcome.status == "failed"
    assert "good.report.json: cannot be written: Input/output error" in str(outcome.error)
    if overwrite:
        assert "good.laz: replaced before that, and complete" in str(outcome.error)
        assert [path.name for path in Path("out").iterdir()] == ["good.laz"]
    else:
        assert not list(Path("out").iterdir())


_SECOND = """
import sys
from pathlib import Path
sys.path.insert(0, {tests!r})
from batch_tools import run_one
outcome = run_one("good.las", "out", profile="balanced", batch={batch})
print(outcome.status, outcome.error)
"""


@pytest.mark.quick_cases("batch2")
@pytest.mark.parametrize("batch", [{}, {"overwrite": True}, {"resume": True}])
def test_two_runs_never_mix_their_outputs(place, batch):
    """The second run begins while the first has finished its cloud and not yet published it."""
    code = _SECOND.format(tests=str(Path(__file__).parent.parent), batch=batch)
    said = []

    def begin(event):
        if event["event"] == "unit":
            done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
            said.append(done.stdout + done.stderr)

    result = run_batch([make_job("good.las")], RunOptions(Path("out"), **batch), begin)
    assert result.failed == 0
    assert said[0].startswith("failed") and "good: another run makes this output now" in said[0]
    report = json.loads(Path("out/good.report.json").read_text())
    assert report["chain"] == effective(load_profile("fast"))
    assert report["output"]["size"] == os.path.getsize("out/good.laz")
    assert sorted(path.name for path in Path("out").iterdir()) == ["good.laz", "good.report.json"]
    assert run_one("good.las", "out", profile="balanced", batch={"overwrite": True}).status == "written"


def test_the_claim_of_a_killed_run_counts_no_more(tmp_path):
    code = "import os, sys; from pathlib import Path; from wavebatch.files.disk.publish import Claim\n"
    code += "Claim(Path(sys.argv[1]), 'a'); os.kill(os.getpid(), 9)"
    subprocess.run([sys.executable, "-c", code, tmp_path])
    assert len(list(tmp_path.iterdir())) == 1
    claim = publish.Claim(tmp_path, "a")
    refuses(InputError, "another run makes this output now", publish.Claim, tmp_path, "a")
    assert publish.remove_stale(tmp_path) == []
    claim.discard()
    assert not list(tmp_path.iterdir())


def test_a_pattern_that_is_no_name_ends_at_once(place):
    """A list of 100,000 brackets was searched for minutes."""
    Path("list.txt").write_text("good.las\n" + "[" * 100_000 + "a.las\n")
    _is_fine(_run("@list.txt"), 3, "File name too long")
