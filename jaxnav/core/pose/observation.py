"""`Observation`, one reading of all sensors, and `Snapshot`, its compact form for the solvers."""

import dataclasses
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.linalg.small_matrices import in_order
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import quad_area
from jaxnav.core.models.imu import Preintegrated
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig

# Sigma of the error of lens calibration and rolling shutter in a corner, beside its own scatter.
MODEL_SIGMA_PX = 0.15
# A reading beyond these is an error of the sensor or of its unit.
_MAX_SPEED_MPS = 1e3
_MAX_DT_S = 1e4


class Observation(eqx.Module):
    """One synchronous reading of cameras, odometer and steering sensor.

    Axes: C cameras of the rig, M markers of the map. Lanes that are not visible hold any finite
    numbers. `usable` removes readings that no vehicle can have.
    """

    corners_px: Float[Array, "C M 4 2"]  # raw pixels, M in the order of the map
    visible: Bool[Array, "C M"]
    speed_mps: Float[Array, ""] | float = 0.0
    steering_rad: Float[Array, ""] | float = 0.0
    dt_s: Float[Array, ""] | float = 0.0  # since the previous observation
    corner_sigma_px: Float[Array, "C M 4"] | None = None  # None: the estimator's own figure
    has_odometry: Bool[Array, ""] | bool = True  # False: the wheels tell nothing
    # v m/s and w rad/s in the vehicle's axes; a NaN is no reading. Of a body that moves freely, by
    # another estimator: the mean over `dt_s`, so that exp(twist dt_s) is the motion. Of a
    # `TwistBase`, by its wheels: v_x, v_y and w_z (entries 0, 1, 5) at the stamp.
    twist: Float[Array, " 6"] | None = None
    # What an IMU tells of the motion in `dt_s`, in the vehicle's axes; see `InertialMotion`.
    imu: Preintegrated | None = None
    # Readings of another sensor, for `OrientationGiven`; a NaN is no reading.
    heading_rad: Float[Array, ""] | None = None  # psi in the world
    heading_sigma_rad: Float[Array, ""] | float = 0.02
    normals_camera: Float[Array, "C M 3"] | None = None  # unit normal of each marker
    normal_sigma_rad: Float[Array, ""] | float = 0.05
    T_world_vehicle_true: jaxlie.SE3 | None = None  # simulations only, for `Oracle`
    # Mean angular velocity over `dt_s` in the vehicle's axes, by a gyroscope; a NaN is no reading.
    # The planar filter reads z, where its vehicle has a gyro.
    gyro_radps: Float[Array, " 3"] | None = None

    def usable(self) -> "Observation":
        """The observation with all readings finite that a filter uses.

        A lane with a non-finite corner is not visible; without a speed and a steering angle that
        a vehicle can have there is no odometry; a `dt_s` that is no positive time is 0.
        """
        can_steer = jnp.abs(self.steering_rad) < jnp.pi / 2
        has_odometry = self.has_odometry & (jnp.abs(self.speed_mps) < _MAX_SPEED_MPS) & can_steer
        dt_s = jnp.asarray(self.dt_s)
        usable_dt = (dt_s > 0) & (dt_s < _MAX_DT_S)
        return dataclasses.replace(
            self,
            visible=self.visible & jnp.all(jnp.isfinite(self.corners_px), axis=(2, 3)),
            speed_mps=jnp.where(has_odometry, self.speed_mps, 0.0),
            steering_rad=jnp.where(can_steer, self.steering_rad, 0.0),
            dt_s=jnp.where(usable_dt, dt_s, 0.0),
            has_odometry=has_odometry,
        )

    def driven(self, dtype: DTypeLike) -> tuple[Array, Array, Array]:
        """`speed_mps`, NaN without odometry, `steering_rad` and `dt_s`: what a controller reads."""
        speed_mps = jnp.where(self.has_odometry, self.speed_mps, jnp.nan)
        asarray = partial(jnp.asarray, dtype=dtype)
        return asarray(speed_mps), asarray(self.steering_rad), asarray(self.dt_s)


class Sightings(eqx.Module):
    """The D largest visible markers, each with the camera that sees it."""

    camera_index: Int[Array, " D"]
    marker_index: Int[Array, " D"]
    corners_px: Float[Array, "D 4 2"]
    rays: Float[Array, "D 4 3"]  # unit vectors through the corners, in the camera's frame
    sigma_px: Float[Array, "D 4"]
    visible: Bool[Array, " D"]


