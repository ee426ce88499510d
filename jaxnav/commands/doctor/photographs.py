"""Checks of the files by pictures of the standing car: `--frame CAMERA=IMAGE`.

Each marker alone tells whether its corners are in the print's order, and whether the car is then
level: the print is taken as true and the map is tested, its corners tried in every order in which a
person may have written them down. All markers at once tell whether the files agree; which of them
is wrong a drive tells `jaxnav calibrate check`.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jaxlie
import numpy as np
from jaxtyping import Array, Float, UInt8
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.rig.views import both_poses, inverted
from jaxnav.commands.doctor.findings import Finding, found, listed
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import MODEL_SIGMA_PX
from jaxnav.detection import CornerLanes, Detections, make_detectors, observe
from jaxnav.detection.observe import double_area_px2
from jaxnav.errors import BadInput
from jaxnav.files import Route
from jaxnav.files.images import read_image
from jaxnav.files.poses import transform

_LEAST_PX = 12.0  # width of a marker that is found
# Corner i of the map is corner order[i] of the print: orders that are turned, and orders that count
# the other way round, as seen from behind.
TURNED = tuple(tuple((k + i) % 4 for i in range(4)) for k in range(4))
MIRRORED = tuple(tuple((k - i) % 4 for i in range(4)) for k in range(4))
_CORNERS = ("top-left", "top-right", "bottom-right", "bottom-left")
_FALLEN_DEG = 30.0  # no error of extrinsics tilts a car like this
_STANDS_DEG = 15.0
_MOST_HEIGHT_M, _MOST_TILT_DEG = 0.03, 2.0  # errors of tape and floor
_MAX_WORSE = 40.0  # of chi-square, by which the mirror image of a pose may explain corners worse
_MAX_ERROR = 3.0  # times the RMS that the corners' sigma allows
_FITS = 2.0  # chi-square for each number, up to which all is well
_SMALL_PX = 0.3  # an RMS this small is no error of a file either
_LEAST_SIZE = 0.03  # a smaller error of a size is not reported
_CLEARLY = 2.0  # sigma
# Prior sigmas of a pose, m and rad: anywhere in space, or on a floor that is nearly level, with a
# tape's errors in the cameras' places.
ANYWHERE = (10.0, 10.0, 10.0, 3.0, 3.0, 3.0)
LEVEL = (10.0, 10.0, 0.01, np.deg2rad(0.5), np.deg2rad(0.5), 3.0)
_SCALE_SIGMA = 0.3  # of the logarithm of a true over a written size
_MOST_STARTS = 4  # of many markers, whose poses a search begins at


def pictures(frames: Mapping[str, str], files: Mapping[str, Any]) -> Iterator[Finding]:
    """Read pictures of one standing car, by the names of their cameras, and examine them.

    Args:
        files: rig, markers and route, as far as they could be read.

    Raises:
        BadInput: a picture can't be read, or is of a camera that the rig does not have.
    """
    if "rig" not in files or "markers" not in files:
        yield found("picture.skipped")
        return
    rig, images = files["rig"], {}
    for name, path in frames.items():
        if name not in rig.names:
            problem = f"the rig has no camera {name!r}: expected one of {', '.join(rig.names)}"
            raise BadInput(f"--frame {name}={path}", problem)
        images[name] = read_image(Path(path))
    yield from examine_pictures(rig, files["markers"], files.get("route"), images)


def examine_pictures(
    rig: CameraRig,
    markers: MarkerMap,
    route: Route | None,
    images: Mapping[str, UInt8[np.ndarray, "rows columns ..."]],
) -> Iterator[Finding]:
    """Run all checks of pictures of one standing car.

    Args:
        images: by the names of their cameras.
    """
    sizes_px = dict(zip(rig.names, rig.image_sizes_px, strict=True))
    wrong = [name for name, image in images.items() if image.shape[1::-1] != sizes_px[name]]
    for name in wrong:
        (height, width), (rig_width, rig_height) = images[name].shape[:2], sizes_px[name]
        yield found(
            "picture.size", camera=name, width=width, height=height, rig_width=rig_width,
            rig_height=rig_height,
        )  # fmt: skip
    if wrong:
        return
    detectors = make_detectors(markers)
    detections = [
        Detections.concatenate(
            [detector.detect(images[name], rig.camera(index)) for detector in detectors]
            if name in images
            else []
        )
        for index, name in enumerate(rig.names)
    ]
    yield from _identities(rig, markers, detections)
    seen = Sighted(rig, markers, observe(detections, markers))
    if not seen.ids:
        return
    seen, poses, findings = in_their_order(seen, route)
    yield from findings
    yield from _together(seen, poses, route)


def _identities(
    rig: CameraRig, markers: MarkerMap, detections: Sequence[Detections]
) -> Iterator[Finding]:
    """Report which markers are in view, of the map and others."""
    known, foreign, twice = [], [], []
    for name, one in zip(rig.names, detections, strict=True):
        keys = list(zip(one.ids.tolist(), one.families, strict=True))
        counts = Counter(keys)
        sides_px = np.sqrt(np.abs(double_area_px2(one.corners_px)) / 2)
        for key, side_px in zip(keys, sides_px, strict=True):
            if markers.index(*key) is None:
                foreign.append(f"{key[0]} of {key[1]} in {name}")
            elif counts[key] > 1:
                twice.append(f"{key[0]} in {name}")
            else:
                known.append(f"{key[0]} in {name} ({side_px:.0f} px)")
    if foreign:
        yield found("picture.foreign", seen=listed(foreign))
    if twice:
        yield found("picture.twice", seen=listed(sorted(set(twice))))
    if known:
        yield found("picture.seen", seen=listed(known))
    else:
        families = listed(sorted(set(markers.families)))
        yield found("picture.none", ids=listed(markers.ids), families=families, least_px=_LEAST_PX)


@dataclass(frozen=True)
class Sighted:
    """What the cameras of a standing car see of the markers."""

    rig: CameraRig
    markers: MarkerMap
    lanes: CornerLanes

    def only(self, marker: int) -> "Sighted":
        """These sightings with only one marker in view."""
        alone = np.arange(len(self.markers.ids)) == marker
        return replace(self, lanes=self.lanes._replace(visible=self.lanes.visible & alone))

    def reordered(self, marker: int, order: tuple[int, ...]) -> "Sighted":
        """These sightings with the corners of one marker in another order."""
        corners_px, sigma_px = self.lanes.corners_px.copy(), self.lanes.sigma_px.copy()
        corners_px[:, marker] = corners_px[:, marker, order]
        sigma_px[:, marker] = sigma_px[:, marker, order]
        return replace(self, lanes=self.lanes._replace(corners_px=corners_px, sigma_px=sigma_px))

    @property
    def ids(self) -> dict[int, str]:
        """The names of the markers in view, by their place in the map."""
        seen = np.flatnonzero(self.lanes.visible.any(axis=0)).tolist()
        return {index: f"marker {self.markers.ids[index]}" for index in seen}

    @property
    def numbers(self) -> int:
        """The number of corner coordinates."""
        return 8 * int(self.lanes.visible.sum())

    @property
    def sigma_px(self) -> Float[np.ndarray, "N 4"]:
        """Of the corners in view along an axis, of detection and calibration together."""
        return np.hypot(self.lanes.sigma_px[self.lanes.visible], MODEL_SIGMA_PX)

    @property
    def allowed_px(self) -> float:
        """RMS of the corners' sigmas, px."""
        return float(np.sqrt(np.mean(self.sigma_px**2)))

    def poses(self) -> Float[np.ndarray, "P 4 4"]:
        """Both T_world_vehicle by each marker in each camera."""
        camera, marker = np.nonzero(self.lanes.visible)
        rays = np.asarray(_rays(self.rig.cameras, self.lanes.corners_px))[camera, marker]
        Ts_camera_marker = both_poses(rays, np.asarray(self.markers.size_m, float)[marker])
        Ts_world_marker = np.asarray(self.markers.Ts_world_marker.as_matrix(), float)[marker]
        Ts_camera_vehicle = np.asarray(self.rig.Ts_camera_vehicle.as_matrix(), float)[camera]
        T = Ts_world_marker[:, None] @ inverted(Ts_camera_marker) @ Ts_camera_vehicle[:, None]
        return T[np.isfinite(T).all(axis=(2, 3))]


