"""`jaxnav ros`: a lifecycle node of ROS 2 around the loop that `jaxnav run` has.

configure    reads the files and compiles
activate     opens vehicle and cameras and begins to drive or to localise
deactivate   stops the vehicle and leaves the topics
"""

import sys
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Protocol

from jaxnav.belief.constant_velocity import ConstantVelocity
from jaxnav.belief.selectors import make_selector
from jaxnav.commands.drive.arguments import Ros, Run
from jaxnav.commands.drive.observers import DriveRecorder
from jaxnav.commands.drive.run import Drive, compiled_pilot, guarding_process, searches_for
from jaxnav.commands.process import configure_jax
from jaxnav.compiling.executables import keep_in
from jaxnav.compiling.step import compiled_step
from jaxnav.configuration import step_folder
from jaxnav.errors import BadInput, visible
from jaxnav.files import (
    Params,
    Route,
    apply_params,
    load_markers,
    load_params,
    load_rig,
    load_route,
    load_vehicle,
)
from jaxnav.files.ros import RosFile, load_ros
from jaxnav.files.validation import at
from jaxnav.loop.flags import Fault
from jaxnav.loop.frames import FrameDetections
from jaxnav.loop.interfaces import Camera, Frame, Setup
from jaxnav.loop.pilot import Input, Outcome
from jaxnav.loop.seeing import Search
from jaxnav.loop.signals import Signals
from jaxnav.models.markers import MarkerMap
from jaxnav.navigator import Navigator
from jaxnav.recording.drive_setup import PILOT_SELECTORS, DriveSetup
from jaxnav.ros.body import BodyTracker
from jaxnav.ros.connection import Connection, message_type
from jaxnav.ros.estimates import Report, report_of_drive
from jaxnav.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.ros.publisher import FrameNames, OdomPose, Publisher
from jaxnav.vehicles.ros2_cameras import open_cameras

_LOOK_S = 0.05
_CLOCK_S = 10.0  # for the first message of /clock
_LEAST_NS = 18_000_000  # between two estimates of which the later has no new corners
_NOWHERE = Route(((0.0, 0.0),), 0.15, (0.0, 0.0, 0.0))  # of who does not drive
EXIT_STOPPED = 1


class Activity(Protocol):
    """What the node does between `activate` and `deactivate`."""

    ended: str | None
    """Why it ended by itself; None while it goes on."""

    def stop(self, reason: str) -> None:
        """Stop it and wait until all is closed. May be called any number of times."""
        ...


def run(args: Ros, signals: Signals) -> int:
    """Run the node until a signal ends it or, unless it is managed, the drive ends.

    Raises:
        BadInput: a file, a topic or an option is wrong; where managed, the transition fails.
        Interrupted: a signal came.
    """
    configure_jax(float64=args.float64, threads=1)
    keep_in(step_folder())
    node = _Node(args, signals)
    try:
        if not args.managed:
            node.begin()
        node.connection.run()
        while args.managed or node.ended is None:
            signals.check()
            time.sleep(_LOOK_S)
        return EXIT_STOPPED
    finally:
        node.close()


