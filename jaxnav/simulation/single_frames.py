"""Single frames of one marker: where it stands before the cameras, and what is seen of it."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxnav.models.camera import Camera
from jaxnav.models.geometry import rotation_from_matrix
from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig
from jaxnav.pose.observation import Observation
from jaxnav.simulation.corners import see

IMAGE_PX = 2048  # side of a pinhole camera's image


class View(eqx.Module):
    """Where one marker stands, seen from the vehicle; scalars, or leading axes throughout."""

    range_m: Float[Array, "*F"]  # from the cameras' mean position to the marker's centre
    bearing_rad: Float[Array, "*F"]  # of the marker: left of straight ahead
    elevation_rad: Float[Array, "*F"]  # above the horizon
    view_angle_rad: Float[Array, "*F"]  # between the marker's normal and the line of sight
    azimuth_rad: Float[Array, "*F"]  # where the normal leans to: 0 the reader's right, pi/2 up
    roll_rad: Float[Array, "*F"]  # of the marker about its normal


class CornerErrors(eqx.Module):
    """How a detector's corners differ from the true ones."""

    noise_px: Float[Array, "*F"]  # standard deviation, independent
    bias_px: Float[Array, "*F"]  # of every corner, in a direction of its own
    blur_px: Float[Array, "*F"]  # length of a streak, in which each corner is found anywhere


def pinhole_rig(cameras: int, focal_px: float, baseline_m: float) -> CameraRig:
    """Cameras without distortion that look ahead side by side, the first in the vehicle's origin.

    Args:
        baseline_m: from each to the next, to the right.
    """
    R_camera_vehicle = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
    rotation = rotation_from_matrix(jnp.asarray(R_camera_vehicle, float))
    center = (IMAGE_PX - 1) / 2
    camera = Camera.create((focal_px, focal_px), (center, center))
    return CameraRig.create(
        [camera] * cameras,
        [
            jaxlie.SE3.from_rotation_and_translation(
                rotation, jnp.asarray([-i * baseline_m, 0.0, 0.0])
            )
            for i in range(cameras)
        ],
        [f"camera{i}" for i in range(cameras)],
        [(IMAGE_PX, IMAGE_PX)] * cameras,
    )


def marker_as_world(size_m: Float[Array, ""] | float) -> MarkerMap:
    """A map of one marker, whose frame is the world's."""
    identity = jaxlie.SE3.identity()
    return MarkerMap(jaxlie.SE3(identity.wxyz_xyz[None]), jnp.asarray([size_m]), (0,), ("",))


def T_vehicle_world_of(view: View, rig: CameraRig) -> jaxlie.SE3:
    """The pose of the marker, which is the world, that a view describes. Of one view."""
    cos_up, sin_up = jnp.cos(view.elevation_rad), jnp.sin(view.elevation_rad)
    sight = jnp.stack(
        [cos_up * jnp.cos(view.bearing_rad), cos_up * jnp.sin(view.bearing_rad), sin_up]
    )
    # A marker that looks at the cameras, upright: x to its reader's right, z along its normal.
    x = jnp.stack([jnp.sin(view.bearing_rad), -jnp.cos(view.bearing_rad), jnp.zeros_like(sin_up)])
    facing = rotation_from_matrix(jnp.stack([x, jnp.cross(-sight, x), -sight], axis=1))
    lean = jnp.stack(
        [-jnp.sin(view.azimuth_rad), jnp.cos(view.azimuth_rad), jnp.zeros_like(sin_up)]
    )
    rotation = (
        facing
        @ jaxlie.SO3.exp(view.view_angle_rad * lean)
        @ jaxlie.SO3.from_z_radians(view.roll_rad)
    )
    centers_vehicle = jax.vmap(lambda T: T.inverse().translation())(rig.Ts_camera_vehicle)
    return jaxlie.SE3.from_rotation_and_translation(
        rotation, jnp.mean(centers_vehicle, axis=0) + view.range_m * sight
    )


def observe(
    view: View, errors: CornerErrors, rig: CameraRig, markers: MarkerMap, key: Array
) -> tuple[Observation, jaxlie.SE3]:
    """What the cameras see of a marker that is the world, and T_world_vehicle. Of one view."""
    T_world_vehicle = T_vehicle_world_of(view, rig).inverse()
    corners_px, visible = see(rig, markers, T_world_vehicle)
    corners_px = corners_px + corner_errors_px(errors, corners_px.shape, corners_px.dtype, key)
    return Observation(corners_px, visible), T_world_vehicle


def corner_errors_px(
    errors: CornerErrors, shape: tuple[int, ...], dtype: jnp.dtype, key: Array
) -> Float[Array, "C M 4 2"]:
    """What is added to exact corners, shape (C, M, 4, 2)."""
    noise_key, bias_key, blur_key, streak_key = jax.random.split(key, 4)
    noise = jax.random.normal(noise_key, shape, dtype)
    streak = directions(jax.random.uniform(streak_key, shape[:2], dtype))[:, :, None]
    along = jax.random.uniform(blur_key, shape[:3], dtype, -0.5, 0.5)
    return (
        errors.noise_px * noise
        + errors.bias_px * directions(jax.random.uniform(bias_key, shape[:3], dtype))
        + errors.blur_px * along[..., None] * streak
    )


def directions(turn: Float[Array, "*batch"]) -> Float[Array, "*batch 2"]:
    """Unit vectors in the image, from a turn in [0, 1)."""
    return jnp.stack([jnp.cos(2 * jnp.pi * turn), jnp.sin(2 * jnp.pi * turn)], axis=-1)
