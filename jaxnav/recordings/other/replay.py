"""Localise a rig in every frame of a recording, in 6 degrees of freedom.

A recording may have a reference by other software, against which every pose is judged.
"""

import functools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxnav.core.filter.choose import Branch, Selector, judge_branch
from jaxnav.core.filter.free import ConstantVelocity, FreeBody
from jaxnav.core.filter.imu import InertialMotion
from jaxnav.core.filter.kalman import nis
from jaxnav.core.models.geometry import inverse_cayley
from jaxnav.core.models.imu import Preintegrated
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import opposite, poses_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.candidates import find_candidates
from jaxnav.core.pose.observation import MODEL_SIGMA_PX, Observation, Snapshot
from jaxnav.errors import BadInput
from jaxnav.files import Params, apply_params, limits
from jaxnav.files.executables import kept
from jaxnav.recordings.other.localise import (
    CHUNK_FRAMES,
    Localised,
    localise,
    padded,
    single_marker,
)
from jaxnav.recordings.other.recording import Recording
from jaxnav.recordings.ros.body import MAX_DT_S

CLAIM = 1e-3  # a decided pose with a smaller flip probability claims to be right
# The log score of a probability of 0 that is wrong is infinite: none counts as less than this.
_LEAST_PROBABILITY = 1e-6
_MISFIT_SHARE = 0.25  # of a marker's side in the image
_MISFIT_FRAMES = 64  # in which map and reference are held against the corners
_IDS = 8  # that are listed
SIGMA_SAMPLES = 512  # detections from which the scatter of a recording's corners is estimated


@dataclass(frozen=True)
class Replay:
    """A localised recording. `tracks` is 1 where all markers share one pose, else the map's M."""

    T_world_vehicle: Float[np.ndarray, "F tracks 7"]
    seen: Bool[np.ndarray, "F tracks"]  # a marker of the track was in view
    located: Bool[np.ndarray, "F tracks"]
    decided: Bool[np.ndarray, "F tracks"]
    flip_probability: Float[np.ndarray, "F tracks"]
    nees: Float[np.ndarray, "F tracks"]  # of the pose, 6 dof; meaningless without a reference
    branch: Branch  # leaves (F, tracks); meaningless where there is no reference
    # Where a track is `seen`, in the order of `np.nonzero`: every pose that its corners may mean,
    # wxyz xyz, NaN where there are fewer than N; and which of them is nearest to the reported pose.
    candidates: Float[np.ndarray, "S N 7"]
    selected: Int[np.ndarray, " S"]
    frames_per_second: float  # without the first chunk, which is compiled, unless it is alone
    corner_sigma_px: float  # the filter's
    filtered: "Replay | None" = None  # of a smoothed one: as each pose was known at its own time


