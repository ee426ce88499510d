"""Checks of each marker alone: are its corners in the print's order, and is the car then level?

The print is taken as true and the map is tested: the corners are tried in every order in which a
person may have written them down.
"""

from collections.abc import Iterator

import numpy as np

from jaxnav.commands.doctor.findings import Finding
from jaxnav.commands.doctor.fits import FileErrors, Sighted, StandingFit, fit, poses_by_each
from jaxnav.files import Route
from jaxnav.models.markers import MarkerMap

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
_POSE_NUMBERS = 6


def in_their_order(
    seen: Sighted, route: Route | None
) -> tuple[Sighted, list[StandingFit], list[Finding]]:
    """Find the order of each marker's corners, and the pose of the car by that marker alone.

    Args:
        route: tells on which side of a marker the car may be.

    Returns:
        The sightings with corners as the map should have them, a pose by each marker alone, and
        the findings.
    """
    poses, findings = [], []
    for index in np.flatnonzero(seen.visible.any(axis=0)).tolist():
        pose, order = _best_order(seen, index, route)
        seen = seen.reordered(index, order)
        poses.append(pose)
        name = f"marker {seen.markers.ids[index]}"
        if order == TURNED[0]:
            findings.append(_on_ground(name, pose))
        else:
            findings.append(_wrong_order(name, order, pose))
        findings.extend(_square(name, seen.only(index), pose))
    return seen, poses, findings


def standing(seen: Sighted) -> StandingFit:
    """The most level pose, anywhere in space, among those that explain the corners."""
    anywhere = FileErrors.of_pose(seen, level=False)
    fits = [fit(seen, [start], anywhere) for start in poses_by_each(seen)]
    least = min(each.cost for each in fits)
    return min(
        (each for each in fits if each.cost <= least + _MAX_WORSE), key=lambda each: each.tilt_rad
    )


def _best_order(
    seen: Sighted, index: int, route: Route | None
) -> tuple[StandingFit, tuple[int, ...]]:
    """The pose and the corner order that leave the car level; the map's own order where it does."""
    alone = seen.only(index)
    behind = route is not None and _is_behind(seen.markers, index, route)
    as_written = standing(alone)
    if _tilt_deg(as_written) < _FALLEN_DEG and not behind:
        return as_written, TURNED[0]
    # From the car's pose alone, turned and mirrored can't be told apart.
    tried = [
        (standing(alone.reordered(index, order)), order)
        for order in (MIRRORED if behind else TURNED)
    ]
    pose, order = min(tried, key=lambda pair: pair[0].tilt_rad)
    return (pose, order) if _tilt_deg(pose) < _STANDS_DEG else (as_written, TURNED[0])


def _tilt_deg(pose: StandingFit) -> float:
    return float(np.rad2deg(pose.tilt_rad))


def _is_behind(markers: MarkerMap, index: int, route: Route) -> bool:
    """Whether start and all waypoints lie on the unprinted side of a marker."""
    T = np.asarray(markers.Ts_world_marker.as_matrix())[index]
    places_m = np.array([route.start_pose[:2], *route.waypoints_m])
    return bool(np.all((places_m - T[:2, 3]) @ T[:2, 2] < 0))


def _wrong_order(name: str, order: tuple[int, ...], pose: StandingFit) -> Finding:
    # Entry order.index(j) of the map is corner j of the print.
    right = " ".join(str(order.index(corner) + 1) for corner in range(4))
    if order in TURNED:
        problem = f"turned by {90 * order[0]} deg"
    else:
        problem = "counted the wrong way round, as if seen from behind"
    return Finding(
        "picture",
        "error",
        f"{name}: the corners are {problem}: the first one in the map is the printed "
        f"{_CORNERS[order[0]]}; in the printed order the car stands level "
        f"(tilt {_tilt_deg(pose):.0f} deg)",
        f"write its corners_world_m in the order of the present entries {right}; or turn its "
        "T_world_marker",
    )


def _on_ground(name: str, pose: StandingFit) -> Finding:
    R_world_vehicle = pose.T_world_vehicle[:3, :3]
    height_m, tilt_deg = float(pose.T_world_vehicle[2, 3]), _tilt_deg(pose)
    variance_m2 = R_world_vehicle[2] @ pose.pose_covariance[:3, :3] @ R_world_vehicle[2]
    height_sigma_m = float(np.sqrt(variance_m2))
    tilt_sigma_deg = float(np.rad2deg(np.sqrt(np.trace(pose.pose_covariance[3:5, 3:5]))))
    text = (
        f"{name} alone: the car is {height_m * 100:+.1f} cm (+- {height_sigma_m * 100:.1f}) above "
        f"the ground, tilted by {tilt_deg:.1f} deg (+- {tilt_sigma_deg:.1f})"
    )
    high = abs(height_m) > _MOST_HEIGHT_M + 3 * height_sigma_m
    if high or tilt_deg > _MOST_TILT_DEG + 3 * tilt_sigma_deg:
        return Finding(
            "picture",
            "error" if tilt_deg > _FALLEN_DEG else "warning",
            text,
            "measure again: the camera's height, elevation_deg and roll_deg; the marker's corners",
        )
    return Finding("picture", "ok", text)


def _square(name: str, alone: Sighted, pose: StandingFit) -> Iterator[Finding]:
    """Warn where the corners fit no square at all."""
    free = (alone.numbers - _POSE_NUMBERS) / alone.numbers
    allowed_px = alone.allowed_px * float(np.sqrt(free))
    if pose.error_px > _MAX_ERROR * allowed_px:
        yield Finding(
            "picture",
            "warning",
            f"{name}: its corners are {pose.error_px:.2f} px off those of any square, their "
            f"scatter allows {allowed_px:.2f}",
            "calibrate the lens again, glue the paper onto a board; several cameras: their places",
        )
