"""Calibration of the poses of a rig's cameras and of the markers from sightings.

First cameras and markers are linked by relative poses that frames agree on (`linking`), without a
first guess. Then all poses are adjusted at once (`bundle`), with the noise estimated from the
residuals. Then every frame and every marker is tried at the other poses that its sightings admit,
until no other pose is better.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.calibrate.parts import variance_inflation
from jaxnav.calibrate.rig import bundle
from jaxnav.calibrate.rig.branches import other_branches
from jaxnav.calibrate.rig.linking import Linker, Links
from jaxnav.calibrate.rig.pose_arrays import Ts_vehicle_camera, inverted, matrices, wxyz_xyz
from jaxnav.calibrate.rig.views import RigViews, both_poses, rays_camera
from jaxnav.core.linalg.schur import ReducedSystem
from jaxnav.core.linalg.small_matrices import solve_upper
from jaxnav.core.models.camera import LENS_COEFFICIENTS, Camera
from jaxnav.core.models.rig import CameraRig
from jaxnav.errors import BadInput

_LEAST_SIGMA_PX = 1e-3  # for corners that are exact
_SAME_SCALE = 0.02  # the estimate of the noise has settled when it changes by no more
_ROUNDS, _STEPS = 8, 30
_PARTS = 40  # of a recording, compared with each other
_NOTICED = 1.3  # a smaller inflation of the variances counts as none: 40 parts tell no better


@dataclass(frozen=True)
class RigCalibration:
    """The calibrated poses of cameras and markers, with their covariance and residuals.

    Attributes:
        views: the sightings used; its frames are those with a pose.
        Ts_vehicle_camera: (C, 4, 4); as given for a camera that is not `calibrated`.
        Ts_world_marker: (M, 4, 4), of all markers of `views`.
        Ts_world_vehicle: (F, 4, 4), the vehicle's pose in every frame.
        calibrated: (C,) true for cameras linked to the reference camera.
        mapped: (M,) true for markers linked to the known ones.
        sigma_px: standard deviation of a corner's coordinate, from the residuals.
        residuals_px: (N, 4, 2) projected minus observed.
        weight: (N,), 1 if a sighting counts in full.
        cameras: the cameras with their lenses, as given unless they were to be refined.
        covariance: (6 S, 6 S) of the twists xi in T * cay(xi) of T_vehicle_camera and
            T_world_marker and of the lenses, see `bundle.RigUnknowns`; zero for whatever was given.
        frames_follow: (F, 6, 6 S) derivatives of the frames' twists by those unknowns.
        inflation: factor of the covariance over that from noise independent between frames; 1 if
            there is no other noise.
        turned: how many frames and markers changed their branch after the first adjustment.
    """

    views: RigViews
    Ts_vehicle_camera: Float[np.ndarray, "C 4 4"]
    Ts_world_marker: Float[np.ndarray, "M 4 4"]
    Ts_world_vehicle: Float[np.ndarray, "F 4 4"]
    calibrated: Bool[np.ndarray, " C"]
    mapped: Bool[np.ndarray, " M"]
    cameras: Camera
    sigma_px: float
    residuals_px: Float[np.ndarray, "N 4 2"]
    weight: Float[np.ndarray, " N"]
    covariance: Float[np.ndarray, "R R"]
    frames_follow: Float[np.ndarray, "F 6 R"]
    inflation: float
    turned: int

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
    views, free = start.linker.views, start.free
    poses, turned, adjusted = start.poses, 0, None
    sigma_px = bundle.sigma_px_of(
        np.asarray(bundle.reprojection_residuals_px(poses, bundle.seen(rig, views, 1.0)))
    )
    for _ in range(_ROUNDS):
        adjusted, used_px = _adjusted(rig, views, poses, free, sigma_px)
        sigma_px = bundle.sigma_px_of(np.asarray(adjusted.residuals_px))
        poses, changed = other_branches(
            rig, start.linker, start.links, adjusted.poses, free, sigma_px
        )
        turned += changed
        if not changed:
            break
    assert adjusted is not None  # there is a round
    return _calibration(rig, start, adjusted, used_px, turned)


@dataclass(frozen=True)
class _Start:
    links: Links
    linker: Linker
    poses: bundle.RigUnknowns
    given: np.ndarray  # (C, 4, 4), T_vehicle_camera
    calibrated: np.ndarray
    mapped: np.ndarray
    free: np.ndarray  # (S, 6), mask of the shared unknowns that move, see `bundle.RigUnknowns`


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
    sixes = (C, M, 2 * C if refine_lenses else 0)
    free_cameras, free_markers, free_lenses = (np.zeros((count, 6), bool) for count in sixes)
    if reference_camera is not None:
        free_cameras[calibrated] = True
        free_cameras[reference_camera] = False
    free_markers[mapped] = True
    free_markers[anchors] = False
    for index in np.flatnonzero(calibrated) if refine_lenses else ():
        lens = rig.cameras.lenses[int(rig.cameras.lens_index[index])]
        figures = np.arange(12) < 4 + LENS_COEFFICIENTS[lens]
        free_lenses[index], free_lenses[C + index] = figures[:6], figures[6:]
    return _Start(
        links,
        linker,
        bundle.RigUnknowns(
            wxyz_xyz(inverted(Ts_vehicle_world)),
            wxyz_xyz(np.where(calibrated[:, None, None], links.Ts_group_camera, given)),
            wxyz_xyz(links.Ts_group_marker),
            bundle.lenses_of(rig.cameras)[: C if refine_lenses else 0],
        ),
        given,
        calibrated,
        mapped,
        np.concatenate([free_cameras, free_markers, free_lenses]),
    )


def _adjusted(
    rig: CameraRig, views: RigViews, poses: bundle.RigUnknowns, free: np.ndarray, sigma_px: float
) -> tuple[bundle.Adjusted, float]:
    """Adjust the poses at the noise estimated from their residuals; return it too, px."""
    for _ in range(_ROUNDS):
        used_px = max(sigma_px, _LEAST_SIGMA_PX)
        known = bundle.seen(rig, views, used_px)
        adjusted = bundle.adjust(
            poses,
            known,
            jnp.asarray(free.reshape(-1)),
            parts=min(_PARTS, views.frames),
            max_steps=_STEPS,
        )
        poses = adjusted.poses
        sigma_px = bundle.sigma_px_of(np.asarray(adjusted.residuals_px))
        if abs(sigma_px - used_px) <= _SAME_SCALE * used_px and bool(adjusted.converged):
            break
    return adjusted, used_px


def _calibration(
    rig: CameraRig, start: _Start, adjusted: bundle.Adjusted, used_px: float, turned: int
) -> RigCalibration:
    views, flat = start.linker.views, start.free.reshape(-1)
    inverse = np.linalg.inv(np.asarray(adjusted.reduced.system))
    inverse = np.where(flat[:, None] & flat[None], (inverse + inverse.T) / 2, 0)
    residuals = np.asarray(adjusted.residuals_px)
    unknowns = 6 * views.frames + int(flat.sum())
    # The fitted unknowns have taken up their part of the noise.
    left = max(residuals.size - unknowns, 1) / residuals.size
    sigma_px = bundle.sigma_px_of(residuals) / np.sqrt(left)
    scores = np.asarray(adjusted.scores)
    inflation = variance_inflation(scores, inverse, int(flat.sum()), _NOTICED)
    lenses = adjusted.poses.lenses
    return RigCalibration(
        views=views,
        Ts_vehicle_camera=np.where(
            start.calibrated[:, None, None],
            matrices(adjusted.poses.Ts_vehicle_camera),
            start.given,
        ),
        Ts_world_marker=matrices(adjusted.poses.Ts_world_marker),
        Ts_world_vehicle=matrices(adjusted.poses.Ts_world_vehicle),
        calibrated=start.calibrated,
        mapped=start.mapped,
        cameras=bundle.with_lenses(rig.cameras, lenses) if len(lenses) else rig.cameras,
        sigma_px=sigma_px,
        residuals_px=residuals,
        weight=np.asarray(adjusted.weight),
        covariance=inverse * (sigma_px / used_px) ** 2 * inflation,
        frames_follow=np.asarray(_follows(adjusted.reduced)),
        inflation=inflation,
        turned=turned,
    )


@jax.jit
def _follows(reduced: ReducedSystem) -> Array:
    return -jax.vmap(solve_upper)(reduced.factor, reduced.carried)
