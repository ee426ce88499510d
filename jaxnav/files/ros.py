"""Reading of the file of a ROS node in YAML: our files, topics and frames.

rig: rig.yaml                  # our files; their paths count from this file's folder
markers: markers.yaml
vehicle: vehicle.yaml          # of a car or another base; left out: a rig that moves freely
route: route.yaml              # left out: somebody else drives, jaxnav only localises
params: params.yaml            # tuned; may be left out, as all that follows
selector: multi-hypothesis
cameras: {front: /front/detections, left: /left/detections}     # as in topics.yaml
camera_type: apriltag_msgs/msg/AprilTagDetectionArray   # or sensor_msgs/msg/Image
corner_sigma_px: 0.3
odometry: /odom                # of a rig that moves freely: by other software, may be left out
odometry_type: nav_msgs/msg/Odometry
T_vehicle_odometry: {wxyz: [1, 0, 0, 0], xyz_m: [0, 0, 0]}    # its body on a rig that moves freely
odometry_delay_s: 0.0          # of such a rig's: its poses were taken so long before their stamps
odometry_sigma: {scale: 0.03, turn_deg: 1.0}    # and how far off they may be, alike in every step
odom_tf: false                 # true: odom -> base is what /tf says, not the odometry's pose
joints: {driven: [rear_left, rear_right], steered: [front_left], wheel_radius_m: 0.033}
imu: {topic: /imu, T_vehicle_imu: {wxyz: [1, 0, 0, 0], xyz_m: [0, 0, 0]}}    # of the vehicle's gyro
command: /drive                # left out: /drive of a car, /cmd_vel of another base
command_type: ackermann        # ackermann_msgs/AckermannDriveStamped; or twist, as of other bases
frames: {map: map, odom: odom, base: base_link}
base_x_m: -0.128               # of base_link, forward of the middle between the axles
tf_tolerance_s: 0.0            # tf is stamped so far in the future
"""

from contextlib import suppress
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float
from pydantic import Field, model_validator

from jaxnav.errors import BadInput
from jaxnav.files import poses
from jaxnav.files.ranges import within
from jaxnav.files.topics import OdometrySigma, TopicMap
from jaxnav.files.validation import (
    Entry,
    MountPose,
    Name,
    NonNegative,
    Number,
    QuaternionPose,
    Text,
    at,
)

Frame = Annotated[str, Field(strict=True, pattern=r"^[A-Za-z_][\w/.\-]{0,99}$")]


class FramesEntry(Entry):
    """Names of frames, as REP-105 has them."""

    map: Frame = "map"
    odom: Frame = "odom"
    base: Frame = "base_link"


