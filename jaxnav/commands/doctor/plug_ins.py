"""Checks that open the vehicle and its cameras, read them for a moment, and never drive."""

import math
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from jaxnav.commands.doctor.cameras import judge_cameras, watch
from jaxnav.commands.doctor.findings import Finding, Report, found, said
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.drive import plugins
from jaxnav.drive.chassis import Chassis, chassis_of, pace_mps
from jaxnav.drive.interfaces import AnyVehicle, Odometry, Setup
from jaxnav.drive.interfaces import Reading as Read
from jaxnav.drive.limits import Limits
from jaxnav.drive.moved_vehicle import GuardProcess
from jaxnav.errors import BadInput
from jaxnav.files import Route
from jaxnav.vehicles.conformance.calls import HANGS_S, Worker, start_call
from jaxnav.vehicles.conformance.cameras import Parked

READINGS = 20
PATIENCE_S = 3.0  # until a driver must have measured something
SLOW_S = 0.02  # a whole tick of the loop
OLD_S = 0.1  # the loop calls older odometry stale
LEAST_RATE_HZ = 20.0
OPENS_WITHIN_S = 30.0
_PAUSE_S = 0.01
_STANDS_MPS = 0.05


@dataclass(frozen=True)
class Reading:
    """One `read` of a vehicle: its odometry, when it returned, and how long it took."""

    odometry: Read
    now_ns: int
    took_s: float


def plug_ins(
    report: Report,
    asked: tuple[str | None, str | None, dict[str, str]],
    rig: CameraRig | None,
    markers: MarkerMap | None,
    vehicle: Vehicle | TwistBase | None,
    route: Route | None,
) -> Iterator[Finding]:
    """Examine the plug-ins that were named, if all files can be read.

    Args:
        asked: the names of vehicle and cameras, and the options.
    """
    if rig is None or markers is None or vehicle is None or route is None:
        yield found("plug-ins.skipped")
        return
    vehicle_name, cameras_name, options = asked
    setup = Setup(rig, markers, vehicle, route.start_pose, options=options)
    examine(report, setup, vehicle_name, cameras_name)


def examine(
    report: Report, setup: Setup, vehicle_name: str | None, cameras_name: str | None
) -> None:
    """Open and read plug-ins; a failure of one hides no finding of the other.

    Cameras without a vehicle get one that stands still.
    """
    opened: list[AnyVehicle] = []
    vehicle: Any = Parked()
    if vehicle_name is not None:
        report.examine("vehicle", lambda: _open_vehicle(vehicle_name, setup, opened))
    if opened:
        vehicle = opened[0]
        report.examine("odometry", lambda: _odometry(vehicle, chassis_of(setup.vehicle)))
    elif vehicle_name is not None and cameras_name is not None:
        report.add(found("cameras.parked"))
    if cameras_name is not None:
        report.examine("cameras", lambda: _cameras(cameras_name, setup, vehicle))
    if opened:
        report.examine("vehicle", lambda: _close("vehicle", opened))


def _open_vehicle(name: str, setup: Setup, opened: list[AnyVehicle]) -> Iterator[Finding]:
    plugins.load_factory("--car", plugins.VEHICLES, name)
    try:
        opened.append(_open("opening it", plugins.open_vehicle, name, setup))
    except ValueError as failure:
        yield found("vehicle.unopened", why=failure)
        return
    yield found("vehicle.opened", name=name)
    yield _guard(name)
    if not opened[0].timeout_s < math.inf:
        yield found("vehicle.no_timeout", name=name)


def _guard(name: str) -> Finding:
    """Report whether `jaxnav run` would open a vehicle in the guard's process, by its import."""
    guarding = GuardProcess(name)
    until_s = time.monotonic() + OPENS_WITHIN_S

    def check() -> None:
        if time.monotonic() > until_s:
            raise BadInput("vehicle", f"{name} is not imported within {OPENS_WITHIN_S:g} s")

    try:
        guarding.prepare(check)
    finally:
        guarding.end()
    key = "guard.process" if guarding.stays is None else "guard.thread"
    return found(key, name=name, why=guarding.stays)


def _open(what: str, open_plug_in: Any, name: str, *given: Any) -> Any:
    """What a plug-in opens; a ValueError says why it does not."""
    try:
        return start_call(partial(open_plug_in, name, *given))(what, OPENS_WITHIN_S)
    except (OSError, AssertionError) as failure:
        raise ValueError(f"{name}: {said(failure)}") from None


def _close(name: str, things: Sequence[Any]) -> Iterator[Finding]:
    for thing in things:
        try:
            start_call(thing.close)("close()", HANGS_S)
        except Exception as failure:
            yield found(f"{name}.unclosed", why=said(failure))


