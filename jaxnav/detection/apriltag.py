"""AprilTag's own detector through pyapriltags, with corners fitted by `refine`."""

import importlib
from collections.abc import Collection

import numpy as np
from jaxtyping import Float, Shaped

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.conventions import (
    APRILTAG_FAMILIES,
    APRILTAG_FIRST_CORNER_ON_OPENCV,
    APRILTAG_PIXEL_EDGE_PX,
    TL_TR_BR_BL,
)
from jaxnav.detection.families import dictionary
from jaxnav.detection.types import Detections, grey, refine_detections
from jaxnav.errors import BadInput

_TO_OURS = TL_TR_BR_BL[APRILTAG_FIRST_CORNER_ON_OPENCV]
_MIN_DECISION_MARGIN = 10.0  # grey levels; tags decoded from noise stay below


class AprilTagDetector:
    """Detects markers of one AprilTag family. Slower than OpenCV, but finds small ones at once."""

    def __init__(self, family: str = "tag36h11", ids: Collection[int] | None = None):
        """See `make_detector`."""
        dictionary(family)
        if family not in APRILTAG_FAMILIES:
            known = ", ".join(APRILTAG_FAMILIES)
            raise BadInput("family", f"{family!r} is none of the apriltag detector's: {known}")
        try:
            pyapriltags = importlib.import_module("pyapriltags")
        except ImportError as error:
            raise BadInput(
                "detector", "'apriltag' needs pyapriltags: pip install 'jaxnav[apriltag]'"
            ) from error
        self.family, self.ids = family, ids
        self._decoder = pyapriltags.Detector(families=family, nthreads=1, quad_decimate=1.0)

    def detect(
        self,
        image: Shaped[np.ndarray, "..."],
        camera: Camera | None = None,
        predicted_corners_px: Float[np.ndarray, "K 4 2"] | None = None,
    ) -> Detections:
        """Detect all markers of the family in the image: see `Detector.detect`.

        Predictions are not needed and not used.
        """
        del predicted_corners_px
        image = grey(image)
        markers = [
            (int(tag.tag_id), np.asarray(tag.corners, float)[_TO_OURS] - APRILTAG_PIXEL_EDGE_PX)
            for tag in self._decoder.detect(np.ascontiguousarray(image))
            if tag.decision_margin > _MIN_DECISION_MARGIN
        ]
        return refine_detections(image, markers, self.family, camera, self.ids)
