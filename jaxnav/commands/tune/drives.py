"""Recorded drives as sequences of equal length to tune a filter on.

Inputs of a recorded drive are treated as the pilot treats them: the same stamps, frames and
readings are believed, corrected as the vehicle's file says. But they are in the order of their
stamps, as if nothing had ever come late.
"""

from collections.abc import Collection, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxnav.commands.tune.sequences import IDENTITY, bounds, cut, maps, observations, side_by_side
from jaxnav.errors import BadInput
from jaxnav.loop.chassis import chassis_of
from jaxnav.loop.corrections import Corrections
from jaxnav.loop.flags import Reject
from jaxnav.loop.frames import FrameIntake
from jaxnav.loop.gyro_track import GyroTrack
from jaxnav.loop.history import EventData
from jaxnav.loop.pilot import Input
from jaxnav.loop.stamps import OLD_NS, Stamps
from jaxnav.models.gyro import Gyro
from jaxnav.models.twist_base import TwistBase
from jaxnav.recording.drive_log import DriveLog
from jaxnav.recording.drive_replay import check_inputs
from jaxnav.recording.drive_setup import DriveSetup
from jaxnav.tuning.recorded import FrameSequences

_NS_PER_US = 1000


class Event(NamedTuple):
    """A reading of the odometry or a sighting of markers, with its stamp."""

    stamp_ns: int
    data: EventData  # odometry, or corners of some cameras


def sequences_of_drive(
    log: DriveLog, setup: DriveSetup, part: tuple[float, float], length: int = 400
) -> FrameSequences:
    """Sequences of a drive. The vehicle's true pose is unknown, so that no frame is judged.

    Odometry that the pilot refused on the way is left out. Where the vehicle has a gyro, every
    event has its mean rate since the event before.

    Args:
        setup: its `navigator()` goes with the sequences.
        part: which of the events, as shares of them: (0, 0.5) is the first half.
        length: events of a sequence, at most.

    Raises:
        BadInput: a frame of a camera that the rig does not have, or no marker is in view.
    """
    outcomes = log.outcomes
    refused_ns = {
        int(now_ns)
        for now_ns, rejects in zip(outcomes.now_ns, outcomes.rejects, strict=True)
        if rejects & Reject.ODOMETRY
    }
    return sequences_of_inputs(log.inputs, setup, log.path, part, length, refused_ns)


def sequences_of_inputs(
    inputs: Sequence[Input],
    setup: DriveSetup,
    where: Path,
    part: tuple[float, float],
    length: int = 400,
    refused_ns: Collection[int] = (),
) -> FrameSequences:
    """`sequences_of_drive` for inputs of a pilot, which may come from a ROS bag.

    Args:
        where: the file that the inputs are of.
        refused_ns: `now_ns` of inputs whose odometry is left out.
    """
    check_inputs(inputs, setup, where)
    events = believed_events(inputs, setup, refused_ns)
    begin, end = bounds(len(events), part)
    if not any(event.data.corners_px is not None for event in events[begin:end]):
        problem = f"{end - begin} of its {len(events)} events, and none shows a marker of the map"
        raise BadInput(where, problem)
    rows = _Rows.of(events, setup)
    indices, used = side_by_side(cut(np.arange(begin, end), length))
    stamps_us = rows.stamps_us[indices]
    dt_s = np.diff(stamps_us, axis=1, prepend=stamps_us[:, :1]) * 1e-6
    lanes = np.tile(np.arange(len(setup.markers.ids)), (len(indices), 1))
    told = rows.wheels()
    if setup.vehicle.gyro is not None:
        told["gyro_radps"] = np.zeros((len(events), 3))
        told["gyro_radps"][:, 2] = _mean_rates(inputs, events, setup.vehicle.gyro)
    obs = observations(
        corners_px=jnp.asarray(rows.corners_px[indices], float),
        visible=jnp.asarray(rows.visible[indices] & used[..., None, None]),
        corner_sigma_px=jnp.asarray(rows.sigma_px[indices], float),
        has_odometry=jnp.asarray(rows.has_odometry[indices] & used),
        dt_s=jnp.asarray(dt_s, float),
        **{name: jnp.asarray(values[indices], float) for name, values in told.items()},
    )
    return FrameSequences(
        markers=maps(setup.markers, lanes),
        obs=obs,
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.asarray(np.tile(IDENTITY, (*used.shape, 1)), float),
        judged=jnp.zeros(used.shape, bool),
    )


