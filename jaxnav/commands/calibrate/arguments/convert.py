"""What `jaxnav calibrate convert` can be told."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.commands.kinds import require, require_finite, require_within

CalibrationFormat = Literal["jaxnav", "kalibr", "ros", "opencv", "photonvision", "wpilib"]
WPILibFamily = Literal["tag16h5", "tag25h9", "tag36h11"]

_OPTIONAL = "(optional)"


@dataclass(frozen=True)
class CalibrateConvert:
    """Convert cameras and marker maps between jaxnav's files and those of other tools.

    Which tool wrote SOURCE, its keys tell. Numbers are carried over as they are written; what the
    other format can't hold is refused, and what it does not carry is told.
    """

    source: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="SOURCE")]
    """jaxnav's rig or marker map, Kalibr's camchain, ROS's camera_info, OpenCV's FileStorage,
    PhotonVision's or WPILib's JSON."""
    to: CalibrationFormat
    """What to write: wpilib takes a marker map, the others cameras, jaxnav both."""
    out: Annotated[Path, tyro.conf.arg(metavar="FILE|DIR")]
    """The file (.json of photonvision and wpilib, else .yaml); of several cameras, where each has
    one of its own, their folder."""
    camera_name: Annotated[
        str | None, tyro.conf.arg(metavar="NAME", help_behavior_hint=_OPTIONAL)
    ] = None
    """Which camera, where SOURCE has several; what to call it, where SOURCE has one."""
    position_m: Annotated[
        tuple[float, float, float] | None,
        tyro.conf.arg(metavar="X Y Z", help_behavior_hint=_OPTIONAL),
    ] = None
    """Where the camera is on the vehicle, if SOURCE does not say so: forward, left, up."""
    yaw_deg: float = 0.0
    """With --position-m: 0 looks forward, 90 to the left."""
    elevation_deg: float = 0.0
    """With --position-m: positive looks up."""
    roll_deg: float = 0.0
    """With --position-m: positive is clockwise as seen from behind the camera."""
    marker_size_m: Annotated[
        float | None,
        tyro.conf.arg(metavar="FLOAT", help_behavior_hint="(default: FIRST's, 0.1651)"),
    ] = None
    """Side of the black square of every tag in a WPILib layout, which does not tell."""
    family: Annotated[
        WPILibFamily | None,
        tyro.conf.arg(
            metavar="{tag16h5,tag25h9,tag36h11}",
            help_behavior_hint="(default: FIRST's, tag36h11)",
        ),
    ] = None
    """Of the tags in a WPILib layout, which does not tell."""
    field_size_m: Annotated[
        tuple[float, float] | None,
        tyro.conf.arg(metavar="LENGTH WIDTH", help_behavior_hint="(default: what the map spans)"),
    ] = None
    """Of the field in a WPILib layout to be written."""

    def __post_init__(self) -> None:
        for flag, angle_deg in (
            ("--yaw-deg", self.yaw_deg),
            ("--elevation-deg", self.elevation_deg),
            ("--roll-deg", self.roll_deg),
        ):
            require_within(flag, angle_deg, "angle_deg")
            require(self.position_m is not None or angle_deg == 0, flag, "needs --position-m")
        for coordinate in self.position_m or ():
            require_within("--position-m", coordinate, "position_m")
        for size_m in self.field_size_m or ():
            require_finite("--field-size-m", size_m)
        require(self.camera_name != "", "--camera-name", "must not be empty")
        if self.marker_size_m is not None:
            require_within("--marker-size-m", self.marker_size_m, "size_m")
