"""What a car senses, each thing at its own time: fused where it belongs, however late it comes.

Cameras look when they look, the odometer has a rate of its own, and a frame is as old as its
detection took. Whoever calls keeps the last events and what was believed after some of them (see
`loop.history`); a late event is fused from the belief before it, and all that came after
it once more, in one call:

    moment, then, control, report = advance(navigator, moment, control, events, count, new, ...)

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

from jaxnav.belief.motion import Belief
from jaxnav.control import ControlState
from jaxnav.navigator import Estimate, Navigator, Output
from jaxnav.pose.candidates import Candidates
from jaxnav.pose.consistency import consistent
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


class Moment(eqx.Module):
    """What was believed after an event."""

    belief: Belief
    decided: Bool[Array, ""]
    flip_probability: Float[Array, ""]
    restarts: Int[Array, ""]  # so far: how often all that was believed had to be given up


class Report(eqx.Module):
    """Everything that is known after an event. Of `output`, pose and command are those of the
    present, candidates and what was made of them those of the new event."""

    output: Output
    mean: Float[Array, " n"]  # of the motion model's state, at present
    outvoted: Bool[Array, " M"]  # markers that the others in view of the new event contradict


class _Found(eqx.Module):
    """What the corners of an event told."""

    candidates: Candidates
    costs: Float[Array, " N"]
    selected: Int[Array, ""]
    nis: Float[Array, ""]
    outvoted: Bool[Array, " M"]


def begin(navigator: Navigator) -> Moment:
    """Nothing sensed yet."""
    belief = navigator.init().belief
    return Moment(
        belief=belief,
        decided=jnp.asarray(False),
        flip_probability=jnp.zeros((), belief.mean.dtype),
        restarts=jnp.zeros((), jnp.int32),
    )


def advance(
    navigator: Navigator,
    moment: Moment,
    control: ControlState | None,
    events: Events,
    count: Int[Array, ""],
    new: Int[Array, ""],
    now_us: Int[Array, ""],
    elapsed_us: Int[Array, ""],
) -> tuple[Moment, Moment, ControlState | None, Report]:
    """Fuse events, and say where the vehicle is now and what it should do.

    Args:
        moment: what was believed before the first of them.
        control: of the last command.
        events: the new one, and those around it that are to be fused, once more or with it.
        count: how many of them there are; the rest of the N is not looked at.
        new: which of them is the new one.
        now_us: int32, since `moment`: the time for which pose and command are meant.
        elapsed_us: int32, since the last command.

    Returns:
        What is believed after the last event, what was after the new one, the controller's state,
        and what is to be told.
    """
    nothing, lanes = _nothing(navigator, moment), _lanes(navigator)

    def fuse(carry: tuple[Array, Moment, Moment, _Found]) -> tuple[Array, Moment, Moment, _Found]:
        index, before, then, found = carry
        previous_us = jnp.where(index > 0, events.stamps_us[jnp.maximum(index - 1, 0)], 0)
        dt_s = _seconds(navigator, events.stamps_us[index] - previous_us)
        obs = events.at(index, dt_s, lanes).usable()
        after, of_this = _after(navigator, before, obs, nothing, events.corners is None)
        then, found = jax.tree.map(
            lambda a, b: jnp.where(index == new, a, b), (after, of_this), (then, found)
        )
        return index + 1, after, then, found

    _, moment, then, found = jax.lax.while_loop(
        lambda carry: carry[0] < count, fuse, (jnp.zeros_like(count), moment, moment, nothing)
    )
    last = jnp.maximum(count - 1, 0)
    age_us = jnp.where(count > 0, now_us - events.stamps_us[last], now_us)
    obs = events.at(new, _seconds(navigator, elapsed_us), lanes)
    obs = dataclasses.replace(obs, has_odometry=jnp.asarray(True))
    control, report = _reported(navigator, moment, control, obs.usable(), found, age_us)
    return moment, then, control, report


def _after(
    navigator: Navigator, before: Moment, obs: Observation, nothing: _Found, blind: bool
) -> tuple[Moment, _Found]:
    """What is believed after an observation.

    Args:
        blind: no event of the call shows corners.
    """

    def coasted() -> tuple[Moment, _Found]:
        belief = navigator.coast(before.belief, obs)
        located = jnp.any(belief.initialised)
        given_up = jnp.any(before.belief.initialised) & ~located
        return Moment(
            belief,
            before.decided & located,
            jnp.where(located, before.flip_probability, 0),
            before.restarts + given_up,
        ), nothing

    def looked() -> tuple[Moment, _Found]:
        found = consistent(navigator.snapshot(obs), navigator.find_candidates)

        def estimated() -> tuple[Moment, _Found]:
            estimate = navigator.estimate(before.belief, found.snapshot, found.candidates)
            return Moment(
                estimate.belief,
                estimate.decided,
                estimate.flip_probability.astype(before.flip_probability.dtype),
                before.restarts + estimate.restarted,
            ), _Found(
                found.candidates, estimate.costs, estimate.selected, estimate.nis, found.outvoted
            )

        after: tuple[Moment, _Found] = jax.lax.cond(
            jnp.any(found.snapshot.seen.visible), estimated, coasted
        )
        return after

    if blind:
        return coasted()
    after: tuple[Moment, _Found] = jax.lax.cond(jnp.any(obs.visible), looked, coasted)
    return after


def _nothing(navigator: Navigator, moment: Moment) -> _Found:
    """What an event without corners tells."""
    candidates = navigator.no_candidates()
    costs = jnp.full_like(candidates.cost, jnp.inf)
    nobody = jnp.zeros(len(navigator.markers.ids), bool)
    nis = jnp.zeros((), moment.belief.mean.dtype)
    return _Found(candidates, costs, jnp.asarray(-1), nis, nobody)


def _reported(
    navigator: Navigator,
    moment: Moment,
    control: ControlState | None,
    obs: Observation,
    found: _Found,
    age_us: Array,
) -> tuple[ControlState | None, Report]:
    """Pose and command at present, `obs` holding the odometry that is known."""
    blind = dataclasses.replace(
        obs, has_odometry=jnp.asarray(False), dt_s=_seconds(navigator, age_us)
    )
    belief: Belief = jax.lax.cond(
        age_us > FRESH_US,
        lambda: navigator.coast(moment.belief, blind),
        lambda: moment.belief,
    )
    best = navigator.believed(belief)
    present = Estimate(
        belief=belief,
        best=best,
        costs=found.costs,
        selected=found.selected,
        flip_probability=moment.flip_probability,
        decided=moment.decided & best.located,
        nis=found.nis,
        restarted=jnp.asarray(False),
        log_likelihood=jnp.zeros((), belief.mean.dtype),
    )
    control, output = navigator.act(control, obs, found.candidates, present)
    return control, Report(output, best.mean, found.outvoted)


def _lanes(navigator: Navigator) -> tuple[int, int]:
    """Cameras and markers."""
    return len(navigator.rig), len(navigator.markers.ids)


def _seconds(navigator: Navigator, microseconds: Array) -> Array:
    return microseconds.astype(navigator.corner_sigma_px.dtype) * 1e-6
