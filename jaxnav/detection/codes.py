"""Which code of a family a fitted marker shows: the predicted one, and by how much."""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnav.detection.families import codes_of
from jaxnav.detection.image_model import cell_shares, tells
from jaxnav.detection.pattern_fit import PatternFit, bounded_loss
from jaxnav.detection.pattern_model import Window

_NODES = 4  # images of a moving marker that are averaged, at most
_NEAR = 96  # codes that are drawn
_MOST = 10.0  # standard deviations, of a pixel that helps to choose them


@cache
def codes_on_device(family: str) -> Float[Array, "codes cells"]:
    """`codes_of` as an array of JAX, float32."""
    return jnp.asarray(codes_of(family), jnp.float32)


def code_advantage(
    fit: PatternFit,
    window: Window,
    codes: Float[Array, "codes cells"],
    own: Int[Array, ""],
    instants: Int[Array, ""],
) -> Float[Array, ""]:
    """By how many noise variances every other code, in any quarter turn, is worse than this one.

    Every code is drawn through the blur, the homography and the light of the fit, and compared with
    pixels that the fit left out as well: what hides a marker in the eyes of one code may be another
    code. The loss of a pixel is bounded. Negative if another code is better.

    Args:
        codes: of the family, see `codes_of`.
        own: which of them the fitted pattern is.
        instants: as in `fit_pattern`.
    """
    n = window.K.shape[0] - 1
    ink = _cell_images(fit, window, n, jnp.minimum(instants, _NODES))
    inside = np.pad(np.ones((n - 2, n - 2), bool), 1).ravel()
    frame, cells = jnp.sum(ink[~inside], axis=0), ink[inside]
    # By a pixel's own noise: what it would be without ink, and by how much ink darkens it.
    share = window.real / fit.deviation
    light, darkens, bend = (
        share * part for part in (window.levels - fit.white, fit.darkens, fit.bend)
    )

    def left(drawn: Array) -> Array:
        """What so much ink leaves of each pixel's light; nothing where the pixel does not tell."""
        residual = light + darkens * drawn - bend * drawn * (1 - drawn)
        return jnp.where(tells(residual, window.levels), residual, 0)

    # To draw all codes would take some milliseconds: those that correlate best suffice, with what
    # remains between no ink in the cells and ink in all of them.
    grey = (left(frame) + left(frame + jnp.sum(cells, axis=0))) / 2
    alike = codes @ (cells @ (darkens * jnp.clip(grey, -_MOST, _MOST)))
    near = jnp.argsort(alike)[:_NEAR]  # `top_k` calls a library, and such programs can't be kept
    drawn = frame[None] + jnp.concatenate([codes[near], codes[own][None]]) @ cells
    losses = jnp.sum(bounded_loss(jax.vmap(left)(drawn))[0], axis=1)
    return jnp.min(jnp.where(near == own, jnp.inf, losses[:-1])) - losses[-1]


def _cell_images(
    fit: PatternFit, window: Window, n: int, nodes: Int[Array, ""]
) -> Float[Array, "cells N"]:
    """The share of each pixel's light that comes from each cell of a moving marker, (n * n, N)."""
    y, rays, rays_px = fit.y, window.rays, window.rays_px
    between = y.motion_px / nodes
    S = jnp.stack([between[0] ** 2, between[0] * between[1], between[1] ** 2]) / 12
    S = S + y.lens_px2 * jnp.asarray([1, 0, 1], S.dtype)

    def add(i: Array, images: Array) -> Array:
        time = (i + 0.5) / nodes - 0.5
        shifted = rays - time * (y.motion_px[0] * rays_px[0] + y.motion_px[1] * rays_px[1])
        return images + cell_shares(y.M, shifted, rays_px, S, n) / nodes

    return jax.lax.fori_loop(0, nodes, add, jnp.zeros((n * n, rays.shape[1]), rays.dtype))
