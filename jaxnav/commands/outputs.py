"""A check, before any work is done, that a command does not write over what it reads."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from jaxnav.commands import COMMANDS, registered
from jaxnav.commands.calibrate.arguments import CalibrateIntrinsics

_OUTPUTS = {"out", "json", "record"}  # fields of outputs


def check_outputs(command: Any) -> None:
    """Refuse a command that would write over what it reads, or whose output can't be written.

    Raises:
        BadInput: names the flag.
    """
    one, flag, outputs = registered(command), "--out", list[Path]()
    if one.in_folder:
        names = one.in_folder
        if one is COMMANDS["replay"] and command.record_anew:
            names += ("replay.mcap",)
        outputs = [path for name in names for path in command.out.glob(name)]
    elif name := one.file or one.made:
        flag, given = f"--{name}", getattr(command, name)
        outputs = [] if given is None else [given]
    if not outputs:
        return
    from jaxnav.files.writing import refuse_overwriting, require_writable  # imports JAX

    refuse_overwriting(flag, outputs, _inputs(command))
    if one.file:
        require_writable(outputs[0])


def _inputs(value: Any) -> Iterator[Path]:
    """All paths of input files among a command's arguments, also behind KEY=."""
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
