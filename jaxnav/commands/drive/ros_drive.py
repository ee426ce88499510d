"""A vehicle in the node of ROS 2: driven, localised while others drive, or played from a bag."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from jaxnav.commands.drive.arguments import Ros, Run
from jaxnav.commands.drive.learnt_watch import ExposureWatch
from jaxnav.commands.drive.observers import DriveRecorder, closing_notes
from jaxnav.commands.drive.ros_save import LearntKeeper
from jaxnav.commands.drive.ros_setup import (
    Activity,
    Say,
    check_selector,
    check_vehicle,
    odom_for,
    path_of,
    publisher_for,
    rig_for,
    timed,
)
from jaxnav.commands.drive.run import Drive, compiled_pilot, guarding_process, searches_for
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import Frame, Setup
from jaxnav.drive.loop import Fenced
from jaxnav.drive.pilot import Input, Outcome, Pilot
from jaxnav.drive.seeing import Search
from jaxnav.drive.signals import Signals
from jaxnav.errors import BadInput, Containment
from jaxnav.files import Route, load_markers, load_params, load_route, load_vehicle
from jaxnav.files.configuration import step_folder
from jaxnav.files.ros import RosFile
from jaxnav.files.vehicles import may_resume
from jaxnav.recordings.drive_replay import check_inputs
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.ros import read_ros_drive
from jaxnav.recordings.ros import message_type
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros.odom_frame import OdomFrame
from jaxnav.vehicles.ros.publisher import Publisher

OVER = "the bag is over"
_CLOCK = "rosgraph_msgs/msg/Clock"
_CAMERAS = "jaxnav.vehicles.ros2_cameras:open_cameras"
_LOOK_S = 0.05
_LEAST_NS = 18_000_000  # between two estimates of which the later has no new corners
_NOWHERE = Route(((0.0, 0.0),), 0.15, (0.0, 0.0, 0.0))  # of who does not drive


class PreparedDrive:
    """A car with its files read and its programs compiled.

    Attributes:
        file: the node's.
    """

    def __init__(
        self, args: Ros, file: RosFile, connection: Connection, signals: Signals, say: Say
    ):
        """Read, compile, and begin to listen to who knows odom -> base.

        Raises:
            BadInput: a file is wrong; names file and key.
        """
        self.file, self._args, self._signals, self._say = file, args, signals, say
        self._connection, self._drives = connection, file.route is not None
        self._begun = 0
        check_selector(file)
        setup = DriveSetup(
            rig=rig_for(file, signals),
            markers=load_markers(path_of(file, "markers")),
            vehicle=load_vehicle(path_of(file, "vehicle")),
            route=load_route(path_of(file, "route")) if self._drives else _NOWHERE,
            selector=file.selector,
            float64=args.float64,
            drives=self._drives,
        )
        if (params := file.file("params")) is not None:
            setup = setup.with_params(load_params(params))
        check_vehicle(file, setup.vehicle)
        self._setup = setup
        self._run = Run(
            car="ros2",
            cameras=_CAMERAS,
            corner_backend=args.corner_backend,
            period_s=args.period_s,
            timeout_s=args.timeout_s,
            float64=args.float64,
            headless=True,
        )
        self._searches, self._inputs = self._compiled(setup, file)
        odom: OdomFrame | None = None
        self._listening: list[Any] = []
        if args.bag is not None:
            connection.ros_time = True  # the bag's
        else:
            odom, self._listening = odom_for(file, connection)
        self._publisher = publisher_for(file, connection, setup.markers, odom)

    def with_markers(self, path: str) -> Callable[[], None]:
        """Read another map and compile for it; return what takes it. Nothing changes until then.

        Raises:
            BadInput: the file is wrong, or does not fit the others.
        """
        file = self.file.with_markers(path)
        setup = replace(self._setup, markers=load_markers(path_of(file, "markers")))
        searches, inputs = self._compiled(setup, file)

        def take() -> None:
            self.file, self._setup, self._searches, self._inputs = file, setup, searches, inputs
            self._publisher.show_map(setup.markers)

        return take

    def _compiled(
        self, setup: DriveSetup, file: RosFile
    ) -> tuple[list[Search], Sequence[Input] | None]:
        """The searches of a setup whose programs are compiled, and the inputs of a bag."""
        args = self._args
        searches = searches_for(
            args.corner_backend, setup.rig, setup.markers, args.detector == "follow"
        )
        others = [search.warm_up for search in searches]
        others.append(LearntKeeper(file, setup).warm_up)
        timed(self._say, lambda: compiled_pilot(self._run, setup, others))
        if args.bag is None:
            return searches, None
        return searches, _inputs_of(args.bag, file, setup, args.corner_backend)

    def begin(self) -> Activity:
        """Begin a drive in which nothing is known."""
        setup, signals = self._setup, self._signals
        pilot = setup.pilot(step_folder())
        pilot.warm_up()
        reporter = _Reporter(self._publisher)
        keeper = LearntKeeper(self.file, setup)
        exposures = ExposureWatch(setup.rig.names, self._searches)
        observers: list[Any] = [reporter, keeper, exposures, *self._record()]
        if self._inputs is not None:
            return _Playing(
                self._inputs, pilot, observers, keeper, self._connection, self._args.rate, self._say
            )
        guarding = guarding_process(self._run)
        if guarding is not None:
            guarding.prepare(signals.check)
        options = self.file.options(self._drives, self._connection.sim_time)
        start = setup.route_on_map.start_pose
        drive = Drive(
            self._run,
            Setup(setup.rig, setup.markers, setup.vehicle, start, 0, options),
            guarding,
            signals,
            until_arrival=False,
            now_ns=self._connection.now_ns,
            resumes=may_resume(path_of(self.file, "vehicle")),
        )
        run = partial(drive.run, pilot, self._searches, observers)
        return _Driving(drive, run, observers, keeper, self._say)

    def close(self) -> None:
        """Leave the topics."""
        self._publisher.close()
        self._connection.forget(*self._listening)

    def _record(self) -> list[DriveRecorder]:
        """The recorder of one drive; of the second and later ones the file has a number."""
        path = self._args.record
        if path is None:
            return []
        self._begun += 1
        if self._begun > 1:
            path = path.with_stem(f"{path.stem}_{self._begun}")
        return [DriveRecorder(path, self._setup, images=False)]


class _Driving:
    """A drive in a thread of its own. Implements `Activity`."""

    def __init__(
        self,
        drive: Drive,
        run: Callable[[], str],
        observers: list[Any],
        keeper: LearntKeeper,
        say: Say,
    ):
        self.ended: str | None = None
        self.save = keeper.save
        self._drive, self._run, self._observers, self._say = drive, run, observers, say
        self._thread = threading.Thread(target=self._drives, name="the loop", daemon=True)
        self._thread.start()

    def stop(self, reason: str) -> None:
        """See `Activity`."""
        while self._thread.is_alive():
            if self._drive.guard is not None:
                self._drive.guard.trip(reason)
            self._thread.join(_LOOK_S)
        loop = getattr(self._drive, "loop", None)  # a drive that could not begin has none
        _close(self._observers, Containment() if loop is None else loop.contained, self._say)
        if self._drive.heard is not None:
            self._say(self._drive.heard)

    def _drives(self) -> None:
        try:
            self.ended = self._run()
        except BaseException as error:  # a plug-in's, or a signal: the node says so and rests
            self.ended = _named(error)


class _Playing:
    """A drive whose inputs are a bag's, in a thread of its own. Implements `Activity`."""

    def __init__(
        self,
        inputs: Sequence[Input],
        pilot: Pilot,
        observers: list[Any],
        keeper: LearntKeeper,
        connection: Connection,
        rate: float,
        say: Say,
    ):
        """Args:
        rate: times real time.
        """
        self.ended: str | None = None
        self.save = keeper.save
        self._inputs, self._pilot, self._observers = inputs, pilot, observers
        self._contained = Containment()
        self._connection, self._rate, self._say = connection, rate, say
        self._clock = connection.publisher(_CLOCK, "/clock")
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._play, name="the bag", daemon=True)
        self._thread.start()

    def stop(self, reason: str) -> None:
        """See `Activity`."""
        self._over.set()
        self._thread.join()
        _close(self._observers, self._contained, self._say)
        self._connection.forget(self._clock)

    def _play(self) -> None:
        try:
            self._plays()
        except Exception as error:
            self.ended = _named(error)

    def _plays(self) -> None:
        observers = [Fenced(observer, self._contained) for observer in self._observers]
        begin_s, first_ns = time.monotonic(), self._inputs[0].now_ns
        for given in self._inputs:
            due_s = begin_s + (given.now_ns - first_ns) / 1e9 / self._rate
            if self._over.wait(max(due_s - time.monotonic(), 0.0)):
                return
            clock = message_type(_CLOCK)(clock=self._connection.stamp(given.now_ns))
            self._connection.publish(self._clock, clock)
            outcome = self._pilot.handle(given)
            for observer in observers:
                observer.on_outcome(given, outcome)
        self.ended = OVER


