"""Study closed-loop drives: whether and when the car arrives, and how well it knows its pose.

A trial is one drive of `Rollout`: the navigator's own step, plant, odometer and corners.
"""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Shaped

from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.filter.selectors import SELECTORS, make_selector
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.navigator import Navigator
from jaxnav.experiments.studies.lanes import in_precision
from jaxnav.experiments.studies.parameters import Parameter, cameras, positive, told_noise_px
from jaxnav.experiments.studies.study import (
    Cell,
    Config,
    Progress,
    Rate,
    Schema,
    Study,
    Variable,
    nobody,
)
from jaxnav.sim.bases import BASES, IMUS, equipped
from jaxnav.sim.rollout import Keep, Rollout, Trace
from jaxnav.sim.scenarios import Scenario, on_laps, scenarios
from jaxnav.sim.scores import Drives

OUTCOMES = ("arrived", "failed", "left the floor", "invalid")
ARRIVED, FAILED, LEFT_FLOOR, INVALID = range(4)


def _error(description: str, unit: str, high: float, low: float = 0.0) -> Parameter:
    """A parameter for an error that the navigator does not know of, by default the scenario's."""
    described = f"{description}; else the scenario's"
    return Parameter(described, unit, None, low=low, high=high, static=True)


PARAMETERS = {
    "scenario": Parameter("what happens", "", "paper", choices=tuple(scenarios()), static=True),
    "selector": Parameter(
        "which pose is believed", "", "multi-hypothesis", choices=tuple(SELECTORS), static=True
    ),
    "base": Parameter(
        "what drives: the vehicle, or a base of the QCar's size",
        "",
        "ackermann",
        choices=BASES,
        static=True,
    ),
    "imu": Parameter(
        "gyro of that class; none: the vehicle's", "", "none", choices=IMUS, static=True
    ),
    "frame_rate_hz": Parameter(
        "pictures a second; else the scenario's", "Hz", None, low=0.5, high=15.0, static=True
    ),
    "cameras": cameras("the first ones of the rig; by default all"),
    "corner_noise_px": Parameter("standard deviation of a corner coordinate", "px", 1.0, low=0.0),
    "corner_drift_px": Parameter(
        "of what stays or drifts beside it; else the scenario's", "px", None, low=0.0
    ),
    "corner_correlation": _error("of that from frame to frame, 1: it stays", "", 1.0),
    "corner_lag_s": _error("how late corners are", "s", scenarios()["paper"].frame_period_s),
    "cameras_off_deg": _error("each camera is turned by this, its own way", "deg", 180.0),
    "cameras_off_m": _error("each camera is moved by this, its own way", "m", 10.0),
    "told_noise_px": positive("sigma the estimator is told (R); else the noise", "px", None),
    "marker_size_m": positive("side of every marker; by default the map's", "m", None),
    "focal_px": positive("mean of the cameras' focal lengths; else the rig's", "px", None),
    "process_noise_scale": positive("times the motion model's Q", "", 1.0),
    "odometry_noise_scale": positive("times the odometry's R", "", 1.0),
    "proportional_per_m": Parameter("gain of the throttle", "1/m", 0.03, low=0.0),
    "integral_per_ms": Parameter("gain of the throttle", "1/(m s)", 0.005, low=0.0),
    "waypoint_radius_m": positive("a waypoint is reached within this", "m", 0.15),
    "start_x_m": Parameter("where the drive starts; by default the scenario's", "m", None),
    "start_y_m": Parameter("where the drive starts; by default the scenario's", "m", None),
    "start_heading_deg": Parameter("of the start; by default the scenario's", "deg", None),
    "odometer_scale": Parameter(
        "what the odometer reports over what is true", "", None, low=0.1, high=10.0, static=True
    ),
    "wheel_spin": _error("share of the speed that is reported too much, 1 s of 3", "", 10.0),
    "wheel_spin_from_s": _error("when a spin begins, 0: as the car starts off", "s", 3.0),
    "steering_offset_deg": _error("reported straight ahead", "deg", 45.0, low=-45.0),
    "laps": Parameter(
        "before the marker; 0: the scenario's route",
        "",
        0,
        low=0,
        high=100,
        whole=True,
        static=True,
    ),
    "duration_s": Parameter(
        "a drive ends after this", "s", None, low=0.1, high=3600.0, static=True
    ),
}


