"""First place of a known marker near where it is expected: correlation with its blurred picture."""

import math
from functools import cache
from typing import NamedTuple

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.detection.families import marker_cells
from jaxnav.detection.refine import mean_side_px
from jaxnav.detection.signs_of_life import sign
from jaxnav.detection.types import at_scale

_TEXELS = 8  # of a cell, along a side
_FINER = 2  # sub-pixels of the drawn marker, along a side
_LENS_PX = 0.7
_MOST_RADIUS_PX = 48
_SIDE_PX = 32.0  # of a marker that is searched for: a larger one is shrunk, or takes 100 ms
_MOST_PAPER = 2.5  # extent of the white zone against the marker's: beyond is almost the horizon
_LEAST_MATCH = 0.35  # correlation, -1 to 1
_STREAKS_PX = (4.0, 8.0)  # tried in four directions where the motion is not known
_SURE_PX = 2.0  # of the streak: what is known better is not searched for
_GREY = 0.5


class Match(NamedTuple):
    """The best place found."""

    quad_px: Float[np.ndarray, "4 2"]
    streak_px: tuple[float, float]
    correlation: float


def best_match(
    image: UInt8[np.ndarray, "rows columns"],
    family: str,
    marker_id: int,
    quads_px: Float[np.ndarray, "H 4 2"],
    radius_px: float,
    streak_px: tuple[float, float],
    streak_sigma_px: float,
) -> Match | None:
    """The shift of one of the quadrilaterals at which the marker's picture fits best, to a pixel or
    to a 32nd of the marker's side, whichever is more.

    Args:
        radius_px: the farthest shift along an axis.
        streak_px: the expected streak of the marker during the exposure.
        streak_sigma_px: its standard deviation; above 2 px other streaks are tried as well.
    """
    streaks = [streak_px]
    if streak_sigma_px > _SURE_PX:
        angles = np.arange(4) * math.pi / 4
        streaks += [(s * math.cos(a), s * math.sin(a)) for s in _STREAKS_PX for a in angles]
    pattern = _printed(family, marker_id)
    quads_px = quads_px[np.all(np.isfinite(quads_px), axis=(1, 2))]
    side_px = max(map(mean_side_px, quads_px), default=0.0)
    shrink = min(max(int(side_px / _SIDE_PX), 1), *image.shape)
    image, _ = at_scale(image, 1 / shrink)
    best: Match | None = None
    for quad_px in quads_px:
        sign()  # each place takes some 10 ms
        quad = (quad_px + 0.5) / shrink - 0.5
        paper = _paper(pattern, quad)
        if not np.ptp(paper, axis=0).max() < _MOST_PAPER * np.ptp(quad, axis=0).max():
            continue
        longest = max(math.hypot(*streak) for streak in streaks) / shrink
        drawn, mask, origin = _draw(pattern, paper, longest)
        for streak in streaks:
            smeared = _smeared(drawn, (streak[0] / shrink, streak[1] / shrink))
            found = _shift(image, smeared, mask, origin, radius_px / shrink)
            if found is not None and (best is None or found[1] > best.correlation):
                best = Match(quad_px + shrink * found[0], streak, found[1])
    return best if best is not None and best.correlation > _LEAST_MATCH else None


@cache
def _printed(family: str, marker_id: int) -> np.ndarray:
    cells = np.pad(marker_cells(family, marker_id), 1, constant_values=1.0)
    return np.kron(cells, np.ones((_TEXELS, _TEXELS))).astype(np.float32)


def _draw(
    pattern: np.ndarray, paper: np.ndarray, reach_px: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The marker's picture, where its paper is (both sub-sampled), and the pixel of its corner."""
    margin = math.ceil(reach_px / 2) + 1
    low = np.floor(paper.min(axis=0)).astype(int) - margin
    size = np.ceil(paper.max(axis=0)).astype(int) + margin + 1 - low
    side = pattern.shape[0]
    texels = _box(0, side) - 0.5
    finer = ((paper - low + 0.5) * _FINER - 0.5).astype(np.float32)
    H = cv2.getPerspectiveTransform(texels, finer)
    shape = (int(size[0]) * _FINER, int(size[1]) * _FINER)
    drawn = cv2.warpPerspective(
        pattern, H, shape, flags=cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=_GREY
    )
    mask = cv2.warpPerspective(np.ones_like(pattern), H, shape, flags=cv2.INTER_LINEAR)
    area = (int(size[0]), int(size[1]))
    return (
        cv2.resize(drawn, area, interpolation=cv2.INTER_AREA),
        cv2.resize(mask, area, interpolation=cv2.INTER_AREA),
        low,
    )


def _paper(pattern: np.ndarray, quad: np.ndarray) -> np.ndarray:
    """Corners (4, 2) of the white zone around the marker with these corners."""
    cells = pattern.shape[0] // _TEXELS
    square = _box(1, cells - 1)
    H = cv2.getPerspectiveTransform(square, quad.astype(np.float32))
    ends = _box(0, cells)[None]
    return np.asarray(cv2.perspectiveTransform(ends, H)[0], float)


def _box(low: float, high: float) -> np.ndarray:
    return np.array([[low, low], [high, low], [high, high], [low, high]], np.float32)


def _smeared(drawn: np.ndarray, streak: tuple[float, float]) -> np.ndarray:
    blurred = cv2.GaussianBlur(drawn, (0, 0), _LENS_PX)
    length = math.hypot(*streak)
    if length < 1:
        return blurred
    radius = math.ceil(length / 2) + 1
    kernel = np.zeros((2 * radius + 1, 2 * radius + 1), np.float32)
    for t in np.linspace(-0.5, 0.5, 4 * radius):
        x, y = radius + t * streak[0], radius + t * streak[1]
        column, row = math.floor(x), math.floor(y)
        fx, fy = x - column, y - row
        kernel[row : row + 2, column : column + 2] += np.outer([1 - fy, fy], [1 - fx, fx])
    return cv2.filter2D(blurred, -1, kernel / kernel.sum(), borderType=cv2.BORDER_REPLICATE)


def _shift(
    image: np.ndarray,
    drawn: np.ndarray,
    mask: np.ndarray,
    origin: np.ndarray,
    radius_px: float,
) -> tuple[np.ndarray, float] | None:
    """The shift (2,) at which what was drawn correlates best, and how well."""
    radius = min(math.ceil(radius_px), _MOST_RADIUS_PX)
    rows, columns = drawn.shape
    low = origin - radius
    high = origin + np.array([columns, rows]) + radius
    # What lies outside of the image is as its border: half a marker is still found.
    before = np.maximum(-low, 0)
    after = np.maximum(high - image.shape[::-1], 0)
    if np.any(before >= high - low) or np.any(after >= high - low):
        return None
    inside = image[max(low[1], 0) : high[1], max(low[0], 0) : high[0]]
    if inside.size == 0:
        return None
    window = cv2.copyMakeBorder(
        inside, before[1], after[1], before[0], after[0], cv2.BORDER_REPLICATE
    ).astype(np.float32)
    # Weights: the marker counts, the ground around it does not.
    scores = cv2.matchTemplate(window, drawn, cv2.TM_CCOEFF_NORMED, mask=mask)
    scores[~np.isfinite(scores)] = -1
    _, highest, _, at = cv2.minMaxLoc(scores)
    return np.array(at) - radius, float(highest)
