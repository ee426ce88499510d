"""A vehicle in the node of ROS 2: driven, localised while others drive, or played from a bag."""

import itertools
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import version

import jax
import numpy as np

from jaxnav.commands.drive.arguments import Run
from jaxnav.commands.drive.observers import (
    DriveObserver,
    DriveRecorder,
    ExposureWatch,
    closing_notes,
)
from jaxnav.commands.drive.ros_setup import Activity, Prepared, path_of
from jaxnav.commands.drive.run import Drive, compiled_pilot, guarding_process, searches_for
from jaxnav.core.filter.errors import EACH
from jaxnav.core.filter.odometry import LEARNT, SENSORS_END
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.drive.interfaces import Setup
from jaxnav.drive.loop import Fenced
from jaxnav.drive.pilot import Input, Outcome, Pilot
from jaxnav.errors import BadInput, Containment
from jaxnav.files import Route, load_markers, load_params, load_rig, load_route, load_vehicle
from jaxnav.files.configuration import step_folder
from jaxnav.files.provenance import calibrated_now
from jaxnav.files.ros import RosFile
from jaxnav.files.validation import at
from jaxnav.files.vehicles import as_car, may_resume
from jaxnav.files.writing import atomic_write_all
from jaxnav.recordings.adoption import (
    NEVER_SURE,
    NOTHING_KEPT,
    adopted_files,
    is_other_rig,
    is_other_vehicle,
)
from jaxnav.recordings.drive_replay import check_inputs
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.learnt import Learnt, errors_of
from jaxnav.recordings.other.ros import read_ros_drive
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.odometry_messages import TWIST_TYPES
from jaxnav.vehicles.ros.publisher import Publisher

OVER = "the bag is over"
_WHERE = "save"  # of what is wrong with none of the files
_CLOCK = "rosgraph_msgs/msg/Clock"
_CAMERAS = "jaxnav.vehicles.ros2_cameras:open_cameras"
_LEAST_NS = 18_000_000  # between two estimates of which the later has no new corners
_NOWHERE = Route(((0.0, 0.0),), 0.15, (0.0, 0.0, 0.0))  # of who does not drive


class PreparedDrive(Prepared):
    """A vehicle: it is driven, localised while others drive, or played from a bag."""

    def begin(self) -> Activity:
        setup = self._setup
        pilot = setup.pilot(step_folder())
        pilot.warm_up()
        keeper = LearntKeeper(self._file, setup)
        observers: list[DriveObserver] = [
            _Reporter(self.publisher),
            keeper,
            ExposureWatch(setup.rig.names, self._searches),
        ]
        if (path := self._args.record) is not None:
            number = next(self._numbers)
            path = path if number == 1 else path.with_stem(f"{path.stem}_{number}")
            observers.append(DriveRecorder(path, setup, images=False))
        if self._inputs is not None:
            return self._play(self._inputs, pilot, observers, keeper)
        return self._drive(pilot, observers, keeper)

    def _read(self) -> DriveSetup:
        file, args, drives = self._file, self._args, self._file.route is not None
        self._numbers = itertools.count(1)  # of recordings
        setup = DriveSetup(
            rig=self._rig(),
            markers=load_markers(path_of(file, "markers")),
            vehicle=load_vehicle(path_of(file, "vehicle")),
            route=load_route(path_of(file, "route")) if drives else _NOWHERE,
            selector=file.selector,
            float64=args.float64,
            drives=drives,
        )
        if (params := file.file("params")) is not None:
            setup = setup.with_params(load_params(params))
        check_vehicle(file, setup.vehicle)
        if args.bag is not None:
            self._connection.ros_time = True  # the bag's
        self._run = Run(
            car="ros2",
            cameras=_CAMERAS,
            corner_backend=args.corner_backend,
            period_s=args.period_s,
            timeout_s=args.timeout_s,
            float64=args.float64,
            headless=True,
        )
        return setup

    def _compile(self) -> None:
        args, file, setup = self._args, self._file, self._setup
        follow, self._inputs = args.detector == "follow", None
        self._searches = searches_for(args.corner_backend, setup.rig, setup.markers, follow)
        others = [search.warm_up for search in self._searches]
        others.append(LearntKeeper(file, setup).warm_up)
        self._timed(lambda: compiled_pilot(self._run, setup, others))
        if args.bag is not None:
            figures = setup.rig, setup.markers, setup.vehicle
            self._inputs = read_ros_drive(args.bag, file, *figures, args.corner_backend)
            if not self._inputs:
                raise BadInput(args.bag, "holds no input")
            check_inputs(self._inputs, setup, args.bag)

    def _drive(
        self, pilot: Pilot, observers: list[DriveObserver], keeper: "LearntKeeper"
    ) -> Activity:
        """Drive, or look on while somebody else does."""
        setup, drives = self._setup, self._file.route is not None
        guarding = guarding_process(self._run)
        if guarding is not None:
            guarding.prepare(self._signals.check)
        options = self._file.options(drives, self._connection.sim_time)
        start = setup.route_on_map.start_pose
        drive = Drive(
            self._run,
            Setup(setup.rig, setup.markers, setup.vehicle, start, 0, options),
            guarding,
            self._signals,
            until_arrival=False,
            now_ns=self._connection.now_ns,
            resumes=may_resume(path_of(self._file, "vehicle")),
        )

        def trip(reason: str) -> None:
            if drive.guard is not None:
                drive.guard.trip(reason)

        def close() -> None:
            loop = getattr(drive, "loop", None)  # a drive that could not begin has none
            _close(observers, Containment() if loop is None else loop.contained, self._say)
            if drive.heard is not None:
                self._say(drive.heard)

        return Activity(
            partial(drive.run, pilot, self._searches, observers), trip, close, keeper.save
        )

    def _play(
        self,
        inputs: Sequence[Input],
        pilot: Pilot,
        observers: list[DriveObserver],
        keeper: "LearntKeeper",
    ) -> Activity:
        """Handle the inputs of a bag at the times at which they were recorded."""
        connection, contained, over = self._connection, Containment(), threading.Event()
        clock = connection.publisher(_CLOCK, "/clock")

        def play() -> str | None:
            fenced = [Fenced(observer, contained) for observer in observers]
            begin_s, first_ns = time.monotonic(), inputs[0].now_ns
            for given in inputs:
                due_s = begin_s + (given.now_ns - first_ns) / 1e9 / self._args.rate
                if over.wait(max(due_s - time.monotonic(), 0.0)):
                    return None
                message = message_type(_CLOCK)(clock=connection.stamp(given.now_ns))
                connection.publish(clock, message)
                outcome = pilot.handle(given)
                for observer in fenced:
                    observer.on_outcome(given, outcome)
            return OVER

        def close() -> None:
            _close(observers, contained, self._say)
            connection.forget(clock)

        return Activity(play, lambda reason: over.set(), close, keeper.save)


