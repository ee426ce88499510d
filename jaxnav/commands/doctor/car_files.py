"""Checks of a car's files: lenses and places of cameras and markers, and what is seen on the route.

Where the files contradict themselves their loaders say so. These look for what is possible, and not
likely of a small vehicle.
"""

import math
from collections.abc import Iterator
from typing import Any

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Bool, Float

from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.doctor.findings import Finding, found, listed
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle, curvature_per_m
from jaxnav.detection.observe import double_area_px2
from jaxnav.files import Route

_LEAST_HEIGHT_M, _MOST_HEIGHT_M = 0.01, 2.5
_MOST_DISTANCE_M = 4.0  # from the middle of the vehicle: a van
_SAME_PLACE_M, _SAME_DIRECTION = 0.02, np.cos(np.deg2rad(5))
_MAX_OFF_CENTER = 0.1  # of the image's size
_MAX_ASPECT = 1.05  # fx : fy; pixels are squares
_FIELD_DEG = (20.0, 220.0)  # of lenses that see markers from a vehicle
_LENS_PX = 0.5  # a ray that lands farther than this from its pixel belongs to another one
_PIXELS_ALONG = 64  # from the centre to each corner of the image
_FAR_M = 1e6
_SAME_RAY = 1e-3  # between a ray and the ray of its pixel, where the lens is one-to-one

_UNDERGROUND = 0.01  # of a side: a careful tape's error
_UPRIGHT = 0.3  # the normal's vertical part, below which a marker hangs on a wall
_TURNED_DEG = 45
_MOST_SIZE_M = 2.0

READABLE_PX = 12.0  # a marker this wide is read in every second picture of a car at rest
_POSES_ALONG = 48  # of the route, from which views are computed
_LONG_BLIND_M = 1.0  # farther than this the odometer should not be trusted alone
_NEAR_M = 0.25  # the car is about that wide
_HIGH_M = 1.5
_LEAST_STEERING_RAD = 0.1
_LEAST_RADIUS_M = 0.05  # the estimate's own error is about that
_TOP_SPEED_MPS = (0.1, 5.0)
# What a small vehicle's figures lie between, and what they mean.
_LAG = 0.02, 2.0, "it is the time in s until 63 % of a commanded speed is reached"
_TURN = "it is the largest turn rate in rad/s that is commanded: a turn in a second is 6.28"
_FIGURES = {
    "speed_time_constant_s": _LAG,
    "time_constant_s": _LAG,
    "wheelbase_m": (0.05, 4.0, "it is the distance between the axles in m"),
    "forward_limit_mps": (*_TOP_SPEED_MPS, "it is the largest speed in m/s that is commanded"),
    "turn_limit_radps": (0.2, 20.0, _TURN),
}


# --- rig -----------------------------------------------------------------------------------


def rig_file(rig: CameraRig) -> Iterator[Finding]:
    """Run all checks of a rig that was loaded from a file."""
    yield found("rig.cameras", count=len(rig), names=listed(rig.names))
    yield from places(rig)
    yield from lenses(rig)
    yield from bearings(rig)


def places(rig: CameraRig) -> Iterator[Finding]:
    """Check where the cameras are and how they are turned."""
    T = Ts_vehicle_camera(rig)
    for name, position_m, R in zip(rig.names, T[:, :3, 3], T[:, :3, :3], strict=True):
        height_m, distance_m = position_m[2], np.hypot(*position_m[:2])
        yaw = np.arctan2(R[1, 2], R[0, 2])
        yaw_deg, elevation_deg = np.rad2deg([yaw, np.arcsin(np.clip(R[2, 2], -1, 1))])
        if not _LEAST_HEIGHT_M < height_m < _MOST_HEIGHT_M:
            level = "error" if height_m <= 0 else None
            yield found("rig.height", level, camera=name, height_m=height_m)
        elif distance_m > _MOST_DISTANCE_M:
            yield found("rig.far", camera=name, distance_m=distance_m)
        else:
            looks: dict[str, Any] = {
                "yaw_deg": round(yaw_deg),
                "elevation_deg": round(elevation_deg),
            }
            yield found("rig.place", camera=name, height_m=height_m, **looks)
        if R[2, 1] > 0:
            yield found("rig.upside_down", camera=name)
    for i in range(len(rig)):
        for j in range(i):
            near = np.linalg.norm(T[i, :3, 3] - T[j, :3, 3]) < _SAME_PLACE_M
            if near and T[i, :3, 2] @ T[j, :3, 2] > _SAME_DIRECTION:
                yield found("rig.copied", one=rig.names[j], other=rig.names[i])


