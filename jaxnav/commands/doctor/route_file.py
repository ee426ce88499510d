"""Checks of vehicle and route: do they fit each other, and are markers seen along the route?"""

import math
from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.doctor.findings import Finding, found, listed
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle, curvature_per_m
from jaxnav.detection.observe import double_area_px2
from jaxnav.files import Route

READABLE_PX = 12.0  # a marker this wide is read in every second picture of a car at rest
_ALONG = 48  # poses along the route from which views are computed
_LONG_BLIND_M = 1.0  # farther than this the odometer should not be trusted alone
_NEAR_M = 0.25  # the car is about that wide
_HIGH_M = 1.5
_LEAST_STEERING_RAD = 0.1
_LEAST_RADIUS_M = 0.05  # the estimate's own error is about that
_TOP_SPEED_MPS = (0.1, 5.0)
# What a small vehicle's figures lie between, and what they mean.
_LAG = 0.02, 2.0, "it is the time in s until 63 % of a commanded speed is reached"
_FIGURES = {
    "speed_time_constant_s": _LAG,
    "time_constant_s": _LAG,
    "wheelbase_m": (0.05, 4.0, "it is the distance between the axles in m"),
    "forward_limit_mps": (*_TOP_SPEED_MPS, "it is the largest speed in m/s that is commanded"),
    "turn_limit_radps": (
        0.2,
        20.0,
        "it is the largest turn rate in rad/s that is commanded: a turn in a second is 6.28",
    ),
}


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
    poses, length_m = along(route)
    radius_m, turn_m = route.waypoint_radius_m, turning_radius_m(vehicle)
    findings = list[Finding]()
    arrivals = _arrivals(route)
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
    yield from findings or [
        found(
            "route.free",
            count=len(route.waypoints_m),
            length_m=length_m,
            least_m=apart_m.min(),
            most_m=apart_m.min(axis=1).max(),
        )
    ]


def sight_along(rig: CameraRig, markers: MarkerMap, route: Route) -> Iterator[Finding]:
    """Check which markers are seen, and how large, from start, waypoints and along the route."""
    poses, length_m = along(route)
    arrivals = _arrivals(route)
    Ts_world_marker = np.asarray(markers.Ts_world_marker.as_matrix())
    centers_world_m, normals_xy = Ts_world_marker[:, :3, 3], Ts_world_marker[:, :2, 2]
    apart_m = np.abs(centers_world_m[:, 2:] - Ts_vehicle_camera(rig)[:, 2, 3]).min()
    if apart_m > _HIGH_M:
        yield found("sight.heights", apart_m=apart_m)
    looked_from = np.concatenate([arrivals, poses])
    sides_px, cameras_world_m = _views(rig, markers, looked_from)
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
    blind_m = max(map(len, runs)) * length_m / (_ALONG - 1)
    if blind_m > _LONG_BLIND_M:
        yield found("sight.blind", blind_m=blind_m, least_px=READABLE_PX)
    else:
        yield found("sight.along", share=readable.mean())


def _views(
    rig: CameraRig, markers: MarkerMap, poses: Float[np.ndarray, "P 3"]
) -> tuple[Float[np.ndarray, "P C M"], Float[np.ndarray, "P C 3"]]:
    """Views of every marker in every camera from planar poses.

    Returns:
        The side of a square of each marker's area in the image, px, 0 where the marker does not lie
        in the image whole with its printed side towards the camera; and the cameras' places, m.
    """
    corners_px, inside, Ts = jax.device_get(_corners(rig, markers, jnp.asarray(poses, float)))
    areas_px2 = double_area_px2(corners_px) / 2
    places_m = np.einsum("pij,cj->pci", Ts, Ts_vehicle_camera(rig)[:, :, 3])[..., :3]
    return np.sqrt(np.where(inside & (areas_px2 > 0), areas_px2, 0)), places_m


@jax.jit
def _corners(
    rig: CameraRig, markers: MarkerMap, poses: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    def one(pose: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        T_world_vehicle = T_world_vehicle_from_planar(pose)
        T_vehicle_world, corners_m = T_world_vehicle.inverse(), markers.corners_world_m
        inside = jnp.all(rig.sees(T_vehicle_world, corners_m), axis=-1)
        return rig.project(T_vehicle_world, corners_m), inside, T_world_vehicle.as_matrix()

    return jax.vmap(one)(poses)


def along(route: Route) -> tuple[Float[np.ndarray, "N 3"], float]:
    """Poses (N, 3), evenly along straight lines through start and waypoints, and the length, m."""
    arrivals = _arrivals(route)
    legs_m = np.linalg.norm(np.diff(arrivals[:, :2], axis=0), axis=1)
    ends_m = np.append(0, np.cumsum(legs_m))
    at_m = np.linspace(0, ends_m[-1], _ALONG)
    leg = np.clip(np.searchsorted(ends_m, at_m, side="right"), 1, len(legs_m))
    xy = [np.interp(at_m, ends_m, arrivals[:, axis]) for axis in (0, 1)]
    return np.stack([*xy, arrivals[leg, 2]], axis=1), float(ends_m[-1])


def _arrivals(route: Route) -> Float[np.ndarray, "W+1 3"]:
    """Poses of the start, and of each waypoint with the heading of its leg."""
    places = np.array([route.start_pose[:2], *route.waypoints_m], float)
    legs = np.diff(places, axis=0)
    headings = [route.start_pose[2], *np.arctan2(legs[:, 1], legs[:, 0])]
    return np.column_stack([places, headings])
