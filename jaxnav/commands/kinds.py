"""Kinds of values that several commands are told, and what is asked of them."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.errors import BadInput

Selector = Literal[
    "multi-hypothesis",
    "lowest-reprojection",
    "ratio-test",
    "object-space",
    "paper-cost",
    "mahalanobis",
]
# These need what only a simulation has: another sensor, the truth.
SimulatedSelector = Literal[Selector, "orientation-given", "oracle", "all"]
Scenario = Literal[
    "paper",
    "static",
    "approach",
    "orbit",
    "tunnel",
    "kidnapped",
    "slip",
    "miscalibrated",
    "blur",
]
StudyKind = Literal["ambiguity", "drive"]
CornerBackend = Literal["aruco", "apriltag"]
Switch = tyro.conf.FlagCreatePairsOff[bool]


def optional(
    metavar: str,
    without: str = "(optional)",
    constructor: type | None = None,
    help_text: str | None = None,
) -> object:
    """How help shows an option that may be left out.

    Args:
        metavar: the value's name in the help.
        without: what is then.
        constructor: of the value, where the word None is none.
        help_text: the help, where the field has none of its own.
    """
    return tyro.conf.arg(
        metavar=metavar, help_behavior_hint=without, constructor=constructor, help=help_text
    )


_QCAR = "FILE", "(default: the QCar's)", None
QCarFile = Annotated[Path | None, optional(*_QCAR)]
OptionalFile = Annotated[Path | None, optional("FILE")]
OptionalName = Annotated[str | None, optional("NAME", constructor=str)]
KeyValues = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]], optional("KEY=VALUE", "(repeatable)")
]

# These bring their help along.
QCarRig = Annotated[Path | None, optional(*_QCAR, "Cameras: a rig file or a Kalibr camchain.")]
QCarMarkers = Annotated[Path | None, optional(*_QCAR, "Marker map.")]
QCarVehicle = Annotated[Path | None, optional(*_QCAR, "Vehicle parameters and limits.")]
QCarBicycle = Annotated[Path | None, optional(*_QCAR, "Bicycle parameters and limits.")]
Believed = Annotated[
    Selector, tyro.conf.arg(help="Which of the two poses of a marker is believed.")
]
Detector = Annotated[
    CornerBackend,
    tyro.conf.arg(help="Marker detector. apriltag needs the extra of that name."),
]
Float64 = Annotated[Switch, tyro.conf.arg(help="Estimate in double precision.")]
ResultsFolder = Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for the results.")]


@dataclass(frozen=True, kw_only=True)
class Headless:
    """What every command is told that shows how far it is."""

    headless: Switch = False
    """No progress bar."""


def require(condition: bool, flag: str, problem: str) -> None:
    """Raise BadInput where a condition does not hold."""
    if not condition:
        raise BadInput(flag, problem)


def require_at_least(least: int, flag: str, value: int) -> None:
    """Raise BadInput where a number is too small."""
    bound = "not be negative" if least == 0 else f"be at least {least}"
    require(value >= least, flag, f"must {bound}, got {value}")


def require_finite(flag: str, value: float, zero_allowed: bool = False) -> None:
    """Raise BadInput where a number is not positive, or not finite."""
    large_enough = value >= 0 if zero_allowed else value > 0
    bound = "not be negative" if zero_allowed else "be positive"
    require(math.isfinite(value) and large_enough, flag, f"must {bound} and finite, got {value}")


def require_within(flag: str, value: float, name: str) -> None:
    """Raise BadInput where a number is not what a file may hold of the same quantity.

    Args:
        name: of the quantity, in `jaxnav.files.ranges`.
    """
    from jaxnav.files.ranges import RANGES, problem_of  # NumPy: not for --help

    if RANGES[name].least > 0:
        require_finite(flag, value)
    problem = problem_of(name, value)
    require(problem is None, flag, problem or "")
