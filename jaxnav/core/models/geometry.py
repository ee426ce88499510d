"""Planar poses, rigid motions and angles.

`T_a_b` maps coordinates in frame b to coordinates in frame a (`p_a = T_a_b @ p_b`) and is
also the pose of b in a. Tangent vectors of SE(3) are ordered (translation, rotation), as in
jaxlie, and perturb from the right: `T * exp(xi)`, or `T * cay(xi)`, which is the same up to third
order; so xi lives in the inner frame.
"""

import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Shaped

from jaxnav.core.linalg.small_matrices import first_highest, matvec, product, sandwich

# Columns of the identity for vectors ordered (translation, rotation), such as xi: on level ground a
# vehicle shifts along its x and y and turns about its z.
ON_GROUND = np.eye(6)[:, [0, 1, 5]]
OFF_GROUND = np.eye(6)[:, [2, 3, 4]]
# Angles that differ by less are the same where one of two is chosen: a twentieth of what lies
# between two candidates at least, and more than the rounding of an angle in float32, 3e-4.
EVEN_RAD = 1e-3
# And of four divisors, the largest of which is 1 or more, those that serve as well as the largest.
EVEN_FOUR_SQUARES = 0.1
_SKEW = np.cross(np.eye(3)[:, None], np.eye(3)[None]).transpose(2, 1, 0).reshape(9, 3)


def wrap_angle(angle_rad: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """The angle wrapped to [-pi, pi).

    Units: rad in, rad out. The derivative is 1 everywhere.
    """
    return angle_rad - 2 * jnp.pi * jnp.floor((angle_rad + jnp.pi) / (2 * jnp.pi))


def wrap_angle_np(angle_rad: Float[np.ndarray, "*batch"]) -> Float[np.ndarray, "*batch"]:
    """`wrap_angle` of NumPy's arrays, of any precision: rad, wrapped to [-pi, pi)."""
    return (angle_rad + np.pi) % (2 * np.pi) - np.pi


def T_world_vehicle_from_planar(pose: Float[Array, "*batch 3"]) -> jaxlie.SE3:
    """Lift (x_m, y_m, psi_rad), the pose of the vehicle in the world, to SE(3).

    Height, roll and pitch are zero.

    Source: Liu, Schofield, Shan (2023), Eq. 12; `f` there returns the inverse,
    `T_vehicle_world`.
    """
    x_m, y_m, psi_rad = jnp.moveaxis(pose, -1, 0)
    zero = jnp.zeros_like(x_m)
    return jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3(jnp.stack([jnp.cos(psi_rad / 2), zero, zero, jnp.sin(psi_rad / 2)], axis=-1)),
        jnp.stack([x_m, y_m, zero], axis=-1),
    )


def planar_rotation(angle_rad: Float[Array, ""]) -> Float[Array, "3 3"]:
    """Rotation of (x, y, psi) about z."""
    c, s, zero, one = jnp.cos(angle_rad), jnp.sin(angle_rad), angle_rad * 0, angle_rad * 0 + 1
    rows = ([c, -s, zero], [s, c, zero], [zero, zero, one])
    return jnp.stack([jnp.stack(row) for row in rows])


def planar_from_T_world_vehicle(T_world_vehicle: jaxlie.SE3) -> Float[Array, "*batch 3"]:
    """The planar part (x_m, y_m, psi_rad) of a pose: position on the ground and heading.

    The heading is the direction of the vehicle's x axis seen from above. Where that axis is
    vertical the heading is undefined; 0 is returned, with a zero gradient.
    """
    w, x, y, z = jnp.moveaxis(T_world_vehicle.rotation().wxyz, -1, 0)
    cosine, sine = 1 - 2 * (y**2 + z**2), 2 * (w * z + x * y)
    position_m = T_world_vehicle.translation()
    return jnp.concatenate([position_m[..., :2], safe_atan2(sine, cosine)[..., None]], axis=-1)


def cayley(xi: Float[Array, " 6"]) -> jaxlie.SE3:
    """The rigid motion (1 - X / 2)^-1 (1 + X / 2), where X is the 4 x 4 matrix of a twist xi.

    exp(xi) up to third order, and like it a motion about a fixed screw axis, with cay(-xi) the
    inverse of cay(xi); but rational: no series, no 0 / 0. Here it parametrises poses next to a
    given one.

    Source: Selig (2007), "Cayley maps for SE(3)".
    """
    half = xi[3:] / 2
    swing = jnp.cross(half, xi[:3])
    swing = (swing + jnp.cross(half, swing)) / (1 + jnp.sum(half**2))
    rotation = jaxlie.SO3(jnp.append(jnp.ones(1, xi.dtype), half)).normalize()
    return jaxlie.SE3.from_rotation_and_translation(rotation, xi[:3] + swing)