@jax.jit
def _rays(cameras: Camera, corners_px: Float[Array, "C M 4 2"]) -> Float[Array, "C M 4 3"]:
    return jax.vmap(lambda camera, pixels: camera.unproject(pixels))(cameras, corners_px)


@jax.jit
def _projected_px(
    rig: CameraRig, markers: MarkerMap, T_world_vehicle: Float[Array, "4 4"]
) -> Float[Array, "C M 4 2"]:
    T_vehicle_world = jaxlie.SE3.from_matrix(T_world_vehicle).inverse()
    return rig.project(T_vehicle_world, markers.corners_world_m)


@dataclass(frozen=True)
class Fit:
    """The pose that explains the corners best.

    Attributes:
        cost: chi-square of corners and prior.
        error_px: RMS error of all corner coordinates.
        factor: of all sizes, where these are fitted.
        covariance: of a shift and a turn of the vehicle in its own frame, and of the logarithm of
            the factor where there is one.
    """

    T_world_vehicle: Float[np.ndarray, "4 4"]
    cost: float
    error_px: float
    factor: float
    covariance: Float[np.ndarray, "n n"]

    @property
    def planar(self) -> tuple[float, float, float]:
        """The pose on the ground: x m, y m, psi rad."""
        T = self.T_world_vehicle
        return float(T[0, 3]), float(T[1, 3]), float(np.arctan2(T[1, 0], T[0, 0]))

    @property
    def tilt_deg(self) -> float:
        """The angle between the vehicle's z axis and the world's, deg."""
        return float(np.rad2deg(np.arccos(np.clip(self.T_world_vehicle[2, 2], -1, 1))))


