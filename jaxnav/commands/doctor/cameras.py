"""Checks of cameras: a second of each one's frames (size, light, rate, age, skew between cameras),
and in a recorded drive whether their stamps tell when the images were taken."""

import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from jaxnav.commands.doctor.findings import Finding, found, listed, said
from jaxnav.commands.drive.delay_watch import delays_of, describe_delay, warnings
from jaxnav.drive.camera_delays import HARMLESS_S
from jaxnav.drive.interfaces import Camera, Frame
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.vehicles.conformance.calls import start_call

WATCH_S = 1.0
PATIENCE_S = 3.0  # until the first picture must have come
OLD_S = 0.2  # the loop calls a camera with older frames stale
LATE_S = 0.1
LEAST_RATE_HZ = 10.0
SKEW_S = 0.02
_DARK, _BRIGHT = 15.0, 240.0  # mean grey levels
_LEAST_CONTRAST = 8.0  # standard deviation of grey levels
_FROZEN = 3  # pictures that are all identical


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
        elif age_s > LATE_S:
            level = "error" if age_s > OLD_S else None
            findings.append(found("cameras.old", level, camera=name, age_s=age_s))
        if rate_hz < LEAST_RATE_HZ:
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
    for text in warnings(delays, setup):
        what, _, do = text.partition(": ")
        yield found("stamps.late", what=what, do=do)
    for name, one in zip(setup.rig.names, delays.delays, strict=True):
        if not one.known:
            yield found("stamps.unknown", camera=name, file=path.name)
        elif not one.late:
            delay, harmless_ms = describe_delay(one), HARMLESS_S * 1e3
            yield found("stamps.fine", camera=name, delay=delay, harmless_ms=harmless_ms)
