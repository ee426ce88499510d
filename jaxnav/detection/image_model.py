"""The image of a marker: a printed pattern through lens, pixel and motion.

    dark = mean_j sum_kl K_kl Phi2((x_j - x_l) / s_x, (y_j - y_k) / s_y; rho)
    (x_j, y_j, 1) ~ M (ray(u) - t_j d ray/du motion)

(x, y) are paper coordinates, K the corners of the cells at (x_l, y_k) (second differences of the
pattern), Phi2 the integral of the blur on the paper. The blur's covariance is G (S + I/12) G' with
G = d(x, y)/du, S that of the lens (px^2), 1/12 that of a square pixel, whose flat top is kept. A
marker that moves during the exposure shows the mean of its images at instants t_j, evenly over it,
each blurred by the motion between two of them. A pixel that is full, or empty, says only that
there is no less light, or no more.

Source: Tobin (1958), censored observations.
"""

import math
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnav.core.linalg.small_matrices import eliminate
from jaxnav.detection.paper import Numbers, blur_on_paper, generators, library, on_paper

PIXEL_VARIANCE_PX2 = 1 / 12  # of a square
_MEHLER_ORDERS = 3
_MAX_RHO = 0.95
# Grey levels of 8 bits beyond which a pixel may be empty or full: some noise comes after that.
_EMPTY, _FULL = 2.0, 250.0


class Exposure(NamedTuple):
    """The image of a marker's ink, and its derivatives."""

    dark: Float[Array, " N"]  # share of each pixel's light that ink takes
    far: Float[Array, " N"]  # share of it from beyond the paper
    by_D: Float[Array, "8 N"]  # of dark, when M becomes (I + D) M
    by_motion: Float[Array, "2 N"]  # 1/px
    by_lens: Float[Array, " N"]  # 1/px^2


