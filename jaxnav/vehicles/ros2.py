"""Connect to a vehicle behind ROS 2 topics.

Options, `--option KEY=VALUE`:

    odometry_topic (/odom), odometry_type (nav_msgs/msg/Odometry, or another of
        `jaxnav.ros.odometry_messages`; of a JointState also driven, steered: names of joints with
        commas between them, and wheel_radius_m)
    command_topic (/drive), command_type (ackermann: ackermann_msgs/AckermannDriveStamped whose
        speed is throttle * speed_per_throttle_mps; twist: geometry_msgs/Twist; none: somebody else
        drives)
    sim_time (false): true takes the time of /clock

ROS is not needed to install jaxnav; it is imported when something here is opened.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from jaxnav.errors import BadInput
from jaxnav.loop.interfaces import Odometry, Setup, Vehicle
from jaxnav.loop.limits import Limits
from jaxnav.models.twists import TwistReader, twist_of
from jaxnav.ros.connection import Connection, message_type
from jaxnav.ros.odometry_messages import ACKERMANN, JOINTS, ODOMETRY_TYPES, WheelJoints, odometry
from jaxnav.vehicles.options import choice, number

if TYPE_CHECKING:  # the guard's process opens the vehicle without JAX
    from collections.abc import Mapping

    from jaxnav.models.bicycle import Vehicle as VehicleModel

_LOCK_PATIENCE_S = 0.03  # a `stop` waits this long for a message that another thread publishes
_SHORT = {"odometry": ODOMETRY_TYPES[0], "ackermann": ACKERMANN}  # names of earlier releases
_COMMANDS = {"ackermann": ACKERMANN, "twist": "geometry_msgs/msg/Twist"}


def open_vehicle(setup: Setup) -> Vehicle:
    """Open the vehicle behind the topics.

    Raises:
        ImportError: ROS 2 or one of its message packages is not there.
        BadInput: an option is wrong.
    """
    return RosVehicle(setup.vehicle, setup.options)


class RosVehicle:
    """A vehicle behind ROS topics. A read gives the last message, with that message's stamp."""

    timeout_s = math.inf  # a subscriber may stop by itself, but does not say so

    def __init__(self, vehicle: VehicleModel, options: Mapping[str, str]):
        """Subscribe to the odometry.

        Args:
            options: see the module.
        """
        kind = choice(options, "odometry_type", (*ODOMETRY_TYPES, *_SHORT))
        self._kind = _SHORT.get(kind, kind)
        self._joints = _joints(options) if self._kind == JOINTS else None
        command = choice(options, "command_type", (*_COMMANDS, "none"))
        self._limits = Limits.of(vehicle)
        self._wheelbase_m = float(vehicle.wheelbase_m)
        self._twists = TwistReader(self._wheelbase_m, self._limits.steering_rad)
        self._speed_per_throttle_mps = float(vehicle.speed_per_throttle_mps)
        self._topic = options.get("odometry_topic", "/odom")
        self._reading: Odometry | None = None
        self._steering_rad = 0.0
        self._written_ns: int | None = None
        self._closed = False
        self._writing = threading.Lock()  # so that no command follows the zero speed of a `stop`
        self._stops = 0
        sim_time = choice(options, "sim_time", ("false", "true")) == "true"
        self._connection = Connection("jaxnav_vehicle", sim_time)
        self._clock = self._connection.source_clock()
        self._publisher, self._command_type = None, None
        if command != "none":
            topic, kind = options.get("command_topic", "/drive"), _COMMANDS[command]
            self._publisher = self._connection.publisher(kind, topic)
            self._command_type = message_type(kind)
        self._stamped = command == "ackermann"
        self._connection.listen(self._kind, self._topic, self._take)
        self._connection.run()

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
                self._command(throttle)
            finally:
                if self._stops != stops:  # a stop did not wait for this command, which hung
                    self._command(0.0)

    def stop(self) -> None:
        """Publish speed zero, also while ROS hangs with another message.

        Raises:
            OSError: it could not be published.
        """
        self._stops += 1
        free = self._writing.acquire(timeout=_LOCK_PATIENCE_S)
        try:
            if not self._closed:
                self._command(0.0)
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
            self._connection.close()

    def _command(self, throttle: float) -> None:
        if self._command_type is None:
            return
        speed_mps, message = throttle * self._speed_per_throttle_mps, self._command_type()
        if self._stamped:
            message.header.stamp = self._connection.stamp(self._connection.now_ns())
            message.drive.steering_angle = float(self._steering_rad)
            message.drive.speed = float(speed_mps)
        else:  # the velocity along x is that of the rear axle; see `TwistReader`
            twist = twist_of(float(speed_mps), float(self._steering_rad), self._wheelbase_m)
            message.linear.x, message.angular.z = twist
        self._connection.publish(self._publisher, message)

    def _take(self, message: Any) -> None:
        reading = odometry(self._kind, message, self._twists, self._joints)
        stamp_ns = self._clock.time_ns(message.header.stamp)
        self._reading = replace(reading, stamp_ns=stamp_ns)


def _joints(options: Mapping[str, str]) -> WheelJoints:
    names = {}
    for key in ("driven", "steered"):
        names[key] = tuple(name for name in options.get(key, "").split(",") if name)
        if not names[key]:
            raise BadInput(f"--option {key}", "missing: the names of a JointState's joints")
    radius_m = number(options, "wheel_radius_m", math.nan, 0.001, 10.0)
    if math.isnan(radius_m):
        raise BadInput("--option wheel_radius_m", "missing: the radius of the driven wheels")
    return WheelJoints(names["driven"], names["steered"], radius_m)
