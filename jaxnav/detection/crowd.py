"""Reduction of an image full of squares to the squares that may be markers.

A decoder takes a millisecond for every quadrilateral and compares them all with each other: a
grille, a tiled wall or a poster made for it holds a camera up for seconds. If an image has more of
them than any room, the cells of all are first compared with the codes of the family at once, and
everything but the surroundings of the best is erased from the image.
"""

import math
from itertools import pairwise

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxnav.detection.families import all_cells, codes_of
from jaxnav.detection.types import at_scale

# A room with markers has a dozen quadrilaterals in 820 x 410 pixels, a robot field over a hundred.
_CROWD = 300
_CROWD_PIXELS = 820 * 410
_MOST_LOOKED_AT = 4096
_KEPT = 48
_KEPT_SHARE = 2  # at most 1/2 of the image is kept; a larger region would hold most of the crowd
# As in OpenCV's decoder: threshold windows, darkness below their mean, straightness of an edge.
_WINDOWS_PX, _DARKER, _STRAIGHT = (3, 13, 23), 7, 0.03
_SAME_PLACE_PX = 3.0
# At half the size, dark spots from noise vanish, the least outline is that of 3 x 3 pixels, and a
# square's may be off by a pixel; sides and areas distinguish it from the spots of a carpet.
_HALF_WINDOW_PX, _SPECK, _OUTLINE_PX = 11, np.ones((2, 2), np.uint8), 8
_HALF_STRAIGHT, _HALF_OFF_PX, _AREA_OFF, _LEAST_SIDES = 0.05, 1.0, 0.25, 0.35
_HALF_SHARE = 0.75  # of a crowd's squares, so many are seen at half the size at least
_MARGIN_SIDES, _MARGIN_PX = 0.25, 4


def thin_crowd(
    image: UInt8[np.ndarray, "rows columns"], family: str, least_perimeter_px: float
) -> UInt8[np.ndarray, "rows columns"]:
    """The image; if it is crowded, a copy that shows nothing but the likeliest markers.

    Args:
        image: (H, W) grey levels.
        family: one of `jaxnav.core.models.markers.FAMILY_SIZES`.
        least_perimeter_px: least perimeter of the quadrilaterals that the decoder examines.
    """
    crowd = max(_CROWD, min(1000, _CROWD * image.size // _CROWD_PIXELS))
    if not _has_squares(image, _HALF_SHARE * crowd, least_perimeter_px):
        return image
    quads = _quads(image, least_perimeter_px)
    if len(quads) <= crowd:
        return image
    likely = quads[np.argsort(_unlikeness(image, quads, family), kind="stable")[:_KEPT]]
    left, room_px2 = np.full_like(image, int(image.mean())), image.size / _KEPT_SHARE
    for quad in likely:
        low, high = quad.min(axis=0), quad.max(axis=0)
        margin_px = _MARGIN_SIDES * (high - low).max() + _MARGIN_PX
        x0, y0 = np.maximum(low - margin_px, 0).astype(int)
        x1, y1 = np.ceil(high + margin_px).astype(int)
        if (x1 - x0) * (y1 - y0) > room_px2:
            continue
        room_px2 -= (x1 - x0) * (y1 - y0)
        left[y0:y1, x0:x1] = image[y0:y1, x0:x1]
    return left


def _has_squares(image: np.ndarray, more_than: float, least_perimeter_px: float) -> bool:
    """True if the image at half size has more dark or light squares than that. It takes 1 to 4 ms;
    finding the quadrilaterals of a textured wall at full size takes 30 to 50."""
    small = at_scale(image, 0.5)[0]
    dark = cv2.morphologyEx(_dark(small, _HALF_WINDOW_PX), cv2.MORPH_OPEN, _SPECK)
    outlines, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    least = max(_OUTLINE_PX, 0.4 * least_perimeter_px)
    outlines = [np.asarray(outline) for outline in outlines if len(outline) >= least]
    if len(outlines) <= more_than:
        return False
    return sum(map(_is_square, outlines)) > more_than


def _is_square(outline: np.ndarray) -> bool:
    """Whether an outline in an image of half the size may be that of a square."""
    off_px = max(_HALF_STRAIGHT * len(outline), _HALF_OFF_PX)
    corners = cv2.approxPolyDP(outline, off_px, True)
    if len(corners) != 4 or not cv2.isContourConvex(corners):
        return False
    areas = cv2.contourArea(corners), cv2.contourArea(outline)
    sides = [math.dist(p, q) for p, q in pairwise([*corners[:, 0], corners[0, 0]])]
    alike = min(sides) >= _LEAST_SIDES * max(sides)
    return alike and abs(areas[0] - areas[1]) <= _AREA_OFF * max(areas)


def _dark(image: np.ndarray, window_px: int) -> np.ndarray:
    mean, inverse = cv2.ADAPTIVE_THRESH_MEAN_C, cv2.THRESH_BINARY_INV
    return np.asarray(cv2.adaptiveThreshold(image, 255, mean, inverse, window_px, _DARKER))


def _quads(image: np.ndarray, least_perimeter_px: float) -> np.ndarray:
    """Find the quadrilaterals (Q, 4, 2) of the image, clockwise, the largest first."""
    outlines: list[np.ndarray] = []
    for window_px in _WINDOWS_PX:
        dark = _dark(image, window_px)
        contours, _ = cv2.findContours(dark, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
        outlines += [np.asarray(o) for o in contours if len(o) >= least_perimeter_px]
    quads = []
    for outline in sorted(outlines, key=len)[::-1]:
        corners = cv2.approxPolyDP(outline, _STRAIGHT * len(outline), True)
        if len(corners) == 4 and cv2.isContourConvex(corners):
            quads.append(corners.reshape(4, 2))
            if len(quads) == _MOST_LOOKED_AT:
                break
    quads_px = np.array(quads, float).reshape(-1, 4, 2)
    # Each threshold window finds the same quadrilateral again.
    places = np.round(quads_px.mean(axis=1) / _SAME_PLACE_PX)
    quads_px = quads_px[np.sort(np.unique(places, axis=0, return_index=True)[1])]
    edges = np.roll(quads_px, -1, axis=1) - quads_px
    is_clockwise = edges[:, 0, 0] * edges[:, 1, 1] > edges[:, 0, 1] * edges[:, 1, 0]
    return np.where(is_clockwise[:, None, None], quads_px, quads_px[:, ::-1])


def _unlikeness(image: np.ndarray, quads: np.ndarray, family: str) -> np.ndarray:
    """(Q,) number of cells, frame included, that differ from the family's nearest code."""
    n = all_cells(family).shape[1]
    at = (np.arange(n) + 0.5) / n
    u, v = (side.ravel()[:, None] for side in np.meshgrid(at, at))
    weights = np.hstack([(1 - u) * (1 - v), u * (1 - v), u * v, (1 - u) * v])  # of TL TR BR BL
    points = (weights @ quads).astype(np.float32)
    x, y = np.moveaxis(points, -1, 0).copy()
    levels = cv2.remap(image, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    levels = levels.astype(np.float32)
    middle = (levels.min(axis=1) + levels.max(axis=1)) / 2
    ink = (levels < middle[:, None]).astype(np.float32)
    is_inside = np.pad(np.ones((n - 2, n - 2), bool), 1).ravel()
    inside, codes = ink[:, is_inside], codes_of(family).astype(np.float32)
    differ = inside.sum(axis=1)[:, None] + codes.sum(axis=1) - 2 * inside @ codes.T
    frame = np.count_nonzero(~is_inside) - ink[:, ~is_inside].sum(axis=1)
    return np.asarray(differ.min(axis=1) + frame)
