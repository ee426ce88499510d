"""Checks that open the vehicle and its cameras, read them for a moment, and never drive."""

import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from jaxnav.commands.doctor.camera_frames import judge_cameras, watch
from jaxnav.commands.doctor.findings import Finding, Report, error, ok, said, warning
from jaxnav.drive import plugins
from jaxnav.drive.chassis import Chassis, chassis_of, pace_mps
from jaxnav.drive.interfaces import AnyVehicle, Odometry, Setup
from jaxnav.drive.interfaces import Reading as Read
from jaxnav.drive.limits import Limits
from jaxnav.drive.moved_vehicle import GuardProcess
from jaxnav.errors import BadInput
from jaxnav.vehicles.conformance.calls import HANGS_S, Worker, start_call
from jaxnav.vehicles.conformance.cameras import Parked

READINGS = 20
_PAUSE_S = 0.01
_PATIENCE_S = 3.0  # until a driver must have measured something
_SLOW_S = 0.02  # a whole tick of the loop
_OLD_S = 0.1  # the loop calls older odometry stale
_LEAST_RATE_HZ = 20.0
_STANDS_MPS = 0.05
_OPENS_WITHIN_S = 30.0


@dataclass(frozen=True)
class Reading:
    """One `read` of a vehicle: its odometry, when it returned, and how long it took."""

    odometry: Read
    now_ns: int
    took_s: float


def plug_ins(
    report: Report, setup: Setup, vehicle_name: str | None, cameras_name: str | None
) -> None:
    """Examine the plug-ins that were named; a failure of one hides no finding of the other.

    Cameras without a vehicle get one that stands still.
    """
    vehicle: Any = Parked()
    if vehicle_name is not None:
        opened: list[AnyVehicle] = []
        report.examine("vehicle", _open_vehicle, vehicle_name, setup, opened)
        if opened:
            vehicle = opened[0]
            report.examine("odometry", _odometry, vehicle, chassis_of(setup.vehicle))
        elif cameras_name is not None:
            instead = "opened beside a vehicle that stands still instead"
            report.add(Finding("cameras", "note", instead))
    if cameras_name is not None:
        report.examine("cameras", _cameras, cameras_name, setup, vehicle)
    if vehicle_name is not None and opened:
        report.examine("vehicle", _close, [vehicle])


def _open_vehicle(name: str, setup: Setup, opened: list[AnyVehicle]) -> Iterator[Finding]:
    plugins.load_factory("--car", plugins.VEHICLES, name)
    vehicle, problems = _open("opening it", plugins.open_vehicle, name, setup)
    yield from problems
    if problems:
        return
    opened.append(vehicle)
    yield ok(f"{name} opens")
    yield _guard(name)
    if not vehicle.timeout_s < math.inf:
        yield warning(
            f"{name} does not stop by itself when nothing is written any more",
            "killed together, the processes of a drive leave it driving: let your service manager "
            f"run `jaxnav stop --car {name}` then; a computer that fails as a whole does too: have "
            "a switch at hand that cuts its power",
        )


def _guard(name: str) -> Finding:
    """Report whether `jaxnav run` would open a vehicle in the guard's process, by its import."""
    guarding = GuardProcess(name)
    until_s = time.monotonic() + _OPENS_WITHIN_S

    def check() -> None:
        if time.monotonic() > until_s:
            raise BadInput("vehicle", f"{name} is not imported within {_OPENS_WITHIN_S:g} s")

    try:
        guarding.prepare(check)
    finally:
        guarding.end()
    if guarding.stays is None:
        return Finding("guard", "ok", f"{name} can be owned by a process that outlives the rest")
    return Finding(
        "guard",
        "note",
        f"a thread alone watches {name}, which can't be moved to another process: {guarding.stays}",
        "a library that holds the interpreter, or the end of the program, stops the thread too",
    )


def _open(
    what: str, open_plug_in: Callable[..., Any], name: str, *told: Any
) -> tuple[Any, list[Finding]]:
    """What a plug-in opens, or a finding that says why it does not."""
    try:
        return start_call(partial(open_plug_in, name, *told))(what, _OPENS_WITHIN_S), []
    except (BadInput, OSError, AssertionError) as failure:
        problem = str(failure) if isinstance(failure, BadInput) else f"{name}: {said(failure)}"
        do = "is it plugged in, switched on, and free of other programs?"
        return None, [error(problem, do)]


def _close(things: Sequence[Any]) -> Iterator[Finding]:
    for thing in things:
        try:
            start_call(thing.close)("close()", HANGS_S)
        except Exception as failure:
            yield warning(f"closing failed: {said(failure)}", "the driver's author")


def _odometry(vehicle: AnyVehicle, chassis: Chassis) -> Iterator[Finding]:
    """Read the vehicle `READINGS` times, in a thread of its own as a driver may hang, and judge."""
    worker = Worker()
    readings: list[Reading] = []
    failures: list[OSError] = []
    until_s = time.monotonic() + _PATIENCE_S
    try:
        while len(readings) < READINGS and time.monotonic() < until_s:
            called_s = time.monotonic()
            odometry, failure = worker.call("read()", vehicle.read)
            took_s = time.monotonic() - called_s
            if failure is not None:
                failures.append(failure)
            else:
                readings.append(Reading(odometry, time.monotonic_ns(), took_s))
            time.sleep(_PAUSE_S)
    finally:
        worker.close()
    yield from judge_odometry(readings, failures, chassis)


