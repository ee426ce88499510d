"""Calibration of the poses of a rig's cameras and of the markers from sightings.

First cameras and markers are linked by relative poses that frames agree on (`linking`), without a
first guess. Then all poses are adjusted at once (`bundle`), with the noise estimated from the
residuals. Then every frame and every marker is tried at the other poses that its sightings admit,
until no other pose is better.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxnav.calibrate.rig import bundle
from jaxnav.calibrate.rig.linking import Linker, Links
from jaxnav.calibrate.rig.views import (
    RigViews,
    Ts_vehicle_camera,
    both_poses,
    inverted,
    matrices,
    rays_camera,
    wxyz_xyz,
)
from jaxnav.calibrate.robust import variance_inflation
from jaxnav.core.models.camera import LENS_COEFFICIENTS, Camera
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput

_LEAST_SIGMA_PX = 1e-3  # for corners that are exact
_SAME_SCALE = 0.02  # the estimate of the noise has settled when it changes by no more
_ROUNDS, _STEPS = 8, 30
_BETTER = 1.0  # a pose is replaced if another lowers its cost by more than this
_TRIES = 10  # sightings of a marker that propose its pose
_PARTS = 40  # of a recording, compared with each other
_NOTICED = 1.3  # a smaller inflation of the variances counts as none: 40 parts can't show it


@dataclass(frozen=True)
class RigCalibration:
    """The calibrated poses of cameras and markers, with their covariance and residuals."""

    views: RigViews  # the sightings used; its frames are those with a pose
    # as given for a camera that is not `calibrated`
    Ts_vehicle_camera: Float[np.ndarray, "C 4 4"]
    Ts_world_marker: Float[np.ndarray, "M 4 4"]  # of all markers of `views`
    Ts_world_vehicle: Float[np.ndarray, "F 4 4"]  # the vehicle's pose in every frame
    calibrated: Bool[np.ndarray, " C"]  # true for cameras linked to the reference camera
    mapped: Bool[np.ndarray, " M"]  # true for markers linked to the known ones
    cameras: Camera  # the cameras with their lenses, as given unless they were to be refined
    sigma_px: float  # standard deviation of a corner's coordinate, from the residuals
    residuals_px: Float[np.ndarray, "N 4 2"]  # projected minus observed
    weight: Float[np.ndarray, " N"]  # 1 if a sighting counts in full
    # of the twists xi in T * cay(xi) of T_vehicle_camera and T_world_marker and of the lenses, see
    # `bundle.RigUnknowns`; zero for whatever was given
    covariance: Float[np.ndarray, "R R"]
    frames_follow: Float[np.ndarray, "F 6 R"]  # derivatives of the frames' twists by those unknowns
    # factor of the covariance over that from noise independent between frames; 1 if there is no
    # other noise
    inflation: float
    turned: int  # how many frames and markers changed their branch after the first adjustment

    def rms_px(self) -> float:
        """RMS residual of a corner's coordinate over all sightings, outliers included, px."""
        return float(np.sqrt(np.mean(self.residuals_px**2)))

    def sigmas(self) -> Float[np.ndarray, "placed 6"]:
        """(C + M, 6) standard deviations along and about the camera's or marker's axes, m, rad."""
        placed = len(self.calibrated) + len(self.mapped)
        return self._sixes()[:placed]

    def lens_sigmas(self) -> Float[np.ndarray, "C 12"]:
        """(C, 12) standard deviations of fx fy cx cy, px, and of the eight coefficients."""
        C = len(self.calibrated)
        lenses = self._sixes()[C + len(self.mapped) :]
        if not len(lenses):
            return np.zeros((C, 12))
        return np.concatenate([lenses[:C], lenses[C:]], axis=1)

    def _sixes(self) -> np.ndarray:
        return np.sqrt(np.maximum(np.diag(self.covariance), 0)).reshape(-1, 6)


