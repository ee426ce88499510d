"""What a car senses, each thing at its own time: fused where it belongs, however late it comes.

Cameras look when they look, the odometer has a rate of its own, and a frame is as old as its
detection took. Whoever calls keeps the last events and what was believed after some of them (see
`loop.history`); a late event is fused from the belief before it, and all that came after
it once more, in one call:

    belief, then, control, output = advance(navigator, belief, control, events, count, new, ...)

In order, which is most of the time, that is one event and one turn of the loop. Where cameras look
more often than their frames take to come, every frame is late: what was believed right after the
one before, `then`, is where the next one starts.

Source: Larsen, Andersen, Ravn, Poulsen (1998), "Incorporation of time delayed measurements in a
discrete-time Kalman filter", section 2 (the filter recalculated through the delay).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnav.belief.estimate import Belief, Estimate, Evidence
from jaxnav.control import ControlState
from jaxnav.navigator import Navigator, Output
from jaxnav.pose.observation import Observation

# A pose is predicted to the present where its last event is older: at 1 m/s that is 1 mm.
FRESH_US = 1000


class Corners(eqx.Module):
    """What C cameras show of M markers in N readings."""

    corners_px: Float[Array, "N C M 4 2"]
    visible: Bool[Array, "N C M"]
    corner_sigma_px: Float[Array, "N C M 4"]


class Events(eqx.Module):
    """N readings in the order of their stamps: odometry, the corners of some cameras, or both."""

    stamps_us: Int[Array, " N"]  # int32, since the moment that they are fused from
    speed_mps: Float[Array, " N"]  # the last known where there is no odometry, NaN: never known
    steering_rad: Float[Array, " N"]
    has_odometry: Bool[Array, " N"]
    # None where none of them has any: a program without cameras, a third of the time of the other.
    corners: Corners | None

    def at(
        self, index: Int[Array, ""], dt_s: Float[Array, ""], lanes: tuple[int, int]
    ) -> Observation:
        """One of them, as `step` takes it.

        Args:
            lanes: how many cameras and markers there are.
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
    """Fuse events, and say where the vehicle is now and what it should do.

    Args:
        belief: before the first of them.
        control: of the last command.
        events: the new one, and those around it that are to be fused, once more or with it.
        count: how many of them there are; the rest of the N is not looked at.
        new: which of them is the new one.
        now_us: int32, since `belief`: the time for which pose and command are meant.
        elapsed_us: int32, since the last command.

    Returns:
        What is believed after the last event, what was after the new one, the controller's state,
        and what is known: pose and command of the present, and what the corners of the new
        event say.
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
        before, then, evidence = carry
        previous_us = jnp.where(index > 0, events.stamps_us[jnp.maximum(index - 1, 0)], 0)
        dt_s = seconds(events.stamps_us[index] - previous_us)
        after, of_this = sense(before, events.at(index, dt_s, lanes).usable())
        then, evidence = jax.tree.map(
            lambda a, b: jnp.where(index == new, a, b), (after, of_this), (then, evidence)
        )
        return after, then, evidence

    start = belief, belief, navigator.no_evidence(belief)
    belief, then, evidence = jax.lax.fori_loop(0, count, fuse, start)

    last_us = jnp.where(count > 0, events.stamps_us[jnp.maximum(count - 1, 0)], 0)
    age_us = now_us - last_us
    obs = events.at(new, seconds(elapsed_us), lanes)
    unheard = dataclasses.replace(obs, has_odometry=jnp.asarray(False), dt_s=seconds(age_us))
    present: Belief = jax.lax.cond(
        age_us > FRESH_US,
        lambda: navigator.coast(navigator.predict(belief, unheard.usable()))[0],
        lambda: belief,
    )
    estimate = Estimate.of(navigator.motion, present, evidence)
    last_heard = dataclasses.replace(obs, has_odometry=jnp.asarray(True))
    control, output = navigator.act(control, estimate, last_heard)
    return belief, then, control, output
