"""The two errors of the paper: in the image and in space.

Source: Liu, Schofield, Shan (2023), Eqs. 3, 13 and 14.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.models.camera import Camera
from jaxnav.models.geometry import rotation_matrix, transform_points, turn_and_shift
from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig
from jaxnav.pose.observation import Sightings, cameras_of, sightings


def reprojection_residuals(
    rig: CameraRig, seen: Sightings
) -> Callable[[Float[Array, "M 4 3"]], Float[Array, "D 4 2"]]:
    """Projected minus observed corners in pixels, zero in hidden lanes.

    What does not depend on the pose is done once, before anything is minimised.

    Args:
        seen: the sightings.

    Returns:
        A function of the corners of all markers of the map, in the vehicle frame, m.
    """
    cameras = cameras_of(rig, seen)
    Ts_camera_vehicle = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[seen.camera_index])
    Rs_camera_vehicle = jax.vmap(rotation_matrix)(Ts_camera_vehicle.rotation())

    def one(camera: Camera, R: Array, t: Array, corners: Array, corners_px: Array) -> Array:
        return camera.project(turn_and_shift(R, t, corners)) - corners_px

    def residuals(corners_vehicle: Array) -> Array:
        pixels = jax.vmap(one)(
            cameras,
            Rs_camera_vehicle,
            Ts_camera_vehicle.translation(),
            corners_vehicle[seen.marker_index],
            seen.corners_px,
        )
        return jnp.where(seen.visible[:, None, None], pixels, 0)

    return residuals


def e1(
    rig: CameraRig,
    markers: MarkerMap,
    corners_px: Float[Array, "C M 4 2"],
    visible: Bool[Array, "C M"],
    T_vehicle_world: jaxlie.SE3,
) -> Float[Array, ""]:
    """Image-space error: squared distances of all visible corners, pixel^2 (Eq. 3).

    Pixels are raw: the lens is part of the projection.
    """
    seen = sightings(rig, markers, corners_px, visible)
    corners_vehicle = transform_points(T_vehicle_world, markers.corners_world_m)
    return jnp.sum(reprojection_residuals(rig, seen)(corners_vehicle) ** 2)


def e2(
    markers: MarkerMap,
    visible: Bool[Array, "C M"],
    T_vehicle_world: jaxlie.SE3,
    T_vehicle_world_prior: jaxlie.SE3,
) -> Float[Array, ""]:
    """Object-space error: squared distances, in the vehicle frame, between the corners under a
    pose and under the filter's prediction, m^2, summed over the markers in view (Eq. 14).

    A marker seen by two cameras counts once.
    """
    corners = markers.corners_world_m
    gap = transform_points(T_vehicle_world, corners) - transform_points(
        T_vehicle_world_prior, corners
    )
    in_view = jnp.any(visible, axis=0)
    return jnp.sum(jnp.where(in_view[:, None, None], gap, 0) ** 2)
