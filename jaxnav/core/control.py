"""Steering and throttle, or a twist, towards the next waypoint.

Source: Liu, Schofield, Shan (2023), Eqs. 16-19; for bases that are no cars Coulter (1992),
"Implementation of the pure pursuit path tracking algorithm".
"""

import abc
import dataclasses
from collections.abc import Sequence
from typing import Any, TypeVar

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.models.geometry import EVEN_RAD, safe_atan2, safe_norm, wrap_angle
from jaxnav.core.models.vehicle import TwistBase, Vehicle, curvature_per_m, sideslip_rad

Kind = TypeVar("Kind", bound="Follower")


class Command(eqx.Module):
    """Steering and throttle for the vehicle, inside its limits."""

    steering_rad: Float[Array, ""]
    throttle: Float[Array, ""]  # the driver's unit


class ControlLog(eqx.Module):
    """The quantities between the pose and the command, for records and plots."""

    distance_m: Float[Array, ""]  # L_d
    alpha_rad: Float[Array, ""]
    sideslip_rad: Float[Array, ""]  # beta
    integral_ms: Float[Array, ""]  # integral of L_d over time, m s


class ControlState(eqx.Module):
    """The state that the controller carries from one command to the next."""

    waypoint_index: Int[Array, ""]  # W once the last one is reached
    integral_ms: Float[Array, ""]
    explored_s: Float[Array, ""]  # duration of the exploration since the pose was last decided
    side: Float[Array, ""]  # of the line of sight, where it explores: 1 left, -1 right, 0 none

    def exploring(self, given: "ControlInput", side: Float[Array, ""]) -> "ControlState":
        """The state after exploring to a side for `dt_s`; a decided pose ends the exploration."""
        return dataclasses.replace(
            self,
            explored_s=jnp.where(given.decided, 0, self.explored_s + given.elapsed_s()),
            side=jnp.where(given.decided, 0, side),
        )


class Exploration(eqx.Module):
    """Motion of a car while several poses are possible.

    The car drives slowly at `angle_rad` to the line of sight, to the side it points to already:
    motion across the line of sight separates the poses from their mirror images. Whichever pose is
    the true one, the car gets nearer to the marker and stays inside the circle around it on which
    it stood; the ground between the two is open, since the marker is seen. After `duration_s`, or
    nearer than `min_range_m`, the car stands until the pose is decided.
    """

    speed_mps: float = 0.5
    settle_s: float = 0.1  # time constant to that speed; the throttle leads the motor's lag
    angle_rad: float = float(np.deg2rad(60.0))
    reach_m: float = 0.4  # distance of the point on that course at which it steers
    min_range_m: float = 0.7
    duration_s: float = 12.0

    def goes_on(self, state: ControlState, to_marker_m: Float[Array, " 2"]) -> Bool[Array, ""]:
        """Whether it moves: it has not explored for too long, and the marker is not too near."""
        far = safe_norm(to_marker_m) > self.min_range_m
        return (state.explored_s < self.duration_s) & far


class ControlInput(eqx.Module):
    """What a command follows from."""

    pose: Float[Array, " 3"]  # (x_m, y_m, psi_rad) of the vehicle in the world
    located: Bool[Array, ""]  # whether a pose has been estimated yet
    steering_rad: Float[Array, ""]  # measured, for the sideslip; a NaN is taken as 0
    dt_s: Float[Array, ""]  # since the previous command; 0 where it is not positive and finite
    decided: Bool[Array, ""] | bool = True  # whether the pose may be acted upon
    # Position of the nearest marker in vehicle axes, the same under all poses that are still
    # possible. Needed where `decided` may be False.
    to_marker_m: Float[Array, " 2"] | None = None
    # Measured speed, which exploration controls; NaN: it drives open-loop.
    speed_mps: Float[Array, ""] | float = np.nan

    def elapsed_s(self) -> Float[Array, ""]:
        """`dt_s` where it is a time, else 0."""
        return jnp.where(jnp.isfinite(self.dt_s) & (self.dt_s > 0), self.dt_s, 0)