class _Node:
    """The node: its transitions, and what it has made by them."""

    def __init__(self, args: Ros, signals: Signals):
        self._args, self._signals = args, signals
        self._prepared: Callable[[], Activity] | None = None
        self._activity: Activity | None = None
        self._problem: BadInput | None = None
        self.ended: str | None = None
        try:
            self.connection = Connection(
                "jaxnav", make_node=partial(_lifecycle_node, self), args=list(args.ros_args)
            )
        except ImportError as error:
            problem = f"ROS 2 is missing ({error}): source its setup.bash, or see docs/guide/ros.md"
            raise BadInput("jaxnav ros", problem) from None
        except OSError as error:
            raise BadInput("--ros-args", str(error)) from None
        self._node: Any = self.connection.node
        given = self._node.declare_parameter("file", "").value
        self._file = str(args.file or given)
        self._timer = self._node.create_timer(_LOOK_S, self._look)
        self._node.create_service(message_type("std_srvs/srv/Trigger"), "~/reset", self._reset)

    def begin(self) -> None:
        """Configure and activate.

        Raises:
            BadInput: what was wrong.
        """
        for step in (self._node.trigger_configure, self._node.trigger_activate):
            step()
            if self._problem is not None:
                raise self._problem

    def close(self) -> None:
        """Deactivate, and leave ROS."""
        self._stop("the node ends")
        self.connection.close()

    def took(self, transition: str) -> bool:
        """Go through a transition; whether it went well. Called in the thread of ROS."""
        try:
            getattr(self, f"_{transition}")()
        except BadInput as error:
            self._problem = error
            if self._args.managed:
                self._say(f"{transition}: {error}")
            return False
        except Exception as error:  # ROS would print a trace of its own and go on
            self._problem = BadInput(transition, f"{type(error).__name__}: {error}")
            self._say(str(self._problem))
            return False
        self._problem = None
        return True

    def _configure(self) -> None:
        if not self._file:
            raise BadInput("file", "missing: the node's YAML file, as argument or as parameter")
        file = load_ros(self._file)
        if file.selector not in PILOT_SELECTORS:
            expected = ", ".join(PILOT_SELECTORS)
            problem = f"unknown {file.selector!r}: expected one of {expected}"
            raise BadInput(at(file.path, "selector"), problem)
        make = _body if file.vehicle is None else _drive
        self._prepared = make(self._args, file, self.connection, self._signals, self._say)

    def _activate(self) -> None:
        if self._prepared is None:
            raise BadInput("activate", "the node is not configured")
        if self.connection.sim_time:
            self._await_clock()
        self.ended = None
        self._activity = self._prepared()

    def _deactivate(self) -> None:
        self._stop("deactivated")

    def _cleanup(self) -> None:
        self._stop("cleaned up")
        self._prepared = None

    def _shutdown(self) -> None:
        self._cleanup()

    def _stop(self, reason: str) -> None:
        activity, self._activity = self._activity, None
        if activity is not None:
            activity.stop(reason)

    def _look(self) -> None:
        """Leave the active state where the activity has ended by itself."""
        if self._activity is not None and self._activity.ended is not None:
            why = self._activity.ended
            self._say(f"ended: {why}")
            self._node.trigger_deactivate()
            self.ended = why

    def _reset(self, request: Any, response: Any) -> Any:
        """Begin anew: nothing is known of the pose."""
        response.success, response.message = False, "the node is not active"
        if self._activity is not None and self._prepared is not None:
            self._stop("reset")
            response.success, response.message = True, "begun anew"
            try:
                self._activity = self._prepared()
            except BadInput as error:
                response.success, response.message = False, str(error)
        return response

    def _await_clock(self) -> None:
        until_s = time.monotonic() + _CLOCK_S
        while not self.connection.now_ns():
            if time.monotonic() > until_s:
                raise BadInput("use_sim_time", f"no message on /clock for {_CLOCK_S:g} s")
            self._signals.check()
            self.connection.spin_some()

    def _say(self, text: str) -> None:
        sys.stderr.write(f"jaxnav ros: {visible(text)}\n")


def _lifecycle_node(owner: _Node, name: str, context: Any) -> Any:
    """A lifecycle node whose transitions are those of its owner."""
    from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

    def step(transition: str) -> Callable[[Any, Any], Any]:
        def took(self: Any, state: Any) -> Any:
            good = owner.took(transition)
            return TransitionCallbackReturn.SUCCESS if good else TransitionCallbackReturn.FAILURE

        return took

    steps = ("configure", "activate", "deactivate", "cleanup", "shutdown")
    kind = type("JaxnavNode", (LifecycleNode,), {f"on_{one}": step(one) for one in steps})
    return kind(name, context=context)


