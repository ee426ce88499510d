"""Detection of a board's tags in an image: their ids, and their corners to a pixel."""

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxnav.calibration.boards.board import Board
from jaxnav.detection.families import dictionary

# Where fewer than this part of the tags are read, the image is read again at twice its size.
_FEW = 0.5
_MAX_CORRECTION = 0.4  # part of the bits that a family can correct


def read_tags(
    board: Board, image: UInt8[np.ndarray, "rows columns"]
) -> tuple[Int[np.ndarray, " N"], Float[np.ndarray, "N 4 2"], tuple[int, ...]]:
    """Read the tags of a charuco board or an aprilgrid in an image (H, W) by OpenCV's decoder.

    Returns:
        Of N tags the indices (N,) into `Board.tags` and the corners (N, 4, 2), px, TL TR BR BL; and
        the ids that were read, but are not on the board.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    parameters.markerBorderBits = board.border_cells
    parameters.minMarkerDistanceRate = 0.02
    parameters.minMarkerPerimeterRate = 0.01
    parameters.errorCorrectionRate = _MAX_CORRECTION
    decoder = cv2.aruco.ArucoDetector(dictionary(board.family), parameters)
    seen, twice = _decoded(decoder, image, 1)
    if len(seen) < _FEW * board.tag_count:
        larger = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        seen_larger, twice_larger = _decoded(decoder, larger, 2)
        seen, twice = seen_larger | seen, twice | twice_larger
    place_of = {tag.id: place for place, tag in enumerate(board.tags)}
    own = sorted(marker_id for marker_id in seen if marker_id in place_of)
    own = [marker_id for marker_id in own if marker_id not in twice]
    places = np.array([place_of[marker_id] for marker_id in own], int)
    corners = [
        np.roll(seen[marker_id], -board.tags[place].turns, axis=0)
        for marker_id, place in zip(own, places, strict=True)
    ]
    return (
        places,
        np.array(corners, float).reshape(-1, 4, 2),
        tuple(sorted(marker_id for marker_id in seen if marker_id not in place_of)),
    )


def _decoded(
    decoder: cv2.aruco.ArucoDetector, image: np.ndarray, scale: int
) -> tuple[dict[int, np.ndarray], set[int]]:
    """Corners (4, 2) by id in pixels of the image before enlargement, and the ids seen twice."""
    quads, ids, _ = decoder.detectMarkers(image)
    seen: dict[int, np.ndarray] = {}
    twice: set[int] = set()
    for marker_id, quad in zip(
        [int(i) for i in np.ravel([] if ids is None else ids)], quads, strict=True
    ):
        if marker_id in seen:
            twice.add(marker_id)
        seen[marker_id] = (quad.reshape(4, 2).astype(float) + 0.5) / scale - 0.5
    return seen, twice