def lenses(rig: CameraRig) -> Iterator[Finding]:
    """Check principal points, focal lengths and fields of view against the size of the images, and
    that every pixel belongs to one ray: lens models may fold back before the corners."""
    sizes_px = np.array(rig.image_sizes_px, float)
    centers_px, focals_px = np.asarray(rig.cameras.center_px), np.asarray(rig.cameras.focal_px)
    ends_px = (sizes_px - 1)[:, None] * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    share = np.arange(1, _PIXELS_ALONG + 1)[:, None, None] / _PIXELS_ALONG
    centers = centers_px[:, None]
    diagonals_px = centers[:, None] + share * (ends_px - centers)[:, None]
    edges_px = ends_px[:, :2].copy()
    edges_px[..., 1] = centers_px[:, 1:]
    pixels = np.concatenate([edges_px, diagonals_px.reshape(len(rig), -1, 2)], axis=1)
    rays, error_px = jax.device_get(_through_lens(rig.cameras, jnp.asarray(pixels, float)))
    fields_deg = np.rad2deg(np.arccos(np.clip(rays[:, :2, 2], -1, 1)).sum(axis=1))
    good = (error_px[:, 2:] < _LENS_PX).reshape(len(rig), _PIXELS_ALONG, 4)
    reach = np.cumprod(good, axis=1).sum(axis=1).min(axis=1) / _PIXELS_ALONG
    for name, size_px, center, focal, field_deg, part in zip(
        rig.names, sizes_px, centers_px, focals_px, fields_deg, reach, strict=True
    ):
        off = np.abs(center - (size_px - 1) / 2) / size_px
        figures = {
            "camera": name, "x_px": center[0], "y_px": center[1], "fx": focal[0], "fy": focal[1],
            "field_deg": field_deg, "width": round(size_px[0]), "height": round(size_px[1]),
            "calibrated_width": 2 * center[0] + 1, "calibrated_height": 2 * center[1] + 1,
        }  # fmt: skip
        if off.max() > _MAX_OFF_CENTER:
            outside = bool(np.any((center < 0) | (center > size_px - 1)))
            yield found("rig.off_center", "error" if outside else None, **figures)
        if max(focal) > _MAX_ASPECT * min(focal):
            yield found("rig.aspect", **figures)
        if not _FIELD_DEG[0] < field_deg < _FIELD_DEG[1]:
            yield found("rig.field", **figures)
        elif off.max() <= _MAX_OFF_CENTER:
            yield found("rig.lens", **figures)
        if part < 1:
            yield found("rig.folds", "error" if part < 0.5 else None, camera=name, reach=part)
    if np.all(reach == 1):
        yield found("rig.unfolded")


@jax.jit
def _through_lens(
    cameras: Camera, pixels: Float[jax.Array, "C N 2"]
) -> tuple[Float[jax.Array, "C N 3"], Float[jax.Array, "C N"]]:
    """Unit rays of pixels, and how far from its pixel the lens model projects each, px."""

    def one(camera: Camera, pixels: jax.Array) -> tuple[jax.Array, jax.Array]:
        rays = camera.unproject(pixels)
        return rays, jnp.linalg.norm(camera.project(rays) - pixels, axis=-1)

    return jax.vmap(one)(cameras, pixels)


