"""What driving a car and tracking a rig share in the node of ROS 2: its files and its topics."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.drive.signals import Signals
from jaxnav.errors import BadInput
from jaxnav.files import load_rig
from jaxnav.files.ros import RosFile
from jaxnav.files.validation import at
from jaxnav.recordings.drive_setup import PILOT_SELECTORS
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY, TWIST_TYPES
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.lenses import await_lenses, with_lenses
from jaxnav.vehicles.ros.odom_frame import IDENTITY, OdomFrame, OdomPose, OdomTf
from jaxnav.vehicles.ros.publisher import FrameNames, Publisher

Say = Callable[[str], None]
_TF = "tf2_msgs/msg/TFMessage"


class Activity(Protocol):
    """What the node does between `activate` and `deactivate`."""

    ended: str | None
    """Why it ended by itself; None while it goes on."""

    def stop(self, reason: str) -> None:
        """Stop it and wait until all is closed. May be called any number of times."""
        ...

    def save(self, folder: str) -> str:
        """Write what it has learnt into new files in a folder; return what was written.

        Raises:
            BadInput: it can't, and has written nothing.
        """
        ...


def publisher_for(
    file: RosFile, connection: Connection, markers: MarkerMap, odom: OdomFrame | None
) -> Publisher:
    """The publisher of a node's estimates.

    Raises:
        BadInput: a message package is missing.
    """
    frames = FrameNames(file.frames.map, file.frames.odom, file.frames.base)
    try:
        base_x_m = 0.0 if file.vehicle is None else file.base_x_m
        return Publisher(connection, frames, markers, odom, file.tf_tolerance_s, base_x_m)
    except ImportError as error:
        problem = f"a message package of ROS 2 is missing ({error}): see docs/guide/ros.md"
        raise BadInput("jaxnav ros", problem) from None


def odom_for(file: RosFile, connection: Connection) -> tuple[OdomFrame | None, list[Any]]:
    """What knows odom -> base, and the subscriptions that tell it; None where nothing does."""
    if file.odom_tf:
        of_tf = OdomTf(file.frames.odom, file.frames.base, connection.source_clock)
        return of_tf, [
            connection.listen(_TF, "/tf", of_tf.take),
            connection.listen(_TF, "/tf_static", of_tf.take_static, latched=True),
        ]
    if file.odometry_type != NAV_ODOMETRY or file.odometry is None:
        return None, []
    T_base_sensor = file.T_vehicle_sensor if file.vehicle is None else IDENTITY
    of_pose, clock = OdomPose(T_base_sensor), connection.source_clock()

    def take(message: Any) -> None:
        of_pose.add(clock.time_ns(message.header.stamp), message)

    return of_pose, [connection.listen(NAV_ODOMETRY, file.odometry, take)]


def path_of(file: RosFile, key: str) -> Path:
    """The path of a file that the node's file must name.

    Raises:
        BadInput: there is no such file.
    """
    path = file.file(key)
    assert path is not None  # the file has the key
    return path


def rig_for(file: RosFile, signals: Signals) -> CameraRig:
    """The rig of the file, with the lenses that topics tell.

    Raises:
        BadInput: the rig lacks a camera that the file names, or no lens is told.
    """
    rig = load_rig(path_of(file, "rig"))
    for key in ("cameras", "camera_info"):
        for name in getattr(file, key):
            if name not in rig.names:
                problem = f"the rig has no such camera: it has {', '.join(rig.names)}"
                raise BadInput(at(file.path, f"{key}.{name}"), problem)
    lenses = await_lenses(file.path, file.camera_info, file.is_rectified, signals.check)
    return with_lenses(rig, lenses) if lenses else rig


def check_vehicle(file: RosFile, vehicle: Vehicle | TwistBase) -> None:
    """Refuse keys that do not go with the vehicle that the file names.

    Raises:
        BadInput: names file and key.
    """
    if file.imu is not None and vehicle.gyro is None:
        raise BadInput(at(file.path, "imu"), f"{file.vehicle} has no gyro")
    if not isinstance(vehicle, TwistBase):
        return
    what = "of a base that is no car"
    if file.odometry_type not in TWIST_TYPES:
        problem = f"{what} must be one of {', '.join(TWIST_TYPES)}"
        raise BadInput(at(file.path, "odometry_type"), problem)
    if file.command_type == "ackermann":
        raise BadInput(at(file.path, "command_type"), f"{what} must be twist")
    if file.base_x_m != 0:
        raise BadInput(at(file.path, "base_x_m"), f"{what} must be 0: its twist is base_link's")


def check_selector(file: RosFile) -> None:
    """Refuse a selector that needs what a simulation alone has.

    Raises:
        BadInput: names file and key.
    """
    if file.selector not in PILOT_SELECTORS:
        expected = ", ".join(PILOT_SELECTORS)
        problem = f"unknown {file.selector!r}: expected one of {expected}"
        raise BadInput(at(file.path, "selector"), problem)


def timed(say: Say, compile_all: Callable[[], object]) -> None:
    """Compile, and say for how long."""
    say("compiling")
    began_s = time.monotonic()
    compile_all()
    say(f"compiled in {time.monotonic() - began_s:.1f} s")
