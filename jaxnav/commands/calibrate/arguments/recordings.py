"""What those of `jaxnav calibrate` can be told that read recordings."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.commands.kinds import (
    CornerBackend,
    Headless,
    OptionalFile,
    QCarFile,
    ResultsFolder,
    Switch,
    optional,
    require,
    require_finite,
    require_within,
)

Recordings = Annotated[
    tyro.conf.Positional[tuple[Path, ...]],
    tyro.conf.arg(
        metavar="RECORDING",
        help="Drives (.mcap), folders of TagSLAM, .npz, ROS 1 bags with --rig.",
    ),
]
MarkerSize = Annotated[
    float | None,
    tyro.conf.arg(
        metavar="S",
        constructor=float,
        help_behavior_hint="(default: as of the known ones)",
        help="Side of the markers that are not in that file.",
    ),
]
Family = Annotated[str, tyro.conf.arg(help="Marker family, where the recording does not tell.")]
OdometryParameter = Literal[
    "speed_scale", "steering_gain", "steering_offset_rad", "wheelbase_m", "camera_delay_s"
]
_RecordedFile = Annotated[Path | None, optional("FILE", "(default: the recording's)")]


def _require_inputs(recordings: tuple[Path, ...], marker_size_m: float | None = None) -> None:
    """Raise BadInput where there is none, or where markers are of no size."""
    require(len(recordings) > 0, "RECORDING", "missing: what has the rig seen?")
    if marker_size_m is not None:
        require_within("--marker-size-m", marker_size_m, "size_m")


@dataclass(frozen=True)
class CalibrateRig:
    """Find where the cameras of a rig are, without common views, and the markers with them.

    Drive or carry the rig past markers, so that one camera after another sees them; two markers in
    view now and then, by any cameras, link everything. No start is needed: both poses of every
    sighting are weighed until all frames agree, then all poses are adjusted at once, and sightings
    that nothing explains count less.

    Written to --out: rig.yaml and markers.yaml, which every other command takes, with sigmas;
    report.json; report.png; trajectory.tum.
    """

    recordings: Recordings
    rig: OptionalFile = None
    """Cameras: their lenses, and about where they are, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Markers whose places are known, one at least: they tie the world down. By default those that
    a drive brings along; without any the world is the frame of the marker seen most."""
    marker_size_m: MarkerSize = None
    family: Family = "tag36h11"
    refine_lenses: Switch = False
    """Adjust focal lengths, centres and lenses as well, from where the rig has them."""
    vehicle_frame: Annotated[str, tyro.conf.arg(metavar="places|drive|CAMERA")] = "places"
    """What ties the vehicle frame down: the given places of all cameras together; a drive with
    straight lines and circles; or the given place of one camera."""
    vehicle: QCarFile = None
    """Vehicle file, whose wheelbase a drive needs."""
    out: ResultsFolder = Path("calibrated")

    def __post_init__(self) -> None:
        _require_inputs(self.recordings, self.marker_size_m)


@dataclass(frozen=True)
class CalibrateMarkers:
    """Find where the markers are, with a rig that is calibrated.

    As `calibrate rig`, but the cameras stay where the rig file has them.

    Written to --out: markers.yaml with sigmas; report.json; report.png; trajectory.tum.
    """

    recordings: Recordings
    rig: OptionalFile = None
    """Cameras, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Markers whose places are known, one at least. By default those that a drive brings along;
    without any the world is the frame of the marker seen most."""
    marker_size_m: MarkerSize = None
    family: Family = "tag36h11"
    out: ResultsFolder = Path("calibrated")

    def __post_init__(self) -> None:
        _require_inputs(self.recordings, self.marker_size_m)


@dataclass(frozen=True)
class CalibrateCheck:
    """Find markers that are not where the map says.

    All markers are looked for anew, with a rig that is calibrated. The map is laid over what was
    found so that as many as can agree; the others have moved, or were entered wrongly. The exit
    code is 1 where there is one.

    Written to --out: markers.yaml, the map as it was found; report.json; report.png.
    """

    recordings: Recordings
    rig: OptionalFile = None
    """Cameras, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Map to be checked, in place of the one that a drive brings along."""
    family: Family = "tag36h11"
    tolerance_m: float = 0.02
    """A marker that is no further off than this, and no more than its sigma explains, is right."""
    tolerance_deg: float = 3.0
    """The same for how it is turned."""
    out: ResultsFolder = Path("checked")

    def __post_init__(self) -> None:
        _require_inputs(self.recordings)
        require_finite("--tolerance-m", self.tolerance_m)
        require_finite("--tolerance-deg", self.tolerance_deg)


@dataclass(frozen=True)
class CalibrateOdometry(Headless):
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
    topics: OptionalFile = None
    """Which topic of a ROS bag is what."""
    corner_backend: CornerBackend = "aruco"
    """Who finds the markers in a ROS bag's images."""
    fix: Annotated[tuple[OdometryParameter, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    """What is not looked for: it stays as it is in --vehicle."""
    wheelbase_sigma_m: Annotated[float | None, optional("M")] = None
    """How well the wheelbase in --vehicle was measured; by default nothing is known of it."""
    out: ResultsFolder = Path("calibrated")

    def __post_init__(self) -> None:
        require(bool(self.recordings), "RECORDING", "names no recording")
        if self.wheelbase_sigma_m is not None:
            require_within("--wheelbase-sigma-m", self.wheelbase_sigma_m, "size_m")
            problem = "goes with a wheelbase that is looked for: leave it out of --fix"
            require("wheelbase_m" not in self.fix, "--wheelbase-sigma-m", problem)
