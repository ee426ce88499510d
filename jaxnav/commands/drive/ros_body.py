"""A rig that moves freely in the node of ROS 2, without odometry or with that of other software."""

import threading
from collections.abc import Callable, Sequence
from typing import Any

from jaxnav.commands.drive.ros_setup import LOOK_S, Activity, Prepared, path_of
from jaxnav.commands.drive.run import searches_for
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.models.vehicle import OdometryErrors
from jaxnav.core.navigator import Navigator
from jaxnav.drive.compiled_step import compiled_step
from jaxnav.drive.interfaces import Camera, Setup
from jaxnav.drive.pilot import Outcome
from jaxnav.drive.seeing import Search
from jaxnav.errors import BadInput
from jaxnav.files import apply_params, load_markers, load_params
from jaxnav.files.configuration import step_folder
from jaxnav.recordings.ros.body import BodyTracker
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.recordings.ros.odometry_track import GrowingTrack
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.odom_frame import pose_of
from jaxnav.vehicles.ros2_cameras import open_cameras


class PreparedBody(Prepared):
    """A rig that moves freely."""

    def begin(self) -> Activity:
        tracker, ends = self._tracker(self.publisher.publish), list[Any]()
        if self._file.odometry is not None:
            clock = self._connection.source_clock()

            def take(message: Any) -> None:
                pose = pose_of(message.pose.pose.position, message.pose.pose.orientation)
                if pose is not None:
                    tracker.add_odometry(clock.time_ns(message.header.stamp), pose)

            ends.append(self._connection.listen(NAV_ODOMETRY, self._file.odometry, take))
        cameras = open_cameras(self._setup, None)
        return _Tracking(tracker, cameras, self._searches, self._connection, ends)

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
        frame = self._cameras[index].read(LOOK_S)
        if frame is not None:
            sighted = self._searches[index].look(frame, None)
            if sighted.detections is not None:
                self._tracker.add(index, sighted.stamp_ns, sighted.detections)

    def _rest(self, problem: str, index: int) -> None:
        self._over.wait(LOOK_S)
