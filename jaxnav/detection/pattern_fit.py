"""Fit of a whole marker of known pattern to the raw pixels around its predicted place.

Homography, motion, the lens's blur and the light are fitted together, see `pattern_model`. The loss
of a pixel is bounded, so that what hides a part of the marker does not move the rest. optimistix
runs the Levenberg-Marquardt steps, first with a loss as wide as the contrast and then with one as
wide as the noise.

Source: Geman, McClure (1987), the loss; Madsen, Nielsen, Tingleff (2004), the damping; MacKinnon,
White (1985), the covariance (HC3).
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax.numpy as jnp
import optimistix as optx
from jaxtyping import Array, Float

from jaxnav.core.linalg.levenberg_marquardt import Move, NielsenLM, NormalEquations
from jaxnav.core.linalg.small_matrices import eliminate
from jaxnav.detection.image_model import Exposure, cell_disagreement, is_informative, ridged
from jaxnav.detection.paper import on_paper
from jaxnav.detection.pattern_model import (
    BEND,
    LENS_PX2,
    LIGHTS,
    SHADES,
    UNKNOWNS,
    Unknowns,
    Window,
    basis_of,
    first_light,
    model,
    prior_of,
)

_WIDTH = 3.0  # of the loss, standard deviations
# Of Gaussian noise under this loss: mean slope of the score over the mean weight, E[psi'] / E[w],
# and E[psi^2] / E[w] over E[w r^2] / E[w].
_SLOPE, _SCORE = 0.734, 0.682
_NOTICED = 1.37  # a smaller factor may come from so many cells by chance
_FAR = 0.2  # of a pixel's light from the ground: what shows more of it says nothing of the noise
_LEAST_NOISE = 0.7  # grey levels: rounding and a quiet sensor
_STEPS = 8
_COARSE_STEPS = 6
_COARSER = 4  # at first one of so many pixels
_MOST_LENS_PX2 = 9.0
_MOST_STEP = 0.15  # of D: half sides


class PixelFit(NamedTuple):
    """What a fit says of each pixel."""

    xy: Float[Array, "2 N"]  # places on the paper
    residual: Float[Array, " N"]  # grey levels
    deviation: Float[Array, " N"]  # standard deviation, grey levels
    dark: Float[Array, " N"]  # share of its light that ink takes
    darkens: Float[Array, " N"]  # by how many levels ink darkens it
    lit: Float[Array, " N"]  # its level without the shadow
    ink: Float[Array, " N"]  # what of that comes from ink


class PatternFit(NamedTuple):
    """The result of a fit, in paper coordinates."""

    y: Unknowns
    pixels: PixelFit
    covariance: Float[Array, "8 8"]  # of D in (I + D) M, by rows without the last entry
    noise: Float[Array, ""]  # standard deviation of the pixels that fit, grey levels
    weight: Float[Array, " N"]  # of each pixel in the loss, 0 to 1; 0 for padding
    white: Float[Array, " N"]  # levels as they would be without ink
    bend: Float[Array, ""]  # of levels that are half dark, grey levels
    disagreement: Float[Array, ""]  # of the cells: 1 where residuals are noise
    explained: Float[Array, ""]  # part of the loss without a marker, 0 to 1


class _PatternLM(NielsenLM):
    """Steps of D, motion, lens and light, damped in proportion to what is known of each."""

    rtol: float = 1e-6
    atol: float = 0.1  # of the sum of squares: a tenth of a standard deviation and less each
    initial_damping: float = 1e-3
    norm: Callable[[Any], Float[Array, ""]] = optx.max_norm

    def solved(self, normal: NormalEquations, damping: Float[Array, ""]) -> Move:
        information, gradient = normal.information, normal.gradient
        damping = jnp.where(damping > 0, jnp.maximum(damping, 1e-7), self.initial_damping)
        diagonal = jnp.maximum(jnp.diagonal(information), 1e-6)
        move = -eliminate(information + jnp.diag(damping * diagonal), gradient[:, None])[:, 0]
        move = jnp.where(jnp.isfinite(move), move, 0)
        shrink = jnp.minimum(1, _MOST_STEP / jnp.maximum(jnp.max(jnp.abs(move[:8])), 1e-9))
        move = move * shrink
        promised = -jnp.sum(move * (2 * gradient + information @ move))
        return Move(move, promised, damping)

    def moved(self, y: Unknowns, move: Float[Array, " n"]) -> Unknowns:
        D = jnp.append(move[:8], 0).reshape(3, 3)
        return Unknowns(
            y.M + D @ y.M,
            y.motion_px + move[8:10],
            jnp.clip(y.lens_px2 + move[10], 0, _MOST_LENS_PX2),
            y.light + move[11:],
        )


def fit_pattern(window: Window, start: Unknowns | None = None) -> PatternFit:
    """Fit a window.

    Args:
        start: where the steps begin, near the end; None: at M = I and the expected motion, which
            may be a pixel off, so that a wide loss comes first.
    """
    y = _nearer(window) if start is None else start
    residual, _, image = model(y, window)
    noise = _noise(residual, image, window)
    y = _minimum(y, window, _deviation(noise, image, window), _STEPS, _SLOPE)
    return _result(y, window)


def _nearer(window: Window) -> Unknowns:
    """The least of a loss as wide as the contrast, over a part of the pixels and instants."""
    patch, dtype = window.patch, window.patch.levels.dtype
    few = window.first(patch.levels.shape[0] // _COARSER)
    few = few._replace(patch=few.patch._replace(instants=(patch.instants + 1) // 2))
    lens_px2, light = jnp.asarray(LENS_PX2, dtype), jnp.zeros(LIGHTS, dtype)
    y = Unknowns(jnp.eye(3, dtype=dtype), patch.motion_px, lens_px2, light)
    y = y._replace(light=first_light(y, few))
    return _minimum(y, few, patch.most_noise * jnp.ones_like(few.patch.levels), _COARSE_STEPS)


def _noise(residual: Array, image: Exposure, window: Window) -> Array:
    """Standard deviation of the pixels that fit, of those that show little of the ground."""
    patch = window.patch
    plain = patch.used & (image.far < _FAR) & is_informative(residual, patch.levels)
    return jnp.maximum(_spread(residual, plain, patch.most_noise), _LEAST_NOISE)


def _deviation(noise: Array, image: Exposure, window: Window) -> Float[Array, " N"]:
    """Standard deviation of each pixel: its noise, and the ground's where that shows."""
    return jnp.sqrt(noise**2 + (window.patch.ground * window.patch.contrast * image.far) ** 2)


