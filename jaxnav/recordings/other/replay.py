"""Localise a rig in every frame of a recording, in 6 degrees of freedom.

The same `Navigator.step` that runs on a vehicle is scanned over the frames, a chunk at a time.
"""

import dataclasses
import functools
import time
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.choose import Branch, Selector, judge_branch
from jaxnav.core.filter.free import ConstantVelocity, FreeBody
from jaxnav.core.filter.imu import InertialMotion
from jaxnav.core.filter.kalman import nis
from jaxnav.core.models.geometry import inverse_cayley
from jaxnav.core.models.imu import Preintegrated
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import opposite, poses_in_world
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.navigator import Navigator, State
from jaxnav.core.pose.candidates import find_candidates
from jaxnav.core.pose.observation import MODEL_SIGMA_PX, Observation, Snapshot
from jaxnav.errors import BadInput
from jaxnav.files import Params, apply_params, limits
from jaxnav.files.executables import kept
from jaxnav.recordings.other.recording import Recording
from jaxnav.recordings.other.smoothed import Kept, Localised, Packed, smooth_chunks
from jaxnav.recordings.ros.body import MAX_DT_S

CHUNK_FRAMES = 64
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
    frames_per_second: float  # compilation excluded
    corner_sigma_px: float  # the filter's
    filtered: "Replay | None" = None  # of a smoothed one: as each pose was known at its own time


class _Frames(eqx.Module):
    """Frames as `scan` takes them, leading axis (F,) or none."""

    corners_px: Float[Array, "*F C M 4 2"]
    visible: Bool[Array, "*F C M"]
    dt_s: Float[Array, "*F"]
    T_world_vehicle_true: Float[Array, "*F 7"]
    twist: Float[Array, "*F 6"] | None  # by odometry; None: of no frame
    imu: Preintegrated | None  # the same

    def observation(self) -> Observation:
        """The frames as observations."""
        return Observation(
            self.corners_px, self.visible, dt_s=self.dt_s, twist=self.twist, imu=self.imu
        )


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
    tracks = len(recording.markers.ids) if one_at_a_time else 1
    if tracks * len(recording) > limits.TRACKED_POSES:
        problem = (
            f"{len(recording)} frames of {tracks} markers are more than {limits.TRACKED_POSES}"
        )
        raise BadInput("--one-at-a-time", f"{problem} poses: take fewer frames (--limit)")
    alone = _with_markers(navigator, _single(navigator.markers, jnp.asarray(0)))
    state = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (tracks, *leaf.shape)),
        (alone if one_at_a_time else navigator).init(),
    )
    total, motions = len(recording), (recording.twists, recording.preintegrated)
    first = _frames(recording, motions, 0)
    run_chunk = _run_chunk.load(navigator, state, first, one_at_a_time=one_at_a_time, smooth=smooth)
    started = time.perf_counter()
    begins = range(0, total, CHUNK_FRAMES)
    chunks, filtered_frames = [], []
    for begin in begins:
        state, outputs, to_smooth = run_chunk(navigator, state, _frames(recording, motions, begin))
        chunks.append(jax.device_get(outputs))
        if smooth:
            filtered_frames.append(Packed.from_kept(to_smooth))
        progress(min(CHUNK_FRAMES, total - begin))
    elapsed_s = time.perf_counter() - started

    def joined(chunks: list[_Judged]) -> Replay:
        pose, seen, located, decided, flip_probability, nees, branch = jax.tree.map(
            lambda *leaves: np.concatenate(leaves)[:total], *chunks
        )
        return Replay(
            np.asarray(poses_in_world(pose, recording.markers.origin_m)),
            seen,
            located,
            decided,
            flip_probability,
            nees,
            branch,
            total / elapsed_s,
            corner_sigma_px,
        )

    filtered = joined(chunks)
    if not smooth:
        return filtered
    obs_of = jax.vmap(_Frames.observation)

    def observations(index: int) -> Observation:
        return obs_of(_frames(recording, motions, begins[index]))

    for index, poses in smooth_chunks(navigator, tracks, filtered_frames, observations):
        truth = _frames(recording, motions, begins[index]).T_world_vehicle_true
        chunks[index] = jax.device_get(_judge_all(poses, truth))
        progress(min(CHUNK_FRAMES, total - begins[index]))
    return dataclasses.replace(joined(chunks), filtered=filtered)


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
    rows = (recording.seen_px[picks], cameras, marker_indices)
    padded = (_padded(column, SIGMA_SAMPLES) for column in rows)
    e1_px2 = _best_e1_px2(recording.rig, recording.markers, *padded)
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
    candidates = find_candidates(Snapshot.create(rig, _single(markers, marker), obs))
    return jnp.min(jnp.where(candidates.valid, candidates.e1_px2, jnp.inf))


# Of a frame: poses (tracks, 7), and the next six fields of `Replay`.
_Judged = tuple[Array, Array, Array, Array, Array, Array, Branch]


