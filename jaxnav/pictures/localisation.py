"""Draw localised recordings and camera frames.

One function returns one Figure; nothing is shown or saved here. Colours are Okabe and Ito's, which
everybody can distinguish.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke

BLACK, ORANGE, SKY = "#000000", "#E69F00", "#56B4E9"
GREEN, BLUE, VERMILION = "#009E73", "#0072B2", "#D55E00"
COLOURS = (BLUE, VERMILION, GREEN, ORANGE, SKY, BLACK, "#CC79A7", "#8C8C8C")  # of a series
STYLES = ("-", "--", "-.", ":")
SELECTED, OTHER = BLUE, ORANGE
PHOTO_DPI = 100.0  # pixels of a photograph in an inch of its picture
_USUAL_PX = 1200.0  # diagonal of a photograph whose words are as large as usual
_LEAST_ARROW = 0.02  # length of an arrow, of the photograph's diagonal


@dataclass(frozen=True)
class AnnotatedFrame:
    """One camera frame with its detections and candidate poses."""

    title: str
    image: UInt8[np.ndarray, "rows columns"] | UInt8[np.ndarray, "rows columns 3"]  # grey or RGB
    detected_px: Float[np.ndarray, "K 4 2"]  # corners
    selected_px: Float[np.ndarray, "P 2 2"]  # marker normals of the candidate taken, foot and tip
    other_px: Float[np.ndarray, "Q 2 2"]  # of all other candidates
    names: tuple[str, ...] = ()  # beside the markers, where given


def localisation_report(
    times_s: Float[np.ndarray, " N"],
    estimate_m: Float[np.ndarray, "N 3"],
    reference_m: Float[np.ndarray, "N 3"] | None,
    errors: Mapping[str, Float[np.ndarray, " N"]],
    markers_m: Float[np.ndarray, "M 4 3"],
    title: str = "",
    connected: bool = True,
    names: tuple[str, str] = ("estimate", "reference"),
) -> Figure:
    """Draw a localised recording: the track from above and from the side, and errors over time.

    Args:
        times_s: (N,).
        estimate_m: (N, 3) positions, NaN where not located.
        reference_m: (N, 3) or None.
        errors: name with unit -> (N,) on a logarithmic axis, NaN where unknown.
        markers_m: (M, 4, 3) corners in the world.
        title: above everything.
        connected: whether successive positions belong to one track; points otherwise.
        names: of the two tracks.
    """
    style: dict[str, Any] = (
        {"ls": "--", "lw": 1} if connected else {"ls": "", "marker": ".", "ms": 1.5}
    )
    figure = Figure(figsize=(11, 4.2 + 1.6 * len(errors)), layout="constrained")
    figure.suptitle(title)
    grid = figure.add_gridspec(1 + len(errors), 2, height_ratios=(2.6, *[1] * len(errors)))
    for column, (first, second) in enumerate(((0, 1), (0, 2))):
        axes = figure.add_subplot(grid[0, column])
        axes.plot(estimate_m[:, first], estimate_m[:, second], color=BLUE, label=names[0], **style)
        if reference_m is not None:
            axes.plot(
                reference_m[:, first], reference_m[:, second], color=BLACK, lw=1, label=names[1]
            )
            _fit_view(axes, np.vstack([reference_m, markers_m.reshape(-1, 3)])[:, [first, second]])
        for corners in markers_m:
            closed = np.vstack([corners, corners[:1]])
            axes.plot(closed[:, first], closed[:, second], color=VERMILION, lw=2)
        axes.set(xlabel=f"{'xyz'[first]} (m)", ylabel=f"{'xyz'[second]} (m)")
        axes.set_aspect("equal", adjustable="box" if reference_m is not None else "datalim")
        axes.grid(alpha=0.3)
        if column == 0:
            axes.legend(loc="best", fontsize=8)
    for row, (name, values) in enumerate(errors.items(), 1):
        axes = figure.add_subplot(grid[row, :])
        axes.semilogy(times_s, values, ".", ms=2, color=BLUE)
        axes.set_ylabel(name)
        axes.grid(alpha=0.3)
        axes.tick_params(labelbottom=row == len(errors))
    if errors:
        axes.set_xlabel("time (s)")
    return figure


def camera_mosaic(rows: Sequence[Sequence[AnnotatedFrame]], title: str = "") -> Figure:
    """Draw camera frames in rows, each with its detections and all candidates' normals.

    Around a small marker the frame shows an enlarged inset.
    """
    columns = max(len(row) for row in rows)
    height, width = rows[0][0].image.shape[:2]
    figure = Figure(
        figsize=(4.2 * columns, (4.2 * height / width + 0.35) * len(rows) + 0.5),
        layout="constrained",
    )
    figure.suptitle(title)
    for r, row in enumerate(rows):
        for c, view in enumerate(row):
            axes = figure.add_subplot(len(rows), columns, r * columns + c + 1)
            axes.set_title(view.title, fontsize=9)
            _show(axes, view)
            side = max((_side_px(corners) for corners in view.detected_px), default=np.inf)
            if side < width / 6:
                _enlarge(axes, view)
    return figure


def photo_with_poses(view: AnnotatedFrame) -> Figure:
    """Draw a photograph, pixel for pixel at `PHOTO_DPI`, with its markers and both poses of each.

    The marker is green, the normal of the better pose blue and of the other one orange; the names
    stand beside the markers.
    """
    height, width = view.image.shape[:2]
    figure = Figure(figsize=(width / PHOTO_DPI, height / PHOTO_DPI))
    axes = figure.add_axes((0, 0, 1, 1))
    scale = max(1.0, np.hypot(width, height) / _USUAL_PX)  # words and arrows grow with the image
    least_px = _LEAST_ARROW * np.hypot(width, height)
    _show(axes, view, scale, least_px)
    for corners, name in zip(view.detected_px, view.names, strict=False):
        at = corners[np.argmax(corners[:, 1])]
        label = axes.annotate(
            name, at, xytext=(0, -3 * scale), textcoords="offset points", va="top", ha="center"
        )
        label.set(fontsize=8 * scale, color=GREEN, annotation_clip=False)
        label.set_path_effects([withStroke(linewidth=2 * scale, foreground="white")])
    key = (("better pose", SELECTED), ("other pose", OTHER))
    for row, (words, color) in enumerate(key):
        at = (0.01, 0.99 - 0.035 * row * max(1.0, width / height))
        text = figure.text(*at, words, color=color, va="top")
        text.set(fontsize=9 * scale)
        text.set_path_effects([withStroke(linewidth=2 * scale, foreground="white")])
    return figure


def reliability_diagram(
    curves: Mapping[str, tuple[Float[np.ndarray, " B"], ...]], title: str = ""
) -> Figure:
    """Draw observed frequencies of flips against predicted probabilities.

    Args:
        curves: label -> mean prediction of each of B bins, frequency there, lower and upper end of
            the frequency's interval, and how many are in the bin. Empty bins are not drawn.
        title: above everything.
    """
    figure = Figure(figsize=(6, 6.5), layout="constrained")
    figure.suptitle(title, fontsize=9)
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    upper.plot((0, 1), (0, 1), color=BLACK, lw=0.8, ls=":")
    for number, (label, columns) in enumerate(curves.items()):
        used = columns[-1] > 0
        predicted, observed, low, high, counts = (column[used] for column in columns)
        color, style = look(number)
        reach = np.maximum(observed - low, 0), np.maximum(high - observed, 0)
        upper.errorbar(
            predicted, observed, yerr=reach, color=color, ls=style, marker="o", ms=3, capsize=2,
            label=label,
        )  # fmt: skip
        lower.step(predicted, counts, where="mid", color=color, ls=style)
    upper.set(ylabel="frequency of a flip", xlim=(0, 1), ylim=(0, 1))
    upper.legend(loc="upper left", fontsize=8)
    lower.set(xlabel="flip probability", ylabel="frames", yscale="log")
    for axes in (upper, lower):
        axes.grid(alpha=0.3)
    return figure


def look(number: int) -> tuple[str, str]:
    """Colour and line style of one of a series of curves."""
    return COLOURS[number % len(COLOURS)], STYLES[number % len(STYLES)]


def evenly(count: int, most: int) -> Int[np.ndarray, " n"]:
    """At most `most` evenly spaced indices below `count`, from the first to the last."""
    return np.unique(np.linspace(0, max(count - 1, 0), min(count, most)).round().astype(int))


def _fit_view(axes: Axes, points: np.ndarray) -> None:
    """Set limits around the given points, so that outliers don't shrink the view."""
    low, high = np.nanmin(points, axis=0), np.nanmax(points, axis=0)
    margin = 0.08 * np.max(high - low) + 0.05
    axes.set(xlim=(low[0] - margin, high[0] + margin), ylim=(low[1] - margin, high[1] + margin))