def sightings(
    rig: CameraRig,
    markers: MarkerMap,
    corners_px: Float[Array, "C M 4 2"],
    visible: Bool[Array, "C M"],
    sigma_px: Float[Array, "*sigma"] | float = 1.0,
    max_count: int | None = None,
) -> Sightings:
    """The visible (camera, marker) lanes in a fixed number of slots.

    A lane with a non-finite corner, or a sigma that is not a positive number, is not visible.

    Args:
        corners_px: (C, M, 4, 2).
        visible: (C, M).
        sigma_px: standard deviation of a corner coordinate, one for all or (C, M, 4).
        max_count: slots; by default one for each lane. Smaller images beyond it are dropped.

    Raises:
        ValueError: shapes that do not fit the rig and the map.
    """
    lanes = (len(rig), len(markers.ids))
    if corners_px.shape != (*lanes, 4, 2) or visible.shape != lanes:
        raise ValueError(
            f"corners_px (C, M, 4, 2) and visible (C, M) with C, M = {lanes} expected, "
            f"got {corners_px.shape} and {visible.shape}"
        )
    count = lanes[0] * lanes[1]
    kept = min(count, max_count or count)
    dtype = rig.cameras.focal_px.dtype
    corners = corners_px.reshape(count, 4, 2).astype(dtype)
    seen = visible.reshape(count) & jnp.all(jnp.isfinite(corners), axis=(1, 2))
    sigma = jnp.broadcast_to(jnp.asarray(sigma_px, dtype), (*lanes, 4)).reshape(count, 4)
    seen = seen & jnp.all(jnp.isfinite(sigma) & (sigma > 0), axis=1)
    sigma = jnp.where(seen[:, None], sigma, 1)
    # A hidden lane becomes a plain square near the principal point: every formula stays finite.
    camera_index = jnp.repeat(jnp.arange(lanes[0]), lanes[1])
    dummy = jnp.asarray([[-20.0, -20.0], [20.0, -20.0], [20.0, 20.0], [-20.0, 20.0]], dtype)
    centers = rig.cameras.center_px[camera_index]
    corners = jnp.where(seen[:, None, None], corners, centers[:, None] + dummy[None])
    if kept < count:
        area = jnp.where(seen, quad_area(corners), -1)
        slots = in_order(area, kept)
    else:
        slots = jnp.arange(count)
    camera_index, corners = camera_index[slots], corners[slots]
    cameras = jax.tree.map(lambda leaf: leaf[camera_index], rig.cameras)
    return Sightings(
        camera_index=camera_index,
        marker_index=jnp.tile(jnp.arange(lanes[1]), lanes[0])[slots],
        corners_px=corners,
        rays=jax.vmap(lambda camera, px: camera.unproject(px))(cameras, corners),
        sigma_px=sigma[slots],
        visible=seen[slots],
    )


def slots(rig: CameraRig, markers: MarkerMap, max_sightings: int | None) -> int:
    """D, the number of largest sightings used: by default two for each marker, at most 16."""
    count = len(markers.ids)
    return min(max_sightings or min(2 * count, 16), len(rig) * count)


class Snapshot(eqx.Module):
    """One observation with its rig and map: all that a pose is compared with."""

    rig: CameraRig
    markers: MarkerMap
    obs: Observation
    seen: Sightings

    @staticmethod
    def create(
        rig: CameraRig,
        markers: MarkerMap,
        obs: Observation,
        corner_sigma_px: Float[Array, ""] | float = 1.0,
        model_sigma_px: Float[Array, ""] | float = MODEL_SIGMA_PX,
        max_sightings: int | None = None,
    ) -> "Snapshot":
        """The snapshot of an observation: its largest sightings with the sigma of their corners.

        Args:
            rig: C cameras.
            markers: M markers.
            obs: the observation.
            corner_sigma_px: of observations that bring no sigma of their own.
            model_sigma_px: sigma of lens calibration and rolling shutter in a corner, added in
                quadrature to the sigma that an observation brings.
            max_sightings: see `slots`.
        """
        sigma_px = corner_sigma_px
        if obs.corner_sigma_px is not None:
            sigma_px = jnp.sqrt(obs.corner_sigma_px**2 + model_sigma_px**2)
        count = slots(rig, markers, max_sightings)
        seen = sightings(rig, markers, obs.corners_px, obs.visible, sigma_px, count)
        return Snapshot(rig, markers, obs, seen)


def log_sigmas(seen: Sightings) -> Float[Array, ""]:
    """Sum of log(sigma) over all visible coordinates, for the likelihood of the corners."""
    return 2 * jnp.sum(jnp.where(seen.visible[:, None], jnp.log(seen.sigma_px), 0))


def cameras_of(rig: CameraRig, seen: Sightings) -> tuple[Camera, jaxlie.SE3]:
    """The camera of every sighting and its `T_camera_vehicle`, batch axis (D,)."""
    cameras_and_poses = rig.cameras, rig.Ts_camera_vehicle
    return jax.tree.map(lambda leaf: leaf[seen.camera_index], cameras_and_poses)
