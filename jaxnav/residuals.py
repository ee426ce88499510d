"""The two errors of the paper: in the image and in space.

Source: Liu, Schofield, Shan (2023), Eqs. 3, 13 and 14.
"""

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.camera import Camera
from jaxnav.geometry import transform_points
from jaxnav.markers import MarkerMap
from jaxnav.observation import Sightings, cameras_of, sightings
from jaxnav.rig import CameraRig


def reprojection_residuals(
    rig: CameraRig, seen: Sightings, corners_vehicle: Float[Array, "M 4 3"]
) -> Float[Array, "D 4 2"]:
    """Projected minus observed corners in pixels, zero in hidden lanes.

    Args:
        seen: the sightings.
        corners_vehicle: corners of all markers of the map, in the vehicle frame, m.
    """

    def one(
        camera: Camera,
        T_camera_vehicle: jaxlie.SE3,
        marker_index: Array,
        corners_px: Array,
        visible: Array,
    ) -> Array:
        corners_camera = transform_points(T_camera_vehicle, corners_vehicle[marker_index])
        return jnp.where(visible, camera.project(corners_camera) - corners_px, 0)

    Ts_camera_vehicle = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[seen.camera_index])
    return jax.vmap(one)(
        cameras_of(rig, seen), Ts_camera_vehicle, seen.marker_index, seen.corners_px, seen.visible
    )


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
    return jnp.sum(reprojection_residuals(rig, seen, corners_vehicle) ** 2)


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