def _minimum(
    y: Unknowns, window: Window, scale: Float[Array, " N"], steps: int, slope: float = 1.0
) -> Unknowns:
    """The unknowns at the least loss.

    Args:
        slope: mean slope of the score over the mean weight. With it steps are Newton's; with the
            weights alone each is a part of the way, 0.73 of it.
    """

    def cost(y: Any, args: Any) -> tuple[Any, Any]:
        del args
        residual, J, _ = model(y, window)
        loss, weight = _loss(residual / scale, window.patch.used)
        weighted = J * (weight / scale**2)[None]
        prior, prior_J = prior_of(y, window)
        return jnp.concatenate([jnp.sqrt(loss), prior]), NormalEquations(
            slope * (weighted @ J.T) + prior_J.T @ prior_J, -weighted @ residual + prior_J.T @ prior
        )

    solver = _PatternLM()
    solution: Any = optx.least_squares(cost, solver, y, has_aux=True, max_steps=steps, throw=False)
    minimum: Unknowns = solution.value
    return minimum


def bounded_loss(r: Any) -> tuple[Any, Any]:
    """The bounded loss of residuals in standard deviations, at most width^2, and its weights.

    Takes NumPy's and JAX's arrays.
    """
    near = 1 / (1 + (r / _WIDTH) ** 2)
    return r**2 * near, near**2


