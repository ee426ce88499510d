"""Arguments of `jaxnav calibrate`."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro
from annotated_types import Ge, Interval

from jaxnav.commands import kinds
from jaxnav.commands.kinds import flag_of, optional, require

CalibrationFormat = Literal["jaxnav", "kalibr", "ros", "opencv", "photonvision", "wpilib"]
WPILibFamily = Literal["tag16h5", "tag25h9", "tag36h11"]

_Angle = Annotated[float, kinds.Within("angle_deg")]
_Place = Annotated[float, kinds.Within("position_m")]
_NAMED = re.compile(r"([A-Za-z_][\w.\-]{0,99})=(.+)")
_Count = Annotated[int | None, optional("INT", "(default: as the target and the paper suggest)")]
Recordings = Annotated[
    tyro.conf.Positional[tuple[Path, ...]],
    tyro.conf.arg(
        metavar="RECORDING",
        help="Drives (.mcap), folders of TagSLAM, .npz, ROS 1 bags with --rig.",
    ),
]
MarkerSize = Annotated[
    kinds.SizeM | None,
    tyro.conf.arg(
        metavar="S",
        constructor=float,
        help_behavior_hint="(default: as of the known ones)",
        help="Side of the markers that are not in that file.",
    ),
]
Family = Annotated[
    str | None,
    optional(
        "NAME",
        "(default: the map's, or tag36h11)",
        str,
        "Marker family, where the recording does not tell.",
    ),
]
OdometryParameter = Literal[
    "speed_scale", "steering_gain", "steering_offset_rad", "wheelbase_m", "camera_delay_s"
]
_RecordedFile = Annotated[Path | None, optional("FILE", "(default: the recording's)")]


@dataclass(frozen=True)
class CalibrateBoard:
    """Print a calibration target at true scale, with rulers on it to check the print.

    A charuco board is the best for a single camera: it may be cut off by the image's edge, so its
    points reach the corners. An aprilgrid does the same and is what Kalibr takes.

    Written to --out: board.pdf and board.png, either of which is to be printed at 100 %;
    board.yaml, which `jaxnav calibrate intrinsics --board` takes; report.json.
    """

    target: tyro.conf.Positional[Literal["charuco", "aprilgrid", "chessboard", "marker"]]
    """What is printed."""
    paper: Annotated[str, tyro.conf.arg(metavar="{a4,a3,letter,WxH}")] = "a4"
    """The paper, or its width and height in mm, as in 600x400."""
    landscape: kinds.Switch = False
    """The paper's longer side lies."""
    columns: _Count = None
    """Squares or tags side by side."""
    rows: _Count = None
    """Squares or tags one above the other."""
    size_m: Annotated[
        kinds.Positive | None, optional("FLOAT", "(default: the largest round size that fits)")
    ] = None
    """Side of a square, or of the black outline of a tag or marker, m."""
    marker_size_m: Annotated[
        kinds.Positive | None, optional("FLOAT", "(default: a cell of white around it)")
    ] = None
    """Of a charuco board, the side of its markers, m."""
    spacing: Annotated[float, Interval(gt=-math.inf, lt=math.inf)] = 0.3
    """Of an aprilgrid, the gap between tags in sides of a tag: Kalibr's tagSpacing."""
    family: Annotated[str | None, optional("NAME", "(default: 4x4 for charuco, else tag36h11)")] = (
        None
    )
    """Of the markers: tag36h11, 4x4_50, 6x6_250, ..."""
    first_id: int = 0
    """Of the markers, which are numbered on from there."""
    border_cells: int = 2
    """Of an aprilgrid, how wide the tags' black frame is; Kalibr reads 2."""
    dpi: Annotated[int, Interval(ge=50, le=2400)] = 300
    """Pixels an inch of the PNG."""
    out: kinds.ResultsFolder = Path("calibrated")

    def __post_init__(self) -> None:
        named = self.paper.lower() in ("a4", "a3", "letter")
        known = named or self.paper_size_mm is not None
        require(
            known, "--paper", f"must be a4, a3, letter or WxH in mm (600x400), got {self.paper}"
        )
        if self.paper_size_mm is not None:
            fits = all(50 <= side <= 5000 for side in self.paper_size_mm)
            require(fits, "--paper", f"must be from 50 to 5000 mm a side, got {self.paper}")
        charuco = self.target == "charuco" or self.marker_size_m is None
        require(charuco, "--marker-size-m", f"goes with charuco, not with {self.target}")
        alone = self.target != "marker" or (self.columns is None and self.rows is None)
        require(alone, "--columns", "and --rows go with boards, not with a single marker")
        pair = self.marker_size_m is None or self.size_m is not None
        require(pair, "--marker-size-m", "needs --size-m")

    @property
    def paper_size_mm(self) -> tuple[float, float] | None:
        """Width and height where they are given in mm."""
        match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)(?:mm)?", self.paper.lower())
        return (float(match[1]), float(match[2])) if match else None


