"""Draw a calibration of odometry, and the sensor errors that a drive has learnt."""

import textwrap

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.calibrate.odometry.calibrate import OdometryCalibration
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import SENSOR_ERRORS, Vehicle
from jaxnav.pictures.localisation import BLACK, BLUE, GREEN, ORANGE, SKY, VERMILION, evenly
from jaxnav.recordings.learnt import Learnt
from jaxnav.recordings.records import Outcomes

_POINTS = 400  # of a curve of what is learnt, at most
_UNITS = {"steering_offset_rad": " (rad)", "camera_delay_s": " (s)"}
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
    axes.set(xlabel="time (s)", ylabel="as read (m/s, rad)", title="readings of the odometer")
    axes.legend(fontsize="small")


def learnt_over_time(outcomes: Outcomes, rig: CameraRig, vehicle: Vehicle) -> Figure:
    """Draw each error over the drive with its sigma; the prior's is the grey band.

    A row of panels for the cameras, turned about the vehicle's axes, and one for the sensors.
    """
    known = np.flatnonzero(np.isfinite(outcomes.errors).all(axis=1) & outcomes.located)
    shown = known[evenly(len(known), _POINTS)]
    states = [
        Learnt.from_errors(outcomes.errors[i], outcomes.errors_sigma[i], rig, vehicle)
        for i in shown
    ]
    learnt = [state for state in states if state is not None]
    times_s = outcomes.times_s[shown]
    columns = max(len(rig), len(SENSOR_ERRORS))
    figure = Figure(figsize=(3.4 * columns, 6), layout="constrained")
    of_cameras, of_sensors = figure.subplots(2, columns, sharex=True)
    for camera, name in enumerate(rig.names):
        turns = np.rad2deg([state.turns_rad[camera] for state in learnt])
        sigmas = np.rad2deg([state.turns_sigma_rad[camera] for state in learnt])
        prior = float(np.rad2deg(np.max(learnt[0].turns_prior_rad[camera])))
        axes = of_cameras[camera]
        for axis, colour in enumerate((ORANGE, GREEN, BLUE)):
            label = f"about {'xyz'[axis]}"
            _curve(axes, times_s, turns[:, axis], sigmas[:, axis], colour, label)
        _panel(axes, f"camera {name}", "turned (deg)", prior)
        axes.legend(fontsize="small", loc="upper left")
    for index, name in enumerate(SENSOR_ERRORS):
        values = np.array([state.sensors[index] for state in learnt])
        sigmas = np.array([state.sensors_sigma[index] for state in learnt])
        _curve(of_sensors[index], times_s, values, sigmas, BLUE, None)
        prior = float(learnt[0].sensors_prior[index])
        _panel(of_sensors[index], name, f"off{_UNITS.get(name, '')}", prior)
        of_sensors[index].set_xlabel("time (s)")
    for axes in (*of_cameras[len(rig) :], *of_sensors[len(SENSOR_ERRORS) :]):
        axes.set_visible(False)
    return figure


def _curve(
    axes: Axes,
    times_s: np.ndarray,
    values: np.ndarray,
    sigmas: np.ndarray,
    colour: str,
    label: str | None,
) -> None:
    axes.plot(times_s, values, color=colour, lw=1.2, label=label)
    axes.fill_between(times_s, values - sigmas, values + sigmas, color=colour, alpha=0.2, lw=0)


def _panel(axes: Axes, title: str, ylabel: str, prior: float) -> None:
    axes.axhspan(-prior, prior, color="0.93", zorder=0)
    axes.axhline(0, color="0.6", lw=0.8)
    axes.set(title=title, ylabel=ylabel)
