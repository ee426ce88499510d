"""Compute the ray of every pixel, and the camera's pose during the exposure.

The plane z = 0 of a surface, seen along a ray r of the camera, is a homography in r:
(x, y, 1) ~ H r with H = [q_x n - q_z a; q_y n - q_z b; n], where q is the camera's position in
the surface's frame and a, b, n are the surface's axes in the camera's. One over the distance
along the ray is -n.r / q_z.

Source: Hartley and Zisserman (2004), "Multiple View Geometry", section 8.1.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnav.core.models.camera import Camera
from jaxnav.errors import BadInput
from jaxnav.sim.sensor import Shutter

CELL_PX = 8  # cell of the grid on which visibility is determined
# Samples of the background: a square grid, rotated until all rows and columns differ.
BACKGROUND_PX = np.array([[-3, -1], [1, -3], [3, 1], [-1, 3]]) / 8


@dataclass(frozen=True)
class PixelRays:
    """The rays of one camera, in layouts that suit products over a row of pixels."""

    rows: int
    columns: int
    rays: Float[np.ndarray, "rows 3 columns"]  # float32 unit vectors through the pixels' centres
    rays_dx: Float[np.ndarray, "rows 3 columns"]  # their change one pixel to the right
    rays_dy: Float[np.ndarray, "rows 3 columns"]  # their change one pixel down
    # Through the samples of the background.
    background_rays: Float[np.ndarray, "rows 4 3 columns"]
    valid: Bool[np.ndarray, "rows columns"]  # pixels that have a ray
    center_px: Float[np.ndarray, " 2"]  # the principal point
    pixel_rad: float  # the typical angle between neighbouring pixels
    finest_rad: float  # that angle where the lens resolves best

    @property
    def nodes_y(self) -> Int[np.ndarray, " nodes"]:
        """The rows of a coarse grid that spans the image."""
        return np.minimum(np.arange(0, self.rows + CELL_PX, CELL_PX), self.rows - 1)

    @property
    def nodes_x(self) -> Int[np.ndarray, " nodes"]:
        """The columns of a coarse grid that spans the image."""
        return np.minimum(np.arange(0, self.columns + CELL_PX, CELL_PX), self.columns - 1)

    @staticmethod
    def create(camera: Camera, columns: int, rows: int) -> "PixelRays":
        """Invert the lens of one camera for every pixel.

        Raises:
            BadInput: no pixel of the image has a ray.
        """
        x, y = np.meshgrid(np.arange(-1.0, columns + 1), np.arange(-1.0, rows + 1))
        rays, error_px = (
            np.asarray(array) for array in _unproject_rows(camera, np.stack([x, y], -1))
        )
        reached = error_px < 0.05
        # A derivative needs both neighbours.
        valid = reached[1:-1, 1:-1].copy()
        for side in (reached[:-2, 1:-1], reached[2:, 1:-1], reached[1:-1, :-2], reached[1:-1, 2:]):
            valid &= side
        rays_dx = ((rays[1:-1, 2:] - rays[1:-1, :-2]) / 2).swapaxes(1, 2)
        rays_dy = ((rays[2:, 1:-1] - rays[:-2, 1:-1]) / 2).swapaxes(1, 2)
        centre = rays[1:-1, 1:-1].swapaxes(1, 2)
        samples = np.stack([centre + dx * rays_dx + dy * rays_dy for dx, dy in BACKGROUND_PX], 1)
        lengths = np.linalg.norm(rays_dx, axis=1)[valid]
        if not lengths.size:
            raise BadInput("rig", "the lens of a camera maps no ray into its image")

        def pack(array: np.ndarray) -> np.ndarray:
            return np.ascontiguousarray(array, np.float32)

        return PixelRays(
            rows=rows,
            columns=columns,
            rays=pack(centre),
            rays_dx=pack(rays_dx),
            rays_dy=pack(rays_dy),
            background_rays=pack(samples),
            valid=valid,
            center_px=np.asarray(camera.center_px),
            pixel_rad=float(np.median(lengths)),
            finest_rad=float(np.percentile(lengths, 1)),
        )


@jax.jit
def _unproject_rows(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
    """The rays (H, W, 3) of pixels (H, W, 2), and their reprojection error (H, W) in px."""

    def one_row(row_px: jax.Array) -> tuple[jax.Array, jax.Array]:
        rays = camera.unproject(row_px)
        return rays, jnp.linalg.norm(camera.project(rays) - row_px, axis=-1)

    # Row by row: a lens may invert by a table of a hundred entries a pixel.
    return jax.lax.map(one_row, pixels)


@dataclass(frozen=True)
class PosePath:
    """The poses of the vehicle at a few instants, with linear interpolation between them."""

    times_s: Float[np.ndarray, " N"]  # relative to the stamp
    Rs_world_vehicle: Float[np.ndarray, "N 3 3"]
    positions_world_m: Float[np.ndarray, "N 3"]

    @staticmethod
    def create(times_s: Float[np.ndarray, " N"], wxyz_xyz: Float[np.ndarray, "N 7"]) -> "PosePath":
        """The motion of T_world_vehicle (N, 7), w x y z, x y z, at evenly spaced times."""
        wxyz = wxyz_xyz[:, :4] / np.linalg.norm(wxyz_xyz[:, :4], axis=1, keepdims=True)
        w, v = wxyz[:, 0, None, None], wxyz[:, 1:]
        cross = np.cross(v[:, None, :], np.eye(3)).swapaxes(1, 2)
        R = np.eye(3) + 2 * w * cross + 2 * cross @ cross
        return PosePath(times_s, R, wxyz_xyz[:, 4:])

    @property
    def rotation_steps_rad(self) -> Float[np.ndarray, " steps"]:
        """The angle between neighbouring poses, (N-1,)."""
        chord = np.linalg.norm(np.diff(self.Rs_world_vehicle, axis=0), axis=(1, 2)) / np.sqrt(8)
        return 2 * np.arcsin(np.clip(chord, 0, 1))

    @property
    def travel_steps_m(self) -> Float[np.ndarray, " steps"]:
        """The distance between neighbouring poses, (N-1,)."""
        return np.linalg.norm(np.diff(self.positions_world_m, axis=0), axis=1)

    def at(
        self, times_s: Float[np.ndarray, "*batch"]
    ) -> tuple[Float[np.ndarray, "*batch 3 3"], Float[np.ndarray, "*batch 3"]]:
        """The rotation (..., 3, 3) and position (..., 3) in the world at any times (...)."""
        if len(self.times_s) == 1:
            shape = np.shape(times_s)
            return (
                np.broadcast_to(self.Rs_world_vehicle[0], (*shape, 3, 3)),
                np.broadcast_to(self.positions_world_m[0], (*shape, 3)),
            )
        step_s = self.times_s[1] - self.times_s[0]
        place = np.clip((times_s - self.times_s[0]) / step_s, 0, len(self.times_s) - 1 - 1e-9)
        before = place.astype(int)
        after, share = before + 1, (place - before)[..., None]
        R, p = self.Rs_world_vehicle, self.positions_world_m
        return (
            R[before] + share[..., None] * (R[after] - R[before]),
            p[before] + share * (p[after] - p[before]),
        )


class MovingCamera:
    """One camera during one image: its motion, and the speed of its picture."""

    def __init__(
        self,
        lens: PixelRays,
        motion: PosePath,
        T_vehicle_camera: Float[np.ndarray, "4 4"],
        shutter: Shutter,
    ):
        self.lens, self._motion, self._T_vehicle_camera = lens, motion, T_vehicle_camera
        self.exposure_s = shutter.exposure_s
        self.row_times_s = shutter.row_times_s(lens.rows)
        steps_s = np.diff(motion.times_s)
        lever_m = np.linalg.norm(T_vehicle_camera[:3, 3])
        turns_rad, travels_m = motion.rotation_steps_rad, motion.travel_steps_m
        self._turn_rad = self._travel_m = 0.0
        if len(steps_s):
            # The fastest moment counts for the whole image: that only costs samples.
            self._turn_rad = float(np.max(turns_rad / steps_s)) * self.exposure_s
            self._travel_m = float(np.max((travels_m + lever_m * turns_rad) / steps_s))
            self._travel_m *= self.exposure_s

    def pose_at(
        self, times_s: Float[np.ndarray, "*batch"]
    ) -> tuple[Float[np.ndarray, "*batch 3 3"], Float[np.ndarray, "*batch 3"]]:
        """T_world_camera at times (...) after the stamp: R (..., 3, 3) and position (..., 3)."""
        R, p = self._motion.at(times_s)
        T = self._T_vehicle_camera
        return R @ T[:3, :3], R @ T[:3, 3] + p

    def blur_px(self, distance_m: float) -> float:
        """An upper bound on the image motion, in one exposure, of a point at a distance."""
        return (self._turn_rad + self._travel_m / max(distance_m, 1e-3)) / self.lens.finest_rad

    def homographies(
        self,
        T_world_surface: Float[np.ndarray, "4 4"],
        rows: slice | Int[np.ndarray, " rows"],
        instants: Float[np.ndarray, " K"],
    ) -> tuple[Float[np.ndarray, "rows K 3 3"], Float[np.ndarray, "rows K"]]:
        """The homographies from camera rays to a surface, for each row at each instant.

        Args:
            T_world_surface: (4, 4).
            rows: the rows.
            instants: (K,) fractions of the exposure, -0.5 to 0.5.

        Returns:
            H (rows, K, 3, 3) and the camera's height q_z over the surface in m, (rows, K); float32.
        """
        times_s = self.row_times_s[rows, None] + self.exposure_s * instants
        R_world_camera, position = self.pose_at(times_s)
        axes = T_world_surface[:3, :3]
        R_surface_camera = axes.T @ R_world_camera
        q = (position - T_world_surface[:3, 3]) @ axes
        q[..., 2] = np.where(np.abs(q[..., 2]) < 1e-9, 1e-9, q[..., 2])
        normal = R_surface_camera[..., 2:, :]
        H = q[..., :, None] * normal - q[..., 2, None, None] * R_surface_camera
        H[..., 2, :] = normal[..., 0, :]
        return H.astype(np.float32), q[..., 2].astype(np.float32)
