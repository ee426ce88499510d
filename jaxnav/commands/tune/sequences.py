"""Recordings as sequences of equal length to tune a filter on: cut, padded, and stacked.

Inputs of a recorded drive are treated as the pilot treats them: the same stamps, frames and
readings are believed. But they are in the order of their stamps, as if nothing had ever come late.
"""

import math
from collections.abc import Collection, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.belief.constant_velocity import ConstantVelocity
from jaxnav.belief.selectors import make_selector
from jaxnav.datasets.recording import Recording
from jaxnav.datasets.replay import estimate_corner_sigma_px
from jaxnav.errors import BadInput
from jaxnav.loop.flags import Reject
from jaxnav.loop.frames import FrameIntake
from jaxnav.loop.history import EventData
from jaxnav.loop.pilot import Input
from jaxnav.loop.stamps import Stamps
from jaxnav.models.markers import MarkerMap
from jaxnav.models.origin import opposite, poses_in_world
from jaxnav.navigator import Navigator
from jaxnav.pose.observation import Observation
from jaxnav.recording.drive_log import DriveLog
from jaxnav.recording.drive_replay import check_inputs
from jaxnav.recording.drive_setup import DriveSetup
from jaxnav.tuning.recorded import FrameSequences

LEAST_SEQUENCES = 4
GAP_S = 0.5  # a marker that was away for longer appears anew
_NS_PER_US = 1000
IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # wxyz xyz


class NamedSequences(NamedTuple):
    """The sequences of one recording, with its name and navigator."""

    name: str  # of the file, for messages
    navigator: Navigator  # that goes with the sequences
    recorded: FrameSequences


def bounds(count: int, part: tuple[float, float]) -> tuple[int, int]:
    """The first row and the end of a part of `count` rows; adjoining parts share no row."""
    begin, end = (round(share * count) for share in part)
    return begin, end


