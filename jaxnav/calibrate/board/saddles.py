"""Fit of the saddle points where two black squares touch to the grey levels around them.

With d1 and d2 the distances of a pixel from the two edges that cross in the point,

    grey = mean + amplitude * erf(d1 / (sqrt(2) sigma1)) * erf(d2 / (sqrt(2) sigma2)),

and d is measured from a parabola where the edges are bent. Each point has eight unknowns (its
place, two angles, two blurs, mean, amplitude). Each edge has its own blur because motion blurs one
and not the other. Levenberg-Marquardt fits all points of an image at once, in a quarter of the time
that `scipy.optimize.least_squares` takes point by point.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from scipy.special import erf

_STEPS = 20
_SMALLEST_SIGMA_PX, _LARGEST_SIGMA_PX = 0.25, 8.0
_START_SIGMA_PX = 0.8
_CONVERGED_PX = 3e-3
_MIN_PIXELS = 24
# Edges of a square pixel that is blurred by sigma go from 10 % to 90 % in this many of them.
EDGE_WIDTH_SIGMAS = 2.563
# Of the place, the angles, the blurs and the light.
_LONGEST_STEP = np.array([1.5, 1.5, 0.2, 0.2, 0.4, 0.4, 60.0, 60.0])
_MAX_TURN_RAD = 0.35
_MIN_AMPLITUDE = 4.0  # grey levels, half of the difference between black and white
_MAX_NOISE = 0.35  # of the amplitude


class Places(NamedTuple):
    """First guesses of N saddles: their places and the directions and bends of their edges."""

    points_px: Float[np.ndarray, "N 2"]  # the places
    # the image of one step, the length of a square, along the board's x and down its columns:
    # [step, u or v]
    along_px: Float[np.ndarray, "N 2 2"]
    # how far the line along either step is off its tangent one step away, to the left of the step
    # (in the image, y down: to its right as one looks at it)
    bend_px: Float[np.ndarray, "N 2"]
    clear: Float[np.ndarray, " N"]  # part of a step up to which there is nothing but the saddle
    # part of a step off both edges beyond which there may be other ink
    cross: Float[np.ndarray, " N"]

    def only(self, which: Int[np.ndarray, " K"] | Bool[np.ndarray, " N"]) -> "Places":
        """The places at some indices or in a mask."""
        return Places(*(column[which] for column in self))


class Saddles(NamedTuple):
    """N fitted saddles."""

    points_px: Float[np.ndarray, "N 2"]  # the places
    # grey levels; positive if the saddle's top left on the board is black
    amplitude: Float[np.ndarray, " N"]
    sigma_px: Float[np.ndarray, "N 2"]  # blur of the edges along x and along y
    good: Bool[np.ndarray, " N"]  # true if the fit converged on a saddle


def fit_saddles(
    image: UInt8[np.ndarray, "rows columns"], places: Places, radius_px: float, max_move_px: float
) -> Saddles:
    """Fit saddles near the given places in a picture of grey levels.

    Args:
        radius_px: radius around a point of the pixels to fit; fewer are taken near other ink.
        max_move_px: saddles that move further than this from their places are not good.
    """
    count, (height, width) = len(places.points_px), image.shape
    reach = int(np.ceil(radius_px)) + 1
    span = np.arange(-reach, reach + 1)
    window = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
    pixels = np.rint(places.points_px).astype(int)[:, None] + window
    inside = np.all((pixels >= 0) & (pixels < (width, height)), axis=2)
    columns, rows = np.moveaxis(np.clip(pixels, 0, (width - 1, height - 1)), 2, 0)
    offset = pixels - places.points_px[:, None]
    distance_px = np.linalg.norm(offset, axis=2)
    # A pixel integrates over half a pixel on each side, and blur over a little more.
    step_px = np.linalg.norm(places.along_px, axis=2)
    near = np.abs(np.einsum("npj,njk->npk", offset, np.linalg.inv(places.along_px)))
    near += 1.0 / step_px[:, None]
    mask = inside & (distance_px <= radius_px)
    mask &= np.all(near < places.clear[:, None, None], axis=2)
    mask &= np.any(near < places.cross[:, None, None], axis=2)
    patch = _Patch(pixels, image[rows, columns], mask, places.bend_px / step_px**2)

    angles = np.arctan2(places.along_px[..., 1], places.along_px[..., 0])
    blur = np.full((count, 2), _START_SIGMA_PX)
    state = np.concatenate([places.points_px, angles, blur, np.zeros((count, 2))], axis=1)
    light = _residual(state, patch)[1][..., 6:]
    equations = np.einsum("npi,npj->nij", light, light) + 1e-6 * np.eye(2)
    levels = np.einsum("npi,np->ni", light, np.where(mask, patch.grey, 0))
    state[:, 6:] = np.linalg.solve(equations, levels[:, :, None])[:, :, 0]
    residual, jacobian = _residual(state, patch)
    loss = np.sum(residual**2, axis=1)
    damping, converged = np.full(count, 1e-3), np.zeros(count, bool)
    for _ in range(_STEPS):
        hessian = np.einsum("npi,npj->nij", jacobian, jacobian)
        diagonal = np.einsum("nii->ni", hessian)
        ridge = damping[:, None] * diagonal + 1e-9 * diagonal.max(axis=1, keepdims=True) + 1e-9
        gradient = np.einsum("npi,np->ni", jacobian, residual)
        step = np.linalg.solve(hessian + np.eye(8) * ridge[:, :, None], gradient[:, :, None])
        step = np.clip(step[:, :, 0], -_LONGEST_STEP, _LONGEST_STEP)
        tried = state - step
        tried[:, 4:6] = np.clip(tried[:, 4:6], _SMALLEST_SIGMA_PX, _LARGEST_SIGMA_PX)
        tried_residual, tried_jacobian = _residual(tried, patch)
        tried_loss = np.sum(tried_residual**2, axis=1)
        better = tried_loss <= loss
        # Damping also makes steps short; the noise distinguishes a minimum from a dead end.
        converged |= np.abs(step[:, :2]).max(axis=1) < _CONVERGED_PX
        state[better], loss[better] = tried[better], tried_loss[better]
        residual[better], jacobian[better] = tried_residual[better], tried_jacobian[better]
        damping = np.where(better, np.maximum(damping / 10, 1e-4), damping * 10)
        if np.all(converged):
            break
    moved_px = np.linalg.norm(state[:, :2] - places.points_px, axis=1)
    turned = np.abs((state[:, 2:4] - angles + np.pi / 2) % np.pi - np.pi / 2)
    used, amplitude = mask.sum(axis=1), np.abs(state[:, 7])
    at_border = (places.points_px < 2) | (places.points_px > (width - 3, height - 3))
    good = (
        converged
        & (used >= _MIN_PIXELS)
        & ~at_border.any(axis=1)
        & (moved_px <= max_move_px)
        & (turned.max(axis=1) < _MAX_TURN_RAD)
        & (amplitude > _MIN_AMPLITUDE)
        & (np.sqrt(loss / np.maximum(used - 8, 1)) < _MAX_NOISE * amplitude)
        & (state[:, 4:6].max(axis=1) < 0.6 * np.where(mask, distance_px, 0).max(axis=1))
    )
    return Saddles(state[:, :2], state[:, 7], state[:, 4:6], good)


class _Patch(NamedTuple):
    pixels: np.ndarray  # (N, P, 2)
    grey: np.ndarray  # (N, P)
    mask: np.ndarray  # (N, P), of the pixels to fit
    bend: np.ndarray  # (N, 2), half the curvature of the edges along x and down, 1/px


def _residual(state: np.ndarray, patch: _Patch) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, P), model minus image, and their derivatives (N, P, 8)."""
    x, y = np.moveaxis(patch.pixels - state[:, None, :2], 2, 0)
    # The two edges are the first axis.
    angle, sigma, bend = (both.T[..., None] for both in (state[:, 2:4], state[:, 4:6], patch.bend))
    cosine, sine = np.cos(angle), np.sin(angle)
    along, across = x * cosine + y * sine, y * cosine - x * sine
    z = (across - bend * along**2) / sigma
    edges = erf(z / np.sqrt(2))
    mean, amplitude = state[:, 6:7], state[:, 7:]
    product = edges[0] * edges[1]
    # By the distance from an edge, and that by the point's place and the edge's angle.
    slope = np.sqrt(2 / np.pi) * np.exp(-0.5 * z**2) / sigma
    by_distance = amplitude * edges[::-1] * slope
    bent = 2 * bend * along
    jacobian = np.stack(
        [
            np.sum(by_distance * (sine + bent * cosine), axis=0),
            np.sum(by_distance * (bent * sine - cosine), axis=0),
            *(-by_distance * (along + bent * across)),
            *(-by_distance * z),
            np.ones_like(product),
            product,
        ],
        axis=-1,
    )
    residual = np.where(patch.mask, mean + amplitude * product - patch.grey, 0)
    return residual, np.where(patch.mask[..., None], jacobian, 0)