class Follower(eqx.Module):
    """Base class of the controllers: waypoint after waypoint, whatever is commanded."""

    waypoints_m: eqx.AbstractVar[Float[Array, "W 2"]]
    waypoint_radius_m: eqx.AbstractVar[Float[Array, ""]]
    vehicle: eqx.AbstractVar[Vehicle | TwistBase]

    @classmethod
    def along(
        cls: type[Kind],
        waypoints_m: Sequence[Sequence[float]] | Float[Array, "W 2"],
        vehicle: Vehicle | TwistBase | None,
        **numbers: float,
    ) -> Kind:
        """A controller of plain numbers, by the names of its fields.

        Raises:
            ValueError: no vehicle, or waypoints of the wrong shape.
        """
        waypoints = jnp.asarray(waypoints_m, float)
        if vehicle is None:
            raise ValueError("waypoints_m needs a vehicle to drive")
        if waypoints.ndim != 2 or waypoints.shape[1] != 2:
            raise ValueError(f"waypoints_m must be (W, 2), got {waypoints.shape}")
        arrays: dict[str, Any] = {k: jnp.asarray(number, float) for k, number in numbers.items()}
        return cls(waypoints_m=waypoints, vehicle=vehicle, **arrays)

    def init(self) -> ControlState:
        """The state at the first waypoint, with a zero integral."""
        zero = jnp.zeros_like(self.waypoint_radius_m)
        return ControlState(jnp.asarray(0), zero, zero, zero)

    def __call__(
        self, state: ControlState, given: ControlInput
    ) -> tuple[ControlState, Any, Bool[Array, ""], ControlLog]:
        """One command, towards the next waypoint if the present one is reached.

        Returns:
            The next state, the command, whether the last waypoint is reached, and the log.
        """
        count, index = self.waypoints_m.shape[0], state.waypoint_index
        short_m = self.short_of(index, given.pose)
        arrived = given.located & given.decided & (short_m <= 0)
        index = jnp.minimum(index + (arrived & (index < count)), count)
        integral_ms = jnp.where(arrived, 0, state.integral_ms)
        state = ControlState(index, integral_ms, state.explored_s, state.side)
        return self.towards(state, given)

    @abc.abstractmethod
    def towards(
        self, state: ControlState, given: ControlInput
    ) -> tuple[ControlState, Any, Bool[Array, ""], ControlLog]:
        """One command towards the waypoint of the state, whether it is reached or not."""

    def way(
        self, state: ControlState, given: ControlInput, sideslip_rad: Float[Array, ""] | float = 0.0
    ) -> tuple[Float[Array, ""], Float[Array, ""], Bool[Array, ""], Bool[Array, ""]]:
        """The way to the waypoint of the state, for a course turned from the heading.

        Returns:
            Distance, m, and angle from the course, rad; whether the last waypoint is reached, and
            whether there is one, and a pose from which to drive there.
        """
        count, index = self.waypoints_m.shape[0], state.waypoint_index
        done = index >= count
        to_waypoint = self.waypoints_m[jnp.minimum(index, count - 1)] - given.pose[:2]
        distance_m = safe_norm(to_waypoint)
        bearing_rad = safe_atan2(to_waypoint[1], to_waypoint[0])
        alpha_rad = wrap_angle(bearing_rad - given.pose[2] - sideslip_rad)
        # A waypoint straight behind is on the left, not on the side of the last bit.
        alpha_rad = jnp.where(alpha_rad < EVEN_RAD - jnp.pi, alpha_rad + 2 * jnp.pi, alpha_rad)
        finite = jnp.isfinite(distance_m) & jnp.isfinite(alpha_rad)
        return distance_m, alpha_rad, done, given.located & ~done & finite

    def short_of(self, index: Int[Array, ""], pose: Float[Array, " 3"]) -> Float[Array, ""]:
        """Distance to the circle inside which a waypoint counts as reached, m; negative inside."""
        waypoint_m = self.waypoints_m[jnp.minimum(index, self.waypoints_m.shape[0] - 1)]
        return safe_norm(waypoint_m - pose[:2]) - self.waypoint_radius_m


