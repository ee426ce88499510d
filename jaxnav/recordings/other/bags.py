"""Reading of ROS 1 bags without ROS, compressed or not.

Message definitions come from the bag itself. Three kinds of its messages are read: detections of
markers (`apriltag_msgs/ApriltagArrayStamped`, TagSLAM's), transforms (`/tf`) and odometry with a
pose (`nav_msgs/Odometry`).
"""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.ranges import is_within
from jaxnav.files.reading import open_file
from jaxnav.files.unpacking import Budget, copy_bz2
from jaxnav.recordings.other.bag_readers import Ros1Reader, messages
from jaxnav.recordings.other.recording import Rows
from jaxnav.recordings.ros.camera_messages import TAGSLAM
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.recordings.ros.odometry_messages import stamp_ns as header_stamp_ns

_TF_TYPES = ("tf/msg/tfMessage", "tf2_msgs/msg/TFMessage")


@dataclass
class TopicDetections:
    """Detections by one camera: every message's stamp, and a row for each detection."""

    message_stamps_ns: list[int] = field(default_factory=list)
    stamps_ns: list[int] = field(default_factory=list)
    ids: list[int] = field(default_factory=list)
    corners_px: list[Any] = field(default_factory=list)  # (4, 2) each, in the message's order


@dataclass
class Bag:
    """The topics, detections and transforms of a bag."""

    topics: dict[str, str] = field(default_factory=dict)  # every topic -> its message type
    detections: dict[str, TopicDetections] = field(default_factory=dict)  # by topic
    # (parent, child) -> stamp in ns -> (7,) wxyz xyz, the pose of the child in the parent
    transforms: dict[tuple[str, str], dict[int, tuple[float, ...]]] = field(default_factory=dict)
    # topic -> stamp in ns -> (7,) wxyz xyz, the pose of the odometry's body in its own frame
    odometry: dict[str, dict[int, tuple[float, ...]]] = field(default_factory=dict)


def is_bag(path: Path) -> bool:
    """Whether a file's name is that of a ROS 1 bag."""
    return path.name.endswith((".bag", ".bag.bz2"))


def read_bag(path: Path, odometry: str | None = None) -> Bag:
    """Read a .bag or .bag.bz2.

    Args:
        odometry: the topic of odometry that is wanted; what others hold is not looked at.

    Raises:
        BadInput: the file is no bag, or ends too early.
    """
    bag = Bag()
    with decompress_bag(path) as plain:
        try:
            with Ros1Reader(plain) as reader:
                bag.topics = {c.topic: c.msgtype for c in reader.connections}
                wanted = [
                    c
                    for c in reader.connections
                    if c.msgtype in (TAGSLAM, *_TF_TYPES)
                    or (c.msgtype == NAV_ODOMETRY and c.topic == odometry)
                ]
                for connection, _, message in messages(reader, wanted, {}):
                    if connection.msgtype == TAGSLAM:
                        detections = bag.detections.setdefault(connection.topic, TopicDetections())
                        _add_detections(detections, message)
                    elif connection.msgtype == NAV_ODOMETRY:
                        track = bag.odometry.setdefault(connection.topic, {})
                        pose = message.pose.pose
                        what = f"a pose on {connection.topic}"
                        row = _row(pose.orientation, pose.position)
                        track[header_stamp_ns(message)] = _checked([row], [what])[0]
                    else:
                        _add_transforms(bag.transforms, message)
        except Exception as error:
            # The reader may meet any bytes, and raises whatever they lead to.
            problem = f"is not a readable ROS 1 bag ({type(error).__name__}: {error})"
            raise BadInput(path, problem) from None
    return bag


@contextmanager
def decompress_bag(path: Path) -> Iterator[Path]:
    """The path of the bag, or of a decompressed copy that is removed after the block."""
    open_file(path).close()
    if path.suffix != ".bz2":
        yield path
        return
    with tempfile.TemporaryDirectory(prefix="jaxnav-") as folder:
        plain = Path(folder) / path.stem
        try:
            with plain.open("wb") as target:
                copy_bz2(path, target, Budget.of_file(path))
        except (OSError, EOFError, ValueError) as error:
            raise BadInput(path, f"can't be decompressed: {str(error).lower()}") from None
        yield plain


def _add_detections(detections: TopicDetections, message: Any) -> None:
    stamp_ns = header_stamp_ns(message)
    if len(message.apriltags) > limits.IN_VIEW:
        raise ValueError(f"a frame of more than {limits.IN_VIEW} detections")
    if len(detections.ids) > limits.DETECTIONS:
        raise ValueError(f"more than {limits.DETECTIONS} detections")
    detections.message_stamps_ns.append(stamp_ns)
    for tag in message.apriltags:
        if len(tag.corners) != 4:
            raise ValueError(f"a detection of marker {tag.id} has {len(tag.corners)} corners")
        detections.stamps_ns.append(stamp_ns)
        detections.ids.append(int(tag.id))
        detections.corners_px.append(np.array([(corner.x, corner.y) for corner in tag.corners]))


def _add_transforms(
    transforms: dict[tuple[str, str], dict[int, tuple[float, ...]]], message: Any
) -> None:
    rows = [_row(s.transform.rotation, s.transform.translation) for s in message.transforms]
    edges = [
        (stamped.header.frame_id.lstrip("/"), stamped.child_frame_id.lstrip("/"))
        for stamped in message.transforms
    ]
    names = [f"the transform from {child} to {parent}" for parent, child in edges]
    for stamped, edge, row in zip(message.transforms, edges, _checked(rows, names), strict=True):
        transforms.setdefault(edge, {})[header_stamp_ns(stamped)] = row


def _row(q: Any, p: Any) -> tuple[float, ...]:
    return q.w, q.x, q.y, q.z, p.x, p.y, p.z


def _checked(rows: list[tuple[float, ...]], names: list[str]) -> list[tuple[float, ...]]:
    """The poses (7,) of the names, which are rigid and in the world."""
    poses = np.array(rows, float).reshape(-1, 7)
    off_unit = np.abs(np.linalg.norm(poses[:, :4], axis=1) - 1)
    rigid = np.asarray(np.isfinite(poses).all(axis=1) & (off_unit <= 1e-3))
    near = np.asarray(is_within("position_m", poses[:, 4:]).all(axis=1))
    for index, name in enumerate(names):
        if not rigid[index]:
            raise ValueError(f"{name} is not rigid")
        if not near[index]:
            raise ValueError(f"{name} leads out of the world")
    return rows


def list_topics(recorded: Sequence[Bag]) -> str:
    """A list of the topics of some bags, for a message."""
    topics = sorted({f"{topic} ({kind})" for bag in recorded for topic, kind in bag.topics.items()})
    return f"topics found: {', '.join(topics) or 'none'}"


def rows_of_topics(topics: Sequence[TopicDetections]) -> Rows:
    """One table of the detections by all cameras, which are in the order of the rig."""
    frame_stamps = [stamp for topic in topics for stamp in topic.message_stamps_ns]
    return Rows(
        stamps_ns=np.array([s for topic in topics for s in topic.stamps_ns], np.int64),
        cameras=np.repeat(np.arange(len(topics)), [len(topic.ids) for topic in topics]),
        ids=np.array([i for topic in topics for i in topic.ids], np.int64),
        corners_px=np.asarray([c for topic in topics for c in topic.corners_px], float).reshape(
            -1, 4, 2
        ),
        frame_stamps_ns=np.unique(np.array(frame_stamps, np.int64)),
    )
