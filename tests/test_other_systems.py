"""What wavebatch does without the parts of POSIX that Windows lacks: no fcntl, no fork, no fsync of folders, ..."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from commands import succeed

ROOT = Path(__file__).resolve().parent.parent

# Python's own modules still use some of them, to start a process on this machine.
WITHOUT = '''
import os, signal, sys

class _Missing:
    """No module of these names, as on Windows."""
    def find_spec(self, name, path=None, target=None):
        if name in ("fcntl", "resource", "termios", "grp", "syslog"):
            raise ImportError(f"{name}: not on this system")

def _refuse(name, real):
    def refuse(*words, **more):
        user = sys._getframe(1).f_globals.get("__name__", "")
        if user.startswith("wavebatch"):
            raise AttributeError(f"{user} uses os.{name}")
        return real(*words, **more)
    return refuse

sys.meta_path.insert(0, _Missing())
for name in ("fork", "kill", "killpg", "getuid", "geteuid", "setsid", "waitpid", "uname"):
    setattr(os, name, _refuse(name, getattr(os, name)))
for name in ("pread", "preadv", "pwrite", "readv", "writev", "statvfs", "sysconf", "getloadavg", "mkfifo",
             "fchmod", "fchown", "set_blocking", "sched_getaffinity", "posix_fadvise", "memfd_create", "lchown"):
    if hasattr(os, name):
        delattr(os, name)
real_open = os.open
def open_file(path, *words, **more):
    if os.path.isdir(path):
        raise PermissionError(13, "Permission denied", str(path))
    return real_open(path, *words, **more)
os.open = open_file
for name in ("O_NOFOLLOW", "O_CLOEXEC", "O_NONBLOCK", "O_DIRECTORY"):
    delattr(os, name)
for name in ("SIGHUP", "SIGCONT", "SIGALRM", "SIGUSR1", "pthread_sigmask", "sigwait", "setitimer"):
    delattr(signal, name)
'''


@pytest.fixture(scope="module")
def elsewhere(tmp_path_factory) -> dict[str, str]:
    """The environment of a process on a system like Windows, and of all processes that it starts."""
    folder = tmp_path_factory.mktemp("elsewhere")
    (folder / "sitecustomize.py").write_text(WITHOUT)
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), str(ROOT)])}


def _wavebatch(environment, *words, **more) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "wavebatch", *map(str, words)]
    return subprocess.run(command, env=environment, capture_output=True, **more)


@pytest.fixture(scope="module")
def cloud(tiny_strip, tmp_path_factory) -> bytes:
    """The cloud of an undisturbed run."""
    folder = tmp_path_factory.mktemp("here")
    succeed("run", tiny_strip, "-o", folder, "-q")
    return (folder / "tiny.laz").read_bytes()


def test_the_parts_are_hidden(elsewhere):
    code = "import os, signal; print(hasattr(signal, 'SIGHUP'), hasattr(os, 'O_CLOEXEC')); import fcntl"
    done = subprocess.run([sys.executable, "-c", code], env=elsewhere, capture_output=True, text=True)
    assert done.stdout.split() == ["False", "False"] and "fcntl: not on this system" in done.stderr


@pytest.mark.quick_cases("2")
@pytest.mark.parametrize("jobs", [1, 2])
def test_a_run_without_posix_gives_the_same_cloud(elsewhere, tiny_strip, cloud, tmp_path, jobs):
    command = ["run", tiny_strip, "-o", tmp_path, "--jobs", jobs, "-q", "--block-size", 100]
    done = _wavebatch(elsewhere, *command)
    assert done.returncode == 0 and not done.stderr, done.stderr
    assert (tmp_path / "tiny.laz").read_bytes() == cloud
    assert not [path for path in tmp_path.iterdir() if path.name.startswith(".")]
    if jobs == 1:
        assert _wavebatch(elsewhere, *command).returncode == 4  # the cloud is there
    assert _wavebatch(elsewhere, *command, "--resume").returncode == 0


@pytest.mark.slow
def test_lists_of_windows_and_a_console_of_an_old_code_page(elsewhere, tiny_strip, tmp_path):
    strip = tmp_path / "Überflug 1.las"
    strip.write_bytes(tiny_strip.read_bytes())
    (tmp_path / "list.txt").write_bytes("\ufeff# strips\r\n\r\n\u00dcberflug 1.las\r\n".encode())
    for page in ("cp437", "cp1252", "ascii"):
        environment = {**elsewhere, "PYTHONIOENCODING": page, "PYTHONUTF8": "0"}
        done = _wavebatch(environment, "info", f"@{tmp_path / 'list.txt'}")
        assert done.returncode == 0, done.stderr
        assert b"berflug 1.las" in done.stdout and b"Traceback" not in done.stderr
        done = _wavebatch(environment, "info", "--json", strip)
        assert "Überflug" in str(json.loads(done.stdout.decode("utf-8" if page == "ascii" else page)).values())
        done = _wavebatch(environment, "info", tmp_path / "fehlt ü.las")
        assert done.returncode == 1 and len(done.stderr.splitlines()) == 1 and b"Traceback" not in done.stderr


@pytest.mark.slow
def test_names_with_drive_letters_are_names_of_files(elsewhere, tiny_strip, tmp_path):
    """A colon is no separator anywhere: `C:\\data\\a.las` reaches the system whole."""
    (tmp_path / "C:").mkdir()
    strip = tmp_path / "C:" / "a.las"
    strip.write_bytes(tiny_strip.read_bytes())
    (tmp_path / "list.txt").write_bytes(b"C:/a.las\r\n")
    done = _wavebatch(elsewhere, "run", "@list.txt", "-o", "C:/out", "--report", "C:/all.json", "-q", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "C:" / "out" / "a.laz").exists() and (tmp_path / "C:" / "all.json").exists()
    done = _wavebatch(elsewhere, "run", "C:\\none\\b.las", "-o", "C:/out", "-q", cwd=tmp_path)
    assert done.returncode == 4 and b"C:\\none\\b.las" in done.stderr and len(done.stderr.splitlines()) == 1
