"""The provenance of calibrated figures, as their file states it.

calibrated:
  date: 2026-05-17
  tool: jaxnav 0.1.0 calibrate rig
  data_sha256: 9f86d081884c7d65...
"""

import hashlib
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated

import numpy as np
from jaxtyping import Shaped
from pydantic import Field

from jaxnav.files.reading import open_file
from jaxnav.files.validation import Entry, Text


class Calibrated(Entry):
    """The key `calibrated` of a rig, a marker map or a vehicle."""

    date: Annotated[str, Field(strict=True, pattern=r"^\d{4}-\d\d-\d\d$")]  # UTC
    tool: Text
    data_sha256: Annotated[str, Field(strict=True, pattern=r"^[0-9a-f]{64}$")]


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
