"""Soften the controller's switch from waypoint to waypoint, so that a drive has derivatives.

The controller heads for one waypoint, then for the next. The frame of the switch depends on the
gains, but a number of frames has no derivative. The soft controller heads for several waypoints at
once, each with a share; the nearer the waypoint, the larger the part of its share that moves on. As
the softness goes to 0 this becomes the controller itself.
"""

from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnav.core.control import (
    Command,
    ControlInput,
    ControlLog,
    ControlState,
    Follower,
    TwistCommand,
)
from jaxnav.core.navigator import Navigator
from jaxnav.sim.plant import standing

DONE = 0.999  # with this share past the last waypoint the drive is over


class SoftState(ControlState):
    """The state of the soft controller; `waypoint_index` is the waypoint of the largest share."""

    shares: Float[Array, " W1"]  # heading for each waypoint; the last: done
    moved: Float[Array, " W"]  # the share that each waypoint has just passed on
    integrals_ms: Float[Array, " W"]  # one for each waypoint
    commands: Float[Array, "parts W"]  # towards each, its parts in the order of their fields


class SoftController(eqx.Module):
    """A replacement for a navigator's controller that applies its law to every waypoint.

    In each frame the part sigmoid((radius - distance) / softness) of a share moves on. The shares
    weight the commands towards the waypoints, which are summed, and the integrals' increments.
    """

    controller: Follower
    softness_m: Float[Array, ""]  # 0: hard

    def init(self) -> SoftState:
        """The state with the whole share at the first waypoint."""
        hard = self.controller.init()
        count = self.controller.waypoints_m.shape[0]
        zero = jnp.zeros_like(hard.integral_ms)
        shares = jnp.zeros(count + 1, zero.dtype).at[0].set(1)
        zeros = jnp.zeros(count, zero.dtype)
        parts = jax.tree.leaves(standing(self.controller.vehicle, zero.dtype))
        commands = jnp.stack([zeros] * len(parts))
        return SoftState(hard.waypoint_index, zero, zero, zero, shares, zeros, zeros, commands)

    def __call__(
        self, state: SoftState, given: ControlInput
    ) -> tuple[SoftState, Command | TwistCommand, Bool[Array, ""], ControlLog]:
        """Control as the controller does; the log is of the waypoint with the largest share."""
        control = self.controller
        waypoints = jnp.arange(control.waypoints_m.shape[0])
        short_m = jax.vmap(lambda index: control.short_of(index, given.pose))(waypoints)
        leaves = jnp.where(given.located & given.decided, _beyond(-short_m, self.softness_m), 0)
        moved = state.shares[:-1] * leaves
        nothing = jnp.zeros(1, moved.dtype)
        shares = state.shares - jnp.append(moved, nothing) + jnp.append(nothing, moved)

        def towards(index: Array, integral_ms: Array) -> tuple[ControlState, Any, ControlLog]:
            hard = ControlState(index, integral_ms, state.explored_s, state.side)
            after, command, _, log = control.towards(hard, given)
            return after, command, log

        after, commands, logs = jax.vmap(towards)(waypoints, state.integrals_ms)
        heading = shares[:-1]
        integrals_ms = state.integrals_ms + heading * (after.integral_ms - state.integrals_ms)
        command = jax.tree.map(lambda leaf: jnp.sum(heading * leaf), commands)
        most, done = jnp.argmax(heading), shares[-1] > DONE
        state = SoftState(
            waypoint_index=jnp.where(done, heading.shape[0], most),
            integral_ms=integrals_ms[most],
            explored_s=after.explored_s[0],  # the same for all waypoints, as is the side
            side=after.side[0],
            shares=shares,
            moved=moved,
            integrals_ms=integrals_ms,
            commands=jnp.stack(jax.tree.leaves(commands)),
        )
        return state, command, done, jax.tree.map(lambda leaf: leaf[most], logs)


def soften_switch(navigator: Navigator, softness_m: float | Float[Array, ""]) -> Navigator:
    """The navigator, with a soft switch from waypoint to waypoint.

    Raises:
        ValueError: it has no route.
    """
    if navigator.controller is None:
        raise ValueError("a navigator without waypoints has no drive to be tuned")
    soft = SoftController(
        navigator.controller, jnp.asarray(softness_m, navigator.controller.waypoint_radius_m.dtype)
    )
    return cast(Navigator, eqx.tree_at(lambda n: n.controller, navigator, soft))


def _beyond(value: Array, softness: Array) -> Array:
    """A step from 0 to 1 at 0, with the width `softness`."""
    soft = softness > 0
    sigmoid = jax.nn.sigmoid(value / jnp.where(soft, softness, 1))
    return jnp.where(soft, sigmoid, (value >= 0).astype(sigmoid.dtype))
