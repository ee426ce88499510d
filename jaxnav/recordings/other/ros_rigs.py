"""Reading of rigs that move freely from ROS bags: the cameras' frames and an IMU.

    topics = load_topics("topics.yaml")
    recording = read_ros_rig("walk.bag", topics, rig, markers)

Frames count at the stamps of their headers; those of one stamp are one frame of the recording.
"""

from contextlib import closing
from pathlib import Path

import numpy as np

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.frames import FrameDetections
from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.ranges import problem_of
from jaxnav.files.topics import TopicMap, same_topic
from jaxnav.files.validation import at
from jaxnav.recordings.other.recording import TO_OURS, Recording, Rows, assemble
from jaxnav.recordings.other.ros_bags import one_line, read_messages
from jaxnav.recordings.other.ros_drives import MessageReader
from jaxnav.recordings.ros import imu_messages
from jaxnav.recordings.ros.odometry_messages import stamp_ns

_TO_THEIRS = np.argsort(TO_OURS)


def read_ros_rig(
    path: str | Path,
    topics: TopicMap,
    rig: CameraRig,
    markers: MarkerMap,
    corner_backend: str = "aruco",
) -> Recording:
    """Read all frames of a bag, and its IMU where the topic map has one.

    Args:
        path: a .bag, a .bag.bz2, the folder of a ROS 2 bag, or one of its .db3 or .mcap files.
        topics: the topics to read; its odometry is not looked at.
        corner_backend: see `make_detector`; for images.

    Raises:
        BadInput: one line naming the file and the topic or key.
    """
    path, imu = Path(path), topics.imu
    reader = MessageReader(path, topics.model_copy(update={"odometry": None}), rig, markers,
                           corner_backend)  # fmt: skip
    frames: list[FrameDetections] = []
    stamps_ns: list[int] = []
    readings: list[tuple[float, ...]] = []
    detections = 0
    with closing(read_messages(path, reader.choose)) as messages:
        for received in messages:
            try:
                if imu is not None and same_topic(received.topic, imu.name):
                    stamps_ns.append(_checked(stamp_ns(received.message)))
                    readings.append(imu_messages.row(received.message))
                else:
                    frames.append(reader.sighted(received))
                    _checked(frames[-1].stamp_ns)
                    detections += _count(frames[-1])
                    if detections > limits.DETECTIONS:
                        raise ValueError(f"more than {limits.DETECTIONS} detections")
            except BadInput:
                raise
            except Exception as error:
                # A definition in the bag may differ from the one that its name promises.
                problem = f"{received.topic}: a message can't be understood ({one_line(error)})"
                raise BadInput(path, problem) from None
    if imu is not None and len(stamps_ns) < 2:
        raise BadInput(at(topics.path, "imu"), f"{path} has {len(stamps_ns)} samples: 2 are needed")
    return assemble(
        path,
        path.name,
        _rows(frames),
        rig,
        markers,
        imu=None if imu is None else imu_messages.samples(imu, stamps_ns, readings),
    )


def _checked(stamp: int) -> int:
    if problem := problem_of("stamp_ns", stamp):
        raise ValueError(f"a stamp {problem}")
    return stamp


def _count(frame: FrameDetections) -> int:
    return 0 if frame.detections is None else len(frame.detections.ids)


def _rows(frames: list[FrameDetections]) -> Rows:
    """One table of all detections, their corners in the order of a recording's."""
    seen = [(frame, frame.detections) for frame in frames if frame.detections is not None]
    counts = [len(found.ids) for _, found in seen]
    corners = [found.corners_px[:, _TO_THEIRS] for _, found in seen]
    return Rows(
        stamps_ns=np.repeat(np.array([frame.stamp_ns for frame, _ in seen], np.int64), counts),
        cameras=np.repeat(np.array([frame.camera for frame, _ in seen], int), counts),
        ids=np.concatenate([np.zeros(0, np.int64), *(found.ids for _, found in seen)]),
        corners_px=np.concatenate([np.zeros((0, 4, 2)), *corners]),
        frame_stamps_ns=np.array([frame.stamp_ns for frame in frames], np.int64),
    )
