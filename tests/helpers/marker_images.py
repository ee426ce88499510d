"""Markers drawn by brute force: rays through sub-pixels, averaged. Independent of the package's
renderer and detector; only the lens is the package's, through `Camera.unproject`."""

from dataclasses import dataclass

import cv2
import jax.numpy as jnp
import numpy as np

from jaxnav.core.models.camera import Camera

SUBPIXELS = 8


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
        return np.asarray(
            self.camera.project(
                jnp.asarray(corners @ self.R_camera_marker.T + self.t_camera_marker)
            )
        )

    def render(self, rng: np.random.Generator) -> np.ndarray:
        """The image, (H, W) uint8."""
        width, height = self.size_px
        k = SUBPIXELS
        u = ((np.arange(width * k) + 0.5) / k - 0.5).astype(np.float32)
        v = ((np.arange(height * k) + 0.5) / k - 0.5).astype(np.float32)
        rays = self._rays(u, v).astype(np.float32)
        # Ray and plane: the marker's own coordinates of the hit.
        R, t = self.R_camera_marker.astype(np.float32), self.t_camera_marker.astype(np.float32)
        along = rays @ R[:, 2]
        depth = (R[:, 2] @ t) / np.where(along == 0, 1e-9, along)  # a ray along the paper
        hit = (rays * depth[..., None] - t) @ R
        n = len(self.cells)
        column = np.floor((hit[..., 0] / self.size_m + 0.5) * n).astype(int)
        row = np.floor((0.5 - hit[..., 1] / self.size_m) * n).astype(int)
        inside = (column >= 0) & (column < n) & (row >= 0) & (row < n)
        paper = (column >= -1) & (column <= n) & (row >= -1) & (row <= n) & (depth > 0)
        cell = self.cells[np.clip(row, 0, n - 1), np.clip(column, 0, n - 1)]
        ink = np.where(inside, self.black + (self.white - self.black) * cell, self.white)
        ground = self.background + self.texture * cv2.resize(
            rng.standard_normal((height // 3 + 1, width // 3 + 1)),
            (width * k, height * k),
            interpolation=cv2.INTER_NEAREST,
        )
        image = np.where(paper, ink, ground).astype(np.float32)
        image = self._blur(image, k)
        image = cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA)
        image = image + self.noise * rng.standard_normal(image.shape)
        return np.clip(np.round(image), 0, 255).astype(np.uint8)

    def _rays(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        if self.camera.lenses == ("none",):
            focal, center = np.asarray(self.camera.focal_px), np.asarray(self.camera.center_px)
            xy = (np.stack(np.meshgrid(u, v), axis=-1) - center) / focal
            return np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1)
        # Exact at whole pixels; between them a lens is linear to a thousandth of a pixel.
        width, height = self.size_px
        grid = np.stack(np.meshgrid(np.arange(-1, width + 1), np.arange(-1, height + 1)), axis=-1)
        rays = np.asarray(self.camera.unproject(jnp.asarray(grid, float)))
        return np.einsum(
            "vi,ijc,uj->vuc", _linear(v, height), rays, _linear(u, width), optimize=True
        )

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
