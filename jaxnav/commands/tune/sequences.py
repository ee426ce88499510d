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
from jaxnav.recordings.other.recording import Recording
from jaxnav.recordings.other.replay import estimate_corner_sigma_px

LEAST_SEQUENCES = 4
GAP_S = 0.5  # a marker that was away for longer appears anew
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
    told = [named.recorded.obs.twist is not None for named in (one, other)]
    if told[0] != told[1]:
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


def observations(**fields: jax.Array) -> Observation:
    """Observations (B, T) of their fields, (B, T, ...) each."""
    of: Any = jax.vmap(jax.vmap(lambda fields: Observation(**fields)))
    stacked: Observation = of(fields)
    return stacked


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
    odometry, told = recording.odometry, {}
    if odometry is not None:
        told["twist"] = jnp.asarray([odometry.twists(piece) for piece in stamps_ns], float)
    reference = recording.reference
    truth, judged = np.tile(IDENTITY, (*frames.shape, 1)), np.zeros(frames.shape, bool)
    if reference is not None:
        judged = used & reference.valid[frames] & visible.any(axis=(2, 3))
        known = reference.valid[frames][..., None]
        Ts = poses_in_world(reference.T_world_vehicle[frames], opposite(recording.markers.origin_m))
        truth = np.where(known, Ts, truth)
    return FrameSequences(
        markers=maps(recording.markers, lanes),
        obs=observations(
            corners_px=jnp.asarray(corners_px, float),
            visible=jnp.asarray(visible),
            dt_s=jnp.asarray(dt_s, float),
            has_odometry=jnp.zeros(frames.shape, bool),
            **told,
        ),
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.asarray(truth, float),
        judged=jnp.asarray(judged),
    )