class _Reporter:
    """An observer that publishes outcomes: each with corners, else every 20 ms."""

    faults = Fault(0)
    closing_note: str | None = None

    def __init__(self, publisher: Publisher):
        self._publisher, self._last_ns = publisher, 0

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """See `Observer`."""
        shows = outcome.data is not None and outcome.data.corners_px is not None
        if shows or abs(outcome.now_ns - self._last_ns) > _LEAST_NS:
            self._last_ns = outcome.now_ns
            self._publisher.publish(outcome, outcome.stamp_ns if shows else None)

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """See `Observer`."""

    def close(self) -> None:
        """See `Onlooker`."""


def _inputs_of(bag: Path, file: RosFile, setup: DriveSetup, corner_backend: str) -> Sequence[Input]:
    rig, markers, vehicle = setup.rig, setup.markers, setup.vehicle
    inputs = read_ros_drive(bag, file, rig, markers, vehicle, corner_backend)
    if not inputs:
        raise BadInput(bag, "holds no input")
    check_inputs(inputs, setup, bag)
    return inputs


def _close(observers: list[Any], contained: Containment, say: Say) -> None:
    """Close observers, and say what they sum up; those that are closed already are gone."""
    for observer in observers:
        contained.of(f"{type(observer).__name__}.close", observer.close)()
    for note in closing_notes(observers, contained):
        say(note)
    observers.clear()
    contained.counts.clear()


def _named(error: BaseException) -> str:
    """What ended a drive: a person's mistake or a signal as they are, all else with its kind."""
    known = isinstance(error, BadInput) or not isinstance(error, Exception)
    return str(error) if known and str(error) else f"{type(error).__name__}: {error}"
