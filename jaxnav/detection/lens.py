"""Conversion of pixels to rays and back through the camera's lens, for the corner fit.

Shapes are fixed and cameras are arguments, so each kind of lens compiles once.
"""

from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Float, Num

from jaxnav.compiling.executables import kept
from jaxnav.detection.edges import PIXELS
from jaxnav.models.camera import Camera


@kept
def _rays_and_jacobians(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
    return camera.unproject(pixels), jax.vmap(jax.jacfwd(camera.unproject))(pixels)


@kept
def _project(camera: Camera, points_camera: jax.Array) -> jax.Array:
    return camera.project(points_camera)


@dataclass(frozen=True)
class Lens:
    """Converts pixels to rays and back. Straight lines become planes through the camera's centre.

    Without a camera, rays are (u, v, 1), so straight lines are straight in the image.
    """

    camera: Camera | None = None

    def rays(
        self, pixels: Num[np.ndarray, "N 2"]
    ) -> tuple[Float[np.ndarray, "3 N"], Float[np.ndarray, "2 3 N"]]:
        """Rays (3, N) through pixels (N, 2), and their derivatives (2, 3, N), per px.

        N is at most PIXELS.
        """
        n = len(pixels)
        if self.camera is None:
            rays = np.vstack([pixels.T, np.ones(n)])
            return rays, np.broadcast_to(np.eye(3)[:2, :, None], (2, 3, n))
        padded = np.zeros((PIXELS, 2), np.asarray(self.camera.focal_px).dtype)
        padded[:n] = pixels
        rays, jacobian = (
            np.asarray(a, float)[:n] for a in _rays_and_jacobians(self.camera, padded)
        )
        return rays.T, jacobian.T

    def pixels(self, rays: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
        """Project rays (N, 3) to pixels (N, 2). Compiles once for each N."""
        if self.camera is None:
            return rays[:, :2] / rays[:, 2:]
        return np.asarray(_project(self.camera, rays), float)
