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


def _file(told: str | None = None, without: str = "(default: the QCar's)") -> object:
    return tyro.conf.arg(metavar="FILE", help_behavior_hint=without, help=told)


QCarFile = Annotated[Path | None, _file()]
OptionalFile = Annotated[Path | None, _file(without="(optional)")]
OptionalName = Annotated[
    str | None, tyro.conf.arg(metavar="NAME", constructor=str, help_behavior_hint="(optional)")
]
KeyValues = Annotated[
    tyro.conf.UseAppendAction[tuple[str, ...]],
    tyro.conf.arg(metavar="KEY=VALUE", help_behavior_hint="(repeatable)"),
]

# These bring their help along.
QCarRig = Annotated[Path | None, _file("Cameras: a rig file or a Kalibr camchain.")]
QCarMarkers = Annotated[Path | None, _file("Marker map.")]
QCarVehicle = Annotated[Path | None, _file("Vehicle parameters and limits.")]
QCarBicycle = Annotated[Path | None, _file("Bicycle parameters and limits.")]
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
