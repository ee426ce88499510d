"""Reading vehicles and routes in YAML, and writing vehicles.

wheelbase_m: 0.256                     start: {x_m: 2.0, y_m: -1.0, psi_deg: 125.0}
steering_limit_rad: 0.5                waypoints_m: [[1.30, 0.0], [0.50, 0.65]]
steering_rate_limit_radps: 5.0         waypoint_radius_m: 0.15
throttle_limit: 0.3                    leave_m: 3.0   # stop beyond; this key may be left out
speed_per_throttle_mps: 10.0
speed_time_constant_s: 0.3

A calibrated vehicle also has corrections of its sensors: true speed = `speed_scale` * the speed
read, true steering = `steering_gain` * the angle read + `steering_offset_rad`, and a camera's stamp
is `camera_delay_s` later than the odometer's of the same instant. Left out, they correct nothing.

`sigma: {speed_scale: 0.01, camera_delay_s: 0.005}` says how well each is known; the estimator lets
a sensor be off by that much, and learns by how much it is. Left out it is 3 % of the speed, 3 % of
the steering angle, 0.5 degrees (0.0087 rad) of its offset and 20 ms. Four zeros make the sensors
exact.

`resume: true` lets the vehicle, of any kind, drive on after a stop because something was late, once
all has been well for 2 s. It is for the person who writes the file: no calibration writes it.

A base that is no car, and a gyro, of a car too:

base: differential                     gyro:
forward_limit_mps: 1.0                   class: consumer
turn_limit_radps: 3.0                    delay_s: 0.004
time_constant_s: 0.15

`base` is differential or tracks; or omni, mecanum or swerve, which need a `left_limit_mps` as well.
`sigma` says how well its odometry is known, by the names of `TWIST_ERRORS`; left out it is 3 % of
the way, 5 % of the effective track width, 0.03 rad a metre of unequal wheels, and 20 ms between
cameras and odometer. Four zeros make it exact.

A gyro is that of its class, consumer where none is given, but for the figures that follow.
"""

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator, model_validator

from jaxnav.core.models.imu import GYROS, Gyro
from jaxnav.core.models.origin import Origin, opposite, planar_in_world, points_in_world
from jaxnav.core.models.vehicle import (
    DEFAULT_SENSOR_SIGMA,
    DEFAULT_TWIST_SIGMA,
    SENSOR_ERRORS,
    TWIST_ERRORS,
    TwistBase,
    Vehicle,
)
from jaxnav.core.parameters import TUNABLES
from jaxnav.errors import BadInput
from jaxnav.files.provenance import Calibrated, file_text
from jaxnav.files.ranges import problem_of, within
from jaxnav.files.reading import read_mapping
from jaxnav.files.validation import (
    AngleDeg,
    Entry,
    FloorPlace,
    NonNegative,
    Number,
    Place,
    Position,
    Positive,
    Radius,
    Wrong,
    read,
    validate,
)
from jaxnav.files.writing import atomic_write

_MOST_SIGMA = TUNABLES["motion.vehicle.sensor_sigma"].most
_NO_FIGURES = ("base", "calibrated", "gyro", "resume", "sigma")


class GyroEntry(Entry):
    """A gyro: its class, and what is known better."""

    class_: Annotated[Literal["consumer", "tactical"], Field(alias="class")] = "consumer"
    noise_density: Annotated[Positive, within("gyro_noise")] | None = None  # rad/s/sqrt(Hz)
    bias_sigma_radps: Annotated[Positive, within("gyro_bias_radps")] | None = None
    bias_walk: Annotated[Positive, within("gyro_walk")] | None = None  # rad/s/sqrt(s)
    saturation_radps: Annotated[Positive, within("turn_limit_radps")] | None = None
    scale_sigma: Annotated[NonNegative, Field(le=0.5)] | None = None
    delay_s: Annotated[Number, within("delay_s")] | None = None
    delay_sigma_s: Annotated[NonNegative, Field(le=0.5)] | None = None

    def gyro(self) -> Gyro:
        """The gyro."""
        return dataclasses.replace(
            GYROS[self.class_], **self.model_dump(exclude={"class_"}, exclude_none=True)
        )


def _require_small(sigma: dict[str, float], names: Iterable[str]) -> None:
    for name, most in zip(names, _MOST_SIGMA, strict=True):
        if sigma.get(name, 0.0) > most:
            unit = {"rad": " rad", "s": " s"}.get(name.rsplit("_", 1)[-1], "")
            raise Wrong("sigma", f"{name} must be at most {most:g}{unit}, got {sigma[name]:g}")


def _sigmas(
    given: Mapping[str, float], names: Iterable[str], defaults: Float[np.ndarray, " 4"]
) -> Float[np.ndarray, " 4"] | None:
    """The sigmas of a vehicle's sensors; None where all are exact."""
    sigma = np.asarray([given.get(n, default) for n, default in zip(names, defaults, strict=True)])
    return sigma if np.any(sigma) else None


