"""Files that appear whole or not at all, arrays on disk, and which files arguments name."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys

import click
import numpy as np
import pytest
from commands import refuses, run_command

from wavebatch.cli import main
from wavebatch.core.errors import ConfigError, InputError
from wavebatch.files.disk import publish
from wavebatch.files.disk.npz import NpzWriter
from wavebatch.files.disk.publish import Draft, is_stream, publish_together, refuse_existing, remove_stale
from wavebatch.files.text_file import find_files, find_strips, write_text


def write(target, text, *, overwrite=False):
    draft = Draft(target, overwrite=overwrite)
    draft.file.write(text)
    return draft


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_nothing_has_the_name_until_it_is_published(tmp_path):
    draft = write(tmp_path / "a", b"one")
    assert not (tmp_path / "a").exists() and len(names(tmp_path)) == 1
    draft.publish()
    assert names(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == b"one"


def test_discard_leaves_nothing(tmp_path):
    draft = write(tmp_path / "a", b"one")
    draft.discard()
    draft.discard()
    assert names(tmp_path) == []


def test_an_existing_file_is_kept_without_overwrite(tmp_path):
    target = tmp_path / "a"
    draft = write(target, b"new")
    target.write_bytes(b"old")  # appears while we write
    refuses(InputError, r"a: exists already; .*--overwrite", publish_together, [draft])
    assert names(tmp_path) == ["a"] and target.read_bytes() == b"old"
    refuses(InputError, "exists already", refuse_existing, target)


def test_overwrite_replaces(tmp_path):
    target = tmp_path / "a"
    target.write_bytes(b"old")
    write(target, b"new", overwrite=True).publish()
    assert names(tmp_path) == ["a"] and target.read_bytes() == b"new"


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_devices_and_pipes_are_never_replaced(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for target in (pipe, "/dev/null", "/dev/stdout", "/dev/fd/1", "/proc/self/fd/1"):
        assert is_stream(target)
        refuses(InputError, "is a device or a pipe, .*; choose another name", Draft, target, overwrite=True)
    refuses(InputError, "pipe: is a device or a pipe", refuse_existing, pipe)
    assert names(tmp_path) == ["pipe"]
    for name in (tmp_path / "a", tmp_path, tmp_path / "none" / "a", "/dev/shm/a"):
        assert not is_stream(name)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_text_goes_into_a_pipe_that_somebody_reads(tmp_path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    with pytest.raises(InputError, match="pipe: cannot be written: "):  # and is not waited for
        write_text(pipe, "lost", overwrite=True)
    reader = os.open(pipe, os.O_RDONLY | os.O_NONBLOCK)
    try:
        write_text(pipe, "text", overwrite=True)
        assert os.read(reader, 10) == b"text"
    finally:
        os.close(reader)
    write_text("/dev/null", "text", overwrite=True)
    assert names(tmp_path) == ["pipe"] and is_stream("/dev/null")


def test_a_dangling_link_is_not_written_through(tmp_path):
    (tmp_path / "a").symlink_to(tmp_path / "elsewhere")
    refuses(InputError, "exists already", refuse_existing, tmp_path / "a")
    refuses(InputError, "exists already", publish_together, [write(tmp_path / "a", b"new")])
    assert names(tmp_path) == ["a"]


def test_the_same_bytes_count_as_published_where_asked(tmp_path):
    (tmp_path / "a").write_bytes(b"same")
    write(tmp_path / "a", b"same").publish(same_is_fine=True)
    assert names(tmp_path) == ["a"]
    with pytest.raises(InputError, match="exists already"):
        publish_together([write(tmp_path / "a", b"sane"), write(tmp_path / "b", b"")])
    assert names(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == b"same"


def test_a_pair_is_taken_back_when_its_second_half_fails(tmp_path):
    first, second = write(tmp_path / "a.wdp", b"1"), write(tmp_path / "a.las", b"2")
    (tmp_path / "a.las").write_bytes(b"other")
    refuses(InputError, "a.las: exists already", publish_together, [first, second])
    assert names(tmp_path) == ["a.las"] and (tmp_path / "a.las").read_bytes() == b"other"


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP])
def test_file_systems_without_links_still_never_replace(tmp_path, monkeypatch, number):
    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(publish.os, "link", refuse)
    write(tmp_path / "a", b"one").publish()
    assert (tmp_path / "a").read_bytes() == b"one"
    refuses(InputError, "exists already", publish_together, [write(tmp_path / "a", b"two")])
    assert names(tmp_path) == ["a"] and (tmp_path / "a").read_bytes() == b"one"


def test_works_where_files_cannot_be_locked(tmp_path, monkeypatch):
    monkeypatch.setattr(publish, "fcntl", None)
    write(tmp_path / "a", b"one").publish()
    assert names(tmp_path) == ["a"]
    (tmp_path / ".wavebatch-1-a.tmp").write_bytes(b"")
    assert remove_stale(tmp_path) == []


def _race(target, start, results):
    draft = write(target, str(os.getpid()).encode())
    start.wait()
    try:
        draft.publish()
        results.put(os.getpid())
    except InputError:
        draft.discard()
        results.put(None)


def test_of_many_writers_exactly_one_wins(tmp_path):
    context = multiprocessing.get_context("spawn")
    start, results = context.Barrier(3), context.Queue()
    workers = [context.Process(target=_race, args=(tmp_path / "a", start, results)) for _ in range(3)]
    for worker in workers:
        worker.start()
    winners = [results.get(timeout=300) for _ in workers]
    for worker in workers:
        worker.join()
    (winner,) = [pid for pid in winners if pid]
    assert names(tmp_path) == ["a"] and int((tmp_path / "a").read_bytes()) == winner


def test_stale_files_go_and_those_being_written_stay(tmp_path):
    alive = write(tmp_path / "a", b"alive")
    assert alive.path.name.startswith(f".wavebatch-{os.getpid()}-")
    code = (
        "import sys, time; from pathlib import Path; from wavebatch.files.disk.publish import Draft\n"
        "draft = Draft(Path(sys.argv[1]), overwrite=False); print('ready', flush=True); time.sleep(600)"
    )
    with subprocess.Popen([sys.executable, "-c", code, str(tmp_path / "b")], stdout=subprocess.PIPE) as other:
        assert other.stdout.readline() == b"ready\n"
        assert remove_stale(tmp_path) == [] and len(names(tmp_path)) == 2
        other.send_signal(signal.SIGKILL)
    (tmp_path / "user.tmp").write_bytes(b"not ours")
    assert [path.name.startswith(".wavebatch-") for path in remove_stale(tmp_path)] == [True]
    assert alive.path.name in names(tmp_path)
    alive.publish()
    assert names(tmp_path) == ["a", "user.tmp"]


def test_a_file_taken_before_it_was_locked_is_made_again(tmp_path, monkeypatch):
    flock, calls = publish.fcntl.flock, []

    def steal(descriptor, how):
        calls.append(descriptor)
        if len(calls) == 1:
            (path,) = tmp_path.iterdir()
            path.unlink()
        flock(descriptor, how)

    monkeypatch.setattr(publish.fcntl, "flock", steal)
    write(tmp_path / "a", b"one").publish()
    assert len(calls) == 2 and (tmp_path / "a").read_bytes() == b"one"


def test_a_missing_folder_is_one_line(tmp_path):
    with pytest.raises(InputError, match=r"none/a: cannot be written: No such file .*; make the folder first$"):
        Draft(tmp_path / "none" / "a", overwrite=False)
    with pytest.raises(InputError, match=r"none: cannot be written: No such file .*; make the folder first$"):
        publish.Claim(tmp_path / "none", "strip")


def test_permission_error_names_the_remedy(tmp_path, monkeypatch):
    def refuse(*_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(publish.os, "open", refuse)
    with pytest.raises(InputError, match="a: cannot be written: Permission denied; check the folder's permissions$"):
        Draft(tmp_path / "a", overwrite=False)


def test_published_files_get_the_usual_permissions(tmp_path):
    old = os.umask(0o022)
    try:
        write(tmp_path / "a", b"").publish()
    finally:
        os.umask(old)
    assert (tmp_path / "a").stat().st_mode & 0o777 == 0o644


@pytest.mark.quick_cases("run-3000")
@pytest.mark.skipif(os.name == "nt", reason="limits of POSIX systems")
@pytest.mark.parametrize(("command", "most"), [("run", 0), ("run", 3000), ("voxelize", 3000)])
def test_a_full_disk_is_told_as_such_by_compressors_and_on_closing_too(tmp_path, tiny_strip, command, most):
    """A compressor says only that it could not seek; a file that is closed writes what it holds."""
    more = ["-o", tmp_path, "--profile", "fast"] if command == "run" else ["-o", tmp_path / "a.npz", "--size", "2"]
    code = (
        "import resource, signal; from wavebatch.cli import main; signal.signal(signal.SIGXFSZ, signal.SIG_IGN); "
        f"resource.setrlimit(resource.RLIMIT_FSIZE, ({most},) * 2); main()"
    )
    arguments = [sys.executable, "-c", code, command, tiny_strip, *more]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=300)
    assert done.returncode == (4 if command == "run" else 1) and done.stderr.count("\n") == 1, done.stderr
    assert "File too large; free space or choose another output folder" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_the_next_draft_in_a_folder_removes_what_killed_processes_left(tmp_path):
    """Of any command, not only of run; files that are locked stay."""
    left = tmp_path / ".wavebatch-1-abc.tmp"
    left.write_text("half")
    with Draft(tmp_path / "a", overwrite=False) as first:
        assert not left.exists() and first.path.exists()
        with Draft(tmp_path / "b", overwrite=False):
            assert first.path.exists()


def write_arrays(target, parts, **options):
    with NpzWriter(target, {"place": np.dtype(("<i4", (3,))), "value": "<f4"}, **options) as writer:
        for place, value in parts:
            writer.add({"place": place, "value": value})
        writer.publish({"size": 0.5, "text": "päper"})


def test_numpy_reads_what_was_added(tmp_path, rng):
    parts = [(rng.integers(-9, 9, (n, 3)), rng.normal(size=n)) for n in (4, 0, 300)]
    for name in ("a.npz", "b.npz"):
        write_arrays(tmp_path / name, parts)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with np.load(tmp_path / "a.npz") as file:
        assert np.array_equal(file["place"], np.concatenate([place for place, _ in parts]))
        assert np.array_equal(file["value"], np.concatenate([value for _, value in parts]).astype("f4"))
        assert file["place"].dtype == "<i4" and file["size"] == 0.5 and str(file["text"]) == "päper"
    write_arrays(tmp_path / "c.npz", [])
    with np.load(tmp_path / "c.npz") as file:
        assert file["place"].shape == (0, 3) and file["value"].shape == (0,)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npz", "b.npz", "c.npz"]


def test_nothing_is_left_of_what_fails(tmp_path):
    refuses(InputError, "make the folder first", NpzWriter, tmp_path / "gone" / "a.npz", {"value": "f4"})
    (tmp_path / "a.npz").write_text("old")
    refuses(InputError, "exists already", NpzWriter, tmp_path / "a.npz", {"value": "f4"})
    writer = NpzWriter(tmp_path / "b.npz", {"value": "f4"})
    writer.add({"value": np.zeros(3)})
    writer.close()
    writer.close()
    assert [path.name for path in tmp_path.iterdir()] == ["a.npz"]
    write_arrays(tmp_path / "a.npz", [], overwrite=True)
    assert (tmp_path / "a.npz").read_bytes()[:2] == b"PK"


@pytest.fixture
def places(tmp_path):
    for name in ("b.las", "a.LAZ", "a.wdp", "note.txt", ".hidden.las", "sub/c.laz"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_bytes(b"")
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "found"),
    [
        ([""], ["a.LAZ", "b.las"]),
        (["*"], ["a.LAZ", "b.las"]),
        (["**/*"], ["a.LAZ", "b.las", "c.laz"]),
        (["@strips.txt"], ["b.las", "c.laz", "a.LAZ"]),
        (["b.las", "", "sub/../b.las"], ["b.las", "a.LAZ"]),  # a strip counts once
        (["x[1].las"], ["x[1].las"]),
        (["none.las", "b.las"], ["none.las", "b.las"]),  # what is missing fails later and alone
    ],
)
def test_folders_patterns_lists_and_names_mean_strips(places, arguments, found):
    """Files of a folder by name; those of a list, which is relative to itself, in its order."""
    (places / "strips.txt").write_text("# night of the 21st\n\nb.las\nsub\n*.LAZ\n")
    if "x[1].las" in arguments:
        (places / "x[1].las").write_bytes(b"")
    given = [f"{'@' * one.startswith('@')}{places}/{one.removeprefix('@')}" for one in arguments]
    assert [path.name for path in find_strips(given)] == found


@pytest.mark.parametrize("name", ["@-", "@/dev/stdin"])
def test_a_list_from_a_pipe_is_relative_to_where_the_command_runs(places, name):
    """`find ... | wavebatch run @-`; names were looked for in /dev."""
    command = [sys.executable, "-m", "wavebatch", "check", name]
    done = subprocess.run(command, cwd=places, input="b.las\nsub\n", capture_output=True, text=True)
    assert [line.split(":")[0] for line in done.stdout.splitlines()] == ["b.las", "sub/c.laz"]


def test_a_link_to_a_strip_that_was_given_is_named(places):
    (places / "link.las").symlink_to(places / "b.las")
    lines = []
    assert find_strips([str(places / "b.las"), str(places / "link.las")], note=lines.append) == [places / "b.las"]
    assert lines == [f"{places / 'link.las'}: is the same file as {places / 'b.las'}; it is used once"]
    find_strips([str(places / "b.las"), str(places / "sub" / ".." / "b.las")], note=lines.append)
    assert len(lines) == 1
    done = run_command("run", places / "b.las", places / "link.las", "-o", places / "o")
    assert lines[0] in done.stderr


def test_a_folder_loses_no_file_without_a_word(places, monkeypatch):
    """A link to a disk that is not there, and a subfolder that may not be read: both were passed over, exit code 0."""
    (places / "far.las").symlink_to(places / "mnt" / "far.las")
    (places / "away.las").symlink_to(places / "away.las")
    assert [path.name for path in find_strips([str(places)])] == ["a.LAZ", "away.las", "b.las", "far.las"]
    done = run_command("check", places)
    assert done.exit_code == 1 and "far.las: cannot be read: No such file" in done.stdout
    walk = os.walk

    def refuse(folder, onerror):
        yield next(walk(folder))
        onerror(PermissionError(13, "Permission denied", str(places / "sub")))

    monkeypatch.setattr(os, "walk", refuse)
    found = find_files([str(places)], recursive=True)
    assert found[0] == places / "sub" and [path.name for path in found[1:]] == ["a.LAZ", "away.las", "b.las", "far.las"]
    lines = []
    assert find_files([str(places)], recursive=True, note=lines.append) == found[1:]
    said = f"{places}: 1 of its subfolders cannot be read, and their files are left out: {places / 'sub'}"
    assert lines == [f"warning: {said}"]
    done = run_command("check", "--recursive", "--quiet", places)
    assert said in done.stderr and f"{places / 'sub'}: " not in done.stdout
    for path in found[1:]:
        path.unlink()
    assert find_files([str(places)], recursive=True, note=lines.append) == found[:1] and len(lines) == 1


def test_files_of_one_name_may_be_read_together_but_not_written_into_one_folder(places):
    (places / "sub" / "b.laz").write_bytes(b"")
    arguments = [str(places), str(places / "sub")]
    assert [path.name for path in find_files(arguments)] == ["a.LAZ", "b.las", "b.laz", "c.laz"]
    refuses(ConfigError, "both outputs would be named b", find_strips, arguments)


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
def test_what_means_nothing_is_refused_in_one_line(places, monkeypatch, arguments, words):
    monkeypatch.chdir(places)
    (places / "empty").mkdir()
    (places / "sub" / "b.laz").write_bytes(b"")
    (places / "loop.txt").write_text("@loop.txt\n")
    (places / "blank.txt").write_text("# nothing\n")
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
