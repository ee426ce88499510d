"""Localise the frames of a recording by a filter, a chunk at a time, and smooth their poses.

`Navigator.sense`, which runs on a vehicle too, is scanned over the frames, or the events of a
recorded drive; a smoother goes back from their end through the beliefs that were kept.
"""

import dataclasses
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.bank import Bank, heaviest
from jaxnav.core.filter.estimate import Belief, Estimate
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.smooth import Trail, doubt
from jaxnav.core.linalg.small_matrices import first_highest
from jaxnav.core.models.geometry import EVEN_RAD, planar_from_T_world_vehicle, rotation_error_rad
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import Origin, planar_in_world, poses_in_world
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.core.pose.refine import Candidates
from jaxnav.files.executables import kept
from jaxnav.recordings.drive_events import DriveEvents
from jaxnav.recordings.drive_setup import DriveSetup

CHUNK_FRAMES = 64


class Localised(eqx.Module):
    """The localised frames of a recording, leading axes (F, tracks) or none."""

    T_world_vehicle: jaxlie.SE3
    covariance: Float[Array, "... 6 6"]  # of xi in T_world_vehicle * cay(xi)
    located: Bool[Array, "..."]
    decided: Bool[Array, "..."]
    flip_probability: Float[Array, "..."]
    candidates: Candidates
    selected: Int[Array, "..."]  # of the candidates; -1: none

    @staticmethod
    def from_estimate(estimate: Estimate) -> "Localised":
        """The poses of one filtered frame."""
        same = {f.name: getattr(estimate, f.name) for f in dataclasses.fields(Localised)}
        return Localised(**same | {"covariance": estimate.covariance[:6, :6]})


class _Kept(eqx.Module):
    """The part of filtered frames that a smoother needs, leading axes (F, tracks) or none."""

    belief: Belief  # without what repeats
    candidates: Candidates


class _Packed(NamedTuple):
    """`_Kept` on the host, moments of living hypotheses alone: of 24 slots one or two live."""

    bare: _Kept  # its bank without mean and covariance
    moments: list[np.ndarray]  # (rows, n) and (rows, d, d)

    @staticmethod
    def from_kept(frames: _Kept) -> "_Packed":
        frames = jax.device_get(frames)
        lives = np.asarray(frames.belief.bank.initialised)
        moments = [np.asarray(whole)[lives] for whole in _moments(frames)]
        return _Packed(eqx.tree_at(_moments, frames, (None, None)), moments)

    def unpack(self) -> _Kept:
        """The frames; hypotheses that don't live are zero."""
        lives = np.asarray(self.bare.belief.bank.initialised)
        filled = []
        for rows in self.moments:
            filled.append(np.zeros((*lives.shape, *rows.shape[1:]), rows.dtype))
            filled[-1][lives] = rows
        return eqx.tree_at(_moments, self.bare, tuple(filled), is_leaf=lambda leaf: leaf is None)


def _moments(frames: _Kept) -> tuple[Array, Array]:
    return frames.belief.bank.mean, frames.belief.bank.covariance


def localise(
    navigator: Navigator,
    frames: int,
    observations: Callable[[int], Observation],
    alone: bool = False,
    smooth: bool = False,
) -> Iterator[tuple[int, Localised]]:
    """Filter all frames; then, if asked for, smooth them from the last to the first.

    Args:
        frames: how many there are.
        observations: those from an index on, `CHUNK_FRAMES` at most, (F, ...) in every leaf.
        alone: whether each marker is tracked alone, as if it were the only one.

    Yields:
        The index of a chunk's first frame, and (CHUNK_FRAMES, tracks) poses, where what is beyond
        the last frame means nothing.
    """
    tracks, begins = len(navigator.markers.ids) if alone else 1, range(0, frames, CHUNK_FRAMES)
    beliefs = _first_beliefs(_alone(navigator, 0) if alone else navigator, tracks=tracks)
    filtered: list[_Packed] = []
    for begin in begins:
        obs = _chunk(observations(begin))
        beliefs, poses, to_smooth = filter_frames(navigator, beliefs, obs, alone=alone, keep=smooth)
        if to_smooth is not None:
            filtered.append(_Packed.from_kept(to_smooth))
        yield begin, poses
    bank = navigator.motion.init(navigator.selector.hypotheses)
    end = _repeated((Trail.begin(bank, jnp.asarray(False)), bank.parent), tracks)
    behind: _Behind | None = None
    for begin in reversed(begins) if smooth else ():
        obs = _chunk(observations(begin))
        behind = behind or (*end, jax.tree.map(lambda leaf: leaf[0], obs))  # any
        behind, poses = smooth_frames(navigator, behind, filtered.pop().unpack(), obs)
        yield begin, poses