def bearings(rig: CameraRig) -> Iterator[Finding]:
    """Report the bearings on the horizon at which a far marker is seen by no or by two cameras."""
    radians = np.deg2rad(np.arange(360))
    horizon = np.stack([np.cos(radians), np.sin(radians), np.zeros(360)], axis=1)
    count = np.asarray(_sees_directions(rig, jnp.asarray(horizon, float))).sum(axis=0)
    if count.all():
        yield found("rig.all_round", twice=int((count > 1).sum()))
        return
    blind = listed(f"{begin} to {end} deg" for begin, end in spans(count == 0))
    level = None if count.any() else "error"
    yield found("rig.blind", level, bearings=blind, count=int((count == 0).sum()))


@jax.jit
def _sees_directions(
    rig: CameraRig, directions_vehicle: Float[jax.Array, "N 3"]
) -> Bool[jax.Array, "C N"]:
    """Which cameras see far objects in unit directions of the vehicle."""
    there, far_m = jaxlie.SE3.identity(), _FAR_M * directions_vehicle

    def again(camera: Camera, T_camera_vehicle: jaxlie.SE3, pixels: jax.Array) -> jax.Array:
        rays = jax.vmap(T_camera_vehicle.rotation().apply)(directions_vehicle)
        return jnp.linalg.norm(camera.unproject(pixels) - rays, axis=-1) < _SAME_RAY

    # A lens that folds sends rays from far outside into the image again.
    same = jax.vmap(again)(rig.cameras, rig.Ts_camera_vehicle, rig.project(there, far_m))
    return rig.sees(there, far_m) & same


def spans(bearings: Bool[np.ndarray, " 360"]) -> list[tuple[int, int]]:
    """Runs of True on the circle: the first and last whole degree of each, in (-180, 180]."""
    if bearings.all():
        return [(-179, 180)]
    begins = np.flatnonzero(bearings & ~np.roll(bearings, 1))
    ends = np.flatnonzero(bearings & ~np.roll(bearings, -1))
    if len(begins) and ends[0] < begins[0]:
        ends = np.roll(ends, -1)
    wrapped = (np.stack([begins, ends], axis=1) + 179) % 360 - 179
    return sorted((int(begin), int(end)) for begin, end in wrapped)


# --- markers -------------------------------------------------------------------------------


def placed(markers: MarkerMap) -> Iterator[Finding]:
    """Check where the markers are, which way up, and how large."""
    Rs_world_marker = np.asarray(markers.Ts_world_marker.as_matrix())[:, :3, :3]
    findings = list[Finding]()
    for marker_id, size, corners_m, R in zip(
        markers.ids, markers.size_m, np.asarray(markers.corners_world_m), Rs_world_marker,
        strict=True,
    ):  # fmt: skip
        marker, size_m, depth_m = f"marker {marker_id}", float(size), -corners_m[:, 2].min()
        x_up, y_up, normal_up = R[2]
        turned_deg = float(np.rad2deg(np.arctan2(x_up, y_up)))
        if size_m > _MOST_SIZE_M:
            findings.append(found("markers.huge", marker=marker, size_m=size_m))
        if depth_m > _UNDERGROUND * size_m:
            findings.append(found("markers.below", marker=marker, depth_m=depth_m))
        if abs(normal_up) < _UPRIGHT and abs(turned_deg) > _TURNED_DEG:
            quarters_deg = 90 * round(turned_deg / 90)
            findings.append(found("markers.turned", marker=marker, turned_deg=quarters_deg))
    families = listed(sorted(set(markers.families)))
    yield from findings or [found("markers.placed", count=len(markers.ids), families=families)]


# --- vehicle and route ---------------------------------------------------------------------


def turning_radius_m(vehicle: Vehicle | TwistBase) -> float:
    """The smallest turning radius, m, of the point midway between the axles; 0 on the spot."""
    if isinstance(vehicle, TwistBase):
        return 0.0
    return 1 / float(curvature_per_m(vehicle.steering_limit_rad, vehicle.wheelbase_m))


