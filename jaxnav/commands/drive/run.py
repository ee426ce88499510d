"""`jaxnav run`: run the loop that drives, with its observers.

Every step of the start checks whether a signal has come, arming above all: see `Signals`.
"""

import gc
import math
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from typing import Any

import jax
import numpy as np

from jaxnav.commands.drive.arguments import Run
from jaxnav.commands.drive.observers import (
    DelayWatch,
    DriveObserver,
    DriveRecorder,
    ExposureWatch,
    LearntWatch,
    LiveView,
    closing_notes,
)
from jaxnav.commands.drive.status_line import StatusLine
from jaxnav.commands.kinds import key_values
from jaxnav.commands.process import configure_jax
from jaxnav.commands.reading import given_files
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.detection import Tracker, make_detectors
from jaxnav.drive import plugins
from jaxnav.drive.corrections import Corrections
from jaxnav.drive.guard import Guard
from jaxnav.drive.interfaces import AnyVehicle, HasOwnFiles, HasTime, Setup, SharesProcess
from jaxnav.drive.limits import CommandLimits
from jaxnav.drive.loop import Loop, Observer
from jaxnav.drive.moved_vehicle import GuardProcess, MovedVehicle
from jaxnav.drive.pilot import Pilot
from jaxnav.drive.priority import before_others
from jaxnav.drive.seeing import Eyes, Search
from jaxnav.drive.signals import EXIT_STOPPED, Signals
from jaxnav.errors import BadInput, Containment, visible
from jaxnav.files import load_params
from jaxnav.files.configuration import step_folder
from jaxnav.files.vehicles import may_resume
from jaxnav.recordings.drive_setup import DriveSetup

# How far the clock of a simulated vehicle runs ahead of a thread that does not come back: longer
# than a camera's thread waits (0.05 s), shorter than the odometer takes to be stale (0.1 s).
_AHEAD_S = 0.08
UNSTOPPED = (
    "{car} does not stop by itself when all processes here are killed at once: have `jaxnav stop "
    "--car {car}` run then, see docs/guide/drive.md, or a switch at hand"
)


@before_others()
def run(args: Run, signals: Signals) -> int:
    """Drive, and print why the drive ended.

    Args:
        signals: of the process, since its first line.

    Raises:
        Interrupted: a signal came before the drive began.
    """
    configure_jax(float64=args.float64, threads=1)
    options = key_values("--option", args.option)
    setup = _setup(args, options)
    signals.check()
    if args.params is not None:
        params = load_params(args.params)
        setup = setup.with_params(params)
        _say(args, params.describe())
    vehicle_setup = Setup(
        setup.rig, setup.markers, setup.vehicle, setup.route_on_map.start_pose, args.seed, options
    )
    with ExitStack() as closing:
        guarding = guarding_process(args)
        if guarding is not None:
            closing.callback(guarding.end)
            guarding.prepare(signals.check)  # its errors are reported before anything is compiled
        plugins.try_cameras(args.cameras or args.car, vehicle_setup)  # so are these
        signals.check()
        follow = args.detector == "follow"
        searches = searches_for(args.corner_backend, setup.rig, setup.markers, follow)
        observers = open_observers(args, setup, closing)
        observers.append(ExposureWatch(setup.rig.names, searches))
        for observer in observers:
            signals.before_leaving(observer.close)
        signals.check()
        others = [search.warm_up for search in searches]
        others += [one.warm_up for one in observers if isinstance(one, DelayWatch)]
        pilot = compiled_pilot(args, setup, others)
        signals.check()
        resumes = args.vehicle is not None and may_resume(args.vehicle)
        drive = Drive(args, vehicle_setup, guarding, signals, resumes=resumes)
        try:
            reason = drive.run(pilot, searches, observers)
        finally:  # also of a drive that raises
            if drive.heard is not None:
                _warn(drive.heard)
    _summarise(drive.loop, drive.eyes, reason)
    print(f"guard: {drive.kept_by}")
    for note in closing_notes(observers, drive.loop.contained):
        print(note)
    return EXIT_STOPPED if drive.loop.stopped or drive.heard is not None else 0