def calibrate_rig(
    views: RigViews,
    rig: CameraRig,
    known: Mapping[int, Float[np.ndarray, "4 4"]],
    reference_camera: int | None,
    refine_lenses: bool = False,
) -> RigCalibration:
    """Calibrate the poses of the cameras and markers that are not known.

    Args:
        views: the sightings, ordered by frame.
        rig: lenses, and the poses of the cameras as given.
        known: marker index -> T_world_marker (4, 4) of the markers that define the world frame.
        reference_camera: the camera whose given pose defines the vehicle frame; None if all
            cameras' poses are given and only markers are to be found.
        refine_lenses: true to adjust the lenses too, false to keep them as given.

    Raises:
        BadInput: no sighting defines the world frame, or no camera can be linked.
    """
    start = _start(views, rig, known, reference_camera, refine_lenses)
    views, free, poses, turned = start.linker.views, start.free, start.poses, 0
    start_px = bundle.reprojection_residuals_px(poses, bundle.seen(rig, views, 1.0))
    sigma_px = bundle.sigma_px_of(np.asarray(start_px))
    for _ in range(_ROUNDS):
        adjusted, used_px = _adjusted(rig, views, poses, free, sigma_px)
        residuals_px = np.asarray(adjusted.residuals_px)
        sigma_px = bundle.sigma_px_of(residuals_px)
        poses, changed = _other_branches(rig, start, adjusted.poses, sigma_px)
        turned += changed
        if not changed:
            break
    count = int(free.sum())
    inverse = np.linalg.inv(np.asarray(adjusted.reduced.system))
    inverse = np.where(free[:, None] & free[None], (inverse + inverse.T) / 2, 0)
    # The fitted unknowns have taken up their part of the noise.
    left = max(residuals_px.size - 6 * views.frames - count, 1) / residuals_px.size
    sigma_px /= np.sqrt(left)
    inflation = variance_inflation(np.asarray(adjusted.scores), inverse, count, _NOTICED)
    found = adjusted.poses
    found_cameras = matrices(found.Ts_vehicle_camera)
    return RigCalibration(
        views=views,
        Ts_vehicle_camera=np.where(start.calibrated[:, None, None], found_cameras, start.given),
        Ts_world_marker=matrices(found.Ts_world_marker),
        Ts_world_vehicle=matrices(found.Ts_world_vehicle),
        calibrated=start.calibrated,
        mapped=start.mapped,
        cameras=bundle.with_lenses(rig.cameras, found.lenses) if refine_lenses else rig.cameras,
        sigma_px=sigma_px,
        residuals_px=residuals_px,
        weight=np.asarray(adjusted.weight),
        covariance=inverse * (sigma_px / used_px) ** 2 * inflation,
        frames_follow=np.asarray(adjusted.frames_follow),
        inflation=inflation,
        turned=turned,
    )


@dataclass(frozen=True)
class _Start:
    links: Links
    linker: Linker
    poses: bundle.RigUnknowns
    given: np.ndarray  # (C, 4, 4), T_vehicle_camera
    calibrated: np.ndarray
    mapped: np.ndarray
    free: np.ndarray  # (6 S,), mask of the shared unknowns that move, see `bundle.RigUnknowns`


def _start(
    views: RigViews,
    rig: CameraRig,
    known: Mapping[int, np.ndarray],
    reference_camera: int | None,
    refine_lenses: bool,
) -> _Start:
    """Link cameras and markers, and leave out those that can't be linked."""
    given = Ts_vehicle_camera(rig)
    rays = rays_camera(rig, views)
    Ts_camera_marker = both_poses(rays, views.size_m[views.marker])
    sound = np.isfinite(Ts_camera_marker).all(axis=(1, 2, 3))
    linker = Linker(views.only(sound), rays[sound], Ts_camera_marker[sound])
    links = Links.none(len(rig), len(views.size_m))
    if reference_camera is None:
        links.group_of_camera[:], links.Ts_group_camera[:] = 0, given
    anchors = list(known)
    links.group_of_marker[anchors] = anchors[0]
    links.Ts_group_marker[anchors] = [known[index] for index in anchors]
    linker.link(links)

    root = anchors[0]
    mapped = links.group_of_marker == links.group_of_marker[root]
    reference = 0 if reference_camera is None else reference_camera
    calibrated = links.group_of_camera == links.group_of_camera[reference]
    rows = mapped[linker.views.marker] & calibrated[linker.views.camera]
    if not rows.any():
        problem = "saw none of the known markers: start with one of them in view of this camera"
        raise BadInput(rig.names[reference], problem)
    T_world_group = known[root] @ inverted(links.Ts_group_marker[root])
    links.Ts_group_marker[mapped] = T_world_group @ links.Ts_group_marker[mapped]
    if reference_camera is not None:
        T_vehicle_group = given[reference] @ inverted(links.Ts_group_camera[reference])
        links.Ts_group_camera[calibrated] = T_vehicle_group @ links.Ts_group_camera[calibrated]

    linker = linker.only(rows)
    Ts_vehicle_world = linker.sights(links).Ts_cameras_markers[:, 0]
    C, M = len(rig), len(views.size_m)
    free = np.zeros((C + M + (2 * C if refine_lenses else 0), 6), bool)
    if reference_camera is not None:
        free[:C][calibrated] = True
        free[reference_camera] = False
    free[C : C + M][mapped] = True
    free[C + np.array(anchors)] = False
    for index in np.flatnonzero(calibrated) if refine_lenses else ():
        lens = rig.cameras.lenses[int(rig.cameras.lens_index[index])]
        figures = np.arange(12) < 4 + LENS_COEFFICIENTS[lens]
        free[C + M + index], free[2 * C + M + index] = figures[:6], figures[6:]
    poses = bundle.RigUnknowns(
        wxyz_xyz(inverted(Ts_vehicle_world)),
        wxyz_xyz(np.where(calibrated[:, None, None], links.Ts_group_camera, given)),
        wxyz_xyz(links.Ts_group_marker),
        bundle.lenses_of(rig.cameras)[: C if refine_lenses else 0],
    )
    return _Start(links, linker, poses, given, calibrated, mapped, free.ravel())


