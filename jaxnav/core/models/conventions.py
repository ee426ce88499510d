"""Corner orders and frames of other tools, against ours: written down here and nowhere else.

Ours: corners go top-left, top-right, bottom-right, bottom-left as a reader sees them, which is the
order of OpenCV's aruco; the centre of the top-left pixel is (0, 0), as OpenCV counts; the marker is
x right, y up, z towards its reader; the vehicle is x forward, y left, z up.

AprilTag's C library counts corners anticlockwise from the bottom left of its own picture of a tag,
and pixels from the image's edge. OpenCV's picture of the same tag (DICT_APRILTAG_16h5, 25h9, 36h11)
stands on its head: there AprilTag begins at the top right. jaxnav's detectors, and so the maps that
go with them, see OpenCV's picture.

WPILib's field layout hangs AprilTag's picture upright: the tag's x axis points out of it, y to the
right of its reader, z up. A tag without rotation faces +x of the field.

Kalibr's `imu` is our vehicle; its cameras are ours.
"""

from typing import Literal

FirstCorner = Literal["bottom_left", "top_right"]

# Corners that go anticlockwise from the first corner -> TL TR BR BL.
TL_TR_BR_BL: dict[FirstCorner, list[int]] = {
    "bottom_left": [3, 2, 1, 0],
    "top_right": [1, 0, 3, 2],
}
# Where AprilTag's library begins on its own picture, and on OpenCV's.
APRILTAG_FIRST_CORNER: FirstCorner = "bottom_left"
APRILTAG_FIRST_CORNER_ON_OPENCV: FirstCorner = "top_right"
# Its corners on its own picture in the order in which it gives them, in sides from the centre.
APRILTAG_CORNERS = [[-0.5, -0.5], [0.5, -0.5], [0.5, 0.5], [-0.5, 0.5]]
# What AprilTag's library calls (0.5, 0.5) is (0, 0): to be taken off its pixels.
APRILTAG_PIXEL_EDGE_PX = 0.5

# The families that AprilTag's library and WPILib have, and OpenCV too.
APRILTAG_FAMILIES = ("tag16h5", "tag25h9", "tag36h11")

# WPILib's tag and our marker of the same print, wxyz: x of the marker is -y of the tag, y is -z and
# z is x. (0.5, 0.5, 0.5, 0.5) would do for AprilTag's picture; OpenCV's is half a turn about z on.
WXYZ_TAG_MARKER = (0.5, -0.5, 0.5, -0.5)