def _cameras(name: str, setup: Setup, vehicle: AnyVehicle) -> Iterator[Finding]:
    plugins.load_factory("--cameras", plugins.CAMERAS, name)
    try:
        cameras = _open("opening them", plugins.open_cameras, name, setup, vehicle)
    except ValueError as failure:
        yield found("cameras.unopened", why=failure)
        return
    try:
        watched = watch(cameras)
    finally:
        closing = list(_close("cameras", cameras))
    yield from judge_cameras(watched, setup.rig.image_sizes_px)
    yield from closing


def _odometry(vehicle: AnyVehicle, chassis: Chassis) -> Iterator[Finding]:
    """Read the vehicle `READINGS` times, in a thread of its own as a driver may hang, and judge."""
    worker = Worker()
    readings: list[Reading] = []
    failures: list[OSError] = []
    until_s = time.monotonic() + PATIENCE_S
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
    findings = list[Finding]()
    if failures:
        level, count = None if readings else "error", len(failures)
        both, why = count + len(readings), said(failures[-1])
        findings.append(found("odometry.failed", level, count=count, all=both, why=why))
    if readings:
        ages_s = [(reading.now_ns - reading.odometry.stamp_ns) / 1e9 for reading in readings]
        fresh_ns = sorted({reading.odometry.stamp_ns for reading in readings})
        rate_hz = (len(fresh_ns) - 1) * 1e9 / max(fresh_ns[-1] - fresh_ns[0], 1)
        findings += [*_wrong_stamps(readings, ages_s, rate_hz), *_wrong_values(readings, chassis)]
    if findings or not readings:
        yield from findings
        return
    reading, age_ms = _in_words(readings[-1].odometry), max(ages_s) * 1e3
    yield found("odometry.fine", all=len(readings), rate_hz=rate_hz, age_ms=age_ms, reading=reading)


def _in_words(read: Read) -> str:
    if isinstance(read, Odometry):
        return f"{read.speed_mps:+.2f} m/s, steering {read.steering_rad:+.2f} rad"
    return (
        f"{read.forward_mps:+.2f} m/s ahead, {read.left_mps:+.2f} to the left, turns "
        f"{read.turn_radps:+.2f} rad/s"
    )


def _wrong_stamps(
    readings: Sequence[Reading], ages_s: Sequence[float], rate_hz: float
) -> Iterator[Finding]:
    """Args:
    rate_hz: of distinct stamps.
    """
    slow, count = sum(reading.took_s > SLOW_S for reading in readings), len(readings)
    if min(ages_s) < 0:
        yield found("odometry.future", age_s=-min(ages_s))
    elif rate_hz == 0:
        yield found("odometry.repeated", all=count)
    elif max(ages_s) > OLD_S:
        yield found("odometry.old", age_s=max(ages_s), old_s=OLD_S)
    elif rate_hz < LEAST_RATE_HZ:
        yield found("odometry.rare", rate_hz=rate_hz, least_hz=LEAST_RATE_HZ)
    if slow > count // 10:
        yield found("odometry.slow", slow_ms=SLOW_S * 1e3, count=slow, all=count)


def _wrong_values(readings: Sequence[Reading], chassis: Chassis) -> Iterator[Finding]:
    count = len(readings)
    valid = [reading.odometry for reading in readings if reading.odometry.valid]
    finite = [o for o in valid if all(map(math.isfinite, o.values))]
    if len(valid) < count:
        level = None if valid else "error"
        yield found("odometry.invalid", level, count=count - len(valid), all=count)
    if len(finite) < len(valid):
        yield found("odometry.no_number", count=len(valid) - len(finite), all=len(valid))
    others = [o for o in finite if not chassis.reads(o)]
    if others:
        yield found("odometry.kind", kind=type(others[0]).__name__)
    if others or not finite:
        return
    fastest = max(finite, key=lambda o: pace_mps(chassis.driven_mps(o)))
    if pace_mps(chassis.driven_mps(fastest)) > _STANDS_MPS:
        same = len({o.values for o in finite}) == 1 < len(finite)
        repeated = f", {len(finite)} times the very same" if same else ""
        yield found("odometry.moves", reading=_in_words(fastest), repeated=repeated)
    cars, limits = [o for o in finite if isinstance(o, Odometry)], chassis.limits
    if cars and isinstance(limits, Limits):
        widest_rad = max((o.steering_rad for o in cars), key=abs)
        if abs(widest_rad) > 1.1 * limits.steering_rad:
            limit_rad = limits.steering_rad
            yield found("odometry.steering", steering_rad=widest_rad, limit_rad=limit_rad)