@kept
def _first_beliefs(navigator: Navigator, *, tracks: int) -> Belief:
    return _repeated(navigator.init().belief, tracks)


def _repeated(tree: Any, count: int) -> Any:
    return jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), tree)


def _chunk(obs: Observation) -> Observation:
    """Frames, padded by the last one again, which then shows nothing and is at the same time."""
    known = np.arange(CHUNK_FRAMES) < len(obs.visible)
    whole: Observation = jax.tree.map(lambda leaf: padded(leaf, CHUNK_FRAMES), obs)
    shown = whole.visible & known[:, None, None], whole.has_odometry & known, whole.dt_s * known
    padding_blind: Observation = eqx.tree_at(
        lambda o: (o.visible, o.has_odometry, o.dt_s), whole, shown
    )
    return padding_blind


def padded(rows: Array | np.ndarray, count: int) -> np.ndarray:
    """Pad rows to a number of them by repeating the last one."""
    rows = np.asarray(rows)
    return np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)])


@kept
def filter_frames(
    navigator: Navigator, beliefs: Belief, obs: Observation, *, alone: bool, keep: bool
) -> tuple[Belief, Localised, _Kept | None]:
    """Filter F frames in all tracks: the (tracks,) beliefs after them, their poses, and, if asked
    for, what a smoother needs of them."""

    Tracked = tuple[Belief, tuple[Localised, _Kept | None]]

    def track(belief: Belief, obs: Observation, marker: Array) -> Tracked:
        of_track = navigator
        if alone:
            of_track = _alone(navigator, marker)
            seen = obs.corners_px[:, marker][:, None], obs.visible[:, marker][:, None]
            obs = dataclasses.replace(obs, corners_px=seen[0], visible=seen[1])
        belief, estimate = of_track.sense(belief, obs)
        filtered = None
        if keep:
            filtered = _Kept(dataclasses.replace(belief, repeats=None), estimate.candidates)
        return belief, (Localised.from_estimate(estimate), filtered)

    def frame(beliefs: Belief, obs: Observation) -> Tracked:
        tracks = jnp.arange(len(navigator.markers.ids) if alone else 1)
        tracked: Tracked = jax.vmap(track, (0, None, 0))(beliefs, obs, tracks)
        return tracked

    beliefs, (poses, filtered) = jax.lax.scan(frame, beliefs, obs)
    return beliefs, poses, filtered


def _alone(navigator: Navigator, index: Array | int) -> Navigator:
    alone: Navigator = eqx.tree_at(
        lambda n: n.markers, navigator, single_marker(navigator.markers, index)
    )
    return alone


def single_marker(markers: MarkerMap, index: Array | int) -> MarkerMap:
    """A map of the one marker at an index."""
    T_world_marker = jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[index][None])
    return MarkerMap(T_world_marker, markers.size_m[index][None], ids=(0,), families=("",))


# Of what lies behind a frame on the way back, for each track; and the observation of all tracks.
_Behind = tuple[Trail, Int[Array, "tracks K"], Observation]


@kept
def smooth_frames(
    navigator: Navigator, behind: _Behind, filtered: _Kept, obs: Observation
) -> tuple[_Behind, Localised]:
    """Go back through frames, from the last to the first.

    Args:
        navigator: the one that filtered them.
        behind: of the last frame.
        filtered: (F, tracks) frames.
        obs: F observations, of which `dt_s` and the odometry are used.
    """

    def one(
        trail: Trail, parent: Array, filtered: _Kept, later: Observation
    ) -> tuple[Trail, Localised]:
        belief = filtered.belief
        trail = trail.back(navigator.motion, belief.bank, belief.decided, parent, later)
        return trail, _report(navigator, trail, filtered)

    def back(behind: _Behind, frame: tuple[_Kept, Observation]) -> tuple[_Behind, Localised]:
        (trail, parent, later), (filtered, obs) = behind, frame
        trail, smoothed = jax.vmap(one, (0, 0, 0, None))(trail, parent, filtered, later)
        return (trail, filtered.belief.bank.parent, obs), smoothed

    smoothed: tuple[_Behind, Localised] = jax.lax.scan(back, behind, (filtered, obs), reverse=True)
    return smoothed


