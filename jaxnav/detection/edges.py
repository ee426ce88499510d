"""Fit of the four edges of a decoded marker to the grey levels around them.

The pattern of a decoded marker is known: a black frame with known cells inside, on white paper.
The fit finds the four edges (eight numbers, the homography between rays and paper) for which the
blurred pattern explains the pixels best. Fitting them to pixels rather than to points found along
normals needs no resampling, keeps the noise of the samples independent, so that the covariance of
the fit is right, and distinguishes an edge from the cells one or two pixels behind it.

    I(u) = white - contrast * dark + c1 x + c2 y + c3 far + c4 dark (1 - dark)
    (x, y, 1) ~ M ray(u)
    dark = sum_kl K_kl Phi2((x - x_l) / s_x, (y - y_k) / s_y; rho)

(x, y) are paper coordinates, K the corners of the cells at (x_l, y_k) (second differences of the
pattern), Phi2 the integral of the blur on the paper. The blur's covariance is G (S + I/12) G' with
G = d(x, y)/du, S that of lens and motion (px^2, fitted), 1/12 that of a square pixel, whose flat
top is kept (see `ink`). far is 1 beyond the white zone, one cell wide, around every marker. With
c4 the levels are no linear measure of the light, as in pictures for screens (sRGB): what is half
dark is then too light. The light (white, contrast, c) enters linearly and is eliminated.

Source: Golub and Pereyra (1973), variable projection; Kaufman (1975) for its Jacobian.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.linalg.small_matrices import eliminate
from jaxnav.detection.image_model import (
    PIXEL_VARIANCE_PX2,
    beyond_paper,
    box_split,
    cell_disagreement,
    ink,
    is_informative,
    ridged,
)
from jaxnav.detection.paper import SQUARE, blur_on_paper, generators, on_paper
from jaxnav.files.executables import kept

PIXELS = 1024  # of one fit; unused ones are masked
_STEPS = 20
_START_BLUR_PX2 = 0.8**2
_BLUR_LIMITS_PX2 = (0.0, 5.0**2)
_HUBER = 2.5  # standard deviations
_UNINFORMATIVE = 1e-3  # weight of such a pixel: with none the light may be unknown
# Prior of the far ground for views without it, and of the curve of the levels: within about a
# hundred grey levels.
_PRIOR = 1e-3
_MOST_CURVE = 1.0  # of the contrast; sRGB has up to 0.95
_CONVERGED = 1e-4  # of half the marker's side
_PLATEAU = 1e-4  # of the loss
_MAX_STEP = 0.1
_NOTICED = 1.6  # a smaller factor may come from so many cells by chance


class EdgeFit(NamedTuple):
    """The result of the fit, in paper coordinates."""

    M: Float[Array, "3 3"]  # rays to paper
    blur_px2: Float[Array, " 3"]  # xx, xy, yy of S
    covariance: Float[Array, "8 8"]  # of D in (I + D) M, by rows without the last entry
    noise: Float[Array, ""]  # standard deviation of the residual, grey levels
    contrast: Float[Array, ""]  # white minus black, grey levels
    residual: Float[Array, " N"]  # grey levels
    converged: Bool[Array, ""]
    step: Float[Array, ""]  # by which the last step moved a corner, or would have


class _Patch(NamedTuple):
    rays: Float[Array, "3 N"]
    rays_px: Float[Array, "2 3 N"]  # derivative by pixel
    levels: Float[Array, " N"]
    K: Float[Array, "k k"]  # row along y, column along x
    most_curve: Float[Array, ""]


class _State(NamedTuple):
    M: Array
    blur: Array
    residual: Array
    J: Array
    hessian: Array
    gradient: Array
    scale: Array
    contrast: Array
    damping: Array
    steps: Array
    converged: Array
    step: Array


@kept
def fit_edges(
    rays: Float[Array, "3 N"],
    rays_px: Float[Array, "2 3 N"],
    levels: Float[Array, " N"],
    K: Float[Array, "k k"],
    used: Bool[Array, " N"],
    curved: Bool[Array, ""],
) -> EdgeFit:
    """Fit by Levenberg-Marquardt with Huber's loss, from M = I, in float32 in any process.

    Args:
        rays: rays through the pixels, in a basis in which the first guess of M is the identity.
        rays_px: their derivatives by pixel.
        levels: grey levels of the pixels.
        K: `step_corners` of the marker.
        used: which pixels count; the others are padding.
        curved: whether levels may be coded; else c4 is 0.
    """
    patch = _Patch(rays, rays_px, levels, K, jnp.where(curved, _MOST_CURVE, 0))
    one = jnp.ones((), levels.dtype)
    blur = jnp.array([1.0, 0.0, 1.0], levels.dtype) * _START_BLUR_PX2
    M = jnp.eye(3, dtype=levels.dtype)

    def state(
        M: Array, blur: Array, weight: Array, damping: Array, steps: Array, size: Array
    ) -> _State:
        residual, J, contrast = _linearise(M, blur, patch, weight)
        weighted, scale = J * weight[None], _rms(residual, weight)
        return _State(
            M, blur, residual, J, weighted @ J.T, weighted @ residual, scale, contrast,
            damping, steps, jnp.array(False), size,
        )  # fmt: skip

    def attempt(s: _State) -> _State:
        diagonal = jnp.diagonal(s.hessian)
        ridge = jnp.diag(s.damping * diagonal + 1e-6 * jnp.max(diagonal[:8]))
        step = eliminate(s.hessian + ridge, s.gradient[:, None])[:, 0]
        size = jnp.max(jnp.abs(_CORNER_MOTION @ step[:8]))
        step = step * jnp.minimum(1, _MAX_STEP / jnp.maximum(size, 1e-9))
        weight = used * _weight(s.residual, s.scale, levels)
        less = jnp.maximum(s.damping * 0.1, 1e-6)
        moved = state(*_moved(s.M, s.blur, step), weight, less, s.steps + 1, size)
        before, after = (
            _loss(r / s.scale, used & is_informative(r, levels))
            for r in (s.residual, moved.residual)
        )
        small = (size < _CONVERGED) | (jnp.abs(before - after) < _PLATEAU * before)
        stayed = s._replace(damping=s.damping * 10, steps=s.steps + 1, step=size)
        ended = jax.tree.map(lambda a, b: jnp.where(after <= before, a, b), moved, stayed)
        return ended._replace(converged=small)

    start = state(M, blur, used * one, 1e-3 * one, jnp.array(0), one)
    s = jax.lax.while_loop(lambda s: (s.steps < _STEPS) & ~s.converged, attempt, start)
    weight = used * _weight(s.residual, s.scale, levels)
    freedom = jnp.maximum(jnp.sum(weight) - 16, 1)
    noise = jnp.sqrt(jnp.sum(weight * s.residual**2) / freedom)
    units = jnp.eye(s.hessian.shape[0], dtype=one.dtype)
    xy, _ = on_paper(s.M, patch.rays, patch.rays_px)
    scores = s.J * (weight * s.residual / noise)[None]
    ratio = cell_disagreement(xy, scores, s.hessian, patch.K.shape[0] - 1)
    factor = jnp.where(ratio > _NOTICED, ratio, 1)
    covariance = eliminate(ridged(s.hessian), units)[:8, :8] * noise**2 * factor
    residual = jnp.where(is_informative(s.residual, levels), s.residual, 0)
    return EdgeFit(s.M, s.blur, covariance, noise, s.contrast, residual, s.converged, s.step)


_CORNER_MOTION = np.moveaxis(generators(SQUARE.T), -1, 0).reshape(8, 8).astype(np.float32)


def _linearise(M: Array, blur: Array, patch: _Patch, weight: Array) -> tuple[Array, Array, Array]:
    """Residual (N,), slopes (11, N) of the model by D and S, light eliminated; contrast."""
    xy, xy_px = on_paper(M, patch.rays, patch.rays_px)
    pixel = PIXEL_VARIANCE_PX2 * jnp.array([1, 0, 1], blur.dtype)
    variance = blur_on_paper(xy_px, blur + pixel)
    dark, slope = ink(xy, variance, box_split(xy_px), patch.K)
    far = beyond_paper(xy, variance, patch.K.shape[0] - 1)
    # Derivatives by D through x and y at fixed blur; by S through the blur on the paper.
    motion = generators(xy)
    by_D = slope[:1] * motion[0] + slope[1:2] * motion[1]
    units = jnp.eye(3, dtype=blur.dtype)
    by_S = [jnp.sum(slope[2:] * blur_on_paper(xy_px, unit), axis=0) for unit in units]
    jacobian = jnp.concatenate([by_D, jnp.stack(by_S)])

    ones, bend = jnp.ones_like(dark), dark * (1 - dark)
    light = jnp.stack([-dark, ones, xy[0], xy[1], far, bend])
    coefficients, _ = _lit(light, weight, patch.levels[:, None])
    # With a curve beyond its limits, edges of a sharp picture could lie anywhere in a pixel.
    curve = coefficients[5, 0] / jnp.maximum(coefficients[0, 0], 1e-3)
    limited = jnp.clip(curve, 0, patch.most_curve)
    fixed = curve != limited
    fixed_curve, free = jnp.where(fixed, limited, 0), jnp.where(fixed, 0, 1)
    light = jnp.stack([fixed_curve * bend - dark, ones, xy[0], xy[1], far, free * bend])
    coefficients, solve = _lit(light, weight, patch.levels[:, None])
    contrast = coefficients[0, 0]
    residual = patch.levels - coefficients[:, 0] @ light
    curved = fixed_curve * contrast + free * coefficients[5, 0]
    jacobian = (curved * (1 - 2 * dark) - contrast)[None] * jacobian
    along_light = solve((light * weight[None]) @ jacobian.T)
    return residual, jacobian - along_light.T @ light, contrast


def _lit(light: Array, weight: Array, levels: Array) -> tuple[Array, Callable[[Array], Array]]:
    """Coefficients (L, 1) of the light that fit levels (N, 1) best, and the solver for others."""
    weighted = light * weight[None]
    gram = weighted @ light.T + jnp.diag(jnp.asarray([0, 0, 0, 0, _PRIOR, _PRIOR], light.dtype))

    def solve(right: Array) -> Array:
        return eliminate(gram, right)

    return solve(weighted @ levels), solve


def _moved(M: Array, blur: Array, step: Array) -> tuple[Array, Array]:
    D = jnp.append(step[:8], 0).reshape(3, 3)
    xx, xy, yy = blur + step[8:]
    # The nearest possible blur: the eigenvalues of the 2x2 covariance are clipped.
    mean, half = (xx + yy) / 2, (xx - yy) / 2
    radius = jnp.sqrt(half**2 + xy**2 + 1e-12)
    low, high = jnp.clip(jnp.stack([mean - radius, mean + radius]), *_BLUR_LIMITS_PX2)
    shrink = (high - low) / 2 / radius
    mean = (high + low) / 2
    return M + D @ M, jnp.stack([mean + half * shrink, xy * shrink, mean - half * shrink])


def _rms(residual: Array, weight: Array) -> Array:
    return jnp.sqrt(jnp.sum(weight * residual**2) / jnp.maximum(jnp.sum(weight), 1)) + 0.3


def _weight(residual: Array, scale: Array, levels: Array) -> Array:
    """Huber's, and next to none of a pixel that says nothing of the model."""
    huber = _HUBER / jnp.maximum(jnp.abs(residual / scale), _HUBER)
    return jnp.where(is_informative(residual, levels), huber, _UNINFORMATIVE)


def _loss(r: Array, used: Array) -> Array:
    size = jnp.abs(r)
    each = jnp.where(size < _HUBER, 0.5 * r**2, _HUBER * (size - 0.5 * _HUBER))
    return jnp.sum(jnp.where(used, each, 0))
