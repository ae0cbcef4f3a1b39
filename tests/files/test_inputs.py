"""Which strips an argument list means."""

import subprocess
import sys

import click
import pytest
from commands import run_command

from wavebatch.cli import main
from wavebatch.core.errors import ConfigError
from wavebatch.files.text_file import find_files, find_strips


@pytest.fixture
def folder(tmp_path):
    for name in ("b.las", "a.LAZ", "a.wdp", "note.txt", ".hidden.las", "sub/c.laz"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    return tmp_path


def _names(arguments):
    return [path.name for path in find_strips(arguments)]


def test_a_folder_means_its_strips_by_name(folder):
    assert _names([str(folder)]) == ["a.LAZ", "b.las"]


def test_globs_mean_strips_only(folder):
    assert _names([str(folder / "*")]) == ["a.LAZ", "b.las"]
    assert _names([str(folder / "**" / "*")]) == ["a.LAZ", "b.las", "c.laz"]


def test_a_list_is_relative_to_itself_and_may_hold_all_of_it(folder):
    (folder / "strips.txt").write_text("# night of the 21st\n\nb.las\nsub\n*.LAZ\n")
    assert _names([f"@{folder / 'strips.txt'}"]) == ["b.las", "c.laz", "a.LAZ"]


@pytest.mark.parametrize("name", ["@-", "@/dev/stdin"])
def test_a_list_from_a_pipe_is_relative_to_where_the_command_runs(folder, name):
    """`find ... | wavebatch run @-`; names were looked for in /dev."""
    command = [sys.executable, "-m", "wavebatch", "check", name]
    done = subprocess.run(command, cwd=folder, input="b.las\nsub\n", capture_output=True, text=True)
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == ["b.las", "sub/c.laz"]


def test_a_strip_counts_once(folder):
    assert _names([str(folder / "b.las"), str(folder), str(folder / "sub" / ".." / "b.las")]) == ["b.las", "a.LAZ"]


def test_a_link_to_a_strip_that_was_given_is_named(folder):
    (folder / "link.las").symlink_to(folder / "b.las")
    lines = []
    assert find_strips([str(folder / "b.las"), str(folder / "link.las")], note=lines.append) == [folder / "b.las"]
    assert lines == [f"{folder / 'link.las'}: is the same file as {folder / 'b.las'}; it is used once"]
    find_strips([str(folder / "b.las"), str(folder / "sub" / ".." / "b.las")], note=lines.append)
    assert len(lines) == 1
    done = run_command("run", folder / "b.las", folder / "link.las", "-o", folder / "o")
    assert lines[0] in done.stderr


def test_files_of_one_name_may_be_read_together_but_not_written_into_one_folder(folder):
    (folder / "sub" / "b.laz").write_bytes(b"")
    arguments = [str(folder), str(folder / "sub")]
    assert [path.name for path in find_files(arguments)] == ["a.LAZ", "b.las", "b.laz", "c.laz"]
    with pytest.raises(ConfigError, match="both outputs would be named b"):
        find_strips(arguments)


def test_a_name_with_brackets_is_a_name(folder):
    (folder / "x[1].las").write_bytes(b"")
    assert _names([str(folder / "x[1].las")]) == ["x[1].las"]


def test_a_named_file_that_is_missing_fails_later_and_alone(folder):
    assert _names([str(folder / "none.las"), str(folder / "b.las")]) == ["none.las", "b.las"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["empty"], "holds no .las or .laz"),
        (["*.laz2"], "matches no"),
        (["@none.txt"], "list cannot be read: No such file"),
        (["@loop.txt"], "line 1: a list cannot name another list"),
        (["@blank.txt"], "blank.txt: the list names no file; write one"),
        (["b.las", "@blank.txt"], "the list names no file"),
        ([], "no file given; name files"),
        (["b.las", "sub/b.laz"], "both outputs would be named b"),
    ],
)
def test_what_means_nothing_is_refused_in_one_line(folder, monkeypatch, arguments, words):
    monkeypatch.chdir(folder)
    (folder / "empty").mkdir()
    (folder / "sub" / "b.laz").write_bytes(b"")
    (folder / "loop.txt").write_text("@loop.txt\n")
    (folder / "blank.txt").write_text("# nothing\n")
    with pytest.raises(ConfigError, match=words) as caught:
        find_strips(arguments)
    assert "\n" not in str(caught.value)


def test_every_command_that_takes_lists_refuses_an_empty_one_in_one_line(tmp_path):
    """A command that takes `@list.txt` reads it with `find_files`: it must neither crash nor end well on nothing."""
    (tmp_path / "empty.txt").write_text("# nothing yet\n\n")
    (tmp_path / "targets.csv").write_text("name,x,y,radius,reflectance\na,0,0,1,0.5\n")
    given = f"@{tmp_path / 'empty.txt'}"
    more = {"run": ["-o", tmp_path / "out"], "calibrate": ["--targets", tmp_path / "targets.csv", "-o", tmp_path / "c"],
            "slice": ["-o", tmp_path / "s.csv"], "voxelize": ["--size", "1", "-o", tmp_path / "v.npz"],
            "grid": ["--column", "z", "-o", tmp_path / "g.tif"], "plot histogram": ["--column", "z"],
            "plot map": ["--column", "z"], "plot section": ["--column", "z"]}  # fmt: skip
    takers = list(_list_takers(main))
    assert {"run", "info", "check", "stats", "plot histogram", "plot profile", *more} <= set(takers)
    for words in takers:
        rest = [*more.get(words, []), *(["-o", tmp_path / "p.png"] if words.startswith("plot") else [])]
        result = run_command(*words.split(), given, *rest)
        assert result.exit_code == 2, (words, result.output, result.exception)
        (line,) = result.stderr.splitlines()
        assert line == f"error: {given[1:]}: the list names no file; write one file, folder or pattern per line", words
    assert sorted(path.name for path in tmp_path.iterdir()) == ["empty.txt", "targets.csv"]


def _list_takers(command, path=""):
    """Paths of the commands with an argument whose help says `@list.txt`."""
    if isinstance(command, click.Group):
        for name in command.list_commands(click.Context(command)):
            yield from _list_takers(command.get_command(click.Context(command), name), f"{path} {name}".strip())
    elif "@list.txt" in (command.help or ""):
        yield path
