"""Check of a marker map against sightings: wrong poses, wrong sizes and markers that moved.

The map is calibrated anew from sightings, and aligned with the given one so that as many markers
as possible agree. The size of a marker follows from the rays to its corners alone.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.rig.calibrate import RigCalibration
from jaxnav.calibrate.rig.views import RigViews, inverted, rays_camera, turn_rad
from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.models.rig import CameraRig
from jaxnav.files.poses import transform

_SIGMAS = 3.0  # deviations up to this many sigmas may be noise
_WRONG_SIZE = 0.05  # relative error of the side that paper and print don't explain
_MOVED = 0.2  # part of a marker's sightings that must disagree with the others for a move
_FEW = 8  # of fewer sightings neither a size nor a second place is found
_AGREE_RAD = 0.02  # largest angle between a ray and its corner for a sighting of the same place
_STEPS = 30


@dataclass(frozen=True)
class Verdict:
    """The result of the check for one marker of the map."""

    seen: int  # number of its sightings
    # deviation of the marker found from the map; None if it isn't linked
    apart_m: float | None
    apart_rad: float | None
    wrong: bool  # true if the deviation is more than tolerance and sigma explain
    # side from the distances of its corners; None if too few rays determine it
    size_m: float | None
    wrong_size: bool  # true if the map has another size
    moved_m: float  # distance that it moved during the recording, 0 if it stood still

    @property
    def right(self) -> bool:
        """True if no error of the marker was found."""
        return not (self.wrong or self.wrong_size or self.moved_m > 0)


@dataclass(frozen=True)
class Check:
    """The result of the check of a map."""

    verdicts: dict[int, Verdict]  # marker index -> verdict
    T_map_world: Float[np.ndarray, "4 4"]  # that aligns the markers found with the map
    agreeing: int  # number of markers that agree under it


def checked(
    calibration: RigCalibration,
    views: RigViews,
    rig: CameraRig,
    given: Mapping[int, Float[np.ndarray, "4 4"]],
    tolerance_m: float,
    tolerance_rad: float,
) -> Check:
    """Compare a map with a calibration that did not use it.

    Args:
        calibration: one with a single marker known, the gauge.
        views: all sightings, including those that were not linked.
        given: marker index -> T_map_marker (4, 4).
    """
    C = len(rig)
    linked = [index for index in given if calibration.mapped[index]]
    T_map_world, agree = _aligned(
        np.stack([given[index] for index in linked]),
        calibration.Ts_world_marker[linked],
        calibration.views.size_m[linked],
        tolerance_m,
        tolerance_rad,
    )
    rays = _Rays.from_calibration(calibration, views, rig)
    sigmas = calibration.sigmas()
    verdicts = {}
    for index in given:
        apart, wrong = None, False
        if calibration.mapped[index]:
            T = T_map_world @ calibration.Ts_world_marker[index]
            apart = np.linalg.norm((T - given[index])[:3, 3]), turn_rad(T, given[index])
            sigma = np.linalg.norm(sigmas[C + index].reshape(2, 3), axis=1)
            wrong = bool(np.any(apart > np.maximum([tolerance_m, tolerance_rad], _SIGMAS * sigma)))
        size_m, moved_m = rays.size_and_move(index)
        given_m = float(views.size_m[index])
        verdicts[index] = Verdict(
            seen=int(np.sum(views.marker == index)),
            apart_m=None if apart is None else float(apart[0]),
            apart_rad=None if apart is None else float(apart[1]),
            wrong=wrong,
            size_m=size_m,
            wrong_size=size_m is not None and abs(size_m / given_m - 1) > _WRONG_SIZE,
            moved_m=moved_m,
        )
    return Check(verdicts, T_map_world, agree)


def sizes_m(calibration: RigCalibration, views: RigViews, rig: CameraRig) -> dict[int, float]:
    """Marker index -> side in m from the rays to its corners, for markers with enough rays."""
    rays = _Rays.from_calibration(calibration, views, rig)
    sizes = {index: rays.size_and_move(index)[0] for index in range(len(views.size_m))}
    return {index: size for index, size in sizes.items() if size is not None}


def _aligned(
    given: np.ndarray,
    Ts_world_marker: np.ndarray,
    size_m: np.ndarray,
    tolerance_m: float,
    tolerance_rad: float,
) -> tuple[np.ndarray, int]:
    """T_map_world under which most markers agree, fitted to their corners; and their number."""

    def agreeing(T: np.ndarray, slack: float) -> np.ndarray:
        over = T @ Ts_world_marker
        apart_m = np.linalg.norm((over - given)[:, :3, 3], axis=1)
        turned = np.array([turn_rad(a, b) for a, b in zip(over, given, strict=True)])
        return (apart_m < slack * tolerance_m) & (turned < slack * tolerance_rad)

    corners = size_m[:, None, None] / 2 * CORNER_SIGNS

    def fitted(of: np.ndarray) -> np.ndarray:
        to, fro = (
            (Ts[of, None, :3, :3] @ corners[of][..., None])[..., 0] + Ts[of, None, :3, 3]
            for Ts in (given, Ts_world_marker)
        )
        to, fro = to.reshape(-1, 3), fro.reshape(-1, 3)
        turn, _ = Rotation.align_vectors(to - to.mean(axis=0), fro - fro.mean(axis=0))
        R = turn.as_matrix()
        return transform(R, to.mean(axis=0) - R @ fro.mean(axis=0))

    best, most = np.eye(4), np.zeros(len(given), bool)
    for one in range(len(given)):
        # One marker's error turns all others, so they may be further off at first.
        T = given[one] @ inverted(Ts_world_marker[one])
        near = agreeing(T, 3)
        near[one] = True
        T = fitted(near)
        for _ in range(3):
            inside = agreeing(T, 1)
            if not inside.any():
                break
            T = fitted(inside)
        inside = agreeing(T, 1)
        if inside.sum() > most.sum():
            best, most = T, inside
    if not most.any():  # no fit has markers that agree: the first is as good as any
        best = given[0] @ inverted(Ts_world_marker[0])
        most[0] = True
    return best, int(most.sum())


class _Rays(NamedTuple):
    """The rays to every corner, in the world of a calibration."""

    marker: np.ndarray
    origins: np.ndarray  # (N, 3)
    directions: np.ndarray  # (N, 4, 3)

    @staticmethod
    def from_calibration(calibration: RigCalibration, views: RigViews, rig: CameraRig) -> "_Rays":
        """The rays of the sightings by calibrated cameras in frames with a pose."""
        frame_of = {int(stamp): index for index, stamp in enumerate(calibration.views.stamps_ns)}
        frames = np.array([frame_of.get(int(stamp), -1) for stamp in views.stamps_ns], int)
        frame = frames[views.frame]
        posed = (frame >= 0) & calibration.calibrated[views.camera]
        Ts = calibration.Ts_world_vehicle[frame] @ calibration.Ts_vehicle_camera[views.camera]
        directions = np.einsum("nij,nkj->nki", Ts[:, :3, :3], rays_camera(rig, views))
        return _Rays(views.marker[posed], Ts[posed, :3, 3], directions[posed])

    def size_and_move(self, index: int) -> tuple[float | None, float]:
        """Side of a marker and the distance that it moved, m; None and 0 if undetermined."""
        rows = np.flatnonzero(self.marker == index)
        first = self._corners(rows)
        if first is None:
            return None, 0.0
        corners, near = first
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)
        size_m = float(edges.mean())
        if np.ptp(edges) > 4 * _WRONG_SIZE * size_m:
            return None, 0.0
        rest = rows[~near]
        if len(rest) < max(_FEW, _MOVED * len(rows)):
            return size_m, 0.0
        second = self._corners(rest)
        if second is None or second[1].mean() < 0.5:
            return size_m, 0.0
        moved_m = float(np.linalg.norm(second[0].mean(axis=0) - corners.mean(axis=0)))
        return size_m, moved_m if moved_m > _WRONG_SIZE * size_m else 0.0

    def _corners(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray] | None:
        """(4, 3) points where most rays to each corner meet, and agreeing rows (n,); or None."""
        if len(rows) < _FEW:
            return None
        origins, directions = self.origins[rows], self.directions[rows]
        across = np.eye(3) - directions[..., :, None] * directions[..., None, :]
        weight = np.ones(len(rows))
        for _ in range(_STEPS):
            A = np.einsum("n,ncij->cij", weight, across)
            b = np.einsum("n,ncij,nj->ci", weight, across, origins)
            if np.linalg.cond(A).max() > 1e6:
                return None
            corners = np.linalg.solve(A, b[..., None])[..., 0]
            way = corners - origins[:, None]
            distance = np.linalg.norm(way, axis=2)
            off = np.einsum("ncij,ncj->nci", across, way)
            angle = np.sqrt(np.mean(np.sum(off**2, axis=2) / distance**2, axis=1))
            # Nearer rays weigh more, rays that point elsewhere hardly at all.
            scale = max(float(np.median(angle)), 1e-4)
            weight = 1 / (distance.mean(axis=1) ** 2 * (1 + (angle / scale) ** 2) ** 2)
            weight /= weight.sum()
        return corners, angle < _AGREE_RAD
