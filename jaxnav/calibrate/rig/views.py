"""Sightings of markers by the cameras of a rig, their rays and both of their poses; and poses in
arrays: as wxyz_xyz and as matrices."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.board.views import unproject
from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.refine import solve_markers
from jaxnav.files.poses import transform

_BATCH = 1024  # sightings at a time


@dataclass(frozen=True)
class RigViews:
    """N sightings of M markers by C cameras in F frames: one row each, ordered by frame."""

    frame: Int[np.ndarray, " N"]  # index of the frame
    camera: Int[np.ndarray, " N"]  # index of the camera in the rig
    marker: Int[np.ndarray, " N"]  # index of the marker, into `marker_ids`
    corners_px: Float[np.ndarray, "N 4 2"]  # TL TR BR BL
    size_m: Float[np.ndarray, " M"]  # side of each marker
    marker_ids: tuple[int, ...]  # (M,) the id printed on each marker
    stamps_ns: Int[np.ndarray, " F"]  # of the frames

    def __len__(self) -> int:
        return len(self.frame)

    def only(self, kept: Bool[np.ndarray, " N"]) -> "RigViews":
        """The rows in a mask, with only the frames that they have; markers keep their indices."""
        frames, frame = np.unique(self.frame[kept], return_inverse=True)
        return replace(
            self,
            frame=frame,
            camera=self.camera[kept],
            marker=self.marker[kept],
            corners_px=self.corners_px[kept],
            stamps_ns=self.stamps_ns[frames],
        )

    @property
    def frames(self) -> int:
        """F, the number of frames, including those without a sighting."""
        return len(self.stamps_ns)

    def corners_marker_m(self) -> Float[np.ndarray, "N 4 3"]:
        """The corners of each row in the frame of its marker."""
        return self.size_m[self.marker][:, None, None] / 2 * CORNER_SIGNS


def rays_camera(rig: CameraRig, views: RigViews) -> Float[np.ndarray, "N 4 3"]:
    """Unit vectors through the corners, in the frame of the camera that saw them."""
    rays = np.zeros((len(views), 4, 3))
    for index in range(len(rig)):
        seen = views.camera == index
        rays[seen] = _in_batches(partial(unproject, rig.camera(index)), views.corners_px[seen])
    return rays


def both_poses(
    rays: Float[np.ndarray, "N 4 3"], size_m: Float[np.ndarray, " N"]
) -> Float[np.ndarray, "N 2 4 4"]:
    """Both poses of every row's marker, T_camera_marker (N, 2, 4, 4), the better fit first.

    They are found in a pinhole camera that looks straight at the marker, so that no lens is too
    wide. Rows without a pose hold NaN.
    """
    forward = rays.mean(axis=1)
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    aside = np.where(np.abs(forward[:, 1:2]) < 0.9, [[0.0, 1, 0]], [[1.0, 0, 0]])
    x = np.cross(aside, forward)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    R_camera_straight = np.stack([x, np.cross(forward, x), forward], axis=2)
    straight = np.einsum("nji,nkj->nki", R_camera_straight, rays)
    corners_n = straight[..., :2] / np.maximum(straight[..., 2:], 1e-3)
    T = _in_batches(_solved, corners_n, size_m)
    T[:, :, :3] = np.einsum("nij,nbjk->nbik", R_camera_straight, T[:, :, :3])
    return T


@jax.jit
def _solved(corners_n: Float[Array, "N 4 2"], size_m: Float[Array, " N"]) -> Array:
    return solve_markers(corners_n, size_m).T_camera_marker.as_matrix()


def _in_batches(function: Callable[..., Array], *rows: np.ndarray) -> np.ndarray:
    """Apply a function to rows in batches of one size, so that it is compiled once."""
    count = len(rows[0])
    spots = np.arange(-(-count // _BATCH) * _BATCH) % max(count, 1)
    parts = [
        np.array(function(*(jnp.asarray(array[spots[begin : begin + _BATCH]]) for array in rows)))
        for begin in range(0, len(spots), _BATCH)
    ]
    if not parts:
        shape = jax.eval_shape(function, *(jnp.asarray(array) for array in rows))
        return np.zeros(shape.shape)
    return np.concatenate(parts)[:count]


def wxyz_xyz(Ts: Float[np.ndarray, "n 4 4"]) -> Float[Array, "n 7"]:
    """Convert matrices (n, 4, 4) to wxyz_xyz (n, 7)."""
    xyzw = Rotation.from_matrix(Ts[:, :3, :3]).as_quat()
    return jnp.asarray(np.concatenate([xyzw[:, [3, 0, 1, 2]], Ts[:, :3, 3]], axis=1), float)


def matrices(poses: Float[Array | np.ndarray, "n 7"]) -> Float[np.ndarray, "n 4 4"]:
    """Convert wxyz_xyz (n, 7) to matrices (n, 4, 4)."""
    array = np.asarray(poses, float)
    return transform(Rotation.from_quat(array[:, [1, 2, 3, 0]]).as_matrix(), array[:, 4:])


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
