"""Types of the flags that several commands share, and what their values must be."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal, cast, get_args

import tyro
from annotated_types import BaseMetadata, Ge, GroupedMetadata, Gt, Lt

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
CornerBackend = Literal["aruco", "apriltag"]
Switch = tyro.conf.FlagCreatePairsOff[bool]


@dataclass(frozen=True)
class Within:
    """The range of a quantity in `jaxnav.files.ranges`, which is read when a value is checked, as
    `--help` is to load no NumPy."""

    name: str

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> Any:
        from jaxnav.files.ranges import within

        return within(self.name).__get_pydantic_core_schema__(source, handler)


Count = Annotated[int, Ge(1)]
Seed = Annotated[int, Ge(0)]
Positive = Annotated[float, Gt(0), Lt(math.inf)]
NotNegative = Annotated[float, Ge(0), Lt(math.inf)]
CornerSigma = Annotated[float, Within("corner_sigma_px")]
SizeM = Annotated[float, Within("size_m")]


def check_values(command: Any) -> None:
    """Hold the arguments of a command against their types.

    What does not go together a command's class refuses by itself, in its `__post_init__`.

    Raises:
        BadInput: names the first flag whose value is out of its range.
    """
    bounded = [field for field in fields(command) if _is_bounded(field.type)]
    if not bounded:  # as of `jaxnav stop`, which loads nothing heavy
        return
    from pydantic import TypeAdapter, ValidationError  # not for --help

    for field in bounded:
        try:
            TypeAdapter(cast(Any, field.type)).validate_python(getattr(command, field.name))
        except ValidationError as invalid:
            error = invalid.errors(include_url=False)[0]
            problem = error["msg"]
            for words, plainer in _PLAINER.items():
                problem = problem.replace(words, plainer)
            got = "" if "got" in problem else f", got {error['input']}"
            raise BadInput(flag_of(field.name), f"{problem}{got}") from None


def _is_bounded(kind: Any) -> bool:
    """Whether a type says more of its values than Python's own."""
    bounds = getattr(kind, "__metadata__", ())
    return any(isinstance(one, BaseMetadata | GroupedMetadata | Within) for one in bounds) or any(
        map(_is_bounded, get_args(kind))
    )


_PLAINER = {
    "Value error, ": "", "Input should": "must", "greater than or equal to": "at least",
    "less than or equal to": "at most", "less than inf": "finite",
}  # fmt: skip


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
Headless = Annotated[Switch, tyro.conf.arg(help="No progress bar.")]
ResultsFolder = Annotated[Path, tyro.conf.arg(metavar="DIR", help="Folder for the results.")]
