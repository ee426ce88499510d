"""Fusion of events at their own times, also where they arrive late or out of order.

Cameras and odometer have rates of their own, and a frame is as old as its detection took. The
caller keeps the last events, and the beliefs after some of them (see `loop.history`). A late event
is fused from the belief before it, and the events after it are fused once more, in one call:

    belief, after_new, control, output = advance(navigator, belief, control, events, count, ...)

Events in order, the usual case, take one turn of the loop. Where a camera's period is shorter than
its delay every frame is late: the belief right after a frame, `after_new`, is where the next one
starts.

Source: Larsen, Andersen, Ravn, Poulsen (1998), "Incorporation of time delayed measurements in a
discrete-time Kalman filter", section 2 (the filter recalculated through the delay).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.control import ControlState
from jaxnav.core.filter.estimate import Belief, Estimate, Evidence
from jaxnav.core.navigator import Navigator, Output
from jaxnav.core.pose.observation import Observation

# A pose whose last event is older is predicted to the present: 1 mm at 1 m/s.
FRESH_US = 1000


class Corners(eqx.Module):
    """Corners of M markers in C cameras, in N readings."""

    corners_px: Float[Array, "N C M 4 2"]
    visible: Bool[Array, "N C M"]
    corner_sigma_px: Float[Array, "N C M 4"]


class Events(eqx.Module):
    """N readings in the order of their stamps: odometry, the corners of some cameras, or both."""

    stamps_us: Int[Array, " N"]  # int32, time since the belief from which they are fused
    speed_mps: Float[Array, " N"]  # the last reading where there is no odometry; NaN: none yet
    steering_rad: Float[Array, " N"]
    has_odometry: Bool[Array, " N"]
    # None where no event has corners: that program takes a third of the time of the other.
    corners: Corners | None
    # Of a `TwistBase`, in place of speed and steering: v_x, v_y, omega.
    twists: Float[Array, "N 3"] | None = None
    # Of a vehicle with a gyro: its mean rate since the reading before, and since the last one; NaN
    # where it has told none.
    gyro_radps: Float[Array, " N"] | None = None
    gyro_since_radps: Float[Array, ""] | None = None

    def at(
        self, index: Int[Array, ""], dt_s: Float[Array, ""], lanes: tuple[int, int]
    ) -> Observation:
        """One event as an `Observation`.

        Args:
            index: which event.
            dt_s: time since the previous event.
            lanes: (C, M), how many cameras and markers there are.
        """
        seen = self.corners
        return Observation(
            corners_px=jnp.zeros((*lanes, 4, 2)) if seen is None else seen.corners_px[index],
            visible=jnp.zeros(lanes, bool) if seen is None else seen.visible[index],
            speed_mps=self.speed_mps[index],
            steering_rad=self.steering_rad[index],
            dt_s=dt_s,
            corner_sigma_px=None if seen is None else seen.corner_sigma_px[index],
            has_odometry=self.has_odometry[index],
            twist=None if self.twists is None else _twist(self.twists[index]),
            gyro_radps=None if self.gyro_radps is None else _about_z(self.gyro_radps[index]),
        )


def advance(
    navigator: Navigator,
    belief: Belief,
    control: ControlState | None,
    events: Events,
    count: Int[Array, ""],
    new: Int[Array, ""],
    now_us: Int[Array, ""],
    elapsed_us: Int[Array, ""],
) -> tuple[Belief, Belief, ControlState | None, Output]:
    """Fuse events, predict to the present, and compute a command.

    Args:
        navigator: senses and acts.
        belief: before the first event.
        control: the controller's state after the last command, None without a route.
        events: N slots, the first `count` of which are fused, in the order of their stamps: the
            new event, and those around it that have to be fused once more.
        count: how many events there are; the other slots are not read.
        new: index of the new event.
        now_us: int32, time since `belief` for which pose and command are meant.
        elapsed_us: int32, time since the last command.

    Returns:
        The belief after the last event, the belief after the new event, the controller's state,
        and the output: pose and command at `now_us`, with the evidence of the new event.
    """
    lanes = len(navigator.rig), len(navigator.markers.ids)

    def sense(before: Belief, obs: Observation) -> tuple[Belief, Evidence]:
        if events.corners is None:
            return navigator.coast(navigator.predict(before, obs))
        after, estimate = navigator.sense(before, obs)
        return after, estimate.evidence

    def seconds(us: Array) -> Array:
        return us.astype(navigator.corner_sigma_px.dtype) * 1e-6

    def fuse(
        index: Array, carry: tuple[Belief, Belief, Evidence]
    ) -> tuple[Belief, Belief, Evidence]:
        before, after_new, evidence = carry
        previous_us = jnp.where(index > 0, events.stamps_us[jnp.maximum(index - 1, 0)], 0)
        dt_s = seconds(events.stamps_us[index] - previous_us)
        after, of_this = sense(before, events.at(index, dt_s, lanes).usable())
        after_new, evidence = jax.tree.map(
            lambda a, b: jnp.where(index == new, a, b), (after, of_this), (after_new, evidence)
        )
        return after, after_new, evidence

    start = belief, belief, navigator.no_evidence(belief)
    belief, after_new, evidence = jax.lax.fori_loop(0, count, fuse, start)

    last_us = jnp.where(count > 0, events.stamps_us[jnp.maximum(count - 1, 0)], 0)
    age_us = now_us - last_us
    obs = events.at(new, seconds(elapsed_us), lanes)
    since = events.gyro_since_radps
    unheard = dataclasses.replace(
        obs,
        has_odometry=jnp.asarray(False),
        dt_s=seconds(age_us),
        gyro_radps=None if since is None else _about_z(since),
    )
    present: Belief = jax.lax.cond(
        age_us > FRESH_US,
        lambda: navigator.coast(navigator.predict(belief, unheard.usable()))[0],
        lambda: belief,
    )
    estimate = Estimate.from_belief(navigator.motion, present, evidence)
    last_heard = dataclasses.replace(obs, has_odometry=jnp.asarray(True))
    control, output = navigator.act(control, estimate, last_heard)
    return belief, after_new, control, output


def _twist(planar: Float[Array, " 3"]) -> Float[Array, " 6"]:
    """The twist of a motion (v_x, v_y, omega) in the plane."""
    zeros = jnp.zeros_like(planar)
    return jnp.concatenate([planar[:2], zeros, planar[2:]])


def _about_z(rate_radps: Float[Array, ""]) -> Float[Array, " 3"]:
    """The angular velocity of a turn in the plane."""
    zero = jnp.zeros_like(rate_radps)
    return jnp.stack([zero, zero, rate_radps])
