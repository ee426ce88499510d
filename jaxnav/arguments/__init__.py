"""What the commands of `jaxnav` can be told: a dataclass each; its fields' docstrings are the help.

Values that no file is needed to judge are judged here.
"""

from typing import Annotated

import tyro

from jaxnav.arguments.calibration import Calibrate
from jaxnav.arguments.kinds import Selector
from jaxnav.arguments.recordings import Locate, Replay, View
from jaxnav.arguments.simulations import Demo, Faults, Simulate
from jaxnav.arguments.studies import Plot, Reliability, Study
from jaxnav.arguments.tuning import Tune, TuneController, TuneFilter
from jaxnav.arguments.vehicles import Doctor, Run

__all__ = [
    "COMMANDS",
    "Calibrate",
    "Command",
    "Demo",
    "Doctor",
    "Faults",
    "Locate",
    "Plot",
    "Reliability",
    "Replay",
    "Run",
    "Selector",
    "Simulate",
    "Study",
    "Tune",
    "TuneController",
    "TuneFilter",
    "View",
]

Command = (
    Annotated[Demo, tyro.conf.subcommand("demo")]
    | Annotated[Replay, tyro.conf.subcommand("replay")]
    | Annotated[Locate, tyro.conf.subcommand("locate")]
    | Annotated[Simulate, tyro.conf.subcommand("simulate")]
    | Annotated[Reliability, tyro.conf.subcommand("reliability")]
    | Annotated[Study, tyro.conf.subcommand("study")]
    | Annotated[Plot, tyro.conf.subcommand("plot")]
    | Annotated[Run, tyro.conf.subcommand("run")]
    | Annotated[Faults, tyro.conf.subcommand("faults")]
    | Annotated[View, tyro.conf.subcommand("view")]
    | Annotated[Doctor, tyro.conf.subcommand("doctor")]
    | Annotated[Tune, tyro.conf.subcommand("tune")]
    | Annotated[Calibrate, tyro.conf.subcommand("calibrate")]
)
COMMANDS = {
    "demo": Demo,
    "replay": Replay,
    "locate": Locate,
    "simulate": Simulate,
    "reliability": Reliability,
    "study": Study,
    "plot": Plot,
    "run": Run,
    "faults": Faults,
    "view": View,
    "doctor": Doctor,
    "tune": Tune,
    "calibrate": Calibrate,
}