class Controller(Follower):
    """Ackermann steering on an arc to the waypoint, and PI throttle on the distance to it.

        alpha = atan2(Y_d - y, X_d - x) - psi - beta                               (Eq. 17)
        steering = atan(2 l sin(alpha) / (L_d cos(beta)))                          (Eq. 18)
        throttle = p1 L_d + p2 integral of L_d dt                                  (Eq. 19)

    with the waypoint (X_d, Y_d) and its distance L_d, m, the pose (x, y, psi), the sideslip beta of
    the measured steering angle, and the wheelbase l.

    The paper's sum of distances never decreases. Here it is an integral over time, limited to
    `integral_limit_ms` and reset at every waypoint. The throttle is zero after the last waypoint,
    before the first pose, and where the pose is not finite. A car would orbit a waypoint inside the
    smallest circle it can drive: it drives straight on until it can reach the waypoint. While the
    pose is undecided the car explores instead, and no waypoint counts as reached.

    The paper lacks `lookahead_m` and `slows_at_rad`; at their default, infinity, they have no
    effect.

    Source: Liu, Schofield, Shan (2023), Eqs. 16-19; see docs/design.md, Steering and throttle.
    """

    waypoints_m: Float[Array, "W 2"]
    waypoint_radius_m: Float[Array, ""]
    vehicle: Vehicle
    proportional_per_m: Float[Array, ""]  # p1, throttle per metre
    integral_per_ms: Float[Array, ""]  # p2, throttle per metre second
    integral_limit_ms: Float[Array, ""]
    # Steers as towards a point at L_d / (1 + L_d / lookahead_m); inf: at the waypoint.
    lookahead_m: Float[Array, ""] | float = np.inf
    # The throttle is halved where |alpha| is this large; inf: never.
    slows_at_rad: Float[Array, ""] | float = np.inf
    exploration: Exploration = Exploration()

    def towards(
        self, state: ControlState, given: ControlInput
    ) -> tuple[ControlState, Command, Bool[Array, ""], ControlLog]:
        """One command towards the waypoint of the state, whether it is reached or not."""
        steering_limit, decided = self.vehicle.steering_limit_rad, given.decided
        steering_rad = jnp.where(jnp.isfinite(given.steering_rad), given.steering_rad, 0)
        beta_rad = sideslip_rad(jnp.clip(steering_rad, -steering_limit, steering_limit))
        distance_m, alpha_rad, done, drives = self.way(state, given, beta_rad)

        ahead_m = distance_m / (1 + distance_m / self.lookahead_m)
        steering = self._steering(alpha_rad, ahead_m, beta_rad)
        steering = jnp.where(self._orbited(alpha_rad, distance_m), 0, steering)
        grown_ms = jnp.where(drives & decided, distance_m * given.elapsed_s(), 0)
        integral_ms = jnp.clip(state.integral_ms + grown_ms, 0, self.integral_limit_ms)
        throttle = self.proportional_per_m * distance_m + self.integral_per_ms * integral_ms
        # Clipped, or a heading of 1e270 rad would leave inf / inf.
        off_course = jnp.clip(alpha_rad, -jnp.pi, jnp.pi) / self.slows_at_rad
        throttle = throttle / (1 + off_course**2)
        limit = self.vehicle.throttle_limit
        state, explore = self._explore(state, given, beta_rad)
        steering = jnp.where(decided, steering, explore.steering_rad)
        throttle = jnp.where(decided, jnp.clip(throttle, -limit, limit), explore.throttle)
        command = Command(
            steering_rad=jnp.where(drives, steering, 0),
            throttle=jnp.where(drives, throttle, 0),
        )
        log = ControlLog(distance_m, alpha_rad, beta_rad, integral_ms)
        state = dataclasses.replace(state, integral_ms=integral_ms)
        return state, command, done, log

    def _explore(
        self, state: ControlState, given: ControlInput, beta_rad: Float[Array, ""]
    ) -> tuple[ControlState, Command]:
        """The command while the pose is undecided; see `Exploration`."""
        zero, to_marker_m = jnp.zeros_like(beta_rad), given.to_marker_m
        if to_marker_m is None:
            return state, Command(zero, zero)
        explore, limit = self.exploration, self.vehicle.steering_limit_rad
        bearing_rad = safe_atan2(to_marker_m[1], to_marker_m[0])
        nearer_side = jnp.where(bearing_rad > EVEN_RAD, -1.0, 1.0).astype(beta_rad.dtype)
        side = jnp.where(state.side == 0, nearer_side, state.side)
        goes = explore.goes_on(state, to_marker_m)
        alpha_rad = wrap_angle(bearing_rad + side * explore.angle_rad - beta_rad)
        steering = self._steering(alpha_rad, jnp.asarray(explore.reach_m, limit.dtype), beta_rad)
        overshoot = jnp.maximum(self.vehicle.speed_time_constant_s / explore.settle_s - 1, 0)
        short_mps = explore.speed_mps - given.speed_mps
        short_mps = jnp.where(jnp.isfinite(short_mps), short_mps, 0)
        throttle = (explore.speed_mps + overshoot * short_mps) / self.vehicle.speed_per_throttle_mps
        throttle = jnp.clip(throttle, 0, self.vehicle.throttle_limit)
        command = Command(steering, jnp.where(goes, throttle, 0))
        return state.exploring(given, side), command

    def _orbited(
        self, alpha_rad: Float[Array, ""], distance_m: Float[Array, ""]
    ) -> Bool[Array, ""]:
        """Whether the waypoint lies so deep inside the smallest circle that the car would orbit it.

        Driving straight on takes the waypoint out of the circle.
        """
        limit = self.vehicle.steering_limit_rad
        radius_m = 1 / curvature_per_m(limit, self.vehicle.wheelbase_m)
        # From the circle's centre, on the waypoint's side of the course.
        ahead_m = distance_m * jnp.cos(alpha_rad)
        aside_m = distance_m * jnp.abs(jnp.sin(alpha_rad)) - radius_m
        missed_by_m = radius_m - safe_norm(jnp.stack([ahead_m, aside_m]))
        return missed_by_m > self.waypoint_radius_m / 2

    def _steering(
        self, alpha_rad: Float[Array, ""], distance_m: Float[Array, ""], beta_rad: Float[Array, ""]
    ) -> Float[Array, ""]:
        """atan(2 l sin(alpha) / (L_d cos(beta))) (Eq. 18), within the limit.

        A waypoint behind the axle gets full lock: the arc of Eq. 18 would straighten out there and
        drive away from it.
        """
        reach_m = jnp.maximum(distance_m, 1e-3) * jnp.cos(beta_rad)
        arc = jnp.arctan(2 * self.vehicle.wheelbase_m * jnp.sin(alpha_rad) / reach_m)
        limit = self.vehicle.steering_limit_rad
        lock = jnp.where(alpha_rad >= 0, limit, -limit)
        return jnp.clip(jnp.where(jnp.abs(alpha_rad) > jnp.pi / 2, lock, arc), -limit, limit)


