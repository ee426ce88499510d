"""What `jaxnav calibrate odometry` can be told."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.commands.kinds import CornerBackend, Switch, require, require_within

OdometryParameter = Literal[
    "speed_scale", "steering_gain", "steering_offset_rad", "wheelbase_m", "camera_delay_s"
]
_RecordedFile = Annotated[
    Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(default: the recording's)")
]


@dataclass(frozen=True)
class CalibrateOdometry:
    """Find the scale of the speed, the steering's gain and offset, wheelbase and cameras' delay.

    From drives past markers whose places are known: eights in front of one, at full lock and half,
    at several speeds, with stops between. A minute suffices. What the drives don't tell is kept as
    it was, and named.

    Written to --out: vehicle.yaml, which demo, run and replay take; report.png; report.json.
    """

    recordings: Annotated[
        tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RECORDING")
    ]
    """Drives recorded by `jaxnav run --record` (.mcap), or ROS bags with --topics."""
    rig: _RecordedFile = None
    """Cameras: a rig file or a Kalibr camchain."""
    markers_file: _RecordedFile = None
    """Marker map."""
    vehicle: _RecordedFile = None
    """The vehicle as it stands: limits, wheelbase, and where the search starts."""
    topics: Annotated[
        Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")
    ] = None
    """Which topic of a ROS bag is what."""
    corner_backend: CornerBackend = "aruco"
    """Who finds the markers in a ROS bag's images."""
    fix: Annotated[tuple[OdometryParameter, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    """What is not looked for: it stays as it is in --vehicle."""
    wheelbase_sigma_m: Annotated[
        float | None, tyro.conf.arg(metavar="M", help_behavior_hint="(optional)")
    ] = None
    """How well the wheelbase in --vehicle was measured; by default nothing is known of it."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("calibrated")
    """Folder for the results."""
    headless: Switch = False
    """No progress bar."""

    def __post_init__(self) -> None:
        require(bool(self.recordings), "RECORDING", "names no recording")
        if self.wheelbase_sigma_m is not None:
            require_within("--wheelbase-sigma-m", self.wheelbase_sigma_m, "size_m")
            told = "goes with a wheelbase that is looked for: leave it out of --fix"
            require("wheelbase_m" not in self.fix, "--wheelbase-sigma-m", told)
