"""Reading of a recorded drive with a progress bar."""

from contextlib import suppress
from pathlib import Path

from tqdm import tqdm

from jaxnav.recording.drive_log import DriveLog, read_drive

_PATIENCE_S = 2.0


def read_shown(path: Path, headless: bool = False) -> DriveLog:
    """`read_drive`, with a bar on a terminal where it takes longer than `_PATIENCE_S`."""
    size = None
    with suppress(OSError, ValueError):  # the reader says what is wrong
        size = path.stat().st_size
    with tqdm(
        total=size, unit="B", unit_scale=True, desc="reading", leave=False, delay=_PATIENCE_S,
        disable=headless or None,
    ) as bar:  # fmt: skip
        return read_drive(path, bar.update)