@dataclass(frozen=True)
class CalibrateIntrinsics:
    """Find a camera's focal length, centre and lens from pictures of a board.

    Show the camera a board of `jaxnav calibrate board`: 20 to 40 pictures or a slow video, tilted
    by 30 to 45 degrees to all sides, near enough to fill much of the image, and up to its corners.
    Blurred and wrong views are found, left out and named. What the pictures don't tell is refused,
    or held at zero and named. The size of the board has no part in this; that its squares are
    square and as many as its file says has.

    Written to --out: camera.yaml, a rig file with the cameras, which `jaxnav calibrate rig` and
    jaxnav locate take; report.json with every parameter's sigma; report.png.
    """

    sources: Annotated[
        tyro.conf.Positional[tuple[Path, ...]],
        tyro.conf.arg(metavar="SOURCE", help_behavior_hint="(required)"),
    ]
    """Images, folders of images, videos. Of several cameras at once: front=DIR left=DIR ..."""
    board: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The board: board.yaml of `jaxnav calibrate board`, or Kalibr's."""
    lens: Literal["auto", "radtan", "equidistant", "omni", "double_sphere", "eucm", "none"] = "auto"
    """The lens model; auto takes radtan, equidistant or none, whichever explains pictures best that
    it was not fitted to."""
    name: str = "camera"
    """Of the camera, where the sources don't say it."""
    max_views: Annotated[int, Ge(8)] = 100
    """Of more views those are taken that tell most about the lens."""
    rig: kinds.OptionalFile = None
    """A rig file that says where the cameras are; its other cameras go along unchanged."""
    out: kinds.ResultsFolder = Path("calibrated")
    headless: kinds.Headless = False

    def __post_init__(self) -> None:
        require(bool(self.sources), "SOURCE", "give images, a folder of images or a video")
        require(
            _NAMED.fullmatch(f"{self.name}=x") is not None,
            "--name",
            f"must be a name (a letter first, then letters, digits and _ - .), got {self.name!r}",
        )
        named = [_NAMED.fullmatch(str(source)) is not None for source in self.sources]
        require(
            all(named) or not any(named),
            "SOURCE",
            "give every source as NAME=PATH, or none of them",
        )

    @property
    def by_camera(self) -> dict[str, tuple[Path, ...]]:
        """The sources of every camera, in the order they were given in."""
        paths: dict[str, tuple[Path, ...]] = {}
        for source in self.sources:
            match = _NAMED.fullmatch(str(source))
            name, path = match.groups() if match else (self.name, source)
            paths[name] = (*paths.get(name, ()), Path(path))
        return paths


@dataclass(frozen=True)
class CalibrateAdopt:
    """Write what a drive has learnt of its cameras and sensors into a new rig and a new vehicle.

    While it drives, the estimator learns by how much each camera is turned, and how far the
    odometer, the steering and the cameras' stamps are off, as far as the drive tells; it never
    changes a file. What the drive did not tell stays as it was, with its sigma.

    Written to --out: rig.yaml and vehicle.yaml, which demo, run and replay take; report.png, each
    error over the drive; report.json.
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """A drive recorded by `jaxnav run --record` (.mcap)."""
    rig: _RecordedFile = None
    """The rig that it was driven with, for figures that a recording does not hold."""
    vehicle: _RecordedFile = None
    """The vehicle that it was driven with."""
    out: kinds.ResultsFolder = Path("adopted")
    headless: kinds.Headless = False


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
    camera_name: Annotated[str | None, optional("NAME")] = None
    """Which camera, where SOURCE has several; what to call it, where SOURCE has one."""
    position_m: Annotated[tuple[_Place, _Place, _Place] | None, optional("X Y Z")] = None
    """Where the camera is on the vehicle, if SOURCE does not say so: forward, left, up."""
    yaw_deg: _Angle = 0.0
    """With --position-m: 0 looks forward, 90 to the left."""
    elevation_deg: _Angle = 0.0
    """With --position-m: positive looks up."""
    roll_deg: _Angle = 0.0
    """With --position-m: positive is clockwise as seen from behind the camera."""
    marker_size_m: Annotated[
        kinds.SizeM | None, optional("FLOAT", "(default: FIRST's, 0.1651)")
    ] = None
    """Side of the black square of every tag in a WPILib layout, which does not tell."""
    family: Annotated[
        WPILibFamily | None, optional("{tag16h5,tag25h9,tag36h11}", "(default: FIRST's, tag36h11)")
    ] = None
    """Of the tags in a WPILib layout, which does not tell."""
    field_size_m: Annotated[
        tuple[kinds.Positive, kinds.Positive] | None,
        optional("LENGTH WIDTH", "(default: what the map spans)"),
    ] = None
    """Of the field in a WPILib layout to be written."""

    def __post_init__(self) -> None:
        for name in ("yaw_deg", "elevation_deg", "roll_deg"):
            placed = self.position_m is not None or getattr(self, name) == 0
            require(placed, flag_of(name), "needs --position-m")
        require(self.camera_name != "", "--camera-name", "must not be empty")


@dataclass(frozen=True)
class _Seen:
    """Arguments shared by rig, markers and check."""

    recordings: Recordings

    def __post_init__(self) -> None:
        require(len(self.recordings) > 0, "RECORDING", "missing: what has the rig seen?")


@dataclass(frozen=True)
class CalibrateRig(_Seen):
    """Find where the cameras of a rig are, without common views, and the markers with them.

    Drive or carry the rig past markers, so that one camera after another sees them; two markers in
    view now and then, by any cameras, link everything. No start is needed: both poses of every
    sighting are weighed until all frames agree, then all poses are adjusted at once, and sightings
    that nothing explains count less.

    Written to --out: rig.yaml and markers.yaml, which every other command takes, with sigmas;
    report.json; report.png; trajectory.tum.
    """

    rig: kinds.OptionalFile = None
    """Cameras: their lenses, and about where they are, in place of the recording's own."""
    markers: kinds.OptionalFile = None
    """Markers whose places are known, one at least: they tie the world down. By default those that
    a drive brings along; without any the world is the frame of the marker seen most."""
    marker_size_m: MarkerSize = None
    family: Family = None
    refine_lenses: kinds.Switch = False
    """Adjust focal lengths, centres and lenses as well, from where the rig has them."""
    vehicle_frame: Annotated[str, tyro.conf.arg(metavar="places|drive|CAMERA")] = "places"
    """What ties the vehicle frame down: the given places of all cameras together; a drive with
    straight lines and circles; or the given place of one camera."""
    vehicle: kinds.QCarFile = None
    """Vehicle file, whose wheelbase a drive needs."""
    out: kinds.ResultsFolder = Path("calibrated")


