"""Change data on their way to the pilot: the parts from which faults are made."""

import dataclasses
import itertools
import math
from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxnav.detection.types import Detections
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import GyroReading, Odometry, Reading, reading_of
from jaxnav.drive.pilot import Input
from jaxnav.vehicles.conformance.lockstep import BEGIN_NS, Change

EditFrame = Callable[[FrameDetections], FrameDetections | None]  # None: the frame is lost
EditOdometry = Callable[[Any], Reading | None]  # of one kind of vehicle


def seconds(given: Input) -> float:
    """The time of an input since the drive began, s."""
    return (given.now_ns - BEGIN_NS) / 1e9


def between(begin_s: float, end_s: float, change: Change) -> Change:
    """Apply a change from `begin_s` to `end_s`."""
    return lambda given: change(given) if begin_s <= seconds(given) < end_s else [given]


def frames(edit: EditFrame) -> Change:
    """Edit the frames of all cameras."""

    def change(given: Input) -> list[Input]:
        if not given.frames:
            return [given]
        kept = tuple(frame for frame in map(edit, given.frames) if frame is not None)
        return [dataclasses.replace(given, frames=kept)] if kept else []

    return change


def odometry(edit: EditOdometry) -> Change:
    """Edit all readings of the odometer."""

    def change(given: Input) -> list[Input]:
        if given.odometry is None:
            return [given]
        edited = edit(given.odometry)
        return [] if edited is None else [dataclasses.replace(given, odometry=edited)]

    return change


def field(name: str, edit: Callable[[Any], Any]) -> Callable[[Any], Any]:
    """Edit one field of a frame, a reading or detections."""
    return lambda whole: dataclasses.replace(whole, **{name: edit(getattr(whole, name))})


def detections(edit: Callable[[Detections], Detections]) -> EditFrame:
    """Edit the detections of frames."""
    return field("detections", lambda seen: None if seen is None else edit(seen))


def corners(edit: Callable[[Float[np.ndarray, "N 4 2"]], Float[np.ndarray, "N 4 2"]]) -> EditFrame:
    """Edit the corners (N, 4, 2) of frames."""
    return detections(field("corners_px", edit))


def doubled(shift_px: float) -> EditFrame:
    """Show every marker once more, so far away."""

    def edit(seen: Detections) -> Detections:
        other = dataclasses.replace(seen, corners_px=seen.corners_px + shift_px)
        return Detections.concatenate([seen, other])

    return detections(edit)


def mirrored(corners_px: Float[np.ndarray, "N 4 2"]) -> Float[np.ndarray, "N 4 2"]:
    """Mirror each marker's corners (N, 4, 2) about its middle."""
    center = corners_px.mean(axis=1, keepdims=True)
    x, y = 2 * center[..., 0] - corners_px[..., 0], corners_px[..., 1]
    return np.stack([x, y], axis=-1)[:, [1, 0, 3, 2]]


def random_corners() -> Change:
    """Put all corners anywhere."""
    rng = np.random.default_rng(0)
    return frames(corners(lambda c: rng.uniform([0, 0], [820, 410], c.shape)))


# Frames that show no marker: a tunnel, a black or a white image.
nothing_seen = field("detections", lambda _: Detections.concatenate([]))
# The driver says of a reading that it is none.
invalid = field("valid", lambda _: False)


def unusable(frame: FrameDetections) -> FrameDetections:
    """Make a frame unusable: no image, or one of a wrong size."""
    return dataclasses.replace(frame, detections=None, faults=Fault.FRAME_UNUSABLE)


def gone(_: object) -> None:
    """Lose a frame or a reading."""


def only_camera(camera: int, edit: EditFrame) -> EditFrame:
    """Edit the frames of one camera only."""
    return lambda frame: edit(frame) if frame.camera == camera else frame


