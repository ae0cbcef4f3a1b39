"""Output files that appear whole or not at all, and never in place of an input of the same call.

All outputs of wavebatch are written through `Draft`: under a temporary name in the same folder, then renamed. A killed
run leaves only temporary files, which the next run removes; a lock shows which of them are still in use (`temp_store`
locks its folders too). Nothing else shows whether a process of another run is still alive.

No output replaces a file that is read in the same call, whatever --overwrite says. `protecting` begins a call: the
command line does it for every command, `run_batch` and the other functions that write do it for programs. `Draft` looks
at the rule, so every output obeys it; `refuse_input` checks before long work.
"""

from __future__ import annotations

import atexit
import contextlib
import errno
import filecmp
import hashlib
import os
import stat
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from io import BufferedRandom
from pathlib import Path
from typing import Any, BinaryIO, cast

from wavebatch.core.errors import ConfigError, InputError
from wavebatch.core.interrupts import uninterrupted
from wavebatch.files.disk.raw_bytes import in_one_line

_FORMAT_BYTE, _ENCODING_BYTE = 104, 6
_WAVEFORM_FORMATS, _WAVES_INTERNAL = (4, 5, 9, 10), 2


_inputs: ContextVar[set[object] | None] = ContextVar("wavebatch_inputs", default=None)
"""Files of the call by name and by number, so that links and hard links are found too."""


@contextlib.contextmanager
def protecting(paths: Iterable[Path | str | None] = ()) -> Iterator[None]:
    """A call that reads these files: no output inside may replace one of them; inside another call, it adds to that."""
    token = _inputs.set(set()) if _inputs.get() is None else None
    try:
        protect(paths)
        yield
    finally:
        if token is not None:
            _inputs.reset(token)


def protect(paths: Iterable[Path | str | None]) -> None:
    """Add files to the inputs of the call, with the packet files of strips; does nothing outside `protecting`."""
    inputs = _inputs.get()
    if inputs is not None:
        for path in [Path(path) for path in paths if path is not None]:
            for one in (path, *_packet_files(path)):
                inputs |= _identify(one)


def refuse_input(target: Path) -> None:
    """Raise ConfigError if the output would replace an input of the call, also through a link."""
    inputs = _inputs.get()
    if inputs is not None and inputs & _identify(Path(target)):
        raise ConfigError(f"{target}: the output would replace this input; choose another output")


def real_name(path: Path) -> str:
    """The file that a name leads to, links resolved."""
    try:
        return os.path.realpath(path)
    except (OSError, ValueError):  # no file can have this name
        return os.path.abspath(path)


def _identify(path: Path) -> set[object]:
    """The name of a file, links resolved, and its number, if it is there."""
    try:
        found = os.stat(path)
    except (OSError, ValueError):
        return {real_name(path)}
    return {real_name(path), (found.st_dev, found.st_ino)}


def _packet_files(path: Path) -> list[Path]:
    """The files in which the packets of a strip may be; none for other files and for strips that hold their packets."""
    if path.suffix.lower() not in (".las", ".laz") or not os.path.isfile(path):  # a pipe would block for ever
        return []
    try:
        with open(path, "rb") as file:
            head = file.read(_FORMAT_BYTE + 1)
    except (OSError, ValueError):
        return []
    if len(head) <= _FORMAT_BYTE or head[_FORMAT_BYTE] & 63 not in _WAVEFORM_FORMATS:
        return []
    if head[_ENCODING_BYTE] & _WAVES_INTERNAL:
        return []
    return list_packet_files(path)


def list_packet_files(path: Path, suffixes: Iterable[str] = (".wdp", ".WDP", ".wdz", ".WDZ")) -> list[Path]:
    """Where the packets of a strip may be: beside it, then beside the file to which it is a link."""
    places = dict.fromkeys((path, Path(real_name(path))))
    return [place.with_suffix(suffix) for place in places for suffix in suffixes]


fcntl: Any
try:
    import fcntl
except ImportError:  # Windows has no fcntl: what killed processes left then stays until the user removes it
    fcntl = None

LOCK_FLAGS = os.O_RDWR | getattr(os, "O_NOFOLLOW", 0) | getattr(os, "O_CLOEXEC", 0) | getattr(os, "O_BINARY", 0)


def make_locked(make: Callable[[], tuple[Path, int]]) -> tuple[Path, int]:
    """Return a new path and the descriptor of its lock file, locked.

    make: makes both; it is called again if `remove_unlocked` of another process took them before they were locked.
    """
    while True:
        path, descriptor = make()
        with contextlib.suppress(BlockingIOError):
            if hold(descriptor):
                return path, descriptor
        os.close(descriptor)


def hold(descriptor: int) -> bool:
    """Lock an open file; False if it was removed meanwhile. Raises BlockingIOError if another process has locked it."""
    try:
        if fcntl is not None:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.fstat(descriptor).st_nlink > 0
    except BlockingIOError:
        raise
    except OSError:  # a file system without locks
        return True


