"""Fits of a standing car's pose, and of errors in its files, to the corners in its pictures.

The pose may be anywhere, or nearly level on the ground; sizes, places and lenses are as the files
say, or a few of them are unknown too. Each unknown is measured in its prior sigma. SciPy minimises,
so that only one small program has to be compiled for fits with different unknowns.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float
from scipy.optimize import least_squares

from jaxnav.commands.doctor.sight import area_px2
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.candidates import both_poses
from jaxnav.core.pose.observation import MODEL_SIGMA_PX, Observation, Snapshot, sightings
from jaxnav.detection.observe import CornerLanes

SIZE_SIGMA = 0.3  # of a logarithm
_FOCAL_SIGMA = 0.1
_MOVED_SIGMA = 1.0  # m and rad
_TURNED_SIGMA_RAD = 0.1
# The most an explanation may leave: a share of the chi-square, and an RMS error of the corners.
_EXPLAINS, _MOST_PX = 0.1, 1.0
_SCALED_ALIKE = 0.01  # sizes that a printer scaled agree this well
_ALIKE = 6.0  # two explanations this close can't be told apart
MOST_ERRORS = 6  # numbers that may be unknown beside the pose
_HEIGHT_SIGMA_M = 0.01  # of a car on a floor that is nearly level,
_TILT_SIGMA_RAD = np.deg2rad(0.5)  # and with a tape's errors in the cameras' places
_FREE_M, _FREE_RAD = 10.0, 3.0


@dataclass(frozen=True)
class Sighted:
    """Sightings by C cameras of the M markers that any of them sees, in the order of the map.

    Attributes:
        corners_px: (C, M, 4, 2).
        visible: (C, M).
        sigma_px: (C, M, 4), of detection and calibration together.
    """

    rig: CameraRig
    markers: MarkerMap
    corners_px: Float[np.ndarray, "C M 4 2"]
    visible: Bool[np.ndarray, "C M"]
    sigma_px: Float[np.ndarray, "C M 4"]

    @staticmethod
    def of(rig: CameraRig, markers: MarkerMap, seen: CornerLanes, most: int) -> "Sighted":
        """The sightings of the `most` markers that look largest in any image."""
        areas_px2 = np.abs(area_px2(seen.corners_px))
        largest = np.where(seen.visible, areas_px2, 0).max(axis=0)
        count = min(int((largest > 0).sum()), most)
        kept = np.sort(np.argsort(-largest, kind="stable")[:count])
        chosen = MarkerMap(
            jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[kept]),
            markers.size_m[kept],
            tuple(markers.ids[i] for i in kept),
            tuple(markers.families[i] for i in kept),
            markers.origin_m,
        )
        sigma_px = np.hypot(seen.sigma_px[:, kept], MODEL_SIGMA_PX)
        return Sighted(rig, chosen, seen.corners_px[:, kept], seen.visible[:, kept], sigma_px)

    def only(self, marker: int) -> "Sighted":
        """These sightings with only one marker in view."""
        alone = np.arange(self.visible.shape[1]) == marker
        visible = self.visible & alone
        return Sighted(self.rig, self.markers, self.corners_px, visible, self.sigma_px)

    def reordered(self, marker: int, order: tuple[int, ...]) -> "Sighted":
        """These sightings with the corners of one marker in another order."""
        corners_px, sigma_px = self.corners_px.copy(), self.sigma_px.copy()
        corners_px[:, marker] = corners_px[:, marker, list(order)]
        sigma_px[:, marker] = sigma_px[:, marker, list(order)]
        return Sighted(self.rig, self.markers, corners_px, self.visible, sigma_px)

    @property
    def numbers(self) -> int:
        """The number of corner coordinates."""
        return 8 * int(self.visible.sum())

    @property
    def allowed_px(self) -> float:
        """RMS of the corners' sigmas, px."""
        return float(np.sqrt(np.mean(self.sigma_px[self.visible] ** 2)))


