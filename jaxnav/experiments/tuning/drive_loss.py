"""Compute the loss of a drive: time, distance from the straight lines, effort, jerky commands."""

from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnav.core.models.geometry import safe_norm, safe_sqrt
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.pose.observation import Observation
from jaxnav.experiments.tuning.soft_switch import SoftState
from jaxnav.sim.rollout import Keep
from jaxnav.sim.scenarios import Scenario
from jaxnav.sim.world import DriveState


class Costs(eqx.Module):
    """The sums over a drive's frames while it is under way."""

    time_s: Float[Array, "*S"]  # to the last waypoint; without arrival the longest duration
    under_way_s: Float[Array, "*S"]
    off_line_m2s: Float[Array, "*S"]  # squared distance of the true car from its leg, over time
    effort_s: Float[Array, "*S"]  # squared commands, as fractions of their limits, over time
    change: Float[Array, "*S"]  # squared differences of successive such fractions


@dataclass(frozen=True)
class DriveLoss:
    """Weights of the four parts. With those given here each is about a quarter of 1 for the
    shipped gains in the paper's scenario.

    Attributes:
        time: weight of the time to the last waypoint, 1/s. A drive that leaves the floor, or whose
            true car has not passed every waypoint, is charged the longest duration.
        cross_track: weight of the RMS distance of the true car from the leg, 1/m: the line from
            the start or the waypoint before to the waypoint ahead.
        effort: weight of throttle^2 + steering^2, of another base of its squared twist, as
            fractions of their limits, over time, 1/s.
        smoothness: weight of the summed squared differences of those fractions between frames.
    """

    time: float = 0.03
    cross_track: float = 2.0
    effort: float = 0.13
    smoothness: float = 0.045

    def __call__(self, costs: Costs) -> Float[Array, "*S"]:
        """The loss of each drive."""
        return sum(self.parts(costs).values(), jnp.zeros_like(costs.time_s))

    def parts(self, costs: Costs) -> dict[str, Float[Array, "*S"]]:
        """The four weighted parts of the loss, by name."""
        under_way_s = jnp.where(costs.under_way_s > 0, costs.under_way_s, 1)
        return {
            "time": self.time * costs.time_s,
            "cross_track": self.cross_track * safe_sqrt(costs.off_line_m2s / under_way_s),
            "effort": self.effort * costs.effort_s,
            "smoothness": self.smoothness * costs.change,
        }


def no_costs(dtype: jnp.dtype) -> Costs:
    """The costs before the first frame: zero."""
    return Costs(*(jnp.zeros((), dtype),) * 5)


class CostsOfFrame(Keep):
    """A record of the costs of each frame, zero once the drive has ended.

    It takes a soft or a hard controller.
    """

    scenario: Scenario

    def __call__(self, before: DriveState, obs: Observation, after: DriveState) -> Costs:
        scenario, dtype = self.scenario, after.car.pose.dtype
        period_s = jnp.asarray(scenario.frame_period_s, dtype)
        waypoints_m = jnp.asarray(scenario.waypoints_m, dtype).reshape(-1, 2)
        count = waypoints_m.shape[0]
        course = _course(before, after, count)
        heading = jnp.where(before.ended, 0, course.shares[:-1])
        under_way = jnp.where(before.ended, 0, 1 - course.shares[-1])
        off_m2 = _off_line_m2(after.car.pose[:2], after.start_pose[:2], waypoints_m)
        given_up = after.ended & ~before.ended & ~(after.on_floor & (after.passed >= count))
        left = (scenario.frames - before.frame).astype(dtype) - under_way
        left_s = jnp.where(given_up, left, 0) * period_s
        going = jnp.where(before.ended, 0, course.going)
        return Costs(
            time_s=under_way * period_s + left_s,
            under_way_s=under_way * period_s,
            off_line_m2s=jnp.sum(heading * off_m2) * period_s,
            effort_s=jnp.sum(going * course.effort) * period_s,
            change=jnp.sum(going * course.change),
        )


class _Course(eqx.Module):
    """The waypoints a car heads for, and its squared commands as fractions of their limits.

    For a soft controller the squares are expectations over cars that switch at random: each share
    has its own command and its own jump, whether it stays at its waypoint or comes from the one
    before. The squares of the mean command would shrink as the switch gets softer.
    """

    shares: Float[Array, " W1"]  # for each waypoint, and done
    going: Float[Array, " n"]  # the share to which each of the following belongs
    effort: Float[Array, " n"]
    change: Float[Array, " n"]


def _course(before: DriveState, after: DriveState, count: int) -> _Course:
    was, now, car = before.state.control, after.state.control, after.truth.vehicle
    if isinstance(was, SoftState) and isinstance(now, SoftState):
        old, new = (_fractions(car, state.commands) for state in (was, now))
        came = now.moved[:-1]
        stayed = now.shares[:-1] - jnp.append(jnp.zeros_like(came[:1]), came)
        effort = jnp.sum(new**2, axis=0)
        jumps = jnp.sum((new[:, 1:] - old[:, :-1]) ** 2, axis=0)
        return _Course(
            now.shares,
            jnp.append(stayed, came),
            jnp.append(effort, effort[1:]),
            jnp.append(jnp.sum((new - old) ** 2, axis=0), jumps),
        )
    if now is None:
        raise ValueError("a navigator without waypoints has no drive to be tuned")
    old, new = (
        _fractions(car, jnp.stack(jax.tree.leaves(command))[:, None])
        for command in (before.command, after.command)
    )
    shares = (jnp.arange(count + 1) == now.waypoint_index).astype(new.dtype)
    effort, change = jnp.sum(new**2, axis=0), jnp.sum((new - old) ** 2, axis=0)
    return _Course(shares, 1 - shares[-1:], effort, change)


def _fractions(
    vehicle: Vehicle | TwistBase, commands: Float[Array, "parts n"]
) -> Float[Array, "parts n"]:
    """The parts of n commands, in the order of their fields, as fractions of their limits."""
    if isinstance(vehicle, TwistBase):
        limits = vehicle.limits
    else:
        limits = jnp.stack([vehicle.steering_limit_rad, vehicle.throttle_limit])
    # What can't move to its left is never commanded to.
    return commands / jnp.where(limits > 0, limits, 1)[:, None]


def _off_line_m2(
    point_m: Float[Array, " 2"], start_m: Float[Array, " 2"], waypoints_m: Float[Array, "W 2"]
) -> Float[Array, " W"]:
    """The squared distance from every leg's line, or from the waypoint if a leg has no length."""
    begins_m = jnp.concatenate([start_m[None], waypoints_m[:-1]])
    along = waypoints_m - begins_m
    length_m = safe_norm(along)
    away = point_m[None] - begins_m
    across_m2 = along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]
    some = length_m > 0
    across_m = across_m2 / jnp.where(some, length_m, 1)
    return jnp.where(some, across_m**2, jnp.sum(away**2, axis=1))