class VehicleFile(Entry):
    """A vehicle file: the arguments of `Vehicle.create`."""

    base: Literal["ackermann"] = "ackermann"
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
    gyro: GyroEntry | None = None
    sigma: dict[str, NonNegative] = Field(default_factory=dict)  # of the keys above, by their names
    resume: bool = False

    @model_validator(mode="after")
    def _agrees(self) -> Self:
        _require_small(self.sigma, SENSOR_ERRORS)
        return self

    def vehicle(self) -> Vehicle:
        """The vehicle, in the process's precision."""
        figures = self.model_dump(exclude={*_NO_FIGURES}, exclude_none=True)
        sigma = _sigmas(self.sigma, SENSOR_ERRORS, DEFAULT_SENSOR_SIGMA)
        gyro = None if self.gyro is None else self.gyro.gyro()
        return Vehicle.create(**figures, sensor_sigma=sigma, gyro=gyro)


# Name -> its default; that of a correction corrects nothing.
_FIGURES = {
    name: field.default
    for name, field in VehicleFile.model_fields.items()
    if name not in _NO_FIGURES
}


class BaseFile(Entry):
    """A vehicle file of a base that is driven by a twist."""

    base: Literal["differential", "tracks", "omni", "mecanum", "swerve"]
    forward_limit_mps: Annotated[Positive, within("base_speed_mps")]
    left_limit_mps: Annotated[Positive, within("base_speed_mps")] | None = None
    turn_limit_radps: Annotated[Positive, within("turn_limit_radps")]
    time_constant_s: Annotated[Positive, within("time_constant_s")]
    sigma: dict[str, NonNegative] = Field(default_factory=dict)
    gyro: GyroEntry | None = None
    resume: bool = False

    @model_validator(mode="after")
    def _agrees(self) -> Self:
        for name in self.sigma.keys() - TWIST_ERRORS:
            raise Wrong("sigma", f"unknown {name}: expected {', '.join(TWIST_ERRORS)}")
        _require_small(self.sigma, TWIST_ERRORS)
        turns_alone = self.base in ("differential", "tracks")
        if turns_alone and self.left_limit_mps is not None:
            raise ValueError(f"base {self.base} can't move to its left: leave out left_limit_mps")
        if not turns_alone and self.left_limit_mps is None:
            raise ValueError(f"base {self.base} needs left_limit_mps")
        return self

    def vehicle(self) -> TwistBase:
        """The base, in the process's precision."""
        return TwistBase.create(
            self.forward_limit_mps,
            self.turn_limit_radps,
            self.time_constant_s,
            self.left_limit_mps or 0.0,
            _sigmas(self.sigma, TWIST_ERRORS, DEFAULT_TWIST_SIGMA),
            None if self.gyro is None else self.gyro.gyro(),
        )


class StartEntry(Entry):
    """The pose at which a drive starts."""

    x_m: Position
    y_m: Position
    psi_deg: AngleDeg


@dataclass(frozen=True)
class Route:
    """The waypoints of a drive and the pose at its start, in the world."""

    waypoints_m: tuple[tuple[float, float], ...]  # (N, 2) x y
    waypoint_radius_m: float  # a waypoint is reached within this
    start_pose: tuple[float, float, float]  # (x m, y m, psi rad) where a simulated drive starts
    leave_m: float | None = None  # see `leaves_at_m`

    @property
    def leaves_at_m(self) -> float:
        """How far from its route the vehicle may drive: what the file says, or enough to turn round
        at each waypoint, 1.5 times the longest leg, the one from the start included, and 1 m."""
        if self.leave_m is not None:
            return self.leave_m
        corners_m = [self.start_pose[:2], *self.waypoints_m]
        return 1.0 + 1.5 * max(math.dist(*leg) for leg in pairwise(corners_m))

    def relative_to(self, origin_m: Origin) -> "Route":
        """The route in the coordinates of a map with this origin, see `MarkerMap`."""
        away_m = opposite(origin_m)
        waypoints_m = points_in_world(self.waypoints_m, away_m)
        x_m, y_m, psi_rad = planar_in_world(self.start_pose, away_m)
        return Route(
            tuple((float(x), float(y)) for x, y in waypoints_m),
            self.waypoint_radius_m,
            (float(x_m), float(y_m), float(psi_rad)),
            self.leave_m,
        )


class _RouteEntry(Entry):
    """What all forms of a route have in common."""

    waypoints_m: Annotated[list[FloorPlace], Field(min_length=1, max_length=4096)]
    waypoint_radius_m: Radius
    leave_m: Radius | None = None

    def _from(self, start_pose: tuple[float, float, float]) -> Route:
        waypoints_m = tuple((x, y) for x, y in self.waypoints_m)
        return Route(waypoints_m, self.waypoint_radius_m, start_pose, self.leave_m)


