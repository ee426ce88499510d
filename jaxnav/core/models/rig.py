"""The camera cluster: several cameras on one body.

Source: Liu, Schofield, Shan (2023), Eq. 2.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.models.camera import Camera, stack_cameras
from jaxnav.core.models.geometry import on_last_axis, transform_points

# Standard deviations of a camera's place, m, and direction, rad, where nobody says: measured by
# hand, and by a calibration that does not tell its own.
PLACED_BY_HAND = np.repeat([0.005, np.deg2rad(0.5)], 3)
PLACED_BY_CALIBRATION = np.repeat([0.002, np.deg2rad(0.2)], 3)


class Timing(NamedTuple):
    """When a camera's sensor sees: None where nobody says.

    Attributes:
        exposure_s: how long each row is exposed.
        row_time_s: from the exposure of one row to that of the next; 0 for a global shutter.
    """

    exposure_s: float | None = None
    row_time_s: float | None = None


UNKNOWN_TIMING = Timing()


class CameraRig(eqx.Module):
    """C cameras fixed to one vehicle. The order of the rig is the order of every C axis."""

    cameras: Camera  # batch axis (C,)
    Ts_camera_vehicle: jaxlie.SE3  # batch axis (C,)
    names: tuple[str, ...] = eqx.field(static=True)
    image_sizes_px: tuple[tuple[int, int], ...] = eqx.field(static=True)  # (width, height)
    # Standard deviations of each camera's place along the vehicle's axes, m, and of its direction
    # about them, rad; None: the cameras are exactly where `Ts_camera_vehicle` says.
    extrinsics_sigma: Float[Array, "C 6"] | None = None
    timings: tuple[Timing, ...] | None = eqx.field(static=True, default=None)  # None: all unknown

    @staticmethod
    def create(
        cameras: Sequence[Camera],
        Ts_camera_vehicle: Sequence[jaxlie.SE3],
        names: Sequence[str],
        image_sizes_px: Sequence[tuple[int, int]],
        extrinsics_sigma: Float[Array | np.ndarray, "C 6"] | None = None,
        timings: Sequence[Timing] | None = None,
    ) -> "CameraRig":
        """A rig from its cameras, one entry each in every sequence."""
        return CameraRig(
            cameras=stack_cameras(cameras),
            Ts_camera_vehicle=jaxlie.SE3(jnp.stack([T.wxyz_xyz for T in Ts_camera_vehicle])),
            names=tuple(names),
            image_sizes_px=tuple((int(w), int(h)) for w, h in image_sizes_px),
            extrinsics_sigma=None
            if extrinsics_sigma is None
            else jnp.asarray(extrinsics_sigma, float),
            timings=None if timings is None else tuple(timings),
        )

    def __len__(self) -> int:
        return len(self.names)

    def camera(self, index: int) -> Camera:
        """One camera of the rig."""
        return jax.tree.map(lambda leaf: leaf[index], self.cameras)

    def timing(self, index: int) -> Timing:
        """What is known of when one camera's sensor sees."""
        return UNKNOWN_TIMING if self.timings is None else self.timings[index]

    def first(self, count: int) -> "CameraRig":
        """The rig with its first cameras alone."""
        arrays = self.cameras, self.Ts_camera_vehicle, self.extrinsics_sigma
        cameras, Ts_camera_vehicle, sigma = jax.tree.map(lambda leaf: leaf[:count], arrays)
        names, sizes_px = self.names[:count], self.image_sizes_px[:count]
        timings = None if self.timings is None else self.timings[:count]
        return CameraRig(cameras, Ts_camera_vehicle, names, sizes_px, sigma, timings)

    def with_focal_px(self, mean_px: Float[Array, ""] | float) -> "CameraRig":
        """The rig with all focal lengths scaled to this mean."""
        focal_px = self.cameras.focal_px * (mean_px / jnp.mean(self.cameras.focal_px))
        return eqx.tree_at(lambda rig: rig.cameras.focal_px, self, focal_px)

    def project(
        self, T_vehicle_world: jaxlie.SE3, points_world_m: Float[Array, "*batch 3"]
    ) -> Float[Array, " C *batch 2"]:
        """Pixels of world points in every camera: u = K_j T_jv T_vw p_w (Eq. 2)."""
        points_vehicle = transform_points(T_vehicle_world, points_world_m)
        return jax.vmap(
            lambda camera, T_camera_vehicle: camera.project(
                transform_points(T_camera_vehicle, points_vehicle)
            )
        )(self.cameras, self.Ts_camera_vehicle)

    def sees(
        self, T_vehicle_world: jaxlie.SE3, points_world_m: Float[Array, "*batch 3"]
    ) -> Bool[Array, " C *batch"]:
        """Whether each world point lies in front of each camera and inside its image."""
        points_vehicle = transform_points(T_vehicle_world, points_world_m)

        def one(camera: Camera, T_camera_vehicle: jaxlie.SE3, size_px: Array) -> Array:
            points_camera = transform_points(T_camera_vehicle, points_vehicle)
            pixels = camera.project(points_camera)
            inside = (pixels >= -0.5) & (pixels <= on_last_axis(size_px - 0.5, pixels))
            return jnp.all(inside, axis=-1) & camera.in_front(points_camera)

        sizes = jnp.asarray(self.image_sizes_px, self.cameras.focal_px.dtype)
        return jax.vmap(one)(self.cameras, self.Ts_camera_vehicle, sizes)