class FileErrors(eqx.Module):
    """Differences from the files, or their sigmas, where 0 says that a number is known."""

    pose: Float[np.ndarray, " 6"]  # xi in T_world_vehicle * exp(xi)
    size: Float[np.ndarray, " M"]  # logarithm of true over written
    moved: Float[np.ndarray, "M 6"]  # xi in T_world_marker * exp(xi)
    focal: Float[np.ndarray, " C"]  # logarithm of true over written
    turned: Float[np.ndarray, "C 3"]  # rotation vector of each camera in its own frame, rad

    @staticmethod
    def of_pose(seen: Sighted, level: bool, **others: Float[np.ndarray, "..."]) -> "FileErrors":
        """Prior sigmas of a pose anywhere in space, or level on the ground, and of `others`."""
        C, M = seen.visible.shape
        on_ground = [_HEIGHT_SIGMA_M, _TILT_SIGMA_RAD, _TILT_SIGMA_RAD]
        z_m, roll_rad, pitch_rad = on_ground if level else [_FREE_M, _FREE_RAD, _FREE_RAD]
        none = {
            "size": np.zeros(M),
            "moved": np.zeros((M, 6)),
            "focal": np.zeros(C),
            "turned": np.zeros((C, 3)),
        }
        pose = np.array([_FREE_M, _FREE_M, z_m, roll_rad, pitch_rad, _FREE_RAD])
        return FileErrors(pose, **(none | others))


@dataclass(frozen=True)
class StandingFit:
    """The best fit of a pose and of unknowns to the corners.

    Attributes:
        T_world_vehicle: (4, 4).
        cost: chi-square of corners and priors.
        error_px: RMS error of all corner coordinates.
        value: of the unknowns.
        sigma: of the unknowns.
        pose_covariance: (6, 6), of xi in T_world_vehicle * exp(xi).
    """

    T_world_vehicle: Float[np.ndarray, "4 4"]
    cost: float
    error_px: float
    value: FileErrors
    sigma: FileErrors
    pose_covariance: Float[np.ndarray, "6 6"]

    @property
    def planar(self) -> tuple[float, float, float]:
        """The pose on the ground: x m, y m, psi rad."""
        T = self.T_world_vehicle
        return float(T[0, 3]), float(T[1, 3]), float(np.arctan2(T[1, 0], T[0, 0]))

    @property
    def tilt_rad(self) -> float:
        """The angle between the vehicle's z axis and the world's, rad."""
        return float(np.arccos(np.clip(self.T_world_vehicle[2, 2], -1, 1)))


def poses_by_each(seen: Sighted) -> list[Float[np.ndarray, " 7"]]:
    """Both T_world_vehicle, (7,) wxyz_xyz each, by each marker in each camera."""
    both = np.asarray(_both(seen.rig, seen.markers, seen.corners_px, seen.visible))
    return list(both[seen.visible.reshape(-1)].reshape(-1, 7))


@jax.jit
def _both(
    rig: CameraRig, markers: MarkerMap, corners_px: jax.Array, visible: jax.Array
) -> jax.Array:
    seen = sightings(rig, markers, corners_px, visible)
    snapshot = Snapshot(rig, markers, Observation(corners_px, visible), seen)
    return both_poses(snapshot).inverse().wxyz_xyz


def fit(
    seen: Sighted, starts: Iterable[Float[np.ndarray, " 7"]], prior_sigma: FileErrors
) -> StandingFit:
    """The best fit from several starts.

    Args:
        starts: T_world_vehicle, (7,) wxyz_xyz each. The prior of the pose is about them.
        prior_sigma: of each unknown.
    """
    fits = [_fit(seen, start, prior_sigma) for start in starts]
    return min(fits, key=lambda each: each.cost)


