"""Fit of the saddle points where two black squares touch to the grey levels around them.

With d1 and d2 the distances of a pixel from the two edges that cross in the point,

    grey = mean + amplitude * erf(d1 / (sqrt(2) sigma1)) * erf(d2 / (sqrt(2) sigma2)),

and d is measured from a parabola where the edges are bent. Each point has eight unknowns (its
place, two angles, two blurs, mean, amplitude); Levenberg-Marquardt fits all points of an image at
once. Each edge has its own blur because motion blurs one and not the other.
"""

from dataclasses import dataclass
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


class Places(NamedTuple):
    """First guesses of N saddles: their places and the directions and bends of their edges.

    Attributes:
        points_px: (N, 2), the places.
        along_px: (N, 2, 2), the image of one step, the length of a square, along the board's x
            and down its columns: [step, u or v].
        bend_px: (N, 2), how far the line along either step is off its tangent one step away, to
            the left of the step (in the image, y down: to its right as one looks at it).
        clear: (N,), part of a step up to which there is nothing but the saddle.
        cross: (N,), part of a step off both edges beyond which there may be other ink.
    """

    points_px: Float[np.ndarray, "N 2"]
    along_px: Float[np.ndarray, "N 2 2"]
    bend_px: Float[np.ndarray, "N 2"]
    clear: Float[np.ndarray, " N"]
    cross: Float[np.ndarray, " N"]

    def only(self, which: Int[np.ndarray, " K"] | Bool[np.ndarray, " N"]) -> "Places":
        """The places at some indices or in a mask."""
        return Places(*(column[which] for column in self))


class Saddles(NamedTuple):
    """N fitted saddles.

    Attributes:
        points_px: (N, 2), the places.
        amplitude: (N,) grey levels; positive if the saddle's top left on the board is black.
        sigma_px: (N, 2), blur of the edges along x and along y.
        good: (N,) bool, true if the fit converged on a saddle.
    """

    points_px: Float[np.ndarray, "N 2"]
    amplitude: Float[np.ndarray, " N"]
    sigma_px: Float[np.ndarray, "N 2"]
    good: Bool[np.ndarray, " N"]


def fit_saddles(
    image: UInt8[np.ndarray, "rows columns"], places: Places, radius_px: float, max_move_px: float
) -> Saddles:
    """Fit saddles near the given places.

    Args:
        image: (H, W) grey levels, uint8.
        places: the first guesses.
        radius_px: radius around a point of the pixels to fit; fewer are taken near other ink.
        max_move_px: saddles that move further than this from their places are not good.
    """
    patch = _Patch.around(image, places, radius_px)
    count = len(places.points_px)
    angles = np.arctan2(places.along_px[..., 1], places.along_px[..., 0])
    state = np.column_stack(
        [places.points_px, angles, np.full((count, 2), _START_SIGMA_PX), np.zeros((count, 2))]
    )
    state = _with_light(state, patch)
    residual, jacobian = _residual(state, patch)
    loss = np.sum(residual**2, axis=1)
    damping = np.full(count, 1e-3)
    converged = np.zeros(count, bool)
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
        # Damping also makes steps short; the noise tells a minimum from a dead end.
        converged |= np.abs(step[:, :2]).max(axis=1) < _CONVERGED_PX
        state[better], loss[better] = tried[better], tried_loss[better]
        residual[better], jacobian[better] = tried_residual[better], tried_jacobian[better]
        damping = np.where(better, np.maximum(damping / 10, 1e-4), damping * 10)
        if np.all(converged):
            break
    moved_px = np.linalg.norm(state[:, :2] - places.points_px, axis=1)
    turned = np.abs((state[:, 2:4] - angles + np.pi / 2) % np.pi - np.pi / 2)
    noise = np.sqrt(loss / np.maximum(patch.mask.sum(axis=1) - 8, 1))
    good = (
        converged
        & patch.enough
        & (moved_px <= max_move_px)
        & (turned.max(axis=1) < _MAX_TURN_RAD)
        & (np.abs(state[:, 7]) > _MIN_AMPLITUDE)
        & (noise < _MAX_NOISE * np.abs(state[:, 7]))
        & (state[:, 4:6].max(axis=1) < 0.6 * patch.radius_px)
    )
    return Saddles(state[:, :2], state[:, 7], state[:, 4:6], good)


_LONGEST_STEP = np.array([1.5, 1.5, 0.2, 0.2, 0.4, 0.4, 60.0, 60.0])
_MAX_TURN_RAD = 0.35
_MIN_AMPLITUDE = 4.0  # grey levels, half of the difference between black and white
_MAX_NOISE = 0.35  # of the amplitude


