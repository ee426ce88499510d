"""Read ROS bags by a topic map: drives, as the inputs of a pilot, and rigs that move freely.

    topics = load_topics("topics.yaml")
    inputs = read_ros_drive("drive.bag", topics, rig, markers, vehicle)
    source = read_ros_rig("walk.bag", topics, rig, markers)

The time of an input is when the recorder received it; its stamp is the message header's. Frames of
several cameras with the same stamp are one input, at the time of the last of them; of a rig, frames
of one stamp are one frame of the recording.
"""

from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path

import numpy as np

from jaxnav.core.models.imu import ImuSamples
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.twists import TwistReader
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.detection.image_search import ImageSearch, size_problem
from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import MOST_TURNS, GyroReading
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import limits
from jaxnav.files.ranges import problem_of
from jaxnav.files.topics import TopicMap, same_topic
from jaxnav.files.validation import at
from jaxnav.recordings.other.bags import ReceivedMessage, read_messages
from jaxnav.recordings.other.recording import Source, rows_of
from jaxnav.recordings.ros import camera_messages
from jaxnav.recordings.ros.odometry_messages import (
    IMU,
    JOINTS,
    ODOMETRY_TYPES,
    TWIST_TYPES,
    WheelJoints,
    gyro,
    odometry,
    stamp_ns,
)

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
    camera_reader = _CameraReader(path, read, rig, markers, corner_backend)
    joints = None
    if (named := topics.joints) is not None:
        joints = WheelJoints(tuple(named.driven), tuple(named.steered), named.wheel_radius_m)
    twists = None
    if isinstance(vehicle, Vehicle):
        twists = TwistReader(float(vehicle.wheelbase_m), float(vehicle.steering_limit_rad))
    inputs: list[Input] = []
    turns: deque[GyroReading] = deque(maxlen=MOST_TURNS)  # since the last odometry
    frames: list[tuple[int, FrameDetections]] = []

    def take(received: ReceivedMessage) -> None:
        if same_topic(received.topic, topics.odometry):
            if twists is None and received.kind not in TWIST_TYPES:
                raise BadInput(path, f"{received.topic}: {received.kind} is a car's odometry")
            reading = odometry(received.kind, received.message, twists, joints)
            inputs.append(Input(received.received_ns, reading, gyro=tuple(turns)))
            turns.clear()
        elif received.kind == IMU and axis is not None:
            turns.append(gyro(received.message, axis))
        else:
            frames.append((received.received_ns, camera_reader.frame(received)))

    read_messages(path, camera_reader.choose, take)
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


def read_ros_rig(path: Path, topics: TopicMap, rig: CameraRig, markers: MarkerMap) -> Source:
    """Read all frames of a bag, and its IMU where the topic map has one.

    Args:
        path: as in `read_ros_drive`.
        topics: the topics to read; its odometry is not looked at.

    Raises:
        BadInput: one line naming the file and the topic or key.
    """
    imu, read = topics.imu, topics.model_copy(update={"odometry": None})
    camera_reader = _CameraReader(path, read, rig, markers, "aruco")
    frames: list[tuple[int, int, Detections]] = []
    frame_stamps_ns: list[int] = []
    samples: dict[int, tuple[float, ...]] = {}  # by stamp, turn rate and specific force
    count = 0

    def take(received: ReceivedMessage) -> None:
        nonlocal count
        stamp = stamp_ns(received.message)
        if problem := problem_of("stamp_ns", stamp):
            raise ValueError(f"a stamp {problem}")
        if imu is not None and same_topic(received.topic, imu.name):
            w, a = received.message.angular_velocity, received.message.linear_acceleration
            count += 1
            samples.setdefault(stamp, tuple(map(float, (w.x, w.y, w.z, a.x, a.y, a.z))))
            return
        frame = camera_reader.frame(received)
        frame_stamps_ns.append(stamp)
        if frame.detections is not None:
            frames.append((stamp, frame.camera, frame.detections))
        if camera_reader.detections > limits.DETECTIONS:
            raise ValueError(f"more than {limits.DETECTIONS} detections")

    read_messages(path, camera_reader.choose, take)
    recorded = None
    if imu is not None:
        if count < 2:
            raise BadInput(at(topics.path, "imu"), f"{path} has {count} samples: 2 are needed")
        rows = np.array([samples[stamp] for stamp in sorted(samples)]).reshape(-1, 6)
        recorded = ImuSamples(
            stamps_ns=np.array(sorted(samples), np.int64),
            gyro_radps=rows[:, :3],
            accel_mps2=rows[:, 3:],
            T_vehicle_imu=imu.T_matrix(),
            noise=imu.noise(),
            delay_s=imu.imu_delay_s,
            max_gyro_radps=imu.max_gyro_radps,
            max_accel_mps2=imu.max_accel_mps2,
            level=imu.level,
        )
    rows_read = rows_of(frames, frame_stamps_ns)
    return Source(path.name, rows_read, rig, lambda: markers, imu=recorded)


