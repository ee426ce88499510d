"""Checks of the marker map: are its markers square, and do they hang or lie as markers do?

The file is read once more as it is: where the loader refuses a marker, these name the likely slip.
"""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from jaxnav.commands.doctor.findings import Finding, found, listed
from jaxnav.core.models.markers import MarkerMap
from jaxnav.errors import BadInput
from jaxnav.files.reading import read_mapping

_MAX_ERROR = 0.01  # of a side: a careful tape's error
_UPRIGHT = 0.3  # the normal's vertical part, below which a marker hangs on a wall
_TURNED_DEG = 45
_MOST_SIZE_M = 2.0


def measured_corners(path: Path) -> Iterator[Finding]:
    """Check that measured corners make a flat square of the size that the file says."""
    try:
        entries = read_mapping(path).get("markers")
    except BadInput:  # the loader reports it
        return
    checked, findings = 0, list[Finding]()
    for index, entry in enumerate(entries if isinstance(entries, list) else []):
        if not isinstance(entry, dict):
            continue
        corners_m, size_m = _corners(entry.get("corners_world_m")), entry.get("size_m")
        if corners_m is not None and isinstance(size_m, int | float) and size_m > 0:
            checked += 1
            findings += _square(f"marker {entry.get('id', index)}", corners_m, float(size_m))
    yield from findings
    if checked and not findings:
        yield found("markers.squares", count=checked)


def _corners(given: Any) -> np.ndarray | None:
    """Corners as an array (4, 3); None where the file holds anything else."""
    try:
        array = np.array(given, float)
    except (TypeError, ValueError):
        return None
    return array if array.shape == (4, 3) and np.isfinite(array).all() else None


def _square(marker: str, corners_m: np.ndarray, size_m: float) -> Iterator[Finding]:
    sides_m = np.linalg.norm(np.roll(corners_m, -1, axis=0) - corners_m, axis=1)
    diagonals_m = np.linalg.norm(corners_m[:2] - corners_m[2:], axis=1)
    side_m = float(sides_m.mean())
    if sides_m.max() > 1.2 * sides_m.min() and diagonals_m.min() < 0.9 * sides_m.max():
        yield found("markers.bow_tie", marker=marker)
        return
    off = abs(side_m / size_m - 1)
    if off > _MAX_ERROR:
        level, more = "error" if off > 3 * _MAX_ERROR else None, size_m / side_m - 1
        yield found("markers.size", level, marker=marker, side_m=side_m, size_m=size_m, off=more)
    spread_m, askew_m = np.ptp(sides_m), np.ptp(diagonals_m)
    if max(spread_m, askew_m) > 2 * _MAX_ERROR * side_m:
        yield found(
            "markers.askew", marker=marker, sides_mm=spread_m * 1e3, diagonals_mm=askew_m * 1e3
        )
    # The smallest extent of the four corners is the one across their plane.
    off_m = np.linalg.svd(corners_m - corners_m.mean(axis=0))[1][2] / 2
    if off_m > _MAX_ERROR * side_m:
        yield found("markers.bent", marker=marker, off_mm=off_m * 1e3)


def placed(markers: MarkerMap) -> Iterator[Finding]:
    """Check where the markers are, which way up, and how large."""
    corners_world_m = np.asarray(markers.corners_world_m)
    Rs_world_marker = np.asarray(markers.Ts_world_marker.as_matrix())[:, :3, :3]
    findings = list[Finding]()
    for marker_id, size, corners_m, R in zip(
        markers.ids, markers.size_m, corners_world_m, Rs_world_marker, strict=True
    ):
        marker, size_m, depth_m = f"marker {marker_id}", float(size), -corners_m[:, 2].min()
        x_up, y_up, normal_up = R[2]
        turned_deg = float(np.rad2deg(np.arctan2(x_up, y_up)))
        if size_m > _MOST_SIZE_M:
            findings.append(found("markers.huge", marker=marker, size_m=size_m))
        if depth_m > _MAX_ERROR * size_m:
            findings.append(found("markers.below", marker=marker, depth_m=depth_m))
        if abs(normal_up) < _UPRIGHT and abs(turned_deg) > _TURNED_DEG:
            quarters_deg = 90 * round(turned_deg / 90)
            findings.append(found("markers.turned", marker=marker, turned_deg=quarters_deg))
    yield from findings
    if not findings:
        families = listed(sorted(set(markers.families)))
        yield found("markers.placed", count=len(markers.ids), families=families)
