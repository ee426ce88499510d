"""What `jaxnav` can be told to do: the one place where a command is registered.

The arguments of a command are a dataclass, in a file that loads nothing heavy, for `--help`; what
it does is `run` of a module. A name of two words is a command of a group.
"""

import dataclasses
import importlib
from collections.abc import Iterator
from functools import cache
from typing import Annotated, Any, Union, cast

_REPORT = ("report.png", "report.json")
_MAP = ("markers.yaml", "trajectory.tum", *_REPORT)
_TUNED = ("params.yaml", "checkpoint.npz", "report.png", "summary.json")
_DROVE = ("*.tum", "report.png", "mosaic.png", "summary.json")


@dataclasses.dataclass(frozen=True)
class Registered:
    """A command.

    Attributes:
        arguments: "module:Class", the module below this package.
        module: that has `run`, below this package.
        in_folder: files that it writes into --out, as patterns.
        file: a field of the arguments, a file to write whose folder must be there: what can't be
            written shows before the work.
        made: the same, whose folder is made. What `calibrate convert` writes depends on what it
            reads: it asks by itself.
    """

    arguments: str
    module: str
    in_folder: tuple[str, ...] = ()
    file: str = ""
    made: str = ""

    @property
    def kind(self) -> type:
        """The dataclass of its arguments; what it shares with others comes last, in help too."""
        module, _, name = self.arguments.partition(":")
        kind: Any = getattr(importlib.import_module(f"{__name__}.{module}"), name)
        named = (name for one in kind.__mro__ for name in vars(one).get("__annotations__", ()))
        kind.__dataclass_fields__ = {name: kind.__dataclass_fields__[name] for name in named}
        return cast(type, kind)


COMMANDS = {
    "demo": Registered(
        "simulate.arguments:Demo",
        "simulate.demo",
        in_folder=(*_DROVE, *(f"seed_*/{name}" for name in _DROVE)),
    ),
    "replay": Registered(
        "drive.arguments:ReplayRecording",
        "drive.replay",
        in_folder=("*.tum", "report.png", "summary.json"),
    ),
    "locate": Registered("drive.arguments:Locate", "drive.locate", file="out"),
    "simulate": Registered("simulate.arguments:Simulate", "simulate.simulate", file="json"),
    "reliability": Registered(
        "study.arguments:StudyReliability",
        "study.reliability",
        in_folder=("reliability.png", "summary.json"),
    ),
    "study": Registered("study.arguments:RunStudy", "study.study", made="out"),
    "plot": Registered(
        "study.arguments:Plot",
        "drive.plot",
        in_folder=("drive.png", "map_*.png", "curves*.png", "reliability.png", "summary.json"),
    ),
    "run": Registered("drive.arguments:Run", "drive.run", made="record"),
    "stop": Registered("drive.arguments:Stop", "drive.stop"),
    "ros": Registered("drive.arguments:Ros", "drive.ros", made="record"),
    "faults": Registered("drive.arguments:Faults", "drive.faults", file="json"),
    "view": Registered("drive.arguments:ViewDrive", "drive.view", made="out"),
    "doctor": Registered("doctor.arguments:Doctor", "doctor.doctor", file="json"),
    "tune filter": Registered("tune.arguments:TuneFilter", "tune.filter", in_folder=_TUNED),
    "tune controller": Registered(
        "tune.arguments:TuneController", "tune.controller", in_folder=_TUNED
    ),
    "calibrate board": Registered(
        "calibrate.arguments:CalibrateBoard",
        "calibrate.board",
        in_folder=("board.pdf", "board.png", "board.yaml", "report.json"),
    ),
    "calibrate intrinsics": Registered(
        "calibrate.arguments:CalibrateIntrinsics",
        "calibrate.intrinsics",
        in_folder=("camera.yaml", *_REPORT),
    ),
    "calibrate compare": Registered(
        "calibrate.arguments:CalibrateCompare", "calibrate.compare", in_folder=_REPORT
    ),
    "calibrate rig": Registered(
        "calibrate.arguments:CalibrateRig",
        "calibrate.rig",
        in_folder=("rig.yaml", *_MAP),
    ),
    "calibrate markers": Registered(
        "calibrate.arguments:CalibrateMarkers", "calibrate.rig", in_folder=_MAP
    ),
    "calibrate check": Registered(
        "calibrate.arguments:CalibrateCheck", "calibrate.check", in_folder=_MAP
    ),
    "calibrate odometry": Registered(
        "calibrate.arguments:CalibrateOdometry",
        "calibrate.odometry",
        in_folder=("vehicle.yaml", *_REPORT),
    ),
    "calibrate adopt": Registered(
        "calibrate.arguments:CalibrateAdopt",
        "calibrate.adopt",
        in_folder=("rig.yaml", "vehicle.yaml", *_REPORT),
    ),
    "calibrate convert": Registered("calibrate.arguments:CalibrateConvert", "calibrate.convert"),
}
GROUPS = {
    "tune": "Learn parameters by gradient, through the step that runs on the car.",
    "calibrate": "Calibrate your own car: cameras, their places, markers, odometry.",
}


def names() -> list[str]:
    """The first words of all commands, in the order of the help."""
    return list(dict.fromkeys(name.partition(" ")[0] for name in COMMANDS))


def registered(arguments: Any) -> Registered:
    """The command that has such arguments."""
    return next(one for one in COMMANDS.values() if one.kind is type(arguments))


@cache
def all_arguments() -> Any:
    """A union of all arguments, as tyro reads it; those of a group are its field `what`."""
    return _union(_of_name(name) for name in names())


def _of_name(name: str) -> Any:
    import tyro  # not before it is needed: `run` hears signals from its first line on

    if name not in GROUPS:
        return Annotated[COMMANDS[name].kind, tyro.conf.subcommand(name)]
    inner = _union(
        Annotated[one.kind, tyro.conf.subcommand(full.partition(" ")[2])]
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