class LearntKeeper(DriveObserver):
    """An observer that keeps what the drive has learnt when it was last sure of its pose.

    What `save` writes is what `jaxnav calibrate adopt --rig --vehicle` writes of the same drive's
    recording, but for the provenance and the rounding of a recording.
    """

    def __init__(self, file: RosFile, setup: DriveSetup):
        """Args:
        file: names rig and vehicle, which are read anew: as exact as they are.
        """
        self._file, self._setup = file, setup
        self._known: tuple[np.ndarray, np.ndarray] | None = None

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        if outcome.output.located and outcome.output.decided:
            errors, sigma = errors_of(outcome.belief.bank)
            if np.isfinite(errors).all():
                self._known = errors, sigma

    def save(self, folder: str) -> str:
        """Write the new files into a folder that is there; return what was written and learnt.

        Raises:
            BadInput: nothing is learnt yet, the folder is missing or holds such a file already, or
                rig or vehicle are not those any more that are driven with. Nothing is written.
        """
        known, target = self._known, self._file.path.parent / folder
        if known is None:
            raise BadInput(_WHERE, NEVER_SURE)
        is_there = False
        with suppress(OSError):  # a name that is too long, say
            is_there = bool(folder) and target.is_dir()
        if not is_there:
            raise BadInput(_WHERE, f"there is no folder {target if folder else repr(folder)}")
        learnt, texts = self._adopted(known)
        for name in texts:
            if (target / name).exists():
                raise BadInput(target / name, "is there already: nothing is written over")
        atomic_write_all({target / name: text for name, text in texts.items()})
        found = learnt.sentences() or ["nothing is off by three of its sigmas"]
        return f"{', '.join(texts)} in {target}: {'; '.join(found)}"

    def warm_up(self) -> None:
        """Compile what `save` calls: some twenty operations, while others drive."""
        count = SENSORS_END - LEARNT + EACH * len(self._setup.rig)
        with suppress(BadInput):  # said by who saves
            self._adopted((np.zeros(count), np.ones(count)))

    def _adopted(self, known: tuple[np.ndarray, np.ndarray]) -> tuple[Learnt, dict[str, str]]:
        """What has been learnt, and the new files by their names."""
        rig_path, vehicle_path = path_of(self._file, "rig"), path_of(self._file, "vehicle")
        setup = self._setup
        with jax.enable_x64(True):
            learnt = Learnt.from_errors(*known, setup.rig, setup.vehicle)
            if learnt is None:
                raise BadInput(_WHERE, f"the drive {NOTHING_KEPT}")
            rig, vehicle = load_rig(rig_path), as_car(load_vehicle(vehicle_path), vehicle_path)
            if is_other_rig(rig, setup.rig):
                raise BadInput(rig_path, "has other cameras by now than those driven with")
            if is_other_vehicle(vehicle, as_car(setup.vehicle, vehicle_path)):
                raise BadInput(vehicle_path, "has other corrections by now than those driven with")
            calibrated = calibrated_now(f"jaxnav {version('jaxnav')} ros, ~/save", known)
            return learnt, adopted_files(setup, learnt, calibrated, rig, vehicle)


class _Reporter(DriveObserver):
    """An observer that publishes outcomes: each with corners, else every 20 ms."""

    def __init__(self, publisher: Publisher):
        self._publisher, self._last_ns = publisher, 0

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        shows = outcome.data is not None and outcome.data.corners_px is not None
        if shows or abs(outcome.now_ns - self._last_ns) > _LEAST_NS:
            self._last_ns = outcome.now_ns
            self._publisher.publish(outcome, outcome.stamp_ns if shows else None)


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


def _close(
    observers: list[DriveObserver], contained: Containment, say: Callable[[str], None]
) -> None:
    """Close observers, and say what they sum up; those that are closed already are gone."""
    for observer in observers:
        contained.wrap(f"{type(observer).__name__}.close", observer.close)()
    for note in closing_notes(observers, contained):
        say(note)
    observers.clear()
    contained.counts.clear()
