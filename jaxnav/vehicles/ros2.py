"""Connect to ROS 2: a vehicle behind topics, and a publisher of the pilot's pose and command.

Options of the vehicle: `odometry_topic` (/odom) and its `odometry_type` (odometry:
nav_msgs/Odometry, or ackermann: ackermann_msgs/AckermannDriveStamped), `command_topic` (/drive,
AckermannDriveStamped: the speed is throttle * speed_per_throttle_mps).

ROS is not needed to install jaxnav; it is imported when something here is opened.
"""

from __future__ import annotations

import math
import threading
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxnav.loop.interfaces import Odometry, Setup, Vehicle
from jaxnav.loop.limits import Limits
from jaxnav.models.twists import TwistReader
from jaxnav.vehicles.options import choice
from jaxnav.vehicles.ros2_node import Node

if TYPE_CHECKING:  # the guard's process opens the vehicle without JAX
    from jaxnav.loop.pilot import Outcome
    from jaxnav.models.bicycle import Vehicle as VehicleModel

_LOCK_PATIENCE_S = 0.03  # a `stop` waits this long for a message that another thread publishes
_PLANAR = np.ix_([0, 1, 5], [0, 1, 5])  # x, y, rotation about z among the six of a ROS covariance


def open_vehicle(setup: Setup) -> Vehicle:
    """Open the vehicle behind the topics.

    Raises:
        ImportError: ROS 2 or one of its message packages is not there.
        BadInput: an option is wrong.
    """
    options = setup.options
    kind = choice(options, "odometry_type", ("odometry", "ackermann"))
    return RosVehicle(
        setup.vehicle,
        options.get("odometry_topic", "/odom"),
        kind,
        options.get("command_topic", "/drive"),
    )


class RosVehicle:
    """A vehicle behind ROS topics. A read gives the last message, with that message's stamp."""

    timeout_s = math.inf  # a subscriber may stop by itself, but does not say so

    def __init__(
        self, vehicle: VehicleModel, odometry_topic: str, odometry_type: str, command_topic: str
    ):
        """Subscribe to the odometry.

        Args:
            odometry_type: odometry or ackermann.
        """
        from ackermann_msgs.msg import AckermannDriveStamped
        from nav_msgs.msg import Odometry as OdometryMessage

        self._limits = Limits.of(vehicle)
        self._twists = TwistReader(float(vehicle.wheelbase_m), self._limits.steering_rad)
        self._speed_per_throttle_mps = float(vehicle.speed_per_throttle_mps)
        self._topic = odometry_topic
        self._reading: Odometry | None = None
        self._steering_rad = 0.0
        self._written_ns: int | None = None
        self._closed = False
        self._writing = threading.Lock()  # so that no command follows the zero speed of a `stop`
        self._stops = 0
        self._node = Node("jaxnav_vehicle")
        self._publisher = self._node.publisher(AckermannDriveStamped, command_topic)
        if odometry_type == "ackermann":
            self._node.listen(AckermannDriveStamped, odometry_topic, self._take_ackermann)
        else:
            self._node.listen(OdometryMessage, odometry_topic, self._take_odometry)

    def read(self) -> Odometry:
        """The latest message, with its own stamp.

        Raises:
            OSError: there was none yet, or the vehicle is closed.
        """
        if self._closed:
            raise OSError("the ROS vehicle is closed")
        if self._reading is None:
            raise OSError(f"no message on {self._topic} yet")
        return self._reading

    def write(self, steering_rad: float, throttle: float) -> None:
        """Publish a command, clamped to the limits.

        Raises:
            OSError: it could not be published, or the vehicle is closed.
        """
        with self._writing:
            if self._closed:
                raise OSError("the ROS vehicle is closed")
            now_ns = time.monotonic_ns()
            before_ns = now_ns if self._written_ns is None else self._written_ns
            self._steering_rad, throttle = self._limits.apply(
                steering_rad, throttle, self._steering_rad, (now_ns - before_ns) / 1e9
            )
            self._written_ns = now_ns
            stops = self._stops
            try:
                self._command(throttle, now_ns)
            finally:
                if self._stops != stops:  # a stop did not wait for this command, which hung
                    self._command(0.0, time.monotonic_ns())

    def stop(self) -> None:
        """Publish speed zero, also while ROS hangs with another message.

        Raises:
            OSError: it could not be published.
        """
        self._stops += 1
        free = self._writing.acquire(timeout=_LOCK_PATIENCE_S)
        try:
            if not self._closed:
                self._command(0.0, time.monotonic_ns())
        finally:
            if free:
                self._writing.release()

    def close(self) -> None:
        """Stop and leave ROS. May be called any number of times."""
        if self._closed:
            return
        try:
            self.stop()
        finally:
            self._closed = True
            self._node.close()

    def _command(self, throttle: float, now_ns: int) -> None:
        speed_mps = throttle * self._speed_per_throttle_mps
        self._node.publish_drive(self._publisher, self._steering_rad, speed_mps, now_ns)

    def _take_odometry(self, message: Any) -> None:
        twist = message.twist.twist
        self._take(message, *self._twists.read(float(twist.linear.x), float(twist.angular.z)))

    def _take_ackermann(self, message: Any) -> None:
        self._take(message, float(message.drive.speed), float(message.drive.steering_angle))

    def _take(self, message: Any, speed_mps: float, steering_rad: float) -> None:
        stamp_ns = self._node.monotonic_ns(message.header.stamp)
        finite = math.isfinite(speed_mps) and math.isfinite(steering_rad)
        self._reading = Odometry(stamp_ns, speed_mps, steering_rad, valid=finite)


