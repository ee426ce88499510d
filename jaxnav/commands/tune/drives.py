"""Recorded drives as sequences of equal length to tune a filter on."""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.commands.tune.sequences import IDENTITY, bounds, cut, maps, side_by_side
from jaxnav.errors import BadInput
from jaxnav.experiments.tuning.recorded import FrameSequences
from jaxnav.recordings.drive_events import DriveEvents, refused_odometry
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.drive_setup import DriveSetup


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
    events = DriveEvents.of(log.inputs, setup, log.path, refused_odometry(log))
    begin, end = bounds(len(events), part)
    if not np.any(events.obs.visible[begin:end]):
        problem = f"{end - begin} of its {len(events)} events, and none shows a marker of the map"
        raise BadInput(log.path, problem)
    indices, used = side_by_side(cut(np.arange(begin, end), length))
    obs: Any = jax.tree.map(lambda leaf: jnp.asarray(leaf[indices]), events.obs)
    shown = obs.visible & used[..., None, None]
    told = shown, obs.has_odometry & used, jnp.where(used, obs.dt_s, 0).at[:, 0].set(0)
    obs = eqx.tree_at(lambda o: (o.visible, o.has_odometry, o.dt_s), obs, told)
    lanes = np.tile(np.arange(len(setup.markers.ids)), (len(indices), 1))
    return FrameSequences(
        markers=maps(setup.markers, lanes),
        obs=obs,
        used=jnp.asarray(used),
        T_world_vehicle_true=jnp.asarray(np.tile(IDENTITY, (*used.shape, 1)), float),
        judged=jnp.zeros(used.shape, bool),
    )
