"""Folders that only this user or root can write to, so that code stored there may be run.

    with PrivateFolder(path, make=True) as folder:
        folder.write("one.step", raw)
        raw = folder.read("one.step")

A user who may write to any part of a path, or rename it, decides what is found at its end. So every
part is opened inside the one before it, never through a link, and the checks look at what was
opened, not at what its name may lead to a moment later.
"""

import os
import stat
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from jaxnav.files.locking import create_temporary, sweep

_ROOT = 0  # may do anything anyway
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_OTHERS_ENTER = stat.S_IXGRP | stat.S_IXOTH
# O_PATH needs no permission to list a folder, which /home may not give.
_PASSED = os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC | getattr(os, "O_PATH", os.O_RDONLY)
_LISTED = os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC | os.O_RDONLY
_FILE = os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC
_TEMPORARY = ".part-"  # prefix of a file's name while it is written
_MAX_BYTES = 2**28  # executables have some MB
_MAX_LINKS = 8  # in the root folder, each leading to the next; more are a circle


class NotPrivateError(Exception):
    """Other users could write to a path. The message is one line: which part of it, and why."""


class PrivateFolder:
    """A folder, held open, from which only files of this user or root are read.

    Every part of its path is this user's or root's, and no other user may write to it. All may
    write to parts before the last where each name in them is its owner's alone, as in /tmp.

    Args:
        path: a link in the root folder, as /tmp is one on some machines, is followed; no other is.
        make: whether to make missing parts, for this user alone.

    Raises:
        NotPrivateError: a part is another user's, others may write to it, or it is a link.
        OSError: a part is missing, or can't be made or opened.
    """

    def __init__(self, path: Path, make: bool = False):
        self.path = _without_links_of_the_root(path)
        self._fd = _opened(self.path, make)

    def __enter__(self) -> "PrivateFolder":
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        os.close(self._fd)

    def read(self, name: str) -> bytes:
        """Read a whole file, and mark it as used now.

        Raises:
            NotPrivateError: it is another user's, or others may write to it.
            OSError: it is missing, a link, too large, or can't be read.
        """
        fd = os.open(name, _FILE, dir_fd=self._fd)
        with os.fdopen(fd, "rb") as file:
            status = os.fstat(fd)
            _require_own(self.path / name, status, _OTHERS_WRITE)
            if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_BYTES:
                raise OSError(f"{self.path / name} is no file of at most {_MAX_BYTES} bytes")
            raw = file.read(_MAX_BYTES)
            os.utime(fd)
        return raw

    def write(self, name: str, raw: bytes) -> None:
        """Write a whole file, for this user alone, in place of an older one; or nothing.

        It is not forced to the disk, as all files here can be made anew. Parts of files that
        killed processes have left are swept away.

        Raises:
            OSError: the file can't be written.
        """
        sweep([n for n in self._names() if n.startswith(_TEMPORARY)], dir_fd=self._fd)
        beside, fd = create_temporary(lambda word: _TEMPORARY + word, 0o600, dir_fd=self._fd)
        try:
            with os.fdopen(fd, "wb") as file:
                file.write(raw)
                file.flush()
                os.rename(beside, name, src_dir_fd=self._fd, dst_dir_fd=self._fd)
        except BaseException:
            self.remove(beside)
            raise

    def holds(self, name: str) -> bool:
        """Whether there is a file of that name."""
        try:
            return stat.S_ISREG(self._status(name).st_mode)
        except OSError:
            return False

    def names_by_use(self) -> list[str]:
        """The names of all entries, the one used longest ago first."""
        entries = []
        for name in self._names():
            with suppress(FileNotFoundError):
                entries.append((self._status(name).st_mtime_ns, name))
        return [name for _, name in sorted(entries)]

    def remove(self, name: str) -> None:
        """Remove a file if it is still there."""
        with suppress(FileNotFoundError):
            os.unlink(name, dir_fd=self._fd)

    def require_own_entries(self) -> None:
        """Check all entries for a reader that opens them by their paths without checks.

        Raises:
            NotPrivateError: an entry is another user's, a link, or others may write to it.
        """
        # Where others can't enter the folder, their permission to write to a file has no effect.
        may_enter = os.fstat(self._fd).st_mode & _OTHERS_ENTER
        for name in self._names():
            with suppress(FileNotFoundError):
                status = self._status(name)
                if stat.S_ISLNK(status.st_mode):
                    raise NotPrivateError(f"{self.path / name} is a link")
                _require_own(self.path / name, status, _OTHERS_WRITE if may_enter else 0)

    def _names(self) -> list[str]:
        with os.scandir(self._fd) as entries:
            return [entry.name for entry in entries]

    def _status(self, name: str) -> os.stat_result:
        return os.stat(name, dir_fd=self._fd, follow_symlinks=False)


def _opened(path: Path, make: bool) -> int:
    """A descriptor of the folder at the end of an absolute path."""
    parts = path.parts
    so_far = Path(parts[0])
    fd = os.open(so_far, _PASSED)
    try:
        _require_own(so_far, os.fstat(fd), _OTHERS_WRITE)
        for number, name in enumerate(parts[1:], 2):
            so_far /= name
            is_last = number == len(parts)
            inner = _opened_in(fd, name, so_far, _LISTED if is_last else _PASSED, make)
            os.close(fd)
            fd = inner
            status = os.fstat(fd)
            # In such a folder no other user can rename or replace what is ours.
            names_are_their_owners = bool(status.st_mode & stat.S_ISVTX) and not is_last
            _require_own(so_far, status, 0 if names_are_their_owners else _OTHERS_WRITE)
    except BaseException:
        os.close(fd)
        raise
    return fd


def _opened_in(fd: int, name: str, path: Path, flags: int, make: bool) -> int:
    try:
        return os.open(name, flags, dir_fd=fd)
    except FileNotFoundError:
        if not make:
            raise
        with suppress(FileExistsError):  # another process was faster; its folder is checked too
            os.mkdir(name, 0o700, dir_fd=fd)
        return _opened_in(fd, name, path, flags, make=False)
    except OSError:
        if stat.S_ISLNK(os.stat(name, dir_fd=fd, follow_symlinks=False).st_mode):
            raise NotPrivateError(f"{path} is a link") from None
        raise


def _require_own(path: Path, status: os.stat_result, forbidden: int) -> None:
    if status.st_uid not in (_ROOT, os.geteuid()):
        raise NotPrivateError(f"{path} belongs to another user, number {status.st_uid}")
    if status.st_mode & forbidden:
        others = "all" if status.st_mode & stat.S_IWOTH else "its group"
        raise NotPrivateError(f"{path} can be written to by {others}: chmod go-w {path}")


def _without_links_of_the_root(path: Path) -> Path:
    """The absolute path, with links in the root folder, which only root can make, resolved."""
    path = Path(os.path.normpath(path.absolute()))
    for _ in range(_MAX_LINKS):
        first = Path(*path.parts[:2])
        if not first.is_symlink():
            break
        path = Path(os.path.normpath(Path(path.anchor, first.readlink(), *path.parts[2:])))
    return path