def step_corners(cells: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n+1 n+1"]:
    """The matrix K (n + 1, n + 1) of a pattern of cells (n, n), 1 white, 0 black."""
    return np.diff(np.diff(np.pad(1 - cells, 1), axis=0), axis=1)


def box_split(xy_px: Float[Array, "2 2 N"]) -> Float[Array, "2 N"]:
    """Offsets (2, N) on the paper of two Gaussians with the fourth cumulant of a pixel's box."""
    # -1/120 px^4 along u and v: -2 split^4.
    return (jnp.sum(xy_px**4, axis=0) / 240) ** 0.25


def expose(
    M: Float[Array, "3 3"],
    motion_px: Float[Array, " 2"],
    lens_px2: Float[Array, ""],
    rays: Float[Array, "3 N"],
    rays_px: Float[Array, "2 3 N"],
    K: Float[Array, "k k"],
    instants: Int[Array, ""],
) -> Exposure:
    """The image of a marker that moves during the exposure.

    Args:
        M: takes rays to the paper in the middle of the exposure.
        motion_px: the streak (u, v) of a point of the marker during the exposure.
        lens_px2: variance of the lens's blur.
        rays: rays through the pixels.
        rays_px: their derivatives by pixel.
        K: `step_corners` of the marker.
        instants: number of images that are averaged: one for every 2.5 px of the streak suffice.
    """
    between = motion_px / instants  # the motion from one instant to the next
    S = jnp.stack([between[0] ** 2, between[0] * between[1], between[1] ** 2]) / 12
    S = S + jnp.asarray([1, 0, 1], M.dtype) * (lens_px2 + PIXEL_VARIANCE_PX2)
    units = jnp.asarray([1, 0, 1], M.dtype)
    zero = jnp.zeros_like(between[0])
    S_motion = (
        jnp.stack([2 * between[0], between[1], zero]) / (12 * instants),
        jnp.stack([zero, between[0], 2 * between[1]]) / (12 * instants),
    )

    def at(time: Array) -> Exposure:
        shifted = rays - time * (motion_px[0] * rays_px[0] + motion_px[1] * rays_px[1])
        xy, xy_px = on_paper(M, shifted, rays_px)
        variance = blur_on_paper(xy_px, S)
        dark, slope = ink(xy, variance, box_split(xy_px), K)
        motion = generators(xy)

        def by_blur(change: Array) -> Array:
            return jnp.sum(slope[2:] * blur_on_paper(xy_px, change), axis=0)

        by_motion = [
            by_blur(S_motion[i]) - time * jnp.sum(slope[:2] * xy_px[i], axis=0) for i in (0, 1)
        ]
        return Exposure(
            dark,
            beyond_paper(xy, variance, K.shape[0] - 1),
            slope[:1] * motion[0] + slope[1:2] * motion[1],
            jnp.stack(by_motion),
            by_blur(units),
        )

    def add(i: Array, sums: Exposure) -> Exposure:
        image = at((i + 0.5) / instants - 0.5)
        return jax.tree.map(lambda total, part: total + part / instants, sums, image)

    shapes = jax.eval_shape(at, jnp.zeros_like(lens_px2))
    nothing = jax.tree.map(lambda part: jnp.zeros(part.shape, part.dtype), shapes)
    return jax.lax.fori_loop(0, instants, add, nothing)


def ink(
    xy: Float[Array, "2 N"],
    variance: Float[Array, "3 N"],
    split: Float[Array, "2 N"],
    K: Float[Array, "k k"],
) -> tuple[Float[Array, " N"], Float[Array, "5 N"]]:
    """Blurred ink (N,), and its derivatives (5, N) by x, y and the blur's xx, yy, xy.

    Along each axis the blur is the mean of two Gaussians, offset by `split` (2, N) to either side.
    With U_0(x) = mean Phi and U_m its m-th derivative, up to sign, the corner of a cell blurs into
    Phi2(x, y) = sum_m xy^m / m! U_m(x) U_m(y)  (Mehler). Blurred images obey the heat equation:
    d/d xx is half of d^2/dx^2, d/d xy is d^2/dx dy.
    """
    knots = jnp.linspace(-1, 1, K.shape[0], dtype=xy.dtype)[:, None]
    sigma = jnp.sqrt(variance[:2] - split**2)
    limit = _MAX_RHO * sigma[0] * sigma[1]
    covariance = jnp.clip(variance[2], -limit, limit)
    columns, rows = (
        _hermite_terms(xy[i : i + 1] - knots, sigma[i : i + 1], split[i : i + 1]) for i in (0, 1)
    )
    # XLA computes a matrix product once, but the rest again for each of the two dozen sums below.
    rows = [K.T @ term for term in rows]
    columns = [jnp.eye(K.shape[0], dtype=K.dtype) @ term for term in columns]

    def derivative(i: int, j: int) -> Array:
        value, factor = jnp.zeros_like(covariance), jnp.ones_like(covariance)
        for m in range(_MEHLER_ORDERS + 1):
            # U_0' = U_1, U_m' = -U_(m+1).
            flips = (i if m else max(i - 1, 0)) + (j if m else max(j - 1, 0))
            product = jnp.sum(columns[m + i] * rows[m + j], axis=0)
            value = value + (-1) ** flips * factor * product
            factor = factor * covariance / (m + 1)
        return value

    by_blur = [derivative(2, 0) / 2, derivative(0, 2) / 2, derivative(1, 1)]
    return derivative(0, 0), jnp.stack([derivative(1, 0), derivative(0, 1), *by_blur])


def _hermite_terms(distance: Array, sigma: Array, split: Array) -> list[Array]:
    """U_0 = mean Phi(z), U_m = mean He_(m-1) phi(z) / sigma^m, z = (distance +- split) / sigma."""
    sides = []
    for z in ((distance + split) / sigma, (distance - split) / sigma):
        step, bump = gauss(z)
        terms, before, he = [step], jnp.ones_like(z), z
        scaled = bump / sigma
        terms.append(scaled)
        for m in range(1, _MEHLER_ORDERS + 2):
            scaled = scaled / sigma
            terms.append(he * scaled)
            before, he = he, z * he - m * before
        sides.append(terms)
    return [(a + b) / 2 for a, b in zip(*sides, strict=True)]


def beyond_paper(
    xy: Float[Array, "2 N"], variance: Float[Array, "3 N"], cells: int
) -> Float[Array, " N"]:
    """The share (N,) of each pixel's light from beyond the white zone, one cell wide."""
    zone = 1 + 2 / cells
    sigma = jnp.sqrt(variance[:2])
    inside = gauss((xy + zone) / sigma)[0] - gauss((xy - zone) / sigma)[0]
    return 1 - inside[0] * inside[1]


def cell_shares(
    M: Numbers, rays: Numbers, rays_px: Numbers, blur_px2: Numbers, cells: int
) -> Numbers:
    """The share of each pixel's light that comes from each cell, (cells * cells, N).

    Accepts NumPy and JAX arrays, see `on_paper`.

    Args:
        blur_px2: (3,), xx, xy, yy of the lens's and the motion's blur.
        cells: along a side.
    """
    numbers = library(rays)
    xy, xy_px = on_paper(M, rays, rays_px)
    pixel_px2 = np.array([PIXEL_VARIANCE_PX2, 0, PIXEL_VARIANCE_PX2], xy.dtype)
    variance = blur_on_paper(xy_px, blur_px2 + pixel_px2)[:2]
    knots = np.linspace(-1, 1, cells + 1, dtype=xy.dtype)[None, :, None]
    # A logistic curve is within 0.01 of the Gaussian integral: enough to read cells.
    z = numbers.clip((xy[:, None] - knots) / numbers.sqrt(variance)[:, None], -20, 20)
    columns, rows = -numbers.diff(1 / (1 + numbers.exp(-1.702 * z)), axis=1)
    return (rows[:, None] * columns[None]).reshape(cells * cells, -1)


def gauss(z: Array) -> tuple[Array, Array]:
    """Integral and density of the standard normal distribution.

    Source: Abramowitz and Stegun (1964), 7.1.26; error below 1.5e-7.
    """
    exponential = jnp.exp(-0.5 * z * z)
    t = 1 / (1 + 0.3275911 / math.sqrt(2) * jnp.abs(z))
    tail = jnp.zeros_like(z)
    for a in (1.061405429, -1.453152027, 1.421413741, -0.284496736, 0.254829592):
        tail = t * (tail + a)
    upper = 0.5 * tail * exponential
    return jnp.where(z < 0, upper, 1 - upper), exponential * (1 / math.sqrt(2 * math.pi))


def is_informative(residual: Any, levels: Any) -> Any:
    """Whether a pixel's residual says something of the model: that of a full one only if the model
    has less light, that of an empty one only if it has more. Takes NumPy's and JAX's arrays.
    """
    return ((levels < _FULL) | (residual > 0)) & ((levels > _EMPTY) | (residual < 0))


def cell_disagreement(
    xy: Float[Array, "2 N"],
    scores: Float[Array, "n N"],
    information: Float[Array, "n n"],
    cells: int,
) -> Float[Array, ""]:
    """The factor of the variances by which the cells of a pattern disagree.

    Where pixels, steps of a print or other ink are wrong alike for some pixels, as they are along
    an edge of a picture that is sharper than its pixels, each cell of the pattern pulls its own
    way. Of independent noise the factor is 1.

    Args:
        xy: places of the pixels on the paper.
        scores: gradients of the pixels' losses by the unknowns, in standard deviations.
        information: sum of the products of the slopes.
        cells: along a side.

    Source: Liang, Zeger (1986), as in `calibration/parts.py`.
    """
    column, row = jnp.clip(jnp.floor((xy + 1) * cells / 2) + 1, 0, cells + 1).astype(int)
    sums = jax.ops.segment_sum(scores.T, row * (cells + 2) + column, (cells + 2) ** 2)
    seen = jnp.sum(jnp.diagonal(information) > 0)  # without a shadow its light is not
    return jnp.sum(sums.T * eliminate(ridged(information), sums.T)) / seen


def ridged(information: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The normal equations with a ridge, so that they have a solution whatever is seen."""
    diagonal = jnp.diagonal(information)
    return information + jnp.diag(1e-6 * jnp.maximum(diagonal, 1e-6 * jnp.max(information)))
