"""Writing of files: written beside and then renamed, so that no reader ever sees half of one."""

import json
import math
import os
import secrets
import stat
import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from jaxtyping import Float

from jaxnav.errors import BadInput
from jaxnav.files.reading import naming

_WRITTEN = "can't be written"
_LEFT_S = 3600.0  # a temporary file of this age was left behind by a process that was killed


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A path beside `path`, with the same suffix, that becomes `path` when the block succeeds.

    When the block raises, nothing is left and an older file stays as it was; after a power cut
    there is the older file or the new one. Files that killed processes left here an hour ago and
    more are removed. An older file's permissions and owner stay; a link stays, and the file it
    leads to is written.

    Raises:
        BadInput: the folder is missing or closed to writing, or `path` is a folder, a device or
            write-protected.
    """
    with naming(path, _WRITTEN):
        target, older = _target(path)
        # While it is written, the file must not be open to more readers than the older one.
        beside = temporary_file(target, 0o600 if older else 0o666)
        try:
            yield beside
            fd = os.open(beside, os.O_RDWR | getattr(os, "O_NOFOLLOW", 0))
            try:
                if older is not None and os.name == "posix":
                    with suppress(PermissionError):  # only root gives files away
                        os.fchown(fd, older.st_uid, older.st_gid)
                    os.fchmod(fd, stat.S_IMODE(older.st_mode))
                os.fsync(fd)
            finally:
                os.close(fd)
            os.replace(beside, target)  # noqa: PTH105  (said in the docstring by this name)
            _sync_folder(target.parent)
        finally:
            beside.unlink(missing_ok=True)


def temporary_file(target: Path, mode: int) -> Path:
    """Make an empty file beside another one, with its suffix, and remove what was left there.

    Args:
        mode: its permissions, less those that the umask takes.

    Raises:
        OSError: it can't be made.
    """
    for left in target.parent.glob(f".jaxnav-{16 * '[0-9a-f]'}*"):
        with suppress(OSError):
            if left.is_file() and time.time() - left.lstat().st_mtime > _LEFT_S:
                left.unlink()
    beside = target.with_name(f".jaxnav-{secrets.token_hex(8)}{target.suffix}")
    os.close(os.open(beside, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode))
    return beside


def require_writable(path: str | Path) -> None:
    """Raise before the work the error that `atomic_path` would raise after it.

    Raises:
        BadInput: the file can't be written.
    """
    with naming(path, _WRITTEN):
        temporary_file(_target(path)[0], 0o600).unlink()


@contextmanager
def sole_writer(path: str | Path) -> Iterator[None]:
    """Keep all other processes out of such a block for the same path while this one runs.

    The lock is a file beside it, `.NAME.lock`, which the system unlocks however its process ends.
    Where the disk knows no locks there is none.

    Raises:
        BadInput: another process is in such a block, or the folder is missing or closed to writing.
    """
    path = Path(os.path.realpath(path))
    beside = path.with_name(f".{path.name}.lock")
    with naming(path, _WRITTEN):
        fd = _locked(beside)
    if fd is None:
        raise BadInput(path, "is being written by another process")
    try:
        yield
    finally:
        # While it is still locked: a process that opened it then finds that it is gone.
        with suppress(OSError):  # Windows removes no open file, and an empty one does no harm
            beside.unlink()
        os.close(fd)


def _locked(path: Path) -> int | None:
    """A descriptor of the file, locked by this process; None where another one has locked it."""
    from filelock import lock_descriptor

    while True:
        fd = os.open(path, os.O_RDWR | os.O_CREAT | getattr(os, "O_NOFOLLOW", 0), 0o600)
        try:
            is_locked = lock_descriptor(fd, blocking=False)
        except OSError:  # no locks on this disk
            return fd
        if not is_locked:
            os.close(fd)
            return None
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(fd), path.stat(follow_symlinks=False)):
                return fd
        # Between opening and locking, the process that had it has removed it.
        os.close(fd)


def atomic_write(path: str | Path, content: str | bytes) -> None:
    """Write a whole file, or nothing.

    Raises:
        BadInput: it can't be written.
    """
    with atomic_path(path) as beside:
        beside.write_bytes(content.encode() if isinstance(content, str) else content)


def atomic_write_all(contents: Mapping[Path, str]) -> None:
    """Write several files, or none of them.

    Raises:
        BadInput: one can't be written.
    """
    with ExitStack() as files:
        for path, text in contents.items():
            files.enter_context(atomic_path(path)).write_bytes(text.encode())


def refuse_overwriting(
    flag: str, outputs: Iterable[Path | None], inputs: Iterable[Path | None]
) -> None:
    """Refuse to write over files that are read.

    Two paths are the same file where the disk says so, whatever their names: links of both kinds,
    another spelling, letters that this disk takes for each other.

    Args:
        flag: the one that names the outputs.
        outputs: files. Files that do not exist yet can't be inputs.
        inputs: files, and folders with the files in them.

    Raises:
        BadInput: one of the outputs is one of the inputs.
    """
    existing = {key: path for path in outputs if path and (key := _identity(path))}
    if not existing:
        return
    for path in (path for path in inputs if path):
        for file in (path, *(path.iterdir() if path.is_dir() else ())):
            key = _identity(file)
            output = existing.get(key) if key else None
            if output is not None:
                said = file if file == output else f"{output}, which is {file},"
                problem = f"{said} is read and would be written over: choose another name"
                raise BadInput(flag, problem)


def output_folder(path: str | Path) -> Path:
    """Make a folder with its parents where it is missing, and return its path.

    Raises:
        BadInput: a file is in the way, or the folder can't be made or written to.
    """
    path = Path(path)
    with naming(path, "can't be made"):
        try:
            path.mkdir(parents=True, exist_ok=True)
        except (FileExistsError, NotADirectoryError):
            raise BadInput(path, "is a file, not a folder") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise BadInput(path, "can't be written to: permission denied")
    return path


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON. NumPy and JAX values become plain, numbers that are not finite become null.

    Raises:
        BadInput: it can't be written.
    """
    atomic_write(path, json.dumps(plain_data(data), indent=2, allow_nan=False) + "\n")


