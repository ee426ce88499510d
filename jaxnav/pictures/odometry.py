"""Draw a calibration of odometry: the drive, the residuals and the figures."""

import textwrap

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.calibrate.odometry.calibrate import OdometryCalibration
from jaxnav.pictures.localisation import BLACK, BLUE, ORANGE, SKY, VERMILION

_GROUPS = 60  # groups of views whose means are drawn


def odometry_report(
    calibration: OdometryCalibration, corners_world_m: Float[np.ndarray, "M 4 3"], figures: str
) -> Figure:
    """Draw the drive on the map, residuals and readings over time, and the figures with advice.

    Args:
        corners_world_m: (M, 4, 3) corners of the markers.
        figures: the lines of a table.
    """
    figure = Figure(figsize=(11, 8), layout="constrained")
    (drive, residuals), (text_axes, readings) = figure.subplots(2, 2)
    _draw_drive(drive, calibration, corners_world_m)
    _draw_residuals(residuals, calibration)
    _draw_readings(readings, calibration)
    text_axes.axis("off")
    text_axes.text(
        0, 1, figures, family="monospace", fontsize=9, va="top", transform=text_axes.transAxes
    )
    advice = "\n".join(textwrap.fill(sentence, 62) for sentence in calibration.advice)
    text_axes.text(0, 0.55, f"What to drive next\n{advice}", fontsize=9, va="top",
              transform=text_axes.transAxes)  # fmt: skip
    return figure


def _draw_drive(axes: Axes, calibration: OdometryCalibration, corners_world_m: np.ndarray) -> None:
    x_m, y_m = calibration.poses[:, :2].T
    axes.plot(x_m, y_m, ".", ms=1, color=BLUE, label="way of the car")
    for index, corners_m in enumerate(corners_world_m):
        label = "markers" if index == 0 else None
        axes.plot(corners_m[:, 0], corners_m[:, 1], color=BLACK, lw=3, label=label)
    title = f"{calibration.way_m:.1f} m in {calibration.duration_s:.0f} s"
    axes.set(xlabel="x (m)", ylabel="y (m)", title=title, aspect="equal")
    axes.legend(fontsize="small")


def _draw_residuals(axes: Axes, calibration: OdometryCalibration) -> None:
    """Draw each view's residual, and group means, which would show a wrong delay or scale."""
    good, times_s = ~calibration.outliers, calibration.view_times_s
    off_px = calibration.views_px.mean(axis=1)
    for axis, name, colour in ((0, "u", BLUE), (1, "v", ORANGE)):
        axes.plot(times_s[good], off_px[good, axis], ".", ms=2, color=colour, alpha=0.4)
        groups = np.array_split(np.flatnonzero(good), min(_GROUPS, int(good.sum())))
        middle = [float(times_s[group].mean()) for group in groups]
        mean = [float(off_px[group, axis].mean()) for group in groups]
        axes.plot(middle, mean, color=colour, label=f"{name}, mean of {len(groups[0])} views")
    reach = 4 * float(np.std(off_px[good])) + 1e-6
    far = np.clip(off_px[~good, 0], -reach, reach)
    if len(far):
        axes.plot(times_s[~good], far, "x", color=VERMILION, label="counts less")
    title = f"corners: {calibration.rms_px:.2f} px RMS, chi-square {calibration.chi2_per_dof:.2f}"
    axes.set(xlabel="time (s)", ylabel="seen less explained (px)", title=title)
    axes.set_ylim(-1.2 * reach, 1.2 * reach)
    axes.legend(fontsize="small")


def _draw_readings(axes: Axes, calibration: OdometryCalibration) -> None:
    times_s = calibration.node_times_s[:-1]
    axes.plot(times_s, calibration.read[:, 0], color=SKY, lw=1, label="speed (m/s)")
    axes.plot(times_s, calibration.read[:, 1], color=VERMILION, lw=1, label="steering (rad)")
    axes.set(xlabel="time (s)", ylabel="as read (m/s, rad)", title="what the odometer said")
    axes.legend(fontsize="small")
