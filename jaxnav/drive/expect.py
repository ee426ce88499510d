"""Predict where each marker appears from the present belief, so a detector can look there first:
by the decided pose, else by every live hypothesis.

    quads_px, visible, radius_px = expected(rig, markers, T_world_vehicle, covariance)

A corner is searched in the circle of that radius around its place in `quads_px`. The same program
tells the corners at any place, and before and after a motion.
"""

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter.bank import Bank
from jaxnav.core.filter.planar import planar_poses
from jaxnav.core.models.geometry import (
    on_last_axis,
    rotation_matrix,
    safe_norm,
    safe_sqrt,
    transform_points,
)
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.navigator import Navigator, Output
from jaxnav.detection.observe import marker_keys
from jaxnav.drive.compiled_step import strip_static
from jaxnav.files.executables import kept

Place = tuple[float, float, float]  # x_m, y_m, psi_rad
SIGMAS = 3.0
# The corner's own noise, and its motion during the exposure.
MARGIN_PX = 4.0
_SPENT = 1e-6  # a remainder below this share of a variance is rounding
_MOST_PLACES = 4  # hypotheses
_APART_NS, _TOO_FAR_NS = 15_000_000, 200_000_000  # of two poses that tell a velocity
_MIN_COVARIANCE = np.diag([0.01**2, 0.01**2, np.deg2rad(0.5) ** 2])  # regions are not narrower


@dataclass(frozen=True)
class Region:
    """The expected places of K markers in an image.

    Attributes:
        quads_px: (K, 4, 2), corners, TL TR BR BL.
        radius_px: (K,), search radii.
        keys: family and id of each marker; left out, none of them is followed.
        flow_px_s: (K, 2), velocities of their centres in the image; None if nobody knows them.
        stamp_ns: the time at which they are expected there; None: that of the image.
        decided: False: they are expected by one hypothesis or another, a marker perhaps in several
            places, and the whole image is searched as well.
    """

    quads_px: Float[np.ndarray, "K 4 2"]
    radius_px: Float[np.ndarray, " K"]
    keys: tuple[tuple[str, int], ...] = ()
    flow_px_s: Float[np.ndarray, "K 2"] | None = None
    stamp_ns: int | None = None
    decided: bool = True


class Expected(NamedTuple):
    """The predicted views of M markers in C cameras.

    Attributes:
        quads_px: corners from the mean pose, TL TR BR BL.
        visible: the marker may be seen: printed side towards the camera, and every corner in front
            of it and in the image, or outside of it by no more than the radius.
        radius_px: the largest distance of a corner from its place.
    """

    quads_px: Float[Array, "C M 4 2"]
    visible: Bool[Array, "C M"]
    radius_px: Float[Array, "C M"]


@kept
def expect_corners(
    rig: CameraRig,
    markers: MarkerMap,
    T_world_vehicle: Float[Array, " 7"],
    covariance: Float[Array, "3 3"],
    margin_px: Float[Array, ""] | float = MARGIN_PX,
) -> Expected:
    """Predict where each marker appears.

    With vectors a_k whose sum of a_k a_k' is the pose's covariance, and u(x) a corner,

        radius = sqrt(sum over k of max |u(x +- 3 a_k) - u(x)|^2) + margin.

    Where u is linear that is 3 sqrt(trace) of the corner's covariance, beyond which a Gaussian
    lies in at most 0.27 % of all cases. Moving the pose instead of taking a derivative keeps the
    radius close to that where u is curved.

    Args:
        T_world_vehicle: wxyz xyz, the mean.
        covariance: of (x_m, y_m, psi_rad) in the world. Where it is not finite nothing is visible.
        margin_px: added to every radius.
    """
    mean = jaxlie.SE3(T_world_vehicle)
    offsets = SIGMAS * _axes(covariance)
    # Half a turn further the cameras would see the same markers again.
    limit = jnp.asarray([jnp.inf, jnp.inf, jnp.pi / 2], offsets.dtype)
    offsets = jnp.clip(offsets, -limit[None], limit[None])

    def corners_px(offset: Array) -> Array:
        return rig.project(_moved(mean, offset).inverse(), markers.corners_world_m)

    quads_px = corners_px(jnp.zeros_like(offsets[0]))
    moved_px = jax.vmap(corners_px)(jnp.stack([offsets, -offsets]).reshape(-1, 3))
    shifts_px = safe_norm(moved_px - quads_px[None]).reshape(2, 3, *quads_px.shape[:-1])
    spread_px = safe_norm(jnp.moveaxis(jnp.max(shifts_px, axis=0), 0, -1))
    radius_px = jnp.max(spread_px, axis=-1) + margin_px
    visible = _inside(rig, quads_px, radius_px) & _towards(rig, markers, mean)
    finite = jnp.isfinite(radius_px) & jnp.all(jnp.isfinite(covariance))
    return Expected(quads_px, visible & finite, radius_px)


