"""Checks of the marker map: are its markers square, and do they hang or lie as markers do?

The file is read once more as it is: where the loader refuses a marker, these name the likely slip.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.commands.doctor.findings import Finding, error, listed, note, ok, warning
from jaxnav.core.models.markers import MarkerMap
from jaxnav.errors import BadInput
from jaxnav.files.reading import read_mapping

_MAX_ERROR = 0.01  # of a side: a careful tape's error
_UPRIGHT = 0.3  # the normal's vertical part, below which a marker hangs on a wall
_TURNED_RAD = np.deg2rad(45)
_MOST_SIZE_M = 2.0


def measured_corners(path: Path) -> Iterator[Finding]:
    """Check that measured corners make a flat square of the size that the file says."""
    checked = 0
    has_findings = False
    for index, entry in enumerate(_entries(path)):
        corners_m, size_m = _numbers(entry.get("corners_world_m")), entry.get("size_m")
        if corners_m is None or not isinstance(size_m, int | float) or not size_m > 0:
            continue
        checked += 1
        for finding in _square(f"marker {entry.get('id', index)}", corners_m, float(size_m)):
            has_findings = True
            yield finding
    if checked and not has_findings:
        yield ok(f"corners of {checked} are squares of their size within 1 %")


def _entries(path: Path) -> list[dict[str, Any]]:
    try:
        entries = read_mapping(path).get("markers")
    except BadInput:  # the loader reports it
        return []
    if not isinstance(entries, list):
        return []
    return [entry for entry in entries if isinstance(entry, dict)]


def _numbers(corners: Any) -> np.ndarray | None:
    """Corners as an array (4, 3); None where the file holds anything else."""
    try:
        array = np.array(corners, float)
    except (TypeError, ValueError):
        return None
    return array if array.shape == (4, 3) and np.isfinite(array).all() else None


def _square(name: str, corners_m: np.ndarray, size_m: float) -> Iterator[Finding]:
    sides_m = np.linalg.norm(np.roll(corners_m, -1, axis=0) - corners_m, axis=1)
    diagonals_m = np.linalg.norm(corners_m[:2] - corners_m[2:], axis=1)
    side_m = float(sides_m.mean())
    if sides_m.max() > 1.2 * sides_m.min() and diagonals_m.min() < 0.9 * sides_m.max():
        yield error(
            f"{name}: its corners make a bow tie, two of them are swapped",
            "corners_world_m are top-left, top-right, bottom-right, bottom-left, clockwise as the "
            "reader sees them",
        )
        return
    if abs(side_m / size_m - 1) > _MAX_ERROR:
        yield (error if abs(side_m / size_m - 1) > 3 * _MAX_ERROR else warning)(
            f"{name}: its corners are {side_m:.4f} m apart, size_m says {size_m:.4f} "
            f"({size_m / side_m - 1:+.1%})",
            "measure the black square from edge to edge, without the white paper, and its corners",
        )
    spread_m = sides_m.max() - sides_m.min()
    askew_m = abs(diagonals_m[0] - diagonals_m[1])
    if max(spread_m, askew_m) > 2 * _MAX_ERROR * side_m:
        yield warning(
            f"{name}: its sides differ by {spread_m * 1e3:.1f} mm, its diagonals by "
            f"{askew_m * 1e3:.1f} mm",
            "measure its corners again, or give T_world_marker",
        )
    # The smallest extent of the four corners is the one across their plane.
    off_m = np.linalg.svd(corners_m - corners_m.mean(axis=0))[1][2] / 2
    if off_m > _MAX_ERROR * side_m:
        yield warning(
            f"{name}: its corners are {off_m * 1e3:.1f} mm off a plane",
            "is the paper curled? Glue it onto a board, and measure its corners again",
        )


def placed(markers: MarkerMap) -> Iterator[Finding]:
    """Check where the markers are, which way up, and how large."""
    corners_world_m = np.asarray(markers.corners_world_m)
    Rs_world_marker = np.asarray(markers.Ts_world_marker.as_matrix())[:, :3, :3]
    has_findings = False
    for index, marker_id in enumerate(markers.ids):
        name, size_m = f"marker {marker_id}", float(markers.size_m[index])
        lowest_m = corners_world_m[index, :, 2].min()
        x_axis, y_axis, normal = Rs_world_marker[index].T
        turned_rad = np.arctan2(x_axis[2], y_axis[2])
        if size_m > _MOST_SIZE_M:
            has_findings = True
            yield warning(f"{name} is {size_m:.3g} m wide", "lengths are in m")
        if lowest_m < -_MAX_ERROR * size_m:
            has_findings = True
            yield warning(
                f"{name} reaches {-lowest_m:.2f} m below the ground",
                "z is measured upwards from the floor that the car drives on",
            )
        if abs(normal[2]) < _UPRIGHT and abs(turned_rad) > _TURNED_RAD:
            quarters = round(float(np.rad2deg(turned_rad)) / 90)
            has_findings = True
            yield note(
                f"{name} hangs turned by {90 * quarters} deg: its top-left corner is not the "
                "upper left one",
                "if the printed marker stands upright its corners are in the wrong order; "
                "--frame with a picture of it tells",
            )
    if not has_findings:
        count = len(markers.ids)
        families = listed(sorted(set(markers.families)))
        yield ok(f"{count} of {families}, upright or flat, above the ground")