@dataclass(frozen=True)
class CalibrateMarkers(_Seen):
    """Find where the markers are, with a rig that is calibrated.

    As `calibrate rig`, but the cameras stay where the rig file has them.

    Written to --out: markers.yaml with sigmas; report.json; report.png; trajectory.tum.
    """

    rig: kinds.OptionalFile = None
    """Cameras, in place of the recording's own."""
    markers: kinds.OptionalFile = None
    """Markers whose places are known, one at least. By default those that a drive brings along;
    without any the world is the frame of the marker seen most."""
    marker_size_m: MarkerSize = None
    family: Family = None
    out: kinds.ResultsFolder = Path("calibrated")


@dataclass(frozen=True)
class CalibrateCheck(_Seen):
    """Find markers that are not where the map says.

    All markers are looked for anew, with a rig that is calibrated. The map is laid over what was
    found so that as many as can agree; the others have moved, or were entered wrongly. The exit
    code is 1 where there is one.

    Written to --out: markers.yaml, the map as it was found; report.json; report.png.
    """

    rig: kinds.OptionalFile = None
    """Cameras, in place of the recording's own."""
    markers: kinds.OptionalFile = None
    """Map to be checked, in place of the one that a drive brings along."""
    family: Family = None
    tolerance_m: kinds.Positive = 0.02
    """A marker that is no further off than this, and no more than its sigma explains, is right."""
    tolerance_deg: kinds.Positive = 3.0
    """The same for how it is turned."""
    out: kinds.ResultsFolder = Path("checked")


@dataclass(frozen=True)
class CalibrateCompare:
    """Draw where two calibrations of a camera differ, over its image.

    A ray of the first file's camera is drawn by the second's, which is turned so that as little
    as possible is left: the place of a camera makes up for such a turn. Cameras are compared by
    name; of two files with one camera each, these.

    Written to --out: report.png, a map for each camera; report.json.
    """

    one: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """Calibration: a rig file, a Kalibr camchain, or what convert reads."""
    other: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    """Another one."""
    out: kinds.ResultsFolder = Path("compared")


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
    markers: _RecordedFile = None
    """Marker map."""
    vehicle: _RecordedFile = None
    """The vehicle as it stands: limits, wheelbase, and where the search starts."""
    topics: kinds.OptionalFile = None
    """Which topic of a ROS bag is what."""
    corner_backend: kinds.CornerBackend = "aruco"
    """Who finds the markers in a ROS bag's images."""
    fix: Annotated[tuple[OdometryParameter, ...], tyro.conf.arg(help_behavior_hint="")] = ()
    """What is not looked for: it stays as it is in --vehicle."""
    wheelbase_sigma_m: Annotated[kinds.SizeM | None, optional("M")] = None
    """How well the wheelbase in --vehicle was measured; by default nothing is known of it."""
    out: kinds.ResultsFolder = Path("calibrated")
    headless: kinds.Headless = False

    def __post_init__(self) -> None:
        require(bool(self.recordings), "RECORDING", "names no recording")
        if self.wheelbase_sigma_m is not None:
            problem = "goes with a wheelbase that is looked for: leave it out of --fix"
            require("wheelbase_m" not in self.fix, "--wheelbase-sigma-m", problem)