def _report(navigator: Navigator, trail: Trail, filtered: _Kept) -> Localised:
    """What is reported of one frame of one track."""
    motion, belief, selector = navigator.motion, filtered.belief, navigator.selector
    bank: Bank = trail.as_bank(belief.bank)
    best = heaviest(bank)
    T = motion.T_world_vehicle(bank.mean[best])
    flip_probability, decided = belief.flip_probability, trail.decided
    if isinstance(selector, MultiHypothesis):
        flip_probability = doubt(motion, bank, selector.far_rad)
        decided = bank.initialised[best] & (flip_probability < selector.decided_mass)
    candidates = filtered.candidates
    off_rad = jax.vmap(lambda T_vehicle_world: rotation_error_rad(T_vehicle_world.inverse(), T))(
        candidates.T_vehicle_world
    )
    nearest = first_highest(-jnp.where(candidates.valid, off_rad, jnp.inf), EVEN_RAD)
    return Localised(
        T_world_vehicle=T,
        covariance=motion.error_covariance(bank, best)[:6, :6],
        located=bank.initialised[best],
        decided=decided,
        flip_probability=flip_probability,
        candidates=candidates,
        selected=jnp.where(jnp.any(candidates.valid) & bank.initialised[best], nearest, -1),
    )


# --- drives ---


@dataclass(frozen=True)
class DriveTrack:
    """Where a vehicle was at N events.

    Attributes:
        stamps_ns: (N,).
        Ts_world_vehicle: (N, 7) wxyz_xyz.
        poses: (N, 3), x_m y_m psi_rad.
        sigma_m, sigma_rad: (N,), of the position where it is known worst, and of the heading.
        located, decided: (N,) bool.
        flip_probability: (N,).
    """

    stamps_ns: Int[np.ndarray, " N"]
    Ts_world_vehicle: Float[np.ndarray, "N 7"]
    poses: Float[np.ndarray, "N 3"]
    sigma_m: Float[np.ndarray, " N"]
    sigma_rad: Float[np.ndarray, " N"]
    located: Bool[np.ndarray, " N"]
    decided: Bool[np.ndarray, " N"]
    flip_probability: Float[np.ndarray, " N"]

    def distances_to(
        self, other: "DriveTrack"
    ) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
        """Distances (N,) m and (N,) rad to a track of the same events, NaN where not located."""
        return distances(self.poses, other.poses, self.located & other.located)

    @property
    def positions_m(self) -> Float[np.ndarray, "N 3"]:
        """Positions of the vehicle, (N, 3) m, NaN where not located."""
        return np.where(self.located[:, None], self.Ts_world_vehicle[:, 4:], np.nan)


def distances(
    poses: Float[np.ndarray, "N 3"], others: Float[np.ndarray, "N 3"], known: Bool[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, " N"], Float[np.ndarray, " N"]]:
    """Distances (N,) m and (N,) rad between planar poses, NaN where they are not known."""
    apart = poses - others
    turn_rad = np.abs(np.angle(np.exp(1j * apart[:, 2])))
    shift_m = np.hypot(apart[:, 0], apart[:, 1])
    return np.where(known, shift_m, np.nan), np.where(known, turn_rad, np.nan)


def smooth_drive(
    events: DriveEvents, setup: DriveSetup, progress: Callable[[int], object] = lambda events: None
) -> tuple[DriveTrack, DriveTrack]:
    """The track of a drive as it was known at each event, and as it is known at the end.

    A drive is filtered as the pilot's own navigator would, had nothing come late, and without what
    the pilot does beside it: it restarts nothing and outvotes nobody.

    Args:
        setup: its navigator filters.
        progress: called with the number of events done since the last call, twice for each.
    """
    found, total, obs = [], len(events), jax.device_get(events.obs)
    for begin, poses in localise(
        setup.navigator(),
        total,
        lambda begin: jax.tree.map(lambda leaf: leaf[begin : begin + CHUNK_FRAMES], obs),
        smooth=True,
    ):
        found.append(jax.device_get(jax.tree.map(lambda leaf: leaf[:, 0], poses)))
        progress(min(CHUNK_FRAMES, total - begin))
    count, origin_m = len(found) // 2, setup.markers.origin_m
    return (
        _track(events.stamps_ns, found[:count], origin_m),
        _track(events.stamps_ns, found[count:][::-1], origin_m),
    )


def _track(stamps_ns: np.ndarray, chunks: list[Localised], origin_m: Origin) -> DriveTrack:
    whole = jax.tree.map(lambda *leaves: np.concatenate(leaves)[: len(stamps_ns)], *chunks)
    # In the vehicle's own axes, the last of which is vertical.
    covariance = np.where(whole.located[:, None, None], whole.covariance, 0).astype(float)
    position = np.linalg.eigvalsh(covariance[:, :2, :2])[:, -1]
    planar = jax.vmap(planar_from_T_world_vehicle)(whole.T_world_vehicle)
    return DriveTrack(
        stamps_ns,
        np.asarray(poses_in_world(whole.T_world_vehicle.wxyz_xyz, origin_m), float),
        np.asarray(planar_in_world(planar, origin_m), float),
        np.sqrt(np.maximum(position, 0)),
        np.sqrt(np.maximum(covariance[:, 5, 5], 0)),
        whole.located,
        whole.decided,
        whole.flip_probability,
    )
