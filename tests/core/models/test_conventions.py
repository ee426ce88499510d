"""Corner orders, pixel origins and the frame of a tag, compared with the tools themselves."""

import cv2
import numpy as np
import pytest

from jaxnav.core.models.conventions import (
    APRILTAG_CORNERS,
    APRILTAG_FAMILIES,
    APRILTAG_FIRST_CORNER,
    APRILTAG_FIRST_CORNER_ON_OPENCV,
    APRILTAG_PIXEL_EDGE_PX,
    TL_TR_BR_BL,
    WXYZ_TAG_MARKER,
)
from jaxnav.detection import make_detector
from jaxnav.detection.families import dictionary
from jaxnav.files import poses
from jaxnav.files.markers import fit_square

SIDE_PX, MARGIN_PX = 160, 60
BOX_PX = np.array([[0, 0], [SIDE_PX, 0], [SIDE_PX, SIDE_PX], [0, SIDE_PX]]) + MARGIN_PX - 0.5


def opencv_picture(family: str, marker_id: int) -> np.ndarray:
    picture = cv2.aruco.generateImageMarker(dictionary(family), marker_id, SIDE_PX, borderBits=1)
    return np.pad(picture, MARGIN_PX, constant_values=255)


@pytest.mark.parametrize("family", APRILTAG_FAMILIES)
def test_apriltags_own_corners_become_those_of_the_picture(family):
    pyapriltags = pytest.importorskip("pyapriltags")
    decoder = pyapriltags.Detector(families=family, quad_decimate=1.0)
    for marker_id in (0, 7, 23):
        picture = opencv_picture(family, marker_id)
        upright = {
            APRILTAG_FIRST_CORNER_ON_OPENCV: picture,
            APRILTAG_FIRST_CORNER: np.ascontiguousarray(np.rot90(picture, 2)),
        }
        for first, image in upright.items():
            (tag,) = decoder.detect(image)
            assert tag.tag_id == marker_id
            corners_px = np.asarray(tag.corners)[TL_TR_BR_BL[first]] - APRILTAG_PIXEL_EDGE_PX
            np.testing.assert_allclose(corners_px, BOX_PX, atol=0.1)
    # Of its own picture, in sides from the centre, y up.
    half = (np.asarray(tag.corners) - tag.center) / SIDE_PX * [1, -1]
    np.testing.assert_allclose(half, APRILTAG_CORNERS, atol=1e-3)


@pytest.mark.parametrize("family", APRILTAG_FAMILIES)
def test_opencv_begins_at_the_top_left_of_its_own_picture(family):
    found = make_detector("aruco", family).detect(opencv_picture(family, 3))
    np.testing.assert_array_equal(found.ids, [3])
    np.testing.assert_allclose(found.corners_px[0], BOX_PX, atol=0.1)


def test_a_tag_that_hangs_as_wpilib_says_is_seen_where_our_marker_is():
    """FIRST's print, upright on the wall x = 0 of a field, seen by a camera that looks along -x."""
    half_m, f, c = 0.0826, 500.0, 200.0
    # Tag frame: x out of the tag, y to the right of its reader, z up.
    corners_tag_m = half_m * np.array([[0, -1, 1], [0, 1, 1], [0, 1, -1], [0, -1, -1]], float)
    apriltags_picture = np.ascontiguousarray(np.rot90(opencv_picture("tag36h11", 5), 2))

    def pixels(points_m: np.ndarray) -> np.ndarray:
        # The camera stands 1 m in front: its x is the tag's y, its y is -z.
        depth = 1 - points_m[:, 0]
        return np.c_[f * points_m[:, 1] / depth + c, -f * points_m[:, 2] / depth + c]

    H = cv2.getPerspectiveTransform(BOX_PX.astype(np.float32), pixels(corners_tag_m).astype("f4"))
    image = cv2.warpPerspective(
        apriltags_picture, H, (400, 400), flags=cv2.INTER_AREA, borderValue=255
    )
    found = make_detector("aruco", "tag36h11").detect(image)
    np.testing.assert_array_equal(found.ids, [5])

    R_tag_marker = poses.matrix(np.array([*WXYZ_TAG_MARKER, 0, 0, 0]))[:3, :3]
    corners_marker_m = half_m * np.array([[-1, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]], float)
    np.testing.assert_allclose(found.corners_px[0], pixels(corners_marker_m @ R_tag_marker.T),
                               atol=0.2)  # fmt: skip
    np.testing.assert_allclose(R_tag_marker[:, 2], [1, 0, 0], atol=1e-15)


def test_the_tag_in_our_frame_is_what_its_corners_say():
    # Our top left is the bottom right of AprilTag's picture, and so on round.
    corners_m = np.array([[0, 1, -1], [0, -1, -1], [0, -1, 1], [0, 1, 1]], float)
    T_tag_marker = fit_square(corners_m, 2.0)
    R = poses.matrix(T_tag_marker)[:3, :3]
    expected = poses.matrix(np.array([*WXYZ_TAG_MARKER, 0, 0, 0]))[:3, :3]
    np.testing.assert_allclose(R, expected, atol=1e-12)
