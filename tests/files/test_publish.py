"""Files appear whole or not at all, never over another one, and leave nothing behind."""

import errno
import multiprocessing
import os
import signal
import subprocess
import sys

import pytest

from wavebatch.core.errors import InputError
from wavebatch.files.disk import publish
from wavebatch.files.disk.publish import Draft, is_stream, publish_together, refuse_existing, remove_stale
from wavebatch.files.text_file import write_text


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
    with pytest.raises(InputError, match=r"a: exists already; .*--overwrite"):
        publish_together([draft])
    assert names(tmp_path) == ["a"] and target.read_bytes() == b"old"
    with pytest.raises(InputError, match="exists already"):
        refuse_existing(target)


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
        with pytest.raises(InputError, match="is a device or a pipe, .*; choose another name"):
            Draft(target, overwrite=True)
    with pytest.raises(InputError, match="pipe: is a device or a pipe"):
        refuse_existing(pipe)
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
    with pytest.raises(InputError, match="exists already"):
        refuse_existing(tmp_path / "a")
    with pytest.raises(InputError, match="exists already"):
        publish_together([write(tmp_path / "a", b"new")])
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
    with pytest.raises(InputError, match="a.las: exists already"):
        publish_together([first, second])
    assert names(tmp_path) == ["a.las"] and (tmp_path / "a.las").read_bytes() == b"other"


@pytest.mark.parametrize("number", [errno.EPERM, errno.EOPNOTSUPP])
def test_file_systems_without_links_still_never_replace(tmp_path, monkeypatch, number):
    def refuse(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(publish.os, "link", refuse)
    write(tmp_path / "a", b"one").publish()
    assert (tmp_path / "a").read_bytes() == b"one"
    with pytest.raises(InputError, match="exists already"):
        publish_together([write(tmp_path / "a", b"two")])
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


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
def test_a_folder_without_permission_is_one_line(tmp_path):
    tmp_path.chmod(0o500)
    with pytest.raises(InputError, match="check the folder's permissions"):
        Draft(tmp_path / "a", overwrite=False)


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
