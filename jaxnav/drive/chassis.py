"""What a vehicle's commands and readings say of its motion: of a car, and of other bases.

The checks of the loop ask whether a reading can be, whether anything moves, and how far. So they
look at driven parts, each of which follows its command with a lag of first order and has its speed
in m/s. A car has one, its speed along its course. Another base has three: its speeds ahead and to
its left, and that of its rim, which its turn moves: a turn on the spot is a way like others.
"""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.drive.flags import Fault
from jaxnav.drive.interfaces import Odometry, Reading, TwistOdometry
from jaxnav.drive.limits import Command, Limits, TwistLimits, turns_by_twist
from jaxnav.files.ranges import RANGES

# A rim is not farther from the middle than this: a slow turn limit says nothing of the size.
_WIDEST_M = 0.5
# Of `values` of a reading, the names in the table of ranges.
_CAR_READS = "speed_mps", "steering_rad"
_BASE_READS = "speed_mps", "speed_mps", "turn_radps"

# How exactly a command is followed, see `Part`. The throttle as in `Propulsion`; what is commanded
# in m/s, rad/s or rad is regulated, or a servo's.
_THROTTLE_FACTOR, _FACTOR = 2.0, 1.4
_SERVO_S = 0.15  # a servo's lag, with that of a bus
# Errors of the corners and of the filter: a camera that is off by 1 degree moves a pose at 2 m by
# 0.035 m, and the next one the other way. Beside it three sigmas. Fitted to ten kinds of wiring
# with ten seeds each (`test_actuation`) and tried on 300 other sound drives: none was blamed.
_MARGIN_M, _SLACK = 0.07, 0.05
# Four degrees; and a steering that is trimmed 1.5 degrees off, wheels that are 3 % apart.
_MARGIN_RAD, _SLACK_RADPM = 0.07, 0.1


class Motion(NamedTuple):
    """A velocity in the vehicle's own axes."""

    forward_mps: float
    left_mps: float
    turn_radps: float


class Part(NamedTuple):
    """One part of a command, and how exactly it must be followed.

    Attributes:
        fault: its name where it is not.
        turns: its motion is a turn, rad; else a way, m.
        by_way: what is commanded is a curvature, 1/m; else a rate.
        lag_s: time constant with which it follows.
        factor: of its gain, either way.
        margin: of a motion, m or rad, beside what the factor leaves.
        slack_per_m: what else it may be off for each metre of way.
    """

    fault: Fault
    turns: bool
    by_way: bool
    lag_s: float
    factor: float
    margin: float
    slack_per_m: float


def pace_mps(driven_mps: tuple[float, ...]) -> float:
    """How fast what moves fastest goes, by the speeds of the driven parts."""
    if len(driven_mps) == 1:
        return abs(driven_mps[0])
    forward, left, rim = driven_mps
    return math.hypot(forward, left) + abs(rim)


@dataclass(frozen=True)
class CarChassis:
    """A car: its throttle drives its speed along its course.

    Attributes:
        tops_mps: the largest speed of each driven part.
        time_constant_s: of the lag from a command to the speed.
        lever_m: way of the rim by a turn of 1 rad; 0 of a car, which does not turn on the spot.
    """

    limits: Limits
    tops_mps: tuple[float, ...]
    time_constant_s: float
    speed_per_throttle_mps: float
    wheelbase_m: float
    lever_m: float = 0.0

    @staticmethod
    def from_vehicle(vehicle: Vehicle) -> CarChassis:
        """That of a car's description."""
        speed_per_throttle_mps = float(vehicle.speed_per_throttle_mps)
        return CarChassis(
            Limits.from_vehicle(vehicle),
            (float(vehicle.throttle_limit) * speed_per_throttle_mps,),
            float(vehicle.speed_time_constant_s),
            speed_per_throttle_mps,
            float(vehicle.wheelbase_m),
        )

    @property
    def slides_m(self) -> float:
        """Way on which sliding wheels may turn it by 1 rad: about one axle, way / wheelbase."""
        return self.wheelbase_m

    @property
    def parts(self) -> tuple[Part, ...]:
        """The parts of a command: throttle and steering."""
        lag_s, factor = self.time_constant_s, _THROTTLE_FACTOR
        return (
            Part(Fault.DRIVE_CONTRADICTED, False, False, lag_s, factor, _MARGIN_M, _SLACK),
            Part(Fault.TURN_CONTRADICTED, True, True, _SERVO_S, _FACTOR, _MARGIN_RAD, _SLACK_RADPM),
        )

    def reads(self, reading: Reading) -> bool:
        """Whether a reading is of this kind of vehicle, and one that a vehicle can have."""
        return isinstance(reading, Odometry) and _can_be(_CAR_READS, reading.values)

    def motion(self, reading: Reading) -> Motion:
        """The motion that a reading tells; Eqs. 4 to 7 of the paper, as `velocity_world`."""
        speed_mps, steering_rad = reading.values
        return car_motion(speed_mps, steering_rad, self.wheelbase_m)

    def driven_mps(self, reading: Reading) -> tuple[float, ...]:
        """The speed of each driven part that a reading tells."""
        return reading.values[:1]

    def wanted_mps(self, command: Command) -> tuple[float, ...]:
        """The speed towards which a command drives each driven part."""
        return (command[1] * self.speed_per_throttle_mps,)

    def targets(self, command: Command) -> tuple[float, ...]:
        """The rate or curvature that a command makes due of each part: speed and curvature."""
        along = car_motion(1.0, command[0], self.wheelbase_m)
        return *self.wanted_mps(command), along.turn_radps

    def seen(self, moved: Motion) -> tuple[float, ...]:
        """What each part has made of a motion: the way along the course, m, and the turn, rad."""
        way_m = math.copysign(math.hypot(moved[0], moved[1]), moved.forward_mps)
        return way_m, moved.turn_radps

    def believed_mps(
        self,
        heading_rad: float,
        velocity: Float[np.ndarray, " 3"],
        covariance: Float[np.ndarray, "3 3"],
    ) -> tuple[tuple[float, float], ...]:
        """The speed of each driven part that an estimate tells, and its sigma.

        Args:
            velocity: derivative of (x_m, y_m, psi_rad) in the world, and its covariance.
        """
        x_mps, y_mps, _ = velocity.tolist()
        forward_mps = math.cos(heading_rad) * x_mps + math.sin(heading_rad) * y_mps
        speed_mps = math.copysign(math.hypot(x_mps, y_mps), forward_mps)
        return ((speed_mps, root_of_sum(covariance)),)


