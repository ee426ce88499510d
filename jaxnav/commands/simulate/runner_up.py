"""What people use otherwise, for comparison: OpenCV's corners, and the first of the two poses.

`cv2.aruco.ArucoDetector` finds the markers and refines their corners, IPPE gives two poses of each,
and the one of lower reprojection error is taken: what `cv2.solvePnPGeneric` with
`SOLVEPNP_IPPE_SQUARE` returns first. Of our selectors that is "lowest-reprojection", whose poses
come from the same IPPE; it stands on the same filter as our method, with its gate and its restart.

Source: Garrido-Jurado et al. (2014); Collins and Bartoli (2014); OpenCV's documentation of both.
"""

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from jaxnav.core.models.camera import Camera
from jaxnav.core.models.markers import MarkerMap
from jaxnav.detection import Detections
from jaxnav.detection.families import dictionary
from jaxnav.detection.types import grey

SELECTOR = "lowest-reprojection"
# RMS along one axis in the demo's images, against the rendered truth: see docs/guide/demo.md.
SIGMA_PX = 0.5


class OpenCVDetector:
    """Detects markers of one family as OpenCV does by itself, with its usual settings.

    Of its ways to refine corners it has the one that errs least in these images, subpixel.
    """

    ids = None  # all of them

    def __init__(self, family: str):
        """See `make_detector`."""
        self.family = family
        parameters = cv2.aruco.DetectorParameters()
        parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
        self._detector = cv2.aruco.ArucoDetector(dictionary(family), parameters)

    def detect(
        self,
        image: Shaped[np.ndarray, "..."],
        camera: Camera | None = None,
        predicted_corners_px: Float[np.ndarray, "K 4 2"] | None = None,
    ) -> Detections:
        """Detect all markers of the family in the image: see `Detector.detect`.

        Neither the lens nor predictions are used.
        """
        del camera, predicted_corners_px
        quads, ids, _ = self._detector.detectMarkers(grey(image))
        count = len(quads)
        return Detections(
            ids=np.zeros(0, int) if ids is None else np.asarray(ids, int).ravel(),
            corners_px=np.array(quads, float).reshape(count, 4, 2),
            sigma_px=np.full((count, 4), SIGMA_PX),
            refined=np.ones(count, bool),
            families=(self.family,) * count,
        )


def opencv_detectors(markers: MarkerMap) -> list[OpenCVDetector]:
    """A detector for each family of a map, as `make_detectors`."""
    return [OpenCVDetector(family) for family in sorted(set(markers.families))]
