"""Convert the pilot's inputs to messages of a recorded drive, and back.

This is cheap: arrays are passed on as they are, and the recorder's thread makes them JSON. So they
must not be changed afterwards.
"""

import hashlib
import struct
from typing import Any

import jax

from jaxnav.detection.types import Detections
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import GyroReading, Odometry, reading_of
from jaxnav.drive.pilot import Input, Outcome
from jaxnav.files.ranges import RANGES
from jaxnav.recordings.message_fields import Rows
from jaxnav.recordings.message_schemas import (
    FRAMES,
    ODOMETRY,
    TICK,
    TWIST,
    AnyInputMessage,
    OdometryMessage,
    SightedMessage,
    TickMessage,
    TwistMessage,
)

# `Stamps` refuses a stamp outside of this range; it refuses the clamped one in the recording too.
_LEAST_NS, _MOST_NS = int(RANGES["stamp_ns"].least), int(RANGES["stamp_ns"].most)
_NONE = Detections.concatenate([])


def input_message(given: Input) -> tuple[str, int, dict[str, Any]]:
    """The topic, stamp in ns and message of an input: the arguments of `Recorder.put`."""
    message: dict[str, Any] = {"now_ns": given.now_ns, "faults": given.faults}
    if given.frames:
        message["frames"] = [_sighted_message(frame) for frame in given.frames]
    if given.gyro:
        message["gyro"] = [_gyro_message(one) for one in given.gyro]
    if given.odometry is None:
        topic, stamp_ns = (FRAMES, given.frames[0].stamp_ns) if given.frames else (TICK, None)
        return topic, given.now_ns if stamp_ns is None else stamp_ns, message
    reading = given.odometry
    of_car = isinstance(reading, Odometry)
    names = ("speed_mps", "steering_rad") if of_car else ("forward_mps", "left_mps", "turn_radps")
    message["stamp_ns"] = _recordable(reading.stamp_ns)
    message |= zip(names, map(float, reading.values), strict=True)
    message["valid"] = bool(reading.valid)
    return ODOMETRY if of_car else TWIST, reading.stamp_ns, message


def input_of(message: AnyInputMessage) -> Input:
    """The input of a message."""
    reading = None
    if isinstance(message, OdometryMessage | TwistMessage):
        reading = reading_of(message.stamp_ns, message.values, message.valid)
    frames = () if isinstance(message, TickMessage) else tuple(map(_sighted, message.frames))
    gyro = tuple(GyroReading(one.stamp_ns, one.turn_radps) for one in message.gyro)
    return Input(message.now_ns, reading, frames, message.faults, gyro)


def _gyro_message(reading: GyroReading) -> dict[str, Any]:
    return {"stamp_ns": _recordable(reading.stamp_ns), "turn_radps": float(reading.turn_radps)}


def _sighted_message(frame: FrameDetections) -> dict[str, Any]:
    detections = _NONE if frame.detections is None else frame.detections
    return {
        "camera": frame.camera,
        "stamp_ns": _recordable(frame.stamp_ns),
        "usable": frame.detections is not None,
        "ids": detections.ids,
        "families": detections.families,
        "corners_px": Rows(detections.corners_px),
        "sigma_px": Rows(detections.sigma_px),
        "refined": detections.refined,
        "faults": frame.faults,
    }


def _recordable(stamp_ns: int) -> int:
    return min(max(stamp_ns, _LEAST_NS), _MOST_NS)


def _sighted(message: SightedMessage) -> FrameDetections:
    markers = Detections(
        ids=message.ids,
        corners_px=message.corners_px,
        sigma_px=message.sigma_px,
        refined=message.refined,
        families=tuple(message.families),
    )
    detections = markers if message.usable else None
    return FrameDetections(message.camera, message.stamp_ns, detections, message.faults)


def digest(outcome: Outcome) -> str:
    """The digest of an outcome's belief and command: drives with the same digests are the same."""
    output = outcome.output
    numbers = (outcome.belief, output.pose, output.covariance, output.command)
    state = hashlib.blake2b(digest_size=8)
    for leaf in jax.tree.leaves(numbers):
        state.update(leaf.tobytes())
    command = outcome.command
    state.update(struct.pack(f"<{len(command)}d", *command))
    return state.hexdigest()