def remove_unlocked(
    paths: Iterable[Path], open_lock: Callable[[Path], int], remove: Callable[[Path], None]
) -> list[Path]:
    """Remove those of the paths that no process has locked, and return them.

    open_lock: returns the descriptor of a path's lock file; a path for which it raises OSError stays. On systems
    without file locks nothing is removed.
    """
    removed: list[Path] = []
    for path in sorted(paths) if fcntl is not None else ():
        with contextlib.suppress(OSError):
            descriptor = open_lock(path)
            try:
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
                if os.fstat(descriptor).st_nlink > 0:  # else another process took it, and the path has a new owner
                    remove(path)
                    removed.append(path)
            finally:
                os.close(descriptor)
    return removed


_PREFIX, _SUFFIX = ".wavebatch-", ".tmp"
_CLAIM_PATIENCE = 0.5
"""Seconds after which a lock is taken for that of another run."""
_NO_LINKS = {errno.EPERM, errno.ENOSYS, errno.ENOTSUP, errno.EOPNOTSUPP, errno.EMLINK, errno.EINVAL}


_REMEDIES: dict[int | None, str] = {
    **dict.fromkeys((errno.ENOSPC, errno.EDQUOT, errno.EFBIG), "free space or choose another output folder"),
    **dict.fromkeys((errno.EACCES, errno.EPERM, errno.EROFS), "check the folder's permissions"),
    errno.ENOENT: "make the folder first",
}


def reporting(target: Path) -> contextlib.AbstractContextManager[None]:
    """Turn an error of the operating system while `target` is written into one InputError line."""
    remedy = lambda error: _REMEDIES.get(error.errno, "choose another output folder")  # noqa: E731
    return in_one_line(lambda error, why: f"{target}: cannot be written: {why}; {remedy(error)}")


