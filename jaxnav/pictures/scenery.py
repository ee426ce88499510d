"""Read a recorded drive's cameras, markers and waypoints, for drawing.

The source is the header of the recording, in the form of the rig, marker and route files. Entries
that are missing or have another form are left out of the picture.
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from jaxtyping import Float
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import ZERO, Origin, opposite, points_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput
from jaxnav.files.markers import MarkerFile
from jaxnav.files.reading import parse_yaml
from jaxnav.files.rigs import RigFile
from jaxnav.files.validation import FloorPlace

_Model = TypeVar("_Model", bound=BaseModel)


@dataclass(frozen=True)
class Scenery:
    """The surroundings of a drive: its rig, markers and waypoints.

    Attributes:
        rig, markers: None if unknown.
        waypoints_m: (W, 2) in the world.
        waypoint_radius_m: a waypoint is reached within this.
    """

    rig: CameraRig | None
    markers: MarkerMap | None
    waypoints_m: Float[np.ndarray, "W 2"]
    waypoint_radius_m: float

    @property
    def markers_m(self) -> Float[np.ndarray, "M 4 3"]:
        """The markers' corners (M, 4, 3) in the world."""
        if self.markers is None:
            return np.zeros((0, 4, 3))
        corners_m = points_in_world(self.markers.corners_world_m, self.origin_m)
        return np.asarray(corners_m, float)

    @property
    def origin_m(self) -> Origin:
        """The origin of the markers' coordinates, see `MarkerMap`."""
        return ZERO if self.markers is None else self.markers.origin_m

    def on_map_m(self, places_m: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 2"]:
        """Points (N, 2) in the world, in the markers' coordinates."""
        return np.asarray(points_in_world(places_m, opposite(self.origin_m)))

    @staticmethod
    def from_header(header: dict[str, Any]) -> "Scenery":
        """Read the scenery from the header of a recording."""
        rig = _read(RigFile, header.get("rig"))
        markers = _read(MarkerFile, header.get("markers"))
        route = _read(_RouteEntry, header.get("route")) or _RouteEntry()
        return Scenery(
            rig=None if rig is None else rig.rig(),
            markers=None if markers is None else markers.map(),
            waypoints_m=np.array(route.waypoints_m, float).reshape(-1, 2),
            waypoint_radius_m=route.waypoint_radius_m,
        )


class _RouteEntry(BaseModel):
    """The part of a route that is drawn."""

    model_config = ConfigDict(frozen=True, extra="ignore")

    waypoints_m: list[FloorPlace] = Field(default_factory=list)
    waypoint_radius_m: float = Field(default=math.nan, strict=True)


def _read(model: type[_Model], value: Any) -> _Model | None:
    try:
        data = parse_yaml(Path("header"), value) if isinstance(value, str) else value
        return model.model_validate(data)
    except (ValidationError, BadInput):
        return None
