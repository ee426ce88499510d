"""Turn a recorded drive into a filter's observations, in the order of their stamps.

Inputs of a recorded drive are treated as the pilot treats them: the same stamps, frames and
readings are believed, corrected as the vehicle's file says. But they are in the order of their
stamps, as if nothing had ever come late.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxnav.core.models.imu import Gyro
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.core.pose.observation import Observation
from jaxnav.drive.chassis import chassis_of
from jaxnav.drive.corrections import Corrections
from jaxnav.drive.flags import Reject
from jaxnav.drive.frames import FrameIntake
from jaxnav.drive.gyro import GyroTrack
from jaxnav.drive.history import EventData
from jaxnav.drive.pilot import Input
from jaxnav.drive.stamps import OLD_NS, Stamps
from jaxnav.errors import BadInput
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.drive_replay import check_inputs
from jaxnav.recordings.drive_setup import DriveSetup

_NS_PER_US = 1000


class Event(NamedTuple):
    """A reading of the odometry or a sighting of markers, with its stamp."""

    stamp_ns: int
    data: EventData  # odometry, or corners of some cameras


@dataclass(frozen=True)
class DriveEvents:
    """N events of a drive.

    Attributes:
        stamps_ns: (N,), in whole microseconds as the pilot counts them.
        obs: (N, ...) on the host, `dt_s` since the event before, 0 of the first. Where the vehicle
            has a gyro, its mean rate in that time; NaN where it tells nothing.
    """

    stamps_ns: Int[np.ndarray, " N"]
    obs: Observation

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @staticmethod
    def from_inputs(
        inputs: Sequence[Input], setup: DriveSetup, where: Path, refused_ns: Collection[int] = ()
    ) -> "DriveEvents":
        """The events of a pilot's inputs.

        Args:
            where: the file that the inputs are of.
            refused_ns: `now_ns` of inputs whose odometry is left out.

        Raises:
            BadInput: a frame of a camera that the rig does not have, or no marker is in view.
        """
        check_inputs(inputs, setup, where)
        events = believed_events(inputs, setup, refused_ns)
        if not any(event.data.corners_px is not None for event in events):
            raise BadInput(where, f"{len(events)} events, and none shows a marker of the map")
        stamps_ns = np.array([e.stamp_ns // _NS_PER_US * _NS_PER_US for e in events], np.int64)
        fields = _fields(events, setup)
        fields["dt_s"] = np.diff(stamps_ns, prepend=stamps_ns[:1]) / 1e9
        if setup.vehicle.gyro is not None:
            fields["gyro_radps"] = np.zeros((len(events), 3))
            fields["gyro_radps"][:, 2] = _mean_rates(inputs, events, setup.vehicle.gyro)
        rows: Any = jax.vmap(lambda fields: Observation(**fields))(
            jax.tree.map(
                lambda leaf: leaf if leaf.dtype == bool else jnp.asarray(leaf, float), fields
            )
        )
        return DriveEvents(stamps_ns, jax.device_get(rows))


def refused_odometry(log: DriveLog) -> set[int]:
    """`now_ns` of the inputs whose odometry the pilot refused on the way."""
    refused = log.outcomes.rejects & Reject.ODOMETRY != 0
    return set(log.outcomes.now_ns[refused].tolist())


def believed_events(
    inputs: Sequence[Input], setup: DriveSetup, refused_ns: Collection[int] = ()
) -> list[Event]:
    """Events that a pilot would believe of its inputs, in the order of the stamps.

    Sightings by several cameras at one instant are one event.
    """
    events = sorted(
        _read_events(inputs, setup, refused_ns),
        key=lambda event: (event.stamp_ns, event.data.corners_px is None),  # corners first
    )
    merged: list[Event] = []
    for event in events:
        if merged and (both := _both(merged[-1], event)):
            merged[-1] = both
        else:
            merged.append(event)
    return merged


def _read_events(
    inputs: Sequence[Input], setup: DriveSetup, refused_ns: Collection[int]
) -> Iterator[Event]:
    """Events of the inputs that `Pilot.handle` would believe, without an estimate."""
    frames = FrameIntake(len(setup.rig), setup.markers, setup.corner_sigma_px)
    stamps, chassis = Stamps(), chassis_of(setup.vehicle)
    corrections = Corrections.from_vehicle(setup.vehicle)
    for given in inputs:
        seen = [corrections.correct_frame(frame) for frame in given.frames]
        data, data_ns, _ = frames.check(seen, given.now_ns)
        if data is not None:
            yield Event(data_ns, data)
        if given.odometry is None:
            continue
        reading = corrections.correct_reading(given.odometry)
        stamp_ns = stamps.take(reading.stamp_ns, given.now_ns)
        believed = reading.valid and chassis.reads(reading)
        if stamp_ns is not None and believed and given.now_ns not in refused_ns:
            yield Event(stamp_ns, EventData(odometry=reading.values))


def _mean_rates(
    inputs: Sequence[Input], events: Sequence[Event], gyro: Gyro
) -> Float[np.ndarray, " N"]:
    """What a gyro tells of the interval before each event, rad/s; NaN where it tells nothing."""
    track = GyroTrack(float(gyro.saturation_radps))
    of_gyro = iter(given for given in inputs if given.gyro)
    given = next(of_gyro, None)
    rates = np.full(len(events), np.nan)
    for index, (before, event) in enumerate(pairwise(events), 1):
        # Readings are late by less than this, and the track is longer.
        while given is not None and given.now_ns <= event.stamp_ns + OLD_NS:
            track.take(given.gyro, given.now_ns)
            given = next(of_gyro, None)
        rates[index] = track.mean_radps(before.stamp_ns, event.stamp_ns)
    return rates


def _both(one: Event, other: Event) -> Event | None:
    """Two events merged into one; None for different instants or the same camera."""
    a, b = one.data, other.data
    if one.stamp_ns != other.stamp_ns or a.visible is None or b.visible is None:
        return None
    there = b.visible.any(axis=1)
    if np.any(a.visible.any(axis=1) & there):
        return None

    def joined(of_a: Any, of_b: Any) -> np.ndarray:
        return np.where(there.reshape(-1, *[1] * (of_a.ndim - 1)), of_b, of_a)

    data = EventData(
        corners_px=joined(a.corners_px, b.corners_px),
        visible=a.visible | b.visible,
        sigma_px=joined(a.sigma_px, b.sigma_px),
    )
    return Event(one.stamp_ns, data)


def _fields(events: Sequence[Event], setup: DriveSetup) -> dict[str, np.ndarray]:
    """The fields of an `Observation` that the events fill, (N, ...) each; odometry is the last."""
    count, turns = len(events), isinstance(setup.vehicle, TwistBase)
    lanes = (count, len(setup.rig), len(setup.markers.ids))
    corners_px, sigma_px = np.zeros((*lanes, 4, 2)), np.ones((*lanes, 4))
    visible = np.zeros(lanes, bool)
    readings = np.zeros((count, 3 if turns else 2))
    reading: tuple[float, ...] = (0.0,) * readings.shape[1]
    for index, (_, data) in enumerate(events):
        reading = data.odometry or reading
        readings[index] = reading
        if data.corners_px is not None:
            corners_px[index] = data.corners_px
            visible[index] = data.visible
            sigma_px[index] = data.sigma_px
    fields = {
        "corners_px": corners_px,
        "visible": visible,
        "corner_sigma_px": sigma_px,
        "has_odometry": np.array([event.data.odometry is not None for event in events], bool),
    }
    if not turns:
        return fields | {"speed_mps": readings[:, 0], "steering_rad": readings[:, 1]}
    twist = np.zeros((count, 6))
    twist[:, [0, 1, 5]] = readings
    return fields | {"twist": twist}
