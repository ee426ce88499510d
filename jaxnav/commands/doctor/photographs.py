"""Checks of the files by pictures of the standing car: `--frame CAMERA=IMAGE`."""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from jaxnav.commands.doctor.findings import Finding, listed
from jaxnav.commands.doctor.fits import Sighted
from jaxnav.commands.doctor.orders import in_their_order
from jaxnav.commands.doctor.together import together
from jaxnav.detection import Detections, make_detectors, observe
from jaxnav.files import Route
from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig

_MOST_MARKERS = 6  # the largest ones, which are compared
_SMALL_PX = 12.0


def usable(rig: CameraRig, images: Mapping[str, np.ndarray]) -> Iterator[Finding]:
    """Report pictures of another size than their camera was calibrated at."""
    for name, image in images.items():
        width_px, height_px = rig.image_sizes_px[rig.names.index(name)]
        if image.shape[:2] != (height_px, width_px):
            yield Finding(
                "picture",
                "error",
                f"{name}: {image.shape[1]} x {image.shape[0]} px, the rig says "
                f"{width_px} x {height_px}",
                "take it at the size that the camera was calibrated at",
            )


def _detections(
    rig: CameraRig, markers: MarkerMap, images: Mapping[str, np.ndarray]
) -> list[Detections]:
    """Detections of the map's families for each camera; none where it has no picture."""
    detectors = make_detectors(markers)
    return [
        Detections.concatenate(
            [
                detector.detect(images[name], rig.camera(index))
                for detector in detectors
                if name in images
            ]
        )
        for index, name in enumerate(rig.names)
    ]


def identities(
    rig: CameraRig, markers: MarkerMap, detections: Sequence[Detections]
) -> Iterator[Finding]:
    """Report which markers are in view, of the map and others."""
    known, foreign, twice = [], [], []
    for name, one in zip(rig.names, detections, strict=True):
        keys = list(zip(one.ids.tolist(), one.families, strict=True))
        counts = Counter(keys)
        for key, corners_px in zip(keys, one.corners_px, strict=True):
            if markers.index(*key) is None:
                foreign.append(f"{key[0]} of {key[1]} in {name}")
            elif counts[key] > 1:
                twice.append(f"{key[0]} in {name}")
            else:
                known.append(f"{key[0]} in {name} ({_side_px(corners_px):.0f} px)")
    if foreign:
        yield Finding(
            "picture",
            "note",
            f"markers that are not in the map: {listed(foreign)}",
            "add them to the map, or check the ids that are written there",
        )
    if twice:
        yield Finding(
            "picture",
            "warning",
            f"seen twice in one picture: {listed(sorted(set(twice)))}",
            "each marker may hang in one place only: print another id; a mirror shows copies too",
        )
    if known:
        yield Finding("picture", "ok", f"markers of the map: {listed(known)}")
    else:
        yield Finding(
            "picture",
            "warning",
            f"no marker of the map ({listed(markers.ids)} of "
            f"{listed(sorted(set(markers.families)))}) is found",
            "wrong id or family in the map? Too small, too dark, blurred, or without a white "
            f"margin? It should be {_SMALL_PX:.0f} px wide and more",
        )


def _side_px(corners_px: np.ndarray) -> float:
    diagonals_px = corners_px[:2] - corners_px[2:]
    (a, b), (c, d) = diagonals_px
    return math.sqrt(abs(a * d - b * c) / 2)


def examine_pictures(
    rig: CameraRig, markers: MarkerMap, route: Route | None, images: Mapping[str, np.ndarray]
) -> Iterator[Finding]:
    """Run all checks of pictures of one standing car.

    Args:
        images: by the names of their cameras.
    """
    wrong = list(usable(rig, images))
    yield from wrong
    if wrong:
        return
    detections = _detections(rig, markers, images)
    yield from identities(rig, markers, detections)
    seen = Sighted.of(rig, markers, observe(detections, markers), _MOST_MARKERS)
    if not seen.visible.any():
        return
    seen, poses, findings = in_their_order(seen, route)
    yield from findings
    yield from together(seen, poses, route)
