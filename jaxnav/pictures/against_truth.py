"""Draw cars that drove from the same start: their ways, and the errors of their poses."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.core.models.geometry import wrap_angle_np
from jaxnav.pictures.localisation import BLACK, BLUE, ORANGE, draw_markers, draw_waypoints

_STYLES = ({"color": BLUE}, {"color": ORANGE}, {"color": ORANGE, "ls": ":"})
_LEAST_M, _LEAST_DEG = 1e-3, 0.01  # where the logarithmic axes end


@dataclass(frozen=True)
class Driven:
    """What one method made of a drive: N instants, poses of x_m, y_m, psi_rad; NaN where none."""

    label: str
    times_s: Float[np.ndarray, " N"]
    true_poses: Float[np.ndarray, "N 3"]
    poses: Float[np.ndarray, "N 3"]

    @property
    def position_error_m(self) -> Float[np.ndarray, " N"]:
        """Distance between pose and truth."""
        return np.hypot(*(self.poses - self.true_poses)[:, :2].T)

    @property
    def heading_error_deg(self) -> Float[np.ndarray, " N"]:
        """Angle between the headings of pose and truth, 0 to 180."""
        return np.rad2deg(np.abs(wrap_angle_np((self.poses - self.true_poses)[:, 2])))


def report_against_truth(
    drives: Sequence[Driven],
    waypoints_m: Float[np.ndarray, "W 2"],
    waypoint_radius_m: float,
    markers_m: Float[np.ndarray, "M 4 3"],
    wrong_heading_deg: float,
    listened: Sequence[Driven] = (),
    title: str = "",
) -> Figure:
    """Draw the ways of one or two cars, and the errors of their poses against time.

    Args:
        drives: ours and, where there is one, the other's.
        waypoints_m: (W, 2).
        waypoint_radius_m: drawn as circles.
        markers_m: (M, 4, 3) corners in the world.
        wrong_heading_deg: drawn as a line: farther off, a pose is the wrong one.
        listened: what the other made of the images of our drive, where it listened.
        title: above everything.
    """
    figure = Figure(figsize=(9.5, 6), layout="constrained")
    figure.suptitle(title, fontsize=8.5)
    grid = figure.add_gridspec(2, 2, width_ratios=(1.15, 1))
    position, heading = (figure.add_subplot(grid[row, 0]) for row in range(2))
    panels = ((position, "position_error_m", _LEAST_M), (heading, "heading_error_deg", _LEAST_DEG))
    for axes, error, least in panels:
        for drive, style in zip([*drives, *listened], _STYLES, strict=False):
            values = np.maximum(getattr(drive, error), least)
            axes.semilogy(drive.times_s, values, label=drive.label, **style)
        axes.grid(alpha=0.3)
    heading.axhline(wrong_heading_deg, color=BLACK, lw=0.8, ls="--")
    for axes, _, least in panels:
        axes.set_ylim(bottom=least)
    end_s = max(drive.times_s[-1] for drive in drives)
    words = heading.annotate("above: the wrong pose", (end_s, wrong_heading_deg), fontsize=8)
    words.set(ha="right", va="bottom")
    position.set_ylabel("position error (m)")
    position.label_outer()
    heading.set(xlabel="time (s)", ylabel="heading error (deg)")
    heading.legend(loc="upper center", bbox_to_anchor=(0.5, -0.22), ncols=2, fontsize=8)
    _draw_ways(figure.add_subplot(grid[:, 1]), drives, waypoints_m, waypoint_radius_m, markers_m)
    return figure


def _draw_ways(
    axes: Axes,
    drives: Sequence[Driven],
    waypoints_m: np.ndarray,
    waypoint_radius_m: float,
    markers_m: np.ndarray,
) -> None:
    for drive, color in zip(drives, (BLUE, ORANGE), strict=False):
        way, estimate = drive.true_poses, drive.poses
        axes.plot(way[:, 0], way[:, 1], color=color, lw=2.2, label=f"{drive.label}: way driven")
        axes.plot(estimate[:, 0], estimate[:, 1], color=color, lw=0.9, ls="--")
        axes.plot(*way[-1, :2], "s", color=color, ms=5)
    axes.plot([], [], color=BLACK, lw=0.9, ls="--", label="where it believed to be")
    start = drives[0].true_poses[0, :2]
    axes.plot(*start, "o", color=BLACK, ms=6)
    axes.annotate("start", (start[0], start[1]), xytext=(8, -4), textcoords="offset points")
    draw_waypoints(axes, waypoints_m, waypoint_radius_m)
    draw_markers(axes, markers_m)
    axes.set(xlabel="x (m)", ylabel="y (m)")
    axes.set_aspect("equal", adjustable="datalim")
    axes.grid(alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.09), ncols=2, fontsize=8)
