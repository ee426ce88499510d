"""The provenance of calibrated figures, at the head of their file.

calibrated:
  date: 2026-05-17
  tool: jaxnav 0.1.0 calibrate rig
  data_sha256: 9f86d081884c7d65...
"""

import hashlib
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Shaped
from pydantic import Field

from jaxnav.files.reading import open_file
from jaxnav.files.validation import Entry, Text
from jaxnav.files.writing import yaml_text


class Calibrated(Entry):
    """The key `calibrated` of a rig, a marker map or a vehicle."""

    date: Annotated[str, Field(strict=True, pattern=r"^\d{4}-\d\d-\d\d$")]  # UTC
    tool: Text
    data_sha256: Annotated[str, Field(strict=True, pattern=r"^[0-9a-f]{64}$")]


def file_text(data: dict[str, Any], calibrated: Calibrated | None = None) -> str:
    """Data as the text of a file, headed by its provenance if there is one."""
    return yaml_text(data if calibrated is None else {"calibrated": calibrated.model_dump()} | data)


def calibrated_now(tool: str, data: Iterable[Path | Shaped[np.ndarray, "..."]]) -> Calibrated:
    """The provenance of a calibration made today.

    Args:
        tool: name, version and command.
        data: all files and arrays that were calibrated from, in an order that does not change.

    Raises:
        BadInput: a file can't be read.
    """
    digest = hashlib.sha256()
    for item in data:
        if isinstance(item, np.ndarray):
            digest.update(f"{item.dtype.str}{item.shape}".encode())
            digest.update(np.ascontiguousarray(item).tobytes())
        else:
            with open_file(item) as file:
                digest.update(hashlib.file_digest(file, "sha256").digest())
    return Calibrated(
        date=datetime.now(UTC).date().isoformat(), tool=tool, data_sha256=digest.hexdigest()
    )