def _drive(
    args: Ros, file: RosFile, connection: Connection, signals: Signals, say: Callable[[str], None]
) -> Callable[[], Activity]:
    """Read the files of a car, and compile; returns what begins a drive."""
    drives = file.route is not None
    setup = DriveSetup(
        rig=load_rig(_path(file, "rig")),
        markers=load_markers(_path(file, "markers")),
        vehicle=load_vehicle(_path(file, "vehicle")),
        route=load_route(_path(file, "route")) if drives else _NOWHERE,
        selector=file.selector,
        float64=args.float64,
        drives=drives,
    )
    _check_cameras(file, setup.rig.names)
    if (params := file.file("params")) is not None:
        setup = setup.with_params(load_params(params))
    options = file.options(drives, connection.sim_time)
    loop_args = Run(
        car="ros2",
        cameras="jaxnav.vehicles.ros2_cameras:open_cameras",
        corner_backend=args.corner_backend,
        period_s=args.period_s,
        timeout_s=args.timeout_s,
        float64=args.float64,
        headless=True,
    )
    searches = searches_for(args.corner_backend, setup.rig, setup.markers)
    say("compiling")
    began_s = time.monotonic()
    compiled_pilot(loop_args, setup, searches)
    say(f"compiled in {time.monotonic() - began_s:.1f} s")
    start = setup.route_on_map.start_pose
    vehicle_setup = Setup(setup.rig, setup.markers, setup.vehicle, start, 0, options)
    odom = None
    if file.odometry_type == NAV_ODOMETRY and file.odometry is not None:
        odom = OdomPose()
        connection.listen(
            NAV_ODOMETRY,
            file.odometry,
            lambda message: odom.add(connection.time_ns(message.header.stamp), message),
        )
    publisher = _publisher(file, connection, setup.markers, odom)

    def begin() -> Activity:
        pilot = setup.pilot(step_folder())
        pilot.warm_up()
        observers: list[Any] = [_Reporter(publisher.publish, file.base_x_m)]
        if args.record is not None:
            observers.append(DriveRecorder(args.record, setup, images=False))
        guarding = guarding_process(loop_args)
        if guarding is not None:
            guarding.prepare(signals.check)
        drive = Drive(
            loop_args, vehicle_setup, guarding, signals, until_arrival=False,
            now_ns=connection.now_ns,
        )  # fmt: skip
        return _Driving(drive, partial(drive.run, pilot, searches, observers), observers, say)

    return begin


class _Driving:
    """A drive in a thread of its own. Implements `Activity`."""

    def __init__(
        self,
        drive: Drive,
        run: Callable[[], str],
        observers: list[Any],
        say: Callable[[str], None],
    ):
        self.ended: str | None = None
        self._drive, self._run, self._observers, self._say = drive, run, observers, say
        self._stopping: str | None = None
        self._thread = threading.Thread(target=self._drives, name="the loop", daemon=True)
        self._thread.start()

    def stop(self, reason: str) -> None:
        """See `Activity`."""
        self._stopping = reason
        while self._thread.is_alive():
            if self._drive.guard is not None:
                self._drive.guard.trip(reason)
            self._thread.join(_LOOK_S)
        for observer in self._observers:
            observer.close()
            if observer.closing_note is not None:
                self._say(observer.closing_note)
        self._observers = []
        if self._drive.unheard is not None:
            self._say(f"THE VEHICLE HAS NOT HEARD THAT IT MUST STOP: {self._drive.unheard}")

    def _drives(self) -> None:
        try:
            self.ended = self._run()
        except (
            BaseException
        ) as error:  # of a plug-in, or a signal: the node says so and is inactive
            self.ended = str(error) or type(error).__name__


