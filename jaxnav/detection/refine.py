"""Corners of a decoded marker: the choice of pixels, the fit and the check of its result."""

from dataclasses import dataclass

import cv2
import jax
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxnav.detection.edges import PIXELS, EdgeFit, fit_edges
from jaxnav.detection.image_model import step_corners
from jaxnav.detection.lens import Lens
from jaxnav.detection.paper import SQUARE, corner_motion, homography, rays_of
from jaxnav.detection.signs_of_life import sign

# Markers up to this side are fitted whole, of larger ones the outline. Where levels may be coded,
# the edges of all cells go with it: a curve of the levels and an outline's size look alike.
_WHOLE_UP_TO_PX = 30.0
_NOWHERE_PX = 1e6  # as in `ranges`: no corner lies beyond
_OUTLINE_PX = 3.0
_POINTS_PER_EDGE = 16
_MIN_PIXELS = 60
_MAX_NOISE = 0.25  # of the contrast
_FEW_GREYS = 0.06  # of the pixels around the outline
_NO_EDGES = np.zeros((0, 2, 2))
_SETTLED_PX = 0.1  # a corner that moves by less in a step
_MAX_MOVE = 0.2  # of the side
# Errors that residuals don't show: pixels are square and not Gaussian, paper is not quite flat.
_MODEL_SIGMA_PX = 0.006


@dataclass(frozen=True)
class MarkerFit:
    """A fit and its pixels. M takes the lens's rays to the paper."""

    M: Float[np.ndarray, "3 3"]
    pixels: Int[np.ndarray, "N 2"]
    edges: EdgeFit


@dataclass(frozen=True)
class RefinedMarker:
    """The corners of a marker after the fit, with their standard deviations.

    Attributes:
        corners_px: (4, 2), TL TR BR BL; the given ones if the fit failed.
        sigma_px: (4,), standard deviation of each corner along an axis (RMS of the two).
        noise: standard deviation of the residual, over the contrast.
        good: true if the fit settled, near its start, on something like the marker.
        fitted: the fit; None if it failed.
    """

    corners_px: Float[np.ndarray, "4 2"]
    sigma_px: Float[np.ndarray, " 4"]
    noise: float
    good: bool
    fitted: MarkerFit | None


def refine_corners(
    image: UInt8[np.ndarray, "rows columns"],
    corners_px: Float[np.ndarray, "4 2"],
    cells: Float[np.ndarray, "n n"],
    lens: Lens,
    whole: bool = False,
) -> RefinedMarker:
    """Fit the corners of a decoded marker to some hundredths of a pixel.

    Args:
        image: (H, W) grey levels, uint8.
        corners_px: (4, 2), TL TR BR BL, a pixel or half a cell off at most.
        cells: (n, n), 1 white, 0 black, with the black frame.
        lens: the lens that bends the marker's straight edges.
        whole: fit the inside of the cells of a large marker too, not their edges alone.
    """
    corners_px = np.asarray(corners_px, float)
    side_px = mean_side_px(corners_px)
    failed = as_decoded(corners_px)
    fitted = fit_marker(image, corners_px, cells, lens, whole)
    if fitted is None:
        return failed
    fit = fitted.edges
    fitted_px = corners_of(fitted.M, lens)
    moved_px = np.max(np.linalg.norm(fitted_px - corners_px, axis=1))
    # Where the blur is at its limit, in pictures sharper than any lens draws, steps don't end.
    settled = bool(fit.converged) or float(fit.step) * side_px / 2 < _SETTLED_PX
    good = (
        settled
        and moved_px < max(2.0, _MAX_MOVE * side_px)
        and float(fit.noise) < _MAX_NOISE * float(fit.contrast)
    )
    if not good:
        return failed
    motion = corner_motion(fitted.M, *lens.rays(fitted_px))
    variance_px2 = np.einsum("ij,jk,ik->i", motion, np.asarray(fit.covariance, float), motion)
    sigma_px = np.sqrt(variance_px2.reshape(4, 2).mean(axis=1) + _MODEL_SIGMA_PX**2)
    return RefinedMarker(fitted_px, sigma_px, float(fit.noise / fit.contrast), True, fitted)


def as_decoded(corners_px: Float[np.ndarray, "4 2"]) -> RefinedMarker:
    """A decoder's corners, which lie within a pixel, or 3 % of the side, of the truth."""
    sigma_px = np.full(4, max(1.0, 0.03 * mean_side_px(corners_px)))
    return RefinedMarker(np.asarray(corners_px, float), sigma_px, np.inf, False, None)


def fit_marker(
    image: UInt8[np.ndarray, "rows columns"],
    corners_px: Float[np.ndarray, "4 2"],
    cells: Float[np.ndarray, "n n"],
    lens: Lens,
    whole: bool,
) -> MarkerFit | None:
    """Fit the marker and return the fit, good or not; None if the image shows too little of it."""
    sign()
    M = homography(lens.rays(corners_px)[0].T)
    side_px = mean_side_px(corners_px)
    whole = whole or side_px <= _WHOLE_UP_TO_PX
    around = image.shape, M, lens, side_px / len(cells)
    pixels = pixels_around(*around, None if whole else _NO_EDGES)
    known = bool(np.all((cells == 0) | (cells == 1)))
    curved = known and _has_greys(image, pixels)
    if curved and not whole:
        pixels = pixels_around(*around, _inner_edges(cells))
    count = len(pixels)
    if count < _MIN_PIXELS:
        return None
    rays, rays_px = lens.rays(pixels)
    # In the basis of the first guess all numbers are of order one, which suits float32.
    lanes = np.minimum(np.arange(PIXELS), count - 1)
    levels = image[pixels[:, 1], pixels[:, 0]]
    seen = (M @ rays)[:, lanes], (M @ rays_px)[:, :, lanes], levels[lanes], step_corners(cells)
    used = np.arange(PIXELS) < count
    fit = fit_edges(*(np.asarray(a, np.float32) for a in seen), used, np.asarray(curved))
    fit = jax.device_get(fit)
    return MarkerFit(np.asarray(fit.M, float) @ M, pixels, fit)