def replay(
    recording: Recording,
    selector: Selector,
    one_at_a_time: bool = False,
    corner_sigma_px: float | None = None,
    progress: Callable[[int], object] = lambda frames: None,
    params: Params | None = None,
    smooth: bool = False,
) -> Replay:
    """Localise the rig in every frame.

    Args:
        recording: frames, rig and map.
        selector: chooses the candidate to believe.
        one_at_a_time: whether each marker is tracked alone, as if it were the only one; M tracks.
        corner_sigma_px: standard deviation of a corner coordinate, by default that of `params`,
            or an estimate from the recording, see `estimate_corner_sigma_px`.
        progress: called with the number of frames done since the last call.
        params: replace the navigator's own.
        smooth: whether a pose is by what was seen after it as well as before.

    Raises:
        BadInput: a parameter that does not fit a rig that moves freely.
    """
    params = Params.from_values({}, "") if params is None else params
    if corner_sigma_px is not None:
        params = params.without("corner_sigma_px")
    elif "corner_sigma_px" not in params.values:
        corner_sigma_px = estimate_corner_sigma_px(recording)
    navigator = Navigator(
        rig=recording.rig,
        markers=recording.markers,
        selector=selector,
        motion=motion_of(recording),
        corner_sigma_px=1.0 if corner_sigma_px is None else corner_sigma_px,
    )
    navigator = apply_params(navigator, params)
    corner_sigma_px = float(navigator.corner_sigma_px)
    total, tracks = len(recording), len(recording.markers.ids) if one_at_a_time else 1
    if tracks * total > limits.TRACKED_POSES:
        problem = f"{total} frames of {tracks} markers are more than {limits.TRACKED_POSES}"
        raise BadInput("--one-at-a-time", f"{problem} poses: take fewer frames (--limit)")
    motions = recording.twists, recording.preintegrated
    chunks, clock_s = [], [time.perf_counter()]
    for begin, poses in localise(
        navigator,
        total,
        lambda begin: _observations(recording, motions, begin),
        one_at_a_time,
        smooth,
    ):
        chunks.append(_without_padding(_judge_all(poses, _truth(recording, begin)), total - begin))
        clock_s.append(time.perf_counter())
        progress(min(CHUNK_FRAMES, total - begin))
    count = -(-total // CHUNK_FRAMES)
    compiled = min(1, count - 1)  # chunks, of which the first is compiled too
    frames_per_second = (total - compiled * CHUNK_FRAMES) / (clock_s[count] - clock_s[compiled])

    def joined(chunks: list[Any], filtered: Replay | None = None) -> Replay:
        known, (candidates, selected) = jax.tree.map(lambda *some: np.concatenate(some), *chunks)
        pose, seen, located, decided, flip_probability, nees, branch = known
        pose, candidates = (
            np.asarray(poses_in_world(some, recording.markers.origin_m))
            for some in (pose, candidates)
        )
        measured = (
            pose,
            seen,
            located,
            decided,
            flip_probability,
            nees,
            branch,
            candidates,
            selected,
        )
        return Replay(*measured, frames_per_second, corner_sigma_px, filtered)

    filtered = joined(chunks[:count])
    return joined(chunks[count:][::-1], filtered) if smooth else filtered


def motion_of(recording: Recording) -> FreeBody:
    """The filter of a recorded rig: with an IMU where one is recorded, else with odometry."""
    if recording.imu is None:
        odometry = recording.odometry
        return ConstantVelocity(odometry_errors=None if odometry is None else odometry.errors())
    arm_m, noise = jnp.asarray(recording.imu.lever_arm_m, float), recording.imu.noise
    if recording.imu.level:
        return InertialMotion(noise=noise, lever_arm_m=arm_m)
    return InertialMotion.in_any_world(noise, lever_arm_m=arm_m)


def estimate_corner_sigma_px(recording: Recording) -> float:
    """Estimate the scatter of a recording's corners, px, from single markers in single cameras.

    The best pose of one marker leaves 2 of 8 coordinates over: its e1 is sigma^2 times chi-square
    with 2 degrees of freedom, however wrong the map and the extrinsics are. A few bad detections
    do not move the median over the recording. Calibration errors add `MODEL_SIGMA_PX`.
    """
    sightings = len(recording.seen_px)
    if not sightings:
        return 1.0
    picks = np.linspace(0, sightings - 1, min(sightings, SIGMA_SAMPLES)).astype(int)
    _, cameras, marker_indices = recording.seen_at[:, picks]
    columns = recording.seen_px[picks], cameras, marker_indices
    rows = (padded(column, SIGMA_SAMPLES) for column in columns)
    e1_px2 = _best_e1_px2(recording.rig, recording.markers, *rows)
    sigma_px = np.sqrt(np.median(np.asarray(e1_px2)[: len(picks)]) / (2 * np.log(2)))
    return float(np.hypot(sigma_px, MODEL_SIGMA_PX))


@kept
@functools.partial(jax.vmap, in_axes=(None, None, 0, 0, 0))
def _best_e1_px2(
    rig: CameraRig, markers: MarkerMap, corners_px: Array, camera: Array, marker: Array
) -> Array:
    """The e1, px^2, of the best pose of one marker in one camera."""
    seen = jnp.arange(len(rig)) == camera
    obs = Observation(jnp.broadcast_to(corners_px, (seen.shape[0], 1, 4, 2)), seen[:, None])
    candidates = find_candidates(Snapshot.create(rig, single_marker(markers, marker), obs))
    return jnp.min(jnp.where(candidates.valid, candidates.e1_px2, jnp.inf))


# The first fields of `Replay`, and of every frame what it has of those where a track is seen.
_Judged = tuple[tuple[Array, Array, Array, Array, Array, Array, Branch], tuple[Array, Array]]


def _judge(poses: Localised, T_world_vehicle_true: Array) -> _Judged:
    """One frame of one track, judged against its reference."""
    truth = jaxlie.SE3(T_world_vehicle_true)
    T, selected, of = poses.T_world_vehicle, poses.selected, poses.candidates
    candidates = jnp.where(of.valid[:, None], of.T_vehicle_world.inverse().wxyz_xyz, jnp.nan)
    judged = (
        T.wxyz_xyz,
        selected >= 0,
        poses.located,
        poses.decided,
        poses.flip_probability,
        nis(inverse_cayley(T.inverse() @ truth), poses.covariance),
        judge_branch(of, selected, truth),
    )
    return judged, (candidates, selected)


_judge_all = kept(jax.vmap(jax.vmap(_judge, (0, None))))


def _without_padding(judged: _Judged, frames: int) -> tuple[Any, list[np.ndarray]]:
    """A chunk's first so many frames, and the rows where a track is seen."""
    known, of_seen = jax.tree.map(lambda leaf: leaf[:frames], jax.device_get(judged))
    return known, [rows[known[1]] for rows in of_seen]


_Motions = tuple[np.ndarray | None, Preintegrated | None]  # by odometry, by an IMU


def _observations(recording: Recording, motions: _Motions, begin: int) -> Observation:
    """The frames of a chunk, (F, ...) in every leaf."""
    frames = np.arange(begin, min(begin + CHUNK_FRAMES, len(recording)))
    dt_s = (
        np.diff(recording.stamps_ns[frames], prepend=recording.stamps_ns[max(begin - 1, 0)]) / 1e9
    )
    twists, imu = jax.tree.map(lambda rows: rows[frames], motions)
    # Over a longer pause the motion is predicted for a while only, unless a sensor tells it.
    known = False if twists is None else np.isfinite(twists).all(axis=1)
    known = known if imu is None else known | (imu.duration_s > 0)
    dt_s = np.where(known, dt_s, np.clip(dt_s, 0, MAX_DT_S))
    fields = {"dt_s": dt_s, "twist": twists, "imu": imu}
    return _observed(recording.lanes(frames), fields)


@kept
@jax.vmap
def _observed(lanes: tuple[Array, Array], fields: dict[str, Any]) -> Observation:
    return Observation(*lanes, **fields)


def _truth(recording: Recording, begin: int) -> np.ndarray:
    """The reference of a chunk in the coordinates of the map, (CHUNK_FRAMES, 7)."""
    truth = np.tile([1.0, 0, 0, 0, 0, 0, 0], (CHUNK_FRAMES, 1))
    if recording.reference is not None:
        there = opposite(recording.markers.origin_m)
        rows = recording.reference.T_world_vehicle[begin : begin + CHUNK_FRAMES]
        truth[: len(rows)] = poses_in_world(rows, there)
    return truth


def frames_in_view(seen: Bool[np.ndarray, "F tracks"]) -> Int[np.ndarray, "F tracks"]:
    """The number of frames in a row, up to each, in which a track is seen; 0 where it is not."""
    frame = np.arange(len(seen))[:, None]
    last_unseen = np.maximum.accumulate(np.where(seen, -1, frame), axis=0)
    return np.where(seen, frame - last_unseen, 0)


def errors(
    replay: Replay, recording: Recording
) -> tuple[Float[np.ndarray, "F tracks"], Float[np.ndarray, "F tracks"]]:
    """Position errors (m) and rotation errors (deg), (F, tracks); NaN without either pose."""
    reference = recording.reference
    assert reference is not None
    known = replay.seen & reference.valid[:, None]
    shape = replay.T_world_vehicle.shape
    estimate = replay.T_world_vehicle[known]
    truth = np.broadcast_to(reference.T_world_vehicle[:, None], shape)[known]
    turned, wanted = (
        Rotation.from_quat(poses[:, :4], scalar_first=True) for poses in (estimate, truth)
    )
    position_m, rotation_deg = np.full((2, *known.shape), np.nan)
    position_m[known] = np.linalg.norm(estimate[:, 4:] - truth[:, 4:], axis=1)
    rotation_deg[known] = np.rad2deg((turned.inv() * wanted).magnitude())
    return position_m, rotation_deg


def scores(replay: Replay, recording: Recording) -> dict[str, float]:
    """How often poses are of the wrong branch and claim to be right, and what that is worth.

    Shares are of the poses with a reference: `wrong` another candidate is nearer to it, `outlier`
    none is near, `decided`, `claimed` decided with a flip probability below `CLAIM`,
    `wrong_of_claimed`. `log_score` is the mean of -log(probability given to what was true), beside
    it that of the best constant; both leave outliers out, as neither branch is true. `anees` is the
    mean squared error by the pose's covariance, which is 6 where that is right.
    """
    assert recording.reference is not None
    judged = replay.seen & recording.reference.valid[:, None]
    wrong, outlier, decided, doubt = (
        np.asarray(each)[judged]
        for each in (replay.branch.wrong, replay.branch.outlier, replay.decided,
                     replay.flip_probability)
    )  # fmt: skip
    claimed = decided & (doubt < CLAIM)
    known = wrong[~outlier]
    probability = np.clip(doubt[~outlier], _LEAST_PROBABILITY, 1 - _LEAST_PROBABILITY)
    nees = replay.nees[judged & replay.located]
    share = np.clip(_mean(known), 1e-12, 1 - 1e-12)
    return {
        "wrong": _mean(wrong),
        "outlier": _mean(outlier),
        "decided": _mean(decided),
        "claimed": _mean(claimed),
        "wrong_of_claimed": _mean(wrong[claimed]),
        "log_score": -_mean(np.where(known, np.log(probability), np.log1p(-probability))),
        "log_score_of_a_constant": float(-(share * np.log(share) + (1 - share) * np.log1p(-share))),
        "anees": _mean(nees),
        "nees_median": float(np.median(nees)) if len(nees) else np.nan,
    }


def _mean(values: np.ndarray) -> float:
    return float(np.mean(values)) if len(values) else np.nan


def explain_outliers(recording: Recording) -> str:
    """A line about why many poses are far from the reference.

    By the reference's poses the map is held against the corners that were seen: some markers are
    not where it says, or it and the reference are in two frames.
    """
    assert recording.reference is not None
    frames = np.flatnonzero(recording.reference.valid)
    frames = frames[np.linspace(0, len(frames) - 1, min(len(frames), _MISFIT_FRAMES)).astype(int)]
    rig, markers = recording.rig, recording.markers
    on_map = poses_in_world(recording.reference.T_world_vehicle[frames], opposite(markers.origin_m))
    there_px = jax.vmap(lambda T: rig.project(T.inverse(), markers.corners_world_m))(
        jaxlie.SE3(jnp.asarray(on_map))
    )
    corners_px, visible = recording.lanes(frames)
    off_px = np.linalg.norm(corners_px - np.asarray(there_px), axis=-1).mean(axis=-1)
    sides_px = np.linalg.norm(corners_px - np.roll(corners_px, 1, axis=-2), axis=-1).mean(axis=-1)
    off_px = np.nan_to_num(off_px, nan=np.inf)
    misfits = {
        marker_id: float(np.median(off_px[..., m][seen] / sides_px[..., m][seen]))
        for m, marker_id in enumerate(markers.ids) if (seen := visible[..., m]).any()
    }  # fmt: skip
    off = [marker_id for marker_id, share in misfits.items() if share > _MISFIT_SHARE]
    if 2 * len(off) > len(misfits):
        return (
            "many outliers: map and reference do not share a frame; by the reference "
            f"{len(off)} of {len(misfits)} markers are not where they were seen"
        )
    if off:
        names = ", ".join(map(str, off[:_IDS])) + (", ..." if len(off) > _IDS else "")
        return f"many outliers: not where the map says, by the reference, are markers {names}"
    return "many outliers, but map and reference agree with the corners"
