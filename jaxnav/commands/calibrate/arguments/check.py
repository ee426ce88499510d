"""What `jaxnav calibrate check` can be told."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxnav.commands.calibrate.arguments.rig import Recordings, require_recordings
from jaxnav.commands.kinds import OptionalFile, require_finite


@dataclass(frozen=True)
class CalibrateCheck:
    """Find markers that are not where the map says.

    All markers are looked for anew, with a rig that is calibrated. The map is laid over what was
    found so that as many as can agree; the others have moved, or were entered wrongly. The exit
    code is 1 where there is one.

    Written to --out: markers.yaml, the map as it was found; report.json; report.png.
    """

    recordings: Recordings
    """Drives (.mcap), folders of TagSLAM, .npz, ROS 1 bags with --rig."""
    rig: OptionalFile = None
    """Cameras, in place of the recording's own."""
    markers_file: OptionalFile = None
    """Map to be checked, in place of the one that a drive brings along."""
    family: str = "tag36h11"
    """Marker family, where the recording does not tell."""
    tolerance_m: float = 0.02
    """A marker that is no further off than this, and no more than its sigma explains, is right."""
    tolerance_deg: float = 3.0
    """The same for how it is turned."""
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")] = Path("checked")
    """Folder for the results."""

    def __post_init__(self) -> None:
        require_recordings(self.recordings)
        require_finite("--tolerance-m", self.tolerance_m)
        require_finite("--tolerance-deg", self.tolerance_deg)
