"""Checks of vehicle and route: do they fit each other, and are markers seen along the route?"""

import math
from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Float

from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.doctor.findings import Finding, error, listed, note, ok, warning
from jaxnav.commands.doctor.sight import PoseViews, views
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle, curvature_per_m
from jaxnav.files import Route

READABLE_PX = 12.0  # a marker this wide is read in every second picture of a car at rest
_ALONG = 48  # poses along the route from which views are computed
_LONG_BLIND_M = 1.0  # farther than this the odometer should not be trusted alone
_NEAR_M = 0.25  # the car is about that wide
_HIGH_M = 1.5
_TOP_SPEED_MPS = (0.1, 5.0)
_TIME_CONSTANT_S = (0.02, 2.0)
_WHEELBASE_M = (0.05, 4.0)
_TURN_RADPS = (0.2, 20.0)
_LEAST_STEERING_RAD = 0.1
_LEAST_RADIUS_M = 0.05  # the estimate's own error is about that


def turning_radius_m(vehicle: Vehicle | TwistBase) -> float:
    """The smallest turning radius, m, of the point midway between the axles; 0 on the spot."""
    if isinstance(vehicle, TwistBase):
        return 0.0
    return 1 / float(curvature_per_m(vehicle.steering_limit_rad, vehicle.wheelbase_m))


def vehicle_file(vehicle: Vehicle | TwistBase) -> Iterator[Finding]:
    """Check that the figures are those of a small vehicle, in the units that are meant."""
    if isinstance(vehicle, TwistBase):
        yield from _base_file(vehicle)
        return
    top_mps = float(vehicle.throttle_limit * vehicle.speed_per_throttle_mps)
    limit_rad, wheelbase_m = float(vehicle.steering_limit_rad), float(vehicle.wheelbase_m)
    lag_s = float(vehicle.speed_time_constant_s)
    problems = [
        (
            not _TOP_SPEED_MPS[0] <= top_mps <= _TOP_SPEED_MPS[1],
            f"full throttle ({float(vehicle.throttle_limit):.3g}) is {top_mps:.3g} m/s",
            "time a straight drive at a small throttle: speed_per_throttle_mps is speed / throttle",
        ),
        (
            not _TIME_CONSTANT_S[0] <= lag_s <= _TIME_CONSTANT_S[1],
            f"speed_time_constant_s is {lag_s:.3g}",
            "it is the time in s until 63 % of the speed is reached",
        ),
        (
            not _WHEELBASE_M[0] <= wheelbase_m <= _WHEELBASE_M[1],
            f"wheelbase_m is {wheelbase_m:.3g}",
            "it is the distance between the axles in m",
        ),
        (
            limit_rad < _LEAST_STEERING_RAD,
            f"steering_limit_rad is {limit_rad:.3g}, {math.degrees(limit_rad):.2g} deg",
            "drive a circle at full lock: calib/README.md says how its radius gives the limit",
        ),
    ]
    good = f"{top_mps:.2g} m/s at full throttle, turns within {turning_radius_m(vehicle):.2f} m"
    yield from _judged(problems, good)


def _base_file(base: TwistBase) -> Iterator[Finding]:
    """The same of a base that is driven by a twist."""
    top_mps, turn_radps = float(base.forward_limit_mps), float(base.turn_limit_radps)
    lag_s = float(base.time_constant_s)
    problems = [
        (
            not _TOP_SPEED_MPS[0] <= top_mps <= _TOP_SPEED_MPS[1],
            f"forward_limit_mps is {top_mps:.3g}",
            "it is the largest speed in m/s that is commanded",
        ),
        (
            not _TURN_RADPS[0] <= turn_radps <= _TURN_RADPS[1],
            f"turn_limit_radps is {turn_radps:.3g}",
            "it is the largest turn rate in rad/s that is commanded: a turn in a second is 6.28",
        ),
        (
            not _TIME_CONSTANT_S[0] <= lag_s <= _TIME_CONSTANT_S[1],
            f"time_constant_s is {lag_s:.3g}",
            "it is the time in s until 63 % of a commanded speed is reached",
        ),
    ]
    good = f"{top_mps:.2g} m/s and {math.degrees(turn_radps):.0f} deg/s at most"
    yield from _judged(problems, good)


