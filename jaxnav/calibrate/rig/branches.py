"""Trial of the other poses that sightings admit, after a search has ended.

A frame has two possible poses, and a marker two for each of some sightings. A search that begins
at a mirrored pose ends there, and only a comparison of costs tells.
"""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from jaxnav.calibrate.rig import bundle
from jaxnav.calibrate.rig.linking import Linker, Links
from jaxnav.calibrate.rig.pose_arrays import inverted, matrices, wxyz_xyz
from jaxnav.core.models.rig import CameraRig

_BETTER = 1.0  # a pose is replaced if another lowers its cost by more than this


def other_branches(
    rig: CameraRig,
    linker: Linker,
    links: Links,
    poses: bundle.RigUnknowns,
    free: Bool[np.ndarray, "S 6"],
    sigma_px: float,
) -> tuple[bundle.RigUnknowns, int]:
    """Move frames and markers to other poses that their sightings admit, if those cost less.

    Args:
        links: overwritten with the given poses.
        free: (S, 6), mask of the shared unknowns that move.

    Returns:
        The poses, and how many of them have changed.
    """
    C, views = len(rig), linker.views
    links.Ts_group_camera[:] = matrices(poses.Ts_vehicle_camera)
    links.Ts_group_marker[:] = matrices(poses.Ts_world_marker)
    known = bundle.seen(rig, views, sigma_px)

    def cost(of: bundle.RigUnknowns, groups: np.ndarray, count: int) -> np.ndarray:
        residuals = np.asarray(bundle.reprojection_residuals_px(of, known))
        return np.bincount(groups, bundle.losses(residuals, float(known.sigma_px)), count)

    def best_of(
        of: bundle.RigUnknowns, name: str, groups: np.ndarray, tries: Iterable[np.ndarray]
    ) -> tuple[bundle.RigUnknowns, int]:
        """Replace each of the named poses by the one that costs its sightings least."""
        best, changed = matrices(getattr(of, name)), 0
        least = cost(of, groups, len(best))
        for tried in tries:
            costs = cost(replace(of, **{name: wxyz_xyz(tried)}), groups, len(best))
            better = costs < least - _BETTER
            changed += int(better.sum())
            best[better] = tried[better]
            least = np.minimum(least, costs)
        return replace(of, **{name: wxyz_xyz(best)}), changed

    candidates = inverted(linker.sights(links).Ts_cameras_markers)
    poses, frames = best_of(
        poses, "Ts_world_vehicle", views.frame, (candidates[:, branch] for branch in (0, 1))
    )

    Ts_world_marker, M = matrices(poses.Ts_world_marker), len(views.size_m)
    Ts_world_vehicle = matrices(poses.Ts_world_vehicle)
    Ts_vehicle_camera = matrices(poses.Ts_vehicle_camera)
    Ts_world_camera = Ts_world_vehicle[views.frame] @ Ts_vehicle_camera[views.camera]
    proposed = Ts_world_camera[:, None] @ linker.Ts_camera_marker
    tries = (
        np.where(
            ((row >= 0) & free[C : C + M, 0])[:, None, None],
            proposed[row, branch],
            Ts_world_marker,
        )
        for row in _spread(views.marker, M)
        for branch in (0, 1)
    )
    poses, markers = best_of(poses, "Ts_world_marker", views.marker, tries)
    return poses, frames + markers


def _spread(marker: np.ndarray, markers: int, count: int = 10) -> np.ndarray:
    """(count, M) rows of each marker's sightings, spread over the recording; -1 if it has none."""
    chosen = np.full((count, markers), -1)
    for index in range(markers):
        rows = np.flatnonzero(marker == index)
        if len(rows):
            chosen[:, index] = rows[np.linspace(0, len(rows) - 1, count).astype(int)]
    return chosen
