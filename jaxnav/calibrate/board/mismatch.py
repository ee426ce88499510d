"""Diagnosis of images in which the board is not found: what they show instead."""

from collections.abc import Sequence

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxnav.calibrate.board.board import Board
from jaxnav.calibrate.board.detection import BoardLook
from jaxnav.detection.families import LARGEST_FAMILIES, dictionary

_MANY = 4  # markers in an image; fewer may be chance


def what_is_seen(
    board: Board,
    looks: Sequence[BoardLook],
    examples: Sequence[UInt8[np.ndarray, "rows columns"]],
    foreign: Sequence[int],
) -> str:
    """Explain to a person in one line why the board is not found, and what to do.

    Args:
        board: the board that was looked for.
        looks: the result for every image.
        examples: some of the images without the board, (H, W) grey.
        foreign: ids that are often seen and not on the board.
    """
    own = sorted({marker_id for look in looks for marker_id in look.own_ids})
    images = f"{len(looks)} image{'s' * (len(looks) != 1)}"
    if foreign:
        return (
            f"markers {_listed(foreign)} of {board.family} are seen, which are not on the "
            f"{board}: describe the board that is in the images"
        )
    if len(own) >= _MANY:
        return (
            f"markers {_listed(own)} are seen, but not arranged as on the {board}: check its kind, "
            "columns and rows"
        )
    if board.kind == "chessboard":
        other = _largest_chessboard(examples)
        if other is not None and sorted(other) != sorted((board.columns, board.rows)):
            return (
                f"shows a chessboard of {other[0]} x {other[1]} squares, not the {board}: count "
                "the squares, not the corners between them"
            )
    elif not board.has_discs:
        other_code = _other_code(board, examples)
        if other_code is not None:
            return f"shows {other_code}, not the {board}: describe the board that is in the images"
    whole = ""
    if board.kind == "chessboard" or board.has_discs:
        whole = f" All of a {'chessboard' if not board.has_discs else 'grid'} must be in the image."
    return (
        f"no {board} is found in {images}: is it the right board, sharp, with white around it, and "
        f"at least some 20 px a square?{whole}"
    )


def _listed(ids: Sequence[int], most: int = 6) -> str:
    listed = ", ".join(str(marker_id) for marker_id in ids[:most])
    return listed if len(ids) <= most else f"{listed}, ..."


def _largest_chessboard(examples: Sequence[np.ndarray]) -> tuple[int, int] | None:
    """Columns and rows, in squares, of the largest chessboard in the images."""
    best: tuple[int, int] | None = None
    flags = cv2.CALIB_CB_LARGER | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
    for image in examples:
        success, _, meta = cv2.findChessboardCornersSBWithMeta(image, (3, 3), flags)
        if success:
            rows, columns = np.asarray(meta).shape
            if best is None or rows * columns > (best[0] - 1) * (best[1] - 1):
                best = (columns + 1, rows + 1)
    return best


def _other_code(board: Board, examples: Sequence[np.ndarray]) -> str | None:
    """Name in words the marker family that the images show instead."""
    most, named = _MANY - 1, None
    for family in LARGEST_FAMILIES:
        for border in (1, 2):
            parameters = cv2.aruco.DetectorParameters()
            parameters.markerBorderBits = border
            parameters.errorCorrectionRate = 0.0
            decoder = cv2.aruco.ArucoDetector(dictionary(family), parameters)
            for image in examples:
                _, ids, _ = decoder.detectMarkers(image)
                if ids is not None and len(ids) > most:
                    most = len(ids)
                    named = f"markers of {family} with a frame of {border} cell{'s' * (border > 1)}"
    return named
