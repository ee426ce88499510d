"""ROS 1 and ROS 2 bags with the messages that a drive may hold, written by rosbags."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

FORMATS = {"bag": "drive.bag", "db3": "drive_db3", "mcap": "drive_mcap"}  # and how they are called

APRILTAGS = "apriltag_msgs/msg/AprilTagDetectionArray"
TAGSLAM = "apriltag_msgs/msg/ApriltagArrayStamped"
ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"
ODOMETRY = "nav_msgs/msg/Odometry"
TF = "tf2_msgs/msg/TFMessage"
IMU = "sensor_msgs/msg/Imu"
IMAGE = "sensor_msgs/msg/Image"
COMPRESSED = "sensor_msgs/msg/CompressedImage"

_DEFINITIONS = {
    "apriltag_msgs/msg/Point": "float64 x\nfloat64 y\n",
    "apriltag_msgs/msg/AprilTagDetection": (
        "string family\nint32 id\nint32 hamming\nfloat32 goodness\nfloat32 decision_margin\n"
        "Point centre\nPoint[4] corners\nfloat64[9] homography\n"
    ),
    APRILTAGS: "std_msgs/Header header\nAprilTagDetection[] detections\n",
    "apriltag_msgs/msg/Apriltag": (
        "int32 id\nstring family\nint32 hamming\nint32 border\nint32 bits\n"
        "geometry_msgs/Point center\ngeometry_msgs/Point[] corners\n"
    ),
    TAGSLAM: "std_msgs/Header header\nApriltag[] apriltags\n",
    "ackermann_msgs/msg/AckermannDrive": (
        "float32 steering_angle\nfloat32 steering_angle_velocity\n"
        "float32 speed\nfloat32 acceleration\nfloat32 jerk\n"
    ),
    ACKERMANN: "std_msgs/Header header\nAckermannDrive drive\n",
    TF: "geometry_msgs/TransformStamped[] transforms\n",
}


@dataclass
class Bag:
    """Messages to write, in the words of ROS 1 or ROS 2.

    Attributes:
        kind: a key of `FORMATS`.
    """

    kind: str
    _types: Any = field(init=False)
    rows: list[tuple[str, str, int, Any]] = field(init=False, default_factory=list)

    def __post_init__(self) -> None:
        store = Stores.ROS1_NOETIC if self.kind == "bag" else Stores.ROS2_JAZZY
        self._types = get_typestore(store)
        for name, text in _DEFINITIONS.items():
            self._types.register(get_types_from_msg(text, name))

    def make(self, name: str, *values: Any, **named: Any) -> Any:
        """A message of `package/Type`."""
        return self._types.types[name.replace("/", "/msg/")](*values, **named)

    def type_hash(self, name: str) -> str:
        """What ROS 2 knows `package/msg/Type` by."""
        return self._types.hash_rihs01(name)

    def header(self, stamp_ns: int) -> Any:
        """A header with a stamp."""
        time = self.make("builtin_interfaces/Time", stamp_ns // 10**9, stamp_ns % 10**9)
        sequence = {"seq": 0} if self.kind == "bag" else {}
        return self.make("std_msgs/Header", stamp=time, frame_id="camera", **sequence)

    def add(self, topic: str, kind: str, received_ns: int, message: Any) -> None:
        """Any message."""
        self.rows.append((topic, kind, received_ns, message))

    def apriltags(
        self, topic: str, received_ns: int, stamp_ns: int, tags: list[tuple[str, int, np.ndarray]]
    ) -> None:
        """What apriltag_ros found: (family, id, (4, 2) corners as AprilTag counts them)."""
        found = [
            self.make(
                "apriltag_msgs/AprilTagDetection",
                family,
                marker_id,
                0,
                0.0,
                50.0,
                self.make("apriltag_msgs/Point", *corners.mean(axis=0)),
                [self.make("apriltag_msgs/Point", *corner) for corner in corners],
                np.eye(3).ravel(),
            )
            for family, marker_id, corners in tags
        ]
        message = self.make("apriltag_msgs/AprilTagDetectionArray", self.header(stamp_ns), found)
        self.add(topic, APRILTAGS, received_ns, message)

    def tagslam(
        self, topic: str, received_ns: int, stamp_ns: int, tags: list[tuple[int, np.ndarray]]
    ) -> None:
        """What TagSLAM's detector found: (id, (4, 2) corners)."""
        point = self._types.types["geometry_msgs/msg/Point"]
        found = [
            self.make(
                "apriltag_msgs/Apriltag",
                marker_id,
                "tf36h11",
                0,
                1,
                6,
                point(*corners.mean(axis=0), 0.0),
                [point(*corner, 0.0) for corner in corners],
            )
            for marker_id, corners in tags
        ]
        message = self.make("apriltag_msgs/ApriltagArrayStamped", self.header(stamp_ns), found)
        self.add(topic, TAGSLAM, received_ns, message)

    def odometry(
        self,
        topic: str,
        received_ns: int,
        stamp_ns: int,
        speed_mps: float,
        yaw_radps: float,
        pose: Sequence[float] = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> None:
        """A reading of speed and yaw rate, and a pose wxyz xyz."""
        w, x, y, z, *place_m = pose
        placed = self.make(
            "geometry_msgs/Pose",
            self.make("geometry_msgs/Point", *place_m),
            self.make("geometry_msgs/Quaternion", x, y, z, w),
        )
        twist = self.make(
            "geometry_msgs/Twist",
            self.make("geometry_msgs/Vector3", speed_mps, 0.0, 0.0),
            self.make("geometry_msgs/Vector3", 0.0, 0.0, yaw_radps),
        )
        message = self.make(
            "nav_msgs/Odometry",
            self.header(stamp_ns),
            "base_link",
            self.make("geometry_msgs/PoseWithCovariance", placed, np.zeros(36)),
            self.make("geometry_msgs/TwistWithCovariance", twist, np.zeros(36)),
        )
        self.add(topic, ODOMETRY, received_ns, message)

    def transform(self, stamp_ns: int, parent: str, child: str, pose: Sequence[float]) -> None:
        """A transform on /tf, its pose wxyz xyz."""
        w, x, y, z, *place_m = pose
        transform = self.make(
            "geometry_msgs/Transform",
            self.make("geometry_msgs/Vector3", *place_m),
            self.make("geometry_msgs/Quaternion", x, y, z, w),
        )
        header = self.header(stamp_ns)
        header.frame_id = parent
        stamped = self.make("geometry_msgs/TransformStamped", header, child, transform)
        self.add("/tf", TF, stamp_ns, self.make("tf2_msgs/TFMessage", [stamped]))

    def ackermann(
        self, topic: str, received_ns: int, stamp_ns: int, speed_mps: float, steering_rad: float
    ) -> None:
        """A reading of speed and steering angle."""
        drive = self.make("ackermann_msgs/AckermannDrive", steering_rad, 0.0, speed_mps, 0.0, 0.0)
        message = self.make("ackermann_msgs/AckermannDriveStamped", self.header(stamp_ns), drive)
        self.add(topic, ACKERMANN, received_ns, message)

    def imu(
        self, topic: str, received_ns: int, stamp_ns: int, gyro: np.ndarray, accel: np.ndarray
    ) -> None:
        """A sample of an IMU that knows no orientation."""
        unknown = np.zeros(9)
        message = self.make(
            "sensor_msgs/Imu",
            self.header(stamp_ns),
            self.make("geometry_msgs/Quaternion", 0.0, 0.0, 0.0, 1.0),
            unknown,
            self.make("geometry_msgs/Vector3", *map(float, gyro)),
            unknown,
            self.make("geometry_msgs/Vector3", *map(float, accel)),
            unknown,
        )
        self.add(topic, IMU, received_ns, message)

    def image(
        self,
        topic: str,
        received_ns: int,
        pixels: np.ndarray,
        encoding: str,
        padding: int = 0,
        height: int | None = None,
    ) -> None:
        """A picture (H, W) or (H, W, channels), with some bytes after each row."""
        rows = np.pad(pixels.reshape(len(pixels), -1), ((0, 0), (0, padding)))
        message = self.make(
            "sensor_msgs/Image",
            self.header(received_ns),
            len(pixels) if height is None else height,
            pixels.shape[1],
            encoding,
            0,
            rows.shape[1],
            rows.ravel(),
        )
        self.add(topic, IMAGE, received_ns, message)

    def compressed(self, topic: str, received_ns: int, data: bytes) -> None:
        """A compressed picture."""
        pixels = np.frombuffer(data, np.uint8)
        message = self.make("sensor_msgs/CompressedImage", self.header(received_ns), "jpeg", pixels)
        self.add(topic, COMPRESSED, received_ns, message)

    def write(self, folder: Path) -> Path:
        """The bag in a folder."""
        path = folder / FORMATS[self.kind]
        if self.kind == "bag":
            writer: Any = Ros1Writer(path)
            serialize = self._types.serialize_ros1
        else:
            plugin = StoragePlugin.MCAP if self.kind == "mcap" else StoragePlugin.SQLITE3
            writer = Ros2Writer(path, version=9, storage_plugin=plugin)
            serialize = self._types.serialize_cdr
        connections: dict[str, Any] = {}
        with writer:
            for topic, kind, received_ns, message in self.rows:
                if topic not in connections:
                    connections[topic] = writer.add_connection(topic, kind, typestore=self._types)
                writer.write(connections[topic], received_ns, serialize(message, kind))
        return path
