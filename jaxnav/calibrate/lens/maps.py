"""Maps over the image: how unsure a lens draws a ray, and how differently two lenses draw it.

A camera's pose makes up for what a lens turns: a centre that is off by a pixel and a camera that
looks a little aside draw nearly the same images. So in both maps the camera is turned such that as
little as possible is left.

Source: Kogan (mrcal), "Projection uncertainty" and "Projection differences", which turn and shift.
"""

from dataclasses import dataclass
from functools import partial

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.fit import LensFit
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import rotation_matrix

_WIDE = 24  # pixels of a map along the image's width
_STEPS = 8  # of Gauss, Newton


@dataclass(frozen=True)
class ImageMap:
    """Values over an image in a grid of h x w pixels."""

    pixels: Float[np.ndarray, "h w 2"]  # where the values are
    # by which the second lens draws a ray elsewhere; NaN where one of the lenses does not draw it.
    # Of a sigma, along x and y.
    shift_px: Float[np.ndarray, "h w 2"]

    @property
    def length_px(self) -> Float[np.ndarray, "h w"]:
        """Lengths of the shifts."""
        return np.linalg.norm(self.shift_px, axis=2)


def grid_px(image_size_px: tuple[int, int]) -> Float[np.ndarray, "h w 2"]:
    """Pixels (h, w, 2) all over the image, its corners among them."""
    width, height = image_size_px
    high = max(2, round(_WIDE * height / width))
    x, y = np.linspace(0, width - 1, _WIDE), np.linspace(0, height - 1, high)
    return np.stack(np.meshgrid(x, y), axis=-1)


def projection_sigma(fit: LensFit) -> ImageMap:
    """One standard deviation of where a ray is drawn, along x and y, px."""
    pixels = grid_px(fit.views.image_size_px)
    slopes = ray_slopes(fit.lens, fit.parameters, pixels.reshape(-1, 2))
    by_lens, by_turn, drawn = jax.device_get(slopes)
    # What a turn of the camera explains is no error of the lens.
    J, turns = by_lens.reshape(-1, by_lens.shape[-1]), by_turn.reshape(-1, 3)
    seen = np.repeat(drawn, 2)
    explained, *_ = np.linalg.lstsq(turns[seen], J[seen], rcond=None)
    J = (J - turns @ explained).reshape(by_lens.shape)
    variance = np.einsum("nci,ij,ncj->nc", J, fit.covariance, J)
    sigma_px = np.sqrt(np.where(drawn[:, None], np.maximum(variance, 0), np.nan))
    return ImageMap(pixels, sigma_px.reshape(pixels.shape))


@partial(jax.jit, static_argnames="lens")
def ray_slopes(
    lens: str, parameters: Float[Array, " 9"], pixels: Float[Array, "N 2"]
) -> tuple[Float[Array, "N 2 9"], Float[Array, "N 2 3"], Bool[Array, " N"]]:
    """Slopes of the pixels of fixed rays by the nine parameters, and by a turn of the camera; and
    whether the lens draws the ray of a pixel there."""
    rays = lens_bundle.camera_of(lens, parameters).unproject(pixels)

    def draw(parameters: Array, turn: Array) -> Array:
        return lens_bundle.camera_of(lens, parameters).project(_turned(rays, turn))

    zero = jnp.zeros(3)
    off = jnp.max(jnp.abs(draw(parameters, zero) - pixels), axis=1)
    by_lens, by_turn = jax.jacfwd(draw, argnums=(0, 1))(parameters, zero)
    return by_lens, by_turn, off < 1


def projection_difference(one: Camera, other: Camera, image_size_px: tuple[int, int]) -> ImageMap:
    """By how much the second camera draws the rays of the first one's pixels elsewhere, px."""
    pixels = grid_px(image_size_px)
    shift_px = jax.device_get(_difference(one, other, jnp.asarray(pixels.reshape(-1, 2))))
    return ImageMap(pixels, np.asarray(shift_px, float).reshape(pixels.shape))


@jax.jit
def _difference(one: Camera, other: Camera, pixels: Array) -> Array:
    rays = one.unproject(pixels)
    drawn = jnp.max(jnp.abs(one.project(rays) - pixels), axis=1) < 1

    def shift(turn: Array) -> Array:
        return other.project(_turned(rays, turn)) - pixels

    def step(_: int, turn: Array) -> Array:
        residual, J = shift(turn), jax.jacfwd(shift)(turn)
        # Rays that are drawn very differently count less: they are of the border.
        weight = drawn / (1 + jnp.sum(residual**2, axis=1))
        H = jnp.einsum("nci,n,ncj->ij", J, weight, J)
        g = jnp.einsum("nci,n,nc->i", J, weight, residual)
        return turn - jnp.linalg.solve(H, g)

    turn = jax.lax.fori_loop(0, _STEPS, step, jnp.zeros(3, pixels.dtype))
    seen = drawn & other.in_front(_turned(rays, turn))
    return jnp.where(seen[:, None], shift(turn), jnp.nan)


def _turned(rays: Array, turn: Array) -> Array:
    """Rays (N, 3) turned by a rotation vector."""
    R = rotation_matrix(jaxlie.SO3.exp(turn))
    return jnp.sum(R[None] * rays[:, None], axis=2)