def _setup(args: Run, options: Mapping[str, str]) -> DriveSetup:
    """Read all files and find all plug-ins before anything is compiled or moves, so that bad input
    is found first."""
    factory = plugins.load_factory("--car", plugins.VEHICLES, args.car)
    plugins.load_factory("--cameras", plugins.CAMERAS, args.cameras or args.car)
    own = factory.own_files(options) if isinstance(factory, HasOwnFiles) else None
    names = ("rig", "markers", "vehicle", "route")
    files = given_files(args, names, or_qcars=own is None)
    files |= {name: getattr(own, name) for name in names if name not in files}
    return DriveSetup(**files, selector=args.selector, float64=args.float64, relocate=args.relocate)


def open_observers(args: Run, setup: DriveSetup, closing: ExitStack) -> list[DriveObserver]:
    """Open the observers that the arguments ask for, which `closing` closes in the end.

    Raises:
        BadInput: the file can't be written, Rerun is missing or its window does not open.
    """
    observers: list[DriveObserver] = []

    def add(observer: DriveObserver) -> None:
        closing.callback(Containment().wrap(f"{type(observer).__name__}.close", observer.close))
        observers.append(observer)

    if args.record is not None:
        add(DriveRecorder(args.record, setup, args.record_images))
    if args.view:
        from jaxnav.pictures.rerun.view import RerunView  # imports all that draws

        waypoints_m = np.asarray(setup.route_on_map.waypoints_m, float)
        add(LiveView(RerunView(setup.rig, setup.markers, waypoints_m, live=True, save=None)))
    if isinstance(setup.vehicle, Vehicle):  # it knows the motion of a car alone
        add(DelayWatch(setup, warns=not args.headless))
    add(LearntWatch(setup, tells=not args.headless))
    if not args.headless:
        add(StatusLine())
    return observers


def guarding_process(args: Run) -> GuardProcess | None:
    """The process that will own the vehicle; None where its plug-in must stay in this one."""
    factory = plugins.load_factory("--car", plugins.VEHICLES, args.car)
    if isinstance(factory, SharesProcess) and factory.shares_process:
        return None
    try:
        return GuardProcess(args.car)
    except OSError as error:
        problem = f"the guard's process can't be started: {error.strerror or error}"
        raise BadInput(f"--car {args.car}", problem) from None


def searches_for(
    corner_backend: str, rig: CameraRig, markers: MarkerMap, follow: bool = False
) -> list[Search]:
    """A search for markers for each camera.

    Args:
        follow: also follow expected markers that can't be decoded.
    """
    detectors = make_detectors(markers, corner_backend)
    rig = jax.device_get(rig)  # NumPy indexes its cameras without compiling anything
    trackers = [Tracker(*rig.timing(c)) if follow else None for c in range(len(rig))]
    return [
        Search(c, rig.image_sizes_px[c], rig.camera(c), detectors, tracker)
        for c, tracker in enumerate(trackers)
    ]


def compiled_pilot(args: Run, setup: DriveSetup, others: Sequence[Callable[[], None]]) -> Pilot:
    """A pilot that is compiled and warmed up.

    Args:
        others: compile what else a drive calls. Once it is armed nothing is compiled or loaded any
            more: whoever waits for it hangs in the eyes of the guard.
    """
    _say(args, "compiling")
    began_s = time.monotonic()
    with ThreadPoolExecutor(1) as beside:
        warm = [beside.submit(other) for other in others]  # in turns: they share programs
        pilot = setup.pilot(step_folder())
        pilot.warm_up()
        for other in warm:
            other.result()
    _say(args, f"compiled in {time.monotonic() - began_s:.1f} s")
    return pilot


