"""Lenses, bearings and views of markers: the few compiled programs that checks of files share."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import T_world_vehicle_from_planar, transform_points
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig

_SAME_RAY = 1e-3  # between a ray and the ray of its pixel, where the lens is one-to-one
_PIXELS = 256  # in each call, so that the program is compiled once


@jax.jit
def _through_lens(cameras: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Rays (C, N, 3) of pixels (C, N, 2) of C cameras, and how far these miss the pixels, px."""

    def one(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
        rays = camera.unproject(pixels)
        return rays, jnp.linalg.norm(camera.project(rays) - pixels, axis=-1)

    return jax.vmap(one)(cameras, pixels)


def through_lens(
    rig: CameraRig, pixels: Float[np.ndarray, "C N 2"]
) -> tuple[Float[np.ndarray, "C N 3"], Float[np.ndarray, "C N"]]:
    """The rays of pixels, and their reprojection errors.

    Args:
        pixels: (C, N, 2), N up to 256.

    Returns:
        Unit rays in each camera (C, N, 3), and how far from its pixel the lens model projects each
        ray, (C, N) px: next to nothing where it can be inverted.
    """
    count = pixels.shape[1]
    padded = np.pad(pixels, ((0, 0), (0, _PIXELS - count), (0, 0)), mode="edge")
    rays, error_px = jax.device_get(_through_lens(rig.cameras, jnp.asarray(padded, float)))
    return rays[:, :count], error_px[:, :count]


@jax.jit
def _sees_directions(rig: CameraRig, directions_vehicle: jax.Array) -> jax.Array:
    def one(camera: Camera, T_camera_vehicle: jaxlie.SE3, size_px: jax.Array) -> jax.Array:
        turn = jaxlie.SE3.from_rotation(T_camera_vehicle.rotation())
        rays = transform_points(turn, directions_vehicle)
        pixels = camera.project(rays)
        inside = jnp.all((pixels >= -0.5) & (pixels <= size_px[None] - 0.5), axis=-1)
        # A lens that folds sends rays from far outside into the image again.
        same = jnp.linalg.norm(camera.unproject(pixels) - rays, axis=-1) < _SAME_RAY
        return inside & same & camera.in_front(rays)

    sizes_px = jnp.asarray(rig.image_sizes_px, directions_vehicle.dtype)
    return jax.vmap(one)(rig.cameras, rig.Ts_camera_vehicle, sizes_px)


def sees_directions(
    rig: CameraRig, directions_vehicle: Float[np.ndarray, "N 3"]
) -> Bool[np.ndarray, "C N"]:
    """Which cameras see far objects in unit directions (N, 3) of the vehicle: (C, N) bool."""
    return np.asarray(_sees_directions(rig, jnp.asarray(directions_vehicle, float)))


def area_px2(corners_px: Float[np.ndarray, "*batch 4 2"]) -> Float[np.ndarray, "*batch"]:
    """The areas (...) of quadrilaterals (..., 4, 2) in an image, px^2: positive where the corners
    run clockwise, as those of a marker seen from the front."""
    a, b = np.moveaxis(corners_px[..., :2, :] - corners_px[..., 2:, :], -2, 0)
    return np.asarray((a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0]) / 2)


@dataclass(frozen=True)
class PoseViews:
    """Views of every marker in every camera from P poses of the vehicle.

    Attributes:
        side_px: (P, C, M), the side of a square of the marker's area in the image; 0 where the
            marker does not lie in the image whole with its printed side towards the camera.
        behind: (P, M), whether the vehicle is on the side of the marker that is not printed.
        range_m: (P, C, M), from camera to marker.
    """

    side_px: Float[np.ndarray, "P C M"]
    behind: Bool[np.ndarray, "P M"]
    range_m: Float[np.ndarray, "P C M"]


@jax.jit
def _corners(
    rig: CameraRig, markers: MarkerMap, poses: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    def one(pose: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        T_world_vehicle = T_world_vehicle_from_planar(pose)
        T_vehicle_world = T_world_vehicle.inverse()
        corners_world_m = markers.corners_world_m
        inside = jnp.all(rig.sees(T_vehicle_world, corners_world_m), axis=-1)
        pixels = rig.project(T_vehicle_world, corners_world_m)
        return pixels, inside, T_world_vehicle.as_matrix()

    return jax.vmap(one)(poses)


def views(rig: CameraRig, markers: MarkerMap, poses: Float[np.ndarray, "P 3"]) -> PoseViews:
    """`PoseViews` from planar poses (P, 3): x m, y m, psi rad."""
    corners_px, inside, Ts_world_vehicle = jax.device_get(
        _corners(rig, markers, jnp.asarray(poses, float))
    )
    areas_px2 = area_px2(corners_px)
    side_px = np.sqrt(np.where(inside & (areas_px2 > 0), areas_px2, 0))
    positions_world_m = np.einsum("pij,cj->pci", Ts_world_vehicle, Ts_vehicle_camera(rig)[:, :, 3])[
        ..., :3
    ]
    Ts_world_marker = np.asarray(markers.Ts_world_marker.as_matrix())
    centers_world_m, normals = Ts_world_marker[:, :3, 3], Ts_world_marker[:, :3, 2]
    arms_m = positions_world_m[:, :, None] - centers_world_m
    to_vehicle_m = Ts_world_vehicle[:, None, :2, 3] - centers_world_m[:, :2]
    behind = np.einsum("pmi,mi->pm", to_vehicle_m, normals[:, :2]) < 0
    return PoseViews(side_px, behind, np.linalg.norm(arms_m, axis=-1))
