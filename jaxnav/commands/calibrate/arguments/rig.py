"""What `jaxnav calibrate rig` can be told."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxnav.commands.kinds import OptionalFile, QCarFile, Switch, require, require_within

Recordings = Annotated[tyro.conf.Positional[tuple[Path, ...]], tyro.conf.arg(metavar="RECORDING")]
MarkerSize = Annotated[
    float | None,
    tyro.conf.arg(
        metavar="S", constructor=float, help_behavior_hint="(default: as of the known ones)"
    ),
]


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
    """Drives (.mcap), folders of TagSLAM, .npz, ROS 1 bags with --rig."""
    rig: OptionalFile = None
    """Cameras: their lenses, and about where they are, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Markers whose places are known, one at least: they tie the world down. By default those that
    a drive brings along; without any the world is the frame of the marker seen most."""
    marker_size_m: MarkerSize = None
    """Side of the markers that are not in that file."""
    family: str = "tag36h11"
    """Marker family, where the recording does not tell."""
    refine_lenses: Switch = False
    """Adjust focal lengths, centres and lenses as well, from where the rig has them."""
    vehicle_frame: Annotated[str, tyro.conf.arg(metavar="places|drive|CAMERA")] = "places"
    """What ties the vehicle frame down: the given places of all cameras together; a drive with
    straight lines and circles; or the given place of one camera."""
    vehicle: QCarFile = None
    """Vehicle file, whose wheelbase a drive needs."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("calibrated")
    """Folder for the results."""

    def __post_init__(self) -> None:
        require_recordings(self.recordings)
        if self.marker_size_m is not None:
            require_within("--marker-size-m", self.marker_size_m, "size_m")


def require_recordings(recordings: tuple[Path, ...]) -> None:
    """Raise BadInput where there is none."""
    require(len(recordings) > 0, "RECORDING", "missing: what has the rig seen?")
