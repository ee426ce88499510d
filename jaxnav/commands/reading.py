"""Reading of recorded drives, and of files that are given beside them."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from jaxnav.commands.bars import FROM_S, progress_bar
from jaxnav.commands.kinds import flag_of
from jaxnav.errors import BadInput
from jaxnav.files import (
    calib_dir,
    load_markers,
    load_params,
    load_rig,
    load_route,
    load_topics,
    load_vehicle,
)
from jaxnav.recordings.drive_log import DriveLog, read_drive

_LOADS: dict[str, Callable[[Path], Any]] = {
    "rig": load_rig, "markers": load_markers, "vehicle": load_vehicle, "route": load_route,
    "params": load_params, "topics": load_topics,
}  # fmt: skip


def given_files(
    args: Any, names: Sequence[str], bag: Path | None = None, or_qcars: bool = False
) -> dict[str, Any]:
    """The content of the files that are given, by their names.

    Args:
        args: with the fields that are asked for.
        names: those asked for: rig, markers, vehicle, route, params, topics.
        bag: a recording that holds none of them, so that all must be given.
        or_qcars: whether the QCar's file stands for one that is not given.

    Raises:
        BadInput: a file that is not valid, or the flag of one that is missing.
    """
    content = {}
    for name in names:
        path = getattr(args, name) or (calib_dir() / "qcar" / f"{name}.yaml" if or_qcars else None)
        if path is not None:
            content[name] = _LOADS[name](path)
        elif bag is not None:
            raise BadInput(flag_of(name), f"missing: a ROS bag ({bag}) does not hold it")
    return content


def read_shown(path: Path, headless: bool = False) -> DriveLog:
    """`read_drive`, with a bar where it takes longer than `FROM_S`."""
    size = None
    with suppress(OSError, ValueError):  # the reader says what is wrong
        size = path.stat().st_size
    with progress_bar(
        total=size, unit="B", unit_scale=True, desc="reading", leave=False, delay=FROM_S,
        disable=headless,
    ) as bar:  # fmt: skip
        return read_drive(path, bar.update)
