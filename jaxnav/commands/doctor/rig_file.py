"""Checks of the rig file: are places, directions and lenses of its cameras plausible?"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from jaxnav.calibrate.rig.views import Ts_vehicle_camera
from jaxnav.commands.doctor.findings import Finding, error, listed, note, ok, warning
from jaxnav.commands.doctor.sight import sees_directions, through_lens
from jaxnav.core.models.rig import CameraRig
from jaxnav.files.reading import read_mapping

_LEAST_HEIGHT_M, _MOST_HEIGHT_M = 0.01, 2.5
_MOST_DISTANCE_M = 4.0  # from the middle of the vehicle: a van
_SAME_PLACE_M, _SAME_DIRECTION = 0.02, np.cos(np.deg2rad(5))
_MAX_OFF_CENTER = 0.1  # of the image's size
_MAX_ASPECT = 1.05  # fx : fy; pixels are squares
_FIELD_DEG = (20.0, 220.0)  # of lenses that see markers from a vehicle
_LENS_PX = 0.5  # a ray that lands farther than this from its pixel belongs to another one
_ALONG = 64  # pixels from the centre to each corner of the image
_ROUNDED = 2e-4  # a hundredth of a degree
_DEGREES = np.arange(360)


def rig_file(path: Path, rig: CameraRig) -> Iterator[Finding]:
    """Run all checks of a rig that was loaded from a file."""
    yield ok(f"{len(rig)} cameras: {listed(rig.names)}")
    yield from rotations(path)
    yield from places(rig)
    yield from intrinsics(rig)
    yield from lenses(rig)
    yield from bearings(rig)


def rotations(path: Path) -> Iterator[Finding]:
    """Check how far the file's matrices are from rotations; the loader refuses worse ones."""
    worst, where = 0.0, ""
    for key, T in _matrices(read_mapping(path), ""):
        R = np.asarray(T, float)[:3, :3]
        deviation = float(np.abs(R @ R.T - np.eye(3)).max())
        if deviation > worst:
            worst, where = deviation, key
    if worst > _ROUNDED:
        yield note(
            f"{where} is a rotation but for {worst:.1g}, {np.rad2deg(worst / 2):.2g} deg",
            "write its numbers with more digits",
        )
    else:
        yield ok("rotations are orthonormal")


def _matrices(data: Any, key: str) -> Iterator[tuple[str, Any]]:
    """Every 4x4 matrix in a file, with its key."""
    if isinstance(data, dict):
        for name, value in data.items():
            yield from _matrices(value, f"{key}.{name}".removeprefix("."))
    elif isinstance(data, list):
        if len(data) == 4 and all(isinstance(row, list) and len(row) == 4 for row in data):
            yield key, data
            return
        for index, value in enumerate(data):
            name = value.get("name", index) if isinstance(value, dict) else index
            yield from _matrices(value, f"{key}.{name}".removeprefix("."))


def places(rig: CameraRig) -> Iterator[Finding]:
    """Check where the cameras are and how they are turned."""
    T = Ts_vehicle_camera(rig)
    for name, position_m, R in zip(rig.names, T[:, :3, 3], T[:, :3, :3], strict=True):
        height_m, distance_m = position_m[2], np.hypot(*position_m[:2])
        if not _LEAST_HEIGHT_M < height_m < _MOST_HEIGHT_M:
            yield (error if height_m <= 0 else warning)(
                f"{name} is {height_m:.3g} m above the ground",
                "measure from the ground, in m; is T_vehicle_camera written where its inverse is "
                "meant?",
            )
        elif distance_m > _MOST_DISTANCE_M:
            yield warning(
                f"{name} is {distance_m:.3g} m from the middle of the vehicle",
                "position_m is in m, from the point midway between the axles",
            )
        else:
            elevation_deg = np.rad2deg(np.arcsin(np.clip(R[2, 2], -1, 1)))
            yield ok(
                f"{name} is {height_m:.3f} m above the ground, looks to "
                f"{round(np.rad2deg(np.arctan2(R[1, 2], R[0, 2])))} deg, "
                f"{round(elevation_deg):+d} up"
            )
        if R[2, 1] > 0:
            yield warning(
                f"{name} is mounted upside down",
                "if it is not: the camera's y axis points down (x right, y down, z forward)",
            )
    for i in range(len(rig)):
        for j in range(i):
            near = np.linalg.norm(T[i, :3, 3] - T[j, :3, 3]) < _SAME_PLACE_M
            if near and T[i, :3, 2] @ T[j, :3, 2] > _SAME_DIRECTION:
                yield warning(
                    f"{rig.names[j]} and {rig.names[i]} look the same way from the same place",
                    "was an entry copied? Correct its yaw_deg and position_m",
                )


