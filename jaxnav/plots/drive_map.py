"""Draw the map of a recorded drive: the car's track, and its alternative poses."""

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse

from jaxnav.files import poses
from jaxnav.loop.flags import Health
from jaxnav.plots.localisation import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SKY,
    VERMILION,
    draw_markers,
    draw_waypoints,
)
from jaxnav.plots.scenery import Scenery
from jaxnav.recording.outcomes import Outcomes

GREY, PURPLE = "#999999", "#CC79A7"
# From pale to dark as health gets worse, so that it is readable in grey too.
HEALTH_COLORS = {
    Health.INIT: GREY,
    Health.ALIGNED: SKY,
    Health.OK: BLUE,
    Health.DEAD_RECKONING: ORANGE,
    Health.DEGRADED: VERMILION,
    Health.STOP: BLACK,
}
_CHI2_2DOF_95 = 5.991
_ELLIPSES, _CANDIDATES = 14, 40  # the most that are drawn


def draw_drive_map(axes: Axes, outcomes: Outcomes, scenery: Scenery) -> None:
    """Draw the track by health, ellipses, hypotheses, candidates, waypoints and markers."""
    located = outcomes.located & np.isfinite(outcomes.pose).all(axis=1)
    track_m = np.where(located[:, None], outcomes.pose[:, :2], np.nan)
    others = _candidate_poses(outcomes)
    _draw_headings(axes, _alternatives(outcomes), GREY, "d", "other hypothesis")
    _draw_headings(axes, others[False], PURPLE, "x", "candidate not taken")
    _draw_headings(axes, others[True], GREEN, ".", "candidate taken")
    draw_markers(axes, scenery.markers_m)
    draw_waypoints(axes, scenery.waypoints_m, scenery.waypoint_radius_m)
    _draw_track(axes, track_m, outcomes.health)
    known = np.flatnonzero(located)
    if known.size:
        _draw_ellipses(axes, outcomes, known)
        first, (x_m, y_m, psi_rad) = track_m[known[0]], outcomes.pose[known[-1]]
        axes.plot(*first, "o", color=BLACK, ms=5, zorder=5, label="start")
        axes.plot(x_m, y_m, "s", color=BLACK, ms=5, zorder=5, label="end")
        ahead = np.cos(psi_rad), np.sin(psi_rad)
        axes.quiver(x_m, y_m, *ahead, scale_units="inches", scale=3, width=0.005, zorder=5)
    places_m = [track_m[known], scenery.waypoints_m, scenery.markers_m.reshape(-1, 3)[:, :2]]
    _look_at(axes, np.vstack(places_m))
    axes.set_xlabel("x (m)", fontsize=9)
    axes.set_ylabel("y (m)", fontsize=9)
    axes.grid(alpha=0.3)
    axes.tick_params(labelsize=8)
    axes.legend(
        handles=[*_health_handles(outcomes.health), *axes.get_legend_handles_labels()[0]],
        loc="upper center",
        bbox_to_anchor=(0.5, -0.13),
        ncols=4,
        fontsize=8,
    )


def _look_at(axes: Axes, places_m: np.ndarray) -> None:
    """Limit the axes to points (N, 2), at equal scales; anything farther off is cut."""
    axes.set_aspect("equal", adjustable="datalim")
    if len(places_m):
        low, high = places_m.min(axis=0), places_m.max(axis=0)
        margin_m = np.maximum(0.08 * np.max(high - low), 0.2)
        # Fixed limits would keep the axes from making both scales equal.
        axes.dataLim.set_points(np.stack([low - margin_m, high + margin_m]))
        axes.autoscale_view()


def _draw_track(axes: Axes, track_m: np.ndarray, health: np.ndarray) -> None:
    """Draw each piece of the track in the colour of its health."""
    pieces = np.stack([track_m[:-1], track_m[1:]], axis=1)
    drawn = np.isfinite(pieces).all(axis=(1, 2))
    colors = [HEALTH_COLORS[Health(value)] for value in health[1:][drawn]]
    axes.add_collection(
        LineCollection(list(pieces[drawn]), colors=colors, linewidths=2.5, zorder=4)
    )


def _health_handles(health: np.ndarray) -> list[Line2D]:
    return [
        Line2D([], [], color=HEALTH_COLORS[state], lw=2.5, label=state.name)
        for state in sorted(Health)
        if state in health
    ]


def _draw_ellipses(axes: Axes, outcomes: Outcomes, known: np.ndarray) -> None:
    """Draw the 95 % ellipses of the vehicle's position, evenly spaced in time."""
    for number, index in enumerate(known[_evenly(len(known), _ELLIPSES)]):
        covariance = outcomes.covariance[index][:2, :2]
        if covariance.shape != (2, 2) or not np.isfinite(covariance).all():
            continue
        variances, vectors = np.linalg.eigh(covariance)
        lengths_m = 2 * np.sqrt(_CHI2_2DOF_95 * np.maximum(variances, 0))
        angle_deg = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
        axes.add_patch(
            Ellipse(
                (outcomes.pose[index, 0], outcomes.pose[index, 1]),
                lengths_m[1],
                lengths_m[0],
                angle=angle_deg,
                facecolor="none",
                edgecolor=BLACK,
                lw=0.9,
                zorder=5,
                label="95 % ellipse" if number == 0 else None,
            )
        )


def _candidate_poses(outcomes: Outcomes) -> dict[bool, np.ndarray]:
    """Whether selected -> (N, 3) planar poses of single frames' candidates, evenly spaced."""
    candidates: dict[bool, list[np.ndarray]] = {True: [], False: []}
    seen = [index for index, Ts in enumerate(outcomes.Ts_vehicle_world) if len(Ts)]
    for index in (seen[number] for number in _evenly(len(seen), _CANDIDATES)):
        for number, T_vehicle_world in enumerate(outcomes.Ts_vehicle_world[index]):
            w, x, y, z, *place_m = poses.inverse(T_vehicle_world)
            psi_rad = math.atan2(2 * (w * z + x * y), 1 - 2 * (y**2 + z**2))
            is_selected = number == outcomes.selected[index]
            candidates[is_selected].append(np.array([place_m[0], place_m[1], psi_rad]))
    return {is_selected: np.array(rows).reshape(-1, 3) for is_selected, rows in candidates.items()}


def _alternatives(outcomes: Outcomes) -> np.ndarray:
    """The planar poses (N, 3) of all but the best hypothesis, evenly spaced."""
    several = [index for index, bank in enumerate(outcomes.hypotheses) if len(bank) > 1]
    rows = [
        np.delete(outcomes.hypotheses[index], np.argmax(outcomes.log_weight[index]), axis=0)
        for index in (several[number] for number in _evenly(len(several), _CANDIDATES))
    ]
    return np.vstack([np.zeros((0, 3)), *rows])


def _draw_headings(axes: Axes, rows: np.ndarray, color: str, marker: str, label: str) -> None:
    """Draw planar poses (N, 3) as signs with a stroke ahead."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return
    x_m, y_m, psi_rad = rows.T
    axes.plot(x_m, y_m, marker, color=color, ms=4, label=label, zorder=2)
    ahead = np.cos(psi_rad), np.sin(psi_rad)
    axes.quiver(
        *(x_m, y_m, *ahead),
        color=color,
        scale_units="inches",
        scale=7,
        width=0.0022,
        headwidth=0,
        zorder=2,
    )


def _evenly(count: int, most: int) -> np.ndarray:
    """At most `most` evenly spaced indices below `count`, from the first to the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(int))
