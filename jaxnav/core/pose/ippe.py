"""Both poses of one square marker, in closed form.

Four coplanar corners fix the homography of the marker's plane; its first-order part at the
marker's centre is compatible with exactly two rotations, mirror images of each other about the
line of sight. Source: Collins and Bartoli (2014), "Infinitesimal plane-based pose estimation".

Rotations stay matrices throughout: an upright marker seen by a level camera is a rotation by
exactly pi, where rotation vectors are two-valued. Differences of nearly equal numbers
are formed before anything is squared, so float32 keeps its digits at frontal and far views.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from jaxnav.core.linalg.small_matrices import matvec, product
from jaxnav.core.models.geometry import rotation_from_matrix, safe_norm, safe_sqrt
from jaxnav.core.models.markers import CORNER_SIGNS


class PosePair(eqx.Module):
    """The two poses that explain four corners, the one with the lower error first.

    At a frontal view the two coincide.
    """

    T_camera_marker: jaxlie.SE3  # batch axes (*batch, 2)
    reprojection_error: Float[
        Array, "*batch 2"
    ]  # RMS over the eight coordinates, units of corners_n


def ippe_square(corners_n: Float[Array, "4 2"], size_m: Float[Array, ""] | float) -> PosePair:
    """Both poses of a square marker from its corners in one camera.

    Args:
        corners_n: (4, 2) normalised image coordinates (x/z, y/z), top-left, top-right,
            bottom-right, bottom-left.
        size_m: side of the marker, m.

    Returns:
        The pair, sorted by reprojection error. Corners that form no square's image (three on a
        line, all equal) give finite but meaningless poses with a large error.

    Source: Collins and Bartoli (2014), section 4; square-specific homography in closed form.
    """
    corners_n = jnp.asarray(corners_n)
    half_m = jnp.asarray(size_m, corners_n.dtype) / 2
    mean_n = jnp.mean(corners_n, axis=0)
    center_n, J = _homography_at_center(corners_n - mean_n[None])
    R_camera_sight = _rotation_to(center_n + mean_n)
    R22, tilt, gamma = _rotation_parts(_to_line_of_sight(J, center_n + mean_n, R_camera_sight))
    on_sight = jnp.append(center_n + mean_n, 1) * half_m / gamma
    poses = [
        _pose(corners_n, mean_n, half_m, R_camera_sight, on_sight, R22, sign * tilt)
        for sign in (1, -1)
    ]
    wxyz_xyz, errors = (jnp.stack(both) for both in zip(*poses, strict=True))
    order = jnp.where(errors[0] <= errors[1], jnp.array([0, 1]), jnp.array([1, 0]))
    return PosePair(jaxlie.SE3(wxyz_xyz[order]), errors[order])


def _homography_at_center(corners: Array) -> tuple[Array, Array]:
    """Image of the marker's centre, and its Jacobian (2, 2) with respect to half sides.

    With u w = a X + b Y + c, w = 1 + g X + h Y and corners at X, Y = +-1, the alternating sum of
    the corners vanishes: g and h solve a 2x2 system, and a, b, c are means.
    """
    top_left, top_right, bottom_right, bottom_left = corners
    across = top_left + top_right - bottom_right - bottom_left
    along = -top_left + top_right + bottom_right - bottom_left
    twist = top_left - top_right + bottom_right - bottom_left
    determinant = across[0] * along[1] - across[1] * along[0]
    # |determinant| is 8 times the area: vanishing only for corners on a line.
    floor = jnp.finfo(corners.dtype).eps * jnp.sum(corners**2) + jnp.finfo(corners.dtype).tiny
    safe = jnp.abs(determinant) > floor
    inverse = jnp.where(safe, 1 / jnp.where(safe, determinant, 1), 0)
    g = (twist[0] * along[1] - twist[1] * along[0]) * inverse
    h = (across[0] * twist[1] - across[1] * twist[0]) * inverse
    signs = jnp.asarray(CORNER_SIGNS[:, :2], corners.dtype)
    weighted = corners * (1 + signs[:, :1] * g + signs[:, 1:] * h)
    center = jnp.mean(weighted, axis=0)
    ab = product(weighted.T, signs) / 4
    return center, ab - center[:, None] * jnp.stack([g, h])[None]


def _rotation_to(point_n: Array) -> Array:
    """The smallest rotation that takes the optical axis to the ray through a point."""
    ray = jnp.concatenate([point_n, jnp.ones(1, point_n.dtype)])
    x, y, z = ray / jnp.sqrt(jnp.sum(ray**2))
    return jnp.stack(
        [
            jnp.stack([1 - x * x / (1 + z), -x * y / (1 + z), x]),
            jnp.stack([-x * y / (1 + z), 1 - y * y / (1 + z), y]),
            jnp.stack([-x, -y, z]),
        ]
    )


def _to_line_of_sight(J: Array, center_n: Array, R_camera_sight: Array) -> Array:
    """The Jacobian as a camera looking straight at the marker's centre would see it."""
    projection = jnp.concatenate([jnp.eye(2, dtype=J.dtype), -center_n[:, None]], axis=1)
    (a, b), (c, d) = product(projection, R_camera_sight[:, :2])
    inverse = jnp.stack([jnp.stack([d, -b]), jnp.stack([-c, a])]) / (a * d - b * c)
    return product(inverse, J)


