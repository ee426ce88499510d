"""What the commands that read recordings and photographs can be told."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from jaxnav.arguments.kinds import (
    CornerBackend,
    OptionalFile,
    Selector,
    Switch,
    require,
    require_within,
)


@dataclass(frozen=True)
class Replay:
    """Drive a recorded drive again, or localise a recorded camera rig in every frame.

    A drive is a .mcap of `jaxnav`, or a ROS bag with --topics, --rig, --markers-file, --vehicle and
    --route. A .mcap with nothing changed is held against what was recorded, and the exit code is 1
    where it differs.

    A rig is localised in 6 degrees of freedom from a folder with bags and their calibration as
    TagSLAM writes it, a ROS 1 bag with --rig and --markers-file, or an .npz of detections. Where
    there is a reference trajectory the errors against it are measured.

    Written to --out: a TUM trajectory, summary.json, and a PNG where something is to be compared.
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Drive (.mcap), ROS bag, folder of TagSLAM or .npz."""
    rig: OptionalFile = None
    """Cameras, a rig file or a Kalibr camchain, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Marker map in place of the recording's own."""
    vehicle: OptionalFile = None
    """Vehicle in place of the drive's own."""
    route: OptionalFile = None
    """Waypoints in place of the drive's own."""
    params: OptionalFile = None
    """Tuned parameters, of a drive in place of all of its own; --corner-sigma-px goes before."""
    topics: OptionalFile = None
    """Which topic of a ROS bag is what: it is a drive then."""
    images: Switch = False
    """Look for the markers once more in the drive's recorded images."""
    corner_backend: CornerBackend = "aruco"
    """Marker detector, for images. apriltag needs the extra of that name."""
    record: Switch = False
    """Record the drive anew, as replay.mcap."""
    markers: Literal["all", "one-at-a-time"] = "all"
    """One pose from all markers in view, or every marker alone as in the paper."""
    selector: Annotated[
        Selector | None,
        tyro.conf.arg(help_behavior_hint="(default: the drive's, or multi-hypothesis)"),
    ] = None
    """Which of the two poses of a marker is believed."""
    corner_sigma_px: Annotated[
        float | None,
        tyro.conf.arg(metavar="PX", help_behavior_hint="(default: as the recording tells)"),
    ] = None
    """Standard deviation of a corner coordinate."""
    limit: Annotated[
        int | None,
        tyro.conf.arg(metavar="N", constructor=int, help_behavior_hint="(default: all)"),
    ] = None
    """Stop after N frames, of a drive after N inputs."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("out")
    """Folder for the results."""
    headless: Switch = False
    """No progress bar."""

    def __post_init__(self) -> None:
        if self.limit is not None:
            require(self.limit >= 1, "--limit", f"must be at least 1, got {self.limit}")
        if self.corner_sigma_px is not None:
            require_within("--corner-sigma-px", self.corner_sigma_px, "corner_sigma_px")


@dataclass(frozen=True)
class View:
    """Look at a recorded drive in Rerun: map, cameras, candidates, health, over time.

    Opens a window, or writes an .rrd file to --out. Needs the extra `viz`.
    """

    recording: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="RECORDING")]
    """Recorded drive (.mcap)."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE", help_behavior_hint="(optional)")] = (
        None
    )
    """Write this file (.rrd) instead of opening a window."""
    headless: Switch = False
    """No progress bar."""


@dataclass(frozen=True)
class Locate:
    """Find markers in a photograph and print both poses of each.

    With each marker: reprojection errors, their ratio, the probability that the better pose is
    the mirrored one, and sigma. No marker in view is a result and not an error.
    """

    image: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="IMAGE")]
    """Photograph, in any format that OpenCV reads."""
    camera: Annotated[Path, tyro.conf.arg(metavar="FILE")]
    """Calibration: a rig file, a Kalibr camchain or a ROS camera_info YAML."""
    marker_size_m: Annotated[float, tyro.conf.arg(metavar="S")]
    """Side of the black square, m."""
    camera_name: Annotated[
        str | None,
        tyro.conf.arg(metavar="NAME", constructor=str, help_behavior_hint="(optional)"),
    ] = None
    """Which camera of the file took it, where the file holds several."""
    family: str = "tag36h11"
    """Marker family."""
    corner_backend: CornerBackend = "aruco"
    """Marker detector. apriltag needs the extra of that name."""
    json: Switch = False
    """Print JSON instead of a table."""
    out: Annotated[Path | None, tyro.conf.arg(metavar="PNG", help_behavior_hint="(optional)")] = (
        None
    )
    """Draw the markers and both poses into this file."""

    def __post_init__(self) -> None:
        require_within("--marker-size-m", self.marker_size_m, "size_m")
