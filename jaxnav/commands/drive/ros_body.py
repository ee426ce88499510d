"""A rig that moves freely in the node of ROS 2, without odometry or with that of other software."""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from jaxnav.commands.drive.arguments import Ros
from jaxnav.commands.drive.ros_setup import (
    Activity,
    Say,
    check_selector,
    odom_for,
    path_of,
    publisher_for,
    rig_for,
    timed,
)
from jaxnav.commands.drive.run import searches_for
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import OdometryErrors
from jaxnav.core.navigator import Navigator, Step
from jaxnav.drive.compiled_step import compiled_step
from jaxnav.drive.interfaces import Camera, Setup
from jaxnav.drive.pilot import Outcome
from jaxnav.drive.seeing import Search
from jaxnav.drive.signals import Signals
from jaxnav.errors import BadInput
from jaxnav.files import Params, apply_params, load_markers, load_params
from jaxnav.files.configuration import step_folder
from jaxnav.files.ros import RosFile
from jaxnav.recordings.ros.body import BodyTracker
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.recordings.ros.odometry_track import GrowingTrack
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.odom_frame import pose_of
from jaxnav.vehicles.ros2_cameras import open_cameras

_LOOK_S = 0.05


class PreparedBody:
    """A rig that moves freely, with its files read and its step compiled.

    Attributes:
        file: the node's.
    """

    def __init__(
        self, args: Ros, file: RosFile, connection: Connection, signals: Signals, say: Say
    ):
        """Read and compile.

        Raises:
            BadInput: a file is wrong; names file and key.
        """
        self.file = file
        check_selector(file)
        for flag, given in (("--record", args.record), ("--bag", args.bag)):
            if given is not None:
                raise BadInput(flag, "is for drives: the file names no vehicle")
        self._args, self._say, self._connection = args, say, connection
        rig, markers = rig_for(file, signals), load_markers(path_of(file, "markers"))
        connection.ros_time = True  # the same stamps give the same poses, whenever they come
        self._navigator, self._step, self._searches = self._compiled(file, rig, markers)
        odom, listening = odom_for(file, connection)
        self._leave = partial(connection.forget, *listening)
        self._publisher = publisher_for(file, connection, markers, odom)
        nothing: Any = None
        options = file.options(False, connection.sim_time) | {"stamps": "ros"}
        self._setup = Setup(rig, markers, nothing, (0.0, 0.0, 0.0), 0, options)

    def with_markers(self, path: str) -> Callable[[], None]:
        """See `PreparedDrive`."""
        file, rig = self.file.with_markers(path), self._navigator.rig
        markers = load_markers(path_of(file, "markers"))
        compiled, setup = self._compiled(file, rig, markers), replace(self._setup, markers=markers)

        def take() -> None:
            self.file, self._setup = file, setup
            self._navigator, self._step, self._searches = compiled
            self._publisher.show_map(markers)

        return take

    def begin(self) -> Activity:
        """Begin to track it, with nothing known."""
        tracker = self._tracker(self._navigator, self._step, self._publisher.publish)
        ends: list[Any] = []
        if self.file.odometry is not None:
            clock = self._connection.source_clock()

            def take(message: Any) -> None:
                pose = pose_of(message.pose.pose.position, message.pose.pose.orientation)
                if pose is not None:
                    tracker.add_odometry(clock.time_ns(message.header.stamp), pose)

            ends.append(self._connection.listen(NAV_ODOMETRY, self.file.odometry, take))
        cameras = open_cameras(self._setup, None)
        return _Tracking(tracker, cameras, self._searches, self._connection, ends)

    def close(self) -> None:
        """Leave the topics."""
        self._publisher.close()
        self._leave()

    def _compiled(
        self, file: RosFile, rig: CameraRig, markers: MarkerMap
    ) -> tuple[Navigator, Step, list[Search]]:
        """The navigator, its compiled step, and the searches, all of them warm."""
        navigator = Navigator(
            rig=rig,
            markers=markers,
            selector=make_selector(file.selector),
            motion=ConstantVelocity(odometry_errors=_errors(file)),
            corner_sigma_px=file.corner_sigma_px,
        )
        params = file.file("params")
        params_read = Params.from_values({}, "") if params is None else load_params(params)
        navigator = apply_params(navigator, params_read)
        step = compiled_step(navigator, step_folder())
        searches = searches_for(self._args.corner_backend, rig, markers)
        tracker = self._tracker(navigator, step, lambda outcome: None)
        others = [search.warm_up for search in searches]
        timed(self._say, lambda: [warm_up() for warm_up in (tracker.warm_up, *others)])
        return navigator, step, searches

    def _tracker(
        self, navigator: Navigator, step: Step, publish: Callable[[Outcome], None]
    ) -> BodyTracker:
        file, contained = self.file, self._connection.contained
        track = None
        if file.odometry is not None:
            track = GrowingTrack(file.T_vehicle_sensor, file.odometry_delay_s)
        return BodyTracker(navigator, step, len(file.cameras), publish, track, contained)


def _errors(file: RosFile) -> OdometryErrors | None:
    """The errors that the filter keeps of the odometry; None without one."""
    if file.odometry is None:
        return None
    return OdometryErrors.create(file.odometry_sigma.sigma(), file.T_vehicle_sensor[4:])


class _Tracking:
    """The tracking of a rig, with a thread for each camera. Implements `Activity`."""

    ended: str | None = None

    def __init__(
        self,
        tracker: BodyTracker,
        cameras: Sequence[Camera],
        searches: Sequence[Search],
        connection: Connection,
        ends: Sequence[Any],
    ):
        """Args:
        ends: the topics to leave.
        """
        self._tracker, self._cameras, self._searches = tracker, cameras, searches
        self._connection, self._ends = connection, ends
        self._over = threading.Event()
        tracker.start()
        self._threads = [
            threading.Thread(target=self._look, args=(index,), daemon=True)
            for index in range(len(cameras))
        ]
        for thread in self._threads:
            thread.start()

    def stop(self, reason: str) -> None:
        """See `Activity`."""
        self._over.set()
        for camera in self._cameras:
            camera.close()
        for thread in self._threads:
            thread.join(1.0)
        self._connection.forget(*self._ends)
        self._tracker.close()

    def save(self, folder: str) -> str:
        """See `Activity`."""
        raise BadInput("save", "a rig that moves freely learns nothing of its cameras")

    def _look(self, index: int) -> None:
        camera = self._cameras[index]
        turn = self._connection.contained.of(f"camera {camera.name}", self._turn, self._rest)
        while not self._over.is_set():
            turn(index)

    def _turn(self, index: int) -> None:
        frame = self._cameras[index].read(_LOOK_S)
        if frame is not None:
            sighted = self._searches[index].look(frame, None)
            if sighted.detections is not None:
                self._tracker.add(index, sighted.stamp_ns, sighted.detections)

    def _rest(self, problem: str, index: int) -> None:
        self._over.wait(_LOOK_S)
