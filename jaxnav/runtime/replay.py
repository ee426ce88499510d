"""A recording through the estimator: every frame localised, in 6 degrees of freedom.

The very `Navigator.step` that runs on a vehicle is scanned over the frames, a chunk at a time.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.ambiguity import Selector
from jaxnav.evaluation import Branch, judge_branch
from jaxnav.markers import MarkerMap
from jaxnav.motion import ConstantVelocity
from jaxnav.navigator import Navigator, State
from jaxnav.observation import Observation
from jaxnav.runtime.recording import Recording

CHUNK_FRAMES = 64
MAX_DT_S = 1.0  # between two frames; a longer pause is a prediction for one second


@dataclass(frozen=True)
class Replay:
    """A localised recording. `tracks` is 1 where all markers serve one pose, else the map's M."""

    T_world_vehicle: Float[np.ndarray, "F tracks 7"]
    seen: Bool[np.ndarray, "F tracks"]  # a marker of the track was in view
    located: Bool[np.ndarray, "F tracks"]
    flip_probability: Float[np.ndarray, "F tracks"]
    branch: Branch  # leaves (F, tracks); meaningless where there is no reference
    frames_per_second: float  # compilation excluded


class _Frames(eqx.Module):
    """Frames as `scan` takes them, leading axis (F,) or none."""

    corners_px: Float[Array, "*F C M 4 2"]
    visible: Bool[Array, "*F C M"]
    dt_s: Float[Array, "*F"]
    T_world_vehicle_true: Float[Array, "*F 7"]


def replay(
    recording: Recording,
    selector: Selector,
    one_at_a_time: bool = False,
    corner_sigma_px: float = 1.0,
    progress: Callable[[int], object] = lambda frames: None,
) -> Replay:
    """Localise the rig in every frame.

    Args:
        recording: frames, rig and map.
        selector: which candidate is believed.
        one_at_a_time: every marker for itself, as if it were the only one; M tracks.
        corner_sigma_px: standard deviation of a corner coordinate.
        progress: called with the number of frames done since the last call.
    """
    step, state = _stepper(recording, selector, one_at_a_time, corner_sigma_px)

    @jax.jit
    def run_chunk(state: State, frames: _Frames, begin: Array) -> tuple[State, tuple]:
        chunk = jax.tree.map(
            lambda leaf: jax.lax.dynamic_slice_in_dim(leaf, begin, CHUNK_FRAMES), frames
        )
        return jax.lax.scan(step, state, chunk)

    frames = _frames(recording)
    total = len(recording)
    run_chunk_compiled = run_chunk.lower(state, frames, jnp.asarray(0)).compile()
    started = time.perf_counter()
    chunks = []
    for begin in range(0, total, CHUNK_FRAMES):
        state, outputs = run_chunk_compiled(state, frames, jnp.asarray(begin))
        chunks.append(jax.device_get(outputs))
        progress(min(CHUNK_FRAMES, total - begin))
    elapsed_s = time.perf_counter() - started
    wxyz_xyz, seen, located, flip_probability, branch = jax.tree.map(
        lambda *leaves: np.concatenate(leaves)[:total], *chunks
    )
    return Replay(wxyz_xyz, seen, located, flip_probability, branch, total / elapsed_s)


def _stepper(
    recording: Recording, selector: Selector, one_at_a_time: bool, corner_sigma_px: float
) -> tuple[Callable[[State, _Frames], tuple[State, tuple]], State]:
    """A scannable step over all tracks, and their initial state."""

    def navigator(markers: MarkerMap) -> Navigator:
        return Navigator(
            rig=recording.rig,
            markers=markers,
            selector=selector,
            motion=ConstantVelocity(),
            corner_sigma_px=corner_sigma_px,
        )

    def outputs_of(markers: MarkerMap, state: State, frame: _Frames) -> tuple[State, tuple]:
        obs = Observation(frame.corners_px, frame.visible, dt_s=frame.dt_s)
        state, out = navigator(markers).step(state, obs)
        truth = jaxlie.SE3(frame.T_world_vehicle_true)
        branch = judge_branch(out.candidates, out.selected, truth)
        pose = out.T_world_vehicle.wxyz_xyz
        return state, (pose, out.selected >= 0, out.located, out.flip_probability, branch)

    count = len(recording.markers.ids) if one_at_a_time else 1
    initial = navigator(recording.markers).init()
    state = jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (count, *leaf.shape)), initial)

    def step(state: State, frame: _Frames) -> tuple[State, tuple]:
        def alone(state: State, marker: Array) -> tuple[State, tuple]:
            seen_alone = _Frames(
                frame.corners_px[:, marker][:, None],
                frame.visible[:, marker][:, None],
                frame.dt_s,
                frame.T_world_vehicle_true,
            )
            return outputs_of(_single(recording.markers, marker), state, seen_alone)

        def together(state: State, _: Array) -> tuple[State, tuple]:
            return outputs_of(recording.markers, state, frame)

        return jax.vmap(alone if one_at_a_time else together)(state, jnp.arange(count))

    return step, state


def _single(markers: MarkerMap, index: Array) -> MarkerMap:
    """A map of one marker, whichever it is."""
    T_world_marker = jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[index][None])
    return MarkerMap(T_world_marker, markers.size_m[index][None], ids=(0,), families=("",))


def _frames(recording: Recording) -> _Frames:
    """All frames, padded to whole chunks with frames that show nothing."""
    count = len(recording)
    dt_s = np.diff(recording.stamps_ns, prepend=recording.stamps_ns[:1]) / 1e9
    identity = np.tile([1.0, 0, 0, 0, 0, 0, 0], (count, 1))
    reference = recording.reference
    truth = identity if reference is None else reference.T_world_vehicle
    padding = -count % CHUNK_FRAMES

    def pad(rows: np.ndarray) -> Array:
        return jnp.asarray(np.concatenate([rows, np.repeat(rows[-1:], padding, axis=0)]))

    visible = np.concatenate(
        [recording.visible, np.zeros((padding, *recording.visible.shape[1:]), bool)]
    )
    return _Frames(
        corners_px=pad(recording.corners_px),
        visible=jnp.asarray(visible),
        dt_s=pad(np.clip(dt_s, 0, MAX_DT_S)),
        T_world_vehicle_true=pad(truth),
    )


def errors(replay: Replay, recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Position (m) and rotation (deg) error, (F, tracks), NaN where either pose is missing."""
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
