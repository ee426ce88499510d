"""Choose in hindsight which of a marker's poses was true: a discrete choice before a descent.

The whole estimator runs over a recording, from a cold start. Once it has decided, it knows the
vehicle's earlier poses too: the decided pose, carried back to the first frame by odometry, is the
prior of one hypothesis, so wide that it only says which local minimum is the true one. From there
the filter is smooth in its noise parameters.
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter.bank import Bank, heaviest
from jaxnav.core.filter.kalman import nis
from jaxnav.core.filter.motion import Motion
from jaxnav.core.filter.odometry import SIX, velocity_of_twist
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.geometry import (
    T_world_vehicle_from_planar,
    planar_from_T_world_vehicle,
)
from jaxnav.core.models.vehicle import TwistBase, advance_bicycle, advance_twist
from jaxnav.core.navigator import Navigator, State
from jaxnav.core.pose.observation import Observation
from jaxnav.experiments.tuning.recorded import FrameSequences
from jaxnav.files.executables import kept

# Standard deviation of a pose that was carried back, m and rad: a third of the difference between
# the two poses of a marker where they can be mistaken for each other.
_CARRIED_SIGMA = 0.3
_LEAST_SHARE = 1e-4  # added to the diagonal of the correlation matrix
_SEQUENCES, _FRAMES = 32, 64  # estimated in one call


class SequenceEstimates(eqx.Module):
    """The output of the whole estimator in every frame of B sequences."""

    T_world_vehicle: Float[Array, "*B T 7"]
    square_m2: Float[Array, "*B T"]  # squared position error
    nees: Float[Array, "*B T"]
    decided: Bool[Array, "*B T"]


def estimate_sequences(
    navigator: Navigator,
    recorded: FrameSequences,
    progress: Callable[[int], object] = lambda count: None,
) -> SequenceEstimates:
    """Estimate all sequences from cold starts. Frames not used or judged hold no valid values.

    Some sequences and frames at a time, so that one program serves any number of both.

    Args:
        progress: called with the number of sequences estimated since the last call.
    """
    count, frames = recorded.used.shape
    whole = jax.device_get(recorded.pad_to(-(-frames // _FRAMES) * _FRAMES))
    first = jax.tree.map(
        lambda leaf: np.broadcast_to(leaf, (_SEQUENCES, *leaf.shape)),
        jax.device_get(_cold(navigator)),
    )
    parts = []
    for begin in range(0, count, _SEQUENCES):
        some = whole.rows(np.minimum(np.arange(begin, begin + _SEQUENCES), count - 1))
        state, estimates = first, []
        for at in range(0, whole.used.shape[1], _FRAMES):
            state, estimate = _estimated(navigator, state, some.frames(slice(at, at + _FRAMES)))
            estimates.append(jax.device_get(estimate))
        kept_rows = min(_SEQUENCES, count - begin)
        parts.append(
            jax.tree.map(
                lambda *leaves: np.concatenate(leaves, axis=1)[:kept_rows, :frames],  # noqa: B023
                *estimates,
            )
        )
        progress(kept_rows)
    joined: SequenceEstimates = jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
    return joined


@kept
def _cold(navigator: Navigator) -> State:
    return navigator.init()


@kept
def _estimated(
    navigator: Navigator, states: State, recorded: FrameSequences
) -> tuple[State, SequenceEstimates]:
    """The states of sequences some frames later, and the estimate of each frame."""

    def one(state: State, recorded: FrameSequences) -> tuple[State, SequenceEstimates]:
        local = eqx.tree_at(lambda n: n.markers, navigator, recorded.markers)

        def frame(
            state: State, now: tuple[Observation, Array, Array]
        ) -> tuple[State, SequenceEstimates]:
            obs, used, truth = now
            after, out = local.step(state, obs)
            after = jax.tree.map(lambda a, b: jnp.where(used, a, b), after, state)
            bank = after.belief.bank
            error = error_of(local.motion, bank.mean[heaviest(bank)], jaxlie.SE3(truth))
            d = error.shape[0]
            return after, SequenceEstimates(
                out.T_world_vehicle.wxyz_xyz,
                jnp.sum(error[: position_states(d)] ** 2),
                nees(error, out.covariance[:d, :d]),
                out.decided & out.located & used,
            )

        frames = (recorded.obs, recorded.used, recorded.T_world_vehicle_true)
        return jax.lax.scan(frame, state, frames)

    return jax.vmap(one)(states, recorded)


def error_of(motion: Motion, mean: Float[Array, " n"], T_true: jaxlie.SE3) -> Float[Array, " d"]:
    """The error of a state's pose in its covariance's coordinates: (3,) car, (6,) free body."""
    planar = isinstance(motion, BicycleKalman)
    pose = planar_from_T_world_vehicle(T_true) if planar else T_true.wxyz_xyz
    true = jnp.concatenate([pose, mean[pose.shape[0] :]])
    return motion.difference(true, mean)[: 3 if planar else 6]


def nees(error: Float[Array, " d"], P: Float[Array, "d d"]) -> Float[Array, ""]:
    """The normalised error squared, by the correlations: variances may differ by any order.

    From afar a rotation and a translation are hardly distinguishable: their correlation, as rounded
    to float32, is kept positive definite by a hundredth of a sigma.
    """
    sigma = jnp.sqrt(jnp.diagonal(P))
    correlation = P / (sigma[:, None] * sigma[None])
    return nis(error / sigma, correlation + _LEAST_SHARE * jnp.eye(P.shape[0], dtype=P.dtype))


def position_states(pose_states: int) -> int:
    """The number of a pose's error states that are lengths."""
    return 2 if pose_states == 3 else 3


