"""Sorting of the detections of all cameras into the order of the marker map."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from jaxnav.core.models.markers import MarkerMap
from jaxnav.detection.types import Detections

SAME_PX = 1.0  # two detections nearer to each other than this count as one
# Of a marker seen edge-on noise may turn the corners round, by its sigmas once in three million.
_MIRRORED_SIGMAS = 5.0


class CornerLanes(NamedTuple):
    """The corners of M markers in C cameras. Lanes that are not visible hold zeros (sigma: ones).

    Attributes:
        corners_px: (C, M, 4, 2), TL TR BR BL.
        visible: (C, M) bool.
        sigma_px: (C, M, 4), standard deviation of each corner along one axis.
        unknown: number of detections of markers that are not in the map.
        duplicates: number of detections dropped because their image shows their id elsewhere too.
        mirrored: number of detections dropped because their corners run as from behind.
    """

    corners_px: Float[np.ndarray, "C M 4 2"]
    visible: Bool[np.ndarray, "C M"]
    sigma_px: Float[np.ndarray, "C M 4"]
    unknown: int
    duplicates: int
    mirrored: int


def marker_keys(markers: MarkerMap) -> tuple[tuple[str, int], ...]:
    """Family and id of each marker of a map, in its order."""
    return tuple(zip(markers.families, map(int, markers.ids), strict=True))


def double_area_px2(corners_px: Float[np.ndarray, "*N 4 2"]) -> Float[np.ndarray, "*N"]:
    """Twice the area that corners TL TR BR BL go round, px^2: the product of the diagonals.

    It is positive for a marker seen from the front, by any lens and roll: on the screen,
    whose y axis points down, these corners run clockwise. It is negative where a detector lists
    them the other way round.
    """
    (right, down), (left, up) = _diagonals_px(corners_px)
    return right * up - down * left


def _diagonals_px(corners_px: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """TL to BR and TR to BL, (2, *N) each."""
    x_y = np.moveaxis(corners_px, -1, 0)
    return x_y[..., 2] - x_y[..., 0], x_y[..., 3] - x_y[..., 1]


def are_mirrored(
    corners_px: Float[np.ndarray, "N 4 2"], sigma_px: Float[np.ndarray, "N 4"]
) -> Bool[np.ndarray, " N"]:
    """Whether corners run as of a marker seen from behind, beyond their noise."""
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is found elsewhere
        area_px2 = double_area_px2(corners_px)
        if not (area_px2 < 0).any():
            return np.zeros(len(area_px2), bool)
        falling, rising = (np.sum(line**2, axis=0) for line in _diagonals_px(corners_px))
        of_tl, of_tr, of_br, of_bl = np.moveaxis(sigma_px**2, -1, 0)
        variance = (of_tl + of_br) * rising + (of_tr + of_bl) * falling
        return area_px2 < -_MIRRORED_SIGMAS * np.sqrt(variance)


def observe(detections: Sequence[Detections], markers: MarkerMap) -> CornerLanes:
    """The observation of one instant from one `Detections` a camera, in the rig's order.

    A marker found at two places in one image is dropped: the map has it once, so one of the two
    is a copy or a reflection, and nothing in the image says which. A marker reported twice at the
    same place is kept once. From the front a marker's corners run clockwise: those that run the
    other way round are in another order than ours, and dropped.
    """
    # The map's own method would be slower: equinox wraps it in a module at every call, 0.1 ms.
    lanes = {key: lane for lane, key in enumerate(zip(markers.ids, markers.families, strict=True))}
    shape = (len(detections), len(lanes))
    corners_px = np.zeros((*shape, 4, 2))
    visible = np.zeros(shape, bool)
    sigma_px = np.ones((*shape, 4))
    unknown = duplicates = mirrored = 0
    for camera, sightings in enumerate(detections):
        if not len(sightings):
            continue
        keys = list(zip(sightings.ids.tolist(), sightings.families, strict=True))
        kept = _once_each(keys, sightings.corners_px)
        counts = Counter(keys[k] for k in kept)
        from_behind = are_mirrored(sightings.corners_px, sightings.sigma_px)
        for k in kept:
            key = keys[k]
            marker = lanes.get(key)
            if marker is None:
                unknown += 1
            elif counts[key] > 1:
                duplicates += 1
            elif from_behind[k]:
                mirrored += 1
            else:
                corners_px[camera, marker] = sightings.corners_px[k]
                sigma_px[camera, marker] = sightings.sigma_px[k]
                visible[camera, marker] = True
    return CornerLanes(corners_px, visible, sigma_px, unknown, duplicates, mirrored)


def _once_each(keys: Sequence[tuple[int, str]], corners_px: np.ndarray) -> list[int]:
    """Indices of the detections without repetitions of a marker at the same place."""
    kept: list[int] = []
    for k, key in enumerate(keys):
        if not any(
            keys[other] == key and np.max(np.abs(corners_px[other] - corners_px[k])) < SAME_PX
            for other in kept
        ):
            kept.append(k)
    return kept
