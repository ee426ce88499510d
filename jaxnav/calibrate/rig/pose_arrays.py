"""Arrays of poses, as wxyz_xyz and as matrices: conversion, retraction, inverses, angles."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float
from scipy.spatial.transform import Rotation

from jaxnav.core.models.geometry import cayley
from jaxnav.core.models.rig import CameraRig
from jaxnav.files.poses import transform


def wxyz_xyz(Ts: Float[np.ndarray, "n 4 4"]) -> Float[Array, "n 7"]:
    """Convert matrices (n, 4, 4) to wxyz_xyz (n, 7)."""
    xyzw = Rotation.from_matrix(Ts[:, :3, :3]).as_quat()
    return jnp.asarray(np.concatenate([xyzw[:, [3, 0, 1, 2]], Ts[:, :3, 3]], axis=1), float)


def matrices(poses: Float[Array | np.ndarray, "n 7"]) -> Float[np.ndarray, "n 4 4"]:
    """Convert wxyz_xyz (n, 7) to matrices (n, 4, 4)."""
    array = np.asarray(poses, float)
    return transform(Rotation.from_quat(array[:, [1, 2, 3, 0]]).as_matrix(), array[:, 4:])


@jax.vmap
def retracted(wxyz_xyz: Float[Array, " 7"], xi: Float[Array, " 6"]) -> Float[Array, " 7"]:
    """Move poses (n, 7) by twists (n, 6): T * cay(xi)."""
    return (jaxlie.SE3(wxyz_xyz) @ cayley(xi)).normalize().wxyz_xyz


def inverted(T: Float[np.ndarray, "*batch 4 4"]) -> Float[np.ndarray, "*batch 4 4"]:
    """Inverses of rigid transforms (..., 4, 4)."""
    R = np.swapaxes(T[..., :3, :3], -1, -2)
    return transform(R, -(R @ T[..., :3, 3:])[..., 0])


def turn_rad(
    T: Float[np.ndarray, "4 4"], Ts: Float[np.ndarray, "*batch 4 4"]
) -> Float[np.ndarray, "*batch"]:
    """Angles between the rotation of T (4, 4) and those of Ts (..., 4, 4)."""
    trace = np.sum(T[:3, :3] * Ts[..., :3, :3], axis=(-1, -2))
    return np.asarray(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def Ts_vehicle_camera(rig: CameraRig) -> Float[np.ndarray, "C 4 4"]:
    """The poses of a rig's cameras, (C, 4, 4)."""
    return inverted(np.asarray(rig.Ts_camera_vehicle.as_matrix(), float))