def fit(seen: Sighted, start: Float[np.ndarray, "4 4"], sigmas: Sequence[float]) -> Fit:
    """The best pose near a start.

    Args:
        start: T_world_vehicle, which the prior is about.
        sigmas: of the prior: six of the pose and, where one factor of all sizes is to be fitted,
            one of its logarithm.
    """
    visible, sigma_px = seen.lanes.visible, seen.sigma_px[..., None]

    def at(u: np.ndarray) -> tuple[np.ndarray, float, np.ndarray]:
        """The pose, the factor, and the errors in px."""
        xi = u * sigmas
        T = start @ transform(Rotation.from_rotvec(xi[3:6]).as_matrix(), xi[:3])
        factor, markers = math.exp(float(xi[6:].sum())), seen.markers
        if len(sigmas) > 6:
            markers = replace(markers, size_m=markers.size_m * factor)
        errors_px = np.asarray(_projected_px(seen.rig, markers, T)) - seen.lanes.corners_px
        return T, factor, errors_px[visible]

    def residuals(u: np.ndarray) -> np.ndarray:
        return np.append(at(u)[2] / sigma_px, u)

    solution = least_squares(residuals, np.zeros(len(sigmas)), method="lm")
    T, factor, errors_px = at(solution.x)
    J = np.asarray(solution.jac)
    return Fit(
        T,
        cost=float(2 * solution.cost),
        error_px=float(np.sqrt(np.mean(errors_px**2))),
        factor=factor,
        covariance=np.linalg.inv(J.T @ J) * np.outer(sigmas, sigmas),
    )


def in_their_order(seen: Sighted, route: Route | None) -> tuple[Sighted, list[Fit], list[Finding]]:
    """Find the order of each marker's corners, and the pose of the car by that marker alone.

    Args:
        route: tells on which side of a marker the car may be.

    Returns:
        The sightings with corners as the map should have them, a pose by each marker alone, and
        the findings.
    """
    poses, findings = [], []
    for index, marker in seen.ids.items():
        pose, order = _best_order(seen.only(index), index, route)
        seen = seen.reordered(index, order)
        poses.append(pose)
        if order != TURNED[0]:
            findings.append(_wrong_order(marker, order, pose))
        else:
            findings.append(_levelled(marker, pose))
        alone = seen.only(index)
        allowed_px = alone.allowed_px * math.sqrt((alone.numbers - 6) / alone.numbers)
        if pose.error_px > _MAX_ERROR * allowed_px:  # they fit no square at all
            off: dict[str, Any] = {"error_px": pose.error_px, "allowed_px": allowed_px}
            findings.append(found("picture.no_square", marker=marker, **off))
    return seen, poses, findings


def standing(seen: Sighted) -> Fit:
    """The most level pose, anywhere in space, among those that explain the corners."""
    fits = [fit(seen, start, ANYWHERE) for start in seen.poses()]
    least = min(each.cost for each in fits)
    return min(
        (each for each in fits if each.cost <= least + _MAX_WORSE), key=lambda each: each.tilt_deg
    )


def _best_order(alone: Sighted, index: int, route: Route | None) -> tuple[Fit, tuple[int, ...]]:
    """The pose and the corner order that leave the car level; the map's own order where it does."""
    behind = route is not None and _is_behind(alone.markers, index, route)
    as_written = standing(alone)
    if as_written.tilt_deg < _FALLEN_DEG and not behind:
        return as_written, TURNED[0]
    # From the car's pose alone, turned and mirrored can't be told apart.
    tried = [
        (standing(alone.reordered(index, order)), order)
        for order in (MIRRORED if behind else TURNED)
    ]
    pose, order = min(tried, key=lambda pair: pair[0].tilt_deg)
    return (pose, order) if pose.tilt_deg < _STANDS_DEG else (as_written, TURNED[0])