class _CameraReader:
    """Turns the messages of the cameras' topics into `FrameDetections`.

    Attributes:
        detections: how many so far.
    """

    def __init__(
        self, path: Path, topics: TopicMap, rig: CameraRig, markers: MarkerMap, corner_backend: str
    ):
        self._path, self._topics, self._rig, self._markers = path, topics, rig, markers
        self._corner_backend = corner_backend
        self._images: ImageSearch | None = None
        self.detections = 0
        for name in topics.cameras:
            if name not in rig.names:
                problem = f"the rig has no such camera: it has {', '.join(rig.names)}"
                raise BadInput(at(topics.path, f"cameras.{name}"), problem)
        self._camera_of = {
            topic.strip("/"): rig.names.index(name) for name, topic in topics.cameras.items()
        }
        self._families = dict(zip(markers.ids, markers.families, strict=True))

    def choose(self, kinds: Mapping[str, str]) -> list[str]:
        """The topics to read, each checked to be of a type that can be read."""
        topics = self._topics
        wanted: dict[str, tuple[str, tuple[str, ...]]] = {
            f"cameras.{name}": (topic, camera_messages.CAMERA_TYPES)
            for name, topic in topics.cameras.items()
        }
        if topics.odometry is not None:
            wanted["odometry"] = (topics.odometry, ODOMETRY_TYPES)
        if topics.imu is not None:
            wanted["imu"] = (topics.imu.name, (IMU,))
        chosen = [self._find(kinds, key, *entry) for key, entry in wanted.items()]
        if JOINTS in [kinds[topic] for topic in chosen] and topics.joints is None:
            raise BadInput(at(topics.path, "joints"), f"missing: {topics.odometry} is of {JOINTS}")
        if camera_messages.TAGSLAM in [kinds[topic] for topic in chosen]:
            if len(set(self._markers.ids)) < len(self._markers.ids):
                problem = "ids must differ: the recording does not tell families"
                raise BadInput("--markers", problem)
        return chosen

    def _find(
        self, kinds: Mapping[str, str], key: str, topic: str, expected: tuple[str, ...]
    ) -> str:
        where = at(self._topics.path, key)
        matches = [recorded for recorded in kinds if same_topic(recorded, topic)]
        if not matches:
            listed = ", ".join(f"{name} ({kind})" for name, kind in sorted(kinds.items()))
            problem = f"{self._path} has no topic {topic}; topics found: {listed or 'none'}"
            raise BadInput(where, problem)
        if kinds[matches[0]] not in expected:
            problem = f"{topic} of {self._path} is of {kinds[matches[0]]}, not of"
            raise BadInput(where, f"{problem} {', '.join(expected)}")
        return matches[0]

    def frame(self, received: ReceivedMessage) -> FrameDetections:
        """The detections in a message of detections or of an image."""
        camera, stamp = self._camera_of[received.topic.strip("/")], stamp_ns(received.message)
        faults = Fault(0)
        if received.kind in (camera_messages.IMAGE, camera_messages.COMPRESSED):
            found = self._detect(camera, received)
            faults = Fault.FRAME_UNUSABLE if found is None else faults
        else:
            found = camera_messages.detections(
                received.kind,
                received.message,
                self._topics.first_corner,
                self._topics.corner_sigma_px,
                self._families,
            )
        self.detections += len(found or ())
        return FrameDetections(camera, stamp, found, faults)

    def _detect(self, camera: int, received: ReceivedMessage) -> Detections | None:
        image = camera_messages.grey_image(received.kind, received.message)
        if image is None:
            return None
        if self._images is None:
            self._images = ImageSearch(self._rig, self._markers, self._corner_backend)
        if problem := size_problem(self._rig, camera, image):
            raise BadInput(self._path, f"{received.topic}: {problem}")
        return self._images.detections(camera, image)
