"""Draw a recorded drive: a map, and below it health, doubts, commands and ages over time.

One function returns one Figure; nothing is shown or saved here.
"""

import math
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Ellipse
from matplotlib.ticker import LogLocator, MaxNLocator

from jaxnav.core.filter.choose import Ungated
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.filter.selectors import SELECTORS
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.files import poses
from jaxnav.pictures.localisation import (
    BLACK,
    BLUE,
    GREEN,
    ORANGE,
    SKY,
    VERMILION,
    draw_markers,
    draw_waypoints,
    evenly,
)
from jaxnav.pictures.scenery import Scenery
from jaxnav.recordings.drive_log import DriveLog
from jaxnav.recordings.records import Outcomes

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
_FAULT = "#444444"  # distinct from all colours of health
_JOIN_S = 0.15  # a shorter gap in a flag is closed: not every event can raise it
_LETTER = 0.012  # width of a letter as a fraction of the time axis
_SMALLEST_FLIP = 1e-6  # lower end of the axis of the flip probability
_WIDTH_IN, _MAP_IN, _LANE_IN, _PANEL_IN = 8.0, 4.7, 0.17, 1.05

_Panel = Callable[[Axes, Outcomes], None]
_Bars = list[tuple[float, float]]


def drive_log_report(log: DriveLog, title: str = "") -> Figure:
    """Draw a recorded drive: its map, and health, doubts, commands and ages over time.

    Args:
        log: a log of at least one outcome.
        title: title of the figure.

    Raises:
        ValueError: the log has no outcome.
    """
    outcomes = log.outcomes
    if not len(outcomes.now_ns):
        raise ValueError("a drive without outcomes can't be drawn")
    lanes = list(_lanes(outcomes))
    ages = list(_ages_ms(log))
    draw_nis = partial(_draw_nis, gate_nis=_gate_nis(log.header))
    panels: list[_Panel] = [_draw_doubt, draw_nis, _draw_commands, _draw_sigma]
    heights = [_MAP_IN, 0.35 + _LANE_IN * len(lanes), *[_PANEL_IN] * (len(panels) + bool(ages))]
    figure = Figure(figsize=(_WIDTH_IN, sum(heights) + 0.5), layout="constrained")
    figure.suptitle(title, fontsize=10)
    grid = figure.add_gridspec(len(heights), 1, height_ratios=heights)
    _draw_map(figure.add_subplot(grid[0]), outcomes, Scenery.from_header(log.header))
    first = figure.add_subplot(grid[1])
    _draw_lanes(first, outcomes, lanes)
    below = [figure.add_subplot(grid[row], sharex=first) for row in range(2, len(heights))]
    for draw, axes in zip(panels, below, strict=False):
        draw(axes, outcomes)
    if ages:
        _draw_ages(below[-1], ages)
    end_s = float(outcomes.times_s[-1])
    first.set_xlim(0, end_s if end_s > 0 else 1)
    for axes in (first, *below):
        axes.grid(alpha=0.3)
        axes.tick_params(labelsize=8, labelbottom=axes is below[-1])
        axes.yaxis.label.set_fontsize(8)
    below[-1].set_xlabel("time (s)", fontsize=9)
    figure.align_ylabels(below)
    return figure


def _lanes(outcomes: Outcomes) -> Iterator[tuple[str, str, _Bars]]:
    """Name, colour and bars (begin s, duration s) of each flag that was ever raised."""
    for kinds, values, color in (
        (Fault, outcomes.faults, _FAULT),
        (Reject, outcomes.rejects, PURPLE),
    ):
        for flag in kinds:
            up = (values & flag.value) > 0
            if up.any():
                least_s = 0.003 * float(outcomes.times_s[-1] - outcomes.times_s[0])  # is visible
                yield flag.name or "", color, _bars(outcomes.times_s, up, _JOIN_S, least_s)


def _bars(
    times_s: np.ndarray, up: np.ndarray, joined_s: float = 0.0, least_s: float = 0.0
) -> _Bars:
    """Begin and duration in s of a flag's bars, up to the next event.

    Args:
        joined_s: gaps up to this are closed.
        least_s: a bar is drawn at least so long.
    """
    begins_s, ends_s = times_s[up], np.append(times_s[1:], times_s[-1])[up]
    first = np.flatnonzero(np.append(True, begins_s[1:] - ends_s[:-1] > joined_s)[: len(begins_s)])
    last = np.append(first[1:], len(begins_s))[: len(first)] - 1
    lengths_s = np.maximum(ends_s[last] - begins_s[first], least_s)
    return list(zip(begins_s[first].tolist(), lengths_s.tolist(), strict=True))