class RosPublisher:
    """A publisher of every outcome of a pilot: the pose with its covariance, and the command."""

    def __init__(
        self,
        vehicle: VehicleModel,
        odometry_topic: str = "jaxnav/odometry",
        command_topic: str = "jaxnav/command",
        world_frame: str = "map",
        vehicle_frame: str = "base_link",
    ):
        """Args:
        world_frame: name of the poses' frame.
        vehicle_frame: name of the frame midway between the axles, x forward.

        Raises:
            ImportError: ROS 2 or one of its message packages is not there.
        """
        from ackermann_msgs.msg import AckermannDriveStamped
        from nav_msgs.msg import Odometry as OdometryMessage

        self._speed_per_throttle_mps = float(vehicle.speed_per_throttle_mps)
        self._frames = world_frame, vehicle_frame
        self._odometry_type = OdometryMessage
        self._node = Node("jaxnav")
        self._odometry = self._node.publisher(OdometryMessage, odometry_topic)
        self._command = self._node.publisher(AckermannDriveStamped, command_topic)

    def publish(self, outcome: Outcome) -> None:
        """Publish the command, and the pose where it is known.

        Raises:
            OSError: it could not be published.
        """
        speed_mps = outcome.throttle * self._speed_per_throttle_mps
        self._node.publish_drive(self._command, outcome.steering_rad, speed_mps, outcome.now_ns)
        if not outcome.output.located:
            return
        pose = np.asarray(outcome.pose, float)
        velocity = np.asarray(outcome.output.velocity, float)
        covariance = np.asarray(outcome.output.covariance, float)
        if all(np.isfinite(part).all() for part in (pose, velocity, covariance)):
            self._publish_odometry(pose, velocity, covariance, outcome.now_ns)

    def close(self) -> None:
        """Leave ROS. May be called any number of times."""
        self._node.close()

    def _publish_odometry(
        self, pose: np.ndarray, velocity: np.ndarray, covariance: np.ndarray, now_ns: int
    ) -> None:
        """Args:
        pose: x_m, y_m, psi_rad in the world.
        velocity: derivative of the pose.
        covariance: (6, 6) of both.
        """
        message = self._odometry_type()
        message.header.stamp = self._node.stamp(now_ns)
        message.header.frame_id, message.child_frame_id = self._frames
        x_m, y_m, psi_rad = map(float, pose)
        message.pose.pose.position.x, message.pose.pose.position.y = x_m, y_m
        message.pose.pose.orientation.z = math.sin(psi_rad / 2)
        message.pose.pose.orientation.w = math.cos(psi_rad / 2)
        message.pose.covariance = _among_six(covariance[:3, :3])
        # A twist is in the axes of the vehicle, our velocity in those of the world.
        c, s = math.cos(psi_rad), math.sin(psi_rad)
        turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
        twist = message.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = map(float, turn @ velocity)
        message.twist.covariance = _among_six(turn @ covariance[3:6, 3:6] @ turn.T)
        self._node.publish(self._odometry, message)


def _among_six(covariance: np.ndarray) -> list[float]:
    """The 36 numbers of ROS (x, y, z and rotations about x, y, z) from a planar covariance."""
    six = np.zeros((6, 6))
    six[_PLANAR] = covariance
    return [float(value) for value in six.ravel()]
