"""Smooth the track of a recorded drive: filtered event by event, then back from its end.

    smoothed = smooth_drive(events, setup)

A drive is filtered as the pilot's own navigator would, had nothing come late, and without what the
pilot does beside it: it restarts nothing and outvotes nobody.
"""

from collections.abc import Callable
from dataclasses import dataclass

import jax
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxnav.core.models.geometry import planar_from_T_world_vehicle
from jaxnav.core.models.origin import Origin, planar_in_world, poses_in_world
from jaxnav.recordings.drive_events import DriveEvents
from jaxnav.recordings.drive_setup import DriveSetup
from jaxnav.recordings.other.localise import CHUNK_FRAMES, Localised, localise


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
    events: DriveEvents,
    setup: DriveSetup,
    progress: Callable[[int], object] = lambda events: None,
) -> tuple[DriveTrack, DriveTrack]:
    """The track of a drive as it was known at each event, and as it is known at the end.

    Args:
        setup: its navigator filters.
        progress: called with the number of events done since the last call, twice for each.
    """
    found, total = [], len(events)
    for begin, poses in localise(
        setup.navigator(),
        total,
        lambda begin: jax.tree.map(lambda leaf: leaf[begin : begin + CHUNK_FRAMES], events.obs),
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
