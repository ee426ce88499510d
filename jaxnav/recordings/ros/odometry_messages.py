"""Convert ROS messages to readings of an odometer, without ROS, OpenCV or JAX.

nav_msgs/Odometry                           a car's speed and yaw rate, another base's twist
geometry_msgs/TwistStamped, TwistWithCovarianceStamped      the same
ackermann_msgs/AckermannDriveStamped        a car's speed and steering angle
sensor_msgs/JointState                      wheels and the joints that steer, by their names
sensor_msgs/Imu                             the rate of a gyro about the vehicle's vertical axis
"""

import math
from dataclasses import dataclass
from typing import Any

from jaxnav.core.models.twists import TwistReader
from jaxnav.drive.interfaces import GyroReading, Odometry, Reading, TwistOdometry
from jaxnav.files.ranges import RANGES
from jaxnav.recordings.ros import time_ns

NAV_ODOMETRY = "nav_msgs/msg/Odometry"
TWIST = "geometry_msgs/msg/TwistStamped"
TWIST_WITH_COVARIANCE = "geometry_msgs/msg/TwistWithCovarianceStamped"
ACKERMANN = "ackermann_msgs/msg/AckermannDriveStamped"
JOINTS = "sensor_msgs/msg/JointState"
ODOMETRY_TYPES = (NAV_ODOMETRY, ACKERMANN, TWIST_WITH_COVARIANCE, TWIST, JOINTS)
IMU = "sensor_msgs/msg/Imu"
TWIST_TYPES = (NAV_ODOMETRY, TWIST_WITH_COVARIANCE, TWIST)  # of a base that is no car


@dataclass(frozen=True)
class WheelJoints:
    """The joints of a car, by their names in a JointState.

    Attributes:
        driven: wheels without steering, whose mean rate in rad/s tells the speed.
        steered: joints about the vertical axis; of several the mean angle is taken.
        radius_m: of the driven wheels.
    """

    driven: tuple[str, ...]
    steered: tuple[str, ...]
    radius_m: float


def stamp_ns(message: Any) -> int:
    """The stamp in a message's header, ns, on the clock of the computer that measured."""
    return time_ns(message.header.stamp)


def gyro(message: Any, axis: tuple[float, float, float]) -> GyroReading:
    """The reading of a gyro in a sensor_msgs/Imu, with the message's own stamp.

    Args:
        axis: the vehicle's vertical in the axes of the IMU, a unit vector.
    """
    rate = message.angular_velocity
    parts = zip(axis, (float(rate.x), float(rate.y), float(rate.z)), strict=True)
    return GyroReading(stamp_ns(message), sum(a * w for a, w in parts))


def odometry(
    kind: str, message: Any, twists: TwistReader | None, joints: WheelJoints | None = None
) -> Reading:
    """The reading in a message of one of `ODOMETRY_TYPES`; a number that no vehicle can have, NaN
    among them, is not valid.

    Args:
        twists: must read all messages of one topic, in their order; None of a base that is no car,
            whose messages are of `TWIST_TYPES`.
        joints: of a JointState.
    """
    if twists is None:
        twist = message.twist if kind == TWIST else message.twist.twist
        parts = float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)
        valid = _hold("speed_mps", *parts[:2]) and _hold("turn_radps", parts[2])
        return TwistOdometry(stamp_ns(message), *parts, valid=valid)
    speed_mps, steering_rad = _speed_and_steering(kind, message, twists, joints)
    valid = _hold("speed_mps", speed_mps) and _hold("steering_rad", steering_rad)
    return Odometry(stamp_ns(message), speed_mps, steering_rad, valid=valid)


def _hold(name: str, *values: float) -> bool:
    """Whether all values are within the range of a quantity."""
    return all(map(RANGES[name].holds, values))


def _speed_and_steering(
    kind: str, message: Any, twists: TwistReader, joints: WheelJoints | None
) -> tuple[float, float]:
    if kind == ACKERMANN:
        return float(message.drive.speed), float(message.drive.steering_angle)
    if kind == JOINTS:
        return (math.nan, math.nan) if joints is None else _of_joints(message, twists, joints)
    twist = message.twist if kind == TWIST else message.twist.twist
    forward_mps, turn_radps = float(twist.linear.x), float(twist.angular.z)
    if not (_hold("speed_mps", forward_mps) and _hold("turn_radps", turn_radps)):
        return math.nan, math.nan  # the reader, which holds a steering, must not see it
    return twists.read(forward_mps, turn_radps)


def _of_joints(message: Any, twists: TwistReader, joints: WheelJoints) -> tuple[float, float]:
    """Speed of the vehicle's middle, from the rear axle's, which the driven wheels tell."""
    names = list(message.name)
    try:
        rates = [float(message.velocity[names.index(name)]) for name in joints.driven]
        angles = [float(message.position[names.index(name)]) for name in joints.steered]
    except (ValueError, IndexError):  # another robot's joints, or a message without rates
        return math.nan, math.nan
    if not (_hold("turn_radps", *rates) and _hold("steering_rad", *angles)):
        return math.nan, math.nan
    steering_rad = sum(angles) / len(angles)
    rear_mps = joints.radius_m * sum(rates) / len(rates)
    yaw_rate_radps = rear_mps * math.tan(steering_rad) / twists.wheelbase_m
    speed_mps, _ = twists.read(rear_mps, yaw_rate_radps)
    return speed_mps, steering_rad