class RosFile(TopicMap):
    """The file of a ROS node; see the module."""

    rig: Text
    markers: Text
    vehicle: Text | None = None
    route: Text | None = None
    params: Text | None = None
    selector: Text = "multi-hypothesis"
    camera_type: Literal[
        "apriltag_msgs/msg/AprilTagDetectionArray",
        "sensor_msgs/msg/Image",
        "sensor_msgs/msg/CompressedImage",
    ] = "apriltag_msgs/msg/AprilTagDetectionArray"
    camera_info: Annotated[dict[str, Name], Field(max_length=64)] = Field(default_factory=dict)
    rectified: Annotated[bool, Field(strict=True)] | None = None  # None: detections are, images not
    odometry_type: Literal[
        "nav_msgs/msg/Odometry",
        "ackermann_msgs/msg/AckermannDriveStamped",
        "geometry_msgs/msg/TwistWithCovarianceStamped",
        "geometry_msgs/msg/TwistStamped",
        "sensor_msgs/msg/JointState",
    ] = "nav_msgs/msg/Odometry"
    T_vehicle_odometry: MountPose = Field(
        default_factory=lambda: QuaternionPose(wxyz=[1, 0, 0, 0], xyz_m=[0, 0, 0])
    )
    odometry_delay_s: Annotated[Number, within("delay_s")] = 0.0
    odometry_sigma: OdometrySigma = OdometrySigma()
    odom_tf: Annotated[bool, Field(strict=True)] = False
    command: Name | None = None
    command_type: Literal["ackermann", "twist"] | None = None
    frames: FramesEntry = Field(default_factory=FramesEntry)
    base_x_m: Annotated[Number, Field(ge=-100, le=100)] = 0.0
    tf_tolerance_s: Annotated[NonNegative, Field(le=10)] = 0.0

    @model_validator(mode="after")
    def _fits_together(self) -> "RosFile":
        if self.vehicle is None:
            for key in ("route", "joints", "imu"):
                if getattr(self, key) is not None:
                    raise ValueError(f"{key} needs a vehicle")
            if self.odometry_type != "nav_msgs/msg/Odometry":
                raise ValueError(
                    "without a vehicle odometry_type is nav_msgs/msg/Odometry, which has a pose"
                )
        elif self.odometry is None:
            raise ValueError("a vehicle needs odometry: its topic")
        for key in ("T_vehicle_odometry", "odometry_delay_s", "odometry_sigma"):
            if self.vehicle is not None and key in self.model_fields_set:
                raise ValueError(f"{key} is for a rig that moves freely, without a vehicle")
        if (self.joints is not None) != (self.odometry_type == "sensor_msgs/msg/JointState"):
            raise ValueError("joints go with the odometry_type sensor_msgs/msg/JointState")
        return self

    def file(self, key: str) -> Path | None:
        """The path of one of our files; None where it is left out.

        Raises:
            BadInput: there is no such file.
        """
        text = getattr(self, key)
        if text is None:
            return None
        path = self.path.parent / text
        is_there = False
        with suppress(OSError):  # a name that is too long, say
            is_there = path.is_file()
        if not is_there:
            raise BadInput(at(self.path, key), f"there is no file {path}")
        return path

    @property
    def is_rectified(self) -> bool:
        """Whether corners are pixels of a rectified image; apriltag_ros takes one."""
        detects = self.camera_type == "apriltag_msgs/msg/AprilTagDetectionArray"
        return detects if self.rectified is None else self.rectified

    @property
    def T_vehicle_sensor(self) -> Float[np.ndarray, " 7"]:
        """Where the body of a free rig's odometry is on it, (7,) wxyz xyz."""
        return poses.pose_as_read(self.T_vehicle_odometry)

    def with_markers(self, path: str) -> "RosFile":
        """The same with another marker file, whose path counts from this file's folder."""
        return self.model_copy(update={"markers": path})

    def options(self, drives: bool, sim_time: bool) -> dict[str, str]:
        """The options of the plug-ins `ros2` of vehicle and cameras.

        Args:
            drives: whether commands are sent.
        """
        options = {f"camera.{name}": topic for name, topic in self.cameras.items()} | {
            "camera_type": self.camera_type,
            "corner_sigma_px": repr(self.corner_sigma_px),
            "first_corner": self.first_corner,
            "sim_time": "true" if sim_time else "false",
        }
        if self.odometry is not None:
            options |= {"odometry_topic": self.odometry, "odometry_type": self.odometry_type}
            if self.command is not None:
                options |= {"command_topic": self.command}
            kind = self.command_type if drives else "none"
            if kind is not None:
                options |= {"command_type": kind}
        if self.imu is not None:
            axis = ",".join(map(repr, self.imu.vertical()))
            options |= {"imu_topic": self.imu.name, "imu_axis": axis}
        if self.joints is not None:
            options |= {"driven": ",".join(self.joints.driven)}
            options |= {"steered": ",".join(self.joints.steered)}
            options |= {"wheel_radius_m": repr(self.joints.wheel_radius_m)}
        return options


def load_ros(path: str | Path) -> RosFile:
    """Read the file of a ROS node.

    Raises:
        BadInput: one line naming file and key.
    """
    return RosFile.load(Path(path))
