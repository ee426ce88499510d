"""Simulate a car in its world at any instant of real time or of a test's time."""

import threading
from collections import deque
from dataclasses import dataclass, field

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from jaxnav.compiling.executables import kept
from jaxnav.control import Command
from jaxnav.detection.types import Detections
from jaxnav.models.bicycle import Vehicle as VehicleModel
from jaxnav.models.geometry import T_world_vehicle_from_planar
from jaxnav.models.markers import MarkerMap
from jaxnav.models.rig import CameraRig
from jaxnav.simulation.corners import see
from jaxnav.simulation.plant import CarState, OdometryNoise, move

_SUBSTEP_NS = 5_000_000
_KEPT = 400  # substeps: two seconds into the past


@kept
def _moved(vehicle: VehicleModel, row: jax.Array, command: jax.Array, dt_s: jax.Array) -> jax.Array:
    """`move` on plain arrays: (x_m, y_m, psi_rad, speed_mps, steering_rad)."""
    car = CarState(row[:3], row[3], row[4])
    car = move(vehicle, car, Command(command[0], command[1]), dt_s)
    return jnp.concatenate([car.pose, jnp.stack([car.speed_mps, car.steering_rad])])


@kept
def _seen(rig: CameraRig, markers: MarkerMap, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
    return see(rig, markers, T_world_vehicle_from_planar(pose))


@dataclass(frozen=True)
class WorldSettings:
    """The noise, delay and timeout of the simulated car."""

    corner_sigma_px: float = 0.3
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    actuation_delay_s: float = 0.01
    vehicle_timeout_s: float = 0.2  # without a command the car stops by itself


class SimWorld:
    """The simulated car and its track of the last two seconds. Thread-safe."""

    def __init__(
        self,
        rig: CameraRig,
        markers: MarkerMap,
        vehicle: VehicleModel,
        start_pose: tuple[float, float, float],
        begin_ns: int,
        settings: WorldSettings | None = None,
        seed: int = 0,
    ):
        """Place the car at rest at its start."""
        self.rig, self.markers, self.vehicle = rig, markers, vehicle
        self.settings = settings or WorldSettings()
        self.rng = np.random.default_rng(seed)
        self._lock = threading.Lock()
        self._dtype = np.asarray(vehicle.wheelbase_m).dtype
        self._row = np.array([*start_pose, 0.0, 0.0], self._dtype)
        self._time_ns = begin_ns
        self._track: deque[tuple[int, np.ndarray]] = deque([(begin_ns, self._row)], maxlen=_KEPT)
        # Commands and the times at which they act: the last one that is due is obeyed.
        self._commands: deque[tuple[int, float, float]] = deque([(begin_ns, 0.0, 0.0)])
        self._written_ns = begin_ns
        self._held = False

    def write(self, steering_rad: float, throttle: float, now_ns: int) -> None:
        """Take a command, which acts after the actuation delay."""
        with self._lock:
            self._advance(now_ns)
            due_ns = now_ns + int(self.settings.actuation_delay_s * 1e9)
            self._commands.append((due_ns, steering_rad, throttle))
            self._written_ns = now_ns

    def carry_off(self, by: tuple[float, float, float]) -> None:
        """Move the car by (m, m, rad) in the world, as a person would."""
        with self._lock:
            self._row = self._row + np.array([*by, 0.0, 0.0], self._dtype)

    def hold(self, held: bool) -> None:
        """Hold the car fast, wheels included, or let it go."""
        with self._lock:
            self._held = held

    def move_markers(
        self, by_m: tuple[float, float, float], which: slice = slice(None), scale: float = 1.0
    ) -> None:
        """Somebody takes markers elsewhere, by so much in the world, or puts larger ones there."""
        with self._lock:
            Ts = self.markers.Ts_world_marker
            moved = Ts.wxyz_xyz.at[which, 4:].add(jnp.asarray(by_m, Ts.wxyz_xyz.dtype)[None])
            size_m = self.markers.size_m.at[which].multiply(scale)
            self.markers = eqx.tree_at(lambda m: m.size_m, self.markers, size_m)
            self.markers = eqx.tree_at(lambda m: m.Ts_world_marker.wxyz_xyz, self.markers, moved)

    def knock_camera(self, camera: int, turn_rad: tuple[float, float, float]) -> None:
        """Somebody turns a camera about its own axes, by a rotation vector."""
        with self._lock:
            Ts = self.rig.Ts_camera_vehicle.wxyz_xyz
            turn = jaxlie.SE3.from_rotation(jaxlie.SO3.exp(jnp.asarray(turn_rad, Ts.dtype)))
            turned = Ts.at[camera].set((turn @ jaxlie.SE3(Ts[camera])).wxyz_xyz)
            self.rig = eqx.tree_at(lambda r: r.Ts_camera_vehicle.wxyz_xyz, self.rig, turned)

    def state(self, at_ns: int) -> Float[np.ndarray, " 5"]:
        """(x_m, y_m, psi_rad, speed_mps, steering_rad) at an instant of the last two seconds."""
        with self._lock:
            self._advance(at_ns)
            newer = self._track[-1]
            for older in reversed(self._track):
                if older[0] <= at_ns:
                    break
                newer = older
        if older[0] >= at_ns or newer[0] == older[0]:
            return older[1]
        share = (at_ns - older[0]) / (newer[0] - older[0])
        return np.asarray(older[1] + share * (newer[1] - older[1]))

    def pose(self, at_ns: int) -> Float[np.ndarray, " 7"]:
        """T_world_vehicle at an instant, (7,) wxyz_xyz."""
        x_m, y_m, psi_rad = self.state(at_ns)[:3]
        return np.array([np.cos(psi_rad / 2), 0, 0, np.sin(psi_rad / 2), x_m, y_m, 0])

    def odometry(self, at_ns: int) -> tuple[float, float]:
        """The noisy (speed_mps, steering_rad) of the sensors."""
        noise, state = self.settings.odometry, self.state(at_ns)
        with self._lock:
            errors = self.rng.standard_normal(2)
        scale = noise.speed_scale * float(noise.scale_at(at_ns * 1e-9))
        return (
            float(scale * state[3] + noise.speed_sigma_mps * errors[0]),
            float(state[4] + noise.steering_offset_rad + noise.steering_sigma_rad * errors[1]),
        )

    def detections(self, at_ns: int) -> list[Detections]:
        """The detections of each camera, with noise on the corners."""
        pose = self.state(at_ns)[:3]
        corners_px, visible = jax.device_get(_seen(self.rig, self.markers, pose))
        sigma_px = self.settings.corner_sigma_px
        with self._lock:
            noise_px = sigma_px * self.rng.standard_normal(corners_px.shape)
        return [
            Detections(
                ids=np.array([self.markers.ids[m] for m in index], int),
                corners_px=noisy_px[index],
                sigma_px=np.full((len(index), 4), max(sigma_px, 0.05)),
                refined=np.ones(len(index), bool),
                families=tuple(self.markers.families[m] for m in index),
            )
            for noisy_px, index in zip(
                corners_px + noise_px, map(np.flatnonzero, visible), strict=True
            )
        ]

    def _advance(self, until_ns: int) -> None:
        while self._time_ns < until_ns:
            step_ns = min(_SUBSTEP_NS, until_ns - self._time_ns)
            steering_rad, throttle = self._obeyed(self._time_ns)
            command = np.array([steering_rad, throttle], self._dtype)
            dt_s = np.asarray(step_ns / 1e9, self._dtype)
            moved = np.asarray(_moved(self.vehicle, self._row, command, dt_s))
            # A held car keeps its pose; its wheels are steered nevertheless.
            self._row = (
                np.array([*self._row[:3], 0, moved[4]], self._dtype) if self._held else moved
            )
            self._time_ns += step_ns
            self._track.append((self._time_ns, self._row))

    def _obeyed(self, time_ns: int) -> tuple[float, float]:
        while len(self._commands) > 1 and self._commands[1][0] <= time_ns:
            self._commands.popleft()
        _, steering_rad, throttle = self._commands[0]
        silent_s = (time_ns - self._written_ns) / 1e9
        return steering_rad, 0.0 if silent_s > self.settings.vehicle_timeout_s else throttle