def vehicle_file(vehicle: Vehicle | TwistBase) -> Iterator[Finding]:
    """Check that the figures are those of a small vehicle, in the units that are meant."""
    findings = list[Finding]()
    for name, (least, most, meaning) in _FIGURES.items():
        value = float(getattr(vehicle, name, least))
        if not least <= value <= most:
            findings.append(found("vehicle.figure", name=name, value=value, meaning=meaning))
    if isinstance(vehicle, TwistBase):
        top_mps, turn_radps = float(vehicle.forward_limit_mps), float(vehicle.turn_limit_radps)
        fine = found("vehicle.base", top_mps=top_mps, turn_degps=math.degrees(turn_radps))
    else:
        limit, lock_rad = float(vehicle.throttle_limit), float(vehicle.steering_limit_rad)
        top_mps = limit * float(vehicle.speed_per_throttle_mps)
        if not _TOP_SPEED_MPS[0] <= top_mps <= _TOP_SPEED_MPS[1]:
            findings.append(found("vehicle.throttle", throttle_limit=limit, top_mps=top_mps))
        if lock_rad < _LEAST_STEERING_RAD:
            findings.append(found("vehicle.lock", value=lock_rad, degrees=math.degrees(lock_rad)))
        fine = found("vehicle.car", top_mps=top_mps, turning_radius_m=turning_radius_m(vehicle))
    yield from findings or [fine]


def route_file(route: Route, vehicle: Vehicle | TwistBase, markers: MarkerMap) -> Iterator[Finding]:
    """Check that the waypoints can be driven to, and that no marker stands in the way."""
    arrivals, (poses, length_m) = _arrivals(route), _along(route)
    radius_m, turn_m = route.waypoint_radius_m, turning_radius_m(vehicle)
    findings = list[Finding]()
    for number, (pose, target) in enumerate(zip(arrivals, arrivals[1:, :2], strict=False), 1):
        leg_m = float(np.linalg.norm(target - pose[:2]))
        left = np.array([-np.sin(pose[2]), np.cos(pose[2])])
        centers = pose[:2] + turn_m * np.array([left, -left])
        if leg_m <= radius_m:
            findings.append(found("route.reached", number=number, leg_m=leg_m, radius_m=radius_m))
        elif np.linalg.norm(target - centers, axis=1).min() < turn_m - radius_m:
            findings.append(found("route.circle", number=number, turn_m=turn_m))
    if radius_m < _LEAST_RADIUS_M:
        findings.append(found("route.radius", radius_m=radius_m))
    if route.leaves_at_m < (turns_m := 2 * turn_m + radius_m):
        findings.append(found("route.leaves", leave_m=route.leaves_at_m, turns_m=turns_m))
    centers_world_m = np.asarray(markers.Ts_world_marker.translation())
    apart_m = np.linalg.norm(poses[:, None, :2] - centers_world_m[:, :2], axis=-1)
    # One may drive over a marker on the floor.
    least_m = np.where(centers_world_m[:, 2] > 0.02, apart_m.min(axis=0), np.inf)
    if least_m.min() < _NEAR_M:
        marker = markers.ids[int(least_m.argmin())]
        findings.append(found("route.marker", marker=marker, apart_m=least_m.min()))
    figures: dict[str, Any] = {"least_m": apart_m.min(), "most_m": apart_m.min(axis=1).max()}
    free = found("route.free", count=len(route.waypoints_m), length_m=length_m, **figures)
    yield from findings or [free]