def write_tum(
    path: str | Path,
    stamps_s: Float[np.ndarray, " F"],
    Ts_world_vehicle: Float[np.ndarray, "poses 7"],
) -> None:
    """Write a trajectory in TUM's format: `stamp_s x y z qx qy qz qw` a line, which `evo` reads.

    Args:
        stamps_s: (F,) s.
        Ts_world_vehicle: (F, 7) wxyz_xyz, jaxlie's order, m.

    Raises:
        BadInput: it can't be written.
    """
    stamps_s, Ts = np.asarray(stamps_s, float), np.asarray(Ts_world_vehicle, float)
    if Ts.shape != (*stamps_s.shape, 7) or stamps_s.ndim != 1:
        raise ValueError(f"(F,) and (F, 7) expected, got {stamps_s.shape} and {Ts.shape}")
    lines = [
        # From 1000 m on 9 digits give less than a um.
        f"{stamp:.9f} {' '.join(f'{m:.9g}' if abs(m) < 1e3 else f'{m:.6f}' for m in place_m)} "
        f"{qx:.9g} {qy:.9g} {qz:.9g} {qw:.9g}\n"
        for stamp, (qw, qx, qy, qz, *place_m) in zip(stamps_s, Ts, strict=True)
    ]
    atomic_write(path, "".join(lines))


def _target(path: str | Path) -> tuple[Path, os.stat_result | None]:
    """The file that a path leads to, and the status of an older file there; None without one."""
    if "\0" in str(path):
        raise BadInput(path, "can't be written: a name has no NUL")
    target = Path(os.path.realpath(path))
    try:
        older = target.stat()
    except FileNotFoundError:
        return target, None
    if stat.S_ISDIR(older.st_mode):
        raise BadInput(path, "can't be written: it is a folder")
    if not stat.S_ISREG(older.st_mode):
        raise BadInput(path, "can't be written: it is a device or a pipe, not a file")
    if not os.access(target, os.W_OK):
        raise BadInput(path, "can't be written: permission denied")
    return target, older


def _sync_folder(folder: Path) -> None:
    """Force the names in a folder to its disk, if it can do that, to survive a power cut."""
    with suppress(OSError):
        fd = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def _identity(path: Path) -> tuple[int, int] | None:
    """Device and inode of a path; None where there is no such file, or it can't be a name."""
    try:
        status = path.stat()
    except (OSError, ValueError):
        return None
    return status.st_dev, status.st_ino


def yaml_text(data: dict[str, Any]) -> str:
    """Data as YAML, with each list of numbers on one line."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=False, width=200)


class _Dumper(yaml.SafeDumper):
    """A dumper without aliases."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _text(dumper: _Dumper, text: str) -> yaml.ScalarNode:
    # A number of YAML 1.2, such as 1e-5 or 08, may be a word to PyYAML; it begins like a number.
    style = None if text[:1].isalpha() else '"'
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=style)


def _list(dumper: _Dumper, entries: list[Any]) -> yaml.SequenceNode:
    is_row = not any(isinstance(entry, list | dict) for entry in entries)
    return dumper.represent_sequence("tag:yaml.org,2002:seq", entries, flow_style=is_row)


_Dumper.add_representer(str, _text)
_Dumper.add_representer(list, _list)


def plain_data(value: Any) -> Any:
    """NumPy, JAX and paths as plain values, and None for numbers not finite; the rest unchanged."""
    if isinstance(value, dict):
        return {str(key): plain_data(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [plain_data(inner) for inner in value]
    if hasattr(value, "tolist"):  # arrays and their scalars
        return plain_data(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    if isinstance(value, Path):
        return str(value)
    return value
