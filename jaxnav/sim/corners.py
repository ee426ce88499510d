"""Project markers to corners without images or a detector, and let their errors drift.

Pure, for rollouts under vmap.
"""

import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Key

from jaxnav.core.models.geometry import quad_area, rotation_matrix
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig

MIN_SIDE_PX = 8.0  # below this no detector reads a marker


def see(
    rig: CameraRig, markers: MarkerMap, T_world_vehicle: jaxlie.SE3
) -> tuple[Float[Array, "C M 4 2"], Bool[Array, "C M"]]:
    """Exact corners in pixels, and a mask of the readable markers.

    A marker is readable if all its corners are inside the image, its printed side faces the camera,
    and its diagonals span a square of at least `MIN_SIDE_PX`.
    """
    T_vehicle_world = T_world_vehicle.inverse()
    corners_px = rig.project(T_vehicle_world, markers.corners_world_m)
    inside = jnp.all(rig.sees(T_vehicle_world, markers.corners_world_m), axis=-1)
    normals = jax.vmap(rotation_matrix)(markers.Ts_world_marker.rotation())[:, :, 2]
    Ts_world_camera = jax.vmap(lambda T: T_world_vehicle @ T.inverse())(rig.Ts_camera_vehicle)
    towards = Ts_world_camera.translation()[:, None] - markers.Ts_world_marker.translation()[None]
    faces = jnp.einsum("cmi,mi->cm", towards, normals) > 0
    return corners_px, inside & faces & (quad_area(corners_px) > MIN_SIDE_PX**2)


def drifted(
    drift: Float[Array, "*batch"], correlation: float, key: Key[Array, ""]
) -> Float[Array, "*batch"]:
    """A drift one frame later: a first-order Gauss-Markov process of unit variance.

    drift' = a drift + sqrt(1 - a^2) e, with e ~ N(0, 1) of every element and frame for itself.

    Args:
        drift: drawn from N(0, 1) at first.
        correlation: a, from 0 (white) to 1 (constant).
    """
    fresh = jax.random.normal(key, drift.shape, drift.dtype)
    return correlation * drift + (1 - correlation**2) ** 0.5 * fresh
