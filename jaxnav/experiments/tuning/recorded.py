"""Hold the measurements of many drives, on which a filter is tuned and then judged."""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.pose.observation import Observation
from jaxnav.sim.rollout import Keep, Rollout
from jaxnav.sim.world import DriveState


class FrameSequences(eqx.Module):
    """B sequences of T frames; every leaf has the leading axis (B,)."""

    markers: MarkerMap
    obs: Observation  # (B, T, ...)
    used: Bool[Array, "*B T"]  # False: padding
    T_world_vehicle_true: Float[Array, "*B T 7"]
    judged: Bool[Array, "*B T"]  # the true pose is known, and the estimate is compared with it

    def __len__(self) -> int:
        return len(self.used)

    def rows(self, rows: slice | Int[np.ndarray, " rows"]) -> "FrameSequences":
        """Some of the sequences."""
        some: FrameSequences = jax.tree.map(lambda leaf: leaf[rows], self)
        return some

    def frames(self, frames: slice) -> "FrameSequences":
        """Some of the frames of all sequences."""
        timed = (self.obs, self.used, self.T_world_vehicle_true, self.judged)
        return FrameSequences(self.markers, *jax.tree.map(lambda leaf: leaf[:, frames], timed))

    @staticmethod
    def concatenate(parts: "list[FrameSequences]") -> "FrameSequences":
        """Concatenate the sequences; shorter ones are padded with unused frames."""
        length = max(part.used.shape[1] for part in parts)
        padded = [part.pad_to(length) for part in parts]
        joined: FrameSequences = jax.tree.map(lambda *leaves: jnp.concatenate(leaves), *padded)
        return joined

    def pad_to(self, length: int) -> "FrameSequences":
        """Pad to `length` frames: the last one repeated, without markers and unused."""
        more = length - self.used.shape[1]
        frames = (self.obs, self.used, self.T_world_vehicle_true, self.judged)
        obs, used, truth, judged = jax.tree.map(
            lambda leaf: jnp.concatenate([leaf, jnp.repeat(leaf[:, -1:], more, axis=1)], axis=1),
            frames,
        )
        known = jnp.arange(length)[None] < self.used.shape[1]
        shows = (obs.visible & known[..., None, None], jnp.where(known, obs.dt_s, 0))
        heard = known & obs.has_odometry
        obs = eqx.tree_at(lambda o: (o.visible, o.dt_s, o.has_odometry), obs, (*shows, heard))
        return FrameSequences(self.markers, obs, used & known, truth, judged & known)


def simulate_sequences(
    rollout: Rollout,
    keys: Key[Array, " B"],
    progress: Callable[[int], object] = lambda ended: None,
) -> FrameSequences:
    """Simulate closed-loop drives from a cold start, judged from the frame on in which the
    navigator that drove had decided its branch.

    Args:
        keys: one for each drive; a key's drive does not depend on the others.
        progress: called with the number of drives that have ended since the last call.
    """
    trace, obs = rollout.run_keeping(keys, _Observations(), progress)
    true_poses, decided, active = map(np.asarray, (trace.true_pose, trace.decided, trace.active))
    count, length = len(active), int(active.sum(axis=1).max())
    judged = np.maximum.accumulate(decided & active, axis=1) & active
    poses = T_world_vehicle_from_planar(jnp.asarray(true_poses[:, :length]))
    return FrameSequences(
        markers=jax.tree.map(
            lambda leaf: jnp.broadcast_to(leaf, (count, *jnp.shape(leaf))),
            rollout.navigator.markers,
        ),
        obs=jax.tree.map(lambda leaf: jnp.asarray(leaf[:, :length]), obs),
        used=jnp.asarray(active[:, :length]),
        T_world_vehicle_true=poses.wxyz_xyz,
        judged=jnp.asarray(judged[:, :length]),
    )


class _Observations(Keep):
    """A record of every observation, without the truth."""

    def __call__(self, before: DriveState, obs: Observation, after: DriveState) -> Observation:
        return dataclasses.replace(obs, T_world_vehicle_true=None, heading_rad=None)