class Draft(contextlib.AbstractContextManager):
    """A file that is being written: `file` is open under a temporary name, also for reading, and locked.

    target: its final name. overwrite: whether publishing replaces an existing file.
    As a context manager it discards the file unless it was published.
    Raises InputError if the folder cannot be written, or the name is that of a device or a pipe, and ConfigError if the
    target is an input (see `protect`).
    """

    def __init__(self, target: Path, *, overwrite: bool) -> None:
        self.target = Path(target)
        self.overwrite = overwrite
        if is_stream(self.target):
            raise InputError(_refusal(self.target))
        check_target(self.target, overwrite=True)
        if self.target.parent not in _cleared:
            _cleared.add(self.target.parent)
            remove_stale(self.target.parent)
        with uninterrupted(), reporting(self.target):
            self.path, descriptor = make_locked(lambda: _create(self.target.parent))
            self.file = cast(BufferedRandom, os.fdopen(descriptor, "w+b", buffering=1 << 20))
            self.published = False
            _open.add(self)

    def __exit__(self, *error: object) -> None:
        self.discard()

    def publish(self, *, same_is_fine: bool = False) -> None:
        """Give the finished file its final name in one step; without overwrite an existing file is never replaced.

        same_is_fine: an existing file with the same bytes counts as published, because a killed run may have left it.
        """
        with uninterrupted(), reporting(self.target):
            self.file.flush()
            os.fsync(self.file.fileno())
            if fcntl is None:  # Windows cannot rename an open file
                self.file.close()
            try:
                if self.overwrite:
                    os.replace(self.path, self.target)
                else:
                    # Two processes may do it at once: the second name is given to one file only.
                    try:
                        os.link(self.path, self.target)
                    except OSError as error:
                        if error.errno not in _NO_LINKS:
                            raise
                        # No hard links here: only one process can create this empty file, so it reserves the name.
                        os.close(os.open(self.target, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
                        os.replace(self.path, self.target)
            except FileExistsError:
                if not (same_is_fine and filecmp.cmp(self.path, self.target, shallow=False)):
                    raise InputError(_refusal(self.target)) from None
            else:
                self.published = True
            # The new name survives a power cut; Windows cannot open folders, some file systems cannot sync them.
            with contextlib.suppress(OSError):
                descriptor = os.open(self.target.parent, os.O_RDONLY)
                try:
                    os.fsync(descriptor)
                finally:
                    os.close(descriptor)
        self.discard()

    def discard(self) -> None:
        """Close and remove the temporary file; does nothing if it is gone already."""
        with contextlib.suppress(OSError):
            self.file.close()
        with contextlib.suppress(OSError):
            os.unlink(self.path)
        _open.discard(self)


_cleared: set[Path] = set()
"""Folders from which this process has removed what killed ones had left."""

_open: set[Draft | Claim] = set()
"""What is neither published nor discarded."""


@atexit.register
def _discard_all() -> None:
    """At the end of the process: what an interrupt in the middle of cleaning up has left."""
    for draft in list(_open):
        draft.discard()


def is_stream(target: Path) -> bool:
    """Whether the name is that of a device, pipe or socket; root could replace it with a file by mistake."""
    folder = Path(os.path.realpath(Path(target).parent))
    if folder.as_posix() in ("/dev", "/dev/fd") or folder.is_relative_to("/proc"):  # links to files there too
        return True
    try:
        mode = os.lstat(target).st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(mode) or stat.S_ISLNK(mode) or stat.S_ISDIR(mode))


def open_stream(target: Path) -> BinaryIO:
    """Open a device or a pipe for writing; raises OSError for a pipe without a reader instead of waiting."""
    descriptor = os.open(target, os.O_WRONLY | getattr(os, "O_NONBLOCK", 0))
    if hasattr(os, "set_blocking"):
        os.set_blocking(descriptor, True)
    return os.fdopen(descriptor, "wb")


def check_target(target: Path, *, overwrite: bool) -> None:
    """Raise, before long work, what `publish` would raise after it: the target is an input, exists, or cannot exist."""
    refuse_input(target)
    with reporting(target), contextlib.suppress(FileNotFoundError):
        os.lstat(target)
    refuse_existing(target, overwrite)


def refuse_existing(target: Path, overwrite: bool = False) -> None:
    """Raise InputError if something of that name exists, without `overwrite`; publishing checks again."""
    if not overwrite and os.path.lexists(target):
        raise InputError(_refusal(target))


def publish_together(drafts: Sequence[Draft]) -> None:
    """Publish drafts in order; if the last one exists, all are complete.

    On an error the earlier ones are removed again, except those that replaced an older file: the error then names them.
    """
    done: list[Draft] = []
    with uninterrupted():
        try:
            for draft in drafts:
                draft.publish(same_is_fine=draft is not drafts[-1])
                done.append(draft)
        except BaseException as error:
            for draft in done:
                if draft.published and not draft.overwrite:
                    with contextlib.suppress(OSError):
                        os.unlink(draft.target)
            for draft in drafts:
                draft.discard()
            kept = ", ".join(str(draft.target) for draft in done if draft.published and draft.overwrite)
            if kept and isinstance(error, InputError):
                raise InputError(f"{error}; {kept}: replaced before that, and complete") from error
            raise


class Claim:
    """The right to make the outputs of a name in a folder: a second run there would mix its outputs with this one's.

    Raises InputError while another process has it. Without file locks, everyone gets it.
    """

    def __init__(self, folder: Path, name: str) -> None:
        self._descriptor: int | None = None
        if fcntl is None:
            return
        digest = hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
        self._path = folder / f"{_PREFIX}lock-{digest}{_SUFFIX}"
        deadline = time.monotonic() + _CLAIM_PATIENCE
        with uninterrupted(), reporting(folder):
            while self._descriptor is None:
                try:
                    # None if the file was removed meanwhile.
                    descriptor, held = os.open(self._path, LOCK_FLAGS | os.O_CREAT, 0o666), False
                    try:
                        held = hold(descriptor)
                    finally:
                        if not held:
                            os.close(descriptor)
                    self._descriptor = descriptor if held else None
                except BlockingIOError:  # `remove_stale` may hold it for an instant
                    if time.monotonic() > deadline:
                        what = "another run makes this output now; wait for that run, or choose another folder"
                        raise InputError(f"{folder / name}: {what}") from None
                    time.sleep(_CLAIM_PATIENCE / 10)
            _open.add(self)

    def discard(self) -> None:
        """Give it back; may be called twice."""
        if self._descriptor is not None:
            with contextlib.suppress(OSError):
                os.unlink(self._path)
            os.close(self._descriptor)
            self._descriptor = None
        _open.discard(self)


def list_names(folder: Path, begins: tuple[str, ...], end: str = "") -> list[Path]:
    """What a folder holds whose name begins with one of these and ends so; a glob compiles a pattern for each.

    Nothing where the folder cannot be read.
    """
    try:
        names = os.listdir(folder)
    except OSError:
        return []
    return [folder / name for name in names if name.startswith(begins) and name.endswith(end)]


def remove_stale(folder: Path) -> list[Path]:
    """Remove the temporary files of ended processes from `folder` and return their names.

    A locked file is still being written and stays. On systems without file locks nothing is removed.
    """
    found = list_names(folder, (_PREFIX,), _SUFFIX)
    return remove_unlocked(found, lambda path: os.open(path, LOCK_FLAGS), os.unlink)


def _create(folder: Path) -> tuple[Path, int]:
    """A new file, open for reading and writing."""
    path = folder / f"{_PREFIX}{os.getpid()}-{os.urandom(6).hex()}{_SUFFIX}"
    return path, os.open(path, LOCK_FLAGS | os.O_CREAT | os.O_EXCL, 0o666)


def _refusal(target: Path) -> str:
    """Why no file of this name, which there is, is written."""
    if is_stream(target):
        return f"{target}: is a device or a pipe, but this output must be a regular file; choose another name"
    return f"{target}: exists already; choose another output or replace it with --overwrite"