SCHEMA = Schema(
    kind="drive",
    parameters=PARAMETERS,
    variables={
        "outcome": Variable("what became of the drive", dtype="int8", outcomes=OUTCOMES),
        "ever_wrong": Variable(
            "whether a decided pose was the wrong one", dtype="int8", outcomes=("no", "yes")
        ),
        "wrong_fraction": Variable("of the frames with a pose, heading off by 20 degrees"),
        "wrong_once_decided_fraction": Variable("of the frames that are decided"),
        "duration_s": Variable("of the drive", "s"),
        "time_to_decide_s": Variable("from the start; missing where it never decided", "s"),
        "position_error_m": Variable("median over the decided frames of a drive", "m"),
        "position_error_max_m": Variable("largest of the decided frames of a drive", "m"),
        "rotation_error_deg": Variable("median over the decided frames of a drive", "deg"),
        "nees": Variable("mean over the decided frames of a drive, 3 degrees of freedom"),
        "lm_steps": Variable("of the slower candidate, mean over the frames"),
    },
    rates={
        "success_rate": Rate("arrived, of all drives", "outcome", ("arrived",), OUTCOMES),
        "flip_rate": Rate("ever wrong once decided", "ever_wrong", ("yes",), ("no", "yes")),
        "invalid_rate": Rate("not finite", "outcome", ("invalid",), OUTCOMES),
    },
    box_trials=256,
)


class DriveStudy(Study):
    """The study that `jaxnav study drive` runs."""

    schema = SCHEMA

    def __init__(
        self, config: Config, rig: CameraRig, markers: MarkerMap, vehicle: Vehicle | TwistBase
    ):
        super().__init__(config)
        world = (rig, markers, vehicle)
        self.rig, self.markers, self.vehicle = in_precision(world, config.precision)

    def run(
        self, cells: Sequence[Cell], trials: range, progress: Progress = nobody
    ) -> dict[str, Shaped[np.ndarray, "cells ... trials"]]:
        with jax.enable_x64(self.config.precision == "float64"):
            scored = [self._cell(cell, trials, progress) for cell in cells]
        return {name: np.stack([one[name] for one in scored]) for name in SCHEMA.variables}

    def _cell(self, cell: Cell, trials: range, progress: Progress) -> dict[str, np.ndarray]:
        """Run the drives of one cell: their scores (trials,) by name."""
        scenario = self.scenario(cell)
        rollout = self.rollout(cell, scenario)
        key = jax.random.key(self.config.seed)
        keys = jax.vmap(lambda trial: jax.random.fold_in(key, trial))(jnp.asarray(trials))
        # The same bits for any number of drives in a box.
        trace, _ = rollout.run_keeping(keys, Keep(), progress, like=self.config.trials)
        return _scores(trace, scenario)

    @staticmethod
    def scenario(cell: Cell) -> Scenario:
        """The scenario of a cell."""
        value: dict[str, Any] = dict(cell)
        scenario = scenarios()[value["scenario"]]
        if value["laps"] and scenario.drives:
            scenario = on_laps(scenario, value["laps"])
        turn_rad, shift_m = scenario.extrinsics_off
        starts = (value["start_x_m"], value["start_y_m"], _radians(value["start_heading_deg"]))
        changed: Scenario = _replaced(
            scenario,
            odometry=_replaced(
                scenario.odometry,
                speed_scale=value["odometer_scale"],
                spin=value["wheel_spin"],
                spin_from_s=value["wheel_spin_from_s"],
                steering_offset_rad=_radians(value["steering_offset_deg"]),
            ),
            extrinsics_off=(
                _given(_radians(value["cameras_off_deg"]), turn_rad),
                _given(value["cameras_off_m"], shift_m),
            ),
            start_pose=tuple(map(_given, starts, scenario.start_pose)),
            corner_drift_px=_given(value["corner_drift_px"], scenario.corner_drift_px),
            corner_lag_s=value["corner_lag_s"],
            corner_correlation=value["corner_correlation"],
            frame_period_s=value["frame_rate_hz"] and 1 / value["frame_rate_hz"],
            duration_s=value["duration_s"],
        )
        return changed

    def rollout(self, cell: Cell, scenario: Scenario) -> Rollout:
        """The simulation of a cell's drives."""
        value: dict[str, Any] = dict(cell)
        rig, markers = self._world(value)
        vehicle = equipped(self.vehicle, value["base"], value["imu"])
        motion = BicycleKalman(
            vehicle,
            tilt_sigma_rad=scenario.told_tilt_sigma_rad,
            height_sigma_m=scenario.told_height_sigma_m,
        )
        motion = eqx.tree_at(
            lambda m: (m.acceleration_density, m.odometry_sigma),
            motion,
            (
                motion.acceleration_density * value["process_noise_scale"],
                motion.odometry_sigma * np.sqrt(value["odometry_noise_scale"]),
            ),
        )
        told_px = told_noise_px(value["told_noise_px"], value["corner_noise_px"])
        navigator = Navigator(
            rig=rig,
            markers=markers,
            vehicle=vehicle,
            waypoints_m=scenario.waypoints_m,
            waypoint_radius_m=value["waypoint_radius_m"],
            selector=make_selector(value["selector"]),
            motion=motion,
            proportional_per_m=value["proportional_per_m"],
            integral_per_ms=value["integral_per_ms"],
            corner_sigma_px=told_px,
        )
        return Rollout(navigator, vehicle, markers, scenario, value["corner_noise_px"])

    def _world(self, value: Mapping[str, Any]) -> tuple[CameraRig, MarkerMap]:
        rig, markers = jax.tree.map(jnp.asarray, (self.rig, self.markers))
        rig = rig.first(value["cameras"] or len(rig))
        if value["focal_px"] is not None:
            rig = rig.with_focal_px(value["focal_px"])
        if value["marker_size_m"] is not None:
            sizes_m = jnp.full_like(markers.size_m, value["marker_size_m"])
            markers = eqx.tree_at(lambda m: m.size_m, markers, sizes_m)
        return rig, markers