def cut(indices: Int[np.ndarray, " N"], length: int) -> list[Int[np.ndarray, " T"]]:
    """The fewest pieces of at most `length` indices, whose lengths differ by one at most."""
    if not len(indices):
        return []
    return np.array_split(indices, -(-len(indices) // length))


def runs(
    indices: Int[np.ndarray, " N"], stamps_ns: Int[np.ndarray, " F"], gap_s: float
) -> list[Int[np.ndarray, " T"]]:
    """Rising indices, split where the stamps of two neighbours are more than `gap_s` apart."""
    if not len(indices):
        return []
    apart_s = np.diff(stamps_ns[indices]) / 1e9
    return np.split(indices, np.flatnonzero(apart_s > gap_s) + 1)


def side_by_side(
    pieces: Sequence[Int[np.ndarray, " N"]],
) -> tuple[Int[np.ndarray, "B T"], Bool[np.ndarray, "B T"]]:
    """Pieces padded to the longest with their last index, and a mask that is False at padding."""
    length = max(len(piece) for piece in pieces)
    indices = np.array([np.pad(piece, (0, length - len(piece)), mode="edge") for piece in pieces])
    lengths = np.array([len(piece) for piece in pieces])
    return indices, np.arange(length) < lengths[:, None]


def maps(markers: MarkerMap, rows: Int[np.ndarray, "B N"]) -> MarkerMap:
    """A map for each of B sequences, of N markers; ids are dummies, which no estimate uses."""

    def some(wxyz_xyz: Float[Array, "N 7"], size_m: Float[Array, " N"]) -> MarkerMap:
        ids = tuple(range(len(size_m)))
        return MarkerMap(jaxlie.SE3(wxyz_xyz), size_m, ids, families=("",) * len(ids))

    stack: MarkerMap = jax.vmap(some)(markers.Ts_world_marker.wxyz_xyz[rows], markers.size_m[rows])
    return stack


def join_sequences(recordings: Sequence[NamedSequences]) -> FrameSequences:
    """The sequences of all recordings, padded to the longest.

    Raises:
        BadInput: names two recordings that one estimator can't take together.
    """
    first = recordings[0]
    for other in recordings[1:]:
        if problem := _apart(first, other):
            raise BadInput(f"{first.name}, {other.name}", problem)
    return FrameSequences.concatenate([named.recorded for named in recordings])


def _apart(one: NamedSequences, other: NamedSequences) -> str | None:
    """The reason why one estimator can't take two recordings together; None without one."""
    lanes, lanes_other = (named.recorded.obs.visible.shape[2:] for named in (one, other))
    for what, here, there in zip(("cameras", "markers"), lanes, lanes_other, strict=True):
        if here != there:
            return f"must have as many {what} to be tuned on together, got {here} and {there}"
    if not _alike(one.recorded, other.recorded):
        return "must be of one kind to be tuned on together, drives or recordings of a rig"
    for what, flag, here, there in (
        ("rig", "--rig", _rig(one.navigator), _rig(other.navigator)),
        ("vehicle", "--vehicle", _vehicle(one.navigator), _vehicle(other.navigator)),
    ):
        if not eqx.tree_equal(here, there, rtol=1e-6, atol=1e-6):
            return f"must have the same {what} to be tuned on together; {flag} gives them one"
    return None


def _rig(navigator: Navigator) -> Any:
    """The parts on which poses depend; image sizes may be guesses from the corners seen."""
    return navigator.rig.cameras, navigator.rig.Ts_camera_vehicle


def _vehicle(navigator: Navigator) -> Any:
    return getattr(navigator.motion, "vehicle", None)


def _alike(one: Any, other: Any) -> bool:
    """Whether two trees have the same structure, whatever their leaves hold."""
    return bool(eqx.tree_equal(*(jax.tree.map(lambda _: 0, tree) for tree in (one, other))))


def _observations(**fields: jax.Array) -> Observation:
    """Observations (B, T) of their fields, (B, T, ...) each."""
    of: Any = jax.vmap(jax.vmap(lambda fields: Observation(**fields)))
    observations: Observation = of(fields)
    return observations


def navigator_of(
    recording: Recording,
    one_at_a_time: bool,
    selector: str,
    corner_sigma_px: float | None = None,
) -> Navigator:
    """The navigator that localises the rig of a recording by its `sequences_of_recording`.

    Args:
        selector: one of `SELECTORS`.
        corner_sigma_px: by default estimated from the recording itself.
    """
    if corner_sigma_px is None:
        corner_sigma_px = estimate_corner_sigma_px(recording)
    lanes = np.arange(1 if one_at_a_time else len(recording.markers.ids))
    return Navigator(
        rig=recording.rig,
        markers=jax.tree.map(lambda leaf: leaf[0], maps(recording.markers, lanes[None])),
        selector=make_selector(selector),
        motion=ConstantVelocity(),
        corner_sigma_px=corner_sigma_px,
    )


def sequences_of_recording(
    recording: Recording,
    one_at_a_time: bool,
    part: tuple[float, float],
    length: int = 64,
    shortest: int = 10,
) -> FrameSequences:
    """Sequences of a recording, judged where the reference knows the pose and a marker is in view.

    Args:
        one_at_a_time: a sequence is an appearance of one marker, as if it were the only one, and
            has the frames that show it; else it has all markers and consecutive frames. Either
            ends at a gap of more than `GAP_S`, and is cut in equal pieces where it is too long.
        part: which of the frames, as shares of them: (0, 0.5) is the first half.
        length: frames of a sequence, at most.
        shortest: sequences of fewer frames are left out.

    Raises:
        BadInput: there are fewer than `LEAST_SEQUENCES`.
    """
    begin, end = bounds(len(recording), part)
    seen = recording.seen
    markers, pieces = [], []
    for marker in range(seen.shape[1] if one_at_a_time else 1):
        frames = np.arange(begin, end)
        if one_at_a_time:
            frames = frames[seen[begin:end, marker]]
        for appearance in runs(frames, recording.stamps_ns, GAP_S):
            for piece in cut(appearance, length):
                if len(piece) >= shortest:
                    markers.append(marker)
                    pieces.append(piece)
    if len(pieces) < LEAST_SEQUENCES:
        what = "of one marker without a gap" if one_at_a_time else "without a gap"
        raise BadInput(
            recording.name,
            f"{end - begin} of its {len(recording)} frames give {len(pieces)} sequences of "
            f"{shortest} frames or more {what}: at least {LEAST_SEQUENCES} are needed",
        )
    return _recorded(recording, np.array(markers) if one_at_a_time else None, pieces)


def _recorded(
    recording: Recording, markers: Int[np.ndarray, " B"] | None, pieces: list[np.ndarray]
) -> FrameSequences:
    """Pieces of a recording as sequences side by side.

    Args:
        markers: the only marker of each piece; None for all of them.
    """
    frames, used = side_by_side(pieces)
    if markers is None:
        lanes = np.tile(np.arange(len(recording.markers.ids)), (len(pieces), 1))
        corners_px, visible = (
            lanes_of.reshape(*frames.shape, *lanes_of.shape[1:])
            for lanes_of in recording.lanes(frames.ravel())
        )
    else:
        lanes = markers[:, None]
        # Piece by piece, so that all markers but one of a large map are dropped at once.
        alone = [
            [lanes_of[:, :, [marker]] for lanes_of in recording.lanes(piece)]
            for piece, marker in zip(frames, markers, strict=True)
        ]
        corners_px, visible = (np.stack(rows) for rows in zip(*alone, strict=True))
    visible = visible & used[:, :, None, None]
    corners_px = np.where(visible[..., None, None], corners_px, 0.0)
    stamps_ns = recording.stamps_ns[frames]
    dt_s = np.diff(stamps_ns, axis=1, prepend=stamps_ns[:, :1]) / 1e9
    reference = recording.reference
    truth, judged = np.tile(IDENTITY, (*frames.shape, 1)), np.zeros(frames.shape, bool)
    if reference is not None:
        judged = used & reference.valid[frames] & visible.any(axis=(2, 3))
        known = reference.valid[frames][..., None]
        Ts = poses_in_world(reference.T_world_vehicle[frames], opposite(recording.markers.origin_m))
        truth = np.where(known, Ts, truth)
    return FrameSequences(
        markers=maps(recording.markers, lanes),
        obs=_observations(
            corners_px=jnp.asarray(corners_px, float),
            visible=jnp.asarray(visible),
            dt_s=jnp.asarray(dt_s, float),
            has_odometry=jnp.zeros(frames.shape, bool),
        ),
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.asarray(truth, float),
        judged=jnp.asarray(judged),
    )


class Event(NamedTuple):
    """A reading of the odometry or a sighting of markers, with its stamp."""

    stamp_ns: int
    data: EventData  # odometry, or corners of some cameras


def sequences_of_drive(
    log: DriveLog, setup: DriveSetup, part: tuple[float, float], length: int = 400
) -> FrameSequences:
    """Sequences of a drive. The car's true pose is unknown, so that no frame is judged.

    Odometry that the pilot refused on the way is left out.

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
    rows = _Rows.of(events, len(setup.rig), len(setup.markers.ids))
    indices, used = side_by_side(cut(np.arange(begin, end), length))
    stamps_us = rows.stamps_us[indices]
    dt_s = np.diff(stamps_us, axis=1, prepend=stamps_us[:, :1]) * 1e-6
    lanes = np.tile(np.arange(len(setup.markers.ids)), (len(indices), 1))
    obs = _observations(
        corners_px=jnp.asarray(rows.corners_px[indices], float),
        visible=jnp.asarray(rows.visible[indices] & used[..., None, None]),
        corner_sigma_px=jnp.asarray(rows.sigma_px[indices], float),
        speed_mps=jnp.asarray(rows.odometry[indices, 0], float),
        steering_rad=jnp.asarray(rows.odometry[indices, 1], float),
        has_odometry=jnp.asarray(rows.has_odometry[indices] & used),
        dt_s=jnp.asarray(dt_s, float),
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
    stamps = Stamps()
    for given in inputs:
        data, data_ns, _ = frames.check(given.frames, given.now_ns)
        if data is not None:
            yield Event(data_ns, data)
        reading = given.odometry
        if reading is None:
            continue
        stamp_ns = stamps.take(reading.stamp_ns, given.now_ns)
        odometry = (reading.speed_mps, reading.steering_rad)
        believed = reading.valid and all(map(math.isfinite, odometry))
        if stamp_ns is not None and believed and given.now_ns not in refused_ns:
            yield Event(stamp_ns, EventData(odometry=odometry))


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
    odometry: Float[np.ndarray, "N 2"]  # speed_mps, steering_rad: the last known
    has_odometry: Bool[np.ndarray, " N"]
    corners_px: Float[np.ndarray, "N C M 4 2"]
    visible: Bool[np.ndarray, "N C M"]
    sigma_px: Float[np.ndarray, "N C M 4"]

    @staticmethod
    def of(events: Sequence[Event], cameras: int, markers: int) -> "_Rows":
        """Arrays of the events, with stamps in whole microseconds as the pilot counts them."""
        lanes = (len(events), cameras, markers)
        rows = _Rows(
            stamps_us=np.array([event.stamp_ns // _NS_PER_US for event in events], np.int64),
            odometry=np.zeros((len(events), 2)),
            has_odometry=np.array([event.data.odometry is not None for event in events], bool),
            corners_px=np.zeros((*lanes, 4, 2)),
            visible=np.zeros(lanes, bool),
            sigma_px=np.ones((*lanes, 4)),
        )
        odometry = (0.0, 0.0)
        for index, (_, data) in enumerate(events):
            odometry = data.odometry or odometry
            rows.odometry[index] = odometry
            if data.corners_px is not None:
                rows.corners_px[index] = data.corners_px
                rows.visible[index] = data.visible
                rows.sigma_px[index] = data.sigma_px
        return rows