def sight_along(rig: CameraRig, markers: MarkerMap, route: Route) -> Iterator[Finding]:
    """Check which markers are seen, and how large, from start, waypoints and along the route."""
    arrivals, (poses, length_m) = _arrivals(route), _along(route)
    Ts_world_marker = np.asarray(markers.Ts_world_marker.as_matrix())
    centers_world_m, normals_xy = Ts_world_marker[:, :3, 3], Ts_world_marker[:, :2, 2]
    looked_from = np.concatenate([arrivals, poses])
    views = jax.device_get(_views(rig, markers, jnp.asarray(looked_from, float)))
    corners_px, inside, cameras_world_m = views
    apart_m = np.abs(centers_world_m[:, 2:] - cameras_world_m[0, :, 2]).min()
    if apart_m > _HIGH_M:
        yield found("sight.heights", apart_m=apart_m)
    # The side of a square of a marker's area in the image; 0 where it does not lie in it whole with
    # its printed side towards the camera.
    areas_px2 = double_area_px2(corners_px) / 2
    sides_px = np.sqrt(np.where(inside & (areas_px2 > 0), areas_px2, 0))
    if not sides_px.any():
        to_vehicle_m = looked_from[:, None, :2] - centers_world_m[:, :2]
        behind = np.einsum("pmi,mi->pm", to_vehicle_m, normals_xy) < 0
        yield found("sight.behind" if behind.all() else "sight.never", ids=listed(markers.ids))
        return
    for number in range(len(arrivals)):
        place = f"waypoint {number}" if number else "the start"
        camera, marker = np.unravel_index(int(sides_px[number].argmax()), sides_px.shape[1:])
        side_px = float(sides_px[number, camera, marker])
        if side_px == 0:
            yield found("sight.waypoint" if number else "sight.start", place=place)
            continue
        range_m = np.linalg.norm(cameras_world_m[number, camera] - centers_world_m[marker])
        view = (
            f"{place}: marker {markers.ids[int(marker)]} is {side_px:.0f} px wide in "
            f"{rig.names[int(camera)]}, at {range_m:.1f} m"
        )
        key = "sight.small" if side_px < READABLE_PX else "sight.view"
        yield found(key, view=view, range_m=range_m * side_px / READABLE_PX)
    readable: np.ndarray = np.any(sides_px[len(arrivals) :] >= READABLE_PX, axis=(1, 2))
    runs = "".join("x" if seen else "." for seen in readable).split("x")
    blind_m = max(map(len, runs)) * length_m / (_POSES_ALONG - 1)
    if blind_m > _LONG_BLIND_M:
        yield found("sight.blind", blind_m=blind_m, least_px=READABLE_PX)
    else:
        yield found("sight.along", share=readable.mean())


@jax.jit
def _views(
    rig: CameraRig, markers: MarkerMap, poses: Float[jax.Array, "P 3"]
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Corners (P, C, M, 4, 2) from planar poses, whether a marker's all lie in the image (P, C, M),
    and the cameras' places in the world (P, C, 3), m."""

    def one(pose: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        T_world_vehicle = T_world_vehicle_from_planar(pose)
        T_vehicle_world, corners_m = T_world_vehicle.inverse(), markers.corners_world_m
        inside = jnp.all(rig.sees(T_vehicle_world, corners_m), axis=-1)
        eyes_m = rig.Ts_camera_vehicle.inverse().translation()
        eyes_world_m = jax.vmap(T_world_vehicle.apply)(eyes_m)
        return rig.project(T_vehicle_world, corners_m), inside, eyes_world_m

    return jax.vmap(one)(poses)


def _along(route: Route) -> tuple[Float[np.ndarray, "N 3"], float]:
    """Poses (N, 3), evenly along straight lines through start and waypoints, and the length, m."""
    arrivals = _arrivals(route)
    legs_m = np.linalg.norm(np.diff(arrivals[:, :2], axis=0), axis=1)
    ends_m = np.append(0, np.cumsum(legs_m))
    at_m = np.linspace(0, ends_m[-1], _POSES_ALONG)
    leg = np.clip(np.searchsorted(ends_m, at_m, side="right"), 1, len(legs_m))
    xy = [np.interp(at_m, ends_m, arrivals[:, axis]) for axis in (0, 1)]
    return np.stack([*xy, arrivals[leg, 2]], axis=1), float(ends_m[-1])


def _arrivals(route: Route) -> Float[np.ndarray, "W+1 3"]:
    """Poses of the start, and of each waypoint with the heading of its leg."""
    places = np.array([route.start_pose[:2], *route.waypoints_m], float)
    legs = np.diff(places, axis=0)
    headings = [route.start_pose[2], *np.arctan2(legs[:, 1], legs[:, 0])]
    return np.column_stack([places, headings])