@dataclass(frozen=True)
class BaseChassis:
    """A base that is driven by a twist; attributes and methods as of `CarChassis`."""

    limits: TwistLimits
    time_constant_s: float
    lever_m: float

    @staticmethod
    def from_base(base: TwistBase) -> BaseChassis:
        """That of a base's description.

        The wheels of a differential drive turn it about their middle as fast as they drive it
        ahead: half its track width is the ratio of the two limits.
        """
        limits = TwistLimits.from_base(base)
        lever_m = min(limits.forward_mps / limits.turn_radps, _WIDEST_M)
        return BaseChassis(limits, float(base.time_constant_s), lever_m)

    @property
    def slides_m(self) -> float:
        """About one wheel it turns by way / half its track."""
        return self.lever_m

    @property
    def tops_mps(self) -> tuple[float, ...]:
        """Ahead, to the left, and of the rim."""
        return self.wanted_mps(astuple(self.limits))

    @property
    def parts(self) -> tuple[Part, ...]:
        """Ahead, to the left and the turn."""
        rate = False, self.time_constant_s, _FACTOR
        return (
            Part(Fault.DRIVE_CONTRADICTED, False, *rate, _MARGIN_M, _SLACK),
            Part(Fault.SIDEWAYS_CONTRADICTED, False, *rate, _MARGIN_M, _SLACK),
            Part(Fault.TURN_CONTRADICTED, True, *rate, _MARGIN_RAD, _SLACK_RADPM),
        )

    def reads(self, reading: Reading) -> bool:
        """See `CarChassis`."""
        return isinstance(reading, TwistOdometry) and _can_be(_BASE_READS, reading.values)

    def motion(self, reading: Reading) -> Motion:
        """See `CarChassis`."""
        return Motion(*reading.values)

    def driven_mps(self, reading: Reading) -> tuple[float, ...]:
        """See `CarChassis`."""
        return self.wanted_mps(reading.values)

    def wanted_mps(self, command: Command) -> tuple[float, ...]:
        """See `CarChassis`."""
        forward_mps, left_mps, turn_radps = command
        return forward_mps, left_mps, turn_radps * self.lever_m

    def targets(self, command: Command) -> tuple[float, ...]:
        """See `CarChassis`."""
        return command

    def seen(self, moved: Motion) -> tuple[float, ...]:
        """See `CarChassis`."""
        return moved

    def believed_mps(
        self,
        heading_rad: float,
        velocity: Float[np.ndarray, " 3"],
        covariance: Float[np.ndarray, "3 3"],
    ) -> tuple[tuple[float, float], ...]:
        """See `CarChassis`."""
        x_mps, y_mps, turn_radps = velocity.tolist()
        c, s = math.cos(heading_rad), math.sin(heading_rad)
        sigma_mps = root_of_sum(covariance)
        turn_sigma = math.sqrt(max(float(covariance[2, 2]), 0.0))
        return (
            (c * x_mps + s * y_mps, sigma_mps),
            (c * y_mps - s * x_mps, sigma_mps),
            (turn_radps * self.lever_m, turn_sigma * self.lever_m),
        )


Chassis = CarChassis | BaseChassis


def chassis_of(vehicle: Vehicle | TwistBase) -> Chassis:
    """That of a vehicle's description."""
    return (
        BaseChassis.from_base(vehicle)
        if turns_by_twist(vehicle)
        else CarChassis.from_vehicle(vehicle)
    )


def _can_be(names: tuple[str, ...], values: tuple[float, ...]) -> bool:
    """Whether each value is within the range of its name."""
    return all(RANGES[name].holds(value) for name, value in zip(names, values, strict=True))


def car_motion(speed_mps: float, steering_rad: float, wheelbase_m: float) -> Motion:
    """The motion of a car whose front wheels are turned by an angle."""
    tangent = math.tan(steering_rad)
    beta_rad = math.atan(tangent / 2)
    forward_mps = speed_mps * math.cos(beta_rad)
    return Motion(forward_mps, speed_mps * math.sin(beta_rad), forward_mps * tangent / wheelbase_m)


def root_of_sum(covariance: Float[np.ndarray, "n n"]) -> float:
    """Sigma of the first two coordinates together."""
    return math.sqrt(max(float(covariance[0, 0]) + float(covariance[1, 1]), 0.0))