def late(delay_s: float, every: int = 1) -> Change:
    """Delay every n-th input with frames, n = `every`."""
    calls = itertools.count(1)

    def change(given: Input) -> list[Input]:
        if not given.frames:
            return [given]
        delay_ns = int(delay_s * 1e9) if next(calls) % every == 0 else 0
        return [dataclasses.replace(given, now_ns=given.now_ns + delay_ns)]

    return change


def stalled(end_s: float) -> Change:
    """Stall the loop; it gets all inputs at once at the end."""
    end_ns = BEGIN_NS + int(end_s * 1e9)
    return lambda given: [dataclasses.replace(given, now_ns=max(given.now_ns, end_ns))]


def frozen(cameras: Iterable[int], jitter_px: float, seed: int = 0) -> EditFrame:
    """Freeze the pictures of cameras under new stamps.

    Args:
        jitter_px: largest difference of a corner detected again in the same picture.
    """
    kept: dict[int, Detections] = {}
    of, rng = set(cameras), np.random.default_rng(seed)

    def edit(frame: FrameDetections) -> FrameDetections:
        if frame.camera not in of:
            return frame
        if frame.detections is not None:
            kept.setdefault(frame.camera, frame.detections)
        sightings = kept.get(frame.camera)
        if sightings is not None:
            noise_px = jitter_px * rng.uniform(-1, 1, sightings.corners_px.shape)
            sightings = dataclasses.replace(sightings, corners_px=sightings.corners_px + noise_px)
        return dataclasses.replace(frame, detections=sightings)

    return edit


def speed(edit: Callable[[float], float]) -> EditOdometry:
    """Edit the measured speed, not the steering; all parts of a twist."""

    def edited(reading: Reading) -> Reading:
        if isinstance(reading, Odometry):
            return field("speed_mps", edit)(reading)
        return reading_of(reading.stamp_ns, tuple(map(edit, reading.values)), reading.valid)

    return edited


def neither(given: Input) -> list[Input]:
    """Lose frames and readings."""
    return [dataclasses.replace(given, odometry=None, frames=())]


def drifting_clocks() -> Change:
    """Let the clocks of cameras and odometer drift by 100 ppm."""

    def drifting(ns: int) -> int:
        return ns + int((ns - BEGIN_NS) * 100e-6)

    return both(frames(field("stamp_ns", drifting)), odometry(field("stamp_ns", drifting)))


def spiking() -> EditOdometry:
    """Measure ten times the speed in each fifth reading."""
    calls = itertools.count(1)
    return speed(lambda mps: (1.0 if next(calls) % 5 else 10.0) * mps)


def noise() -> Callable[[float], float]:
    """A gyro's rates with noise of 1 rad/s."""
    rng = np.random.default_rng(0)
    return lambda rate_radps: rate_radps + float(rng.standard_normal())


def gyro(edit: Callable[[float], float]) -> Change:
    """Edit the rates that a gyro reads, rad/s."""

    def change(given: Input) -> list[Input]:
        edited = (GyroReading(one.stamp_ns, edit(one.turn_radps)) for one in given.gyro)
        return [dataclasses.replace(given, gyro=tuple(edited))]

    return change


def constant() -> Callable[[Any], Any]:
    """Repeat the first value for ever."""
    first: list[Any] = []

    def edit(value: Any) -> Any:
        first.append(value)
        return first[0]

    return edit


def both(change: Change, other: Change) -> Change:
    """Apply two changes, one after the other."""
    return lambda given: [done for one in change(given) for done in other(one)]


def repeated() -> EditOdometry:
    """Repeat the first reading under new stamps."""
    first = constant()
    return lambda reading: dataclasses.replace(first(reading), stamp_ns=reading.stamp_ns)


def not_finite() -> EditOdometry:
    """Replace speed or steering, in turns, by what is no number."""
    names = itertools.cycle(("speed_mps", "steering_rad"))
    values = itertools.cycle((math.inf, -math.inf, math.nan))

    def edit(reading: Odometry) -> Odometry:
        bad: dict[str, Any] = {next(names): next(values)}
        return dataclasses.replace(reading, **bad)

    return edit
