"""The other poses that sightings admit, tried where a search has ended.

Each frame has two, and each marker some from as many sightings: a search that began at a mirrored
pose ends there, and only a comparison tells.
"""

from dataclasses import replace

import numpy as np

from jaxnav.calibration import bundle
from jaxnav.calibration.linking import Linker, Links, inverted
from jaxnav.calibration.pose_arrays import matrices, wxyz_xyz
from jaxnav.rig import CameraRig

_BETTER = 1.0  # by which a cost must be lower to be another one


def other_branches(
    rig: CameraRig,
    linker: Linker,
    links: Links,
    poses: bundle.Unknowns,
    free: np.ndarray,
    sigma_px: float,
) -> tuple[bundle.Unknowns, int]:
    """Put frames and markers where another pose that their sightings admit costs less.

    Args:
        links: brought to where the poses are.
        free: (S, 6).

    Returns:
        The poses, and how many of them are others.
    """
    C, views = len(rig), linker.views
    Ts_world_vehicle = matrices(poses.Ts_world_vehicle)
    links.Ts_group_camera[:] = matrices(poses.Ts_vehicle_camera)
    links.Ts_group_marker[:] = matrices(poses.Ts_world_marker)
    known = bundle.seen(rig, views, sigma_px)

    def cost(of: bundle.Unknowns, groups: np.ndarray, count: int) -> np.ndarray:
        residuals = np.asarray(bundle.reprojection_residuals_px(of, known))
        return np.bincount(groups, bundle.losses(residuals, float(known.sigma_px)), count)

    F, M = len(Ts_world_vehicle), len(views.size_m)
    changed = 0
    best = cost(poses, views.frame, F)
    candidates = inverted(linker.sights(links).Ts_cameras_markers)
    for branch in (0, 1):
        tried = candidates[:, branch]
        other = replace(poses, Ts_world_vehicle=wxyz_xyz(tried))
        found = cost(other, views.frame, F)
        better = found < best - _BETTER
        changed += int(better.sum())
        Ts_world_vehicle[better] = tried[better]
        best = np.minimum(best, found)
    poses = replace(poses, Ts_world_vehicle=wxyz_xyz(Ts_world_vehicle))

    Ts_world_marker = matrices(poses.Ts_world_marker)
    best = cost(poses, views.marker, M)
    Ts_vehicle_camera = matrices(poses.Ts_vehicle_camera)
    Ts_world_camera = Ts_world_vehicle[views.frame] @ Ts_vehicle_camera[views.camera]
    proposed = Ts_world_camera[:, None] @ linker.Ts_camera_marker
    for row in _spread(views.marker, M):
        for branch in (0, 1):
            tried = np.where(
                ((row >= 0) & free[C : C + M, 0])[:, None, None],
                proposed[row, branch],
                Ts_world_marker,
            )
            other = replace(poses, Ts_world_marker=wxyz_xyz(tried))
            found = cost(other, views.marker, M)
            better = found < best - _BETTER
            changed += int(better.sum())
            Ts_world_marker[better] = tried[better]
            best = np.minimum(best, found)
    return replace(poses, Ts_world_marker=wxyz_xyz(Ts_world_marker)), changed


def _spread(marker: np.ndarray, markers: int, count: int = 10) -> np.ndarray:
    """(count, M) sightings of every marker, spread over the recording; -1 where there is none."""
    chosen = np.full((count, markers), -1)
    for index in range(markers):
        rows = np.flatnonzero(marker == index)
        if len(rows):
            chosen[:, index] = rows[np.linspace(0, len(rows) - 1, count).astype(int)]
    return chosen
