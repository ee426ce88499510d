"""Reading of topic maps in YAML: the topics of a ROS bag with cameras and odometry.

    cameras: {front: /front/detections, left: /left/image_raw}   # names as in the rig
    odometry: /odom                # of a type in jaxnav/recordings/ros/odometry_messages.py
    joints: {driven: [rear_left, rear_right], steered: [front], wheel_radius_m: 0.033}  # JointState
    imu: {topic: /imu, preset: consumer, T_vehicle_imu: [[1, 0, 0, 0.1], ...]}    # sensor_msgs/Imu
    corner_sigma_px: 0.3           # of detections in the bag; may be left out
    first_corner: bottom_left      # of detections in the bag; may be left out

AprilTag counts a marker's corners counter-clockwise from the bottom left of its own picture.
OpenCV's picture of the same marker stands on its head. A map made for AprilTag's picture goes
with `bottom_left`; one made for OpenCV's, as jaxnav's own detectors see it, with `top_right`.
"""

import dataclasses
import math
from pathlib import Path
from typing import Annotated, Literal, Self

import numpy as np
from jaxtyping import Float
from pydantic import Field, PrivateAttr, model_validator

from jaxnav.core.models.conventions import FirstCorner
from jaxnav.core.models.imu import PRESETS, ImuNoise
from jaxnav.core.models.vehicle import (
    DEFAULT_SCALE_SIGMA,
    DEFAULT_TURN_SIGMA_RAD,
    default_odometry_sigma,
)
from jaxnav.core.parameters import TUNABLES
from jaxnav.files import poses
from jaxnav.files.ranges import within
from jaxnav.files.reading import first_repeated
from jaxnav.files.validation import (
    CornerSigma,
    Entry,
    MountPose,
    Name,
    NonNegative,
    Number,
    Positive,
    Wrong,
    read,
)


class JointsEntry(Entry):
    """The joints of a sensor_msgs/JointState that give speed and steering."""

    driven: Annotated[list[Name], Field(min_length=1, max_length=16)]
    steered: Annotated[list[Name], Field(min_length=1, max_length=16)]
    wheel_radius_m: Annotated[Positive, Field(le=10)]


# One that is larger says that nobody knows it, or was written in another unit.
_MOST_SCALE, *_, _MOST_TURN_RAD = TUNABLES["motion.odometry_errors.sigma"].most


class OdometrySigma(Entry):
    """How far off a free rig's odometry may be beside its drift, alike in every step.

    Attributes:
        scale: of its way.
        turn_deg: of the direction of its body on the rig, about each axis.
    """

    scale: Annotated[NonNegative, Field(le=_MOST_SCALE)] = DEFAULT_SCALE_SIGMA
    turn_deg: Annotated[NonNegative, Field(le=round(math.degrees(_MOST_TURN_RAD), 9))] = round(
        math.degrees(DEFAULT_TURN_SIGMA_RAD), 9
    )

    def sigma(self) -> Float[np.ndarray, " 4"]:
        """Of the scale, and of the direction, rad."""
        return default_odometry_sigma(self.scale, math.radians(self.turn_deg))


_Noise = Annotated[Positive, within("imu_noise")]
_Walk = Annotated[NonNegative, within("imu_noise")]
_Range = Annotated[Positive, within("imu_range")]