@dataclass(frozen=True)
class _Patch:
    """The pixels of the fit: (N, P, 2) places, (N, P) grey levels and a mask of those used."""

    pixels: np.ndarray
    grey: np.ndarray
    mask: np.ndarray
    curvature: np.ndarray  # (N, 2), 1/px, of the edges along x and down
    radius_px: np.ndarray  # (N,)
    enough: np.ndarray  # (N,) bool

    @staticmethod
    def around(image: np.ndarray, places: Places, radius_px: float) -> "_Patch":
        reach = int(np.ceil(radius_px)) + 1
        span = np.arange(-reach, reach + 1)
        window = np.stack(np.meshgrid(span, span), axis=-1).reshape(-1, 2)
        pixels = np.rint(places.points_px).astype(int)[:, None] + window
        height, width = image.shape
        inside = np.all((pixels >= 0) & (pixels < (width, height)), axis=2)
        clipped = np.clip(pixels, 0, (width - 1, height - 1))
        offset = pixels - places.points_px[:, None]
        steps = np.einsum("npj,njk->npk", offset, np.linalg.inv(places.along_px))
        # A pixel integrates over half a pixel on each side, and blur over a little more.
        step_px = np.linalg.norm(places.along_px, axis=2)
        margin = 1.0 / step_px[:, None, :]
        near = np.abs(steps) + margin
        distance = np.linalg.norm(offset, axis=2)
        mask = inside & (distance <= radius_px) & np.all(near < places.clear[:, None, None], axis=2)
        mask &= np.any(near < places.cross[:, None, None], axis=2)
        curvature = 2 * places.bend_px / step_px**2
        reached = np.where(mask, distance, 0).max(axis=1)
        grey = image[clipped[..., 1], clipped[..., 0]].astype(float)
        enough = (mask.sum(axis=1) >= _MIN_PIXELS) & np.all(
            (places.points_px >= 2) & (places.points_px <= (width - 3, height - 3)), axis=1
        )
        return _Patch(pixels.astype(float), grey, mask, curvature, reached, enough)


def _residual(state: np.ndarray, patch: _Patch) -> tuple[np.ndarray, np.ndarray]:
    """Residuals (N, P), model minus image, and their derivatives (N, P, 8)."""
    offset = patch.pixels - state[:, None, :2]
    edges, slopes, by_place, by_angle, by_sigma = [], [], [], [], []
    for edge in (0, 1):
        angle, sigma = state[:, None, 2 + edge], state[:, None, 4 + edge]
        bend = patch.curvature[:, None, edge] / 2
        cosine, sine = np.cos(angle), np.sin(angle)
        along = offset[..., 0] * cosine + offset[..., 1] * sine
        off = offset[..., 1] * cosine - offset[..., 0] * sine - bend * along**2
        z = off / sigma
        slope = np.sqrt(2 / np.pi) * np.exp(-0.5 * z**2) / sigma
        edges.append(erf(z / np.sqrt(2)))
        slopes.append(slope)
        # Derivatives of the distance by the point's u and v, and by the angle.
        by_place.append((sine + 2 * bend * along * cosine, -cosine + 2 * bend * along * sine))
        across = offset[..., 1] * cosine - offset[..., 0] * sine
        by_angle.append(-along - 2 * bend * along * across)
        by_sigma.append(-z * slope)
    first, second = edges
    amplitude = state[:, None, 7]
    product = first * second
    residual = state[:, None, 6] + amplitude * product - patch.grey
    with_first, with_second = amplitude * second * slopes[0], amplitude * first * slopes[1]
    jacobian = np.stack(
        [
            with_first * by_place[0][0] + with_second * by_place[1][0],
            with_first * by_place[0][1] + with_second * by_place[1][1],
            with_first * by_angle[0],
            with_second * by_angle[1],
            amplitude * second * by_sigma[0],
            amplitude * first * by_sigma[1],
            np.ones_like(product),
            product,
        ],
        axis=-1,
    )
    return np.where(patch.mask, residual, 0), np.where(patch.mask[..., None], jacobian, 0)


def _with_light(state: np.ndarray, patch: _Patch) -> np.ndarray:
    """The state with the mean and amplitude that fit the image best."""
    _, jacobian = _residual(state, patch)
    light = jacobian[:, :, 6:8]
    hessian = np.einsum("npi,npj->nij", light, light) + 1e-6 * np.eye(2)
    right = np.einsum("npi,np->ni", light, np.where(patch.mask, patch.grey, 0))
    state[:, 6:8] = np.linalg.solve(hessian, right[:, :, None])[:, :, 0]
    return state
