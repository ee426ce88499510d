"""Define the scenarios of `jaxnav simulate`, by name."""

import dataclasses
from collections.abc import Sequence
from dataclasses import field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from jaxnav.core.models.rig import CameraRig
from jaxnav.sim.plant import BaseState, CarState, OdometryNoise

HEADING_SIGMA_RAD = 0.05  # noise of the compass heading given to `OrientationGiven`
_LAP_M = ((1.2, -0.2), (0.0, 0.6), (-1.2, -0.2), (0.0, -1.2))  # counter-clockwise, marker in view


class Scenario(eqx.Module):
    """A drive and its disturbances, which the navigator is not told.

    Numbers are leaves: scenarios with as many waypoints share a program.

    The `told_...` fields are what it is told: how far the car's cameras may be from level and from
    their calibration, zero where they are exact.

    Raises:
        ValueError: corners that are later than a frame period, or a correlation outside 0 to 1.
    """

    waypoints_m: tuple[tuple[float, float], ...]
    start_pose: tuple[float, float, float]  # x_m, y_m, psi_rad
    start_spread: tuple[float, float, float] = (0.1, 0.1, float(np.deg2rad(10.0)))  # uniform, +-
    drives: bool = eqx.field(static=True, default=True)  # False: parked
    duration_s: float = 40.0
    frame_period_s: float = 1 / 15  # the paper's cluster captures and detects at 15 Hz
    latency_s: float = 0.03  # from the stamp of a frame until its command acts
    floor_m: tuple[float, float, float, float] = (-2.5, 2.5, -2.5, 2.5)  # x_min x_max y_min y_max
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    hidden_s: tuple[float, float] = (0.0, 0.0)  # begin and end of the time without any marker
    kidnapped_s: float = np.inf  # when the car is displaced
    kidnapped_by: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, m, rad, in the world
    extrinsics_off: tuple[float, float] = (0.0, 0.0)  # rad, m; each camera in its own direction
    # Cameras and sensors are off by what their files tell, anew each drive.
    as_told: bool = eqx.field(static=True, default=False)
    told_tilt_sigma_rad: float = 0.0
    told_height_sigma_m: float = 0.0
    corner_lag_s: float = 0.0  # corners lie where they were this long before the stamp
    # Beside the white noise, each coordinate of each corner has a part that stays or drifts.
    corner_drift_px: float = 0.0  # its standard deviation
    corner_correlation: float = 0.95  # from frame to frame; 1: constant through a drive
    gyro_late_s: float = 0.0  # a gyro's readings are later by this than it is told
    turns_radps: float = 0.0  # parked, a base that is no car turns on the spot
    # Errors of the frames from then on count apart, too.
    scored_after_s: tuple[float, ...] = eqx.field(static=True, default=())
    frames: int = eqx.field(init=False)  # of the longest drive

    def __post_init__(self) -> None:
        if not 0 <= self.corner_lag_s <= self.frame_period_s:
            raise ValueError(
                f"corner_lag_s must be from 0 to frame_period_s, {self.frame_period_s:g}, "
                f"got {self.corner_lag_s:g}"
            )
        if not 0 <= self.corner_correlation <= 1:
            raise ValueError(f"corner_correlation must be in [0, 1], got {self.corner_correlation}")
        self.frames = int(np.ceil(self.duration_s / self.frame_period_s))

    def hidden(self, stamp_s: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether all markers are hidden at a time."""
        begin_s, end_s = self.hidden_s
        return (stamp_s >= begin_s) & (stamp_s < end_s)

    def displaced(
        self, car: CarState | BaseState, stamp_s: Float[Array, ""], period_s: Float[Array, ""]
    ) -> CarState | BaseState:
        """The car's state, displaced if the kidnapping falls into this frame."""
        now = (stamp_s >= self.kidnapped_s) & (stamp_s < self.kidnapped_s + period_s)
        shift = jnp.where(now, jnp.asarray(self.kidnapped_by, car.pose.dtype), 0)
        return eqx.tree_at(lambda c: c.pose, car, car.pose + shift)

    def true_rig(self, rig: CameraRig, key: Key[Array, ""]) -> CameraRig:
        """The true rig, if the navigator believes `rig`."""
        if self.as_told:
            return _off_as_told(rig, key)
        turn_rad, shift_m = self.extrinsics_off
        directions = jax.random.normal(key, (len(rig), 2, 3), rig.cameras.focal_px.dtype)
        directions = directions / jnp.linalg.norm(directions, axis=2, keepdims=True)
        xi = jnp.concatenate([shift_m * directions[:, 0], turn_rad * directions[:, 1]], axis=1)
        wxyz_xyz = jax.vmap(lambda T, xi: (T @ jaxlie.SE3.exp(xi)).wxyz_xyz)(
            rig.Ts_camera_vehicle, xi
        )
        return eqx.tree_at(lambda r: r.Ts_camera_vehicle, rig, jaxlie.SE3(wxyz_xyz))

    def other_sensors(
        self, car: CarState | BaseState, T_world_vehicle: jaxlie.SE3, key: Key[Array, ""]
    ) -> dict[str, Any]:
        """The further measurements that only `OrientationGiven` and `Oracle` use."""
        error = jax.random.normal(key, (), car.pose.dtype)
        return {
            "heading_rad": car.pose[2] + HEADING_SIGMA_RAD * error,
            "heading_sigma_rad": HEADING_SIGMA_RAD,
            "T_world_vehicle_true": T_world_vehicle,
        }


def _off_as_told(rig: CameraRig, key: Key[Array, ""]) -> CameraRig:
    """The rig, its cameras shifted along and turned about the vehicle's axes as it allows for."""
    if rig.extrinsics_sigma is None:
        return rig
    dtype = rig.cameras.focal_px.dtype
    off = rig.extrinsics_sigma * jax.random.normal(key, (len(rig), 6), dtype)

    def one(T_camera_vehicle: jaxlie.SE3, off: Array) -> Array:
        T = T_camera_vehicle.inverse()
        turned = jaxlie.SO3.exp(off[3:]) @ T.rotation()
        moved = jaxlie.SE3.from_rotation_and_translation(turned, T.translation() + off[:3])
        return moved.inverse().wxyz_xyz

    wxyz_xyz = jax.vmap(one)(rig.Ts_camera_vehicle, off)
    return eqx.tree_at(lambda r: r.Ts_camera_vehicle, rig, jaxlie.SE3(wxyz_xyz))


def _paper() -> Scenario:
    """The scenario of the paper's experiment: Liu, Schofield, Shan (2023), section III."""
    return Scenario(
        waypoints_m=((1.30, 0.0), (0.50, 0.65)),
        start_pose=(2.0, -1.0, float(np.deg2rad(125.0))),
    )


def _orbit() -> Scenario:
    """A drive past the marker on an arc of 1.7 m, through the frontal view."""
    angles = np.deg2rad(np.arange(36.0, -61.0, -24.0))
    waypoints = [(1.7 * np.sin(a), 1.47 - 1.7 * np.cos(a)) for a in angles]
    start = np.deg2rad(60.0)
    return Scenario(
        waypoints_m=tuple((float(x), float(y)) for x, y in waypoints),
        start_pose=(
            float(1.7 * np.sin(start)),
            float(1.47 - 1.7 * np.cos(start)),
            float(np.pi + start),
        ),
    )


def on_laps(scenario: Scenario, laps: int) -> Scenario:
    """A scenario driven for this many laps of 6 m before the marker instead of on its own route.

    The paper's drive takes 8 s. What an error that repeats does in the long run, and what an
    estimator learns of it, shows later: errors after 20 s and after 60 s count apart. A lap takes
    18 s: two laps are 35 s, four are 70 s.
    """
    return dataclasses.replace(
        scenario,
        waypoints_m=_LAP_M * laps,
        duration_s=40.0 + 30.0 * laps,
        scored_after_s=(20.0, 60.0)[: laps // 2],
    )


def on_route(
    scenario: Scenario,
    waypoints_m: Sequence[tuple[float, float]],
    start_pose: tuple[float, float, float],
) -> Scenario:
    """A scenario driven on this route instead of its own, on a floor that reaches 2 m beyond it.

    The time is a lap's for its length, 5 s a metre, where that is more than the scenario's.
    """
    places_m = np.array([start_pose[:2], *waypoints_m])
    (x_min, y_min), (x_max, y_max) = places_m.min(axis=0) - 2.0, places_m.max(axis=0) + 2.0
    length_m = float(np.linalg.norm(np.diff(places_m, axis=0), axis=1).sum())
    return dataclasses.replace(
        scenario,
        waypoints_m=tuple((float(x), float(y)) for x, y in waypoints_m),
        start_pose=start_pose,
        duration_s=max(scenario.duration_s, 5.0 * length_m * scenario.drives),
        floor_m=(float(x_min), float(x_max), float(y_min), float(y_max)),
    )


def _everything() -> Scenario:
    """Half of every error that repeats at once.

    Corners are 25 ms late, which stands for blur as well, and drift by 0.25 px; each camera is off
    by 0.5 degrees and 5 mm; wheels slip by 5 %, spin by another 25 %, and the steering is off by
    0.5 degrees. Spins begin 2 s after the start, when the branch is decided. The white noise of the
    corners is as told.
    """
    return dataclasses.replace(
        _paper(),
        corner_lag_s=0.025,
        corner_drift_px=0.25,
        extrinsics_off=(float(np.deg2rad(0.5)), 0.005),
        odometry=OdometryNoise(
            speed_scale=1.05,
            steering_offset_rad=float(np.deg2rad(0.5)),
            turn_scale=1.025,
            turn_offset_radpm=0.015,
            spin=0.25,
        ),
    )


def scenarios() -> dict[str, Scenario]:
    """All scenarios, by name."""
    paper = _paper()
    vary = dataclasses.replace
    off = (float(np.deg2rad(1.0)), 0.01)  # of each camera: rad, m
    uneven = OdometryNoise(
        steering_offset_rad=float(np.deg2rad(1.0)),
        turn_scale=1.05,
        turn_offset_radpm=0.03,
        spin=0.5,
    )
    return {
        "paper": paper,
        "static": vary(paper, drives=False, duration_s=10.0, start_spread=(0.3, 0.3, np.pi)),
        "approach": vary(
            paper, start_pose=(0.1, -1.8, float(np.pi / 2)), waypoints_m=((0.1, -0.5), (0.1, 0.5))
        ),
        "orbit": _orbit(),
        "tunnel": vary(paper, hidden_s=(2.0, 4.0)),
        "kidnapped": vary(paper, kidnapped_s=3.0, kidnapped_by=(0.7, -0.7, float(np.pi / 2))),
        "long-tunnel": vary(on_laps(paper, laps=2), hidden_s=(8.0, 20.0)),
        "slip": vary(paper, odometry=OdometryNoise(speed_scale=1.1)),
        "slip-30": vary(paper, odometry=OdometryNoise(speed_scale=1.3)),
        "gyro-late": vary(
            paper, drives=False, duration_s=10.0, turns_radps=float(2 * np.pi), gyro_late_s=0.01
        ),
        "miscalibrated": vary(
            paper,
            extrinsics_off=off,
            told_tilt_sigma_rad=float(np.deg2rad(1.0)),
            told_height_sigma_m=0.01,
        ),
        "blur": vary(paper, corner_lag_s=0.02),
        "late": vary(paper, corner_lag_s=0.05),
        "drifting-corners": vary(paper, corner_drift_px=0.5),
        "each-camera-off": on_laps(vary(paper, extrinsics_off=off), laps=4),
        "uneven-wheels": vary(paper, odometry=uneven),
        "everything": _everything(),
        "as-told": vary(paper, as_told=True),
    }