class ImuEntry(Entry):
    """An inertial measurement unit: its topic, its place, and how good it is.

    The densities and walks, `rostopic` and `update_rate` are those of Kalibr's imu.yaml.

    Attributes:
        topic: of sensor_msgs/Imu; or `rostopic`.
        T_vehicle_imu: where it is on the vehicle, its axes in the vehicle's.
        preset: a kind of sensor, for what is not given one by one.
        gyroscope_noise_density: rad/s/sqrt(Hz); the accelerometer's m/s^2/sqrt(Hz).
        gyroscope_random_walk: rad/s^2/sqrt(Hz); the accelerometer's m/s^3/sqrt(Hz).
        gyroscope_bias_sigma: rad/s; the accelerometer's m/s^2.
        update_rate: Hz; not looked at, as the stamps say it.
        imu_delay_s: its samples were taken so long before their stamps, on the cameras' clock.
        max_gyro_radps, max_accel_mps2: its range, beyond which a reading is saturated.
        level: the map's z points up within two degrees; else gravity is found on the way.
    """

    topic: Name | None = None
    rostopic: Name | None = None
    T_vehicle_imu: MountPose
    preset: Literal["consumer", "tactical"] = "consumer"
    gyroscope_noise_density: _Noise | None = None
    accelerometer_noise_density: _Noise | None = None
    gyroscope_random_walk: _Walk | None = None
    accelerometer_random_walk: _Walk | None = None
    gyroscope_bias_sigma: _Noise | None = None
    accelerometer_bias_sigma: _Noise | None = None
    update_rate: Positive | None = None
    imu_delay_s: Annotated[Number, within("delay_s")] = 0.0
    max_gyro_radps: _Range = 1e6
    max_accel_mps2: _Range = 1e6
    level: Annotated[bool, Field(strict=True)] = True

    @model_validator(mode="after")
    def _one_topic(self) -> "ImuEntry":
        if (self.topic is None) == (self.rostopic is None):
            raise ValueError("give one of topic and rostopic")
        return self

    @property
    def name(self) -> str:
        """The topic."""
        return self.topic or self.rostopic or ""

    def noise(self) -> ImuNoise:
        """The errors of its readings."""
        preset = PRESETS[self.preset]
        names = [field.name for field in dataclasses.fields(preset)]
        given = {name: getattr(self, name, None) for name in names}
        return dataclasses.replace(preset, **{k: v for k, v in given.items() if v is not None})

    def vertical(self) -> tuple[float, float, float]:
        """The vehicle's vertical in the axes of the IMU, about which a gyro turns."""
        x, y, z = self.T_matrix()[2, :3].tolist()
        return x, y, z

    def T_matrix(self) -> Float[np.ndarray, "4 4"]:
        """T_vehicle_imu, (4, 4)."""
        return poses.matrix(poses.pose_as_read(self.T_vehicle_imu))


class TopicMap(Entry):
    """The topics of a ROS bag that hold the cameras' frames and the odometry.

    Attributes:
        cameras: name in the rig -> topic of detections or of images.
        odometry: the topic; None where the bag has none.
        joints: of a topic of JointState.
        imu: of a rig that moves freely, or of a vehicle whose file has a gyro, which then gives its
            turn rate; None where there is none.
        corner_sigma_px: standard deviation of a detected corner along one axis.
        first_corner: the corner, as the marker map sees the marker, that a detection begins with;
            the others follow counter-clockwise.
    """

    _path: Path = PrivateAttr(default=Path())
    cameras: Annotated[dict[str, Name], Field(min_length=1, max_length=64)]
    odometry: Name | None = None
    joints: JointsEntry | None = None
    imu: ImuEntry | None = None
    corner_sigma_px: CornerSigma = 0.3
    first_corner: FirstCorner = "bottom_left"

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read such a file; see `load_topics`."""
        topics = read(path, cls)
        topics._path = path
        return topics

    @property
    def path(self) -> Path:
        """The file, for messages."""
        return self._path

    @model_validator(mode="after")
    def _each_topic_once(self) -> Self:
        if twice := first_repeated(topic.strip("/") for topic in self.cameras.values()):
            raise Wrong("cameras", f"the topic {twice} is given to two cameras")
        for camera, topic in self.cameras.items():
            if same_topic(topic, self.odometry):
                problem = f"{topic} is the topic of the camera {camera!r} already"
                raise Wrong("odometry", problem)
        return self


def same_topic(topic: str, other: str | None) -> bool:
    """Whether two spellings of a topic's name mean the same topic."""
    return other is not None and topic.strip("/") == other.strip("/")


def load_topics(path: str | Path) -> TopicMap:
    """Read a topic map.

    Raises:
        BadInput: one line naming file and key.
    """
    return TopicMap.load(Path(path))
