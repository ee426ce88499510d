"""Draw a calibrated rig: the map it drove through, its cameras and their residuals."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.calibrate.rig.calibrate import RigCalibration
from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.models.rig import CameraRig
from jaxnav.pictures.localisation import BLACK, BLUE, COLOURS, SKY, VERMILION, evenly

_ARROWS = 400  # residuals drawn for each camera


def rig_report(
    calibration: RigCalibration,
    rig: CameraRig,
    given: Float[np.ndarray, "C 4 4"],
    corners_world_m: Float[np.ndarray, "M 4 3"],
    marker_ids: Sequence[int],
) -> Figure:
    """Draw the map and the rig from above, and every camera's residuals over its image.

    Args:
        rig: has the names and the image sizes of the cameras.
        given: (C, 4, 4) T_vehicle_camera before calibration.
        corners_world_m: (M, 4, 3) of the markers that were found.
        marker_ids: theirs.
    """
    names, views = rig.names, calibration.views
    residuals_px = calibration.residuals_px.mean(axis=1)  # of each sighting's four corners
    centers_px = views.corners_px.mean(axis=1)
    columns = max(2, min(4, len(names)))
    rows = -(-len(names) // columns)
    figure = Figure(figsize=(3.6 * columns, 4.6 + 2.9 * rows), layout="constrained")
    halves = figure.subfigures(2, 1, height_ratios=[4.6, 2.9 * rows], squeeze=False)
    top, bottom = halves[:, 0]
    world, vehicle = top.subplots(1, 2)
    _draw_map(world, corners_world_m, marker_ids, calibration.Ts_world_vehicle[:, :3, 3])
    _draw_cameras(vehicle, names, calibration.Ts_vehicle_camera, given)
    axes = np.ravel(bottom.subplots(rows, columns, squeeze=False))
    for index, (axis, name) in enumerate(zip(axes, names, strict=False)):
        of = views.camera == index
        seen = centers_px[of], residuals_px[of], calibration.weight[of]
        _draw_residuals(axis, name, rig.image_sizes_px[index], *seen)
    for axis in axes[len(names) :]:
        axis.set_axis_off()
    return figure


def map_check(
    *,
    given: Float[np.ndarray, "M 4 4"],
    estimate: Float[np.ndarray, "M 4 4"],
    size_m: Float[np.ndarray, " M"],
    ids: Sequence[int],
    wrong: Sequence[bool],
) -> Figure:
    """Draw a given map and the found one over each other, with arrows from one to the other.

    Args:
        given, estimate: (M, 4, 4) T_world_marker.
        wrong: for each marker, whether something is wrong with it.
    """
    figure = Figure(figsize=(7.5, 6.5), layout="constrained")
    axes = figure.subplots()
    corners = size_m[:, None, None] / 2 * CORNER_SIGNS
    squares = [
        (Ts[:, None, :3, :3] @ corners[..., None])[..., 0] + Ts[:, None, :3, 3]
        for Ts in (given, estimate)
    ]
    flat, labels = _flattened(np.concatenate(squares).reshape(-1, 3))
    before, after = flat.reshape(2, -1, 4, 2)
    for a, b, marker_id, off in zip(before, after, ids, wrong, strict=True):
        axes.plot(*a[[0, 1, 2, 3, 0]].T, color=SKY, linewidth=4)
        _draw_marker(axes, b, marker_id, VERMILION if off else BLACK, BLACK)
        if off:
            axes.annotate("", xy=b.mean(axis=0), xytext=a.mean(axis=0),
                          arrowprops={"arrowstyle": "->", "color": VERMILION})  # fmt: skip
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=labels[0], ylabel=labels[1], title="map (blue) and as found (red: wrong)")
    return figure


def _draw_map(
    axes: Axes, corners_m: np.ndarray, marker_ids: Sequence[int], path_m: np.ndarray
) -> None:
    # The two directions of largest extent; seen from above if the world is level.
    flat, labels = _flattened(np.concatenate([corners_m.reshape(-1, 3), path_m]))
    corners, path = flat[: 4 * len(corners_m)].reshape(-1, 4, 2), flat[4 * len(corners_m) :]
    axes.plot(*path.T, color=SKY, linewidth=1, label="path")
    for square, marker_id in zip(corners, marker_ids, strict=True):
        _draw_marker(axes, square, marker_id, BLACK, VERMILION)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=labels[0], ylabel=labels[1], title="markers and path in the world")


def _draw_marker(
    axes: Axes, corners: np.ndarray, marker_id: int, colour: str, of_text: str
) -> None:
    axes.plot(*corners[[0, 1, 2, 3, 0]].T, color=colour, linewidth=1.5)
    axes.annotate(str(marker_id), corners.mean(axis=0), textcoords="offset points",
                  xytext=(5, 5), fontsize=9, color=of_text)  # fmt: skip


def _flattened(points: np.ndarray) -> tuple[np.ndarray, tuple[str, str]]:
    extent = np.ptp(points, axis=0)
    kept = sorted(np.argsort(extent)[1:]) if extent[2] > 2 * extent[:2].min() else [0, 1]
    return points[:, kept], (f"{'xyz'[kept[0]]} (m)", f"{'xyz'[kept[1]]} (m)")


def _draw_cameras(
    axes: Axes, names: Sequence[str], Ts_vehicle_camera: np.ndarray, given: np.ndarray
) -> None:
    spread = np.ptp(np.concatenate([Ts_vehicle_camera, given])[:, :3, 3], axis=0)
    flat = [0, 1] if spread[2] <= 2 * spread[:2].min() or spread.max() < 0.02 else [0, 2]
    length = max(0.35 * float(spread.max()), 0.02)
    for Ts, alpha in ((given, 0.35), (Ts_vehicle_camera, 1.0)):
        for index, T in enumerate(Ts):
            colour = COLOURS[index % len(COLOURS)]
            foot, way = T[:3, 3], length * T[:3, 2]
            axes.annotate(
                "", xy=(foot + way)[flat], xytext=foot[flat],
                arrowprops={"arrowstyle": "->", "color": colour, "alpha": alpha, "lw": 1.5},
            )  # fmt: skip
            axes.plot(*foot[flat], "o", color=colour, alpha=alpha, markersize=5)
            axes.plot(*(foot + 1.2 * way)[flat], alpha=0)
            if alpha == 1:
                axes.annotate(names[index], (foot + way)[flat], fontsize=8, color=colour)
    axes.plot(0, 0, "+", color=BLACK)
    axes.set_aspect("equal", adjustable="datalim")
    axes.set(xlabel=f"{'xyz'[flat[0]]} (m)", ylabel=f"{'xyz'[flat[1]]} (m)",
             title="cameras on the vehicle (faint: as given)")  # fmt: skip


def _draw_residuals(
    axes: Axes,
    name: str,
    size_px: tuple[int, int],
    centers_px: np.ndarray,
    residuals_px: np.ndarray,
    weight: np.ndarray,
) -> None:
    width, height = size_px
    full = weight >= 1
    if len(centers_px):
        rows = evenly(len(centers_px), _ARROWS)
        typical = float(np.median(np.hypot(*residuals_px.T))) or 1.0
        scale = 0.04 * width / typical
        inside = rows[full[rows]]
        axes.quiver(
            *centers_px[inside].T, *(residuals_px[inside] * scale).T, color=BLUE,
            angles="xy", scale_units="xy", scale=1, width=0.003,
        )  # fmt: skip
        axes.plot(*centers_px[rows[~full[rows]]].T, "x", color=VERMILION, markersize=4)
        axes.set_xlabel(f"arrows {scale:.0f} x, typical {typical:.2f} px; x: outliers", fontsize=8)
    rms = float(np.sqrt(np.mean(residuals_px[full] ** 2))) if full.any() else float("nan")
    axes.set(xlim=(0, width), ylim=(height, 0))
    axes.set_title(f"{name}: {len(centers_px)} sightings, {rms:.2f} px", fontsize=9)
    axes.set_aspect("equal")
    axes.tick_params(labelsize=7)