def judge_odometry(
    readings: Sequence[Reading], failures: Sequence[OSError], chassis: Chassis
) -> Iterator[Finding]:
    """Report what is wrong with the readings of a vehicle that stands.

    Args:
        readings: in the order in which they were taken.
        failures: the errors of further attempts to read.
    """
    if failures:
        yield (warning if readings else error)(
            f"{len(failures)} of {len(failures) + len(readings)} readings failed: "
            f"{said(failures[-1])}",
            "look at the cable to the car's controller, and at its driver",
        )
    if not readings:
        return
    problems = [*_wrong_stamps(readings), *_wrong_values(readings, chassis)]
    yield from problems
    if problems or failures:
        return
    stamps_ns = [reading.odometry.stamp_ns for reading in readings]
    last = readings[-1].odometry
    yield ok(
        f"{len(readings)} readings at {_rate_hz(stamps_ns):.0f} Hz, "
        f"{max(_ages_s(readings)) * 1e3:.0f} ms old at most; "
        f"{_said(last)}"
    )


def _said(read: Read) -> str:
    """A reading in words."""
    if isinstance(read, Odometry):
        return f"{read.speed_mps:+.2f} m/s, steering {read.steering_rad:+.2f} rad"
    return (
        f"{read.forward_mps:+.2f} m/s ahead, {read.left_mps:+.2f} to the left, turns "
        f"{read.turn_radps:+.2f} rad/s"
    )


def _ages_s(readings: Sequence[Reading]) -> list[float]:
    return [(reading.now_ns - reading.odometry.stamp_ns) / 1e9 for reading in readings]


def _rate_hz(stamps_ns: Sequence[int]) -> float:
    """The rate of distinct stamps, Hz; 0 where there is only one."""
    fresh = sorted(set(stamps_ns))
    return (len(fresh) - 1) / max((fresh[-1] - fresh[0]) / 1e9, 1e-9) if len(fresh) > 1 else 0.0


def _wrong_stamps(readings: Sequence[Reading]) -> Iterator[Finding]:
    ages_s = _ages_s(readings)
    rate_hz = _rate_hz([reading.odometry.stamp_ns for reading in readings])
    slow = sum(reading.took_s > _SLOW_S for reading in readings)
    if min(ages_s) < 0:
        yield error(
            f"stamps lie up to {-min(ages_s):.3g} s in the future",
            "stamp_ns must be of time.monotonic_ns() of this computer",
        )
    elif rate_hz == 0:
        yield error(
            f"{len(readings)} readings have one and the same stamp: nothing new is measured",
            "does the car's controller run? Is its cable in?",
        )
    elif max(ages_s) > _OLD_S:
        yield error(
            f"readings are up to {max(ages_s):.3g} s old, over {_OLD_S:g} s counts as none",
            "stamp_ns is of time.monotonic_ns(), when it was measured; read the driver's queue dry",
        )
    elif rate_hz < _LEAST_RATE_HZ:
        yield warning(
            f"{rate_hz:.0f} readings a second",
            f"let the driver measure at {_LEAST_RATE_HZ:.0f} Hz or more",
        )
    if slow > len(readings) // 10:
        yield warning(
            f"read() took over {_SLOW_S * 1e3:.0f} ms, {slow} of {len(readings)} times",
            "it must give the latest reading at once: read in a thread of the driver's own",
        )


def _wrong_values(readings: Sequence[Reading], chassis: Chassis) -> Iterator[Finding]:
    valid = [reading.odometry for reading in readings if reading.odometry.valid]
    finite = [o for o in valid if all(map(math.isfinite, o.values))]
    if len(valid) < len(readings):
        yield (warning if valid else error)(
            f"{len(readings) - len(valid)} of {len(readings)} readings are marked as not valid",
            "the driver says so itself: look at its messages",
        )
    if len(finite) < len(valid):
        yield error(
            f"{len(valid) - len(finite)} of {len(valid)} valid readings are no numbers",
            "the driver should say valid=False where it can't tell",
        )
    if not finite:
        return
    of_this_kind = [o for o in finite if chassis.reads(o)]
    if len(of_this_kind) < len(finite):
        yield error(
            f"readings are of the kind {type(finite[0]).__name__}, the file is of another vehicle",
            "a car reads Odometry, a base that is driven by a twist TwistOdometry",
        )
        return
    fastest = max(finite, key=lambda o: pace_mps(chassis.driven_mps(o)))
    if pace_mps(chassis.driven_mps(fastest)) > _STANDS_MPS:
        same = len({o.values for o in finite}) == 1 < len(finite)
        yield warning(
            f"it says {_moves(fastest)}"
            + (f", {len(finite)} times the very same" if same else "")
            + ": does the car stand?",
            "a car at rest must read 0: look at the encoder and its offset, at a driver that "
            "repeats old values",
        )
    cars, limits = [o for o in finite if isinstance(o, Odometry)], chassis.limits
    if not cars or not isinstance(limits, Limits):
        return
    widest = max(cars, key=lambda o: abs(o.steering_rad))
    if abs(widest.steering_rad) > 1.1 * limits.steering_rad:
        yield warning(
            f"steering reads {widest.steering_rad:+.2f} rad, its limit is "
            f"{limits.steering_rad:.2f}",
            "steering_rad is in rad, positive to the left",
        )


def _moves(read: Read) -> str:
    return f"{read.speed_mps:+.2f} m/s" if isinstance(read, Odometry) else _said(read)


def _cameras(name: str, setup: Setup, vehicle: AnyVehicle) -> Iterator[Finding]:
    plugins.load_factory("--cameras", plugins.CAMERAS, name)
    cameras, problems = _open("opening them", plugins.open_cameras, name, setup, vehicle)
    yield from problems
    if problems:
        return
    try:
        watched = watch(cameras)
    finally:
        closing = list(_close(cameras))
    yield from judge_cameras(watched, setup.rig.image_sizes_px)
    yield from closing
