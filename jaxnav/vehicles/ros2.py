"""Connect to a vehicle behind ROS 2 topics.

Options, `--option KEY=VALUE`:

    odometry_topic (/odom), odometry_type (nav_msgs/msg/Odometry, or another of
        `recordings.ros.odometry_messages`; of a JointState also driven, steered: names of joints
        with commas between them, and wheel_radius_m)
    command_topic (/drive; /cmd_vel of a base that is no car), command_type (ackermann:
        ackermann_msgs/AckermannDriveStamped whose speed is throttle * speed_per_throttle_mps, not
        of such a base; twist: geometry_msgs/Twist; none: another node drives)
    imu_topic, imu_axis (0,0,1): sensor_msgs/Imu of the vehicle's gyro, and the vehicle's vertical
        in its axes
    sim_time (false): true takes the time of /clock

ROS is not needed to install jaxnav; it is imported when something here is opened.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from jaxnav.core.models.twists import TwistReader, twist_of
from jaxnav.drive.interfaces import (
    MOST_TURNS,
    AnyVehicle,
    GyroReading,
    Reading,
    Setup,
    reading_of,
)
from jaxnav.drive.limits import Command, limits_of, turns_by_twist
from jaxnav.errors import BadInput
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.odometry_messages import (
    ACKERMANN,
    IMU,
    JOINTS,
    ODOMETRY_TYPES,
    TWIST_TYPES,
    WheelJoints,
    gyro,
    odometry,
)
from jaxnav.vehicles.options import choice, number, switch
from jaxnav.vehicles.ros.connection import Connection

if TYPE_CHECKING:  # the guard's process opens the vehicle without JAX
    from collections.abc import Mapping

    from jaxnav.core.models.vehicle import TwistBase
    from jaxnav.core.models.vehicle import Vehicle as VehicleModel

# Until the commands have a subscriber: what is sent before is lost, and a vehicle that gets no
# commands is taken for one that is held fast.
_HEARD_WITHIN_S, _LOOK_S = 5.0, 0.01
_LOCK_PATIENCE_S = 0.03  # a `stop` waits this long for a message that another thread publishes
_SHORT = {"odometry": ODOMETRY_TYPES[0], "ackermann": ACKERMANN}  # names of earlier releases
_COMMANDS = {"ackermann": ACKERMANN, "twist": "geometry_msgs/msg/Twist"}
_CAR_COMMANDS = (*_COMMANDS, "none")
_UNIT = 1e-3  # a vector's length may be off by this


def open_vehicle(setup: Setup) -> AnyVehicle:
    """Open the vehicle behind the topics.

    Raises:
        ImportError: ROS 2 or one of its message packages is not there.
        BadInput: an option is wrong.
    """
    return RosVehicle(setup.vehicle, setup.options)


class RosVehicle:
    """A vehicle behind ROS topics. A read gives the last message, with that message's stamp."""

    timeout_s = math.inf  # a subscriber may stop by itself, but does not say so

    def __init__(self, vehicle: VehicleModel | TwistBase, options: Mapping[str, str]):
        """Subscribe to the odometry, and wait up to 5 s until the commands have a subscriber.

        Args:
            options: see the module.
        """
        of_base = turns_by_twist(vehicle)
        kinds = TWIST_TYPES if of_base else (*ODOMETRY_TYPES, *_SHORT)
        kind = choice(options, "odometry_type", kinds)
        self._kind = _SHORT.get(kind, kind)
        self._joints = _joints(options) if self._kind == JOINTS else None
        command = choice(options, "command_type", ("twist", "none") if of_base else _CAR_COMMANDS)
        self._limits = limits_of(vehicle)
        self._twists = self._wheelbase_m = self._speed_per_throttle_mps = None
        if not turns_by_twist(vehicle):
            self._wheelbase_m = float(vehicle.wheelbase_m)
            self._twists = TwistReader(self._wheelbase_m, float(vehicle.steering_limit_rad))
            self._speed_per_throttle_mps = float(vehicle.speed_per_throttle_mps)
        self._topic = options.get("odometry_topic", "/odom")
        self._reading: Reading | None = None
        self._turns: deque[GyroReading] = deque(maxlen=MOST_TURNS)
        self._sent = self._limits.zero
        self._written_ns: int | None = None
        self._closed = False
        self._writing = threading.Lock()  # so that no command follows the zero speed of a `stop`
        self._stops = 0
        sim_time = switch(options, "sim_time")
        self._connection = Connection("jaxnav_vehicle", sim_time)
        self._clock = self._connection.source_clock()
        self._publisher, self._command_type = None, None
        if command != "none":
            topic = options.get("command_topic", "/cmd_vel" if of_base else "/drive")
            kind = _COMMANDS[command]
            self._publisher = self._connection.publisher(kind, topic)
            self._command_type = message_type(kind)
        self._stamped = command == "ackermann"
        self._connection.listen(self._kind, self._topic, self._take, failed=self._take_nothing)
        if "imu_topic" in options:
            self._axis = _axis(options)
            self._gyro_clock = self._connection.source_clock()
            topic = options["imu_topic"]
            self._connection.listen(IMU, topic, self._take_turn, failed=self._take_no_turn)
        self._connection.run()
        end_s = time.monotonic() + _HEARD_WITHIN_S
        while not self._is_heard and time.monotonic() < end_s:
            time.sleep(_LOOK_S)

    def read(self) -> Any:
        """The latest message, with its own stamp.

        Raises:
            OSError: there was none yet, or the vehicle is closed.
        """
        if self._closed:
            raise OSError("the ROS vehicle is closed")
        if self._reading is None:
            raise OSError(f"no message on {self._topic} yet")
        return self._reading

    def read_gyro(self) -> list[GyroReading]:
        """See `HasGyro`: the messages of the IMU since the last call, the newest of them."""
        readings: list[GyroReading] = []
        while self._turns:
            readings.append(self._turns.popleft())
        return readings

    def write(self, *command: float) -> None:
        """Publish a command, clamped to the limits.

        Raises:
            OSError: it could not be published, or the vehicle is closed.
        """
        with self._writing:
            if self._closed:
                raise OSError("the ROS vehicle is closed")
            now_ns = time.monotonic_ns()
            before_ns = now_ns if self._written_ns is None else self._written_ns
            self._sent = self._limits.within(command, self._sent, (now_ns - before_ns) / 1e9)
            self._written_ns = now_ns
            stops = self._stops
            try:
                self._command(self._sent)
            finally:
                if self._stops != stops:  # a stop did not wait for this command, which hung
                    self._command(self._limits.standing(self._sent))

    def stop(self) -> None:
        """Publish speed zero, also while ROS hangs with another message.

        Raises:
            OSError: it could not be published.
        """
        self._stops += 1
        free = self._writing.acquire(timeout=_LOCK_PATIENCE_S)
        try:
            if not self._closed:
                self._command(self._limits.standing(self._sent))
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

    @property
    def _is_heard(self) -> bool:
        """Whether the commands have a subscriber, or there are none."""
        return self._publisher is None or self._publisher.get_subscription_count() > 0

    def _command(self, command: Command) -> None:
        if self._command_type is None:
            return
        message = self._command_type()
        if self._wheelbase_m is None or self._speed_per_throttle_mps is None:
            message.linear.x, message.linear.y, message.angular.z = map(float, command)
            self._connection.publish(self._publisher, message)
            return
        steering_rad, speed_mps = float(command[0]), command[1] * self._speed_per_throttle_mps
        if self._stamped:
            message.header.stamp = self._connection.stamp(self._connection.now_ns())
            message.drive.steering_angle = steering_rad
            message.drive.speed = float(speed_mps)
        else:  # the velocity along x is that of the rear axle; see `TwistReader`
            twist = twist_of(float(speed_mps), steering_rad, self._wheelbase_m)
            message.linear.x, message.angular.z = twist
        self._connection.publish(self._publisher, message)

    def _take(self, message: Any) -> None:
        reading = odometry(self._kind, message, self._twists, self._joints)
        stamp_ns = self._clock.time_ns(message.header.stamp)
        self._reading = replace(reading, stamp_ns=stamp_ns)

    def _take_nothing(self) -> None:
        """A message that can't be read is an invalid reading of now, which the loop flags."""
        nothing = [0.0] * len(self._limits.zero)
        self._reading = reading_of(self._connection.now_ns(), nothing, valid=False)

    def _take_turn(self, message: Any) -> None:
        stamp_ns = self._gyro_clock.time_ns(message.header.stamp)
        self._turns.append(replace(gyro(message, self._axis), stamp_ns=stamp_ns))

    def _take_no_turn(self) -> None:
        self._turns.append(GyroReading(self._connection.now_ns(), math.nan))


def _axis(options: Mapping[str, str]) -> tuple[float, float, float]:
    """The vehicle's vertical in the axes of its IMU.

    Raises:
        BadInput: these are no three numbers of a unit vector.
    """
    text = options.get("imu_axis", "0,0,1")
    try:
        x, y, z = (float(part) for part in text.split(","))
    except ValueError:
        x = y = z = math.nan
    if not abs(math.hypot(x, y, z) - 1) < _UNIT:
        raise BadInput(
            "--option imu_axis", f"expected three numbers of a unit vector, got {text!r}"
        )
    return x, y, z


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
