"""The compiled program that follows one marker: from raw pixels to corners and what decides.

One call for everything, from the rays through the pixels to the comparison with other codes: each
array that crosses between NumPy and JAX, and each call, takes tens of microseconds.
"""

from functools import cache
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.models.camera import Camera
from jaxnav.detection.disturbance import noise_correlation
from jaxnav.detection.families import codes_of
from jaxnav.detection.image_model import cell_shares, is_informative
from jaxnav.detection.lens import pixels_of, rays_through
from jaxnav.detection.paper import SQUARE, corner_motion, homography, on_paper, rays_of
from jaxnav.detection.pattern_fit import PatternFit, PixelFit, bounded_loss, fit_pattern
from jaxnav.detection.pattern_model import Patch, Unknowns, Window
from jaxnav.files.executables import kept

_NODES = 4  # images of a moving marker that are averaged to compare codes, at most
_NEAR = 96  # codes that are drawn
_MOST = 10.0  # standard deviations, of a pixel that helps to choose them
_ZONE = 1.1  # cells around the marker that count: its white zone is one wide


class Summary(NamedTuple):
    """What a fit says of its marker."""

    corners_px: Float[Array, "4 2"]
    covariance_px2: Float[Array, "8 8"]  # of the corners, u and v of each in turn
    streak_px: Float[Array, " 2"]
    noise: Float[Array, ""]  # standard deviation of the pixels that fit, grey levels
    contrast: Float[Array, ""]  # white minus black, of the pixels that fit, grey levels
    weight: Float[Array, ""]  # mean weight of the pixels that count, 0 to 1
    disagreement: Float[Array, ""]  # of the cells: 1 where residuals are noise
    explained: Float[Array, ""]  # part of the loss without a marker, 0 to 1
    advantage: Float[Array, ""]  # noise variances by which the nearest other code is worse
    alike: Float[Array, ""]  # factor of the variances by which neighbours' noise is alike


class Followed(NamedTuple):
    """A fit: what decides, each pixel's part, and where another fit of the marker may start."""

    summary: Summary
    pixels: PixelFit
    unknowns: Unknowns


@cache
def codes_on_device(family: str) -> Float[Array, "codes cells"]:
    """`codes_of` as an array of JAX, float32."""
    return jnp.asarray(codes_of(family), jnp.float32)


@kept
def follow_pattern(
    camera: Camera | None,
    patch: Patch,
    codes: Float[Array, "codes cells"],
    start: Unknowns | None = None,
) -> Followed:
    """Fit a patch in float32 in any process.

    Args:
        camera: makes edges straight in the world; without it, straight in the image.
        codes: of the family, see `codes_of`.
        start: the unknowns of an earlier fit of the same patch; None: the patch's quadrilateral.
    """
    rays, rays_px = rays_through(camera, patch.pixels)
    M0 = homography(rays_through(camera, patch.quad_px)[0].T)
    f32 = jnp.float32
    rays, rays_px = (M0 @ rays).astype(f32), (M0[None] @ rays_px).astype(f32)
    zone = 1 + 2 * _ZONE / (patch.K.shape[0] - 1)
    near = jnp.all(jnp.abs(on_paper(jnp.eye(3, dtype=f32), rays, rays_px)[0]) < zone, axis=0)
    patch = patch._replace(real=patch.real & near, used=patch.used & near)
    window = Window(rays, rays_px, patch)
    fit = fit_pattern(window, start)
    pixels = fit.pixels
    M = fit.y.M.astype(M0.dtype) @ M0
    corners_px = pixels_of(camera, rays_of(M, SQUARE))
    motion = corner_motion(M, *rays_through(camera, corners_px)).astype(f32)
    # Where the ground beyond the paper shows, residuals are alike, and count little in the fit.
    plain = (fit.weight > 0.5) & is_informative(pixels.residual, patch.levels)
    share = jnp.where(plain, fit.noise / pixels.deviation, 0)
    alike = noise_correlation(patch.pixels, pixels.residual / pixels.deviation, share)
    covariance = motion @ (alike * (fit.covariance + fit.covariance.T) / 2) @ motion.T
    summary = Summary(
        corners_px.astype(f32),
        covariance,
        fit.y.motion_px,
        fit.noise,
        jnp.sum(fit.weight * pixels.darkens) / jnp.maximum(jnp.sum(fit.weight), 1),
        jnp.sum(fit.weight) / jnp.maximum(jnp.sum(patch.used), 1),
        fit.disagreement,
        fit.explained,
        _code_advantage(fit, window, codes),
        alike,
    )
    return Followed(summary, pixels, fit.y)


def _code_advantage(
    fit: PatternFit, window: Window, codes: Float[Array, "codes cells"]
) -> Float[Array, ""]:
    """By how many noise variances every other code, in any quarter turn, is worse than this one.

    Every code is drawn through the blur, the homography and the light of the fit, and compared with
    pixels that the fit left out as well: what hides a marker if this code is right may be another
    code. The loss of a pixel is bounded. Negative if another code is better.
    """
    patch, pixels = window.patch, fit.pixels
    n = patch.K.shape[0] - 1
    ink = _cell_images(fit.y, window, n)
    inside = np.pad(np.ones((n - 2, n - 2), bool), 1).ravel()
    frame, cells = jnp.sum(ink[~inside], axis=0), ink[inside]
    # By a pixel's own noise: what it would be without ink, and by how much ink darkens it.
    share = patch.real / pixels.deviation
    light, darkens, bend = (
        share * part for part in (patch.levels - fit.white, pixels.darkens, fit.bend)
    )

    def left(drawn: Array) -> Array:
        """What so much ink leaves of each pixel's light; 0 where the pixel is not informative."""
        residual = light + darkens * drawn - bend * drawn * (1 - drawn)
        return jnp.where(is_informative(residual, patch.levels), residual, 0)

    # To draw all codes would take some milliseconds: those that correlate best suffice, with what
    # remains between no ink in the cells and ink in all of them.
    grey = (left(frame) + left(frame + jnp.sum(cells, axis=0))) / 2
    alike = codes @ (cells @ (darkens * jnp.clip(grey, -_MOST, _MOST)))
    near = jnp.argsort(alike)[:_NEAR]  # `top_k` calls a library, and such programs can't be kept
    drawn = frame[None] + jnp.concatenate([codes[near], codes[patch.own][None]]) @ cells
    losses = jnp.sum(bounded_loss(jax.vmap(left)(drawn))[0], axis=1)
    return jnp.min(jnp.where(near == patch.own, jnp.inf, losses[:-1])) - losses[-1]


def _cell_images(y: Unknowns, window: Window, n: int) -> Float[Array, "cells N"]:
    """The share of each pixel's light that comes from each cell of a moving marker, (n * n, N)."""
    rays, rays_px, nodes = window.rays, window.rays_px, jnp.minimum(window.patch.instants, _NODES)
    between = y.motion_px / nodes
    S = jnp.stack([between[0] ** 2, between[0] * between[1], between[1] ** 2]) / 12
    S = S + y.lens_px2 * jnp.asarray([1, 0, 1], S.dtype)

    def add(i: Array, images: Array) -> Array:
        time = (i + 0.5) / nodes - 0.5
        shifted = rays - time * (y.motion_px[0] * rays_px[0] + y.motion_px[1] * rays_px[1])
        return images + cell_shares(y.M, shifted, rays_px, S, n) / nodes

    return jax.lax.fori_loop(0, nodes, add, jnp.zeros((n * n, rays.shape[1]), rays.dtype))
