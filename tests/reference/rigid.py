"""Rigid motions next to the identity, by their definition as 4 x 4 matrices."""

import numpy as np
from scipy.spatial.transform import Rotation


def twist_matrix(xi: np.ndarray) -> np.ndarray:
    """Of a twist (translation, rotation)."""
    x, y, z = xi[3:]
    return np.array([[0, -z, y, xi[0]], [z, 0, -x, xi[1]], [-y, x, 0, xi[2]], [0, 0, 0, 0]])


def cayley(xi: np.ndarray) -> np.ndarray:
    X, eye = twist_matrix(xi), np.eye(4)
    return np.linalg.solve(eye - X / 2, eye + X / 2)


def inverse_cayley(T: np.ndarray) -> np.ndarray:
    X = 2 * (T - np.eye(4)) @ np.linalg.inv(T + np.eye(4))
    return np.array([X[0, 3], X[1, 3], X[2, 3], X[2, 1], X[0, 2], X[1, 0]])


def matrix(wxyz_xyz: np.ndarray) -> np.ndarray:
    """Of poses (..., 7)."""
    wxyz_xyz = np.asarray(wxyz_xyz, float)
    T = np.zeros((*wxyz_xyz.shape[:-1], 4, 4))
    T[..., :3, :3] = Rotation.from_quat(wxyz_xyz[..., [1, 2, 3, 0]]).as_matrix()
    T[..., :3, 3], T[..., 3, 3] = wxyz_xyz[..., 4:], 1
    return T


def wxyz_xyz(T: np.ndarray) -> np.ndarray:
    """Of matrices (..., 4, 4)."""
    quaternion = Rotation.from_matrix(T[..., :3, :3]).as_quat()
    return np.concatenate([quaternion[..., [3, 0, 1, 2]], T[..., :3, 3]], axis=-1)