def follower_along(
    waypoints_m: Sequence[Sequence[float]] | Float[Array, "W 2"],
    vehicle: Vehicle | TwistBase | None,
    waypoint_radius_m: float,
    **throttle_gains: float,
) -> Follower | None:
    """The controller of a car or of another base, which has no throttle; None without waypoints.

    Raises:
        ValueError: no vehicle, or waypoints of the wrong shape.
    """
    if len(waypoints_m) == 0:
        return None
    if isinstance(vehicle, TwistBase):
        return TwistController.along(waypoints_m, vehicle, waypoint_radius_m=waypoint_radius_m)
    return Controller.along(
        waypoints_m, vehicle, waypoint_radius_m=waypoint_radius_m, **throttle_gains
    )


class TwistCommand(eqx.Module):
    """The twist of a base in its own axes, inside its limits."""

    forward_mps: Float[Array, ""]
    left_mps: Float[Array, ""]  # 0 for a differential drive
    turn_radps: Float[Array, ""]


class TwistController(Follower):
    """Pure pursuit, and turning on the spot, for a base that is driven by a twist.

    With the waypoint at the distance L and the angle alpha from the base's x axis, and the speed
    v = min(speed_mps, slows_per_s L), a differential drive gets

        p = max(0, (cos(alpha) - cos(spot)) / (1 - cos(spot)))
        forward = p v,    turn = 2 p v sin(alpha) / L + (1 - p) turns_per_s alpha:

    the arc through the waypoint where it lies ahead, a turn on the spot where it lies farther than
    `spot_rad` to the side, and in between a mixture without a jump. A base that can move to its
    left, left_limit_mps > 0, drives straight towards the waypoint and keeps its heading. Beyond a
    limit the whole twist is scaled down, so that the path stays.

    While the pose is undecided the base explores, with the course of `Exploration`: a turn about
    its own cameras would tell them little. A differential drive takes the side of the line of
    sight, and forward or backward, for which it turns least, 60 degrees at most; another base moves
    there as it stands. `Exploration.settle_s` is not looked at. All else is as in `Controller`.
    """

    waypoints_m: Float[Array, "W 2"]
    waypoint_radius_m: Float[Array, ""]
    vehicle: TwistBase
    speed_mps: Float[Array, ""] | float = 0.5
    slows_per_s: Float[Array, ""] | float = 1.0  # speed per distance, near a waypoint
    turns_per_s: Float[Array, ""] | float = 2.0  # turn rate per angle, on the spot
    spot_rad: float = float(np.deg2rad(60.0))
    exploration: Exploration = Exploration()

    def towards(
        self, state: ControlState, given: ControlInput
    ) -> tuple[ControlState, TwistCommand, Bool[Array, ""], ControlLog]:
        """One command towards the waypoint of the state; what wheels measured is not looked at."""
        distance_m, alpha_rad, done, drives = self.way(state, given)
        follow = self._twist(
            jnp.where(drives, alpha_rad, 0),
            jnp.where(drives, distance_m, 1),
            jnp.minimum(self.speed_mps, self.slows_per_s * distance_m),
        )
        state, explore = self._explore(state, given)
        twist = self._limited(jnp.where(given.decided, follow, explore))
        command = TwistCommand(*jnp.where(drives, twist, 0))
        zero = jnp.zeros_like(distance_m)
        return state, command, done, ControlLog(distance_m, alpha_rad, zero, zero)

    def _twist(
        self, alpha_rad: Float[Array, ""], distance_m: Float[Array, ""], speed: Float[Array, ""]
    ) -> Float[Array, " 3"]:
        """The twist to a point at an angle and a distance."""
        c, s = jnp.cos(alpha_rad), jnp.sin(alpha_rad)
        spot = jnp.cos(self.spot_rad)
        part = jnp.maximum((c - spot) / (1 - spot), 0)
        curvature = 2 * s / jnp.maximum(distance_m, 1e-3)
        turn = part * speed * curvature + (1 - part) * self.turns_per_s * alpha_rad
        differential = jnp.stack([part * speed, jnp.zeros_like(c), turn])
        sideways = jnp.stack([speed * c, speed * s, jnp.zeros_like(c)])
        return jnp.where(self.vehicle.left_limit_mps > 0, sideways, differential)

    def _explore(
        self, state: ControlState, given: ControlInput
    ) -> tuple[ControlState, Float[Array, " 3"]]:
        """The twist while the pose is undecided; see `Exploration`."""
        zero, to_marker_m = jnp.zeros_like(state.explored_s), given.to_marker_m
        if to_marker_m is None:
            return state, jnp.stack([zero] * 3)
        explore = self.exploration
        bearing_rad = safe_atan2(to_marker_m[1], to_marker_m[0])
        left, right = (bearing_rad + side * explore.angle_rad for side in (1, -1))
        turns_less = jnp.abs(jnp.sin(left)) < jnp.abs(jnp.sin(right)) + EVEN_RAD
        nearer_side = jnp.where(turns_less, 1.0, -1.0).astype(zero.dtype)
        side = jnp.where(state.side == 0, nearer_side, state.side)
        alpha_rad = wrap_angle(bearing_rad + side * explore.angle_rad)
        backs = (jnp.abs(alpha_rad) > jnp.pi / 2) & ~(self.vehicle.left_limit_mps > 0)
        alpha_rad = jnp.where(backs, wrap_angle(alpha_rad + jnp.pi), alpha_rad)
        reach_m, speed = (jnp.asarray(x, zero.dtype) for x in (explore.reach_m, explore.speed_mps))
        twist = self._twist(alpha_rad, reach_m, speed)
        twist = twist.at[0].multiply(jnp.where(backs, -1, 1))
        goes = explore.goes_on(state, to_marker_m)
        return state.exploring(given, side), jnp.where(goes, twist, 0)

    def _limited(self, twist: Float[Array, " 3"]) -> Float[Array, " 3"]:
        """The twist, scaled down until it is inside the limits."""
        limits = self.vehicle.limits
        beyond = jnp.abs(twist) / jnp.where(limits > 0, limits, 1)
        return twist / jnp.maximum(jnp.max(jnp.where(limits > 0, beyond, 0)), 1)