def _fit(seen: Sighted, start: np.ndarray, prior_sigma: FileErrors) -> StandingFit:
    flat_sigma, unravel = ravel_pytree(prior_sigma)
    asked = np.flatnonzero(flat_sigma)
    slots = np.full(6 + MOST_ERRORS, flat_sigma.size)  # past the end where fewer are asked for
    slots[: len(asked)] = asked
    given: Any = (seen.rig, seen.markers, seen.corners_px, seen.visible, seen.sigma_px)
    latest: list[Any] = [None, None]

    def look(u: np.ndarray) -> Any:
        if latest[0] is None or not np.array_equal(latest[0], u):
            latest[:] = u.copy(), jax.device_get(_errors(*given, start, prior_sigma, slots, u))
        return latest[1]

    def residuals(u: np.ndarray) -> np.ndarray:
        return np.append(look(u)[0], u)

    def jacobian(u: np.ndarray) -> np.ndarray:
        return np.vstack([look(u)[1], np.eye(slots.size)])

    solution = least_squares(residuals, np.zeros(slots.size), jacobian, method="lm", max_nfev=200)
    whitened, J, wxyz_xyz = look(solution.x)
    covariance = np.linalg.inv(J.T @ J + np.eye(slots.size))
    value, sigma = np.zeros(flat_sigma.size), np.zeros(flat_sigma.size)
    mine = slice(len(asked))
    value[asked] = solution.x[mine] * flat_sigma[asked]
    sigma[asked] = np.sqrt(np.diag(covariance)[mine]) * flat_sigma[asked]
    pose_sigma = np.asarray(prior_sigma.pose)
    sigmas_px = np.repeat(seen.sigma_px.reshape(-1), 2)
    return StandingFit(
        np.asarray(jaxlie.SE3(jnp.asarray(wxyz_xyz)).as_matrix()),
        cost=float(2 * solution.cost),
        error_px=float(np.sqrt(np.sum((whitened * sigmas_px) ** 2) / max(seen.numbers, 1))),
        value=unravel(jnp.asarray(value)),
        sigma=unravel(jnp.asarray(sigma)),
        pose_covariance=covariance[:6, :6] * np.outer(pose_sigma, pose_sigma),
    )


