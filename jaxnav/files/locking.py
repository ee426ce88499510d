"""File locks of processes at work, which the kernel releases however their process ends."""

import fcntl
import os
import secrets
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from jaxnav.errors import BadInput

_NEW = os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW | os.O_CLOEXEC
_OLD = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


@contextmanager
def naming_written(path: str | Path) -> Iterator[None]:
    """Turn the system's errors about a file that is written into `BadInput`."""
    try:
        yield
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadInput(path, f"can't be written: {reason}") from None


@contextmanager
def sole_writer(path: str | Path) -> Iterator[None]:
    """Keep all other processes out of such a block for the same path while this one runs.

    The lock is a file beside it, `.NAME.lock`. Where the disk knows no locks there is none.

    Raises:
        BadInput: another process is in such a block, or the folder is missing or closed to writing.
    """
    path = Path(os.path.realpath(path))
    beside = path.with_name(f".{path.name}.lock")
    with naming_written(path):
        fd = _locked(beside)
    if fd is None:
        raise BadInput(path, "is being written by another process")
    try:
        yield
    finally:
        # While it is still locked: a process that opened it then finds that it is gone.
        beside.unlink(missing_ok=True)
        os.close(fd)


def create_temporary(
    name_of: Callable[[str], str], mode: int, dir_fd: int | None = None
) -> tuple[str, int]:
    """Create a file that is locked while open, so that `sweep` keeps it until its process ends.

    Args:
        name_of: makes its name from some unique characters.
        mode: its permissions, less those that the umask takes.
        dir_fd: the folder of the name, by default the process's own.

    Returns:
        Its name and its descriptor, for writing.

    Raises:
        OSError: it can't be made.
    """
    while True:
        name = name_of(secrets.token_hex(4))
        fd = os.open(name, _NEW, mode, dir_fd=dir_fd)
        # Another process may have swept it away before it was locked.
        if _lock(fd) is not False and os.fstat(fd).st_nlink:
            return name, fd
        os.close(fd)


def sweep(names: Iterable[str], dir_fd: int | None = None) -> None:
    """Remove the files of `create_temporary` whose processes have ended."""
    for name in names:
        with suppress(OSError):
            fd = os.open(name, _OLD, dir_fd=dir_fd)
            try:
                if _lock(fd):
                    os.unlink(name, dir_fd=dir_fd)
            finally:
                os.close(fd)


def _locked(path: Path) -> int | None:
    """A descriptor of the file, locked by this process; None where another one has locked it."""
    while True:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
        if _lock(fd) is False:
            os.close(fd)
            return None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(fd), path.stat(follow_symlinks=False)):
                return fd
        # Between opening and locking, the process that had it has removed it.
        os.close(fd)


def _lock(fd: int) -> bool | None:
    """Whether this process now has the lock; None where the disk knows no locks."""
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    except OSError:
        return None
    return True
