"""What commands write, and that none of it is what they read: asked before any work is done."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxnav.arguments import (
    Calibrate,
    Demo,
    Doctor,
    Faults,
    Locate,
    Plot,
    Reliability,
    Replay,
    Run,
    Simulate,
    Study,
    Tune,
    View,
)
from jaxnav.arguments.calibration import CALIBRATIONS, CalibrateIntrinsics

# Files of a command in its folder --out.
_REPORT = ("report.png", "report.json")
_MAP = ("markers.yaml", "trajectory.tum", *_REPORT)
_IN_FOLDER: dict[type, tuple[str, ...]] = {
    Demo: tuple(
        f"{folder}{name}"
        for folder in ("", "seed_*/")
        for name in ("*.tum", "report.png", "mosaic.png", "summary.json")
    ),
    Replay: ("*.tum", "report.png", "summary.json"),
    Reliability: ("reliability.png", "summary.json"),
    Plot: ("drive.png", "map_*.png", "curves*.png", "reliability.png", "summary.json"),
    Tune: ("params.yaml", "checkpoint.npz", "report.png", "summary.json"),
    CALIBRATIONS["board"]: ("board.pdf", "board.png", "board.yaml", "report.json"),
    CALIBRATIONS["check"]: _MAP,
    CALIBRATIONS["intrinsics"]: ("camera.yaml", *_REPORT),
    CALIBRATIONS["markers"]: _MAP,
    CALIBRATIONS["odometry"]: ("vehicle.yaml", *_REPORT),
    CALIBRATIONS["rig"]: ("rig.yaml", *_MAP),
}
# Those whose file must have its folder already: what can't be written shows before the work.
_FILE: dict[type, str] = {Simulate: "json", Faults: "json", Doctor: "json", Locate: "out"}
# Those that make a folder for it. What CalibrateConvert writes depends on what it reads: it asks
# by itself.
_ELSEWHERE: dict[type, str] = {View: "out", Study: "out", Run: "record"}
_OUTPUTS = {"out", "json", "record"}  # fields that are no inputs


def check_outputs(command: Any) -> None:
    """Refuse a command that would write over what it reads, or can't write what it is to.

    Raises:
        BadInput: names the flag.
    """
    kind = type(command.what if isinstance(command, Calibrate) else command)
    told = command.what if isinstance(command, Calibrate | Tune) else command
    flag, outputs = "--out", list[Path]()
    if kind in _IN_FOLDER:
        names = _IN_FOLDER[kind]
        if isinstance(command, Replay) and command.record:
            names += ("replay.mcap",)
        outputs = [path for name in names for path in told.out.glob(name)]
    elif kind in _FILE or kind in _ELSEWHERE:
        name = (_FILE | _ELSEWHERE)[kind]
        flag, given = f"--{name}", getattr(told, name)
        outputs = [] if given is None else [given]
    if not outputs:
        return
    from jaxnav.files.writing import refuse_overwriting, require_writable  # takes JAX along

    refuse_overwriting(flag, outputs, _inputs(told))
    if kind in _FILE:
        require_writable(outputs[0])


def _inputs(value: Any) -> Iterator[Path]:
    """All paths among arguments, also behind KEY=."""
    if isinstance(value, Path):
        yield value
    elif isinstance(value, str) and value.partition("=")[2]:
        yield Path(value.partition("=")[2])
    elif isinstance(value, CalibrateIntrinsics):
        yield from (value.board, *filter(None, [value.rig]))
        yield from (path for paths in value.by_camera.values() for path in paths)
    elif isinstance(value, tuple | list):
        for inner in value:
            yield from _inputs(inner)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name not in _OUTPUTS:
                yield from _inputs(getattr(value, field.name))
