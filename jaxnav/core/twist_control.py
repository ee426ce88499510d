"""A twist towards the next waypoint, for bases that are no cars.

Source: Coulter (1992), "Implementation of the pure pursuit path tracking algorithm".
"""

from collections.abc import Sequence

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.control import (
    ControlInput,
    Controller,
    ControlLog,
    ControlState,
    Exploration,
    Follower,
)
from jaxnav.core.models.bicycle import Vehicle
from jaxnav.core.models.geometry import EVEN_RAD, safe_atan2, safe_norm, wrap_angle
from jaxnav.core.models.twist_base import TwistBase


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
        range_m = safe_norm(to_marker_m)
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
        goes = (state.explored_s < explore.duration_s) & (range_m > explore.min_range_m)
        return state.exploring(given, side), jnp.where(goes, twist, 0)

    def _limited(self, twist: Float[Array, " 3"]) -> Float[Array, " 3"]:
        """The twist, scaled down until it is inside the limits."""
        limits = self.vehicle.limits
        beyond = jnp.abs(twist) / jnp.where(limits > 0, limits, 1)
        return twist / jnp.maximum(jnp.max(jnp.where(limits > 0, beyond, 0)), 1)
