"""Vehicles and routes: YAML in.

wheelbase_m: 0.256                     start: {x_m: 2.0, y_m: -1.0, psi_deg: 125.0}
steering_limit_rad: 0.5                waypoints_m: [[1.30, 0.0], [0.50, 0.65]]
steering_rate_limit_radps: 5.0         waypoint_radius_m: 0.15
throttle_limit: 0.3
speed_per_throttle_mps: 10.0
speed_time_constant_s: 0.3
"""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from pydantic import Field

from jaxnav.bicycle import Vehicle
from jaxnav.files.reading import read_mapping
from jaxnav.files.validation import Entry, Number, Pair, Positive, validate


class VehicleFile(Entry):
    """A vehicle file: the arguments of `Vehicle.create`."""

    wheelbase_m: Positive
    steering_limit_rad: Annotated[Positive, Field(lt=math.pi / 2)]
    throttle_limit: Positive
    speed_per_throttle_mps: Positive
    speed_time_constant_s: Positive
    steering_rate_limit_radps: Positive | None = None

    def vehicle(self) -> Vehicle:
        """The vehicle, in the process's precision."""
        return Vehicle.create(**self.model_dump(exclude_none=True))


class StartEntry(Entry):
    """Where a drive starts."""

    x_m: Number
    y_m: Number
    psi_deg: Number


class RouteFile(Entry):
    """A route file."""

    waypoints_m: Annotated[list[Pair], Field(min_length=1, max_length=4096)]
    waypoint_radius_m: Positive
    start: StartEntry


@dataclass(frozen=True)
class Route:
    """Where a drive goes, in the world."""

    waypoints_m: tuple[tuple[float, float], ...]  # (N, 2) x y
    waypoint_radius_m: float  # a waypoint is reached within this
    start_pose: tuple[float, float, float]  # (x m, y m, psi rad) where a simulated drive starts


def load_vehicle(path: str | Path) -> Vehicle:
    """Bicycle parameters and limits.

    Raises:
        BadInput: one line naming file and key.
    """
    path = Path(path)
    return validate(VehicleFile, read_mapping(path), path).vehicle()


def vehicle_data(vehicle: Vehicle) -> dict[str, float]:
    """What a file of the vehicle holds, all numbers bit for bit; see `VehicleFile`."""
    return {name: float(getattr(vehicle, name)) for name in VehicleFile.model_fields}


def load_route(path: str | Path) -> Route:
    """Waypoints and the start of a simulated drive.

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
