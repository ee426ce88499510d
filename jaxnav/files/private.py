"""Folders that only this user or root can write to, so that code stored there may be run.

    with PrivateFolder(path, make=True) as folder:
        folder.write("one.step", raw)
        raw = folder.read("one.step")

A user who may write to any part of a path, or rename it, decides what is found at its end. So every
part is checked, from the root on: what is ours or root's, in a folder where nobody else may write
or rename it, stays what it was when it was looked at.
"""

import os
import stat
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from types import TracebackType

from jaxnav.files.writing import temporary_file

_ROOT = 0  # may do anything anyway
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_OTHERS_ENTER = stat.S_IXGRP | stat.S_IXOTH
_MAX_BYTES = 2**28  # executables have some MB
_MAX_LINKS = 8  # in the root folder, each leading to the next; more are a circle


class NotPrivateError(Exception):
    """Other users could write to a path. The message is one line: which part of it, and why."""


class PrivateFolder(AbstractContextManager["PrivateFolder"]):
    """A folder from which only files of this user or root are read.

    Every part of its path is this user's or root's, and no other user may write to it. All may
    write to parts before the last where each name in them is its owner's alone, as in /tmp.

    Args:
        path: a link in the root folder, as /tmp is one on some machines, is followed; no other is.
        make: whether to make missing parts, for this user alone.

    Raises:
        NotPrivateError: a part is another user's, others may write to it, or it is a link.
        OSError: a part is missing, or can't be made.
    """

    def __init__(self, path: Path, make: bool = False):
        self.path = _without_links_of_the_root(path)
        for part in (*reversed(self.path.parents), self.path):
            if make and not part.exists():
                with suppress(FileExistsError):  # of a faster process: it is checked as well
                    part.mkdir(0o700)
            status = part.lstat()
            # In such a folder no other user can rename or replace what is ours.
            names_are_their_owners = status.st_mode & stat.S_ISVTX and part != self.path
            _require_own(part, status, 0 if names_are_their_owners else _OTHERS_WRITE)
        if not self.path.is_dir():
            raise NotADirectoryError(f"{self.path} is no folder")

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Nothing is held open."""

    def read(self, name: str) -> bytes:
        """Read a whole file, and mark it as used now.

        Raises:
            NotPrivateError: it is another user's or a link, or others may write to it.
            OSError: it is missing, too large, or can't be read.
        """
        path = self.path / name
        status = path.lstat()
        _require_own(path, status, _OTHERS_WRITE)
        if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_BYTES:
            raise OSError(f"{path} is no file of at most {_MAX_BYTES} bytes")
        os.utime(path)
        return path.read_bytes()

    def write(self, name: str, raw: bytes) -> None:
        """Write a whole file, for this user alone, in place of an older one; or nothing.

        It is not forced to the disk, as all files here can be made anew.

        Raises:
            OSError: the file can't be written.
        """
        beside = temporary_file(self.path / name, 0o600)
        try:
            beside.write_bytes(raw)
            beside.replace(self.path / name)
        finally:
            beside.unlink(missing_ok=True)

    def holds(self, name: str) -> bool:
        """Whether there is a file of that name."""
        with suppress(OSError):
            return stat.S_ISREG((self.path / name).lstat().st_mode)
        return False

    def names_by_use(self) -> list[str]:
        """The names of all entries, the one used longest ago first."""
        used = []
        for entry in self.path.iterdir():
            with suppress(FileNotFoundError):
                used.append((entry.lstat().st_mtime_ns, entry.name))
        return [name for _, name in sorted(used)]

    def remove(self, name: str) -> None:
        """Remove a file if it is still there."""
        (self.path / name).unlink(missing_ok=True)

    def require_own_entries(self) -> None:
        """Check all entries for a reader that opens them by their paths without checks.

        Raises:
            NotPrivateError: an entry is another user's, a link, or others may write to it.
        """
        # Where others can't enter the folder, their permission to write to a file has no effect.
        may_enter = self.path.lstat().st_mode & _OTHERS_ENTER
        for entry in self.path.iterdir():
            with suppress(FileNotFoundError):
                _require_own(entry, entry.lstat(), _OTHERS_WRITE if may_enter else 0)


def _require_own(path: Path, status: os.stat_result, forbidden: int) -> None:
    if not hasattr(os, "geteuid"):
        raise NotPrivateError("this system does not say whose a file is")
    if stat.S_ISLNK(status.st_mode):
        raise NotPrivateError(f"{path} is a link")
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
