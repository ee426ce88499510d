"""Define the scenarios of `jaxnav simulate`, by name."""

import dataclasses
from dataclasses import dataclass, field
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from jaxnav.models.rig import CameraRig
from jaxnav.simulation.plant import CarState, OdometryNoise

HEADING_SIGMA_RAD = 0.05  # noise of the compass heading given to `OrientationGiven`


@dataclass(frozen=True)
class Scenario:
    """A drive and its disturbances, which the navigator is not told.

    The `told_...` fields are what it is told: how far the car's cameras may be from level and from
    their calibration, zero where they are exact.
    """

    waypoints_m: tuple[tuple[float, float], ...]
    start_pose: tuple[float, float, float]  # x_m, y_m, psi_rad
    start_spread: tuple[float, float, float] = (0.1, 0.1, float(np.deg2rad(10.0)))  # uniform, +-
    drives: bool = True  # False: parked
    duration_s: float = 40.0
    frame_period_s: float = 1 / 15  # the paper's cluster captures and detects at 15 Hz
    latency_s: float = 0.03  # from the stamp of a frame until its command acts
    floor_m: tuple[float, float, float, float] = (-2.5, 2.5, -2.5, 2.5)  # x_min x_max y_min y_max
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    hidden_s: tuple[float, float] = (0.0, 0.0)  # begin and end of the time without any marker
    kidnapped_s: float = np.inf  # when the car is displaced
    kidnapped_by: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, m, rad, in the world
    extrinsics_off: tuple[float, float] = (0.0, 0.0)  # rad, m; each camera in its own direction
    told_tilt_sigma_rad: float = 0.0
    told_height_sigma_m: float = 0.0
    corner_lag_s: float = 0.0  # corners lie where they were this long before the stamp

    @property
    def frames(self) -> int:
        """The number of frames of the longest drive."""
        return int(np.ceil(self.duration_s / self.frame_period_s))

    def hidden(self, stamp_s: Float[Array, ""]) -> Bool[Array, ""]:
        """Whether all markers are hidden at a time."""
        begin_s, end_s = self.hidden_s
        return (stamp_s >= begin_s) & (stamp_s < end_s)

    def displaced(
        self, car: CarState, stamp_s: Float[Array, ""], period_s: Float[Array, ""]
    ) -> CarState:
        """The car's state, displaced if the kidnapping falls into this frame."""
        now = (stamp_s >= self.kidnapped_s) & (stamp_s < self.kidnapped_s + period_s)
        shift = jnp.where(now, jnp.asarray(self.kidnapped_by, car.pose.dtype), 0)
        return eqx.tree_at(lambda c: c.pose, car, car.pose + shift)

    def true_rig(self, rig: CameraRig, key: Key[Array, ""]) -> CameraRig:
        """The true rig, if the navigator believes `rig`."""
        turn_rad, shift_m = self.extrinsics_off
        if turn_rad == 0 and shift_m == 0:
            return rig
        directions = jax.random.normal(key, (len(rig), 2, 3), rig.cameras.focal_px.dtype)
        directions = directions / jnp.linalg.norm(directions, axis=2, keepdims=True)
        xi = jnp.concatenate([shift_m * directions[:, 0], turn_rad * directions[:, 1]], axis=1)
        wxyz_xyz = jax.vmap(lambda T, xi: (T @ jaxlie.SE3.exp(xi)).wxyz_xyz)(
            rig.Ts_camera_vehicle, xi
        )
        return eqx.tree_at(lambda r: r.Ts_camera_vehicle, rig, jaxlie.SE3(wxyz_xyz))

    def other_sensors(
        self, car: CarState, T_world_vehicle: jaxlie.SE3, key: Key[Array, ""]
    ) -> dict[str, Any]:
        """The further measurements that only `OrientationGiven` and `Oracle` use."""
        error = jax.random.normal(key, (), car.pose.dtype)
        return {
            "heading_rad": car.pose[2] + HEADING_SIGMA_RAD * error,
            "heading_sigma_rad": HEADING_SIGMA_RAD,
            "T_world_vehicle_true": T_world_vehicle,
        }


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


def scenarios() -> dict[str, Scenario]:
    """All scenarios, by name."""
    paper = _paper()
    vary = dataclasses.replace
    return {
        "paper": paper,
        "static": vary(paper, drives=False, duration_s=10.0, start_spread=(0.3, 0.3, np.pi)),
        "approach": vary(
            paper, start_pose=(0.1, -1.8, float(np.pi / 2)), waypoints_m=((0.1, -0.5), (0.1, 0.5))
        ),
        "orbit": _orbit(),
        "tunnel": vary(paper, hidden_s=(2.0, 4.0)),
        "kidnapped": vary(paper, kidnapped_s=3.0, kidnapped_by=(0.7, -0.7, float(np.pi / 2))),
        "slip": vary(paper, odometry=OdometryNoise(speed_scale=1.1)),
        "miscalibrated": vary(
            paper,
            extrinsics_off=(float(np.deg2rad(1.0)), 0.01),
            told_tilt_sigma_rad=float(np.deg2rad(1.0)),
            told_height_sigma_m=0.01,
        ),
        "blur": vary(paper, corner_lag_s=0.02),
    }
