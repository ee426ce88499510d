"""What `jaxnav calibrate board`, `intrinsics` and `convert` can be told."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.commands.kinds import (
    Headless,
    OptionalFile,
    ResultsFolder,
    Switch,
    optional,
    require,
    require_finite,
    require_within,
)

CalibrationFormat = Literal["jaxnav", "kalibr", "ros", "opencv", "photonvision", "wpilib"]
WPILibFamily = Literal["tag16h5", "tag25h9", "tag36h11"]

_NAMED = re.compile(r"([A-Za-z_][\w.\-]{0,99})=(.+)")
_Count = Annotated[int | None, optional("INT", "(default: as the target and the paper suggest)")]


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
    landscape: Switch = False
    """The paper's longer side lies."""
    columns: _Count = None
    """Squares or tags side by side."""
    rows: _Count = None
    """Squares or tags one above the other."""
    size_mm: Annotated[
        float | None, optional("FLOAT", "(default: the largest round size that fits)")
    ] = None
    """Side of a square, or of the black outline of a tag or marker."""
    marker_mm: Annotated[
        float | None, optional("FLOAT", "(default: a cell of white around it)")
    ] = None
    """Of a charuco board, the side of its markers."""
    spacing: float = 0.3
    """Of an aprilgrid, the gap between tags in sides of a tag: Kalibr's tagSpacing."""
    family: Annotated[str | None, optional("NAME", "(default: 4x4 for charuco, else tag36h11)")] = (
        None
    )
    """Of the markers: tag36h11, 4x4_50, 6x6_250, ..."""
    first_id: int = 0
    """Of the markers, which are numbered on from there."""
    border_cells: int = 2
    """Of an aprilgrid, how wide the tags' black frame is; Kalibr reads 2."""
    dpi: int = 300
    """Pixels an inch of the PNG."""
    out: ResultsFolder = Path("calibrated")

    def __post_init__(self) -> None:
        named = self.paper.lower() in ("a4", "a3", "letter")
        known = named or self.paper_size_mm is not None
        require(
            known, "--paper", f"must be a4, a3, letter or WxH in mm (600x400), got {self.paper}"
        )
        if self.paper_size_mm is not None:
            fits = all(50 <= side <= 5000 for side in self.paper_size_mm)
            require(fits, "--paper", f"must be from 50 to 5000 mm a side, got {self.paper}")
        for flag, value in (("--size-mm", self.size_mm), ("--marker-mm", self.marker_mm)):
            if value is not None:
                require_finite(flag, value)
        charuco = self.target == "charuco" or self.marker_mm is None
        require(charuco, "--marker-mm", f"goes with charuco, not with {self.target}")
        alone = self.target != "marker" or (self.columns is None and self.rows is None)
        require(alone, "--columns", "and --rows go with boards, not with a single marker")
        pair = self.marker_mm is None or self.size_mm is not None
        require(pair, "--marker-mm", "needs --size-mm")
        require(math.isfinite(self.spacing), "--spacing", f"must be finite, got {self.spacing}")
        require(50 <= self.dpi <= 2400, "--dpi", f"must be from 50 to 2400, got {self.dpi}")

    @property
    def paper_size_mm(self) -> tuple[float, float] | None:
        """Width and height where they are given in mm."""
        match = re.fullmatch(r"(\d+(?:\.\d+)?)x(\d+(?:\.\d+)?)(?:mm)?", self.paper.lower())
        return (float(match[1]), float(match[2])) if match else None


@dataclass(frozen=True)
class CalibrateIntrinsics(Headless):
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
        tyro.conf.Positional[tuple[str, ...]],
        tyro.conf.arg(metavar="SOURCE", help_behavior_hint="(required)"),
    ]
    """Images, folders of images, videos. Of several cameras at once: front=DIR left=DIR ..."""
    board: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """The board: board.yaml of `jaxnav calibrate board`, or Kalibr's."""
    lens: Literal["auto", "radtan", "equidistant", "none"] = "auto"
    """The lens model; auto takes whichever explains pictures best that it was not fitted to."""
    name: str = "camera"
    """Of the camera, where the sources don't say it."""
    max_views: int = 100
    """Of more views those are taken that tell most about the lens."""
    rig: OptionalFile = None
    """A rig file that says where the cameras are; its other cameras go along unchanged."""
    out: ResultsFolder = Path("calibrated")

    def __post_init__(self) -> None:
        require(bool(self.sources), "SOURCE", "give images, a folder of images or a video")
        require(self.max_views >= 8, "--max-views", f"must be at least 8, got {self.max_views}")
        require(
            _NAMED.fullmatch(f"{self.name}=x") is not None,
            "--name",
            f"must be a name (a letter first, then letters, digits and _ - .), got {self.name!r}",
        )
        named = [_NAMED.fullmatch(source) is not None for source in self.sources]
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
            match = _NAMED.fullmatch(source)
            name, path = match.groups() if match else (self.name, source)
            paths[name] = (*paths.get(name, ()), Path(path))
        return paths


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
    position_m: Annotated[tuple[float, float, float] | None, optional("X Y Z")] = None
    """Where the camera is on the vehicle, if SOURCE does not say so: forward, left, up."""
    yaw_deg: float = 0.0
    """With --position-m: 0 looks forward, 90 to the left."""
    elevation_deg: float = 0.0
    """With --position-m: positive looks up."""
    roll_deg: float = 0.0
    """With --position-m: positive is clockwise as seen from behind the camera."""
    marker_size_m: Annotated[float | None, optional("FLOAT", "(default: FIRST's, 0.1651)")] = None
    """Side of the black square of every tag in a WPILib layout, which does not tell."""
    family: Annotated[
        WPILibFamily | None, optional("{tag16h5,tag25h9,tag36h11}", "(default: FIRST's, tag36h11)")
    ] = None
    """Of the tags in a WPILib layout, which does not tell."""
    field_size_m: Annotated[
        tuple[float, float] | None, optional("LENGTH WIDTH", "(default: what the map spans)")
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
