"""Reading vehicles and routes in YAML, and writing vehicles.

wheelbase_m: 0.256                     start: {x_m: 2.0, y_m: -1.0, psi_deg: 125.0}
steering_limit_rad: 0.5                waypoints_m: [[1.30, 0.0], [0.50, 0.65]]
steering_rate_limit_radps: 5.0         waypoint_radius_m: 0.15
throttle_limit: 0.3
speed_per_throttle_mps: 10.0
speed_time_constant_s: 0.3

A calibrated vehicle also has corrections of its sensors: true speed = `speed_scale` * the speed
read, true steering = `steering_gain` * the angle read + `steering_offset_rad`, and a camera's stamp
is `camera_delay_s` later than the odometer's of the same instant. Left out, they correct nothing.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from jaxnav.files.provenance import Calibrated
from jaxnav.files.ranges import within
from jaxnav.files.reading import read_mapping
from jaxnav.files.rigs import with_provenance
from jaxnav.files.validation import (
    AngleDeg,
    Entry,
    FloorPlace,
    Number,
    Position,
    Positive,
    Radius,
    validate,
)
from jaxnav.files.writing import atomic_write, yaml_text
from jaxnav.models.bicycle import Vehicle
from jaxnav.models.origin import Origin, opposite, planar_in_world, points_in_world


class VehicleFile(Entry):
    """A vehicle file: the arguments of `Vehicle.create`."""

    wheelbase_m: Annotated[Positive, within("wheelbase_m")]
    steering_limit_rad: Annotated[Positive, Field(lt=math.pi / 2), within("steering_limit_rad")]
    throttle_limit: Annotated[Positive, within("throttle")]
    speed_per_throttle_mps: Annotated[Positive, within("speed_per_throttle_mps")]
    speed_time_constant_s: Annotated[Positive, within("time_constant_s")]
    steering_rate_limit_radps: Annotated[Positive, within("steering_rate_radps")] | None = None
    speed_scale: Annotated[Positive, within("gain")] = 1.0
    steering_gain: Annotated[Positive, within("gain")] = 1.0
    steering_offset_rad: Annotated[Number, within("offset_rad")] = 0.0
    camera_delay_s: Annotated[Number, within("delay_s")] = 0.0
    calibrated: Calibrated | None = None
    sigma: dict[str, Positive] = Field(default_factory=dict)  # of the keys above, by their names

    def vehicle(self) -> Vehicle:
        """The vehicle, in the process's precision."""
        return Vehicle.create(**self.model_dump(exclude={"calibrated", "sigma"}, exclude_none=True))


# Name -> its default; that of a correction corrects nothing.
_FIGURES = {
    name: field.default
    for name, field in VehicleFile.model_fields.items()
    if name not in ("calibrated", "sigma")
}


class StartEntry(Entry):
    """The pose at which a drive starts."""

    x_m: Position
    y_m: Position
    psi_deg: AngleDeg


class RouteFile(Entry):
    """A route file."""

    waypoints_m: Annotated[list[FloorPlace], Field(min_length=1, max_length=4096)]
    waypoint_radius_m: Radius
    start: StartEntry


@dataclass(frozen=True)
class Route:
    """The waypoints of a drive and the pose at its start, in the world."""

    waypoints_m: tuple[tuple[float, float], ...]  # (N, 2) x y
    waypoint_radius_m: float  # a waypoint is reached within this
    start_pose: tuple[float, float, float]  # (x m, y m, psi rad) where a simulated drive starts

    def relative_to(self, origin_m: Origin) -> "Route":
        """The route in the coordinates of a map with this origin, see `MarkerMap`."""
        away_m = opposite(origin_m)
        waypoints_m = points_in_world(self.waypoints_m, away_m)
        x_m, y_m, psi_rad = planar_in_world(self.start_pose, away_m)
        return Route(
            tuple((float(x), float(y)) for x, y in waypoints_m),
            self.waypoint_radius_m,
            (float(x_m), float(y_m), float(psi_rad)),
        )


def load_vehicle(path: str | Path) -> Vehicle:
    """Read a vehicle's bicycle parameters and limits.

    Raises:
        BadInput: one line naming file and key.
    """
    path = Path(path)
    return validate(VehicleFile, read_mapping(path), path).vehicle()


def vehicle_data(vehicle: Vehicle) -> dict[str, float]:
    """The content of a vehicle's file, all numbers bit for bit; see `VehicleFile`."""
    data = {name: float(getattr(vehicle, name)) for name in _FIGURES}
    # Without corrections that correct nothing, any version of the program reads the file.
    return {name: value for name, value in data.items() if _FIGURES[name] != value}


def save_vehicle(
    path: str | Path,
    vehicle: Vehicle,
    calibrated: Calibrated | None = None,
    sigma: Mapping[str, float] | None = None,
) -> None:
    """Write a vehicle; `load_vehicle` gives back the same numbers, bit for bit.

    Args:
        calibrated: the provenance of the figures.
        sigma: their standard deviations, by the names of their keys.

    Raises:
        BadInput: the file can't be written.
    """
    data: dict[str, Any] = dict(vehicle_data(vehicle))
    if sigma:
        data["sigma"] = {name: float(value) for name, value in sigma.items()}
    atomic_write(path, yaml_text(with_provenance(data, calibrated)))


def load_route(path: str | Path) -> Route:
    """Read a route: waypoints, and the start of a simulated drive.

    Raises:
        BadInput: one line naming file and key.
    """
    path = Path(path)
    entry = validate(RouteFile, read_mapping(path), path)
    return Route(
        waypoints_m=tuple((x, y) for x, y in entry.waypoints_m),
        waypoint_radius_m=entry.waypoint_radius_m,
        start_pose=(entry.start.x_m, entry.start.y_m, math.radians(entry.start.psi_deg)),
    )