def _adjusted(
    rig: CameraRig, views: RigViews, poses: bundle.RigUnknowns, free: np.ndarray, sigma_px: float
) -> tuple[bundle.Adjusted, float]:
    """Adjust the poses at the noise estimated from their residuals; return it too, px."""
    for _ in range(_ROUNDS):
        used_px = max(sigma_px, _LEAST_SIGMA_PX)
        known = bundle.seen(rig, views, used_px)
        adjusted = bundle.adjust(poses, known, jnp.asarray(free), min(_PARTS, views.frames), _STEPS)
        poses = adjusted.poses
        sigma_px = bundle.sigma_px_of(np.asarray(adjusted.residuals_px))
        if abs(sigma_px - used_px) <= _SAME_SCALE * used_px and bool(adjusted.converged):
            break
    return adjusted, used_px


def _other_branches(
    rig: CameraRig, start: _Start, poses: bundle.RigUnknowns, sigma_px: float
) -> tuple[bundle.RigUnknowns, int]:
    """Move frames and markers to other poses that their sightings admit, if those cost less; and
    say how many have moved.

    A frame has two possible poses, and a marker two for each of some sightings. A search that
    begins at a mirrored pose ends there, and only a comparison of costs shows it.
    """
    C, linker, links = len(rig), start.linker, start.links
    views, M = linker.views, len(linker.views.size_m)
    links.Ts_group_camera[:] = matrices(poses.Ts_vehicle_camera)
    links.Ts_group_marker[:] = matrices(poses.Ts_world_marker)
    known = bundle.seen(rig, views, sigma_px)

    def cost(of: bundle.RigUnknowns, groups: np.ndarray, count: int) -> np.ndarray:
        return np.bincount(groups, bundle.costs(of, known), count)

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

    Ts_world_marker, Ts_world_vehicle, Ts_vehicle_camera = (
        matrices(Ts)
        for Ts in (poses.Ts_world_marker, poses.Ts_world_vehicle, poses.Ts_vehicle_camera)
    )
    Ts_world_camera = Ts_world_vehicle[views.frame] @ Ts_vehicle_camera[views.camera]
    proposed = Ts_world_camera[:, None] @ linker.Ts_camera_marker
    # (tries, M) rows of each marker's sightings, spread over the recording; -1 if it has none.
    spread = np.full((_TRIES, M), -1)
    for index in np.flatnonzero(start.free.reshape(-1, 6)[C : C + M, 0]):
        rows = np.flatnonzero(views.marker == index)
        if len(rows):
            spread[:, index] = rows[np.linspace(0, len(rows) - 1, _TRIES).astype(int)]
    tries = (
        np.where((row >= 0)[:, None, None], proposed[row, branch], Ts_world_marker)
        for row in spread
        for branch in (0, 1)
    )
    poses, markers = best_of(poses, "Ts_world_marker", views.marker, tries)
    return poses, frames + markers
