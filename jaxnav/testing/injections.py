"""What can happen to data on their way to the pilot: pieces of which faults are made."""

import dataclasses
import math
from collections.abc import Callable, Iterable

import numpy as np

from jaxnav.detection.types import Detections
from jaxnav.loop.flags import Fault
from jaxnav.loop.frames import Sighted
from jaxnav.loop.interfaces import Odometry
from jaxnav.testing.lockstep import BEGIN_NS, Change, Input

EditFrame = Callable[[Sighted], Sighted | None]  # None: it never comes
EditOdometry = Callable[[Odometry], Odometry | None]


def seconds(given: Input) -> float:
    """Since the drive began."""
    return (given.now_ns - BEGIN_NS) / 1e9


def between(begin_s: float, end_s: float, change: Change) -> Change:
    """A change for a while."""
    return lambda given: change(given) if begin_s <= seconds(given) < end_s else [given]


def frames(edit: EditFrame) -> Change:
    """Every camera's frame edited."""

    def change(given: Input) -> list[Input]:
        if not given.frames:
            return [given]
        kept = tuple(frame for frame in map(edit, given.frames) if frame is not None)
        return [dataclasses.replace(given, frames=kept)] if kept else []

    return change


def odometry(edit: EditOdometry) -> Change:
    """Every reading edited."""

    def change(given: Input) -> list[Input]:
        if given.odometry is None:
            return [given]
        edited = edit(given.odometry)
        return [] if edited is None else [dataclasses.replace(given, odometry=edited)]

    return change


def detections(edit: Callable[[Detections], Detections]) -> EditFrame:
    """What a frame shows, edited."""
    return lambda frame: (
        frame
        if frame.detections is None
        else dataclasses.replace(frame, detections=edit(frame.detections))
    )


def corners(edit: Callable[[np.ndarray], np.ndarray]) -> EditFrame:
    """Corners (N, 4, 2) edited."""
    return detections(lambda found: dataclasses.replace(found, corners_px=edit(found.corners_px)))


def stamps(edit: Callable[[int], int]) -> EditFrame:
    """The stamps of frames edited."""
    return lambda frame: dataclasses.replace(frame, stamp_ns=edit(frame.stamp_ns))


def nothing_seen(frame: Sighted) -> Sighted:
    """A frame that shows no marker: a tunnel, a black or a white image."""
    return dataclasses.replace(frame, detections=Detections.concatenate([]))


def unusable(frame: Sighted) -> Sighted:
    """No image, or one of a wrong size."""
    return dataclasses.replace(frame, detections=None, faults=Fault.FRAME_UNUSABLE)


def gone(_: object) -> None:
    """It never comes."""


def only_camera(camera: int, edit: EditFrame) -> EditFrame:
    """One camera's frames alone edited."""
    return lambda frame: edit(frame) if frame.camera == camera else frame


def late(delay_s: float, every: int = 1) -> Change:
    """Frames that come later than others: every so-manieth."""
    count = 0

    def change(given: Input) -> list[Input]:
        nonlocal count
        if not given.frames:
            return [given]
        count += 1
        delay_ns = int(delay_s * 1e9) if count % every == 0 else 0
        return [dataclasses.replace(given, now_ns=given.now_ns + delay_ns)]

    return change


def stalled(begin_s: float, stall_s: float) -> Change:
    """A loop that does nothing for a while, and then has to do all that came meanwhile."""
    end_ns = BEGIN_NS + int((begin_s + stall_s) * 1e9)

    def change(given: Input) -> list[Input]:
        waits = begin_s <= seconds(given) < begin_s + stall_s
        return [dataclasses.replace(given, now_ns=max(given.now_ns, end_ns))] if waits else [given]

    return change


def frozen(cameras: Iterable[int], jitter_px: float, seed: int = 0) -> EditFrame:
    """Cameras whose pictures stay the same under new stamps.

    Args:
        jitter_px: the largest error of a corner that is found anew in the same picture.
    """
    kept: dict[int, Detections] = {}
    of, rng = set(cameras), np.random.default_rng(seed)

    def edit(frame: Sighted) -> Sighted:
        if frame.camera not in of:
            return frame
        if frame.detections is not None:
            kept.setdefault(frame.camera, frame.detections)
        found = kept.get(frame.camera)
        if found is not None:
            noise_px = jitter_px * rng.uniform(-1, 1, found.corners_px.shape)
            found = dataclasses.replace(found, corners_px=found.corners_px + noise_px)
        return dataclasses.replace(frame, detections=found)

    return edit


def speed(edit: Callable[[float], float]) -> EditOdometry:
    """What the wheels say, edited; the steering goes on."""
    return lambda reading: dataclasses.replace(reading, speed_mps=edit(reading.speed_mps))


def constant() -> Callable[[float], float]:
    """The first value for ever."""
    first: list[float] = []

    def edit(value: float) -> float:
        first.append(value)
        return first[0]

    return edit


def both(change: Change, other: Change) -> Change:
    """Two changes one after the other."""
    return lambda given: [done for one in change(given) for done in other(one)]


def repeated() -> EditOdometry:
    """A driver that gives its old values again, under new stamps."""
    last: list[Odometry] = []

    def edit(reading: Odometry) -> Odometry:
        last.append(reading)
        return dataclasses.replace(last[0], stamp_ns=reading.stamp_ns)

    return edit


def with_values(values: Iterable[float]) -> EditOdometry:
    """Speed and steering that are no numbers, one kind after the other."""
    kinds = list(values)
    count = 0

    def edit(reading: Odometry) -> Odometry:
        nonlocal count
        count += 1
        bad = kinds[count % len(kinds)]
        if count % 2:
            return dataclasses.replace(reading, speed_mps=bad)
        return dataclasses.replace(reading, steering_rad=bad)

    return edit


NOT_FINITE = (math.nan, math.inf, -math.inf)
