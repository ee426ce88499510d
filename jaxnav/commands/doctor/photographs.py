"""Checks of the files by pictures of the standing car: `--frame CAMERA=IMAGE`.

Each marker alone tells whether its corners are in the print's order, and whether the car is then
level: the print is taken as true and the map is tested, its corners tried in every order in which a
person may have written them down. All markers at once tell whether sizes, places, lenses and
cameras agree.
"""

import math
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import UInt8

from jaxnav.commands.doctor.findings import Finding, error, listed, note, ok, warning
from jaxnav.commands.doctor.fits import (
    SIZE_SIGMA,
    FileErrors,
    Sighted,
    StandingFit,
    explained,
    fit,
    in_words,
    poses_by_each,
)
from jaxnav.commands.doctor.sight import area_px2
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.origin import Origin
from jaxnav.core.models.rig import CameraRig
from jaxnav.detection import Detections, make_detectors, observe
from jaxnav.files import Route

_MOST_MARKERS = 6  # the largest ones, which are compared
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
_POSE_NUMBERS = 6

_FITS = 2.0  # chi-square for each number, up to which all is well
_SMALL_PX = 0.3  # an RMS this small is no error of a file either
_LEAST_SIZE = 0.03  # a smaller error of a size is not reported
_CLEARLY = 2.0  # sigma


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
    wrong = list(usable(rig, images))
    yield from wrong
    if wrong:
        return
    detections = _detections(rig, markers, images)
    yield from identities(rig, markers, detections)
    seen = Sighted.of(rig, markers, observe(detections, markers), _MOST_MARKERS)
    if not seen.visible.any():
        return
    seen, poses, findings = in_their_order(seen, route)
    yield from findings
    yield from together(seen, poses, route)


def usable(
    rig: CameraRig, images: Mapping[str, UInt8[np.ndarray, "rows columns ..."]]
) -> Iterator[Finding]:
    """Report pictures of another size than their camera was calibrated at."""
    for name, image in images.items():
        width_px, height_px = rig.image_sizes_px[rig.names.index(name)]
        if image.shape[:2] != (height_px, width_px):
            yield error(
                f"{name}: {image.shape[1]} x {image.shape[0]} px, the rig says "
                f"{width_px} x {height_px}",
                "take it at the size that the camera was calibrated at",
            )


def _detections(
    rig: CameraRig, markers: MarkerMap, images: Mapping[str, np.ndarray]
) -> list[Detections]:
    """Detections of the map's families for each camera; none where it has no picture."""
    detectors = make_detectors(markers)
    return [
        Detections.concatenate(
            [
                detector.detect(images[name], rig.camera(index))
                for detector in detectors
                if name in images
            ]
        )
        for index, name in enumerate(rig.names)
    ]


def identities(
    rig: CameraRig, markers: MarkerMap, detections: Sequence[Detections]
) -> Iterator[Finding]:
    """Report which markers are in view, of the map and others."""
    known, foreign, twice = [], [], []
    for name, one in zip(rig.names, detections, strict=True):
        keys = list(zip(one.ids.tolist(), one.families, strict=True))
        counts = Counter(keys)
        for key, corners_px in zip(keys, one.corners_px, strict=True):
            if markers.index(*key) is None:
                foreign.append(f"{key[0]} of {key[1]} in {name}")
            elif counts[key] > 1:
                twice.append(f"{key[0]} in {name}")
            else:
                known.append(f"{key[0]} in {name} ({np.sqrt(np.abs(area_px2(corners_px))):.0f} px)")
    if foreign:
        yield note(
            f"markers that are not in the map: {listed(foreign)}",
            "add them to the map, or check the ids that are written there",
        )
    if twice:
        yield warning(
            f"seen twice in one picture: {listed(sorted(set(twice)))}",
            "each marker may hang in one place only: print another id; a mirror shows copies too",
        )
    if known:
        yield ok(f"markers of the map: {listed(known)}")
    else:
        yield warning(
            f"no marker of the map ({listed(markers.ids)} of "
            f"{listed(sorted(set(markers.families)))}) is found",
            "wrong id or family in the map? Too small, too dark, blurred, or without a white "
            f"margin? It should be {_LEAST_PX:.0f} px wide and more",
        )


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
            findings.append(_levelled(name, pose))
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
    return error(
        f"{name}: the corners are {problem}: the first one in the map is the printed "
        f"{_CORNERS[order[0]]}; in the printed order the car stands level "
        f"(tilt {_tilt_deg(pose):.0f} deg)",
        f"write its corners_world_m in the order of the present entries {right}; or turn its "
        "T_world_marker",
    )


