"""Recordings as sequences of equal length: cut, padded, and stacked."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.errors import BadInput
from jaxnav.models.markers import MarkerMap
from jaxnav.navigator import Navigator
from jaxnav.tuning.recorded import FrameSequences

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
