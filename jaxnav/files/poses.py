"""Rigid transforms as files hold them, in NumPy's float64 whatever JAX's precision is.

A pose is the (7,) array of jaxlie: quaternion w x y z, then translation in m.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

# Rounding in a file is repaired up to this deviation; beyond, the matrix is no rotation.
_MAX_DEVIATION = 1e-3


def check_matrix(rows: list[list[float]]) -> list[list[float]]:
    """Return the rows if they are a rigid 4x4 transform.

    Raises:
        ValueError: the rows are a mirror image, not orthonormal, or the last row is wrong.
    """
    T = np.asarray(rows, float)
    R = T[:3, :3]
    if np.abs(T[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise ValueError(f"the last row must be 0 0 0 1, got {rows[3]}")
    deviation = np.abs(R @ R.T - np.eye(3)).max()
    if deviation > _MAX_DEVIATION:
        raise ValueError(f"the 3x3 part is not a rotation: R R' is off by {deviation:.2g}")
    if np.linalg.det(R) < 0:
        raise ValueError("the 3x3 part has det(R) < 0: a mirror image, not a rotation")
    return rows


def check_quaternion(wxyz: list[float]) -> list[float]:
    """Return the quaternion if its length is 1 but for rounding.

    Raises:
        ValueError: its length is not 1.
    """
    length = np.linalg.norm(wxyz)
    if abs(length - 1) > _MAX_DEVIATION:
        raise ValueError(f"must have length 1, got {length:.6g}")
    return wxyz


def pose_from_matrix(T: Sequence[Sequence[float]] | np.ndarray) -> Float[np.ndarray, " 7"]:
    """The pose (7,) of a 4x4 that `check_matrix` accepts; R becomes the nearest rotation."""
    T = np.asarray(T, float)
    return _pose(Rotation.from_matrix(T[:3, :3]), T[:3, 3])


def pose_as_read(written: Any) -> Float[np.ndarray, " 7"]:
    """The pose (7,) of one as a file has it: the rows of a 4x4, or `wxyz` and `xyz_m`.

    A quaternion is normalised only if its length is off by more than float32's rounding.
    """
    if isinstance(written, list):
        return pose_from_matrix(written)
    q = np.asarray(written.wxyz, float)
    length = np.linalg.norm(q)
    return np.concatenate([q if abs(length - 1) < 1e-6 else q / length, written.xyz_m])


def matrix_as_read(written: Any) -> Float[np.ndarray, "4 4"]:
    """The 4x4 of one as a file has it, the file's own numbers where it is a 4x4 there."""
    return np.array(written, float) if isinstance(written, list) else matrix(pose_as_read(written))


def quaternion_product(p: Sequence[float], q: Sequence[float]) -> list[float]:
    """The quaternion p q, wxyz; every number is rounded once where a factor holds only halves."""
    pw, px, py, pz = p
    qw, qx, qy, qz = q
    return [
        math.fsum((pw * qw, -px * qx, -py * qy, -pz * qz)),
        math.fsum((pw * qx, px * qw, py * qz, -pz * qy)),
        math.fsum((pw * qy, -px * qz, py * qw, pz * qx)),
        math.fsum((pw * qz, px * qy, -py * qx, pz * qw)),
    ]


def pose_from_rotation_vector(
    rotation_rad: Sequence[float], xyz_m: Sequence[float]
) -> Float[np.ndarray, " 7"]:
    """The pose (7,) of a rotation vector, rad, and a translation, m."""
    return _pose(Rotation.from_rotvec(np.asarray(rotation_rad, float)), xyz_m)


def _pose(rotation: Rotation, xyz_m: Sequence[float] | np.ndarray) -> Float[np.ndarray, " 7"]:
    return np.concatenate([rotation.as_quat(scalar_first=True), np.asarray(xyz_m, float)])


def transform(
    R: Float[np.ndarray, "*batch 3 3"], translation_m: np.ndarray | Sequence[float]
) -> Float[np.ndarray, "*batch 4 4"]:
    """The 4x4 of a rotation (..., 3, 3) and a translation (..., 3), m."""
    T = np.zeros((*R.shape[:-2], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, translation_m, 1
    return T


def matrix(pose: Float[np.ndarray, " 7"]) -> Float[np.ndarray, "4 4"]:
    """The 4x4 of a pose (7,)."""
    return transform(Rotation.from_quat(pose[:4], scalar_first=True).as_matrix(), pose[4:])


def inverse(pose: Float[np.ndarray, " 7"]) -> Float[np.ndarray, " 7"]:
    """The pose T_b_a of T_a_b."""
    w, x, y, z, *xyz_m = pose.tolist()
    back = rotated((w, -x, -y, -z), xyz_m)
    return np.array([w, -x, -y, -z, -back[0], -back[1], -back[2]])


def compose(
    T_a_b: Float[np.ndarray, " 7"], T_b_c: Float[np.ndarray, " 7"]
) -> Float[np.ndarray, " 7"]:
    """The pose T_a_c. In plain numbers: a tenth of the time of products of small arrays."""
    (*p, x_m, y_m, z_m), (*q, dx_m, dy_m, dz_m) = T_a_b.tolist(), T_b_c.tolist()
    turned = rotated(p, (dx_m, dy_m, dz_m))
    product = quaternion_product(p, q)
    length = math.hypot(*product)
    wxyz = [number / length for number in product]
    return np.array([*wxyz, x_m + turned[0], y_m + turned[1], z_m + turned[2]])


def rotated(wxyz: Sequence[float], vector: Sequence[float]) -> tuple[float, float, float]:
    """A vector, turned by a quaternion of any length but 0."""
    (w, x, y, z), (a, b, c) = wxyz, vector
    twice = 2 / (w * w + x * x + y * y + z * z)
    # 2 (q x v), and its cross product with q
    d, e, f = twice * (y * c - z * b), twice * (z * a - x * c), twice * (x * b - y * a)
    return a + w * d + y * f - z * e, b + w * e + z * d - x * f, c + w * f + x * e - y * d


def rotation_towards(
    yaw_deg: float, elevation_deg: float, roll_deg: float
) -> Float[np.ndarray, "3 3"]:
    """The rotation R_vehicle_camera (3, 3) of a camera that looks in a direction.

    Args:
        yaw_deg: 0 looks forward, 90 to the left.
        elevation_deg: positive looks up.
        roll_deg: positive turns the camera clockwise as seen from behind it.
    """
    forward = [[0, 0, 1], [-1, 0, 0], [0, -1, 0]]  # right, down, forward in x y z
    about_axis = Rotation.from_euler("z", roll_deg, degrees=True)
    towards = Rotation.from_euler("ZY", [yaw_deg, -elevation_deg], degrees=True)
    return (towards * Rotation.from_matrix(forward) * about_axis).as_matrix()