def _levelled(name: str, pose: StandingFit) -> Finding:
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
        return (error if tilt_deg > _FALLEN_DEG else warning)(
            text,
            "measure again: the camera's height, elevation_deg and roll_deg; the marker's corners",
        )
    return ok(text)


def _square(name: str, alone: Sighted, pose: StandingFit) -> Iterator[Finding]:
    """Warn where the corners fit no square at all."""
    free = (alone.numbers - _POSE_NUMBERS) / alone.numbers
    allowed_px = alone.allowed_px * float(np.sqrt(free))
    if pose.error_px > _MAX_ERROR * allowed_px:
        yield warning(
            f"{name}: its corners are {pose.error_px:.2f} px off those of any square, their "
            f"scatter allows {allowed_px:.2f}",
            "calibrate the lens again, glue the paper onto a board; several cameras: their places",
        )


def together(seen: Sighted, poses: Sequence[StandingFit], route: Route | None) -> Iterator[Finding]:
    """Report where the car stands, and which part of the files contradicts the rest.

    Args:
        seen: corners in the order of the print.
        poses: the pose by each marker alone.
    """
    starts = [_on_ground(pose) for pose in poses]
    whole = fit(seen, starts, FileErrors.of_pose(seen, level=True))
    if route is not None:
        yield _place(whole, route, seen.markers.origin_m)
    if len(seen.markers.ids) == 1:
        yield _size_alone(seen, starts)
        return
    text = (
        f"{len(seen.markers.ids)} markers together: corners are {whole.error_px:.2f} px off, "
        f"their scatter allows {seen.allowed_px:.2f}"
    )
    if whole.cost <= _FITS * seen.numbers or whole.error_px < _SMALL_PX:
        yield ok(text)
        return
    best = explained(seen, [*starts, _on_ground(whole)], whole)
    if not best:
        yield warning(
            f"{text}, and no single error explains it",
            "calibrate the lenses, then measure the cameras' places and the markers' corners again",
        )
        return
    ways = " or ".join(in_words(seen, each)[0] for each in best)
    yield error(f"{text}; {best[0].fit.error_px:.2f} if {ways}", in_words(seen, best[0])[1])


def _on_ground(pose: StandingFit) -> np.ndarray:
    return np.asarray(T_world_vehicle_from_planar(jnp.asarray(pose.planar, float)).wxyz_xyz)


def _place(whole: StandingFit, route: Route, origin_m: Origin) -> Finding:
    x_m, y_m, psi_rad = whole.planar
    start = route.start_pose
    apart_m = math.hypot(x_m - start[0], y_m - start[1])
    turn_deg = math.degrees((psi_rad - start[2] + math.pi) % (2 * math.pi) - math.pi)
    return ok(
        f"the car stands at x {origin_m[0] + x_m:.2f} m, y {origin_m[1] + y_m:.2f} m, "
        f"psi {round(math.degrees(psi_rad))} deg: "
        f"{apart_m:.2f} m and {round(turn_deg):+d} deg from the route's start"
    )


def _size_alone(seen: Sighted, starts: Sequence[np.ndarray]) -> Finding:
    """Check the size of a single marker: its height over the camera tells its distance, so size."""
    size = FileErrors.of_pose(seen, level=True, size=np.full(1, SIZE_SIGMA))
    standing_fit = fit(seen, starts, size)
    logarithm, sigma = float(standing_fit.value.size[0]), float(standing_fit.sigma.size[0])
    factor, written_m = math.exp(logarithm), float(seen.markers.size_m[0])
    text = f"marker {seen.markers.ids[0]} is {factor:.2f} (+- {sigma:.2f}) of its size in the map"
    if abs(logarithm) > max(_CLEARLY * sigma, _LEAST_SIZE):
        return warning(
            f"{text}, if the camera's height and elevation are right",
            f"measure its black square: is it {written_m * factor:.4f} m instead of "
            f"{written_m:.4f}?",
        )
    return ok(text)