class SequenceStarts(eqx.Module):
    """The start of each of B sequences: one hypothesis, in the local minimum chosen as true."""

    bank: Bank
    chosen: Bool[Array, "*B"]  # False: never decided, so the sequence carries no information


def find_starts(navigator: Navigator, recorded: FrameSequences) -> SequenceStarts:
    """The start of every sequence, as this navigator decided."""
    seen = estimate_sequences(navigator, recorded)
    decided = np.asarray(seen.decided)
    first = np.argmax(decided, axis=1)
    poses = np.asarray(seen.T_world_vehicle)[np.arange(len(recorded)), first]
    poses = _carried_back(navigator, recorded.obs, poses, first)
    return SequenceStarts(_around(navigator, poses), jnp.asarray(decided.any(axis=1)))


@kept
def _carried_back(
    navigator: Navigator, obs: Observation, T_world_vehicle: Array, frames: Array
) -> Float[Array, "B 7"]:
    """The pose of each vehicle in its first frame, from its pose in a later frame.

    A body without odometry is assumed at rest: the estimator decides within a few frames.
    """
    if not isinstance(navigator.motion, BicycleKalman):
        return T_world_vehicle
    vehicle = navigator.motion.vehicle

    def one(obs: Observation, pose: Array, frame: Array) -> Array:
        def back(pose: Array, now: tuple[Observation, Array]) -> tuple[Array, None]:
            # Events without odometry, such as frames, hold the last reading.
            obs, index = dataclasses.replace(now[0], has_odometry=True).usable(), now[1]
            speed_mps, steering_rad, dt_s = (
                jnp.asarray(x, pose.dtype) for x in (obs.speed_mps, obs.steering_rad, obs.dt_s)
            )
            if isinstance(vehicle, TwistBase):
                read = velocity_of_twist(obs.twist, jnp.zeros(SIX, pose.dtype)).velocity
                before = advance_twist(pose, -read, dt_s)
            else:
                before = advance_bicycle(pose, -speed_mps, steering_rad, dt_s, vehicle.wheelbase_m)
            return jnp.where((index > 0) & (index <= frame), before, pose), None

        indices = jnp.arange(obs.visible.shape[0])
        return jax.lax.scan(back, pose, (obs, indices), reverse=True)[0]

    planar = jax.vmap(one)(obs, planar_from_T_world_vehicle(jaxlie.SE3(T_world_vehicle)), frames)
    return T_world_vehicle_from_planar(planar).wxyz_xyz


@kept
def _around(navigator: Navigator, T_world_vehicle: Float[Array, "B 7"]) -> Bank:
    """A bank of one hypothesis for each pose, at rest, with a wide covariance."""
    motion = navigator.motion
    empty = motion.init(1)
    velocity_sigma = motion.initial_velocity_sigma  # type: ignore[attr-defined]
    sigma = jnp.concatenate([jnp.full_like(velocity_sigma, _CARRIED_SIGMA), velocity_sigma])

    def one(T: Array) -> Bank:
        pose = T
        if isinstance(motion, BicycleKalman):
            pose = planar_from_T_world_vehicle(jaxlie.SE3(T))
        mean = jnp.concatenate([pose, jnp.zeros_like(empty.mean[0, pose.shape[0] :])])
        # Behind pose and velocity are the errors of the sensors, as likely as not.
        covariance = empty.covariance[0].at[: len(sigma), : len(sigma)].set(jnp.diag(sigma**2))
        bank: Bank = eqx.tree_at(
            lambda b: (b.mean, b.covariance, b.initialised),
            empty,
            (mean[None], covariance[None], jnp.ones(1, bool)),
        )
        return bank

    banks: Bank = jax.vmap(one)(T_world_vehicle)
    return banks
