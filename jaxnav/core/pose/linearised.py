"""Residuals of the corners together with their derivatives, in closed form, for many poses at once.

A minimisation asks for both at every step, and for so few unknowns differentiation costs more than
the residuals. Coordinates come first, then corners, and the poses, which all are treated alike,
last: that is the axis that runs through vector registers. Sums of three or six products are
written as sums over an axis, which XLA computes once and keeps; it would repeat a chain of
additions in every consumer of the result.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnav.core.models.geometry import rotation_matrix
from jaxnav.core.models.lenses import MOST_COEFFICIENTS, image_of
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Sightings, cameras_of

# Residuals (2, P, N) of P corners under N poses, in units of their sigma, and their derivative by
# a shift of the corners, (3, 2, P, N), per m.
Rows = tuple[Float[Array, "2 P N"], Float[Array, "3 2 P N"]]


def reprojection_rows(rig: CameraRig, seen: Sightings) -> Callable[[Float[Array, "3 P N"]], Rows]:
    """Projected minus observed corners over sigma, zero in hidden lanes, and their derivatives.

    The parts that do not depend on the pose are computed here, once.

    Returns:
        A function of each sighting's own corners in the vehicle frame, P = 4 D of them, m.
    """
    of_corner = jnp.repeat(jnp.arange(seen.camera_index.shape[0]), 4)
    cameras, Ts_camera_vehicle = cameras_of(rig, seen)
    Rs_camera_vehicle = jax.vmap(rotation_matrix)(Ts_camera_vehicle.rotation())

    def last(leaf: Array) -> Array:
        """(D, ...) to (..., P, 1)."""
        return jnp.moveaxis(leaf[of_corner], 0, -1)[..., None]

    turn, shift = last(Rs_camera_vehicle), last(Ts_camera_vehicle.translation())
    hidden = last(~seen.visible)
    weight = jnp.where(hidden, 0, 1 / seen.sigma_px.reshape(-1, 1))
    gain = last(cameras.focal_px) * weight[None]  # (2, P, 1)
    corners_px = seen.corners_px.reshape(-1, 2).T[..., None]
    target = (last(cameras.center_px) - corners_px) * weight[None]
    coefficients, lens_index = last(cameras.distortion), last(cameras.lens_index)

    def rows(points: Array) -> Rows:
        in_camera = jnp.sum(turn * points[None], axis=1) + shift
        per_lens = [image_of(lens, in_camera, coefficients) for lens in cameras.lenses]
        image, slope = per_lens[0]
        for index, (other_image, other_slope) in enumerate(per_lens[1:], start=1):
            image = jnp.where((lens_index == index)[None], other_image, image)
            slope = jnp.where((lens_index == index)[None, None], other_slope, slope)
        residual = jnp.where(hidden[None], 0, image * gain + target)
        slope = jnp.sum(turn[:, :, None] * slope[:, None], axis=0) * gain[None]
        return residual, jnp.where(hidden[None, None], 0, slope)

    return rows


def pinhole_rows(
    corners_n: Float[Array, "P 2"], unit: Float[Array, ""]
) -> Callable[[Float[Array, "3 P N"]], Rows]:
    """As `reprojection_rows` for a camera of focal length 1, in multiples of `unit`.

    Args:
        corners_n: (P, 2) observed corners, normalised image coordinates.
        unit: in which residuals are counted.

    Returns:
        A function of the corners in the camera frame.
    """

    def rows(points: Array) -> Rows:
        image, slope = image_of("none", points, jnp.zeros(MOST_COEFFICIENTS, points.dtype))
        return (image - corners_n.T[..., None]) / unit, slope / unit

    return rows


def wrench(
    rows: Rows, points: Float[Array, "3 P N"]
) -> tuple[Float[Array, "3 N"], Float[Array, "3 N"]]:
    """J'r of a shift and a turn of all points about the origin, computed without forming J.

    Returns:
        sum of slope * residual (3, N), the force, and its moment (3, N), the torque.
    """
    residual, slope = rows
    force = jnp.sum(slope * residual[None], axis=1)
    return jnp.sum(force, axis=1), jnp.sum(cross_product(points, force), axis=1)


def answers(
    slope: Float[Array, "3 2 P N"], points: Float[Array, "3 P N"]
) -> Float[Array, "6 2*P N"]:
    """Derivative of residuals by a shift and a turn of all points about the origin."""
    both = jnp.concatenate([slope, cross_product(points[:, None], slope)])
    return both.reshape(6, -1, both.shape[-1])


def cross_product(a: Float[Array, "3 ..."], b: Float[Array, "3 ..."]) -> Float[Array, "3 ..."]:
    """a x b, coordinates first."""
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def turn_arms(half: Float[Array, "3 N"], arms: Float[Array, "3 P N"]) -> Float[Array, "3 P N"]:
    """Arms turned by the quaternion (1, half), normalised."""
    swing = 2 * cross_product(half[:, None], arms)
    per_norm = 1 / (1 + jnp.sum(half**2, axis=0))
    return arms + (swing + cross_product(half[:, None], swing)) * per_norm[None, None]