def believed_events(
    inputs: Sequence[Input], setup: DriveSetup, refused_ns: Collection[int] = ()
) -> list[Event]:
    """Events that a pilot would believe of its inputs, in the order of the stamps.

    Sightings by several cameras at one instant are one event.
    """
    events = sorted(_read_events(inputs, setup, refused_ns), key=_order)
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
    corrections = Corrections.of(setup.vehicle)
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
    told = iter(given for given in inputs if given.gyro)
    given = next(told, None)
    rates = np.full(len(events), np.nan)
    for index, (before, event) in enumerate(pairwise(events), 1):
        # Readings are late by less than this, and the track is longer.
        while given is not None and given.now_ns <= event.stamp_ns + OLD_NS:
            track.take(given.gyro, given.now_ns)
            given = next(told, None)
        rates[index] = track.mean_radps(before.stamp_ns, event.stamp_ns)
    return rates


def _order(event: Event) -> tuple[int, bool]:
    """A sort key: by stamp, corners first."""
    return event.stamp_ns, event.data.corners_px is None


def _both(one: Event, other: Event) -> Event | None:
    """Two events merged into one; None for different instants or the same camera."""
    a, b = one.data, other.data
    if one.stamp_ns != other.stamp_ns or a.visible is None or b.visible is None:
        return None
    if np.any(np.any(a.visible, axis=1) & np.any(b.visible, axis=1)):
        return None
    assert a.corners_px is not None
    assert b.corners_px is not None
    assert a.sigma_px is not None
    assert b.sigma_px is not None
    there = np.any(b.visible, axis=1)[:, None]
    data = EventData(
        corners_px=np.where(there[..., None, None], b.corners_px, a.corners_px),
        visible=a.visible | b.visible,
        sigma_px=np.where(there[..., None], b.sigma_px, a.sigma_px),
    )
    return Event(one.stamp_ns, data)


class _Rows(NamedTuple):
    """N events as arrays."""

    stamps_us: np.ndarray
    odometry: Float[np.ndarray, "N values"]  # of the last reading, see `interfaces`
    has_odometry: Bool[np.ndarray, " N"]
    corners_px: Float[np.ndarray, "N C M 4 2"]
    visible: Bool[np.ndarray, "N C M"]
    sigma_px: Float[np.ndarray, "N C M 4"]

    @staticmethod
    def of(events: Sequence[Event], setup: DriveSetup) -> "_Rows":
        """Arrays of the events, with stamps in whole microseconds as the pilot counts them."""
        values = 3 if isinstance(setup.vehicle, TwistBase) else 2
        lanes = (len(events), len(setup.rig), len(setup.markers.ids))
        rows = _Rows(
            stamps_us=np.array([event.stamp_ns // _NS_PER_US for event in events], np.int64),
            odometry=np.zeros((len(events), values)),
            has_odometry=np.array([event.data.odometry is not None for event in events], bool),
            corners_px=np.zeros((*lanes, 4, 2)),
            visible=np.zeros(lanes, bool),
            sigma_px=np.ones((*lanes, 4)),
        )
        odometry: tuple[float, ...] = (0.0,) * values
        for index, (_, data) in enumerate(events):
            odometry = data.odometry or odometry
            rows.odometry[index] = odometry
            if data.corners_px is not None:
                rows.corners_px[index] = data.corners_px
                rows.visible[index] = data.visible
                rows.sigma_px[index] = data.sigma_px
        return rows

    def wheels(self) -> dict[str, np.ndarray]:
        """The fields of an `Observation` that the odometry fills, (N, ...) each."""
        if self.odometry.shape[1] == 2:
            return {"speed_mps": self.odometry[:, 0], "steering_rad": self.odometry[:, 1]}
        twist = np.zeros((len(self.odometry), 6))
        twist[:, [0, 1, 5]] = self.odometry
        return {"twist": twist}
