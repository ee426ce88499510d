"""Single frames of one marker in one camera: does the flip probability mean what it says?

A frame is a random view of a square marker with Gaussian corner noise. It is flipped when, of its
two refined poses, the one that was taken is not the one nearer to the truth in angle.
"""

from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.ambiguity import LowestReprojection
from jaxnav.camera import Camera
from jaxnav.candidates import find_candidates
from jaxnav.constant_velocity import ConstantVelocity
from jaxnav.evaluation import judge_branch
from jaxnav.geometry import transform_points
from jaxnav.markers import MarkerMap
from jaxnav.observation import Observation, Snapshot
from jaxnav.rig import CameraRig

SIZE_M = 0.172
FOCAL_PX = 320.0
BATCH = 2000


@dataclass(frozen=True)
class Views:
    """What is drawn, each uniformly between its ends."""

    side_px: tuple[float, float] = (10.0, 100.0)
    angle_rad: tuple[float, float] = (0.0, float(np.deg2rad(60.0)))  # normal to line of sight
    noise_px: tuple[float, float] = (0.2, 2.0)


class Frames(eqx.Module):
    """What became of the frames, leading axis (F,)."""

    flip_probability: Float[Array, "*F"]
    flipped: Bool[Array, "*F"]
    pair: Bool[Array, "*F"]  # there were two poses to choose from, one of them near the truth


def single_frames(
    count: int,
    seed: int,
    views: Views | None = None,
    progress: Callable[[int], object] = lambda done: None,
) -> Frames:
    """Independent frames, on the host.

    Args:
        progress: called with the number of frames done since the last call.
    """
    views = views or Views()
    batch = min(BATCH, count)
    identity = jaxlie.SE3.identity()
    camera = Camera.create((FOCAL_PX, FOCAL_PX), (400.0, 300.0), "none", ())
    rig = CameraRig.create([camera], [identity], ["camera"], [(800, 600)])
    markers = MarkerMap(jaxlie.SE3(identity.wxyz_xyz[None]), jnp.asarray([SIZE_M]), (0,), ("",))
    run = jax.jit(jax.vmap(lambda key: _frame(key, views, rig, markers)))
    keys = jax.random.split(jax.random.key(seed), -(-count // batch) * batch)
    parts = []
    for begin in range(0, len(keys), batch):
        parts.append(jax.device_get(run(keys[begin : begin + batch])))
        progress(min(batch, count - begin))
    frames: Frames = jax.tree.map(lambda *leaves: np.concatenate(leaves)[:count], *parts)
    return frames


def _frame(key: Array, views: Views, rig: CameraRig, markers: MarkerMap) -> Frames:
    draws = jax.random.uniform(key, (8,))
    noise_key = jax.random.fold_in(key, 0)

    def between(index: int, ends: tuple[float, float]) -> Array:
        return ends[0] + (ends[1] - ends[0]) * draws[index]

    depth_m = FOCAL_PX * SIZE_M / between(0, views.side_px)
    tilt, noise_px = between(1, views.angle_rad), between(2, views.noise_px)
    around, roll = 2 * jnp.pi * draws[3], 2 * jnp.pi * draws[4]
    place = depth_m * jnp.stack([1.2 * draws[5] - 0.6, 0.8 * draws[6] - 0.4, jnp.ones(())])
    # A marker that looks at the camera, tilted about an axis across the line of sight, rolled.
    sight = place / jnp.sqrt(jnp.sum(place**2))
    x = jnp.cross(jnp.asarray([0.0, 1.0, 0.0]), -sight)
    x = x / jnp.sqrt(jnp.sum(x**2))
    facing = jaxlie.SO3.from_matrix(jnp.stack([x, jnp.cross(-sight, x), -sight], axis=1))
    axis = jnp.stack([jnp.cos(around), jnp.sin(around), jnp.zeros(())])
    tilted = facing @ jaxlie.SO3.exp(tilt * axis) @ jaxlie.SO3.from_z_radians(roll)
    # The marker is the world, the camera the vehicle.
    T_camera_world = jaxlie.SE3.from_rotation_and_translation(tilted, place)
    corners_px = rig.camera(0).project(transform_points(T_camera_world, markers.corners_world_m[0]))
    corners_px = corners_px + noise_px * jax.random.normal(noise_key, (4, 2))
    obs = Observation(corners_px[None, None], jnp.ones((1, 1), bool))
    snapshot = Snapshot.create(rig, markers, obs, noise_px)
    candidates = find_candidates(snapshot, max_steps=20)
    nothing_known = ConstantVelocity().poses(ConstantVelocity().init())
    selection = LowestReprojection()(nothing_known, candidates, snapshot)
    branch = judge_branch(candidates, selection.selected, T_camera_world.inverse())
    return Frames(selection.flip_probability, branch.wrong, branch.ambiguous & ~branch.outlier)
