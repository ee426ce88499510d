"""The two errors of the paper: in the image and in space.

Source: Liu, Schofield, Shan (2023), Eqs. 3, 13 and 14.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import rotation_matrix, transform_points, turn_and_shift
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Sightings, cameras_of, sightings


def reprojection_residuals(
    rig: CameraRig, seen: Sightings
) -> Callable[[Float[Array, "M 4 3"]], Float[Array, "D 4 2"]]:
    """Projected minus observed corners in pixels, zero in hidden lanes.

    The parts that do not depend on the pose are computed here, once.

    Args:
        rig: C cameras.
        seen: D sightings.

    Returns:
        A function of the corners of all markers of the map, in the vehicle frame, m.
    """
    cameras, Ts_camera_vehicle = cameras_of(rig, seen)
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
    """Image-space error, pixel^2 (Eq. 3): squared distances of all visible corners.

        e1(T_vw) = sum_ij |u_ij - project_j(T_jv T_vw p_i)|^2

    Pixels are raw: the lens is part of the projection.

    Args:
        rig: C cameras j, with T_jv = `Ts_camera_vehicle`.
        markers: M markers, whose corners p_i are in the world.
        corners_px: u_ij, (C, M, 4, 2).
        visible: (C, M).
        T_vehicle_world: T_vw.

    Source: Liu, Schofield, Shan (2023), Eq. 3.
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
    """Object-space error, m^2 (Eq. 14): squared distances of the corners to their prediction.

        e2(T_vw) = sum_i |T_vw p_i - T_w p_i|^2

    in the vehicle frame, over the corners p_i of the markers in view. A marker seen by two cameras
    counts once.

    Args:
        markers: M markers.
        visible: (C, M).
        T_vehicle_world: T_vw.
        T_vehicle_world_prior: T_w, the filter's prediction.

    Source: Liu, Schofield, Shan (2023), Eq. 14.
    """
    corners = markers.corners_world_m
    gap = transform_points(T_vehicle_world, corners) - transform_points(
        T_vehicle_world_prior, corners
    )
    in_view = jnp.any(visible, axis=0)
    return jnp.sum(jnp.where(in_view[:, None, None], gap, 0) ** 2)
