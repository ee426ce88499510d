"""The marker families OpenCV knows: names, dictionaries and black-and-white cells."""

from functools import cache

import cv2
import numpy as np

from jaxnav.errors import BadInput

# AprilTag families keep AprilTag's names; ArUco ones are OpenCV's, in lower case, without DICT_.
DICTIONARIES: dict[str, int] = {
    "tag16h5": cv2.aruco.DICT_APRILTAG_16h5,
    "tag25h9": cv2.aruco.DICT_APRILTAG_25h9,
    "tag36h10": cv2.aruco.DICT_APRILTAG_36h10,
    "tag36h11": cv2.aruco.DICT_APRILTAG_36h11,
    "aruco_original": cv2.aruco.DICT_ARUCO_ORIGINAL,
    "aruco_mip_36h12": cv2.aruco.DICT_ARUCO_MIP_36h12,
} | {
    f"{bits}x{bits}_{count}": getattr(cv2.aruco, f"DICT_{bits}X{bits}_{count}")
    for bits in (4, 5, 6, 7)
    for count in (50, 100, 250, 1000)
}


def dictionary(family: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family.

    Raises:
        BadInput: the family is unknown.
    """
    if family not in DICTIONARIES:
        raise BadInput("family", f"unknown {family!r}: expected one of {', '.join(DICTIONARIES)}")
    return cv2.aruco.getPredefinedDictionary(DICTIONARIES[family])


@cache
def all_cells(family: str) -> np.ndarray:
    """Cells of all markers of a family, (ids, n, n) float, with their black frame."""
    codes = dictionary(family)
    n = codes.markerSize + 2
    cells = [
        cv2.aruco.generateImageMarker(codes, marker_id, n, borderBits=1) > 127
        for marker_id in range(len(codes.bytesList))
    ]
    return np.array(cells, float)


def marker_cells(family: str, marker_id: int) -> np.ndarray:
    """Cells of a marker with its black frame, (n, n) float: 1 white, 0 black, top row first."""
    return all_cells(family)[marker_id]
