"""What the node of ROS 2 runs: what a driven vehicle and a rig that moves freely share, and such a
rig, without odometry or with that of other software."""

import copy
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Self

from jaxnav.commands.drive.arguments import Ros
from jaxnav.commands.drive.run import searches_for
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import OdometryErrors
from jaxnav.core.navigator import Navigator
from jaxnav.drive.compiled_step import compiled_step
from jaxnav.drive.interfaces import Camera, Setup
from jaxnav.drive.pilot import Outcome
from jaxnav.drive.signals import Signals
from jaxnav.errors import BadInput
from jaxnav.files import apply_params, load_markers, load_params, load_rig
from jaxnav.files.configuration import step_folder
from jaxnav.files.ros import RosFile
from jaxnav.files.validation import at
from jaxnav.recordings.drive_setup import PILOT_SELECTORS
from jaxnav.recordings.ros.body import BodyTracker
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.recordings.ros.odometry_track import GrowingTrack
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.lenses import await_lenses, with_lenses
from jaxnav.vehicles.ros.odom_frame import IDENTITY, OdomFrame, OdomPose, OdomTf, pose_of
from jaxnav.vehicles.ros.publisher import FrameNames, Publisher
from jaxnav.vehicles.ros2_cameras import open_cameras

LOOK_S = 0.05
_TF = "tf2_msgs/msg/TFMessage"


class Activity:
    """What the node does between `activate` and `deactivate`, in a thread of its own.

    Attributes:
        ended: why it ended by itself; None while it goes on.
        save: writes what it has learnt into new files in a folder, and returns what was written;
            where it can't it raises BadInput, and has written nothing.
    """

    def __init__(
        self,
        work: Callable[[], str | None],
        trip: Callable[[str], None],
        close: Callable[[], None],
        save: Callable[[str], str],
    ):
        """Args:
        work: returns why it has ended by itself; None where it was tripped.
        trip: tells `work` to end, for a reason.
        close: called once it has ended.
        """
        self.ended: str | None = None
        self.save = save
        self._work, self._trip, self._close = work, trip, close
        self._thread = threading.Thread(target=self._works, name="the loop", daemon=True)
        self._thread.start()

    def stop(self, reason: str) -> None:
        """Stop it and wait until all is closed. May be called any number of times."""
        while self._thread.is_alive():
            self._trip(reason)
            self._thread.join(LOOK_S)
        self._close()

    def _works(self) -> None:
        try:
            self.ended = self._work()
        except BaseException as error:  # a plug-in's, or a signal: the node says so and rests
            # A person's mistake or a signal as they are, all else with its kind.
            known = isinstance(error, BadInput) or not isinstance(error, Exception)
            text = str(error)
            self.ended = text if known and text else f"{type(error).__name__}: {text}"


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


class PreparedBody(Prepared):
    """A rig that moves freely."""

    def begin(self) -> Activity:
        connection, searches = self._connection, self._searches
        tracker, ends, over = self._tracker(self.publisher.publish), list[Any](), threading.Event()
        if self._file.odometry is not None:
            clock = connection.source_clock()

            def take(message: Any) -> None:
                pose = pose_of(message.pose.pose.position, message.pose.pose.orientation)
                if pose is not None:
                    tracker.add_odometry(clock.time_ns(message.header.stamp), pose)

            ends.append(connection.listen(NAV_ODOMETRY, self._file.odometry, take))
        cameras = open_cameras(self._setup, None)

        def look(index: int, camera: Camera) -> None:
            def turn() -> None:
                frame = camera.read(LOOK_S)
                if frame is not None:
                    sighted = searches[index].look(frame, None)
                    if sighted.detections is not None:
                        tracker.add(index, sighted.stamp_ns, sighted.detections)

            name, rest = f"camera {camera.name}", lambda problem: over.wait(LOOK_S)
            fenced = connection.contained.wrap(name, turn, rest)
            while not over.is_set():
                fenced()

        def track() -> None:
            threads = [
                threading.Thread(target=look, args=each, daemon=True) for each in enumerate(cameras)
            ]
            for thread in threads:
                thread.start()
            over.wait()
            for thread in threads:
                thread.join(1.0)

        def close() -> None:
            for camera in cameras:
                camera.close()
            connection.forget(*ends)
            tracker.close()

        def save(folder: str) -> str:
            raise BadInput("save", "a rig that moves freely learns nothing of its cameras")

        tracker.start()
        return Activity(track, lambda reason: over.set(), close, save)

    def _read(self) -> Setup:
        for flag, given in (("--record", self._args.record), ("--bag", self._args.bag)):
            if given is not None:
                raise BadInput(flag, "is for drives: the file names no vehicle")
        rig, markers = self._rig(), load_markers(path_of(self._file, "markers"))
        self._connection.ros_time = True  # the same stamps give the same poses, whenever they come
        nothing: Any = None
        options = self._file.options(False, self._connection.sim_time) | {"stamps": "ros"}
        return Setup(rig, markers, nothing, (0.0, 0.0, 0.0), 0, options)

    def _compile(self) -> None:
        file, setup, odometry_errors = self._file, self._setup, None
        if file.odometry is not None:
            sigma = file.odometry_sigma.sigma()
            odometry_errors = OdometryErrors.create(sigma, file.T_vehicle_sensor[4:])
        navigator = Navigator(
            rig=setup.rig,
            markers=setup.markers,
            selector=make_selector(file.selector),
            motion=ConstantVelocity(odometry_errors=odometry_errors),
            corner_sigma_px=file.corner_sigma_px,
        )
        if (params := file.file("params")) is not None:
            navigator = apply_params(navigator, load_params(params))
        self._navigator, self._step = navigator, compiled_step(navigator, step_folder())
        self._searches = searches_for(self._args.corner_backend, setup.rig, setup.markers)
        warm_ups = self._tracker(lambda outcome: None).warm_up, *(s.warm_up for s in self._searches)
        self._timed(lambda: [warm_up() for warm_up in warm_ups])

    def _tracker(self, publish: Callable[[Outcome], None]) -> BodyTracker:
        file, contained, track = self._file, self._connection.contained, None
        if file.odometry is not None:
            track = GrowingTrack(file.T_vehicle_sensor, file.odometry_delay_s)
        cameras = len(file.cameras)
        return BodyTracker(self._navigator, self._step, cameras, publish, track, contained)


def path_of(file: RosFile, key: str) -> Path:
    """The path of a file that the node's file must name.

    Raises:
        BadInput: there is no such file.
    """
    path = file.file(key)
    assert path is not None  # the file has the key
    return path