def _draw_lanes(axes: Axes, outcomes: Outcomes, lanes: list[tuple[str, str, _Bars]]) -> None:
    """Draw health on top, and below it a lane for each fault and reject."""
    for state in Health:
        bars = _bars(outcomes.times_s, outcomes.health == state)
        axes.broken_barh(bars, (-0.4, 0.8), color=HEALTH_COLORS[state], lw=0)
        for begin_s, length_s in bars:
            if length_s > _LETTER * len(state.name) * outcomes.times_s[-1]:
                middle_s = begin_s + length_s / 2
                axes.text(
                    middle_s, 0, state.name, color="white", fontsize=7, ha="center", va="center"
                )
    for row, (_, color, lane) in enumerate(lanes, 1):
        axes.broken_barh(lane, (row - 0.35, 0.7), color=color, lw=0)
    axes.set_yticks(range(len(lanes) + 1), ["health", *(name for name, _, _ in lanes)])
    axes.set_ylim(len(lanes) + 0.6, -0.6)
    axes.set_axisbelow(True)


def _draw_doubt(axes: Axes, outcomes: Outcomes) -> None:
    flip = np.clip(outcomes.flip_probability, _SMALLEST_FLIP, 1)
    axes.semilogy(outcomes.times_s, flip, color=BLUE, lw=1.2)
    axes.set_ylim(_SMALLEST_FLIP / 2, 2)
    axes.set_yticks([_SMALLEST_FLIP, 1e-3, 1], [f"<{_SMALLEST_FLIP:g}", "0.001", "1"])
    axes.minorticks_off()
    axes.set_ylabel("flip\nprobability", color=BLUE)
    count = [len(bank) for bank in outcomes.hypotheses]
    right = _right_of(axes, "hypotheses")
    right.step(outcomes.times_s, count, where="post", color=VERMILION, lw=1.2, ls="--")
    right.set_ylim(0, max(count) + 1)
    right.yaxis.set_major_locator(MaxNLocator(nbins=4, integer=True))


def _gate_nis(header: dict[str, Any]) -> float:
    """The gate of the filter that drove, the default one where the header names none; inf: none."""
    if isinstance(SELECTORS.get(str(header.get("selector"))), Ungated):
        return math.inf
    parameters = header.get("parameters")
    given = parameters.get("motion.gate_nis") if isinstance(parameters, dict) else None
    if isinstance(given, int | float) and given > 0:
        return float(given)
    return float(BicycleKalman.gate_nis)


def _draw_nis(axes: Axes, outcomes: Outcomes, gate_nis: float) -> None:
    fused = outcomes.nis > 0
    above = outcomes.nis > gate_nis
    for which, style in ((fused & ~above, {"color": BLUE}), (above, {"color": VERMILION})):
        nis = np.minimum(outcomes.nis[which], 1e6)
        axes.semilogy(outcomes.times_s[which], nis, ".", ms=3, **style)
    if math.isfinite(gate_nis):
        axes.axhline(gate_nis, color=BLACK, lw=1, ls="--")
        at_left = axes.get_yaxis_transform()
        name = f"gate {gate_nis:g}"
        axes.text(0.005, gate_nis * 1.3, name, fontsize=7, transform=at_left, clip_on=True)
    axes.set_ylim(1e-2, max(300.0, 3 * float(np.max(outcomes.nis[fused], initial=0.0))))
    axes.set_ylabel("NIS")


def _draw_commands(axes: Axes, outcomes: Outcomes) -> None:
    """Of a car throttle and steering; of another base its speeds, and how fast it turns."""
    label, turn = "throttle", "steering (deg)"
    lines, turns = [outcomes.throttle], outcomes.steering_rad
    if not np.isnan(outcomes.twist).all():
        *lines, turns = outcomes.twist.T
        label, turn = "ahead, left (m/s)", "turn (deg/s)"
    for line, color in zip(lines, (BLUE, GREEN), strict=False):
        axes.step(outcomes.times_s, line, where="post", color=color, lw=1.2)
    axes.set_ylabel(label, color=BLUE)
    right = _right_of(axes, turn)
    right.step(outcomes.times_s, np.rad2deg(turns), where="post", color=VERMILION, lw=1.2, ls="--")


def _draw_sigma(axes: Axes, outcomes: Outcomes) -> None:
    variances_m2 = np.trace(outcomes.covariance[:, :2, :2], axis1=1, axis2=2)
    shown = outcomes.located & (variances_m2 > 0)
    sigma_mm = 1e3 * np.sqrt(np.where(shown, variances_m2, np.nan))
    axes.semilogy(outcomes.times_s, sigma_mm, color=GREEN, lw=1.2)
    # Within a decade or so matplotlib writes out every minor tick, one over the other.
    few = shown.any() and np.nanmax(sigma_mm) < 30 * np.nanmin(sigma_mm)
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5) if few else (1,)))
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.set_ylabel("position\nsigma (mm)")


