"""Simulate single frames of one marker, from its pose before the cameras to its corners."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Key

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import rotation_from_matrix
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Observation
from jaxnav.sim.corners import see

IMAGE_PX = 2048  # side of a pinhole camera's image


class MarkerView(eqx.Module):
    """The pose of one marker seen from the vehicle; scalars, or leading axes throughout."""

    range_m: Float[Array, "*F"]  # from the cameras' mean position to the marker's centre
    bearing_rad: Float[Array, "*F"]  # of the marker, positive to the left
    elevation_rad: Float[Array, "*F"]  # above the horizon
    view_angle_rad: Float[Array, "*F"]  # between the marker's normal and the line of sight
    azimuth_rad: Float[Array, "*F"]  # direction of the normal's lean: 0 viewer's right, pi/2 up
    roll_rad: Float[Array, "*F"]  # of the marker about its normal


class CornerErrors(eqx.Module):
    """The errors of a detector's corners."""

    noise_px: Float[Array, "*F"]  # standard deviation, independent
    bias_px: Float[Array, "*F"]  # length; each corner has its own direction
    blur_px: Float[Array, "*F"]  # length of a streak; a corner lies anywhere in it


def pinhole_rig(cameras: int, focal_px: float, baseline_m: float) -> CameraRig:
    """A rig of forward cameras side by side, without distortion, the first at the vehicle's origin.

    Args:
        baseline_m: distance from each camera to the next, to the right.
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
    """A map of one marker, whose frame is the world frame."""
    identity = jaxlie.SE3.identity()
    return MarkerMap(jaxlie.SE3(identity.wxyz_xyz[None]), jnp.asarray([size_m]), (0,), ("",))


def T_vehicle_world_of(view: MarkerView, rig: CameraRig) -> jaxlie.SE3:
    """The pose of the marker, whose frame is the world frame, in one view (no batch axis)."""
    cos_up, sin_up = jnp.cos(view.elevation_rad), jnp.sin(view.elevation_rad)
    sight = jnp.stack(
        [cos_up * jnp.cos(view.bearing_rad), cos_up * jnp.sin(view.bearing_rad), sin_up]
    )
    # An upright marker that faces the cameras: x to the viewer's right, z along its normal.
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


def simulate_observation(
    view: MarkerView,
    errors: CornerErrors,
    rig: CameraRig,
    markers: MarkerMap,
    key: Key[Array, ""],
) -> tuple[Observation, jaxlie.SE3]:
    """The observation of the marker, and T_world_vehicle, of one view (no batch axis)."""
    T_world_vehicle = T_vehicle_world_of(view, rig).inverse()
    corners_px, visible = see(rig, markers, T_world_vehicle)
    corners_px = corners_px + corner_errors_px(errors, corners_px.shape, corners_px.dtype, key)
    return Observation(corners_px, visible), T_world_vehicle


def corner_errors_px(
    errors: CornerErrors, shape: tuple[int, ...], dtype: jnp.dtype, key: Key[Array, ""]
) -> Float[Array, "C M 4 2"]:
    """Draw the errors to add to exact corners, shape (C, M, 4, 2)."""
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
    """Unit vectors in the image for an angle in turns, [0, 1)."""
    return jnp.stack([jnp.cos(2 * jnp.pi * turn), jnp.sin(2 * jnp.pi * turn)], axis=-1)
