"""OpenCV's aruco decoder, with a closer look at quadrilaterals that it can't read."""

from collections.abc import Collection, Iterator
from itertools import islice

import cv2
import numpy as np
from jaxtyping import Float, Shaped

from jaxnav.core.models.camera import Camera
from jaxnav.detection.crowd import thin_crowd
from jaxnav.detection.families import decoder_parameters, dictionary
from jaxnav.detection.lens import Lens
from jaxnav.detection.read import frames_first, read_marker
from jaxnav.detection.refine import mean_side_px
from jaxnav.detection.types import Detections, at_scale, grey, refine_detections

# Quadrilaterals with sides in this range get a closer look.
_CLOSER_LOOK_PX = (8.0, 150.0)
_LOOKS_IN_A_CROWD = 3  # closer looks, 10 ms each
_ENLARGE_UP_TO_PX = 40.0
_ENLARGE = 3
_PERIMETER_RATE = 0.03  # OpenCV's least perimeter, over the longer side of the image
_SMALLEST = 0.6  # least perimeter, over the predicted one
_SAME_PLACE_PX = 0.5  # quadrilaterals whose centres are nearer to each other count as one
# A prediction may be off by this part of its side, and by some pixels.
_SEARCH_SIDES, _SEARCH_PX = 0.5, 8


