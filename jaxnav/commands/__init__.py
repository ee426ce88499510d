"""What `jaxnav` can do: the one table of its commands, as the command line reads it.

The arguments of a command are a dataclass, in a file that loads nothing heavy, for `--help`; what
it does is `run` of a module. A name of two words is a command of a group.
"""

import dataclasses
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Union

import tyro

from jaxnav.commands.calibrate.arguments import (
    CalibrateAdopt,
    CalibrateBoard,
    CalibrateCheck,
    CalibrateCompare,
    CalibrateConvert,
    CalibrateIntrinsics,
    CalibrateMarkers,
    CalibrateOdometry,
    CalibrateRig,
)
from jaxnav.commands.doctor.arguments import Doctor
from jaxnav.commands.drive.arguments import (
    Faults,
    Locate,
    ReplayRecording,
    Ros,
    Run,
    Stop,
    ViewDrive,
)
from jaxnav.commands.simulate.arguments import Demo, Simulate
from jaxnav.commands.study.arguments import Plot, RunStudy, StudyReliability
from jaxnav.commands.tune.arguments import TuneController, TuneFilter

_REPORT = ("report.png", "report.json")
_MAP = ("markers.yaml", "trajectory.tum", *_REPORT)
_TUNED = ("params.yaml", "checkpoint.npz", "report.png", "summary.json")
_DROVE = ("*.tum", "report.png", "mosaic.png", "summary.json")


class Command(NamedTuple):
    """A command.

    Attributes:
        arguments: the dataclass of its arguments.
        module: that has `run`, below this package.
        in_folder: files that it writes into --out, as patterns.
        file: a field of the arguments, a file to write whose folder must be there: what can't be
            written shows before the work.
        made: the same, whose folder is made. What `calibrate convert` writes depends on what it
            reads: it asks by itself.
    """

    arguments: type
    module: str
    in_folder: tuple[str, ...] = ()
    file: str = ""
    made: str = ""


COMMANDS = {
    "demo": Command(
        Demo, "simulate.demo", in_folder=(*_DROVE, *(f"seed_*/{name}" for name in _DROVE))
    ),
    "replay": Command(
        ReplayRecording, "drive.replay", in_folder=("*.tum", "report.png", "summary.json")
    ),
    "locate": Command(Locate, "drive.locate", file="out"),
    "simulate": Command(Simulate, "simulate.simulate", file="json"),
    "reliability": Command(
        StudyReliability, "study.reliability", in_folder=("reliability.png", "summary.json")
    ),
    "study": Command(RunStudy, "study.study", made="out"),
    "plot": Command(
        Plot,
        "drive.plot",
        in_folder=("drive.png", "map_*.png", "curves*.png", "reliability.png", "summary.json"),
    ),
    "run": Command(Run, "drive.run", made="record"),
    "stop": Command(Stop, "drive.stop"),
    "ros": Command(Ros, "drive.ros", made="record"),
    "faults": Command(Faults, "drive.faults", file="json"),
    "view": Command(ViewDrive, "drive.view", made="out"),
    "doctor": Command(Doctor, "doctor.doctor", file="json"),
    "tune filter": Command(TuneFilter, "tune.filter", in_folder=_TUNED),
    "tune controller": Command(TuneController, "tune.controller", in_folder=_TUNED),
    "calibrate board": Command(
        CalibrateBoard,
        "calibrate.board",
        in_folder=("board.pdf", "board.png", "board.yaml", "report.json"),
    ),
    "calibrate intrinsics": Command(
        CalibrateIntrinsics, "calibrate.intrinsics", in_folder=("camera.yaml", *_REPORT)
    ),
    "calibrate compare": Command(CalibrateCompare, "calibrate.compare", in_folder=_REPORT),
    "calibrate rig": Command(CalibrateRig, "calibrate.rig", in_folder=("rig.yaml", *_MAP)),
    "calibrate markers": Command(CalibrateMarkers, "calibrate.rig", in_folder=_MAP),
    "calibrate check": Command(CalibrateCheck, "calibrate.check", in_folder=_MAP),
    "calibrate odometry": Command(
        CalibrateOdometry, "calibrate.odometry", in_folder=("vehicle.yaml", *_REPORT)
    ),
    "calibrate adopt": Command(
        CalibrateAdopt, "calibrate.adopt", in_folder=("rig.yaml", "vehicle.yaml", *_REPORT)
    ),
    "calibrate convert": Command(CalibrateConvert, "calibrate.convert"),
}
GROUPS = {
    "tune": "Learn parameters by gradient, through the step that runs on the car.",
    "calibrate": "Calibrate your own car: cameras, their places, markers, odometry.",
}
OUTPUTS = {"out", "json", "record"}  # fields of arguments


def names() -> list[str]:
    """The first words of all commands, in the order of the help."""
    return list(dict.fromkeys(name.partition(" ")[0] for name in COMMANDS))


def command_of(arguments: Any) -> Command:
    """The command that has such arguments."""
    return next(one for one in COMMANDS.values() if one.arguments is type(arguments))


@cache
def all_arguments() -> Any:
    """A union of all arguments, as tyro reads it; those of a group are its field `what`."""
    return _union(_of_name(name) for name in names())


def _of_name(name: str) -> Any:
    if name not in GROUPS:
        return Annotated[COMMANDS[name].arguments, tyro.conf.subcommand(name)]
    inner = _union(
        Annotated[one.arguments, tyro.conf.subcommand(full.partition(" ")[2])]
        for full, one in COMMANDS.items()
        if full.startswith(f"{name} ")
    )
    what = ("what", Annotated[inner, tyro.conf.arg(name="")])
    group = dataclasses.make_dataclass(
        name.capitalize(), [what], frozen=True, namespace={"__doc__": GROUPS[name]}
    )
    return Annotated[group, tyro.conf.subcommand(name)]


def _union(kinds: Iterator[Any]) -> Any:
    return Union[tuple(kinds)]  # noqa: UP007  (they are known when it runs)


def check_outputs(arguments: Any) -> None:
    """Refuse a command that would write over what it reads, or whose output can't be written.

    Raises:
        BadInput: names the flag.
    """
    command = command_of(arguments)
    if command.in_folder:
        names = command.in_folder + ("replay.mcap",) * getattr(arguments, "record_anew", False)
        name, outputs = "out", [path for name in names for path in arguments.out.glob(name)]
    else:
        name = command.file or command.made
        given = getattr(arguments, name, None) if name else None
        outputs = [] if given is None else [given]
    if not outputs:
        return
    from jaxnav.files.writing import refuse_overwriting, require_writable  # imports JAX

    refuse_overwriting(f"--{name}", outputs, _inputs(arguments))
    if command.file:
        require_writable(outputs[0])


def _inputs(value: Any) -> Iterator[Path]:
    """All paths of input files among a command's arguments, also behind KEY=."""
    if isinstance(value, Path | str):
        text = str(value)
        yield from (Path(text),) * isinstance(value, Path)
        yield from (Path(behind) for behind in (text.partition("=")[2],) if behind)
    elif isinstance(value, tuple):
        for inner in value:
            yield from _inputs(inner)
    elif dataclasses.is_dataclass(value):
        for field in dataclasses.fields(value):
            if field.name not in OUTPUTS:
                yield from _inputs(getattr(value, field.name))
