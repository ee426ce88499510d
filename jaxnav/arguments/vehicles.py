"""What the commands that drive a car, or look after one, can be told."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxnav.arguments.kinds import (
    CornerBackend,
    OptionalFile,
    QCarFile,
    Selector,
    Switch,
    require,
    require_finite,
)


@dataclass(frozen=True)
class Run:
    """Drive a vehicle through its route.

    Everything is compiled before the vehicle is armed. The last that it hears, however this ends,
    is zero throttle: at the last waypoint, on Ctrl-C, Ctrl-Z and any other signal, when data are
    missing for too long, and when anything hangs, fails or is killed. A vehicle that can be moved
    is opened in a small process of its own, which stops it whatever becomes of this one; others,
    `sim` and `replay` among them, are watched by a thread. `--vehicle sim` is a simulated car in
    real time; `--vehicle replay --option drive=FILE` is a recorded drive, with its own rig,
    markers, vehicle and route.

    Exit codes: 0 arrived, out of time or recording, 1 stopped by a guard, 2 bad input, 128 plus the
    number of the signal that ended it: 130 Ctrl-C, 143 SIGTERM, 129 a closed terminal, 131 SIGQUIT,
    148 Ctrl-Z.
    """

    vehicle: str = "sim"
    """An installed vehicle (sim, qcar, ros2, replay and those of plug-ins), or MODULE:NAME."""
    cameras: Annotated[
        str | None,
        tyro.conf.arg(
            metavar="NAME", constructor=str, help_behavior_hint="(default: as --vehicle)"
        ),
    ] = None
    """Installed cameras (sim, qcar, opencv, replay and those of plug-ins), or MODULE:NAME."""
    option: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="KEY=VALUE", help_behavior_hint="(repeatable)"),
    ] = ()
    """What the vehicle and the cameras are told, e.g. images=true for sim."""
    rig: QCarFile = None
    """Cameras: a rig file or a Kalibr camchain."""
    markers: QCarFile = None
    """Marker map."""
    vehicle_file: QCarFile = None
    """Vehicle parameters and limits."""
    route: QCarFile = None
    """Waypoints, and where a simulated car starts."""
    params: OptionalFile = None
    """Tuned parameters of filter and controller."""
    selector: Selector = "multi-hypothesis"
    """Which of the two poses of a marker is believed."""
    corner_backend: CornerBackend = "aruco"
    """Marker detector. apriltag needs the extra of that name."""
    relocate: bool = True
    """Drive on, slowly at first, where the corners say that the car is where its wheels can't have
    brought it: somebody carried it there, or shows it a copy of the marker. Without: stop."""
    record: Annotated[
        Path | None, tyro.conf.arg(metavar="MCAP", help_behavior_hint="(optional)")
    ] = None
    """Record the drive into this file."""
    record_images: Switch = False
    """Record the cameras' images too, as JPEG."""
    view: Switch = False
    """Open Rerun and look on. Needs the extra viz."""
    duration_s: Annotated[
        float | None,
        tyro.conf.arg(metavar="S", help_behavior_hint="(default: until the last waypoint)"),
    ] = None
    """End after this time, s."""
    period_s: float = 0.02
    """Between two readings of the odometer, s."""
    timeout_s: float = 0.2
    """So long after the last sign of life of any thread the vehicle has been stopped, s."""
    float64: Switch = False
    """Estimate in double precision."""
    seed: int = 0
    """Of a simulated vehicle."""
    headless: Switch = False
    """No status line."""

    def __post_init__(self) -> None:
        require(self.seed >= 0, "--seed", f"must not be negative, got {self.seed}")
        require(
            0.002 <= self.period_s <= 0.1,
            "--period-s",
            f"must be from 0.002 to 0.1, got {self.period_s}",
        )
        require(
            0.1 <= self.timeout_s <= 10,
            "--timeout-s",
            f"must be from 0.1 to 10, got {self.timeout_s}",
        )
        if self.duration_s is not None:
            require_finite("--duration-s", self.duration_s)
        require(
            self.record is not None or not self.record_images, "--record-images", "needs --record"
        )


@dataclass(frozen=True)
class Doctor:
    """Check what a car will run with, and say what to do about each finding.

    Looked at are the computer (packages, OpenCV, JAX, clock, disk), the four files, pictures that
    the car's cameras took while it stood, and the plug-ins, which are opened and read but not
    driven. Exit code 0: no error; 1: an error was found; 2: a file or a flag is not understood.
    """

    rig: QCarFile = None
    """Cameras: a rig file or a Kalibr camchain."""
    markers: QCarFile = None
    """Marker map."""
    vehicle_file: QCarFile = None
    """Vehicle parameters and limits."""
    route: QCarFile = None
    """Start and waypoints."""
    vehicle: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME", constructor=str, help_behavior_hint="(optional)"),
    ] = None
    """Vehicle plug-in to open and read: an installed name or module:name."""
    cameras: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME", constructor=str, help_behavior_hint="(optional)"),
    ] = None
    """Camera plug-in to open and read: an installed name or module:name."""
    option: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="KEY=VALUE", help_behavior_hint="(repeatable)"),
    ] = ()
    """What the plug-ins are told."""
    frame: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]],
        tyro.conf.arg(metavar="CAMERA=IMAGE", help_behavior_hint="(repeatable)"),
    ] = ()
    """A picture by one of the rig's cameras, the car standing anywhere with a marker in view."""
    drive: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE.mcap", help_behavior_hint="(optional)")
    ] = None
    """A recorded drive with eights, or stops and starts: are the cameras later than they say?"""
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")] = (
        None
    )
    """Write all findings into this file too."""

    def __post_init__(self) -> None:
        for flag, texts in (("--option", self.option), ("--frame", self.frame)):
            expected = "KEY=VALUE" if flag == "--option" else "CAMERA=IMAGE"
            keys = [text.partition("=")[0] for text in texts]
            for text, key in zip(texts, keys, strict=True):
                require("=" in text and key != "", flag, f"expected {expected}, got {text!r}")
                require(keys.count(key) == 1, flag, f"{key} is given twice")