def _ages_ms(log: DriveLog) -> Iterator[tuple[str, str, np.ndarray]]:
    """Name, colour and (N, 2) time s and age ms of each kind of data that was handled."""
    begin_ns = int(log.outcomes.now_ns[0])
    frames = [(given.now_ns, given.frames[0].stamp_ns) for given in log.inputs if given.frames]
    readings = [(i.now_ns, i.odometry.stamp_ns) for i in log.inputs if i.odometry is not None]
    for name, color, stamps_ns in (("frames", BLUE, frames), ("odometry", VERMILION, readings)):
        rows = [((now - begin_ns) / 1e9, (now - stamp) / 1e6) for now, stamp in stamps_ns]
        if rows:
            yield name, color, np.array(rows)


def _draw_ages(axes: Axes, ages: list[tuple[str, str, np.ndarray]]) -> None:
    """Draw the ages of data when they were handled; a clock's jumps lie beyond the axis."""
    for name, color, rows in ages:
        axes.plot(rows[:, 0], rows[:, 1], ".", ms=2.5, color=color, label=name)
    usual_ms = max(float(np.median(np.abs(rows[:, 1]))) for _, _, rows in ages)
    largest_ms = max(float(np.max(rows[:, 1])) for _, _, rows in ages)
    axes.set_ylim(-0.1 * usual_ms - 1, 1.5 * min(largest_ms, 20 * usual_ms + 100) + 1)
    axes.set_ylabel("age when\nhandled (ms)")
    axes.legend(loc="upper right", fontsize=7, ncols=2, markerscale=3)


def _right_of(axes: Axes, label: str) -> Axes:
    right = axes.twinx()
    right.set_ylabel(label, color=VERMILION, fontsize=8)
    right.tick_params(labelsize=8)
    return right


def _draw_map(axes: Axes, outcomes: Outcomes, scenery: Scenery) -> None:
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
    health = [
        Line2D([], [], color=HEALTH_COLORS[state], lw=2.5, label=state.name)
        for state in sorted(Health)
        if state in outcomes.health
    ]
    axes.legend(
        handles=[*health, *axes.get_legend_handles_labels()[0]],
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


def _draw_ellipses(axes: Axes, outcomes: Outcomes, known: np.ndarray) -> None:
    """Draw the 95 % ellipses of the vehicle's position, evenly spaced in time."""
    for number, index in enumerate(known[evenly(len(known), _ELLIPSES)]):
        covariance = outcomes.covariance[index][:2, :2]
        if covariance.shape != (2, 2) or not np.isfinite(covariance).all():
            continue
        variances, vectors = np.linalg.eigh(covariance)
        short_m, long_m = 2 * np.sqrt(_CHI2_2DOF_95 * np.maximum(variances, 0))
        angle_deg = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1]))
        x_m, y_m, _ = outcomes.pose[index]
        ellipse = Ellipse((x_m, y_m), long_m, short_m, angle=angle_deg)
        ellipse.set(facecolor="none", edgecolor=BLACK, lw=0.9, zorder=5)
        ellipse.set_label("95 % ellipse" if number == 0 else "")
        axes.add_patch(ellipse)


def _candidate_poses(outcomes: Outcomes) -> dict[bool, np.ndarray]:
    """Whether selected -> (N, 3) planar poses of single frames' candidates, evenly spaced."""
    candidates: dict[bool, list[np.ndarray]] = {True: [], False: []}
    seen = [index for index, Ts in enumerate(outcomes.Ts_vehicle_world) if len(Ts)]
    for index in (seen[number] for number in evenly(len(seen), _CANDIDATES)):
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
        for index in (several[number] for number in evenly(len(several), _CANDIDATES))
    ]
    return np.vstack([np.zeros((0, 3)), *rows])


def _draw_headings(axes: Axes, rows: np.ndarray, color: str, marker: str, label: str) -> None:
    """Draw planar poses (N, 3) as signs with a stroke ahead."""
    rows = rows[np.isfinite(rows).all(axis=1)]
    if not len(rows):
        return
    x_m, y_m, psi_rad = rows.T
    axes.plot(x_m, y_m, marker, color=color, ms=4, label=label, zorder=2)
    axes.quiver(
        x_m, y_m, np.cos(psi_rad), np.sin(psi_rad), color=color, zorder=2,
        scale_units="inches", scale=7, width=0.0022, headwidth=0,
    )  # fmt: skip