def _judge(poses: Localised, T_world_vehicle_true: Array) -> _Judged:
    """One frame of one track, judged against its reference."""
    truth = jaxlie.SE3(T_world_vehicle_true)
    T, selected = poses.T_world_vehicle, poses.selected
    return (
        T.wxyz_xyz,
        selected >= 0,
        poses.located,
        poses.decided,
        poses.flip_probability,
        nis(inverse_cayley(T.inverse() @ truth), poses.covariance),
        judge_branch(poses.candidates, selected, truth),
    )


_judge_all = kept(jax.vmap(jax.vmap(_judge, (0, None))))


@kept
def _run_chunk(
    navigator: Navigator, state: State, chunk: _Frames, *, one_at_a_time: bool, smooth: bool
) -> tuple[State, _Judged, Kept | None]:
    """Run all tracks over the frames of a chunk; `state` has a leading axis (tracks,).

    Returns also what a smoother needs of the frames, where it is asked for.
    """
    markers = navigator.markers
    Outputs = tuple[_Judged, Kept | None]

    def outputs_of(markers: MarkerMap, state: State, frame: _Frames) -> tuple[State, Outputs]:
        state, out = _with_markers(navigator, markers).step(state, frame.observation())
        judged = _judge(Localised.from_estimate(out), frame.T_world_vehicle_true)
        return state, (judged, Kept.from_estimate(state.belief, out) if smooth else None)

    def step(state: State, frame: _Frames) -> tuple[State, Outputs]:
        def alone(state: State, marker: Array) -> tuple[State, Outputs]:
            seen_alone = dataclasses.replace(
                frame,
                corners_px=frame.corners_px[:, marker][:, None],
                visible=frame.visible[:, marker][:, None],
            )
            return outputs_of(_single(markers, marker), state, seen_alone)

        def together(state: State, _: Array) -> tuple[State, Outputs]:
            return outputs_of(markers, state, frame)

        tracks = jnp.arange(len(markers.ids) if one_at_a_time else 1)
        return jax.vmap(alone if one_at_a_time else together)(state, tracks)

    state, (judged, to_smooth) = jax.lax.scan(step, state, chunk)
    return state, judged, to_smooth


def _with_markers(navigator: Navigator, markers: MarkerMap) -> Navigator:
    return eqx.tree_at(lambda n: n.markers, navigator, markers)


def _single(markers: MarkerMap, index: Array) -> MarkerMap:
    """A map of the one marker at an index."""
    T_world_marker = jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[index][None])
    return MarkerMap(T_world_marker, markers.size_m[index][None], ids=(0,), families=("",))


_Motions = tuple[np.ndarray | None, Preintegrated | None]  # by odometry, by an IMU


def _frames(recording: Recording, motions: _Motions, begin: int) -> _Frames:
    """A chunk of frames, padded beyond the last one with frames that show nothing."""
    frames = np.arange(begin, min(begin + CHUNK_FRAMES, len(recording)))
    dt_s = (
        np.diff(recording.stamps_ns[frames], prepend=recording.stamps_ns[max(begin - 1, 0)]) / 1e9
    )
    reference = recording.reference
    truth = np.tile([1.0, 0, 0, 0, 0, 0, 0], (len(frames), 1))
    if reference is not None:
        there = opposite(recording.markers.origin_m)
        truth = poses_in_world(reference.T_world_vehicle[frames], there)
    corners_px, visible = recording.lanes(frames)
    twists, imu = jax.tree.map(lambda rows: rows[frames], motions)
    # Over a longer pause the motion is predicted for a while only, unless a sensor tells it.
    known = False if twists is None else np.isfinite(twists).all(axis=1)
    known = known if imu is None else known | (imu.duration_s > 0)
    dt_s = np.where(known, dt_s, np.clip(dt_s, 0, MAX_DT_S))

    hidden = np.zeros((CHUNK_FRAMES - len(frames), *visible.shape[1:]), bool)
    return _Frames(
        corners_px=_padded(corners_px, CHUNK_FRAMES),
        visible=jnp.asarray(np.concatenate([visible, hidden])),
        dt_s=_padded(dt_s, CHUNK_FRAMES),
        T_world_vehicle_true=_padded(truth, CHUNK_FRAMES),
        twist=None if twists is None else _padded(twists, CHUNK_FRAMES),
        imu=jax.tree.map(lambda rows: _padded(rows, CHUNK_FRAMES), imu),
    )


def _padded(rows: np.ndarray, count: int) -> Array:
    """Pad rows to a number of them by repeating the last one."""
    return jnp.asarray(np.concatenate([rows, np.repeat(rows[-1:], count - len(rows), axis=0)]))


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
    estimate = jaxlie.SE3(jnp.asarray(replay.T_world_vehicle))
    truth = jaxlie.SE3(
        jnp.broadcast_to(jnp.asarray(reference.T_world_vehicle)[:, None], estimate.wxyz_xyz.shape)
    )
    position_m = np.linalg.norm(estimate.translation() - truth.translation(), axis=-1)
    wxyz = np.asarray((estimate.rotation().inverse() @ truth.rotation()).wxyz)
    rotation_rad = 2 * np.arctan2(np.linalg.norm(wxyz[..., 1:], axis=-1), np.abs(wxyz[..., 0]))
    return np.where(known, position_m, np.nan), np.where(known, np.rad2deg(rotation_rad), np.nan)