def inverse_cayley(T: jaxlie.SE3) -> Float[Array, " 6"]:
    """The twist xi of a rigid motion T = cay(xi), for turns up to 170 degrees.

    Larger turns, whose twists grow without bound, give that of a turn just as large as this.
    """
    wxyz = T.rotation().wxyz
    w = jnp.where(wxyz[:1] < 0, -1, 1) * jnp.maximum(jnp.abs(wxyz[:1]), np.cos(np.deg2rad(85.0)))
    half = wxyz[1:] / w
    return jnp.concatenate([T.translation() - jnp.cross(half, T.translation()), 2 * half])


def cayley_jacobian(xi: Float[Array, " 6"]) -> Float[Array, "6 6"]:
    """J in cay(xi + d) = cay(xi) cay(J d) for small d."""
    half = skew(xi[3:] / 2)
    squared = jnp.sum(xi[3:] ** 2) / 4
    eye = jnp.eye(3, dtype=xi.dtype)
    turn = (eye - half) / (1 + squared)
    A = eye + (product(half, half) - half) / (1 + squared)  # (1 + half)^-1
    return jnp.block([[A, -product(skew(xi[:3] / 2), turn)], [jnp.zeros_like(eye), turn]])


def inverse_cayley_jacobian(xi: Float[Array, " 6"]) -> Float[Array, "6 6"]:
    """The inverse of `cayley_jacobian`."""
    half = skew(xi[3:] / 2)
    squared = jnp.sum(xi[3:] ** 2) / 4
    eye = jnp.eye(3, dtype=xi.dtype)
    turn = (1 + squared) * eye + half + product(half, half)  # (1 + squared) (1 - half)^-1
    back = eye + half
    return jnp.block([[back, product(back, skew(xi[:3] / 2))], [jnp.zeros_like(eye), turn]])


def rotation_matrix(rotation: jaxlie.SO3) -> Float[Array, "3 3"]:
    """The matrix (3, 3) of a unit quaternion, in a fifth of the operations of jaxlie's.

    jaxlie normalises the quaternion first.
    """
    w, v = rotation.wxyz[0], rotation.wxyz[1:]
    outer = v[:, None] * v[None]
    eye = jnp.eye(3, dtype=v.dtype)
    return (w**2 - jnp.sum(v**2)) * eye + 2 * (outer + w * skew(v))


def skew(a: Float[Array, " 3"]) -> Float[Array, "3 3"]:
    """The matrix of the cross product: skew(a) @ b = a x b."""
    return matvec(jnp.asarray(_SKEW, a.dtype), a).reshape(3, 3)


def on_ground(T_world_vehicle: jaxlie.SE3) -> jaxlie.SE3:
    """The level pose on the ground at the same place and heading."""
    return T_world_vehicle_from_planar(planar_from_T_world_vehicle(T_world_vehicle))


def planar_covariance(
    T_world_vehicle: jaxlie.SE3, covariance: Float[Array, "6 6"]
) -> Float[Array, "3 3"]:
    """Covariance of (x_m, y_m, psi_rad) from that of a right-perturbed pose.

    Args:
        T_world_vehicle: the pose the covariance belongs to.
        covariance: (6, 6), of xi in `T_world_vehicle * exp(xi)`, ordered (translation, rotation).
    """
    R_world_vehicle = rotation_matrix(T_world_vehicle.rotation())
    # d psi: the rotation vector in world axes, projected on the rate of the heading.
    c, s = R_world_vehicle[0, 0], R_world_vehicle[1, 0]
    horizontal = jnp.maximum(c**2 + s**2, jnp.finfo(c.dtype).eps)
    dpsi_dx_axis = jnp.stack([-s, c, jnp.zeros_like(c)]) / horizontal
    # d(x axis) = R [0, w_z, -w_y]
    dpsi_dw = jnp.stack(
        [
            jnp.zeros_like(c),
            -jnp.sum(dpsi_dx_axis * R_world_vehicle[:, 2]),
            jnp.sum(dpsi_dx_axis * R_world_vehicle[:, 1]),
        ]
    )
    jacobian = jnp.zeros((3, 6), c.dtype)
    jacobian = jacobian.at[:2, :3].set(R_world_vehicle[:2]).at[2, 3:].set(dpsi_dw)
    return sandwich(jacobian, covariance)


def quad_area(corners: Float[Array, "*batch 4 2"]) -> Float[Array, "*batch"]:
    """Area of quads whose corners go round: half the cross product of their diagonals."""
    diagonals = corners[..., :2, :] - corners[..., 2:, :]
    (ax, ay), (bx, by) = jnp.moveaxis(diagonals, (-2, -1), (0, 1))
    return jnp.abs(ax * by - ay * bx) / 2


def safe_norm(vector: Float[Array, "*batch n"]) -> Float[Array, "*batch"]:
    """Euclidean length along the last axis, with a zero gradient at the origin."""
    squared = jnp.sum(vector**2, axis=-1)
    return safe_sqrt(squared)