def _rotation_parts(A: Array) -> tuple[Array, Array, Array]:
    """The upper-left 2x2 of the rotation, the first two entries (2,) of its last row, and gamma,
    half a side over depth.

    A = gamma R22 with gamma the largest singular value. The last row b of the first two columns
    obeys b b' = I - R22' R22, which in complex numbers reads (b1 + i b0)^2 = p - i q, with
    (p, q) = (differences of the squared columns, twice their product) / gamma^2. Its two square
    roots +-b are the two poses; where it vanishes the view is frontal.
    """
    (a, b), (c, d) = A
    sum_part = jnp.stack([a + d, c - b]) / 2
    difference_part = jnp.stack([a - d, c + b]) / 2
    gamma = safe_norm(sum_part) + safe_norm(difference_part)
    gamma = jnp.where(gamma > 0, gamma, 1)
    p = 4 * (sum_part[0] * difference_part[0] + sum_part[1] * difference_part[1]) / gamma**2
    q = 4 * (sum_part[0] * difference_part[1] - sum_part[1] * difference_part[0]) / gamma**2
    larger = safe_sqrt((safe_norm(jnp.stack([p, q])) + jnp.abs(p)) / 2)
    tilted = larger > 0
    smaller = jnp.where(tilted, -q / (2 * jnp.where(tilted, larger, 1)), 0)
    tilt = jnp.where(p >= 0, jnp.stack([smaller, larger]), jnp.stack([larger, smaller]))
    return A / gamma, tilt, gamma


def _pose(
    corners_n: Array,
    mean_n: Array,
    half_m: Array,
    R_camera_sight: Array,
    on_sight: Array,
    R22: Array,
    tilt: Array,
) -> tuple[Array, Array]:
    """One pose as (wxyz, xyz), and its RMS reprojection error."""
    x_axis = jnp.concatenate([R22[:, 0], tilt[:1]])
    y_axis = jnp.concatenate([R22[:, 1], tilt[1:]])
    x_axis, y_axis = matvec(R_camera_sight, x_axis), matvec(R_camera_sight, y_axis)
    R_camera_marker = jnp.stack([x_axis, y_axis, jnp.cross(x_axis, y_axis)], axis=1)
    rotation = rotation_from_matrix(R_camera_marker)

    # Translation: least squares of (R p + t)_xy - u (R p + t)_z over the corners.
    signs = jnp.asarray(CORNER_SIGNS, corners_n.dtype)
    turned = product(half_m * signs, R_camera_marker.T)
    defect = corners_n * turned[:, 2:] - turned[:, :2]
    offset = corners_n - mean_n[None]
    spread = jnp.sum(offset**2)
    spread = jnp.where(spread > 0, spread, 1)
    depth = -jnp.sum(offset * defect) / spread
    translation = jnp.append(mean_n * depth + jnp.mean(defect, axis=0), depth)
    # Noise larger than a foreshortened side can turn the depth negative; the scale cannot be.
    plausible = (depth > on_sight[2] / 2) & (depth < on_sight[2] * 2)
    translation = jnp.where(plausible, translation, on_sight)

    in_camera = turned + translation[None]
    nearest = 1e-3 * half_m
    projected = in_camera[:, :2] / jnp.maximum(in_camera[:, 2:], nearest)
    error = safe_sqrt(jnp.mean((projected - corners_n) ** 2))
    return jnp.concatenate([rotation.wxyz, translation]), error


def ippe_from_rays(rays_camera: Float[Array, "4 3"], size_m: Float[Array, ""]) -> jaxlie.SE3:
    """Both poses (batch axis 2) from unit rays through the corners, for any lens.

    The camera is turned to look at the marker first, so a marker at 90 degrees to the axis of a
    fisheye is as well conditioned as one in the middle.
    """
    sight = jnp.mean(rays_camera, axis=0)
    R_camera_virtual = _rotation_facing(sight)
    rays_virtual = product(rays_camera, R_camera_virtual)
    depth = jnp.maximum(rays_virtual[:, 2:], 1e-3)
    pair = ippe_square(rays_virtual[:, :2] / depth, size_m)
    T_camera_virtual = jaxlie.SE3.from_rotation(rotation_from_matrix(R_camera_virtual))
    return jax.vmap(lambda T: T_camera_virtual @ T)(pair.T_camera_marker)


def _rotation_facing(direction: Array) -> Array:
    """A rotation whose z axis has the given direction, defined for every non-zero direction."""
    length = safe_norm(direction)
    x, y, z = direction / jnp.where(length > 0, length, 1)
    # Householder-like completion (Duff et al. 2017), stable on the whole sphere.
    sign = jnp.where(z >= 0, 1.0, -1.0).astype(direction.dtype)
    a = -1 / (sign + z)
    b = x * y * a
    first = jnp.stack([1 + sign * x * x * a, sign * b, -sign * x])
    second = jnp.stack([b, sign + y * y * a, -y])
    return jnp.stack([first, second, jnp.stack([x, y, z])], axis=1)
