"""Conversion of pixels to rays and back through the camera's lens, for the corner fit.

Shapes are fixed and cameras are arguments, so each kind of lens compiles once.
"""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Num

from jaxnav.core.models.camera import Camera
from jaxnav.detection.edges import PIXELS
from jaxnav.files.executables import kept


def rays_through(
    camera: Camera | None, pixels: Float[Array, "N 2"]
) -> tuple[Float[Array, "3 N"], Float[Array, "2 3 N"]]:
    """Rays (3, N) through pixels (N, 2), and their derivatives (2, 3, N), per px, inside jit."""
    if camera is None:
        rays = jnp.concatenate([pixels.T, jnp.ones((1, len(pixels)), pixels.dtype)])
        by_px = jnp.eye(3, dtype=pixels.dtype)[:2, :, None]
        return rays, jnp.broadcast_to(by_px, (2, 3, len(pixels)))
    pixels = pixels.astype(camera.focal_px.dtype)
    return camera.unproject(pixels).T, jax.vmap(jax.jacfwd(camera.unproject))(pixels).T


def pixels_of(camera: Camera | None, rays: Float[Array, "N 3"]) -> Float[Array, "N 2"]:
    """Project rays (N, 3) to pixels (N, 2), inside jit."""
    return rays[:, :2] / rays[:, 2:] if camera is None else camera.project(rays)


_RAYS = 128  # that are projected at once

_rays_through, _pixels_of = kept(rays_through), kept(pixels_of)


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
        rays, rays_px = _rays_through(self.camera, padded)
        return np.asarray(rays, float)[:, :n], np.asarray(rays_px, float)[:, :, :n]

    def pixels(self, rays: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 2"]:
        """Project rays (N, 3) to pixels (N, 2)."""
        if self.camera is None:
            return rays[:, :2] / rays[:, 2:]
        padded = np.tile(np.array([0.0, 0.0, 1.0], rays.dtype), (-(-len(rays) // _RAYS), _RAYS, 1))
        padded.reshape(-1, 3)[: len(rays)] = rays
        pixels = [np.asarray(_pixels_of(self.camera, part), float) for part in padded]
        return np.concatenate(pixels)[: len(rays)]
