"""Detection of a board's tags in an image: their ids, and their corners to a pixel."""

from dataclasses import replace

import cv2
import numpy as np
from jaxtyping import Float, Int, UInt8

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.places import mapped
from jaxnav.detection.families import dictionary
from jaxnav.detection.types import at_scale

# Where fewer than this part of the tags are read, the image is read again at twice its size.
_FEW = 0.5
_MAX_CORRECTION = 0.4  # part of the bits that a family can correct
_TAGS_AROUND = 4  # a tag is predicted from so many others
_MOST_STRAY = 2.0  # that one tag, misread perhaps, counts for
_OTHER = 0.5  # of a board's strays: a layout with less is the one that is printed


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
        seen_larger, twice_larger = _decoded(decoder, image, 2)
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


def as_printed(
    board: Board, places: Int[np.ndarray, " N"], corners_px: Float[np.ndarray, "N 4 2"]
) -> Board:
    """The board, or its legacy twin, whichever has its tags where they are seen.

    Args:
        places: of N tags the indices into `Board.tags`, which both have alike.
        corners_px: of these tags.
    """
    if board.kind != "charuco" or board.rows % 2:
        return board
    twin = replace(board, white_top_left=not board.white_top_left)
    strays = [_stray(one, places, corners_px) for one in (board, twin)]
    return twin if strays[1] < _OTHER * strays[0] else board


def _stray(board: Board, places: np.ndarray, corners_px: np.ndarray) -> float:
    """Mean distance of a tag from where its nearest tags predict it, in sides of a tag.

    On an odd number of columns the twin has all tags a column further, but for those that begin
    another row: it is they who tell.
    """
    corners_m = np.reshape([board.tags[place].corners_board_m for place in places], (-1, 4, 2))
    centres_m = corners_m.mean(axis=1)
    strays: list[float] = []
    for index, centre_m in enumerate(centres_m):
        apart_m = np.linalg.norm(centres_m - centre_m, axis=1)
        near = np.argsort(apart_m, kind="stable")[1 : _TAGS_AROUND + 1]
        if len(near) == _TAGS_AROUND:
            known_m, known_px = (
                corners[near].reshape(-1, 2) for corners in (corners_m, corners_px)
            )
            at = mapped(known_m / board.size_m, known_px, corners_m[index] / board.size_m)
            if at is not None:
                off_px = np.linalg.norm(at - corners_px[index], axis=1).mean()
                side_px = np.linalg.norm(np.diff(corners_px[index], axis=0), axis=1).mean()
                strays.append(min(off_px / side_px, _MOST_STRAY))
    return float(np.mean(strays)) if strays else np.inf


def _decoded(
    decoder: cv2.aruco.ArucoDetector, image: np.ndarray, scale: int
) -> tuple[dict[int, np.ndarray], set[int]]:
    """Corners (4, 2) by id, read in the image at another size, and the ids seen twice."""
    scaled, back = at_scale(image, scale)
    quads, ids, _ = decoder.detectMarkers(scaled)
    seen: dict[int, np.ndarray] = {}
    twice: set[int] = set()
    for marker_id, quad in zip(
        [int(i) for i in np.ravel([] if ids is None else ids)], quads, strict=True
    ):
        if marker_id in seen:
            twice.add(marker_id)
        seen[marker_id] = back(quad.reshape(4, 2).astype(float))
    return seen, twice
