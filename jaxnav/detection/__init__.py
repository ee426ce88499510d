"""Detection of markers in images: their ids and their corners.

    detector = make_detector("aruco", family="tag36h11")
    detections = detector.detect(image, camera)
    observed = observe([detections, ...], markers)  # corners_px, visible, sigma_px

    tracks = track(image, camera, [Target("tag36h11", 7, quads_px, radius_px=12.0)])

A decoder (OpenCV's, or AprilTag's own) finds each marker's id and its place to a pixel; `refine`
then fits the corners, in the same way for both. Where a marker is expected, `track` follows it
through blur, shade and what hides a part of it, with nothing decoded. Where none is expected,
`Acquirer` finds those of known ids in an image that is restored from its blur.
"""

from collections.abc import Collection

from jaxnav.core.models.markers import MarkerMap
from jaxnav.detection.acquire import Acquirer
from jaxnav.detection.apriltag import AprilTagDetector
from jaxnav.detection.aruco import ArucoDetector
from jaxnav.detection.families import marker_cells
from jaxnav.detection.observe import CornerLanes, marker_keys, observe
from jaxnav.detection.track import Target, Track, track
from jaxnav.detection.tracker import Tracker
from jaxnav.detection.types import Detections, Detector
from jaxnav.errors import BadInput

__all__ = [
    "Acquirer",
    "AprilTagDetector",
    "ArucoDetector",
    "CornerLanes",
    "Detections",
    "Detector",
    "Target",
    "Track",
    "Tracker",
    "make_detector",
    "make_detectors",
    "marker_cells",
    "observe",
    "track",
]

BACKENDS = {"aruco": ArucoDetector, "apriltag": AprilTagDetector}


def make_detector(
    backend: str = "aruco", family: str = "tag36h11", ids: Collection[int] | None = None
) -> Detector:
    """Make a detector of one family of markers.

    Args:
        backend: "aruco" (OpenCV) or "apriltag" (needs the extra of that name).
        family: one of `jaxnav.core.models.markers.FAMILY_SIZES`.
        ids: of the markers whose corners matter; those of others stay as they are decoded, which
            saves 10 ms each, and once these are read nothing is looked at again. None: all.

    Raises:
        BadInput: backend or family is unknown, or the backend lacks the family or its extra.
    """
    if backend not in BACKENDS:
        raise BadInput("detector", f"unknown {backend!r}: expected one of {', '.join(BACKENDS)}")
    return BACKENDS[backend](family, ids)


def make_detectors(markers: MarkerMap, backend: str = "aruco") -> list[Detector]:
    """Make a detector for each family of a map, of the map's ids: see `make_detector`."""
    keys = marker_keys(markers)
    return [
        make_detector(backend, family, {marker_id for of, marker_id in keys if of == family})
        for family in sorted(set(markers.families))
    ]
