"""Draw random views of one marker in one camera, to check the calibration of flip probabilities.

A frame is a random view of a square marker with Gaussian corner noise. It is flipped if the
selected one of its two refined poses is not the one nearer to the truth in angle.
"""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter.choose import LowestReprojection, judge_branch
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.candidates import find_candidates
from jaxnav.core.pose.observation import Snapshot
from jaxnav.sim.single_frames import (
    CornerErrors,
    MarkerView,
    marker_as_world,
    pinhole_rig,
    simulate_observation,
)

SIZE_M = 0.172
FOCAL_PX = 320.0
BATCH = 2000


@dataclass(frozen=True)
class ViewRanges:
    """The ranges of a random view; each quantity is drawn uniformly between its ends."""

    side_px: tuple[float, float] = (10.0, 100.0)
    angle_rad: tuple[float, float] = (0.0, float(np.deg2rad(60.0)))  # normal to line of sight
    noise_px: tuple[float, float] = (0.2, 2.0)
    bearing_rad: tuple[float, float] = (-0.54, 0.54)
    elevation_rad: tuple[float, float] = (-0.38, 0.38)


class ViewOutcomes(eqx.Module):
    """The outcomes of frames, leading axis (F,)."""

    flip_probability: Float[Array, "*F"]
    flipped: Bool[Array, "*F"]
    pair: Bool[Array, "*F"]  # there were two poses to choose from, one of them near the truth


def random_views(
    count: int,
    seed: int,
    views: ViewRanges | None = None,
    progress: Callable[[int], object] = lambda done: None,
) -> ViewOutcomes:
    """The outcomes of independent random frames, on the host.

    Args:
        progress: called with the number of frames finished since the last call.
    """
    views = views or ViewRanges()
    batch = min(BATCH, count)
    rig, markers = pinhole_rig(1, FOCAL_PX, 0.0), marker_as_world(SIZE_M)
    run = jax.jit(jax.vmap(lambda key: _frame(key, views, rig, markers)))
    keys = jax.random.split(jax.random.key(seed), -(-count // batch) * batch)
    parts = []
    for begin in range(0, len(keys), batch):
        parts.append(jax.device_get(run(keys[begin : begin + batch])))
        progress(min(batch, count - begin))
    frames: ViewOutcomes = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
    return frames


def _frame(key: Array, views: ViewRanges, rig: CameraRig, markers: MarkerMap) -> ViewOutcomes:
    draws = jax.random.uniform(key, (7,))

    def between(index: int, ends: tuple[float, float]) -> Array:
        return ends[0] + (ends[1] - ends[0]) * draws[index]

    view = MarkerView(
        range_m=FOCAL_PX * SIZE_M / between(0, views.side_px),
        bearing_rad=between(1, views.bearing_rad),
        elevation_rad=between(2, views.elevation_rad),
        view_angle_rad=between(3, views.angle_rad),
        azimuth_rad=between(4, (0.0, 2 * np.pi)),
        roll_rad=between(5, (0.0, 2 * np.pi)),
    )
    noise_px, zero = between(6, views.noise_px), jnp.zeros_like(draws[0])
    obs, T_world_vehicle = simulate_observation(
        view, CornerErrors(noise_px, zero, zero), rig, markers, jax.random.fold_in(key, 0)
    )
    obs = eqx.tree_at(lambda o: o.visible, obs, jnp.ones_like(obs.visible))
    snapshot = Snapshot.create(rig, markers, obs, noise_px)
    candidates = find_candidates(snapshot, max_steps=20)
    nothing_known = ConstantVelocity().poses(ConstantVelocity().init())
    selection = LowestReprojection()(nothing_known, candidates, snapshot)
    branch = judge_branch(candidates, selection.selected, T_world_vehicle)
    return ViewOutcomes(
        selection.flip_probability, branch.wrong, branch.ambiguous & ~branch.outlier
    )