class ArucoDetector:
    """Detects markers of one family by OpenCV's decoder and fits their corners by `refine`.

    The decoder's own corner refinement is off. `read` reads the quadrilaterals that the decoder
    finds but can't read, also those in a threefold enlargement around the predictions.
    """

    def __init__(
        self,
        family: str = "tag36h11",
        ids: Collection[int] | None = None,
        closer_looks: int = 12,
    ):
        """See `make_detector`.

        Args:
            family, ids: as there.
            closer_looks: most quadrilaterals of an image to look at again, some ms each.
        """
        self.family = family
        self.ids = None if ids is None else frozenset(ids)
        self._closer_looks = closer_looks
        self._decoders: dict[float, cv2.aruco.ArucoDetector] = {}
        self._decoder(0.0)

    def detect(
        self,
        image: Shaped[np.ndarray, "..."],
        camera: Camera | None = None,
        predicted_corners_px: Float[np.ndarray, "K 4 2"] | None = None,
    ) -> Detections:
        """Detect all markers of the family in the image: see `Detector.detect`."""
        image = grey(image)
        markers, unread = self._decode(image)
        quads = np.zeros((0, 4, 2)) if predicted_corners_px is None else predicted_corners_px
        for quad in np.asarray(quads, float).reshape(-1, 4, 2):
            if np.all(np.isfinite(quad)) and not _is_among(quad, markers):
                side_px, unread = mean_side_px(quad), [quad, *unread]
                if side_px <= _ENLARGE_UP_TO_PX:
                    margin_px = _SEARCH_SIDES * side_px + _SEARCH_PX
                    there, left = self._decode_region(image, quad, margin_px)
                    markers += [one for one in there if not _is_among(one[1], markers)]
                    unread[1:1] = left
        if self.ids is not None and self.ids <= {marker_id for marker_id, _ in markers}:
            unread = []  # all that matter are read
        for one in self._read(image, camera, unread, markers, self._closer_looks):
            markers.append(one)
        return refine_detections(image, markers, self.family, camera, self.ids)

    def detect_near(
        self,
        image: Shaped[np.ndarray, "..."],
        camera: Camera | None,
        quads_px: Float[np.ndarray, "K 4 2"],
        radius_px: Float[np.ndarray, " K"],
    ) -> Detections:
        """Detect markers near their expected places: see `RegionDetector`."""
        image = grey(image)
        markers: list[tuple[int, np.ndarray]] = []
        unread: list[np.ndarray] = []
        for quad, radius in zip(quads_px, radius_px, strict=True):
            if np.all(np.isfinite(quad)) and np.isfinite(radius):
                margin_px = _SEARCH_SIDES * mean_side_px(quad) + float(radius)
                there, left = self._decode_region(image, quad, margin_px)
                markers += [one for one in there if not _is_among(one[1], markers)]
                unread += left
        if not markers:
            markers += islice(self._read(image, camera, unread, markers, 2), 1)
        return refine_detections(image, markers, self.family, camera, self.ids)

    def _read(
        self,
        image: np.ndarray,
        camera: Camera | None,
        unread: list[np.ndarray],
        markers: list[tuple[int, np.ndarray]],
        looks: int,
    ) -> Iterator[tuple[int, np.ndarray]]:
        """The markers in the clearest of the unread quadrilaterals, but where others are."""
        lens = Lens(camera)
        for quad in frames_first(image, _worth_a_look(unread))[:looks]:
            if not _is_among(quad, markers):
                read = read_marker(image, quad, self.family, lens)
                if read is not None:
                    yield read[0], read[1].corners_px

    def _decoder(self, perimeter_rate: float) -> cv2.aruco.ArucoDetector:
        """The decoder whose least perimeter is this part of the image's longer side."""
        if perimeter_rate not in self._decoders:
            parameters = decoder_parameters(max(perimeter_rate, _PERIMETER_RATE))
            self._decoders[perimeter_rate] = cv2.aruco.ArucoDetector(
                dictionary(self.family), parameters
            )
        return self._decoders[perimeter_rate]

    def _decode(
        self, image: np.ndarray, perimeter_rate: float = 0.0
    ) -> tuple[list[tuple[int, np.ndarray]], list[np.ndarray]]:
        """Decode by OpenCV: (id, corners) of each marker, and the quadrilaterals it can't read."""
        least_px = max(perimeter_rate, _PERIMETER_RATE) * max(image.shape)
        left = thin_crowd(image, self.family, least_px)
        quads, ids, unread = self._decoder(perimeter_rate).detectMarkers(left)
        marker_ids = [] if ids is None else [int(i) for i in ids.ravel()]
        markers = [
            (i, quad.reshape(4, 2).astype(float)) for i, quad in zip(marker_ids, quads, strict=True)
        ]
        others = [quad.reshape(4, 2).astype(float) for quad in unread]
        if left is not image:
            others = frames_first(image, _worth_a_look(others))[:_LOOKS_IN_A_CROWD]
        return markers, others

    def _decode_region(
        self, image: np.ndarray, quad: np.ndarray, margin_px: float
    ) -> tuple[list[tuple[int, np.ndarray]], list[np.ndarray]]:
        """Run `_decode` on the region around a quadrilateral, enlarged if that is small."""
        low = np.maximum(np.floor(quad.min(axis=0) - margin_px), 0).astype(int)
        high = np.minimum(np.ceil(quad.max(axis=0) + margin_px), image.shape[::-1]).astype(int)
        if np.any(high - low < 8):
            return [], []
        side_px = mean_side_px(quad)
        # The marker's cells are smaller than this; OpenCV would spend over 1 ms on each.
        perimeter_rate = _SMALLEST * 4 * side_px / max(high - low)
        scale = _ENLARGE if side_px <= _ENLARGE_UP_TO_PX else 1
        region, in_region = at_scale(image[low[1] : high[1], low[0] : high[0]], scale)
        markers, unread = self._decode(region, np.floor(10 * perimeter_rate) / 10)

        def back(corners: np.ndarray) -> np.ndarray:
            return in_region(corners) + low

        return [(i, back(corners)) for i, corners in markers], [back(corners) for corners in unread]


def _worth_a_look(quads: list[np.ndarray]) -> list[np.ndarray]:
    """The quadrilaterals that are neither too small nor too large, one for each place."""
    if not quads:
        return []
    corners = np.stack(quads)
    sides_px = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean(axis=1)
    centers = corners.mean(axis=1)
    smallest, largest = _CLOSER_LOOK_PX
    left = np.flatnonzero((sides_px >= smallest) & (sides_px <= largest))
    kept: list[np.ndarray] = []
    while len(left):
        kept.append(quads[left[0]])
        apart_px = np.abs(centers[left] - centers[left[0]]).max(axis=1)
        left = left[apart_px >= _SAME_PLACE_PX]
    return kept


def _is_among(quad: np.ndarray, markers: list[tuple[int, np.ndarray]]) -> bool:
    """Whether one of the markers is where the quadrilateral is."""
    return any(
        np.linalg.norm(quad.mean(axis=0) - corners.mean(axis=0))
        < 0.5 * max(mean_side_px(quad), mean_side_px(corners))
        for _, corners in markers
    )
