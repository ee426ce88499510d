"""What `jaxnav calibrate` can be told: one file for each of its commands."""

from dataclasses import dataclass
from typing import Annotated

import tyro

from jaxnav.arguments.calibration.boards import CalibrateBoard
from jaxnav.arguments.calibration.check import CalibrateCheck
from jaxnav.arguments.calibration.convert import CalibrateConvert
from jaxnav.arguments.calibration.intrinsics import CalibrateIntrinsics
from jaxnav.arguments.calibration.markers import CalibrateMarkers
from jaxnav.arguments.calibration.odometry import CalibrateOdometry
from jaxnav.arguments.calibration.rig import CalibrateRig

__all__ = [
    "CALIBRATIONS",
    "Calibrate",
    "CalibrateBoard",
    "CalibrateCheck",
    "CalibrateConvert",
    "CalibrateIntrinsics",
    "CalibrateMarkers",
    "CalibrateOdometry",
    "CalibrateRig",
]

_What = (
    Annotated[CalibrateBoard, tyro.conf.subcommand("board")]
    | Annotated[CalibrateIntrinsics, tyro.conf.subcommand("intrinsics")]
    | Annotated[CalibrateRig, tyro.conf.subcommand("rig")]
    | Annotated[CalibrateMarkers, tyro.conf.subcommand("markers")]
    | Annotated[CalibrateCheck, tyro.conf.subcommand("check")]
    | Annotated[CalibrateOdometry, tyro.conf.subcommand("odometry")]
    | Annotated[CalibrateConvert, tyro.conf.subcommand("convert")]
)
CALIBRATIONS = {
    "board": CalibrateBoard,
    "intrinsics": CalibrateIntrinsics,
    "rig": CalibrateRig,
    "markers": CalibrateMarkers,
    "check": CalibrateCheck,
    "odometry": CalibrateOdometry,
    "convert": CalibrateConvert,
}


@dataclass(frozen=True)
class Calibrate:
    """Calibrate your own car: cameras, their places, markers, odometry."""

    what: Annotated[_What, tyro.conf.arg(name="")]
    """What is calibrated."""
