"""Arrays of poses, as wxyz_xyz and as matrices: conversion, retraction, inverses, angles."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxnav.files.poses import transform
from jaxnav.models.geometry import cayley
from jaxnav.models.rig import CameraRig


def wxyz_xyz(Ts: np.ndarray) -> jax.Array:
    """Convert matrices (n, 4, 4) to wxyz_xyz (n, 7)."""
    xyzw = Rotation.from_matrix(Ts[:, :3, :3]).as_quat()
    return jnp.asarray(np.concatenate([xyzw[:, [3, 0, 1, 2]], Ts[:, :3, 3]], axis=1), float)


def matrices(poses: jax.Array | np.ndarray) -> np.ndarray:
    """Convert wxyz_xyz (n, 7) to matrices (n, 4, 4)."""
    array = np.asarray(poses, float)
    return transform(Rotation.from_quat(array[:, [1, 2, 3, 0]]).as_matrix(), array[:, 4:])


@jax.vmap
def retracted(wxyz_xyz: Float[Array, " 7"], xi: Float[Array, " 6"]) -> Float[Array, " 7"]:
    """Move poses (n, 7) by twists (n, 6): T * cay(xi)."""
    return (jaxlie.SE3(wxyz_xyz) @ cayley(xi)).normalize().wxyz_xyz


def inverted(T: np.ndarray) -> np.ndarray:
    """Inverses of rigid transforms (..., 4, 4)."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R, -(R @ T[..., :3, 3:])[..., 0])


def turn_rad(T: np.ndarray, Ts: np.ndarray) -> np.ndarray:
    """Angles between the rotation of T (4, 4) and those of Ts (..., 4, 4)."""
    trace = np.sum(T[:3, :3] * Ts[..., :3, :3], axis=(-1, -2))
    return np.asarray(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def Ts_vehicle_camera(rig: CameraRig) -> np.ndarray:
    """The poses of a rig's cameras, (C, 4, 4)."""
    return inverted(np.asarray(rig.Ts_camera_vehicle.as_matrix(), float))
