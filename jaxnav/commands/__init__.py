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

from jaxnav.commands.calibrate import arguments as of_calibrate
from jaxnav.commands.drive import arguments as of_drive
from jaxnav.commands.simulate import arguments as of_simulate

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
    "demo": Command(of_simulate.Demo, "simulate.demo", (*_DROVE, *(f"seed_*/{x}" for x in _DROVE))),
    "replay": Command(
        of_drive.ReplayRecording, "drive.replay", ("*.tum", "report.png", "summary.json")
    ),
    "locate": Command(of_drive.Locate, "drive.locate", file="out"),
    "simulate": Command(of_simulate.Simulate, "simulate.simulate", file="json"),
    "reliability": Command(
        of_simulate.StudyReliability, "study.reliability", ("reliability.png", "summary.json")
    ),
    "study": Command(of_simulate.RunStudy, "study.study", made="out"),
    "plot": Command(
        of_drive.Plot,
        "drive.plot",
        ("drive.png", "map_*.png", "curves*.png", "reliability.png", "summary.json"),
    ),
    "run": Command(of_drive.Run, "drive.run", made="record"),
    "stop": Command(of_drive.Stop, "drive.stop"),
    "ros": Command(of_drive.Ros, "drive.ros", made="record"),
    "faults": Command(of_drive.Faults, "drive.faults", file="json"),
    "view": Command(of_drive.ViewDrive, "drive.plot", made="out"),
    "doctor": Command(of_drive.Doctor, "doctor.doctor", file="json"),
    "tune filter": Command(of_simulate.TuneFilter, "tune.filter", _TUNED),
    "tune controller": Command(of_simulate.TuneController, "tune.controller", _TUNED),
    "calibrate board": Command(
        of_calibrate.CalibrateBoard,
        "calibrate.board",
        ("board.pdf", "board.png", "board.yaml", "report.json"),
    ),
    "calibrate intrinsics": Command(
        of_calibrate.CalibrateIntrinsics, "calibrate.intrinsics", ("camera.yaml", *_REPORT)
    ),
    "calibrate compare": Command(of_calibrate.CalibrateCompare, "calibrate.compare", _REPORT),
    "calibrate rig": Command(of_calibrate.CalibrateRig, "calibrate.rig", ("rig.yaml", *_MAP)),
    "calibrate markers": Command(of_calibrate.CalibrateMarkers, "calibrate.rig", _MAP),
    "calibrate check": Command(of_calibrate.CalibrateCheck, "calibrate.rig", _MAP),
    "calibrate odometry": Command(
        of_calibrate.CalibrateOdometry, "calibrate.odometry", ("vehicle.yaml", *_REPORT)
    ),
    "calibrate adopt": Command(
        of_calibrate.CalibrateAdopt, "calibrate.adopt", ("rig.yaml", "vehicle.yaml", *_REPORT)
    ),
    "calibrate convert": Command(of_calibrate.CalibrateConvert, "calibrate.convert"),
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
