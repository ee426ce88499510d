"""Kinds of values that several commands are told, and what is asked of them."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from jaxnav.errors import BadInput

Selector = Literal[
    "multi-hypothesis",
    "lowest-reprojection",
    "lowest-reprojection-ungated",
    "ratio-test",
    "object-space",
    "paper-cost",
    "paper-cost-ungated",
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
    "long-tunnel",
    "kidnapped",
    "slip",
    "slip-30",
    "gyro-late",
    "miscalibrated",
    "blur",
    "late",
    "drifting-corners",
    "each-camera-off",
    "uneven-wheels",
    "everything",
    "as-told",
]
Base = Literal["ackermann", "differential", "omni"]
Imu = Literal["none", "consumer", "tactical"]
StudyKind = Literal["ambiguity", "drive"]
CornerBackend = Literal["aruco", "apriltag"]
Switch = tyro.conf.FlagCreatePairsOff[bool]


@dataclass(frozen=True)
class Asked:
    """What is asked of the values of a field that has this in its annotation.

    Attributes:
        check: called with flag and value; raises BadInput.
    """

    check: Callable[[str, Any], None]


@dataclass(frozen=True)
class Checked:
    """The arguments of a command; BadInput where a value is not what its field's annotation asks
    for, or where values don't go together."""

    def __post_init__(self) -> None:
        for field in fields(self):
            given = getattr(self, field.name)
            for asked in getattr(field.type, "__metadata__", ()):
                if isinstance(asked, Asked):
                    for value in given if isinstance(given, tuple) else (given,):
                        if value is not None:
                            asked.check(flag_of(field.name), value)
        self._check()

    def _check(self) -> None:
        """Raise BadInput where values don't go together."""


def flag_of(name: str) -> str:
    """The flag of a field."""
    return f"--{name.replace('_', '-')}"


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


def require(condition: bool, flag: str, problem: str) -> None:
    """Raise BadInput where a condition does not hold."""
    if not condition:
        raise BadInput(flag, problem)


def key_values(flag: str, texts: Sequence[str], expected: str = "KEY=VALUE") -> dict[str, str]:
    """Key -> value of texts KEY=VALUE.

    Raises:
        BadInput: a text that is none, or a key that is given twice.
    """
    values: dict[str, str] = {}
    for text in texts:
        key, equals, value = text.partition("=")
        require(bool(key and equals), flag, f"expected {expected}, got {text!r}")
        require(key not in values, flag, f"{key} is given twice")
        values[key] = value
    return values


def _require_at_least(flag: str, value: int, least: int) -> None:
    bound = "not be negative" if least == 0 else f"be at least {least}"
    require(value >= least, flag, f"must {bound}, got {value}")


def _require_finite(flag: str, value: float, zero_allowed: bool = False) -> None:
    large_enough = value >= 0 if zero_allowed else value > 0
    bound = "not be negative" if zero_allowed else "be positive"
    require(math.isfinite(value) and large_enough, flag, f"must {bound} and finite, got {value}")


def _require_within(flag: str, value: float, name: str) -> None:
    from jaxnav.files.ranges import RANGES, problem_of  # NumPy: not for --help

    if RANGES[name].least > 0:
        _require_finite(flag, value)
    problem = problem_of(name, value)
    require(problem is None, flag, problem or "")


def within(name: str) -> Asked:
    """What a file may hold of the same quantity, whose name stands in `jaxnav.files.ranges`."""
    return Asked(partial(_require_within, name=name))


POSITIVE = Asked(_require_finite)
AT_LEAST_1 = Asked(partial(_require_at_least, least=1))
Count = Annotated[int, AT_LEAST_1]
NotNegativeCount = Annotated[int, Asked(partial(_require_at_least, least=0))]
Seed = NotNegativeCount
Positive = Annotated[float, POSITIVE]
NotNegative = Annotated[float, Asked(partial(_require_finite, zero_allowed=True))]
CornerSigma = Annotated[float, within("corner_sigma_px")]

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
Believed = Annotated[
    Selector, tyro.conf.arg(help="Which of the two poses of a marker is believed.")
]
Detector = Annotated[
    CornerBackend,
    tyro.conf.arg(help="Marker detector. apriltag needs the extra of that name."),
]
Following = Annotated[
    Literal["follow", "decode-only"],
    tyro.conf.arg(
        help="follow: also follow expected markers that are too blurred, shaded or hidden to read."
    ),
]
Float64 = Annotated[Switch, tyro.conf.arg(help="Estimate in double precision.")]
ResultsFolder = Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for the results.")]


@dataclass(frozen=True, kw_only=True)
class Headless(Checked):
    """What every command is told that shows how far it is."""

    headless: Switch = False
    """No progress bar."""


@dataclass(frozen=True, kw_only=True)
class ScenarioCarFiles(Headless):
    """What every command is told that drives through scenarios: its car, in files or by name."""

    base: Base = "ackermann"
    """What drives: the vehicle, or a base of the QCar's size that is commanded by a twist."""
    imu: Imu = "none"
    """The vehicle's gyro: as its file says, or one of that class, with errors drawn anew for each
    drive."""
    rig: QCarRig = None
    markers: QCarMarkers = None
    vehicle: QCarVehicle = None
    route: Annotated[Path | None, optional("FILE", "(default: the scenario's own)")] = None
    """Start and waypoints that go with another marker map."""

    def _check(self) -> None:
        named = self.base == "ackermann" or self.vehicle is None
        require(named, "--base", f"{self.base} takes the place of --vehicle: give one of them")