def likely_poses(
    bank: Bank, most: int
) -> tuple[Float[np.ndarray, "H 7"], Float[np.ndarray, "H 3 3"]]:
    """Poses (wxyz xyz) of a vehicle's heaviest hypotheses, and the covariances of their planar
    poses.

    Args:
        bank: its leaves are NumPy's arrays, and one hypothesis at least is initialised.
        most: so many of them.
    """
    log_weight = np.where(bank.initialised, bank.log_weight, -np.inf)
    likely = np.argsort(-log_weight, kind="stable")[: min(most, int(np.sum(bank.initialised)))]
    poses, covariances = (np.asarray(part)[likely] for part in planar_poses(bank))
    return np.array([_wxyz_xyz(pose) for pose in poses], poses.dtype), covariances


def quads_px(
    navigator: Navigator, place: Place | Float[np.ndarray, " 3"]
) -> Float[np.ndarray, "C M 4 2"]:
    """Corners as seen from a place, px, by the program that predicts search regions."""
    dtype = np.asarray(navigator.corner_sigma_px).dtype
    wxyz_xyz = np.array(_wxyz_xyz(place), dtype)
    corners = expect_corners(navigator.rig, navigator.markers, wxyz_xyz, np.zeros((3, 3), dtype))
    return np.asarray(corners.quads_px)


def due_px(
    navigator: Navigator, pose: Float[np.ndarray, " 3"], motion: Place
) -> tuple[Float[np.ndarray, "C M 4 2"], Float[np.ndarray, "C M 4 2"]]:
    """Corners before and after a motion, (C, M, 4, 2) each.

    Args:
        pose: estimated (x_m, y_m, psi_rad) after the motion. Its error matters little: the relative
            error of a shift is that of the distance to the marker.
        motion: (x_m, y_m, psi_rad) in the vehicle's axes before the motion.
    """
    x_m, y_m, psi_rad = map(float, pose)
    ahead_m, left_m, turn_rad = motion
    c, s = math.cos(psi_rad - turn_rad), math.sin(psi_rad - turn_rad)
    before = x_m - c * ahead_m + s * left_m, y_m - s * ahead_m - c * left_m, psi_rad - turn_rad
    return quads_px(navigator, before), quads_px(navigator, pose)


def _wxyz_xyz(place: Place | Float[np.ndarray, " 3"]) -> list[float]:
    x_m, y_m, psi_rad = map(float, place)
    return [math.cos(psi_rad / 2), 0, 0, math.sin(psi_rad / 2), x_m, y_m, 0]


