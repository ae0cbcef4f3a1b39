"""Folders, lists and bad files: every command takes strips as `run` does."""

import json
import shutil

import pytest
from commands import run_command as run


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


COMMANDS = {
    "info": ([], None),
    "check": ([], None),
    "survey": ([], None),
    "run": (["-o", "out", "--profile", "fast", "-q"], ["A.laz", "A.report.json", "b.laz", "b.report.json"]),
    "voxelize": (["-o", "out", "--size", "5", "-q"], ["A.npz", "b.npz"]),
    "slice": (["-o", "out", "-q"], ["A.csv", "b.csv"]),
}


@pytest.mark.quick_cases("info-folder", "survey-folder", "run-list", "slice-list")
@pytest.mark.parametrize("form", ["folder", "list"])
@pytest.mark.parametrize("command", COMMANDS)
def test_folders_and_lists_with_a_bad_file(folder, tmp_path, monkeypatch, command, form):
    monkeypatch.chdir(tmp_path)
    options, expected = COMMANDS[command]
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
    result = run(command, folder, "--recursive", "-o", tmp_path / "out", *options)
    assert result.exit_code == 2 and "two strips have the same name" in result.stderr


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
