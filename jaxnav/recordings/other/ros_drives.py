"""Reading of drives recorded in ROS bags, as the inputs of a pilot.

    topics = load_topics("topics.yaml")
    inputs = read_ros_drive("drive.bag", topics, rig, markers, vehicle)

The time of an input is when the recorder received it; its stamp is the message header's. Frames of
several cameras with the same stamp are one input, at the time of the last of them.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.twists import TwistReader
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.detection import Detections
from jaxnav.detection.image_search import ImageSearch, size_problem
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import MOST_TURNS, GyroReading
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files.topics import TopicMap, same_topic
from jaxnav.files.validation import at
from jaxnav.recordings.other.ros_bags import ReceivedMessage, one_line, read_messages
from jaxnav.recordings.ros import camera_messages, odometry_messages
from jaxnav.recordings.ros.odometry_messages import IMU, WheelJoints

TOGETHER_NS = 100_000_000  # frames of one stamp that come later than this are not joined


def read_ros_drive(
    path: str | Path,
    topics: TopicMap,
    rig: CameraRig,
    markers: MarkerMap,
    vehicle: Vehicle | TwistBase,
    corner_backend: str = "aruco",
) -> list[Input]:
    """Read all inputs of a bag, in the order of their reception.

    Args:
        path: a .bag, a .bag.bz2, the folder of a ROS 2 bag, or one of its .db3 or .mcap files.
        topics: the topics to read. Cameras of the rig that it leaves out never have a frame.
        markers: their families are searched for in images, and give the family of an id that
            comes without one.
        vehicle: a car's figures turn a yaw rate into steering; the twist of another base is read
            as it is.
        corner_backend: see `make_detector`; for images.

    Raises:
        BadInput: one line naming the file and the topic or key.
    """
    path = Path(path)
    axis = None  # of a gyro, which the filter looks at where the vehicle has one
    if vehicle.gyro is not None and topics.imu is not None:
        axis = topics.imu.vertical()
    read = topics if axis is not None else topics.model_copy(update={"imu": None})
    reader = MessageReader(path, read, rig, markers, corner_backend)
    joints = None
    if topics.joints is not None:
        told = topics.joints
        joints = WheelJoints(tuple(told.driven), tuple(told.steered), told.wheel_radius_m)
    twists = None
    if isinstance(vehicle, Vehicle):
        twists = TwistReader(float(vehicle.wheelbase_m), float(vehicle.steering_limit_rad))
    inputs: list[Input] = []
    turns: deque[GyroReading] = deque(maxlen=MOST_TURNS)  # since the last odometry
    frames: list[tuple[int, FrameDetections]] = []
    with closing(read_messages(path, reader.choose)) as messages:
        for received in messages:
            try:
                if same_topic(received.topic, topics.odometry):
                    if twists is None and received.kind not in odometry_messages.TWIST_TYPES:
                        problem = f"{received.topic}: {received.kind} is a car's odometry"
                        raise BadInput(path, problem)
                    reading = odometry_messages.odometry(
                        received.kind, received.message, twists, joints
                    )
                    inputs.append(Input(received.received_ns, reading, gyro=tuple(turns)))
                    turns.clear()
                elif received.kind == IMU and axis is not None:
                    turns.append(odometry_messages.gyro(received.message, axis))
                else:
                    frames.append((received.received_ns, reader.sighted(received)))
            except BadInput:
                raise
            except Exception as error:
                # A definition in the bag may differ from the one that its name promises.
                problem = f"{received.topic}: a message can't be understood ({one_line(error)})"
                raise BadInput(path, problem) from None
    return sorted([*inputs, *join_frames(frames)], key=lambda given: given.now_ns)


def join_frames(frames: Iterable[tuple[int, FrameDetections]]) -> list[Input]:
    """Join frames of several cameras with the same stamp into one input.

    Args:
        frames: each with the time at which it was received, ns, in the order of these times.
    """
    groups: list[list[tuple[int, FrameDetections]]] = []
    open_groups: dict[int, list[tuple[int, FrameDetections]]] = {}  # by stamp
    for received_ns, frame in frames:
        group = open_groups.get(frame.stamp_ns)
        if (
            group is None
            or received_ns - group[0][0] > TOGETHER_NS
            or frame.camera in (other.camera for _, other in group)
        ):
            group = open_groups[frame.stamp_ns] = []
            groups.append(group)
        group.append((received_ns, frame))
    return [
        Input(group[-1][0], frames=tuple(sorted((f for _, f in group), key=lambda f: f.camera)))
        for group in groups
    ]


@dataclass
class MessageReader:
    """A reader that turns the messages of the cameras' topics into `FrameDetections`."""

    path: Path
    topics: TopicMap
    rig: CameraRig
    markers: MarkerMap
    corner_backend: str
    _images: ImageSearch | None = None

    def __post_init__(self) -> None:
        for name in self.topics.cameras:
            if name not in self.rig.names:
                problem = f"the rig has no such camera: it has {', '.join(self.rig.names)}"
                raise BadInput(at(self.topics.path, f"cameras.{name}"), problem)
        self._camera_of = {
            topic.strip("/"): self.rig.names.index(name)
            for name, topic in self.topics.cameras.items()
        }
        self._families = dict(zip(self.markers.ids, self.markers.families, strict=True))

    def choose(self, kinds: Mapping[str, str]) -> list[str]:
        """The topics to read, each checked to be of a type that can be read."""
        wanted: dict[str, tuple[str, tuple[str, ...]]] = {
            f"cameras.{name}": (topic, camera_messages.CAMERA_TYPES)
            for name, topic in self.topics.cameras.items()
        }
        if self.topics.odometry is not None:
            wanted["odometry"] = (self.topics.odometry, odometry_messages.ODOMETRY_TYPES)
        if self.topics.imu is not None:
            wanted["imu"] = (self.topics.imu.name, (IMU,))
        chosen = [self._find(kinds, key, *entry) for key, entry in wanted.items()]
        if odometry_messages.JOINTS in [kinds[topic] for topic in chosen]:
            if self.topics.joints is None:
                problem = f"missing: {self.topics.odometry} is of {odometry_messages.JOINTS}"
                raise BadInput(at(self.topics.path, "joints"), problem)
        if camera_messages.TAGSLAM in [kinds[topic] for topic in chosen]:
            if len(set(self.markers.ids)) < len(self.markers.ids):
                problem = "ids must differ: the recording does not tell families"
                raise BadInput("--markers", problem)
        return chosen

    def _find(
        self, kinds: Mapping[str, str], key: str, topic: str, expected: tuple[str, ...]
    ) -> str:
        where = at(self.topics.path, key)
        matches = [recorded for recorded in kinds if same_topic(recorded, topic)]
        if not matches:
            listed = ", ".join(f"{name} ({kind})" for name, kind in sorted(kinds.items()))
            problem = f"{self.path} has no topic {topic}; topics found: {listed or 'none'}"
            raise BadInput(where, problem)
        if kinds[matches[0]] not in expected:
            problem = f"{topic} of {self.path} is of {kinds[matches[0]]}, not of"
            raise BadInput(where, f"{problem} {', '.join(expected)}")
        return matches[0]

    def sighted(self, received: ReceivedMessage) -> FrameDetections:
        """The sightings in a message of detections or of an image."""
        camera = self._camera_of[received.topic.strip("/")]
        stamp_ns = odometry_messages.stamp_ns(received.message)
        if received.kind in (camera_messages.IMAGE, camera_messages.COMPRESSED):
            detections = self._search(camera, received)
            faults = Fault.FRAME_UNUSABLE if detections is None else Fault(0)
            return FrameDetections(camera, stamp_ns, detections, faults)
        detections = camera_messages.detections(
            received.kind,
            received.message,
            self.topics.first_corner,
            self.topics.corner_sigma_px,
            self._families,
        )
        return FrameDetections(camera, stamp_ns, detections)

    def _search(self, camera: int, received: ReceivedMessage) -> Detections | None:
        image = camera_messages.grey_image(received.kind, received.message)
        if image is None:
            return None
        self._images = self._images or ImageSearch(self.rig, self.markers, self.corner_backend)
        if problem := size_problem(self.rig, camera, image):
            raise BadInput(self.path, f"{received.topic}: {problem}")
        return self._images.detections(camera, image)
