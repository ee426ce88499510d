"""Checks of a vehicle and its cameras, which are opened and read for a moment and never driven; and
of a recorded drive, whether the cameras' stamps tell when the images were taken."""

import math
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.commands.doctor.findings import Finding, Report, found, listed, said
from jaxnav.commands.drive.arguments import Doctor
from jaxnav.commands.drive.observers import delay_warnings, delays_of, describe_delay
from jaxnav.commands.kinds import key_values
from jaxnav.drive import plugins
from jaxnav.drive.camera_delays import HARMLESS_S
from jaxnav.drive.chassis import Chassis, chassis_of, pace_mps
from jaxnav.drive.interfaces import AnyVehicle, Camera, Frame, Odometry, Setup
from jaxnav.drive.interfaces import Reading as Read
from jaxnav.drive.limits import Limits
from jaxnav.drive.moved_vehicle import GuardProcess
from jaxnav.errors import BadInput
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.vehicles.conformance.calls import HANGS_S, Worker, start_call
from jaxnav.vehicles.conformance.cameras import Parked

OPENS_WITHIN_S = 30.0
PATIENCE_S = 3.0  # until a driver must have measured something, or a first picture must have come

READINGS = 20
SLOW_S = 0.02  # a whole tick of the loop
OLD_S = 0.1  # the loop calls older odometry stale
LEAST_RATE_HZ = 20.0
_PAUSE_S = 0.01
_STANDS_MPS = 0.05

WATCH_S = 1.0
OLD_FRAME_S = 0.2  # the loop calls a camera with older frames stale
LATE_FRAME_S = 0.1
LEAST_FRAME_RATE_HZ = 10.0
SKEW_S = 0.02
_DARK, _BRIGHT = 15.0, 240.0  # mean grey levels
_LEAST_CONTRAST = 8.0  # standard deviation of grey levels
_FROZEN = 3  # pictures that are all identical


def plug_ins(args: Doctor, report: Report, files: dict[str, Any]) -> Iterator[Finding]:
    """Examine the plug-ins that were named, if all files could be read."""
    if len(files) < 4:
        yield found("plug-ins.skipped")
        return
    rig, markers, vehicle = files["rig"], files["markers"], files["vehicle"]
    options, start = key_values("--option", args.option), files["route"].start_pose
    setup = Setup(rig, markers, vehicle, start, options=options)
    examine(report, setup, args.car, args.cameras)


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


# --- odometry ------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reading:
    """One `read` of a vehicle: its odometry, when it returned, and how long it took."""

    odometry: Read
    now_ns: int
    took_s: float


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


# --- cameras -------------------------------------------------------------------------------


@dataclass
class Watched:
    """What one camera gave within a second.

    Attributes:
        stamps_ns: of its frames.
        ages_s: the age of each frame when `read` returned it.
        pictures: a checksum of each image.
        first: the first frame.
        failure: the last error of `read`, or that it hung; empty without one.
    """

    name: str
    stamps_ns: list[int] = field(default_factory=list)
    ages_s: list[float] = field(default_factory=list)
    pictures: list[int] = field(default_factory=list)
    first: Frame | None = None
    failure: str = ""

    @property
    def rate_hz(self) -> float:
        """The mean rate of the stamps, Hz; 0 where they span no time."""
        span_s = (max(self.stamps_ns) - min(self.stamps_ns)) / 1e9
        return (len(self.stamps_ns) - 1) / span_s if span_s > 0 else 0.0


def watch(cameras: Sequence[Camera]) -> list[Watched]:
    """Read all cameras at once, each in its own thread, for a second after its first picture."""
    watched = [Watched(camera.name) for camera in cameras]
    looks = [
        start_call(partial(_look, camera, into))
        for camera, into in zip(cameras, watched, strict=True)
    ]
    for look, into in zip(looks, watched, strict=True):
        try:
            look("read()", PATIENCE_S + 2 * WATCH_S)
        except (AssertionError, OSError) as failure:
            into.failure = str(failure)
    return watched


def _look(camera: Camera, into: Watched) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while time.monotonic() < until_s:
        try:
            frame = camera.read(0.2)
        except OSError as failure:
            into.failure = said(failure)
            time.sleep(0.05)
            continue
        if frame is None:
            continue
        if into.first is None:
            into.first = frame
            until_s = time.monotonic() + WATCH_S
        into.stamps_ns.append(frame.stamp_ns)
        into.ages_s.append((time.monotonic_ns() - frame.stamp_ns) / 1e9)
        if frame.image is not None:
            into.pictures.append(zlib.crc32(np.asarray(frame.image).tobytes()))


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


