"""Detections of all cameras in the order of the marker map."""

from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from jaxnav.detection.types import Detections
from jaxnav.models.markers import MarkerMap

SAME_PX = 1.0  # nearer to each other, two detections are one


class Observed(NamedTuple):
    """What C cameras see of M markers. Lanes that are not visible hold zeros (sigma: ones).

    Attributes:
        corners_px: (C, M, 4, 2), TL TR BR BL.
        visible: (C, M) bool.
        sigma_px: (C, M, 4), standard deviation of each corner along one axis.
        unknown: how many detections are not of the map.
        duplicates: how many detections were dropped since their image shows their id elsewhere too.
    """

    corners_px: np.ndarray
    visible: np.ndarray
    sigma_px: np.ndarray
    unknown: int
    duplicates: int


def observe(detections: Sequence[Detections], markers: MarkerMap) -> Observed:
    """The observation of one instant, one `Detections` a camera in the rig's order.

    A marker found at two places in one image is dropped from it: the map has it once, so one of
    the two is a copy or a reflection, and nothing in the image says which. One that was merely
    reported twice is there once.
    """
    # Not by the map's own method: equinox makes a module of it for every call, 0.1 ms.
    lanes = {key: lane for lane, key in enumerate(zip(markers.ids, markers.families, strict=True))}
    shape = (len(detections), len(lanes))
    corners_px = np.zeros((*shape, 4, 2))
    visible = np.zeros(shape, bool)
    sigma_px = np.ones((*shape, 4))
    unknown = duplicates = 0
    for camera, found in enumerate(detections):
        if not len(found):
            continue
        keys = list(zip(found.ids.tolist(), found.families, strict=True))
        told = _told_once(keys, found.corners_px)
        counts = Counter(keys[k] for k in told)
        for k in told:
            key = keys[k]
            marker = lanes.get(key)
            if marker is None:
                unknown += 1
            elif counts[key] > 1:
                duplicates += 1
            else:
                corners_px[camera, marker] = found.corners_px[k]
                sigma_px[camera, marker] = found.sigma_px[k]
                visible[camera, marker] = True
    return Observed(corners_px, visible, sigma_px, unknown, duplicates)


def _told_once(keys: Sequence[tuple[int, str]], corners_px: np.ndarray) -> list[int]:
    """Indices of the detections, without those that repeat another of their marker."""
    kept: list[int] = []
    for k, key in enumerate(keys):
        if not any(
            keys[other] == key and np.max(np.abs(corners_px[other] - corners_px[k])) < SAME_PX
            for other in kept
        ):
            kept.append(k)
    return kept