def _given(value: float | None, usual: float) -> float:
    return usual if value is None else value


def _radians(value_deg: float | None) -> float | None:
    return None if value_deg is None else float(np.deg2rad(value_deg))


def _replaced(whole: Any, **fields: object) -> Any:
    """A dataclass with those fields replaced that are not None."""
    return dataclasses.replace(whole, **{k: v for k, v in fields.items() if v is not None})


def _scores(trace: Trace, scenario: Scenario) -> dict[str, np.ndarray]:
    """The scores of drives: one number per drive for each variable."""
    drives = Drives.from_trace(trace, scenario)
    on_floor = np.asarray(trace.on_floor).all(axis=1)
    outcome = np.where(drives.success, ARRIVED, np.where(on_floor, FAILED, LEFT_FLOOR))
    finite = np.isfinite(np.asarray(trace.pose)).all(axis=2) & np.isfinite(drives.nees)
    broken = np.any(~finite & drives.counted, axis=1)
    wrong_decided = drives.wrong & drives.decided
    yaw_deg = np.rad2deg(drives.yaw_error_rad)
    return {
        "outcome": np.where(broken, INVALID, outcome).astype(np.int8),
        "ever_wrong": np.where(broken, np.iinfo(np.int8).max, wrong_decided.any(axis=1)).astype(
            np.int8
        ),
        "wrong_fraction": _fraction(drives.wrong & drives.counted, drives.counted),
        "wrong_once_decided_fraction": _fraction(wrong_decided, drives.decided),
        "duration_s": drives.duration_s.astype(np.float32),
        "time_to_decide_s": np.where(
            np.isfinite(drives.time_to_decide_s), drives.time_to_decide_s, np.nan
        ).astype(np.float32),
        "position_error_m": _over(np.nanmedian, drives.position_error_m, drives.decided),
        "position_error_max_m": _over(np.nanmax, drives.position_error_m, drives.decided),
        "rotation_error_deg": _over(np.nanmedian, yaw_deg, drives.decided),
        "nees": _over(np.nanmean, drives.nees, drives.decided),
        "lm_steps": _over(np.nanmean, np.asarray(trace.lm_steps), drives.counted),
    }


def _fraction(part: np.ndarray, whole: np.ndarray) -> np.ndarray:
    count = whole.sum(axis=1)
    fraction = part.sum(axis=1) / np.maximum(count, 1)
    return np.where(count > 0, fraction, np.nan).astype(np.float32)


def _over(
    statistic: Callable[..., np.ndarray], values: np.ndarray, frames: np.ndarray
) -> np.ndarray:
    """A statistic over the selected frames of every drive; NaN for a drive without any."""
    some = frames.any(axis=1)
    chosen = np.where(frames, values, np.nan)
    chosen[~some, 0] = 0.0  # so that NumPy does not warn
    return np.where(some, statistic(chosen, axis=1), np.nan).astype(np.float32)