def _judged(problems: Sequence[tuple[bool, str, str]], good: str) -> Iterator[Finding]:
    """A warning for each figure that is wrong, with what to do; else what is good."""
    for wrong, what, do in problems:
        if wrong:
            yield warning(what, do)
    if not any(wrong for wrong, _, _ in problems):
        yield ok(good)


def route_file(route: Route, vehicle: Vehicle | TwistBase, markers: MarkerMap) -> Iterator[Finding]:
    """Check that the waypoints can be driven to, and that no marker stands in the way."""
    poses, length_m = along(route)
    radius_m, turn_m = route.waypoint_radius_m, turning_radius_m(vehicle)
    places = np.array([route.start_pose[:2], *route.waypoints_m])
    legs_m = np.linalg.norm(np.diff(places, axis=0), axis=1)
    good = True
    for number, pose in enumerate(_arrivals(route)[:-1], 1):
        leg_m, target = legs_m[number - 1], np.array(route.waypoints_m[number - 1])
        if leg_m <= radius_m:
            good = False
            yield warning(
                f"waypoint {number} is {leg_m:.2f} m from the place before: reached at once",
                f"waypoints are apart by more than waypoint_radius_m ({radius_m:g} m)",
            )
            continue
        left = np.array([-np.sin(pose[2]), np.cos(pose[2])])
        centers = pose[:2] + turn_m * np.array([left, -left])
        if np.linalg.norm(target - centers, axis=1).min() < turn_m - radius_m:
            good = False
            yield note(
                f"waypoint {number} lies inside the smallest circle ({turn_m:.2f} m) of a car "
                "that comes from the place before: it drives straight on first, then a loop",
                "move the waypoint, or add one that leads there",
            )
    if radius_m < _LEAST_RADIUS_M:
        good = False
        yield warning(
            f"waypoint_radius_m is {radius_m:g}: the car may pass by and turn round",
            "0.1 to 0.2 m suits a small car",
        )
    if route.leaves_at_m < (turns_m := 2 * turn_m + radius_m):
        good = False
        yield warning(
            f"leave_m is {route.leaves_at_m:g}: a car that turns round stops",
            f"its smallest circle takes {turns_m:.2f} m",
        )
    centers_world_m = np.asarray(markers.Ts_world_marker.translation())
    apart_m = np.linalg.norm(poses[:, None, :2] - centers_world_m[:, :2], axis=-1)
    low = centers_world_m[:, 2] > 0.02  # not on the floor, where one may drive over it
    if low.any() and apart_m[:, low].min() < _NEAR_M:
        marker = markers.ids[int(np.flatnonzero(low)[apart_m[:, low].min(axis=0).argmin()])]
        good = False
        yield warning(
            f"the route leads past marker {marker} at {apart_m[:, low].min():.2f} m",
            "the car would hit it: move the waypoints",
        )
    if good:
        yield ok(
            f"{len(route.waypoints_m)} waypoints, {length_m:.1f} m, "
            f"{apart_m.min():.1f} to {apart_m.min(axis=1).max():.1f} m from the nearest marker"
        )


