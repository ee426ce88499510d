"""Find markers in a blurred image that no decoder reads, with no prediction of their places.

The image is restored for the likeliest motions, see `restore`, and a decoder that knows the sought
ids alone reads it with many errors allowed. What it reads is only proposed: `track` then fits the
whole pattern to the raw pixels, and decides.
"""

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Shaped, UInt8

from jaxnav.core.models.camera import Camera
from jaxnav.detection.crowd import thin_crowd
from jaxnav.detection.families import all_cells, decoder_parameters, dictionary
from jaxnav.detection.restore import BlurredImage, likely_motions
from jaxnav.detection.track import Target, track
from jaxnav.detection.tracker import detections_of
from jaxnav.detection.types import Detections, at_scale, grey

_MOTIONS = 4  # for which an image is restored, at most
_ENLARGE = 2
_MOST_PIXELS = 1e6
_ERRORS = 6  # one bit of so many may be wrong
_FRAME_ERRORS = 0.4  # of the frame's cells
_PERIMETER_RATE = 0.03
_OFF_PX = 4.0  # a corner in a restored image, at most
_STREAK_SIGMA_PX = 1.5
_MOST_PROPOSED = 4  # a motion: each takes some milliseconds


class Acquirer:
    """Finds markers of known ids in blurred images. Not safe for several threads."""

    def __init__(self, keys: Sequence[tuple[str, int]]):
        """Args:
        keys: family and id of each marker.
        """
        self._ids = {
            family: sorted({i for name, i in keys if name == family})
            for family in sorted({name for name, _ in keys})
        }
        self._decoders = {family: _decoder(family, ids) for family, ids in self._ids.items()}

    def detect(self, image: Shaped[np.ndarray, "..."], camera: Camera | None = None) -> Detections:
        """The markers that the first restored image with any of them shows.

        Args:
            image: as in `Detector.detect`, like `camera`; a large one is halved, and again.
        """
        image, scale = grey(image), 1.0
        while scale**2 * image.size > _MOST_PIXELS:
            scale /= 2
        if scale < 1 and camera is not None:
            center_px = scale * (camera.center_px + 0.5) - 0.5
            camera = replace(camera, focal_px=scale * camera.focal_px, center_px=center_px)
        small, in_image = at_scale(image, scale)
        found = self._found(small, camera).once_each()
        corners_px = in_image(found.corners_px)
        return replace(found, corners_px=corners_px, sigma_px=found.sigma_px / scale)

    def _found(self, image: np.ndarray, camera: Camera | None) -> Detections:
        blurred = BlurredImage(image)
        for motion in likely_motions(image)[:_MOTIONS]:
            restored, in_image = at_scale(blurred.restored(motion), _ENLARGE)
            targets = [
                Target(*key, in_image(quad_px)[None], _OFF_PX, motion.streak_px, _STREAK_SIGMA_PX)
                for key, quad_px in self._proposed(restored)
            ]
            found = [seen for seen in track(image, camera, targets) if seen is not None]
            if found:
                return detections_of(found)
        return Detections.concatenate([])

    def _proposed(self, image: np.ndarray) -> list[tuple[tuple[str, int], np.ndarray]]:
        """Family, id and corners of what may be a marker."""
        proposed = []
        for family, ids in self._ids.items():
            left = thin_crowd(image, family, _PERIMETER_RATE * max(image.shape))
            quads, places, _ = self._decoders[family].detectMarkers(left)
            if places is not None:
                corners_px = np.reshape(quads, (-1, 4, 2)).astype(float)
                keys = [(family, ids[int(k)]) for k in places.ravel()]
                proposed += list(zip(keys, corners_px, strict=True))
        return proposed[:_MOST_PROPOSED]


def acquire_in_photograph(
    image: UInt8[np.ndarray, "rows columns *channels"], camera: Camera, family: str
) -> Detections:
    """Any markers of a family in a blurred photograph."""
    keys = [(family, marker_id) for marker_id in range(len(all_cells(family)))]
    return Acquirer(keys).detect(image, camera)


def _decoder(family: str, ids: Sequence[int]) -> cv2.aruco.ArucoDetector:
    """A decoder of those ids: with fewer to compare it is ten times as fast."""
    whole = dictionary(family)
    side = whole.markerSize
    few = cv2.aruco.Dictionary(whole.bytesList[np.array(ids)], side, max(side**2 // _ERRORS, 1))
    parameters = decoder_parameters(_PERIMETER_RATE)
    parameters.errorCorrectionRate = 1.0
    parameters.maxErroneousBitsInBorderRate = _FRAME_ERRORS
    return cv2.aruco.ArucoDetector(few, parameters)
