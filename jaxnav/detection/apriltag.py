"""AprilTag's own detector through pyapriltags, with our corners."""

import importlib

import numpy as np

from jaxnav.camera import Camera
from jaxnav.detection.families import dictionary
from jaxnav.detection.types import Detections, grey, refined_detections
from jaxnav.errors import BadInput

# Families that both AprilTag and OpenCV have. On OpenCV's picture of a marker AprilTag starts at
# the top right and goes on anticlockwise: so measured, the same for all of them.
_FAMILIES = ("tag16h5", "tag25h9", "tag36h11")
_TL_TR_BR_BL = [1, 0, 3, 2]
_PIXEL_EDGE_PX = 0.5  # AprilTag counts from the image's edge, not from a pixel's centre
_MIN_DECISION_MARGIN = 10.0  # grey levels; what noise decodes to stays below


class AprilTagDetector:
    """Markers of one AprilTag family. Slower than OpenCV, and sees smaller ones at once."""

    def __init__(self, family: str = "tag36h11"):
        """See `make_detector`."""
        dictionary(family)
        if family not in _FAMILIES:
            raise BadInput(
                "family", f"{family!r} is none of the apriltag detector's: {', '.join(_FAMILIES)}"
            )
        try:
            pyapriltags = importlib.import_module("pyapriltags")
        except ImportError as error:
            raise BadInput(
                "detector", "'apriltag' needs pyapriltags: pip install 'jaxnav[apriltag]'"
            ) from error
        self.family = family
        self._decoder = pyapriltags.Detector(families=family, nthreads=1, quad_decimate=1.0)

    def detect(
        self,
        image: np.ndarray,
        camera: Camera | None = None,
        predicted_corners_px: np.ndarray | None = None,
    ) -> Detections:
        """All markers of the family in the image: see `Detector.detect`.

        Predictions are not needed and not used.
        """
        del predicted_corners_px
        image = grey(image)
        found = [
            (int(tag.tag_id), np.asarray(tag.corners, float)[_TL_TR_BR_BL] - _PIXEL_EDGE_PX)
            for tag in self._decoder.detect(np.ascontiguousarray(image))
            if tag.decision_margin > _MIN_DECISION_MARGIN
        ]
        return refined_detections(image, found, self.family, camera)
