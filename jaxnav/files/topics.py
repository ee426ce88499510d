"""Reading of topic maps in YAML: the topics of a ROS bag with cameras and odometry.

    cameras: {front: /front/detections, left: /left/image_raw}   # names as in the rig
    odometry: /odom                # of a type in jaxnav/ros/odometry_messages.py
    joints: {driven: [rear_left, rear_right], steered: [front], wheel_radius_m: 0.033}  # JointState
    corner_sigma_px: 0.3           # of detections in the bag; may be left out
    first_corner: bottom_left      # of detections in the bag; may be left out

AprilTag counts a marker's corners counter-clockwise from the bottom left of its own picture.
OpenCV's picture of the same marker stands on its head. A map made for AprilTag's picture goes
with `bottom_left`; one made for OpenCV's, as jaxnav's own detectors see it, with `top_right`.
"""

from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Field, PrivateAttr, field_validator

from jaxnav.files.reading import read_mapping
from jaxnav.files.validation import CornerSigma, Entry, Name, Positive, validate
from jaxnav.models.conventions import FirstCorner


class JointsEntry(Entry):
    """The joints of a sensor_msgs/JointState that tell speed and steering."""

    driven: Annotated[list[Name], Field(min_length=1, max_length=16)]
    steered: Annotated[list[Name], Field(min_length=1, max_length=16)]
    wheel_radius_m: Annotated[Positive, Field(le=10)]


class TopicMap(Entry):
    """The topics of a ROS bag that hold the cameras' frames and the odometry.

    Attributes:
        cameras: name in the rig -> topic of detections or of images.
        odometry: the topic; None where the bag has none.
        joints: of a topic of JointState.
        corner_sigma_px: standard deviation of a detected corner along one axis.
        first_corner: the corner, as the marker map sees the marker, that a detection begins with;
            the others follow counter-clockwise.
    """

    _path: Path = PrivateAttr(default=Path())
    cameras: Annotated[dict[str, Name], Field(min_length=1, max_length=64)]
    odometry: Name | None = None
    joints: JointsEntry | None = None
    corner_sigma_px: CornerSigma = 0.3
    first_corner: FirstCorner = "bottom_left"

    @property
    def path(self) -> Path:
        """The file, for messages."""
        return self._path

    @field_validator("cameras")
    @classmethod
    def _topics_differ(cls, cameras: dict[str, str]) -> dict[str, str]:
        topics = [topic.strip("/") for topic in cameras.values()]
        if len(set(topics)) < len(topics):
            twice = next(topic for topic in topics if topics.count(topic) > 1)
            raise ValueError(f"the topic {twice} is given to two cameras")
        return cameras

    @field_validator("odometry")
    @classmethod
    def _not_a_camera(cls, odometry: str | None, info: Any) -> str | None:
        for camera, topic in info.data.get("cameras", {}).items():
            if odometry is not None and topic.strip("/") == odometry.strip("/"):
                raise ValueError(f"{topic} is the topic of the camera {camera!r} already")
        return odometry


Topics = TypeVar("Topics", bound=TopicMap)


def load_topics(path: str | Path) -> TopicMap:
    """Read a topic map.

    Raises:
        BadInput: one line naming file and key.
    """
    return read_topics(TopicMap, Path(path))


def read_topics(kind: type[Topics], path: Path) -> Topics:
    """Read a topic map, or a file that holds more than one; see `load_topics`."""
    topics = validate(kind, read_mapping(path), path)
    topics._path = path
    return topics
