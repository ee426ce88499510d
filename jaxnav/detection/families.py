"""The marker families that OpenCV knows: their names, dictionaries and black-and-white cells."""

from functools import cache

import cv2
import numpy as np
from jaxtyping import Float, UInt8

from jaxnav.core.models.markers import FAMILY_SIZES, opencv_dictionary_name
from jaxnav.errors import BadInput

# Of each kind of code the family that holds the smaller ones.
LARGEST_FAMILIES = (
    "tag36h11", "tag25h9", "tag16h5", "4x4_1000", "5x5_1000", "6x6_1000", "7x7_1000",
    "aruco_original", "aruco_mip_36h12",
)  # fmt: skip


def dictionary(family: str) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary for a family.

    Raises:
        BadInput: the family is unknown.
    """
    if family not in FAMILY_SIZES:
        raise BadInput("family", f"unknown {family!r}: expected one of {', '.join(FAMILY_SIZES)}")
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, opencv_dictionary_name(family)))


def decoder_parameters(perimeter_rate: float) -> cv2.aruco.DetectorParameters:
    """Of OpenCV's decoder, which leaves the corners as it finds them.

    Args:
        perimeter_rate: least perimeter of a marker, over the longer side of the image.
    """
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_NONE
    # With the default, the paper's outline swallows the marker: 3 of 10 frames are lost.
    parameters.minMarkerDistanceRate = 0.02
    parameters.minDistanceToBorder = 1  # with the default of 3, whole markers are left out
    parameters.minMarkerPerimeterRate = perimeter_rate
    return parameters


@cache
def all_cells(family: str) -> Float[np.ndarray, "ids n n"]:
    """Cells of all markers of a family with their black frames, (ids, n, n) float."""
    codes = dictionary(family)
    n = codes.markerSize + 2
    cells = [
        cv2.aruco.generateImageMarker(codes, marker_id, n, borderBits=1) > 127
        for marker_id in range(len(codes.bytesList))
    ]
    return np.array(cells, float)


def marker_cells(family: str, marker_id: int) -> Float[np.ndarray, "n n"]:
    """Cells of a marker with its black frame, (n, n) float: 1 white, 0 black, top row first."""
    return all_cells(family)[marker_id]


def printed(
    family: str, marker_id: int, cell_px: int
) -> tuple[UInt8[np.ndarray, "side side"], Float[np.ndarray, "4 2"]]:
    """A picture of a marker and its white zone, and where its corners are, TL TR BR BL."""
    cells = np.pad(marker_cells(family, marker_id), 1, constant_values=1)
    levels = np.where(cells == 1, 200, 30).astype(np.uint8)
    low, high = cell_px - 0.5, cell_px * (len(cells) - 1) - 0.5
    quad_px = np.array([[low, low], [high, low], [high, high], [low, high]])
    return np.kron(levels, np.ones((cell_px, cell_px), np.uint8)), quad_px


@cache
def codes_of(family: str) -> Float[np.ndarray, "codes cells"]:
    """Ink inside the frame, (4 * ids, cells): each marker after 0..3 quarter turns."""
    inner = 1 - all_cells(family)[:, 1:-1, 1:-1]
    # After k clockwise turns, the marker's own top-left corner is corner k of the image.
    turned = [np.rot90(inner, -k, axes=(1, 2)) for k in range(4)]
    return np.stack(turned, axis=1).reshape(4 * len(inner), -1)