class _Reporter:
    """An observer that publishes outcomes: each with corners, else every 20 ms."""

    faults = Fault(0)
    closing_note: str | None = None

    def __init__(self, publish: Callable[[Report, int | None], None], base_x_m: float):
        self._publish, self._base_x_m = publish, base_x_m
        self._last_ns = 0

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """See `Observer`."""
        shows = outcome.data is not None and outcome.data.corners_px is not None
        if shows or abs(outcome.now_ns - self._last_ns) > _LEAST_NS:
            self._last_ns = outcome.now_ns
            seen_ns = outcome.stamp_ns if shows else None
            self._publish(report_of_drive(outcome, self._base_x_m), seen_ns)

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """See `Observer`."""

    def close(self) -> None:
        """See `Onlooker`."""


def _body(
    args: Ros, file: RosFile, connection: Connection, signals: Signals, say: Callable[[str], None]
) -> Callable[[], Activity]:
    """Read the files of a rig that moves freely, and compile; returns what begins to track it."""
    if args.record is not None:
        raise BadInput("--record", "records drives: the file names no vehicle")
    rig, markers = load_rig(_path(file, "rig")), load_markers(_path(file, "markers"))
    _check_cameras(file, rig.names)
    navigator = Navigator(
        rig=rig,
        markers=markers,
        selector=make_selector(file.selector),
        motion=ConstantVelocity(),
        corner_sigma_px=file.corner_sigma_px,
    )
    params = file.file("params")
    navigator = apply_params(
        navigator, Params.of({}, "") if params is None else load_params(params)
    )
    searches = searches_for(args.corner_backend, rig, markers)
    connection.ros_time = True  # of stamps that differ by nothing else two runs are the same
    say("compiling")
    began_s = time.monotonic()
    step = compiled_step(navigator, step_folder())
    BodyTracker(navigator, step, 1, lambda report: None).warm_up()
    say(f"compiled in {time.monotonic() - began_s:.1f} s")
    publisher = _publisher(file, connection, markers, None)
    nothing: Any = None
    setup = Setup(
        rig, markers, nothing, (0.0, 0.0, 0.0), 0,
        file.options(False, connection.sim_time) | {"stamps": "ros"},
    )  # fmt: skip

    def begin() -> Activity:
        tracker = BodyTracker(navigator, step, len(file.cameras), publisher.publish)
        return _Tracking(tracker, open_cameras(setup, None), searches)

    return begin


class _Tracking:
    """The tracking of a rig, with a thread for each camera. Implements `Activity`."""

    ended: str | None = None

    def __init__(self, tracker: BodyTracker, cameras: Sequence[Camera], searches: Sequence[Search]):
        self._tracker, self._cameras, self._searches = tracker, cameras, searches
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
        self._tracker.close()

    def _look(self, index: int) -> None:
        try:
            while not self._over.is_set():
                frame = self._cameras[index].read(_LOOK_S)
                if frame is None:
                    continue
                sighted = self._searches[index].look(frame, None)
                if sighted.detections is not None:
                    self._tracker.add(index, sighted.stamp_ns, sighted.detections)
        except Exception as error:  # whatever it is, a camera that is not read any more is said
            self.ended = f"camera {self._cameras[index].name}: {type(error).__name__}: {error}"


def _publisher(
    file: RosFile, connection: Connection, markers: MarkerMap, odom: OdomPose | None
) -> Publisher:
    frames = FrameNames(file.frames.map, file.frames.odom, file.frames.base)
    try:
        return Publisher(connection, frames, markers, odom, file.tf_tolerance_s)
    except ImportError as error:
        problem = f"a message package of ROS 2 is missing ({error}): see docs/guide/ros.md"
        raise BadInput("jaxnav ros", problem) from None


def _path(file: RosFile, key: str) -> Path:
    path = file.file(key)
    assert path is not None  # the file has the key
    return path


def _check_cameras(file: RosFile, names: Sequence[str]) -> None:
    for name in file.cameras:
        if name not in names:
            problem = f"the rig has no such camera: it has {', '.join(names)}"
            raise BadInput(at(file.path, f"cameras.{name}"), problem)