def _axes(covariance: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """Rows a_k: the columns of Cholesky's factor, zero where no variance is left. LAPACK is not
    called, since a program loaded from disk does not find it."""
    rows: list[Array] = []
    for k in range(3):
        rest = covariance[k] - sum((row[k] * row for row in rows), jnp.zeros_like(covariance[k]))
        spent = ~(rest[k] > _SPENT * covariance[k, k])
        row = rest * jnp.where(spent, 0, 1 / safe_sqrt(jnp.where(spent, 1, rest[k])))
        rows.append(jnp.where(jnp.arange(3) < k, 0, row))
    return jnp.stack(rows)


def _moved(T_world_vehicle: jaxlie.SE3, offset: Float[Array, " 3"]) -> jaxlie.SE3:
    """The pose at another (x, y, psi), with the same tilt and height."""
    shift_m = jnp.concatenate([offset[:2], jnp.zeros_like(offset[:1])])
    return jaxlie.SE3.from_rotation_and_translation(
        jaxlie.SO3.from_z_radians(offset[2]) @ T_world_vehicle.rotation(),
        T_world_vehicle.translation() + shift_m,
    )


def _inside(
    rig: CameraRig, quads_px: Float[Array, "C M 4 2"], radius_px: Float[Array, "C M"]
) -> Bool[Array, "C M"]:
    """Whether all corners are in the image, or beside it by no more than the radius."""

    def one(quads_px: Array, radius_px: Array, size_px: Array) -> Array:
        outside_px = jnp.maximum(-0.5 - quads_px, quads_px - on_last_axis(size_px - 0.5, quads_px))
        return jnp.all(jnp.max(outside_px, axis=-1) <= radius_px[:, None], axis=-1)

    sizes_px = jnp.asarray(rig.image_sizes_px, quads_px.dtype)
    return jax.vmap(one)(quads_px, radius_px, sizes_px)


def _towards(rig: CameraRig, markers: MarkerMap, T_world_vehicle: jaxlie.SE3) -> Bool[Array, "C M"]:
    """Whether each camera is on a marker's printed side, and has all of it in front."""
    normals = jax.vmap(rotation_matrix)(markers.Ts_world_marker.rotation())[:, :, 2]
    Ts_world_camera = jax.vmap(lambda T: T_world_vehicle @ T.inverse())(rig.Ts_camera_vehicle)
    towards = Ts_world_camera.translation()[:, None] - markers.Ts_world_marker.translation()[None]
    in_front = jax.vmap(
        lambda camera, T_world_camera: camera.in_front(
            transform_points(T_world_camera.inverse(), markers.corners_world_m)
        )
    )(rig.cameras, Ts_world_camera)
    return (jnp.sum(towards * normals[None], axis=-1) > 0) & jnp.all(in_front, axis=-1)


@dataclass(frozen=True)
class _Belief:
    """Where the vehicle may be: the reported pose once it is decided, else one a hypothesis.

    Attributes:
        wxyz_xyz, covariance: (H, 7) and (H, 3, 3).
        now_ns: when they hold.
        before: the pose a little earlier; None where it was not decided.
    """

    wxyz_xyz: np.ndarray
    covariance: np.ndarray
    now_ns: int
    decided: bool
    before: "_Belief | None"


class Expectation:
    """The regions of a drive. One thread updates them, those that look for markers ask at any
    time."""

    def __init__(self, navigator: Navigator):
        """Compile now: the threads that look for markers are watched."""
        self._unnamed = strip_static(navigator)  # as compiled programs have it
        dtype = np.asarray(navigator.corner_sigma_px).dtype
        self._min_covariance = _MIN_COVARIANCE.astype(dtype)
        self._keys = marker_keys(navigator.markers)
        self._belief: _Belief | None = None
        # Of a belief: where each of its poses expects the markers, and how they move.
        self._known: tuple[_Belief, list[Expected], np.ndarray | None] | None = None
        self._expected(np.array([1, 0, 0, 0, 0, 0, 0], dtype), self._min_covariance)

    def update(self, output: Output, bank: Bank, now_ns: int) -> None:
        """Take what is believed now: an outcome's output and the bank of its belief."""
        # One assignment, since other threads read it.
        self._belief = self._believed(output, bank, now_ns) if output.located else None

    def region(self, camera: int) -> Region | None:
        """Where a camera should see markers; None where no pose is known."""
        belief = self._belief
        if belief is None:
            return None
        known = self._known
        if known is None or known[0] is not belief:  # the same for all cameras of a set
            places = zip(belief.wxyz_xyz, belief.covariance, strict=True)
            expected = [self._expected(*place) for place in places]
            known = self._known = belief, expected, self._flow_px_s(belief, expected[0])
        quads_px, visible, radius_px = (
            np.concatenate([np.asarray(part)[camera] for part in parts])
            for parts in zip(*known[1], strict=True)
        )
        flow_px_s = None if known[2] is None else known[2][camera][visible]
        keys = self._keys * len(known[1])
        seen = tuple(key for key, sees in zip(keys, visible, strict=True) if sees)
        stamp_ns, decided = belief.now_ns, belief.decided
        return Region(quads_px[visible], radius_px[visible], seen, flow_px_s, stamp_ns, decided)

    def _believed(self, output: Output, bank: Bank, now_ns: int) -> _Belief:
        if not output.decided:
            poses, covariances = likely_poses(bank, _MOST_PLACES)
            return _Belief(poses, covariances + self._min_covariance, now_ns, False, None)
        before = self._belief
        if before is not None and before.before is not None and now_ns - before.now_ns < _APART_NS:
            before = before.before
        return _Belief(
            np.asarray(output.T_world_vehicle.wxyz_xyz)[None],
            np.asarray(output.pose_covariance + self._min_covariance)[None],
            now_ns,
            True,
            replace(before, before=None) if before is not None and before.decided else None,
        )

    def _flow_px_s(self, belief: _Belief, expected: Expected) -> np.ndarray | None:
        """Velocities (C, M, 2) of the markers' centres in the images, from two poses in a row."""
        before = belief.before
        if before is None or not _APART_NS <= belief.now_ns - before.now_ns <= _TOO_FAR_NS:
            return None
        earlier = self._expected(before.wxyz_xyz[0], before.covariance[0])
        moved_px = np.mean(expected.quads_px - earlier.quads_px, axis=-2)
        return np.asarray(moved_px / ((belief.now_ns - before.now_ns) / 1e9))

    def _expected(self, wxyz_xyz: np.ndarray, covariance: np.ndarray) -> Expected:
        rig, markers = self._unnamed.rig, self._unnamed.markers
        return Expected(*jax.device_get(expect_corners(rig, markers, wxyz_xyz, covariance)))