def judge_cameras(
    watched: Sequence[Watched], sizes_px: Sequence[tuple[int, int]]
) -> Iterator[Finding]:
    """Report what is wrong with each camera, and the skew between all of them.

    Args:
        sizes_px: (width, height) of the rig's images.
    """
    for camera, size_px in zip(watched, sizes_px, strict=True):
        name, first, ages_s = camera.name, camera.first, camera.ages_s
        if first is None:
            why = f": {camera.failure}" if camera.failure else ""
            yield found("cameras.silent", camera=name, patience_s=PATIENCE_S, why=why)
            continue
        findings, light = list[Finding](), ", finds markers by itself"
        if first.image is not None:
            image = np.asarray(first.image)
            light = f", mean grey {image.mean():.0f}, contrast {image.std():.0f}"
            findings += _wrong_picture(name, image, size_px)
        rate_hz, age_s = camera.rate_hz, float(np.median(ages_s))
        if camera.failure:
            findings.append(found("cameras.failed", camera=name, why=camera.failure))
        if min(ages_s) < 0:
            findings.append(found("cameras.future", camera=name, age_s=-min(ages_s)))
        elif age_s > LATE_FRAME_S:
            level = "error" if age_s > OLD_FRAME_S else None
            findings.append(found("cameras.old", level, camera=name, age_s=age_s))
        if rate_hz < LEAST_FRAME_RATE_HZ:
            findings.append(found("cameras.rare", camera=name, rate_hz=rate_hz))
        if len(camera.pictures) >= _FROZEN and len(set(camera.pictures)) == 1:
            findings.append(found("cameras.frozen", camera=name, count=len(camera.pictures)))
        fine = found("cameras.fine", camera=name, rate_hz=rate_hz, age_ms=age_s * 1e3, light=light)
        yield from findings or [fine]
    yield from skew(watched)


def _wrong_picture(name: str, image: np.ndarray, size_px: tuple[int, int]) -> Iterator[Finding]:
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        yield found("cameras.kind", camera=name, dtype=image.dtype, shape=image.shape)
        return
    height, width = image.shape[:2]
    if (width, height) != tuple(size_px):
        yield found(
            "cameras.size", camera=name, width=width, height=height, rig_width=size_px[0],
            rig_height=size_px[1],
        )  # fmt: skip
    mean, contrast = float(image.mean()), float(image.std())
    if not _DARK <= mean <= _BRIGHT or contrast < _LEAST_CONTRAST:
        yield found("cameras.light", camera=name, mean=mean, contrast=contrast)


def skew(watched: Sequence[Watched]) -> Iterator[Finding]:
    """Report the time between each camera's frames and the nearest ones of the first camera."""
    seen = [camera for camera in watched if len(camera.stamps_ns) > 1]
    if len(seen) < 2:
        return
    apart_s = {}
    for camera in seen[1:]:
        apart_ns = np.subtract.outer(camera.stamps_ns, seen[0].stamps_ns)
        nearest = np.abs(apart_ns).argmin(axis=1, keepdims=True)
        apart_s[camera.name] = float(np.median(np.take_along_axis(apart_ns, nearest, 1))) / 1e9
    shown = listed(f"{name} {value * 1e3:+.0f} ms" for name, value in apart_s.items())
    key = "cameras.apart" if max(map(abs, apart_s.values())) > SKEW_S else "cameras.together"
    yield found(key, apart=f"against {seen[0].name}: {shown}")


def stamps(path: Path) -> Iterator[Finding]:
    """Report each camera's delay against the odometer in a drive that `jaxnav run --record` wrote.

    Raises:
        BadInput: the file is no recording, or damaged, or not of a car.
    """
    log = read_drive(path)
    setup = DriveSetup.from_header(log.header, path)
    setup.car(path)
    delays = delays_of(log, setup)
    for text in delay_warnings(delays, setup):
        what, _, do = text.partition(": ")
        yield found("stamps.late", what=what, do=do)
    for name, one in zip(setup.rig.names, delays.delays, strict=True):
        if not one.known:
            yield found("stamps.unknown", camera=name, file=path.name)
        elif not one.late:
            delay, harmless_ms = describe_delay(one), HARMLESS_S * 1e3
            yield found("stamps.fine", camera=name, delay=delay, harmless_ms=harmless_ms)