def draw_markers(axes: Axes, markers_m: Float[np.ndarray, "M 4 3"]) -> None:
    """Draw markers on a map seen from above: (M, 4, 3) corners in the world."""
    for index, corners in enumerate(markers_m):
        label = "marker" if index == 0 else None
        axes.plot(corners[:, 0], corners[:, 1], color=VERMILION, lw=5, label=label)


def draw_waypoints(axes: Axes, waypoints_m: Float[np.ndarray, "W 2"], radius_m: float) -> None:
    """Draw waypoints (W, 2) on a map, each with the circle within which it is reached."""
    circle = np.linspace(0, 2 * np.pi, 60)
    for number, (x_m, y_m) in enumerate(waypoints_m, 1):
        axes.plot(x_m + radius_m * np.cos(circle), y_m + radius_m * np.sin(circle), color=GREEN)
        text = axes.annotate(f"waypoint {number}", (x_m, y_m), ha="center", va="center")
        text.set(fontsize=8, color=GREEN, zorder=6)
        text.set_path_effects([withStroke(linewidth=2, foreground="white")])


def _show(axes: Axes, view: AnnotatedFrame, scale: float = 1.0, least_px: float = 0.0) -> None:
    """Draw a frame with its markers, and arrows at least as long as `least_px`."""
    axes.imshow(view.image, cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    for corners in view.detected_px:
        closed = np.vstack([corners, corners[:1]])
        axes.plot(closed[:, 0], closed[:, 1], color=GREEN, lw=1.2 * scale)
        axes.plot(*corners[0], "o", color=GREEN, ms=3 * scale)
    for sticks, color in ((view.other_px, OTHER), (view.selected_px, SELECTED)):
        arrow = {"arrowstyle": "->", "color": color, "lw": 1.8 * scale}
        arrow["mutation_scale"] = 10 * scale
        for foot, tip in sticks:
            length_px = np.linalg.norm(tip - foot)
            if 0 < length_px < least_px:
                tip = foot + (tip - foot) * least_px / length_px
            axes.annotate("", tip, foot, arrowprops=arrow)
    height, width = view.image.shape[:2]
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_axis_off()


def _enlarge(axes: Axes, view: AnnotatedFrame) -> None:
    corners = view.detected_px[np.argmax([_side_px(corners) for corners in view.detected_px])]
    center, half = corners.mean(axis=0), max(1.6 * _side_px(corners), 4.0)
    height, width = view.image.shape[:2]
    left = 0.62 if center[0] < width / 2 else 0.02
    inset = axes.inset_axes((left, 0.02, 0.36, 0.36 * width / height))
    _show(inset, view)
    inset.set(xlim=(center[0] - half, center[0] + half), ylim=(center[1] + half, center[1] - half))
    inset.set_axis_on()
    inset.set(xticks=[], yticks=[])


def _side_px(corners: np.ndarray) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max())
