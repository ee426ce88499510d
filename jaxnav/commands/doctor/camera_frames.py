"""Checks of a second of each camera's frames: size, light, rate, age, and skew between cameras."""

import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from jaxnav.commands.doctor.findings import Finding, error, listed, note, ok, said, warning
from jaxnav.drive.interfaces import Camera, Frame
from jaxnav.vehicles.conformance.calls import Finish, start_call

WATCH_S = 1.0
_PATIENCE_S = 3.0  # until the first picture must have come
_OLD_S = 0.2  # the loop calls a camera with older frames stale
_LATE_S = 0.1
_LEAST_RATE_HZ = 10.0
_SKEW_S = 0.02
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
    looks: list[Finish] = []
    for camera, into in zip(cameras, watched, strict=True):
        looks.append(start_call(partial(_look, camera, into)))
    for look, into in zip(looks, watched, strict=True):
        try:
            look("read()", _PATIENCE_S + 2 * WATCH_S)
        except (AssertionError, OSError) as failure:
            into.failure = str(failure)
    return watched


def _look(camera: Camera, into: Watched) -> None:
    until_s = time.monotonic() + _PATIENCE_S
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
        problems = [*_wrong_frames(camera), *_wrong_picture(camera, size_px)]
        yield from problems
        if not problems:
            yield ok(
                f"{camera.name}: {camera.rate_hz:.0f} Hz, {np.median(camera.ages_s) * 1e3:.0f} ms "
                f"old{_light(camera)}"
            )
    yield from skew(watched)


def _wrong_frames(camera: Watched) -> Iterator[Finding]:
    name = camera.name
    if camera.first is None:
        yield error(
            f"{name} gave no picture in {_PATIENCE_S:g} s"
            + (f": {camera.failure}" if camera.failure else ""),
            "is it plugged in? Does another program use it?",
        )
        return
    if camera.failure:
        yield warning(f"{name}: {camera.failure}", "look at its cable and its driver")
    if min(camera.ages_s) < 0:
        yield error(
            f"{name}: stamps lie up to {-min(camera.ages_s):.3g} s in the future",
            "stamp_ns must be of time.monotonic_ns() of this computer",
        )
    elif (age_s := float(np.median(camera.ages_s))) > _LATE_S:
        yield (error if age_s > _OLD_S else warning)(
            f"{name}: pictures are {age_s:.3g} s old when they arrive",
            "let the driver drop what waits in its queue (appsink drop=true max-buffers=1)",
        )
    if camera.rate_hz < _LEAST_RATE_HZ:
        yield warning(
            f"{name}: {camera.rate_hz:.1f} pictures a second",
            "shorten the exposure, or add light; choose a faster mode of the camera",
        )
    if len(camera.pictures) >= _FROZEN and len(set(camera.pictures)) == 1:
        yield error(
            f"{name}: {len(camera.pictures)} times the very same picture",
            "its driver repeats an old picture: plug it in again, start the driver anew",
        )


def _wrong_picture(camera: Watched, size_px: tuple[int, int]) -> Iterator[Finding]:
    if camera.first is None or camera.first.image is None:
        return
    image, name = np.asarray(camera.first.image), camera.name
    shape = image.shape
    if image.dtype != np.uint8 or image.ndim not in (2, 3):
        yield error(
            f"{name} gives {image.dtype} of shape {shape}",
            "expected uint8, (H, W) or (H, W, 3) in BGR order",
        )
        return
    if (shape[1], shape[0]) != tuple(size_px):
        yield error(
            f"{name} gives {shape[1]} x {shape[0]} px, the rig says {size_px[0]} x {size_px[1]}",
            "set the camera to the size that it was calibrated at, or calibrate again",
        )
    mean, contrast = float(image.mean()), float(image.std())
    if not _DARK <= mean <= _BRIGHT or contrast < _LEAST_CONTRAST:
        yield warning(
            f"{name}: mean grey {mean:.0f}, contrast {contrast:.0f}",
            "is the lens cap on, the light off, the exposure too long?",
        )


def _light(camera: Watched) -> str:
    if camera.first is None or camera.first.image is None:
        return ", finds markers by itself"
    image = np.asarray(camera.first.image)
    return f", mean grey {image.mean():.0f}, contrast {image.std():.0f}"


def skew(watched: Sequence[Watched]) -> Iterator[Finding]:
    """Report the time between each camera's frames and the nearest ones of the first camera."""
    seen = [camera for camera in watched if len(camera.stamps_ns) > 1]
    if len(seen) < 2:
        return
    first_ns = np.array(seen[0].stamps_ns)
    apart_s = {}
    for camera in seen[1:]:
        differences_ns = np.array(camera.stamps_ns)[:, None] - first_ns
        nearest = np.abs(differences_ns).argmin(axis=1)
        nearest_ns = differences_ns[np.arange(len(differences_ns)), nearest]
        apart_s[camera.name] = float(np.median(nearest_ns)) / 1e9
    shown = listed(f"{name} {value * 1e3:+.0f} ms" for name, value in apart_s.items())
    text = f"against {seen[0].name}: {shown}"
    if max(map(abs, apart_s.values())) > _SKEW_S:
        yield note(
            f"pictures are not taken together, {text}",
            "each frame counts at its own stamp; check that stamps are of the exposure",
        )
    else:
        yield ok(f"taken together, {text}")
