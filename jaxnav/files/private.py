"""Folders that only this user or root can write to, so that code stored there may be run.

    folder = private_folder(path, make=True)
    write_private(folder / "one.step", raw)
    raw = read_private(folder / "one.step")

A user who may write to any part of a path, or rename it, decides what is found at its end. So every
part is checked, from the root on: what is ours or root's, in a folder where nobody else may write
or rename it, stays what it was when it was looked at.
"""

import os
import stat
from contextlib import suppress
from pathlib import Path

from jaxnav.files.writing import temporary_file

_ROOT = 0  # may do anything anyway
_OTHERS_WRITE = stat.S_IWGRP | stat.S_IWOTH
_OTHERS_ENTER = stat.S_IXGRP | stat.S_IXOTH
_MAX_BYTES = 2**28  # executables have some MB
_MAX_LINKS = 8  # in the root folder, each leading to the next; more are a circle


class NotPrivateError(Exception):
    """Other users could write to a path. The message is one line: which part of it, and why."""


def private_folder(path: Path, make: bool = False) -> Path:
    """The absolute path of a folder, from which only files of this user or root are read.

    Every part of its path is this user's or root's, and no other user may write to it. All may
    write to parts before the last where each name in them is its owner's alone, as in /tmp.

    Args:
        path: a link in the root folder, as /tmp is one on some machines, is followed; no other is.
        make: whether to make missing parts, for this user alone.

    Raises:
        NotPrivateError: a part is another user's, others may write to it, or it is a link.
        OSError: a part is missing, or can't be made.
    """
    path = Path(os.path.normpath(path.absolute()))
    for _ in range(_MAX_LINKS):  # in the root folder, where only root can make them
        first = Path(*path.parts[:2])
        if not first.is_symlink():
            break
        path = Path(os.path.normpath(Path(path.anchor, first.readlink(), *path.parts[2:])))
    for part in (*reversed(path.parents), path):
        if make and not part.exists():
            with suppress(FileExistsError):  # of a faster process: it is checked as well
                part.mkdir(0o700)
        status = part.lstat()
        # In such a folder no other user can rename or replace what is ours.
        names_are_their_owners = status.st_mode & stat.S_ISVTX and part != path
        _require_own(part, status, 0 if names_are_their_owners else _OTHERS_WRITE)
    if not path.is_dir():
        raise NotADirectoryError(f"{path} is no folder")
    return path


def read_private(path: Path) -> bytes:
    """Read a whole file of a `private_folder`, and mark it as used now.

    Raises:
        NotPrivateError: it is another user's or a link, or others may write to it.
        OSError: it is missing, too large, or can't be read.
    """
    status = path.lstat()
    _require_own(path, status, _OTHERS_WRITE)
    if not stat.S_ISREG(status.st_mode) or status.st_size > _MAX_BYTES:
        raise OSError(f"{path} is no file of at most {_MAX_BYTES} bytes")
    os.utime(path)
    return path.read_bytes()


def write_private(path: Path, raw: bytes) -> None:
    """Write a whole file, for this user alone, in place of an older one; or nothing.

    It is not forced to the disk, as all files of a `private_folder` can be made anew.

    Raises:
        OSError: the file can't be written.
    """
    beside = temporary_file(path, 0o600)
    try:
        beside.write_bytes(raw)
        beside.replace(path)
    finally:
        beside.unlink(missing_ok=True)


def require_own_entries(folder: Path) -> None:
    """Check all of a `private_folder` for a reader that opens files by their paths, unchecked.

    Raises:
        NotPrivateError: an entry is another user's, a link, or others may write to it.
    """
    # Where others can't enter the folder, their permission to write to a file has no effect.
    may_enter = folder.lstat().st_mode & _OTHERS_ENTER
    for entry in folder.iterdir():
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
