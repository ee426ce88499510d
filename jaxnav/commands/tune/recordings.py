"""Recordings of a rig without odometry as sequences to tune a filter on."""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxnav.belief.constant_velocity import ConstantVelocity
from jaxnav.belief.selectors import make_selector
from jaxnav.commands.tune.sequences import IDENTITY, bounds, cut, maps, runs, side_by_side
from jaxnav.datasets.recording import Recording
from jaxnav.datasets.replay import estimate_corner_sigma_px
from jaxnav.errors import BadInput
from jaxnav.models.origin import opposite, poses_in_world
from jaxnav.navigator import Navigator
from jaxnav.pose.observation import Observation
from jaxnav.tuning.recorded import FrameSequences

LEAST_SEQUENCES = 4
GAP_S = 0.5  # a marker that was away for longer appears anew


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
            jnp.asarray(corners_px, float), jnp.asarray(visible), jnp.asarray(dt_s, float)
        ),
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.asarray(truth, float),
        judged=jnp.asarray(judged),
    )


@jax.vmap
@jax.vmap
def _observations(
    corners_px: Float[Array, "C M 4 2"], visible: Array, dt_s: Float[Array, ""]
) -> Observation:
    """Observations (B, T) of frames without odometry."""
    return Observation(corners_px, visible, dt_s=dt_s, has_odometry=False)
