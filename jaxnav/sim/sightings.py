"""Simulate a moving rig's sightings of markers as a table of corners, to test calibrations."""

from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.sim.corners import see


class SimulatedSightings(NamedTuple):
    """A table of N sightings, ordered by frame, camera and marker."""

    frame: Int[np.ndarray, " N"]
    camera: Int[np.ndarray, " N"]
    marker: Int[np.ndarray, " N"]
    corners_px: Float[np.ndarray, "N 4 2"]


def simulate_sightings(
    rig: CameraRig,
    markers: MarkerMap,
    Ts_world_vehicle: Float[np.ndarray, "F 7"],
    noise_px: float,
    rng: np.random.Generator,
    max_obliquity_deg: float = 75.0,
) -> SimulatedSightings:
    """The sightings of all readable markers, with Gaussian noise on the corners.

    Args:
        Ts_world_vehicle: wxyz_xyz, m.
        max_obliquity_deg: largest angle between the line of sight and a marker's normal.
    """
    corners_px, visible = _seen(rig, markers, jnp.asarray(Ts_world_vehicle), max_obliquity_deg)
    frame, camera, marker = np.nonzero(np.asarray(visible))
    exact = np.asarray(corners_px)[frame, camera, marker]
    noisy = exact + rng.normal(0, noise_px, exact.shape)
    return SimulatedSightings(frame, camera, marker, noisy)


@partial(jax.jit, static_argnames="max_obliquity_deg")
def _seen(
    rig: CameraRig, markers: MarkerMap, Ts: Float[Array, "F 7"], max_obliquity_deg: float
) -> tuple[Array, Array]:
    least = float(np.cos(np.deg2rad(max_obliquity_deg)))

    def one(wxyz_xyz: Array) -> tuple[Array, Array]:
        T_world_vehicle = jaxlie.SE3(wxyz_xyz)
        corners_px, visible = see(rig, markers, T_world_vehicle)
        normals = markers.Ts_world_marker.rotation().as_matrix()[:, :, 2]
        Ts_world_camera = jax.vmap(lambda T: T_world_vehicle @ T.inverse())(rig.Ts_camera_vehicle)
        towards = (
            Ts_world_camera.translation()[:, None] - markers.Ts_world_marker.translation()[None]
        )
        cosine = jnp.einsum("cmi,mi->cm", towards, normals) / jnp.linalg.norm(towards, axis=-1)
        return corners_px, visible & (cosine > least)

    return jax.lax.map(one, Ts)
