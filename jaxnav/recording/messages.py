"""Convert the pilot's inputs to messages of a recorded drive, and back.

This is cheap: arrays are passed on as they are, and the recorder's thread makes them JSON. So they
must not be changed afterwards.
"""

import hashlib
import struct
from typing import Any

import jax

from jaxnav.detection.types import Detections
from jaxnav.files.ranges import RANGES
from jaxnav.loop.frames import FrameDetections
from jaxnav.loop.interfaces import Odometry
from jaxnav.loop.pilot import Input, Outcome
from jaxnav.recording.message_fields import Rows
from jaxnav.recording.message_schemas import (
    FRAMES,
    ODOMETRY,
    TICK,
    FramesMessage,
    OdometryMessage,
    SightedMessage,
    TickMessage,
)

# `Stamps` refuses a stamp outside of this range; it refuses the clamped one in the recording too.
_LEAST_NS, _MOST_NS = int(RANGES["stamp_ns"].least), int(RANGES["stamp_ns"].most)
_NONE = Detections.concatenate([])


def input_message(given: Input) -> tuple[str, int, dict[str, Any]]:
    """The topic, stamp in ns and message of an input: the arguments of `Recorder.put`."""
    message: dict[str, Any] = {"now_ns": given.now_ns, "faults": given.faults}
    if given.frames:
        message["frames"] = [_sighted_message(frame) for frame in given.frames]
    if given.odometry is None:
        topic, stamp_ns = (FRAMES, given.frames[0].stamp_ns) if given.frames else (TICK, None)
        return topic, given.now_ns if stamp_ns is None else stamp_ns, message
    reading = given.odometry
    message |= {
        "stamp_ns": _recordable(reading.stamp_ns),
        "speed_mps": float(reading.speed_mps),
        "steering_rad": float(reading.steering_rad),
        "valid": bool(reading.valid),
    }
    return ODOMETRY, reading.stamp_ns, message


def input_of(message: OdometryMessage | FramesMessage | TickMessage) -> Input:
    """The input of a message."""
    reading = None
    if isinstance(message, OdometryMessage):
        reading = Odometry(message.stamp_ns, message.speed_mps, message.steering_rad, message.valid)
    frames = () if isinstance(message, TickMessage) else tuple(map(_sighted, message.frames))
    return Input(message.now_ns, reading, frames, message.faults)


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
    state.update(struct.pack("<2d", outcome.steering_rad, outcome.throttle))
    return state.hexdigest()
