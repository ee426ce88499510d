"""Recordings as sequences of equal length to tune a filter on: cut, padded, and stacked."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.selectors import make_selector
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import opposite, poses_in_world
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.errors import BadInput
from jaxnav.experiments.tuning.recorded import FrameSequences
from jaxnav.recordings.drive_events import DriveEvents, refused_odometry
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.recording import Recording
from jaxnav.recordings.other.replay import estimate_corner_sigma_px

LEAST_SEQUENCES = 4
GAP_S = 0.5  # a marker that was away for longer appears anew
_IDENTITY = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # wxyz xyz


class NamedSequences(NamedTuple):
    """The sequences of one recording, with its name and navigator."""

    name: str  # of the file, for messages
    navigator: Navigator  # that goes with the sequences
    recorded: FrameSequences


def sequences_of_drive(
    log: DriveLog, setup: DriveSetup, part: tuple[float, float], length: int = 400
) -> FrameSequences:
    """Sequences of a drive. The vehicle's true pose is unknown, so that no frame is judged.

    Odometry that the pilot refused on the way is left out.

    Args:
        setup: its `navigator()` goes with the sequences.
        part: which of the events, as shares of them: (0, 0.5) is the first half.
        length: events of a sequence, at most.

    Raises:
        BadInput: a frame of a camera that the rig does not have, or no marker is in view.
    """
    events = DriveEvents.from_inputs(log.inputs, setup, log.path, refused_odometry(log))
    begin, end = _bounds(len(events), part)
    if not np.any(events.obs.visible[begin:end]):
        problem = f"{end - begin} of its {len(events)} events, and none shows a marker of the map"
        raise BadInput(log.path, problem)
    indices, used = _side_by_side(_cut(np.arange(begin, end), length))
    obs: Any = jax.tree.map(lambda leaf: jnp.asarray(leaf[indices]), events.obs)
    shown = obs.visible & used[..., None, None]
    of_used = shown, obs.has_odometry & used, jnp.where(used, obs.dt_s, 0).at[:, 0].set(0)
    obs = eqx.tree_at(lambda o: (o.visible, o.has_odometry, o.dt_s), obs, of_used)
    return FrameSequences(
        markers=_maps(setup.markers, np.tile(np.arange(len(setup.markers.ids)), (len(used), 1))),
        obs=obs,
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.asarray(np.tile(_IDENTITY, (*used.shape, 1)), float),
        judged=jnp.zeros(used.shape, bool),
    )


def navigator_of(
    recording: Recording, selector: str, corner_sigma_px: float | None = None
) -> Navigator:
    """The navigator that localises the rig of a recording by its `sequences_of_recording`.

    Args:
        selector: one of `SELECTORS`.
        corner_sigma_px: by default estimated from the recording itself.
    """
    if corner_sigma_px is None:
        corner_sigma_px = estimate_corner_sigma_px(recording)
    return Navigator(
        rig=recording.rig,
        markers=jax.tree.map(lambda leaf: leaf[0], _maps(recording.markers, np.zeros((1, 1), int))),
        selector=make_selector(selector),
        motion=ConstantVelocity(),
        corner_sigma_px=corner_sigma_px,
    )


def sequences_of_recording(
    recording: Recording, part: tuple[float, float], length: int = 64, shortest: int = 10
) -> FrameSequences:
    """Appearances of the markers of a recording, each as if that marker were the only one.

    An appearance has the frames that show the marker. It ends at a gap of more than `GAP_S`, and is
    cut in equal pieces where it is too long. Judged is where the reference knows the pose.

    Args:
        part: which of the frames, as shares of them: (0, 0.5) is the first half.
        length: frames of a sequence, at most.
        shortest: sequences of fewer frames are left out.

    Raises:
        BadInput: there are fewer than `LEAST_SEQUENCES`.
    """
    begin, end = _bounds(len(recording), part)
    markers, pieces = [], []
    for marker, seen in enumerate(recording.seen[begin:end].T):
        frames = begin + np.flatnonzero(seen)
        apart_s = np.diff(recording.stamps_ns[frames]) / 1e9
        for appearance in np.split(frames, np.flatnonzero(apart_s > GAP_S) + 1):
            for piece in _cut(appearance, length):
                if len(piece) >= shortest:
                    markers.append(marker)
                    pieces.append(piece)
    if len(pieces) < LEAST_SEQUENCES:
        raise BadInput(
            recording.name,
            f"{end - begin} of its {len(recording)} frames give {len(pieces)} sequences of "
            f"{shortest} frames or more of one marker without a gap: at least {LEAST_SEQUENCES} "
            "are needed",
        )
    return _recorded(recording, markers, pieces)


def _recorded(
    recording: Recording, markers: Sequence[int], pieces: Sequence[np.ndarray]
) -> FrameSequences:
    """Pieces of a recording as sequences side by side, each with its only marker."""
    frames, used = _side_by_side(pieces)
    # Piece by piece, so that all markers but one of a large map are dropped at once.
    alone = [
        [lanes[:, :, [marker]] for lanes in recording.lanes(piece)]
        for piece, marker in zip(frames, markers, strict=True)
    ]
    corners_px, visible = (np.stack(rows) for rows in zip(*alone, strict=True))
    visible = visible & used[:, :, None, None]
    stamps_ns = recording.stamps_ns[frames]
    fields = {
        "corners_px": np.where(visible[..., None, None], corners_px, 0.0),
        "dt_s": np.diff(stamps_ns, axis=1, prepend=stamps_ns[:, :1]) / 1e9,
    }
    if recording.odometry is not None:
        fields["twist"] = np.array([recording.odometry.twists(piece) for piece in stamps_ns])
    truth, judged, reference = (
        np.array(_IDENTITY),
        np.zeros(frames.shape, bool),
        recording.reference,
    )
    if reference is not None:
        known = reference.valid[frames]
        judged = used & known & visible.any(axis=(2, 3))
        Ts = poses_in_world(reference.T_world_vehicle[frames], opposite(recording.markers.origin_m))
        truth = np.where(known[..., None], Ts, truth)
    observed: Any = jax.vmap(jax.vmap(lambda fields: Observation(**fields)))
    return FrameSequences(
        markers=_maps(recording.markers, np.array(markers)[:, None]),
        obs=observed(
            {name: jnp.asarray(value, float) for name, value in fields.items()}
            | {"visible": jnp.asarray(visible), "has_odometry": jnp.zeros(frames.shape, bool)}
        ),
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.broadcast_to(jnp.asarray(truth, float), (*frames.shape, 7)),
        judged=jnp.asarray(judged),
    )


def _bounds(count: int, part: tuple[float, float]) -> tuple[int, int]:
    """The first row and the end of a part of `count` rows; adjoining parts share no row."""
    begin, end = (round(share * count) for share in part)
    return begin, end


def _cut(indices: Int[np.ndarray, " N"], length: int) -> list[Int[np.ndarray, " T"]]:
    """The fewest pieces of at most `length` indices, whose lengths differ by one at most."""
    return np.array_split(indices, max(1, -(-len(indices) // length)))


def _side_by_side(
    pieces: Sequence[Int[np.ndarray, " N"]],
) -> tuple[Int[np.ndarray, "B T"], Bool[np.ndarray, "B T"]]:
    """Pieces padded to the longest with their last index, and a mask that is False at padding."""
    lengths = np.array([len(piece) for piece in pieces])
    longest = int(lengths.max())
    indices = [np.pad(piece, (0, longest - len(piece)), mode="edge") for piece in pieces]
    return np.array(indices), np.arange(longest) < lengths[:, None]


def _maps(markers: MarkerMap, rows: Int[np.ndarray, "B N"]) -> MarkerMap:
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
    with_twist = [named.recorded.obs.twist is not None for named in (one, other)]
    if with_twist[0] != with_twist[1]:
        return "must both have odometry, or neither, to be tuned on together"
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