def safe_sqrt(value: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """Square root of max(value, 0), with a zero gradient at and below 0. NaN stays NaN."""
    vanishes = value <= 0
    return jnp.where(vanishes, 0, jnp.sqrt(jnp.where(vanishes, 1, value)))


def safe_atan2(y: Float[Array, "*batch"], x: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """atan2 in rad, 0 with a zero gradient at the origin. NaN stays NaN."""
    undefined = x**2 + y**2 <= 0
    return jnp.where(undefined, 0, jnp.arctan2(y, jnp.where(undefined, 1, x)))


def safe_sinc(angle_rad: Float[Array, "*batch"]) -> Float[Array, "*batch"]:
    """sin(a) / a, with derivatives as exact as the value at any angle.

    The derivative of the quotient, cos(a) / a - sin(a) / a^2, loses all digits next to 0 and
    becomes NaN where a^2 underflows: below 0.5 rad the series is used.
    """
    small = jnp.abs(angle_rad) < 0.5
    squared = jnp.where(small, angle_rad, 0) ** 2
    series = jnp.ones_like(squared)
    for factors in (14 * 15, 12 * 13, 10 * 11, 8 * 9, 6 * 7, 4 * 5, 2 * 3):
        series = 1 - squared * series / factors
    large = jnp.where(small, 1, angle_rad)
    return jnp.where(small, series, jnp.sin(large) / large)


def rotation_error_rad(T_a_b: jaxlie.SE3, T_a_c: jaxlie.SE3) -> Float[Array, ""]:
    """Angle between two orientations, rad, 0 to pi; its gradient is zero between equal ones."""
    w, x, y, z = (T_a_b.rotation().inverse() @ T_a_c.rotation()).wxyz
    return 2 * safe_atan2(safe_norm(jnp.stack([x, y, z])), jnp.abs(w))


def rotation_from_matrix(R: Float[Array, "3 3"]) -> jaxlie.SO3:
    """The rotation nearest in direction to a nearly orthonormal matrix, at any angle.

    There are four formulas for the quaternion of a matrix, equal but for the sign. The first whose
    divisor is nearly the largest is used, so half turns are exact, every gradient is finite, and no
    rounding chooses the sign, as of an upright marker before a level camera.

    Source: Shepperd (1978), "Quaternion from rotation matrix".
    """
    m00, m01, m02, m10, m11, m12, m20, m21, m22 = R.reshape(9)
    four_squares = jnp.stack(
        [1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22, 1 - m00 - m11 + m22]
    )
    # Row i is 4 q_i q, for q = (w, x, y, z).
    rows = jnp.stack(
        [
            jnp.stack([four_squares[0], m21 - m12, m02 - m20, m10 - m01]),
            jnp.stack([m21 - m12, four_squares[1], m10 + m01, m02 + m20]),
            jnp.stack([m02 - m20, m10 + m01, four_squares[2], m21 + m12]),
            jnp.stack([m10 - m01, m02 + m20, m21 + m12, four_squares[3]]),
        ]
    )
    row = rows[first_highest(four_squares, EVEN_FOUR_SQUARES)]
    return jaxlie.SO3(row / jnp.sqrt(jnp.sum(row**2)))


def transform_points(
    T_a_b: jaxlie.SE3, points_b: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 3"]:
    """p_a = T_a_b @ p_b for an array of points, (*batch, 3)."""
    return turn_and_shift(rotation_matrix(T_a_b.rotation()), T_a_b.translation(), points_b)


def turn_and_shift(
    R: Float[Array, "3 3"], t: Float[Array, " 3"], points: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 3"]:
    """R p + t for every point."""
    columns = [on_last_axis(R[:, k], points) for k in range(3)]
    return sum((points[..., k : k + 1] * columns[k] for k in range(3)), on_last_axis(t, points))


def on_last_axis(
    vector: Shaped[Array, " n"], like: Shaped[Array, "*batch m"]
) -> Shaped[Array, "... n"]:
    """A vector with leading axes of length 1, which broadcasts along the last axis of `like`."""
    return vector.reshape((1,) * (like.ndim - 1) + vector.shape)


def shift_and_turn(base: Float[Array, " 7"], other: Float[Array, " 7"]) -> Float[Array, " 6"]:
    """(shift in the axes of `base`, m; turn, rad to second order) from `base` to `other`.

    Args:
        base, other: poses (wxyz, xyz).
    """
    (w, v), (w_other, v_other) = (base[0], base[1:4]), (other[0], other[1:4])
    cosine = w * w_other + jnp.sum(v * v_other)
    sine = w * v_other - w_other * v - jnp.cross(v, v_other)
    shift = matvec(rotation_matrix(jaxlie.SO3(base[:4])).T, other[4:] - base[4:])
    return jnp.append(shift, 2 * jnp.where(cosine < 0, -1, 1) * sine)