def intrinsics(rig: CameraRig) -> Iterator[Finding]:
    """Check principal points and focal lengths against the size of the images."""
    sizes_px = np.array(rig.image_sizes_px, float)
    centers_px, focals_px = np.asarray(rig.cameras.center_px), np.asarray(rig.cameras.focal_px)
    middle_px = (sizes_px - 1) / 2
    edges_px = np.stack(
        [
            np.stack([np.zeros(len(rig)), centers_px[:, 1]], axis=1),
            np.stack([sizes_px[:, 0] - 1, centers_px[:, 1]], axis=1),
        ],
        axis=1,
    )
    rays, _ = through_lens(rig, edges_px)
    fields_deg = np.rad2deg(np.arccos(np.clip(rays[..., 2], -1, 1)).sum(axis=1))
    for index, name in enumerate(rig.names):
        size, center, focal = sizes_px[index], centers_px[index], focals_px[index]
        off = np.abs(center - middle_px[index]) / size
        shown = f"{name}: center_px ({center[0]:.0f}, {center[1]:.0f})"
        if off.max() > _MAX_OFF_CENTER:
            outside = bool(np.any((center < 0) | (center > size - 1)))
            yield (error if outside else warning)(
                f"{shown} is far from the middle of {size[0]:.0f} x {size[1]:.0f} px",
                f"was it calibrated at {2 * center[0] + 1:.0f} x {2 * center[1] + 1:.0f} px? Then "
                "calibrate at the size that the car uses",
            )
        if max(focal) > _MAX_ASPECT * min(focal):
            yield warning(
                f"{name}: fx {focal[0]:.0f} and fy {focal[1]:.0f} px differ",
                "pixels are nearly always squares: calibrate again, the board all over the image",
            )
        if not _FIELD_DEG[0] < fields_deg[index] < _FIELD_DEG[1]:
            yield warning(
                f"{name}: focal_px {focal[0]:.0f} sees {fields_deg[index]:.3g} deg of the horizon",
                "focal_px is in px of the images that the car uses, not in mm",
            )
        elif off.max() <= _MAX_OFF_CENTER:
            yield ok(f"{shown}, {fields_deg[index]:.0f} deg from left to right")


def lenses(rig: CameraRig) -> Iterator[Finding]:
    """Check that every pixel belongs to one ray: lens models may fold back before the corners."""
    sizes_px = np.array(rig.image_sizes_px, float)
    corners_px = (sizes_px - 1)[:, None] * np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    centers_px = np.asarray(rig.cameras.center_px)[:, None]
    share = np.arange(1, _ALONG + 1) / _ALONG
    pixels = centers_px[:, None] + share[None, :, None, None] * (corners_px - centers_px)[:, None]
    _, error_px = through_lens(rig, pixels.reshape(len(rig), -1, 2))
    good = (error_px < _LENS_PX).reshape(len(rig), _ALONG, 4)
    reach = np.cumprod(good, axis=1).sum(axis=1).min(axis=1) / _ALONG
    for name, part in zip(rig.names, reach, strict=True):
        if part == 1:
            continue
        yield (error if part < 0.5 else warning)(
            f"{name}: the lens model can be inverted up to {part:.0%} of the way to the corners "
            "of the image only: it folds there",
            "calibrate with the board in the corners too, or with the other lens model",
        )
    if np.all(reach == 1):
        yield ok("lens models can be inverted in the whole image")


def bearings(rig: CameraRig) -> Iterator[Finding]:
    """Report the bearings on the horizon at which a far marker is seen by no or by two cameras."""
    radians = np.deg2rad(_DEGREES)
    horizon = np.stack([np.cos(radians), np.sin(radians), np.zeros(len(radians))], axis=1)
    count = sees_directions(rig, horizon).sum(axis=0)
    blind = spans(count == 0)
    twice = int((count > 1).sum())
    if not blind:
        yield ok(f"all bearings are seen, {twice} of 360 deg by two and more")
        return
    shown = listed(f"{begin} to {end} deg" for begin, end in blind)
    yield (note if (count > 0).any() else error)(
        f"no camera sees {shown} (0 forward, 90 left), {int((count == 0).sum())} of 360 deg",
        "a marker there is not seen: plan the route so, or turn a camera",
    )


def spans(bearings: Bool[np.ndarray, " 360"]) -> list[tuple[int, int]]:
    """Runs of True on the circle: the first and last whole degree of each, in (-180, 180].

    Args:
        bearings: (360,) bool, one for each degree from 0 on.
    """
    if bearings.all():
        return [(-179, 180)]
    begins = np.flatnonzero(bearings & ~np.roll(bearings, 1))
    ends = np.flatnonzero(bearings & ~np.roll(bearings, -1))
    if len(begins) and ends[0] < begins[0]:
        ends = np.roll(ends, -1)
    wrapped = [
        ((int(b) + 179) % 360 - 179, (int(e) + 179) % 360 - 179)
        for b, e in zip(begins, ends, strict=True)
    ]
    return sorted(wrapped)
