"""What a drive costs: time, distance from the straight lines, effort, and jerky commands."""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnav.models.geometry import safe_norm, safe_sqrt
from jaxnav.simulation.scenarios import Scenario
from jaxnav.simulation.world import World
from jaxnav.tuning.soft_switch import SoftState


class Costs(eqx.Module):
    """What is summed over the frames of a drive while it is under way."""

    time_s: Float[Array, "*S"]  # to the last waypoint; without arrival as long as a drive may last
    under_way_s: Float[Array, "*S"]
    off_line_m2s: Float[Array, "*S"]  # squared distance of the true car from its leg, over time
    effort_s: Float[Array, "*S"]  # squared commands, in parts of their limits, over time
    change: Float[Array, "*S"]  # squared difference of successive commands, in the same parts


@dataclass(frozen=True)
class DriveLoss:
    """Weights of the four parts. With those given here each is about a quarter of 1 for the
    shipped gains in the paper's scenario.

    Attributes:
        time: of the time to the last waypoint, 1/s. A drive that leaves the floor, or whose true
            car has not passed every waypoint, pays for as long as it might have lasted.
        cross_track: of the root mean square distance of the true car from the leg, 1/m: the line
            from where the leg began, the start or the waypoint before, to the waypoint ahead.
        effort: of throttle^2 + steering^2, each in parts of its limit, over time, 1/s.
        smoothness: of the squared differences from frame to frame of the same, summed up.
    """

    time: float = 0.03
    cross_track: float = 2.0
    effort: float = 0.13
    smoothness: float = 0.045

    def __call__(self, costs: Costs) -> Float[Array, "*S"]:
        """One number of a whole drive."""
        return sum(self.parts(costs).values(), jnp.zeros_like(costs.time_s))

    def parts(self, costs: Costs) -> dict[str, Float[Array, "*S"]]:
        """The four of them, weighed."""
        under_way_s = jnp.where(costs.under_way_s > 0, costs.under_way_s, 1)
        return {
            "time": self.time * costs.time_s,
            "cross_track": self.cross_track * safe_sqrt(costs.off_line_m2s / under_way_s),
            "effort": self.effort * costs.effort_s,
            "smoothness": self.smoothness * costs.change,
        }


def no_costs(dtype: jnp.dtype) -> Costs:
    """Before the first frame."""
    return Costs(*(jnp.zeros((), dtype),) * 5)


@dataclass(frozen=True)
class CostsOfFrame:
    """What a frame adds, the controller soft or hard; nothing once the drive is over.

    Compares by value, so that `Rollout.run_keeping` compiles once for it.
    """

    scenario: Scenario

    def __call__(self, before: World, after: World) -> Costs:
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
    """Where a car heads, and the squares of its commands in parts of their limits.

    A soft one is the expectation over cars that switch at random: each share's own command and own
    jump, whether it stays at its waypoint or comes from the one before. Those of the mean command
    would be less the softer the switch.
    """

    shares: Float[Array, " W1"]  # for each waypoint, and done
    going: Float[Array, " n"]  # shares of whoever does the following
    effort: Float[Array, " n"]
    change: Float[Array, " n"]


def _course(before: World, after: World, count: int) -> _Course:
    was, now, car = before.state.control, after.state.control, after.truth.vehicle
    limits = jnp.stack([car.throttle_limit, car.steering_limit_rad])[:, None]
    if isinstance(was, SoftState) and isinstance(now, SoftState):
        old, new = (state.commands / limits for state in (was, now))
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
        jnp.stack([world.command.throttle, world.command.steering_rad])[:, None] / limits
        for world in (before, after)
    )
    shares = (jnp.arange(count + 1) == now.waypoint_index).astype(new.dtype)
    effort, change = jnp.sum(new**2, axis=0), jnp.sum((new - old) ** 2, axis=0)
    return _Course(shares, 1 - shares[-1:], effort, change)


def _off_line_m2(
    point_m: Float[Array, " 2"], start_m: Float[Array, " 2"], waypoints_m: Float[Array, "W 2"]
) -> Float[Array, " W"]:
    """Squared distance from the line of every leg; from the waypoint where a leg has no length."""
    begins_m = jnp.concatenate([start_m[None], waypoints_m[:-1]])
    along = waypoints_m - begins_m
    length_m = safe_norm(along)
    away = point_m[None] - begins_m
    across_m2 = along[:, 0] * away[:, 1] - along[:, 1] * away[:, 0]
    some = length_m > 0
    across_m = across_m2 / jnp.where(some, length_m, 1)
    return jnp.where(some, across_m**2, jnp.sum(away**2, axis=1))