def _is_behind(markers: MarkerMap, index: int, route: Route) -> bool:
    """Whether start and all waypoints lie on the unprinted side of a marker."""
    T = np.asarray(markers.Ts_world_marker.as_matrix())[index]
    places_m = np.array([route.start_pose[:2], *route.waypoints_m])
    return bool(np.all((places_m - T[:2, 3]) @ T[:2, 2] < 0))


def _wrong_order(marker: str, order: tuple[int, ...], pose: Fit) -> Finding:
    how = "counted the wrong way round, as if seen from behind"
    if order in TURNED:
        how = f"turned by {90 * order[0]} deg"
    # Entry order.index(j) of the map is corner j of the print.
    right = " ".join(str(order.index(corner) + 1) for corner in range(4))
    first = _CORNERS[order[0]]
    return found(
        "picture.order", marker=marker, how=how, first=first, tilt_deg=pose.tilt_deg, order=right
    )


def _levelled(marker: str, pose: Fit) -> Finding:
    up = pose.T_world_vehicle[2, :3]
    height_m, tilt_deg = float(pose.T_world_vehicle[2, 3]), pose.tilt_deg
    height_sigma_m = math.sqrt(up @ pose.covariance[:3, :3] @ up)
    tilt_sigma_deg = math.degrees(math.sqrt(np.trace(pose.covariance[3:5, 3:5])))
    high = abs(height_m) > _MOST_HEIGHT_M + 3 * height_sigma_m
    level = None
    if high or tilt_deg > _MOST_TILT_DEG + 3 * tilt_sigma_deg:
        level = "error" if tilt_deg > _FALLEN_DEG else "warning"
    return found(
        "picture.level",
        level,
        marker=marker,
        height_cm=height_m * 100,
        height_sigma_cm=height_sigma_m * 100,
        tilt_deg=tilt_deg,
        tilt_sigma_deg=tilt_sigma_deg,
    )


def _together(seen: Sighted, poses: Sequence[Fit], route: Route | None) -> Iterator[Finding]:
    """Report where the car stands, and whether all markers agree or the only one has its size.

    Args:
        seen: corners in the order of the print.
        poses: the pose by each marker alone.
    """
    whole = _on_ground(seen, poses, LEVEL)
    x_m, y_m, psi_rad = whole.planar
    if route is not None:
        start = route.start_pose
        apart_rad = math.remainder(psi_rad - start[2], 2 * math.pi)
        yield found(
            "picture.stands",
            x_m=seen.markers.origin_m[0] + x_m,
            y_m=seen.markers.origin_m[1] + y_m,
            psi_deg=round(math.degrees(psi_rad)),
            apart_m=math.hypot(x_m - start[0], y_m - start[1]),
            turn_deg=round(math.degrees(apart_rad)),
        )
    if len(seen.ids) == 1:
        yield _size(seen, poses)
        return
    fits = whole.cost <= _FITS * seen.numbers or whole.error_px < _SMALL_PX
    key, count = "picture.agree" if fits else "picture.disagree", len(seen.ids)
    yield found(key, count=count, error_px=whole.error_px, allowed_px=seen.allowed_px)


def _on_ground(seen: Sighted, starts: Sequence[Fit], sigmas: Sequence[float]) -> Fit:
    """The best level pose."""
    fits = []
    for x_m, y_m, psi_rad in (start.planar for start in starts[:_MOST_STARTS]):
        R = Rotation.from_euler("z", psi_rad).as_matrix()
        fits.append(fit(seen, transform(R, np.array([x_m, y_m, 0.0])), sigmas))
    return min(fits, key=lambda each: each.cost)


def _size(seen: Sighted, alone: Sequence[Fit]) -> Finding:
    """Check the size of a single marker: its height over the camera tells its distance, so size."""
    ((index, marker),) = seen.ids.items()
    by = _on_ground(seen, alone, (*LEVEL, _SCALE_SIGMA))
    sigma, map_m = math.sqrt(by.covariance[6, 6]), float(seen.markers.size_m[index])
    wrong = abs(math.log(by.factor)) > max(_CLEARLY * sigma, _LEAST_SIZE)
    key = "picture.own_size" if wrong else "picture.right_size"
    size_m = map_m * by.factor
    return found(key, marker=marker, factor=by.factor, sigma=sigma, map_m=map_m, size_m=size_m)
