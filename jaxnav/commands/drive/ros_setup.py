"""What a driven vehicle and a rig that moves freely share in the node of ROS 2."""

import copy
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol, Self

from jaxnav.commands.drive.arguments import Ros
from jaxnav.core.models.rig import CameraRig
from jaxnav.drive.signals import Signals
from jaxnav.errors import BadInput
from jaxnav.files import load_markers, load_rig
from jaxnav.files.ros import RosFile
from jaxnav.files.validation import at
from jaxnav.recordings.drive_setup import PILOT_SELECTORS
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.lenses import await_lenses, with_lenses
from jaxnav.vehicles.ros.odom_frame import IDENTITY, OdomFrame, OdomPose, OdomTf
from jaxnav.vehicles.ros.publisher import FrameNames, Publisher

LOOK_S = 0.05
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


class Prepared(ABC):
    """What the node runs, with its files read and its programs compiled.

    Attributes:
        publisher: of its estimates.
    """

    def __init__(
        self,
        args: Ros,
        file: RosFile,
        connection: Connection,
        signals: Signals,
        say: Callable[[str], None],
    ):
        """Read, compile, and begin to listen to who knows odom -> base.

        Args:
            say: takes a line for a person.

        Raises:
            BadInput: a file is wrong, or a message package is missing; names file and key.
        """
        self._args, self._file, self._connection = args, file, connection
        self._signals, self._say = signals, say
        if file.selector not in PILOT_SELECTORS:
            problem = f"unknown {file.selector!r}: expected one of {', '.join(PILOT_SELECTORS)}"
            raise BadInput(at(file.path, "selector"), problem)
        self._setup = self._read()
        self._compile()
        self._listening = list[Any]()
        odom = None if args.bag is not None else self._odom()
        frames = FrameNames(file.frames.map, file.frames.odom, file.frames.base)
        base_x_m = 0.0 if file.vehicle is None else file.base_x_m
        markers, tolerance_s = self._setup.markers, file.tf_tolerance_s
        try:
            self.publisher = Publisher(connection, frames, markers, odom, tolerance_s, base_x_m)
        except ImportError as error:
            problem = f"a message package of ROS 2 is missing ({error}): see docs/guide/ros.md"
            raise BadInput("jaxnav ros", problem) from None

    def with_markers(self, path: str) -> Self:
        """The same with another map, compiled for it; this one is as it was.

        Raises:
            BadInput: the file is wrong, or does not fit the others.
        """
        other = copy.copy(self)
        other._file = self._file.with_markers(path)
        markers = load_markers(path_of(other._file, "markers"))
        other._setup = replace(self._setup, markers=markers)
        other._compile()
        return other

    def show_map(self) -> None:
        """Send a picture of the map."""
        self.publisher.show_map(self._setup.markers)

    @abstractmethod
    def begin(self) -> Activity:
        """Begin, with nothing known."""

    def close(self) -> None:
        """Leave the topics."""
        self.publisher.close()
        self._connection.forget(*self._listening)

    @abstractmethod
    def _read(self) -> Any:
        """Read the files; what comes of them has `rig` and `markers`."""

    @abstractmethod
    def _compile(self) -> None:
        """Compile for the file and the setup."""

    def _timed(self, compile_all: Callable[[], object]) -> None:
        """Compile, and say for how long."""
        self._say("compiling")
        began_s = time.monotonic()
        compile_all()
        self._say(f"compiled in {time.monotonic() - began_s:.1f} s")

    def _odom(self) -> OdomFrame | None:
        """Listen to what knows odom -> base; None where nothing does."""
        file, connection = self._file, self._connection
        if file.odom_tf:
            of_tf = OdomTf(file.frames.odom, file.frames.base, connection.source_clock)
            self._listening = [
                connection.listen(_TF, "/tf", of_tf.take),
                connection.listen(_TF, "/tf_static", of_tf.take_static, latched=True),
            ]
            return of_tf
        if file.odometry_type != NAV_ODOMETRY or file.odometry is None:
            return None
        T_base_sensor = file.T_vehicle_sensor if file.vehicle is None else IDENTITY
        of_pose, clock = OdomPose(T_base_sensor), connection.source_clock()

        def take(message: Any) -> None:
            of_pose.add(clock.time_ns(message.header.stamp), message)

        self._listening = [connection.listen(NAV_ODOMETRY, file.odometry, take)]
        return of_pose

    def _rig(self) -> CameraRig:
        """The rig of the file, with the lenses that topics give.

        Raises:
            BadInput: the rig lacks a camera that the file names, or a topic gives no lens.
        """
        file = self._file
        rig = load_rig(path_of(file, "rig"))
        for key in ("cameras", "camera_info"):
            for name in getattr(file, key):
                if name not in rig.names:
                    problem = f"the rig has no such camera: it has {', '.join(rig.names)}"
                    raise BadInput(at(file.path, f"{key}.{name}"), problem)
        check = self._signals.check
        lenses = await_lenses(file.path, file.camera_info, file.is_rectified, check)
        return with_lenses(rig, lenses) if lenses else rig


def path_of(file: RosFile, key: str) -> Path:
    """The path of a file that the node's file must name.

    Raises:
        BadInput: there is no such file.
    """
    path = file.file(key)
    assert path is not None  # the file has the key
    return path
