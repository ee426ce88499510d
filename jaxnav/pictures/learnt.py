"""Draw what a drive learns of its cameras and sensors."""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import SENSOR_ERRORS, Vehicle
from jaxnav.pictures.localisation import BLUE, GREEN, ORANGE
from jaxnav.recordings.learnt import Learnt
from jaxnav.recordings.records import Outcomes

_POINTS = 400  # of a curve, at most
_UNITS = {"steering_offset_rad": " (rad)", "camera_delay_s": " (s)"}


def learnt_over_time(outcomes: Outcomes, rig: CameraRig, vehicle: Vehicle) -> Figure:
    """Draw each error over the drive with its sigma; the prior's is the grey band.

    A row of panels for the cameras, turned about the vehicle's axes, and one for the sensors.
    """
    known = np.flatnonzero(np.isfinite(outcomes.errors).all(axis=1) & outcomes.located)
    shown = known[np.unique(np.linspace(0, len(known) - 1, _POINTS).astype(int))]
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
