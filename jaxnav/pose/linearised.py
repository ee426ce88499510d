"""Residuals of the corners together with their derivatives, in closed form, for many poses at once.

A minimisation asks for both at every step, and for so few unknowns differentiation costs more than
the residuals. Coordinates come first, then corners, and the poses, which all are treated alike,
last: that is the axis that runs through vector registers. Sums of three or six products are
written as sums over an axis, which XLA computes once and keeps, where it would repeat a chain of
additions for everyone who asks for the result.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from jaxnav.models.camera import MIN_DEPTH_RATIO
from jaxnav.models.geometry import rotation_matrix
from jaxnav.models.rig import CameraRig
from jaxnav.pose.observation import Sightings, cameras_of

# Residuals (2, P, N) of P corners under N poses, in units of their sigma, and how they answer to a
# shift of the corners, (3, 2, P, N), per m.
Rows = tuple[Float[Array, "2 P N"], Float[Array, "3 2 P N"]]


def reprojection_rows(rig: CameraRig, seen: Sightings) -> Callable[[Float[Array, "3 P N"]], Rows]:
    """Projected minus observed corners over sigma, zero in hidden lanes, and their derivatives.

    What does not depend on the pose is done once, before anything is minimised.

    Returns:
        A function of each sighting's own corners in the vehicle frame, P = 4 D of them, m.
    """
    of_corner = jnp.repeat(jnp.arange(seen.camera_index.shape[0]), 4)
    cameras = cameras_of(rig, seen)
    Ts_camera_vehicle = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[seen.camera_index])
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
        per_lens = [_LENSES[lens](in_camera, coefficients) for lens in cameras.lenses]
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
    """The same for a camera of focal length 1, in multiples of `unit`, of points it sees."""

    def rows(points: Array) -> Rows:
        image, slope = _pinhole(points, points)
        return (image - corners_n.T[..., None]) / unit, slope / unit

    return rows


def wrench(
    rows: Rows, points: Float[Array, "3 P N"]
) -> tuple[Float[Array, "3 N"], Float[Array, "3 N"]]:
    """Force and torque about the origin: J'r of a shift and a turn of all points, without J."""
    residual, slope = rows
    force = jnp.sum(slope * residual[None], axis=1)
    return jnp.sum(force, axis=1), jnp.sum(crossed(points, force), axis=1)


def crossed(a: Float[Array, "3 ..."], b: Float[Array, "3 ..."]) -> Array:
    """a x b, coordinates first."""
    return jnp.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def turned(half: Float[Array, "3 N"], arms: Float[Array, "3 P N"]) -> Float[Array, "3 P N"]:
    """Arms turned by the quaternion (1, half), normalised."""
    swing = 2 * crossed(half[:, None], arms)
    per_norm = 1 / (1 + jnp.sum(half**2, axis=0))
    return arms + (swing + crossed(half[:, None], swing)) * per_norm[None, None]


def _pinhole(points: Array, coefficients: Array) -> tuple[Array, Array]:
    del coefficients
    squared = jnp.sum(points**2, axis=0)
    nonzero = squared > 0
    length = jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, squared, 1)), 0)
    nearest = MIN_DEPTH_RATIO * jnp.maximum(length, 1e-12)
    ahead = points[2] > nearest
    per_depth = 1 / jnp.where(ahead, points[2], nearest)
    image = points[:2] * per_depth[None]
    # Of the depth, or of what stands in for it.
    axis = _axes(jnp.asarray([0.0, 0.0, 1.0], points.dtype), points)
    clamped = MIN_DEPTH_RATIO * points / jnp.maximum(length, 1e-12)[None]
    depth_slope = jnp.where(ahead[None], axis, clamped)
    straight = _axes(jnp.eye(3, 2, dtype=points.dtype), points)
    return image, (straight - depth_slope[:, None] * image[None]) * per_depth[None, None]


def _radtan(points: Array, coefficients: Array) -> tuple[Array, Array]:
    (x, y), slope = _pinhole(points, coefficients)
    k1, k2, p1, p2, k3 = coefficients
    r2 = x**2 + y**2
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    bend = 2 * (k1 + r2 * (2 * k2 + 3 * r2 * k3))  # of radial, per x or y and by r2's own slope
    image = jnp.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ]
    )
    mixed = x * y * bend + 2 * p1 * x + 2 * p2 * y
    along_x = radial + x**2 * bend + 2 * p1 * y + 6 * p2 * x
    along_y = radial + y**2 * bend + 6 * p1 * y + 2 * p2 * x
    u_slope, v_slope = slope[:, 0], slope[:, 1]
    return image, jnp.stack(
        [
            along_x[None] * u_slope + mixed[None] * v_slope,
            mixed[None] * u_slope + along_y[None] * v_slope,
        ],
        axis=1,
    )


def _equidistant(points: Array, coefficients: Array) -> tuple[Array, Array]:
    x, y, z = points
    k1, k2, k3, k4, _ = coefficients
    r2, squared = x**2 + y**2, jnp.sum(points**2, axis=0)
    off_axis = r2 > 1e-14 * z**2
    per_radius = jax.lax.rsqrt(jnp.where(off_axis, r2, 1))
    theta = jnp.where(off_axis, jnp.arctan2(jnp.where(off_axis, r2 * per_radius, 1), z), 0)
    t2 = theta**2
    gain = 1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4)))
    rise = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))  # of theta * gain
    # theta / radius, which tends to 1 / z on the axis
    on_axis = 1 / jnp.where(off_axis | (z <= 0), 1, z)
    ratio = jnp.where(off_axis, theta * per_radius, on_axis) * gain
    rise = rise / jnp.where(squared > 0, squared, 1)
    bend = jnp.where(off_axis, (z * rise - ratio) * per_radius**2, 0)
    # How the ratio answers, times both coordinates; and how these do.
    is_depth = _axes(jnp.asarray([False, False, True]), points)
    slope = jnp.where(is_depth, -rise[None], points * bend[None])[:, None] * points[None, :2]
    straight = _axes(jnp.eye(3, 2, dtype=points.dtype), points)
    return points[:2] * ratio[None], slope + straight * ratio[None, None]


def _axes(constant: Array, points: Array) -> Array:
    """A constant for all points."""
    return constant.reshape(*constant.shape, *(1,) * (points.ndim - 1))


_LENSES = {"none": _pinhole, "radtan": _radtan, "equidistant": _equidistant}
