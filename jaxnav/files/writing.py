"""Files out: written beside, then renamed, so that nobody ever reads half of one."""

import json
import math
import os
import secrets
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from jaxnav.errors import BadInput


@contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """A path beside `path`, with the same suffix, that becomes `path` when the block succeeds.

    When the block raises, nothing is left and an older file stays as it was.

    Raises:
        BadInput: the folder is missing or closed to writing, or `path` is a folder.
    """
    path = Path(path)
    if path.is_dir():
        raise BadInput(path, "can't be written: it is a folder")
    beside = path.with_name(f".{path.stem}-{secrets.token_hex(4)}{path.suffix}")
    try:
        try:
            yield beside
            os.replace(beside, path)  # noqa: PTH105  (said in the docstring by this name)
        finally:
            beside.unlink(missing_ok=True)
    except OSError as error:
        reason = (error.strerror or str(error)).lower()
        raise BadInput(path, f"can't be written: {reason}") from None


def atomic_write(path: str | Path, content: str | bytes) -> None:
    """Write a whole file, or nothing.

    Raises:
        BadInput: it can't be written.
    """
    raw = content.encode() if isinstance(content, str) else content
    with atomic_path(path) as beside:
        beside.write_bytes(raw)


def atomic_write_all(contents: Mapping[Path, str]) -> None:
    """Write several files, or none of them.

    Raises:
        BadInput: one can't be written.
    """
    with ExitStack() as files:
        for path, text in contents.items():
            files.enter_context(atomic_path(path)).write_bytes(text.encode())


def output_folder(path: str | Path) -> Path:
    """The folder, made with its parents where it is missing.

    Raises:
        BadInput: a file is in the way, or it can't be made or written to.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        raise BadInput(path, "is a file, not a folder") from None
    except OSError as error:
        raise BadInput(path, f"can't be made: {(error.strerror or str(error)).lower()}") from None
    if not os.access(path, os.W_OK | os.X_OK):
        raise BadInput(path, "can't be written to: permission denied")
    return path


def write_json(path: str | Path, data: Any) -> None:
    """Write JSON. NumPy and JAX values become plain ones, what is not finite becomes null.

    Raises:
        BadInput: it can't be written.
    """
    atomic_write(path, json.dumps(plain_data(data), indent=2, allow_nan=False) + "\n")


def write_tum(path: str | Path, stamps_s: np.ndarray, Ts_world_vehicle: np.ndarray) -> None:
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
        f"{stamp:.9f} {_metres(x)} {_metres(y)} {_metres(z)} {qx:.9g} {qy:.9g} {qz:.9g} {qw:.9g}\n"
        for stamp, (qw, qx, qy, qz, x, y, z) in zip(stamps_s, Ts, strict=True)
    ]
    atomic_write(path, "".join(lines))


def _metres(value: float) -> str:
    """To 9 digits, and to the um where these would be fewer."""
    return f"{value:.9g}" if abs(value) < 1e3 else f"{value:.6f}"


def yaml_text(data: dict[str, Any]) -> str:
    """YAML with lists of numbers on one line each."""
    return yaml.dump(data, Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=200)


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True


class Quoted(str):
    """Text in quotes in any case, so that no reader takes it for a number."""


_Dumper.add_representer(
    Quoted, lambda dumper, text: dumper.represent_scalar("tag:yaml.org,2002:str", text, style='"')
)


def plain_data(value: Any) -> Any:
    """NumPy, JAX and paths as plain values, what is not finite as None; the rest as it is."""
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