class RouteFile(_RouteEntry):
    """A route file."""

    start: StartEntry

    def route(self) -> Route:
        """The `Route` of this file."""
        return self._from((self.start.x_m, self.start.y_m, math.radians(self.start.psi_deg)))


class RecordedRoute(_RouteEntry):
    """A route in the header of a recorded drive, with the numbers of `Route` itself."""

    start_pose: Place

    @field_validator("start_pose")
    @classmethod
    def _turned_little(cls, start_pose: list[float]) -> list[float]:
        if problem := problem_of("angle_rad", start_pose[2]):
            raise ValueError(f"psi {problem}")
        return start_pose

    def route(self) -> Route:
        """The `Route` of this entry."""
        x_m, y_m, psi_rad = self.start_pose
        return self._from((x_m, y_m, psi_rad))


def load_vehicle(path: str | Path) -> Vehicle | TwistBase:
    """Read a vehicle's parameters and limits: of a car, or of another base.

    Raises:
        BadInput: one line naming file and key.
    """
    return _read(Path(path)).vehicle()


def may_resume(path: Path) -> bool:
    """Whether a vehicle's file allows it to drive on after a stop for being late.

    Raises:
        BadInput: as `load_vehicle`.
    """
    return _read(path).resume


def is_base_file(data: Mapping[str, Any]) -> bool:
    """Whether this is a vehicle file of a base that is no car."""
    return bool(data.get("base", "ackermann") != "ackermann")


def _read(path: Path) -> VehicleFile | BaseFile:
    data = read_mapping(path)
    if is_base_file(data):
        return validate(BaseFile, data, path)
    return validate(VehicleFile, data, path)


def load_car(path: str | Path) -> Vehicle:
    """Read the vehicle of what is for cars alone so far: calibrations, tuning.

    Raises:
        BadInput: as `load_vehicle`; or the vehicle is no Ackermann car, or has a gyro.
    """
    vehicle = as_car(load_vehicle(path), path)
    if vehicle.gyro is not None:
        raise BadInput(
            f"{path}: gyro", "must be left out here: a gyro is only read while it drives"
        )
    return vehicle


def as_car(vehicle: Vehicle | TwistBase, where: str | Path, key: str = "base") -> Vehicle:
    """The vehicle, if it is a car.

    Args:
        where: the file that holds it.
        key: where in the file it says which base it is.

    Raises:
        BadInput: it is another base.
    """
    if isinstance(vehicle, TwistBase):
        raise BadInput(f"{where}: {key}", "must be ackermann here: this is for cars alone so far")
    return vehicle


def vehicle_data(
    vehicle: Vehicle | TwistBase, sigma: Mapping[str, float] | None = None
) -> dict[str, Any]:
    """The content of a vehicle's file, all numbers bit for bit; see `VehicleFile`.

    Args:
        sigma: standard deviations, by the names of their keys, in place of the vehicle's own.
    """
    known = np.zeros(4) if vehicle.sensor_sigma is None else vehicle.sensor_sigma
    written: dict[str, Any]
    if isinstance(vehicle, TwistBase):
        moves_sideways = float(vehicle.left_limit_mps) != 0
        names = ["forward_limit_mps", "turn_limit_radps", "time_constant_s"]
        names += ["left_limit_mps"] * moves_sideways
        written = {"base": "omni" if moves_sideways else "differential"}
        written |= {name: float(getattr(vehicle, name)) for name in names}
        said = zip(TWIST_ERRORS, np.asarray(known, float).tolist(), strict=True)
    else:
        data = {name: float(getattr(vehicle, name)) for name in _FIGURES}
        # Without what corrects nothing, any version of the program reads the file.
        written = {name: value for name, value in data.items() if _FIGURES[name] != value}
        said = zip(SENSOR_ERRORS, np.asarray(known, float).tolist(), strict=True)
        dtype = np.asarray(vehicle.wheelbase_m).dtype
        if np.array_equal(known, DEFAULT_SENSOR_SIGMA.astype(dtype)):
            said = zip((), (), strict=True)
    found = {name: float(value) for name, value in (sigma or {}).items()}
    if sigmas := dict(said) | found:
        written["sigma"] = sigmas
    if (gyro := vehicle.gyro) is not None:
        of_gyro = dataclasses.fields(gyro)
        written["gyro"] = {field.name: float(getattr(gyro, field.name)) for field in of_gyro}
    return written


def save_vehicle(
    path: str | Path,
    vehicle: Vehicle | TwistBase,
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
    atomic_write(path, file_text(vehicle_data(vehicle, sigma), calibrated))


def load_route(path: str | Path) -> Route:
    """Read a route: waypoints, and the start of a simulated drive.

    Raises:
        BadInput: one line naming file and key.
    """
    return read(path, RouteFile).route()
