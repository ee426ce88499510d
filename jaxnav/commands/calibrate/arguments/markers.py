"""What `jaxnav calibrate markers` can be told."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxnav.commands.calibrate.arguments.rig import MarkerSize, Recordings, require_recordings
from jaxnav.commands.kinds import OptionalFile, require_within


@dataclass(frozen=True)
class CalibrateMarkers:
    """Find where the markers are, with a rig that is calibrated.

    As `calibrate rig`, but the cameras stay where the rig file has them.

    Written to --out: markers.yaml with sigmas; report.json; report.png; trajectory.tum.
    """

    recordings: Recordings
    """Drives (.mcap), folders of TagSLAM, .npz, ROS 1 bags with --rig."""
    rig: OptionalFile = None
    """Cameras, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Markers whose places are known, one at least. By default those that a drive brings along;
    without any the world is the frame of the marker seen most."""
    marker_size_m: MarkerSize = None
    """Side of the markers that are not in that file."""
    family: str = "tag36h11"
    """Marker family, where the recording does not tell."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("calibrated")
    """Folder for the results."""

    def __post_init__(self) -> None:
        require_recordings(self.recordings)
        if self.marker_size_m is not None:
            require_within("--marker-size-m", self.marker_size_m, "size_m")
