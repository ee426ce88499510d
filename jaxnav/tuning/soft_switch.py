"""The controller with waypoints that are left little by little: a drive that has derivatives.

The controller heads for one waypoint, then for the next. When it does so depends on its gains, but
no derivative of the commands says so: a number of frames has none. Here it heads for several at
once, each by its share, and a share moves on the more surely the nearer the waypoint is. As the
softness goes to 0 this becomes the controller itself.
"""

from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.control import Command, Controller, ControlLog, ControlState
from jaxnav.navigator import Navigator

DONE = 0.999  # of the shares past the last waypoint: the drive is over


class SoftState(ControlState):
    """What the soft controller remembers: for whoever asks, the waypoint of the largest share."""

    shares: Float[Array, " W1"]  # heading for each waypoint, the last: for none, done
    moved: Float[Array, " W"]  # what each has just handed on
    integrals_ms: Float[Array, " W"]  # one for each waypoint
    commands: Float[Array, "2 W"]  # throttle and steering towards each


class SoftController(eqx.Module):
    """In place of a navigator's `Controller`, whose law it applies to every waypoint.

    In a frame the part sigmoid((radius - distance) / softness) of a share moves on. Commands are
    those towards each waypoint, weighed by the shares; so is what each integral takes in.
    """

    controller: Controller
    softness_m: Float[Array, ""]  # 0: hard

    def init(self) -> SoftState:
        """All of it at the first waypoint."""
        hard = self.controller.init()
        count = self.controller.waypoints_m.shape[0]
        zero = jnp.zeros_like(hard.integral_ms)
        shares = jnp.zeros(count + 1, zero.dtype).at[0].set(1)
        zeros = jnp.zeros(count, zero.dtype)
        commands = jnp.stack([zeros, zeros])
        return SoftState(hard.waypoint_index, zero, zero, zero, shares, zeros, zeros, commands)

    def __call__(
        self,
        state: SoftState,
        pose: Float[Array, " 3"],
        located: Bool[Array, ""],
        steering_rad: Float[Array, ""],
        dt_s: Float[Array, ""],
        decided: Bool[Array, ""] | bool = True,
        to_marker_m: Float[Array, " 2"] | None = None,
        speed_mps: Float[Array, ""] | float = np.nan,
    ) -> tuple[SoftState, Command, Bool[Array, ""], ControlLog]:
        """As `Controller`; the log is that of the waypoint with the largest share."""
        control = self.controller
        waypoints = jnp.arange(control.waypoints_m.shape[0])
        short_m = jax.vmap(lambda index: control.short_of(index, pose))(waypoints)
        leaves = jnp.where(located & decided, _beyond(-short_m, self.softness_m), 0)
        moved = state.shares[:-1] * leaves
        nothing = jnp.zeros(1, moved.dtype)
        shares = state.shares - jnp.append(moved, nothing) + jnp.append(nothing, moved)

        def towards(index: Array, integral_ms: Array) -> tuple[ControlState, Command, ControlLog]:
            hard = ControlState(index, integral_ms, state.explored_s, state.side)
            after, command, _, log = control.towards(
                hard, pose, located, steering_rad, dt_s, decided, to_marker_m, speed_mps
            )
            return after, command, log

        after, commands, logs = jax.vmap(towards)(waypoints, state.integrals_ms)
        heading = shares[:-1]
        integrals_ms = state.integrals_ms + heading * (after.integral_ms - state.integrals_ms)
        command = jax.tree.map(lambda leaf: jnp.sum(heading * leaf), commands)
        most, done = jnp.argmax(heading), shares[-1] > DONE
        state = SoftState(
            waypoint_index=jnp.where(done, heading.shape[0], most),
            integral_ms=integrals_ms[most],
            explored_s=after.explored_s[0],  # alike for all waypoints, as is the side
            side=after.side[0],
            shares=shares,
            moved=moved,
            integrals_ms=integrals_ms,
            commands=jnp.stack([commands.throttle, commands.steering_rad]),
        )
        return state, command, done, jax.tree.map(lambda leaf: leaf[most], logs)


def softened(navigator: Navigator, softness_m: float | Float[Array, ""]) -> Navigator:
    """The navigator, with a soft switch from waypoint to waypoint.

    Raises:
        ValueError: it has no route.
    """
    if navigator.controller is None:
        raise ValueError("a navigator without waypoints has no drive to be tuned")
    soft = SoftController(
        navigator.controller,
        jnp.asarray(softness_m, navigator.controller.waypoint_radius_m.dtype),
    )
    return cast(Navigator, eqx.tree_at(lambda n: n.controller, navigator, soft))


def _beyond(value: Array, softness: Array) -> Array:
    """A step from 0 to 1 at 0, as wide as the softness."""
    soft = softness > 0
    sigmoid = jax.nn.sigmoid(value / jnp.where(soft, softness, 1))
    return jnp.where(soft, sigmoid, (value >= 0).astype(sigmoid.dtype))