def mean_side_px(corners_px: Float[np.ndarray, "4 2"]) -> float:
    """Mean length of the four sides of a quadrilateral (4, 2), px."""
    return float(np.mean(np.linalg.norm(corners_px - np.roll(corners_px, 1, 0), axis=1)))


def corners_of(M: Float[np.ndarray, "3 3"], lens: Lens) -> Float[np.ndarray, "4 2"]:
    """Pixels (4, 2) of the corners, TL TR BR BL, of the marker with homography M."""
    return lens.pixels(rays_of(M, SQUARE))


def _has_greys(image: np.ndarray, pixels: np.ndarray) -> bool:
    """True where levels lie between black and white, so that they can be coded one way or another.

    In a picture sharper than any lens draws an edge shows none, and the outline alone is exact.
    """
    if len(pixels) < _MIN_PIXELS:
        return False
    levels = image[pixels[:, 1], pixels[:, 0]].astype(float)
    dark, light = np.percentile(levels, [5, 95])
    between = (levels > dark + 0.15 * (light - dark)) & (levels < light - 0.15 * (light - dark))
    return bool(between.mean() > _FEW_GREYS)


def _inner_edges(cells: np.ndarray) -> np.ndarray:
    """Ends (E, 2, 2) on the paper of all edges between a black and a white cell."""
    n = len(cells)
    ends = []
    for turned in (False, True):
        table = cells.T if turned else cells
        row, column = np.nonzero(np.diff(table, axis=1))
        along = np.stack([row, row + 1], axis=1)
        across = np.repeat(column[:, None] + 1, 2, axis=1)
        at = np.stack([along, across] if turned else [across, along], axis=-1)
        ends.append(at)
    x, y = np.moveaxis(2 * np.concatenate(ends) / n - 1, -1, 0)
    return np.stack([x, y], axis=-1)


def pixels_around(
    shape: tuple[int, ...],
    M: Float[np.ndarray, "3 3"],
    lens: Lens,
    cell_px: float,
    edges: Float[np.ndarray, "E 2 2"] | None = None,
) -> Int[np.ndarray, "N 2"]:
    """The pixels (N, 2) to fit: along the outline and along edges (E, 2, 2) inside it; with None
    all inside it."""
    t = np.linspace(0, 1, _POINTS_PER_EDGE, endpoint=False)[:, None]
    ends = zip(SQUARE, np.roll(SQUARE, -1, 0), strict=True)
    outline = np.concatenate([(1 - t) * a + t * b for a, b in ends])
    outline_px = lens.pixels(rays_of(M, outline))
    if not (np.abs(outline_px) < _NOWHERE_PX).all():  # no marker has this outline
        return np.zeros((0, 2), int)
    segments_px: Float[np.ndarray, "E 2 2"] | None = None
    if edges is not None:
        segments_px = edges
        if len(edges):
            segments_px = lens.pixels(rays_of(M, edges.reshape(-1, 2))).reshape(-1, 2, 2)
        if not (np.abs(segments_px) < _NOWHERE_PX).all():
            return np.zeros((0, 2), int)
    pixels = pixels_along(shape, outline_px, cell_px, segments_px)
    if len(pixels) > PIXELS:
        pixels = scattered(pixels)[:PIXELS]
    return pixels


def pixels_along(
    shape: tuple[int, ...],
    outline_px: Float[np.ndarray, "P 2"],
    cell_px: float,
    segments_px: Float[np.ndarray, "E 2 2"] | None = None,
    wider_px: int = 0,
) -> Int[np.ndarray, "N 2"]:
    """The pixels (N, 2) beside a marker's outline (P, 2) and beside segments; with None all inside.

    Args:
        wider_px: added to how far they lie beside: within the white zone, one cell wide.
    """
    reach = round(min(_OUTLINE_PX, max(1.0, cell_px))) + wider_px
    low = np.maximum(np.floor(outline_px.min(0)).astype(int) - reach - 1, 0)
    high = np.minimum(np.ceil(outline_px.max(0)).astype(int) + reach + 2, shape[::-1])
    if np.any(high <= low):
        return np.zeros((0, 2), int)
    mask = np.zeros((high - low)[::-1], np.uint8)
    polyline = np.round((outline_px - low) * 16).astype(np.int32)
    cv2.polylines(mask, [polyline], True, 1, 2 * reach, shift=4)
    if segments_px is None:
        cv2.fillPoly(mask, [polyline], 1, shift=4)
    elif len(segments_px):
        segments = np.round((segments_px - low) * 16).astype(np.int32)
        cv2.polylines(mask, list(segments), False, 1, 2 * reach, shift=4)
    rows, columns = np.nonzero(mask)
    return np.column_stack([columns, rows]) + low


def scattered(pixels: Int[np.ndarray, "N 2"]) -> Int[np.ndarray, "N 2"]:
    """The pixels in a fixed but scattered order, whose first ones thin out all rows alike."""
    order = (pixels @ np.array([12.9898, 78.233]) * 43758.5453) % 1.0
    return pixels[np.argsort(order, kind="stable")]