def sight_along(rig: CameraRig, markers: MarkerMap, route: Route) -> Iterator[Finding]:
    """Check which markers are seen, and how large, from start, waypoints and along the route."""
    poses, length_m = along(route)
    arrivals = _arrivals(route)
    seen = views(rig, markers, np.concatenate([arrivals, poses]))
    heights_m = np.asarray(markers.Ts_world_marker.translation())[:, 2]
    apart_m = np.abs(heights_m[:, None] - Ts_vehicle_camera(rig)[:, 2, 3]).min(axis=1)
    if apart_m.min() > _HIGH_M:
        yield warning(
            f"all markers are {apart_m.min():.1f} m and more above or below the cameras",
            "heights are measured from the floor, in m, in both files",
        )
    if not seen.side_px.any():
        yield _never_seen(seen, markers)
        return
    for number in range(len(arrivals)):
        yield _from_place(rig, markers, seen, number)
    readable: np.ndarray = np.any(seen.side_px[len(arrivals) :] >= READABLE_PX, axis=(1, 2))
    blind_m = _longest(~readable) * length_m / (_ALONG - 1)
    if blind_m > _LONG_BLIND_M:
        yield warning(
            f"along {blind_m:.1f} m of the route no marker is {READABLE_PX:.0f} px wide: "
            "the odometer alone counts",
            "add a marker there, print it larger, or move the route nearer",
        )
    else:
        yield ok(f"a readable marker is in view of {readable.mean():.0%} of the route")


def _never_seen(seen: PoseViews, markers: MarkerMap) -> Finding:
    if seen.behind.all():
        return error(
            "start and route lie behind all markers",
            "corners_world_m are clockwise as the reader sees them, beginning top-left: are they "
            "written as seen from behind?",
        )
    return error(
        f"no marker of {listed(markers.ids)} is seen from the start or along the route",
        "compare heights and directions of cameras and markers",
    )


def _from_place(rig: CameraRig, markers: MarkerMap, seen: PoseViews, number: int) -> Finding:
    """Report the best view from the start (number 0) or from a waypoint."""
    place = "the start" if number == 0 else f"waypoint {number}"
    sides_px = seen.side_px[number]
    camera, marker = np.unravel_index(int(sides_px.argmax()), sides_px.shape)
    side_px, range_m = float(sides_px[camera, marker]), seen.range_m[number, camera, marker]
    if side_px == 0:
        return (warning if number == 0 else note)(
            f"{place}: no marker is in view",
            "the car knows its place again when it sees one"
            if number
            else "turn the car, or add a marker: it can't begin before it has seen one",
        )
    text = (
        f"{place}: marker {markers.ids[int(marker)]} is {side_px:.0f} px wide in "
        f"{rig.names[int(camera)]}, at {range_m:.1f} m"
    )
    if side_px < READABLE_PX:
        return warning(
            f"{text}: it can be read from {range_m * side_px / READABLE_PX:.1f} m on",
            "begin nearer, or print it larger",
        )
    return ok(text)


def along(route: Route) -> tuple[Float[np.ndarray, "N 3"], float]:
    """Poses (N, 3), evenly along straight lines through start and waypoints, and the length, m."""
    places = np.array([route.start_pose[:2], *route.waypoints_m], float)
    legs = np.diff(places, axis=0)
    ends_m = np.append(0, np.cumsum(np.linalg.norm(legs, axis=1)))
    at_m = np.linspace(0, ends_m[-1], _ALONG)
    leg = np.clip(np.searchsorted(ends_m, at_m, side="right") - 1, 0, len(legs) - 1)
    xy = [np.interp(at_m, ends_m, places[:, axis]) for axis in (0, 1)]
    return np.stack([*xy, np.arctan2(legs[leg, 1], legs[leg, 0])], axis=1), float(ends_m[-1])


def _arrivals(route: Route) -> np.ndarray:
    """Poses (W + 1, 3) of the start, and of each waypoint with the heading of its leg."""
    places = np.array([route.start_pose[:2], *route.waypoints_m], float)
    legs = np.diff(places, axis=0)
    headings = [route.start_pose[2], *np.arctan2(legs[:, 1], legs[:, 0])]
    return np.column_stack([places, headings])


def _longest(flags: np.ndarray) -> int:
    """The length of the longest run of True."""
    longest = run = 0
    for flag in flags:
        run = run + 1 if flag else 0
        longest = max(longest, run)
    return longest