def _loss(r: Array, used: Array) -> tuple[Array, Array]:
    loss, weight = bounded_loss(r)
    return jnp.where(used, loss, 0), jnp.where(used, weight, 0)


def _spread(residual: Array, used: Array, most: Array) -> Array:
    """Standard deviation of the residuals that fit, from their median size.

    Args:
        most: an upper bound. Residuals beyond three times what is found are left out, twice, so
            that what hides a third of the marker does not count as noise.
    """
    size = jnp.sort(jnp.where(used, jnp.abs(residual), jnp.inf))
    spread = most
    for _ in range(3):
        near = jnp.sum(size < 3 * spread)
        middle = (size[(near - 1) // 2] + size[near // 2]) / 2
        spread = jnp.minimum(1.4826 * middle, most)
    return jnp.where(jnp.isfinite(spread), spread, most)


def _result(y: Unknowns, window: Window) -> PatternFit:
    residual, J, image = model(y, window)
    patch = window.patch
    noise = _noise(residual, image, window)
    scale = _deviation(noise, image, window)
    _, weight = _loss(residual / scale, patch.used)
    _, prior_J = prior_of(y, window)
    prior = prior_J.T @ prior_J
    weighted = J * (weight / scale**2)[None]
    information = weighted @ J.T
    units = jnp.eye(UNKNOWNS, dtype=J.dtype)
    bread = eliminate(ridged(_SLOPE * information + prior), units)
    # The noise is what each pixel shows: a sensor's grows with the light. A pixel that decides
    # much draws the fit to itself: what it shows is too little by its leverage.
    leverage = _SLOPE * jnp.sum(weighted * (bread @ J), axis=0)
    scores = weighted * (residual / jnp.maximum(1 - leverage, 0.3))[None]
    covariance = bread @ (scores @ scores.T + prior) @ bread
    xy, _ = on_paper(y.M, window.rays, window.rays_px)
    counts = jnp.where(is_informative(residual, patch.levels), weight, 0)
    variance = jnp.sum(counts * (residual / scale) ** 2) / jnp.maximum(jnp.sum(counts), 1)
    score = weighted * residual[None] / jnp.sqrt(_SCORE * variance)
    ratio = cell_disagreement(xy, score, information, patch.K.shape[0] - 1)
    covariance = covariance * jnp.where(ratio > _NOTICED, ratio, 1)
    basis, light = basis_of(y, window, image), y.light * patch.contrast
    bright = basis_of(y, window, image._replace(dark=jnp.zeros_like(image.dark)))
    inky = basis_of(y, window, image._replace(dark=jnp.ones_like(image.dark)))
    white = light @ bright
    darkens = white - light @ inky
    in_light = light.at[SHADES].set(0)
    ink = image.dark * (in_light @ inky)
    plain = _plain(basis[:3], window, scale)
    without, with_marker = (jnp.sum(_loss(r / scale, patch.used)[0]) for r in (plain, residual))
    pixels = PixelFit(xy, residual, scale, image.dark, darkens, in_light @ basis, ink)
    return PatternFit(
        y, pixels, covariance[:8, :8], noise, weight, white, light[BEND], ratio,
        1 - with_marker / without,
    )  # fmt: skip


def _plain(basis: Float[Array, "3 N"], window: Window, scale: Array) -> Float[Array, " N"]:
    """Residual (N,) of a ground without a marker: a level and its gradient."""
    real, levels = window.patch.real, window.patch.levels
    weight = real / scale**2
    level = jnp.zeros(3, basis.dtype)
    for _ in range(3):
        weighted = basis * weight[None]
        gram = weighted @ basis.T
        gram = gram + 1e-6 * jnp.trace(gram) * jnp.eye(3)
        level = eliminate(gram, (weighted @ levels)[:, None])[:, 0]
        residual = levels - level @ basis
        weight = _loss(residual / scale, real)[1] / scale**2
    return residual
