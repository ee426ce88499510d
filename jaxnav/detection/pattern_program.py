"""The compiled program that follows one marker: from raw pixels to corners and what decides.

One call for everything, from the rays through the pixels to the comparison with other codes: each
array that crosses between NumPy and JAX, and each call, takes tens of microseconds.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.models.camera import Camera
from jaxnav.detection.codes import code_advantage
from jaxnav.detection.disturbance import noise_correlation
from jaxnav.detection.image_model import tells
from jaxnav.detection.lens import pixels_of, rays_through
from jaxnav.detection.paper import SQUARE, corner_motion, homography, on_paper, rays_of
from jaxnav.detection.pattern_fit import fit_pattern
from jaxnav.detection.pattern_model import Unknowns, Window
from jaxnav.files.executables import kept

_ZONE = 1.1  # cells around the marker that count: its white zone is one wide


class Patch(NamedTuple):
    """The pixels around one marker's predicted place, padded to N, and what is expected there."""

    pixels: Float[Array, "N 2"]
    levels: Float[Array, " N"]
    real: Bool[Array, " N"]  # which pixels are no padding
    used: Bool[Array, " N"]  # which of them count in the fit
    shadow: Float[Array, " N"]  # 1 in the light, 0 in the shadow
    quad_px: Float[Array, "4 2"]  # about where the corners are
    K: Float[Array, "k k"]  # `step_corners` of the marker
    own: Int[Array, ""]  # which of the family's codes it is
    motion_px: Float[Array, " 2"]  # the expected streak
    motion_sigma_px: Float[Array, ""]
    contrast: Float[Array, ""]  # about that of the marker, grey levels
    ground: Float[Array, ""]  # standard deviation of the ground beyond the paper, of the contrast
    most_noise: Float[Array, ""]  # standard deviation of pixels that fit, at most
    instants: Int[Array, ""]  # see `expose`


class Summary(NamedTuple):
    """What a fit tells of its marker."""

    corners_px: Float[Array, "4 2"]
    covariance_px2: Float[Array, "8 8"]  # of the corners, u and v of each in turn
    streak_px: Float[Array, " 2"]
    noise: Float[Array, ""]  # standard deviation of the pixels that fit, grey levels
    contrast: Float[Array, ""]  # white minus black, of the pixels that fit, grey levels
    weight: Float[Array, ""]  # mean weight of the pixels that count, 0 to 1
    disagreement: Float[Array, ""]  # of the cells: 1 where residuals are noise
    explained: Float[Array, ""]  # part of the loss without a marker, 0 to 1
    log_likelihood_ratio: Float[Array, ""]  # of the marker against a plain ground
    advantage: Float[Array, ""]  # noise variances by which the nearest other code is worse
    alike: Float[Array, ""]  # factor of the variances by which neighbours' noise is alike


class PixelFit(NamedTuple):
    """What a fit tells of each pixel."""

    xy: Float[Array, "2 N"]  # places on the paper
    residual: Float[Array, " N"]  # grey levels
    deviation: Float[Array, " N"]  # standard deviation, grey levels
    dark: Float[Array, " N"]  # share of its light that ink takes
    darkens: Float[Array, " N"]  # by how many levels ink darkens it
    lit: Float[Array, " N"]  # its level without the shadow
    ink: Float[Array, " N"]  # what of that comes from ink


class Followed(NamedTuple):
    """A fit: what decides, each pixel's part, and where another fit of the marker may start."""

    summary: Summary
    pixels: PixelFit
    unknowns: Unknowns


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
    window = Window(
        rays, rays_px, patch.levels, patch.real & near, patch.used & near, patch.K, patch.shadow,
        patch.motion_px, patch.motion_sigma_px, patch.contrast, patch.ground, patch.most_noise,
    )  # fmt: skip
    fit = fit_pattern(window, patch.instants, start)
    M = fit.y.M.astype(M0.dtype) @ M0
    corners_px = pixels_of(camera, rays_of(M, SQUARE))
    motion = corner_motion(M, *rays_through(camera, corners_px)).astype(f32)
    # Where the ground beyond the paper shows, residuals are alike, and count little in the fit.
    plain = (fit.weight > 0.5) & tells(fit.residual, patch.levels)
    share = jnp.where(plain, fit.noise / fit.deviation, 0)
    alike = noise_correlation(patch.pixels, fit.residual / fit.deviation, share)
    covariance = motion @ (alike * (fit.covariance + fit.covariance.T) / 2) @ motion.T
    summary = Summary(
        corners_px.astype(f32),
        covariance,
        fit.y.motion_px,
        fit.noise,
        jnp.sum(fit.weight * fit.darkens) / jnp.maximum(jnp.sum(fit.weight), 1),
        jnp.sum(fit.weight) / jnp.maximum(jnp.sum(window.used), 1),
        fit.disagreement,
        fit.explained,
        fit.log_likelihood_ratio,
        code_advantage(fit, window, codes, patch.own, patch.instants),
        alike,
    )
    pixels = PixelFit(
        fit.xy, fit.residual, fit.deviation, fit.dark, fit.darkens, fit.lit, fit.ink
    )  # fmt: skip
    return Followed(summary, pixels, fit.y)
