"""Markers drawn by brute force: rays through sub-pixels, averaged. Independent of the package's
renderer and detector; only the lens is the package's, through `Camera.unproject`."""

from dataclasses import dataclass

import cv2
import equinox as eqx
import numpy as np

from jaxnav.core.models.camera import Camera

SUBPIXELS = 8
_project, _unproject = eqx.filter_jit(Camera.project), eqx.filter_jit(Camera.unproject)


@dataclass(frozen=True)
class Scene:
    """One marker in front of one camera. Levels are grey values, lengths metres."""

    camera: Camera
    size_px: tuple[int, int]  # (width, height)
    R_camera_marker: np.ndarray  # marker x right, y up, z towards the viewer
    t_camera_marker: np.ndarray
    size_m: float
    cells: np.ndarray  # (n, n) 1 white
    black: float = 30.0
    white: float = 200.0
    background: float = 110.0
    texture: float = 0.0  # standard deviation of the background, grey levels
    noise: float = 3.0
    optics_px: float = 0.0  # Gaussian blur of the lens
    motion_px: tuple[float, float] = (0.0, 0.0)  # the streak of a point during the exposure

    def corners_px(self) -> np.ndarray:
        """Where the corners are, (4, 2), TL TR BR BL."""
        h = self.size_m / 2
        corners = np.array([[-h, h, 0], [h, h, 0], [h, -h, 0], [-h, -h, 0]])
        in_camera = corners @ self.R_camera_marker.T + self.t_camera_marker
        return np.asarray(_project(self.camera, in_camera))

    def render(self, rng: np.random.Generator) -> np.ndarray:
        """The image, (H, W) uint8."""
        width, height = self.size_px
        k = SUBPIXELS
        u = ((np.arange(width * k) + 0.5) / k - 0.5).astype(np.float32)
        v = ((np.arange(height * k) + 0.5) / k - 0.5).astype(np.float32)
        # Ray and plane: the marker's own coordinates of the hit, in cells from the paper's corner.
        x, y, ahead = self._along_marker(u, v)
        tx, ty, depth = (self.R_camera_marker.T @ self.t_camera_marker).astype(np.float32)
        depth = depth / np.where(ahead == 0, np.float32(1e-9), ahead)  # a ray along the paper
        n = len(self.cells)
        cell_m = np.float32(self.size_m / n)
        column = np.where(depth > 0, (x * depth - tx) / cell_m + np.float32(n / 2 + 0.5), -9)
        row = np.float32(n / 2 + 0.5) - (y * depth - ty) / cell_m
        paper = np.pad(self.black + (self.white - self.black) * self.cells, 1,
                       constant_values=self.white).astype(np.float32)  # fmt: skip
        grain = rng.standard_normal((height // 3 + 1, width // 3 + 1)).astype(np.float32)
        ground = cv2.resize(
            self.background + self.texture * grain,
            (width * k, height * k),
            interpolation=cv2.INTER_NEAREST,
        )
        image = cv2.remap(
            paper, column, row, cv2.INTER_NEAREST, dst=ground, borderMode=cv2.BORDER_TRANSPARENT
        )
        image = self._blur(image, k)
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        image = image + self.noise * rng.standard_normal(image.shape)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def _along_marker(self, u: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, ...]:
        """The rays through columns u and rows v along the marker's three axes, (V, U) each."""
        R = self.R_camera_marker.astype(np.float32)
        if self.camera.lenses == ("none",):
            (fx, fy), (cx, cy) = np.asarray(self.camera.focal_px), np.asarray(self.camera.center_px)
            x, y = ((u - cx) / fx).astype(np.float32), ((v - cy) / fy).astype(np.float32)
            return tuple(x * R[0, i] + (y * R[1, i] + R[2, i])[:, None] for i in range(3))
        # Exact at whole pixels; between them a lens is linear to a thousandth of a pixel.
        width, height = self.size_px
        grid = np.stack(np.meshgrid(np.arange(-1, width + 1), np.arange(-1, height + 1)), axis=-1)
        rays = np.asarray(_unproject(self.camera, grid.astype(float)))
        across, down = _linear(u, width), _linear(v, height)
        return tuple(np.float32(down @ (rays @ R[:, i]) @ across.T) for i in range(3))

    def _blur(self, image: np.ndarray, k: int) -> np.ndarray:
        length = float(np.hypot(*self.motion_px))
        if length > 0:
            radius = int(np.ceil(length * k / 2)) + 1
            kernel = np.zeros((2 * radius + 1, 2 * radius + 1), np.float32)
            for t in np.linspace(-0.5, 0.5, 201):
                x, y = radius + t * k * self.motion_px[0], radius + t * k * self.motion_px[1]
                x0, y0 = int(np.floor(x)), int(np.floor(y))
                fx, fy = x - x0, y - y0
                kernel[y0 : y0 + 2, x0 : x0 + 2] += np.outer([1 - fy, fy], [1 - fx, fx])
            image = cv2.filter2D(image, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REFLECT)
        if self.optics_px > 0:
            image = cv2.GaussianBlur(image, (0, 0), self.optics_px * k)
        return image


def _linear(at: np.ndarray, size: int) -> np.ndarray:
    """Weights (len(at), size + 2) that interpolate between -1, 0, ... size."""
    return np.maximum(0, 1 - np.abs(at[:, None] - np.arange(-1, size + 1)))


def rotation(view_rad: float, azimuth_rad: float, roll_rad: float) -> np.ndarray:
    """R_camera_marker of a marker seen `view_rad` off its normal, tilted about `azimuth_rad`."""
    facing = np.diag([1.0, -1.0, -1.0])
    tilt = cv2.Rodrigues(view_rad * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad), 0.0]))[0]
    roll = cv2.Rodrigues(roll_rad * np.array([0.0, 0.0, 1.0]))[0]
    return tilt @ roll @ facing


def random_scene(
    rng: np.random.Generator,
    side_px: float,
    cells: np.ndarray,
    view_max_rad: float = np.deg2rad(60),
    **options: object,
) -> Scene:
    """A marker of the given frontal side at a random sub-pixel place, view, roll and exposure."""
    size = int(side_px * 1.25 * np.sqrt(2)) + 24
    focal_px = 400.0
    camera = Camera.create((focal_px, focal_px), ((size - 1) / 2, (size - 1) / 2))
    R = rotation(rng.uniform(0, view_max_rad), rng.uniform(0, 2 * np.pi), rng.uniform(0, 2 * np.pi))
    depth = focal_px / side_px
    t = np.append(rng.uniform(-0.5, 0.5, 2) * depth / focal_px * 4, depth)
    levels = {"black": rng.uniform(20, 60), "white": rng.uniform(150, 250)}
    return Scene(camera, (size, size), R, t, 1.0, cells, **(levels | options))
