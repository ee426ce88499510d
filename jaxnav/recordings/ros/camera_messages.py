"""Convert ROS messages of cameras to corners and images.

    apriltag_msgs/AprilTagDetectionArray   apriltag_ros 2: pixels counted from the image's edge
    apriltag_msgs/ApriltagArrayStamped     TagSLAM: pixels as its calibration counts them
    sensor_msgs/Image, CompressedImage     8 bit, grey, colour or Bayer

Corners are in the image that the detector was given. apriltag_ros takes a rectified image: its
camera in the rig is one without lens.
"""

from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from jaxtyping import UInt8

from jaxnav.core.models.conventions import APRILTAG_PIXEL_EDGE_PX, TL_TR_BR_BL, FirstCorner
from jaxnav.detection.types import Detections
from jaxnav.files.images import decode_image
from jaxnav.recordings.ros import message_type

APRILTAG_ROS = "apriltag_msgs/msg/AprilTagDetectionArray"
TAGSLAM = "apriltag_msgs/msg/ApriltagArrayStamped"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"
CAMERA_TYPES = (APRILTAG_ROS, TAGSLAM, IMAGE, COMPRESSED)

# Name in ROS -> channels, and OpenCV's conversion to grey. OpenCV names a Bayer pattern after its
# second row and column.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, cv2.COLOR_BGR2GRAY),
    "8UC3": (3, cv2.COLOR_BGR2GRAY),
    "rgb8": (3, cv2.COLOR_RGB2GRAY),
    "bgra8": (4, cv2.COLOR_BGRA2GRAY),
    "rgba8": (4, cv2.COLOR_RGBA2GRAY),
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2GRAY),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2GRAY),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2GRAY),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2GRAY),
}


def detections(
    kind: str, message: Any, first_corner: FirstCorner, sigma_px: float, families: Mapping[int, str]
) -> Detections:
    """The markers in a message of `APRILTAG_ROS` or `TAGSLAM`.

    Args:
        sigma_px: of every corner, along one axis.
        families: id in the map -> family, which TagSLAM's messages do not tell.

    Raises:
        ValueError: a marker does not have four corners.
    """
    tags = message.detections if kind == APRILTAG_ROS else message.apriltags
    corners_px = np.zeros((len(tags), 4, 2))
    for row, tag in enumerate(tags):
        if len(tag.corners) != 4:
            raise ValueError(f"a detection of marker {tag.id} has {len(tag.corners)} corners")
        corners_px[row] = [(corner.x, corner.y) for corner in tag.corners]
    ids = [int(tag.id) for tag in tags]
    return Detections(
        ids=np.array(ids, int),
        corners_px=corners_px[:, TL_TR_BR_BL[first_corner]]
        - (APRILTAG_PIXEL_EDGE_PX if kind == APRILTAG_ROS else 0.0),
        sigma_px=np.full((len(tags), 4), sigma_px),
        refined=np.ones(len(tags), bool),
        families=tuple(
            str(tag.family) if kind == APRILTAG_ROS else families.get(i, "")
            for tag, i in zip(tags, ids, strict=True)
        ),
    )


def detections_message(found: Detections, stamp: Any) -> Any:
    """The `APRILTAG_ROS` of detections, its corners from the bottom left on, as the tag's own.

    Raises:
        ImportError: its package is not there.
    """
    message, tag, point = (
        message_type(kind)
        for kind in (APRILTAG_ROS, "apriltag_msgs/msg/AprilTagDetection", "apriltag_msgs/msg/Point")
    )
    order = np.argsort(TL_TR_BR_BL["bottom_left"])
    places_px = found.corners_px[:, order] + APRILTAG_PIXEL_EDGE_PX
    filled = message()
    filled.header.stamp = stamp
    filled.detections = [
        tag(family=family, id=int(i), corners=[point(x=float(x), y=float(y)) for x, y in places])
        for i, family, places in zip(found.ids, found.families, places_px, strict=True)
    ]
    return filled


def grey_image(kind: str, message: Any) -> UInt8[np.ndarray, "rows columns"] | None:
    """The image in a message of `IMAGE` or `COMPRESSED`, (H, W) uint8; None where it is broken.

    Raises:
        ValueError: the encoding is none that we read.
    """
    data = np.asarray(message.data, np.uint8)
    if kind == COMPRESSED:
        return decode_image(data, cv2.IMREAD_GRAYSCALE)
    if message.encoding not in _ENCODINGS:
        known = ", ".join(_ENCODINGS)
        raise ValueError(f"the encoding {message.encoding!r} is none of {known}")
    channels, conversion = _ENCODINGS[message.encoding]
    height, width, step = int(message.height), int(message.width), int(message.step)
    if not height or not width or step < width * channels or data.size != step * height:
        return None
    pixels = data.reshape(height, step)[:, : width * channels]
    if channels > 1:
        pixels = pixels.reshape(height, width, channels)
    pixels = np.ascontiguousarray(pixels)
    return pixels if conversion is None else np.asarray(cv2.cvtColor(pixels, conversion))
