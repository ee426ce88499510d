"""Arguments of `jaxnav doctor`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from jaxnav.commands.kinds import (
    KeyValues,
    OptionalFile,
    OptionalName,
    QCarFile,
    QCarMarkers,
    QCarRig,
    QCarVehicle,
    key_values,
    optional,
)


@dataclass(frozen=True)
class Doctor:
    """Check what a car will run with, and say what to do about each finding.

    Looked at are the computer (packages, OpenCV, JAX, clock, disk), the four files, pictures that
    the car's cameras took while it stood, and the plug-ins, which are opened and read but not
    driven. Exit code 0: no error; 1: an error was found; 2: a file or a flag is not understood.
    """

    rig: QCarRig = None
    markers: QCarMarkers = None
    vehicle: QCarVehicle = None
    route: QCarFile = None
    """Start and waypoints."""
    car: OptionalName = None
    """Vehicle plug-in to open and read: an installed name or module:name."""
    cameras: OptionalName = None
    """Camera plug-in to open and read: an installed name or module:name."""
    option: KeyValues = ()
    """What the plug-ins are told."""
    frame: Annotated[
        tyro.conf.UseAppendAction[tuple[str, ...]], optional("CAMERA=IMAGE", "(repeatable)")
    ] = ()
    """A picture by one of the rig's cameras, the car standing anywhere with a marker in view."""
    drive: Annotated[Path | None, optional("FILE.mcap")] = None
    """A recorded drive with eights, or stops and starts: are the cameras later than they say?"""
    json: OptionalFile = None
    """Write all findings into this file too."""

    def __post_init__(self) -> None:
        key_values("--option", self.option)
        key_values("--frame", self.frame, "CAMERA=IMAGE")
