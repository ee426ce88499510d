"""Drives of a car whose odometry is off, as its sensors tell them. The car is plain Python and
shares no line with the models that are calibrated."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np

from jaxnav.calibrate.odometry.drive import Drive
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.sim.corners import see
from jaxnav.sim.plant import OdometryNoise

STEP_S = 0.0025
LAG_S, SERVO_RADPS, LIMIT_RAD = 0.3, 5.0, 0.5  # as the QCar's
TRUTH = np.array([1.06, 0.93, 0.02, 0.262, 0.035])  # see `odometry_model.NAMES`


@dataclass(frozen=True)
class Leg:
    """A part of a drive: until the car has turned so far, or for a time.

    Attributes:
        steering: of the servo's limit.
    """

    steering: float
    speed_mps: float
    turn_rad: float = math.inf
    time_s: float = math.inf


def eights(speeds_mps: Sequence[float], locks: Sequence[float]) -> list[Leg]:
    """A circle to the left and one to the right, at every lock and speed, with a stop between."""
    legs = []
    for lock, speed in zip(locks, speeds_mps, strict=True):
        legs += [Leg(side * lock, speed, turn_rad=2 * math.pi) for side in (1, -1)]
        legs += [Leg(lock, 0.0, time_s=0.7)]
    return legs


# In front of the paper's marker, heading for it: a circle lies to either side.
START = (0.0, 0.2, math.pi / 2)
RECIPE = eights([0.4, 0.8, 0.6, 1.0], [1.0, 1.0, 0.6, 0.8])


@dataclass(frozen=True)
class Sensors:
    """What they are like; by default those of `jaxnav simulate` and `jaxnav run`."""

    corner_sigma_px: float = 0.3
    frame_period_s: float = 1 / 15
    odometry_period_s: float = 0.02
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    wrong_share: float = 0.0  # of views that are something else


def true_track(
    legs: Sequence[Leg],
    duration_s: float,
    theta: np.ndarray = TRUTH,
    start: tuple[float, float, float] = (0.0, 0.0, 0.0),
) -> np.ndarray:
    """(n, 6): time_s, x_m, y_m, psi_rad, speed_mps, steering_rad. Legs start over when done."""
    _, gain, offset, wheelbase, _ = theta
    (x, y, psi), v, d = start, 0.0, 0.0
    rows = []
    index, turned, since = 0, 0.0, 0.0
    for step in range(round(duration_s / STEP_S)):
        rows.append((step * STEP_S, x, y, psi, v, d))
        leg = legs[index % len(legs)]
        wanted = gain * leg.steering * LIMIT_RAD + offset
        d_next = d + min(max(wanted - d, -SERVO_RADPS * STEP_S), SERVO_RADPS * STEP_S)
        v_next = leg.speed_mps + (v - leg.speed_mps) * math.exp(-STEP_S / LAG_S)
        vm, dm = (v + v_next) / 2, (d + d_next) / 2
        beta = math.atan(math.tan(dm) / 2)
        rate = vm * math.cos(beta) * math.tan(dm) / wheelbase
        course = psi + beta + rate * STEP_S / 2
        x, y = x + vm * STEP_S * math.cos(course), y + vm * STEP_S * math.sin(course)
        psi += rate * STEP_S
        v, d = v_next, d_next
        turned, since = turned + abs(rate) * STEP_S, since + STEP_S
        if turned >= leg.turn_rad or since >= leg.time_s:
            index, turned, since = index + 1, 0.0, 0.0
    return np.array(rows)


@jax.jit
def _seen(rig: CameraRig, markers: MarkerMap, poses: jax.Array) -> tuple[jax.Array, jax.Array]:
    return jax.vmap(lambda pose: see(rig, markers, T_world_vehicle_from_planar(pose)))(poses)


def sensed(
    track: np.ndarray,
    rig: CameraRig,
    markers: MarkerMap,
    seed: int,
    theta: np.ndarray = TRUTH,
    sensors: Sensors | None = None,
) -> Drive:
    """What the sensors tell of a track."""
    sensors = sensors or Sensors()
    rng = np.random.default_rng(seed)
    scale, gain, offset, _, delay_s = theta
    end_s = track[-1, 0]

    def at(times_s: np.ndarray) -> np.ndarray:
        return np.column_stack([np.interp(times_s, track[:, 0], c) for c in track[:, 1:].T])

    read_s = np.arange(0.0, end_s, sensors.odometry_period_s)
    state, noise = at(read_s), sensors.odometry
    frame_s = np.arange(0.05, end_s, sensors.frame_period_s)
    poses = at(frame_s)[:, :3]
    corners_px, visible = jax.device_get(_seen(rig, markers, jnp.asarray(poses)))
    frame, camera, marker = np.nonzero(visible)
    corners_px = corners_px[frame, camera, marker]
    corners_px = corners_px + sensors.corner_sigma_px * rng.standard_normal(corners_px.shape)
    wrong = rng.random(len(frame)) < sensors.wrong_share
    corners_px[wrong] += rng.uniform(-80, 80, (int(wrong.sum()), 1, 2))
    begin_ns = 10**12
    return Drive(
        "drive",
        begin_ns + np.round(1e9 * read_s).astype(np.int64),
        state[:, 3] / scale + noise.speed_sigma_mps * rng.standard_normal(len(read_s)),
        (state[:, 4] - offset) / gain + noise.steering_sigma_rad * rng.standard_normal(len(read_s)),
        begin_ns + np.round(1e9 * (frame_s[frame] + delay_s)).astype(np.int64),
        camera,
        marker,
        corners_px,
        np.full((len(frame), 4), sensors.corner_sigma_px),
    )