class Drive:
    """One drive, from opening the vehicle and its cameras to closing them.

    Attributes:
        guard: of this process, once the vehicle is open.
        kept_by: in words, the guard that stops the vehicle whatever happens here.
        heard: once it is closed, where the last stop did not reach the vehicle, or not by its own
            guard: a line that says so. None where it did.
    """

    loop: Loop
    eyes: Eyes
    guard: Guard | None = None
    kept_by = ""
    heard: str | None = None

    def __init__(
        self,
        args: Run,
        setup: Setup,
        guarding: GuardProcess | None,
        signals: Signals,
        until_arrival: bool = True,
        now_ns: Callable[[], int] = time.monotonic_ns,
        resumes: bool = False,
    ):
        """Open nothing yet.

        Args:
            guarding: the process for the vehicle; None keeps it in this one.
            until_arrival: whether the last waypoint ends the drive.
            now_ns: the time of the vehicle's and the cameras' stamps.
            resumes: whether the vehicle's file says so.
        """
        self._resumes = resumes
        self._args, self._setup, self._guarding, self._signals = args, setup, guarding, signals
        self._until_arrival, self._now_ns = until_arrival, now_ns

    def run(self, pilot: Pilot, searches: list[Search], observers: Sequence[Observer]) -> str:
        """Open, drive, stop and close; return why the drive ended."""
        args, signals = self._args, self._signals
        with ExitStack() as closing:
            # Else the garbage collector goes through JAX's objects now and then, 50 ms a time.
            gc.freeze()
            closing.callback(gc.unfreeze)
            signals.hold()
            vehicle, guard = self._guarded(pilot.limits)
            self.guard = guard
            signals.unheard = True  # until it is known that it has
            closing.callback(self._close, vehicle, guard)
            if not vehicle.timeout_s < math.inf:
                _warn(UNSTOPPED.format(car=args.car))
            signals.on_signal(guard.trip)
            signals.check()
            cameras = plugins.open_cameras(args.cameras or args.car, self._setup, vehicle)
            self.eyes = Eyes(cameras, searches, guard, workers=max(1, os.cpu_count() or 1))
            closing.callback(self.eyes.close)
            # The guard trips before the eyes are closed, which their threads may delay.
            closing.callback(guard.trip, "the drive is over")
            self.loop = Loop(
                pilot, guard, vehicle, self.eyes, observers, args.period_s, self._now_ns, _warn
            )
            signals.check()
            duration_s = args.duration_s if args.duration_s is not None else float("inf")
            return self.loop.run(duration_s, self._until_arrival)

    def _guarded(self, limits: CommandLimits) -> tuple[Any, Guard]:
        """The vehicle, in a process of its own where possible, and the guard of this process."""
        args, why = self._args, "it shares its process"
        if self._guarding is not None:
            moved = self._guarding.open(
                self._setup, limits, args.timeout_s, self._signals.check, self._resumes
            )
            if moved is not None:
                guard = Guard(moved, limits, args.timeout_s, resumes=self._resumes)
                moved.watch(guard.trip, lambda: guard.late)
                self.kept_by = f"a process of its own, {moved.priority}"
                _say(args, f"guard: {self.kept_by}")
                return moved, guard
            why = self._guarding.stays or why
        self.kept_by = f"a thread, {args.car} can't be moved to another process: {why}"
        _say(args, f"guard: {self.kept_by}")
        vehicle = plugins.open_vehicle(args.car, self._setup)
        corrections = Corrections.from_vehicle(self._setup.vehicle)
        clock = vehicle.waiting_clock if isinstance(vehicle, HasTime) else None
        now_ns = time.monotonic_ns if clock is None else clock.now_ns
        guard = Guard(vehicle, limits, args.timeout_s, now_ns, corrections, self._resumes)
        if clock is not None:
            self._now_ns = now_ns
            clock.wait_for(guard.oldest_sign_ns, min(_AHEAD_S, args.timeout_s / 2))
        return vehicle, guard

    def _close(self, vehicle: AnyVehicle, guard: Guard) -> None:
        guard.close()
        unheard, replaced = guard.unheard, None
        if isinstance(vehicle, MovedVehicle):
            unheard, replaced = vehicle.unheard, vehicle.replaced
        if unheard is not None:
            self.heard = f"THE VEHICLE HAS NOT HEARD THAT IT MUST STOP: {unheard}"
        elif replaced is not None:
            self.heard = f"{replaced}; another one has stopped the vehicle"
        self._signals.unheard = self.heard is not None


def _say(args: Run, text: str) -> None:
    if not args.headless:
        _warn(text)


def _warn(text: str) -> None:
    """Write a line that a person must have read, also where no status line is wanted."""
    sys.stderr.write(f"{visible(text)}\n")


def _summarise(loop: Loop, eyes: Eyes, reason: str) -> None:
    print(f"ended: {reason}")
    if loop.late:
        print(
            "if the computer was busy: run fewer programs and threads beside the drive, raise its "
            "priority (`jaxnav doctor` says how), or give it more time (--timeout-s)"
        )
    statistics = loop.statistics
    for name in sorted(statistics.counts):
        median, late = (statistics.quantile_ms(name, share) for share in (0.5, 0.99))
        count = int(statistics.counts[name].sum())
        print(f"{name}: {count}, {median:.2f} ms median, {late:.2f} ms 99 %")
    print(
        f"deadlines missed: {statistics.deadlines_missed}; frames dropped: {eyes.dropped}; "
        f"camera errors: {int(np.sum(eyes.errors))}"
    )