@jax.jit
def _errors(
    rig: CameraRig,
    markers: MarkerMap,
    corners_px: jax.Array,
    visible: jax.Array,
    sigma_px: jax.Array,
    start: jax.Array,
    prior_sigma: FileErrors,
    slots: jax.Array,
    u: jax.Array,
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Corner errors in sigmas, their derivatives by u, and T_world_vehicle (7,) at u."""
    flat_sigma, unravel = ravel_pytree(prior_sigma)

    def errors(u: jax.Array) -> tuple[jax.Array, tuple[jax.Array, jax.Array]]:
        y = unravel(jnp.zeros_like(flat_sigma).at[slots].set(u, mode="drop") * flat_sigma)
        T_world_vehicle = jaxlie.SE3(start) @ jaxlie.SE3.exp(y.pose)
        Ts_world_marker = jax.vmap(lambda T, xi: T @ jaxlie.SE3.exp(xi))(
            markers.Ts_world_marker, y.moved
        )
        Ts_camera_vehicle = jax.vmap(
            lambda T, turn: jaxlie.SE3.from_rotation(jaxlie.SO3.exp(turn)) @ T
        )(rig.Ts_camera_vehicle, y.turned)
        size_m = markers.size_m * jnp.exp(y.size)
        there = MarkerMap(Ts_world_marker, size_m, markers.ids, markers.families)
        seeing = eqx.tree_at(
            lambda rig: (rig.cameras.focal_px, rig.Ts_camera_vehicle.wxyz_xyz),
            rig,
            (rig.cameras.focal_px * jnp.exp(y.focal)[:, None], Ts_camera_vehicle.wxyz_xyz),
        )
        seen_px = seeing.project(T_world_vehicle.inverse(), there.corners_world_m)
        whitened = (seen_px - corners_px) / sigma_px[..., None]
        whitened = jnp.where(visible[..., None, None], whitened, 0).reshape(-1)
        return whitened, (whitened, T_world_vehicle.wxyz_xyz)

    J, (whitened, wxyz_xyz) = jax.jacfwd(errors, has_aux=True)(u)
    return whitened, J, wxyz_xyz


@dataclass(frozen=True)
class Explanation:
    """One error that a file may hold, with the best fit that allows for it.

    Attributes:
        kind: "size", "sizes", "moved", "focal" or "turned".
        index: of the marker or the camera; None for all of them.
        count: how many numbers it frees.
        fit: the best fit with these numbers free.
    """

    kind: str
    index: int | None
    count: int
    fit: StandingFit = field(repr=False)


def explained(
    seen: Sighted, starts: Sequence[Float[np.ndarray, " 7"]], whole: StandingFit
) -> list[Explanation]:
    """The errors that explain the corners best: up to three that can't be told apart, often none.

    Args:
        starts: level poses to begin at.
        whole: the fit without any error.
    """
    tried = [
        Explanation(kind, index, count, fit(seen, starts, prior_sigma))
        for kind, index, count, prior_sigma in _errors_of_files(seen)
    ]
    good = [
        each
        for each in tried
        if each.fit.cost < _EXPLAINS * whole.cost
        and each.fit.error_px < _MOST_PX
        and (each.kind != "sizes" or np.ptp(each.fit.value.size) < _SCALED_ALIKE)
    ]
    misfit = min((max(each.fit.cost / seen.numbers, 1.0) for each in good), default=1.0)

    def price(each: Explanation) -> float:
        """Schwarz's criterion (1978): the misfit left, and a penalty for each number freed."""
        return each.fit.cost / misfit + each.count * math.log(seen.numbers)

    good.sort(key=price)
    return [each for each in good if price(each) < price(good[0]) + _ALIKE][:3]


def _errors_of_files(seen: Sighted) -> Iterator[tuple[str, int | None, int, FileErrors]]:
    """Each error that several markers can tell apart: kind, index, count, and prior sigmas."""
    C, M = seen.visible.shape
    used = np.flatnonzero(seen.visible.any(axis=1))[:MOST_ERRORS]

    def of_pose(**others: np.ndarray) -> FileErrors:
        return FileErrors.of_pose(seen, level=True, **others)

    yield "sizes", None, M, of_pose(size=np.full(M, SIZE_SIGMA))
    focal = np.where(np.isin(np.arange(C), used), _FOCAL_SIGMA, 0.0)
    yield "focal", None, len(used), of_pose(focal=focal)
    for m in range(M):
        this = np.arange(M) == m
        yield "size", m, 1, of_pose(size=np.where(this, SIZE_SIGMA, 0.0))
        moved = np.where(this[:, None], _MOVED_SIGMA, 0.0) * np.ones(6)
        yield "moved", m, 6, of_pose(moved=moved)
    if len(used) > 1:
        for c in used.tolist():
            this = np.arange(C) == c
            turned = np.where(this[:, None], _TURNED_SIGMA_RAD, 0.0) * np.ones(3)
            yield "turned", c, 3, of_pose(turned=turned)


def in_words(seen: Sighted, explanation: Explanation) -> tuple[str, str]:
    """An explanation as text, and what to do about it."""
    value, index = explanation.fit.value, explanation.index
    ids, names = seen.markers.ids, seen.rig.names
    if index is None:
        if explanation.kind == "sizes":
            factors = ", ".join(
                f"{marker_id} {math.exp(float(size)):.3f}"
                for marker_id, size in zip(ids, value.size, strict=True)
            )
            return (
                f"markers have other sizes than in the map: {factors} times",
                "measure the black squares: did the printer scale the page?",
            )
        factors = ", ".join(
            f"{names[c]} {math.exp(float(value.focal[c])):.3f}"
            for c in np.flatnonzero(seen.visible.any(axis=1))
        )
        return (
            f"focal lengths are other than in the rig: {factors} times",
            "calibrate the lenses again, at the image size that the car uses",
        )
    if explanation.kind == "size":
        factor, size_m = math.exp(float(value.size[index])), float(seen.markers.size_m[index])
        return (
            f"marker {ids[index]} is {factor:.3f} of its size in the map",
            f"measure its black square: is it {size_m * factor:.4f} m instead of {size_m:.4f}?",
        )
    if explanation.kind == "moved":
        shift_m = float(np.linalg.norm(value.moved[index, :3]))
        turn_deg = math.degrees(float(np.linalg.norm(value.moved[index, 3:])))
        return (
            f"marker {ids[index]} is moved by {shift_m:.3f} m and {turn_deg:.0f} deg",
            f"measure the corners of marker {ids[index]} again",
        )
    turn_deg = math.degrees(float(np.linalg.norm(value.turned[index])))
    return (
        f"camera {names[index]} is turned by {turn_deg:.1f} deg",
        f"measure yaw_deg, elevation_deg and roll_deg of {names[index]} again",
    )
