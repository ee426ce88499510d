"""Simulate a car or another base in its world at any instant of real time or of a test's time."""

import math
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Float

from jaxnav.core.control import Command, TwistCommand
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.core.models.vehicle import Vehicle as VehicleModel
from jaxnav.detection.types import Detections
from jaxnav.drive.interfaces import GyroReading, Reading, reading_of
from jaxnav.files.executables import kept
from jaxnav.sim.corners import see
from jaxnav.sim.plant import BaseState, CarState, OdometryNoise, move

_SUBSTEP_NS = 5_000_000
_GYRO_NS, _GYRO_KEPT = 10_000_000, 50  # period of the gyro, and how many readings it keeps
_KEPT = 400  # substeps: two seconds into the past


@kept
def _moved(
    vehicle: VehicleModel | TwistBase, row: jax.Array, command: jax.Array, dt_s: jax.Array
) -> jax.Array:
    """`move` on plain arrays: x_m, y_m, psi_rad, then speed_mps and steering_rad or a twist."""
    if isinstance(vehicle, TwistBase):
        base = move(vehicle, BaseState(row[:3], row[3:]), TwistCommand(*command), dt_s)
        return jnp.concatenate([base.pose, base.twist])
    car = CarState(row[:3], row[3], row[4])
    car = move(vehicle, car, Command(command[0], command[1]), dt_s)
    return jnp.concatenate([car.pose, jnp.stack([car.speed_mps, car.steering_rad])])


@kept
def _seen(rig: CameraRig, markers: MarkerMap, pose: jax.Array) -> tuple[jax.Array, jax.Array]:
    return see(rig, markers, T_world_vehicle_from_planar(pose))


@dataclass(frozen=True)
class WorldSettings:
    """The noise, delay and timeout of the simulated vehicle."""

    corner_sigma_px: float = 0.3
    odometry: OdometryNoise = field(default_factory=OdometryNoise)
    actuation_delay_s: float = 0.01
    vehicle_timeout_s: float = 0.2  # without a command the car stops by itself


class SimWorld:
    """The simulated vehicle and its track of the last two seconds. Thread-safe.

    Its gyro, where its description has one, has the errors that this allows for, drawn once.
    """

    def __init__(
        self,
        rig: CameraRig,
        markers: MarkerMap,
        vehicle: VehicleModel | TwistBase,
        start_pose: tuple[float, float, float],
        begin_ns: int,
        settings: WorldSettings | None = None,
        seed: int = 0,
    ):
        """Place the vehicle at rest at its start."""
        self.rig, self.markers, self.vehicle = rig, markers, vehicle
        self._plant = replace(vehicle, gyro=None)  # what moves: all its leaves are arrays
        self.settings = settings or WorldSettings()
        self.rng = np.random.default_rng(seed)
        self._lock = threading.Lock()
        rest = (0.0,) * (3 if isinstance(vehicle, TwistBase) else 2)  # also as a command
        self._dtype = np.dtype(vehicle.dtype)
        self._row = np.array([*start_pose, *rest], self._dtype)
        self._time_ns = begin_ns
        self._track: deque[tuple[int, np.ndarray]] = deque([(begin_ns, self._row)], maxlen=_KEPT)
        # Commands and the times at which they act: the last one that is due is obeyed.
        self._commands: deque[tuple[int, tuple[float, ...]]] = deque([(begin_ns, rest)])
        self._written_ns = self._gyro_ns = begin_ns
        # Of the gyro, whose bias does not walk; numbers that no other sensor uses.
        normal = np.random.default_rng([seed, 1]).standard_normal(3)
        self._gyro_bias, self._gyro_scale, self._gyro_late = normal.tolist()
        self._held = False
        self._acts: Callable[[tuple[float, ...]], tuple[float, ...]] = lambda command: command
        self._reads: Callable[..., tuple[float, ...]] = lambda read, command: read

    def write(self, *command_and_ns: float) -> None:
        """Take a command, which acts after the actuation delay.

        Args:
            command_and_ns: its numbers, and then the time, ns.
        """
        command, now_ns = command_and_ns[:-1], int(command_and_ns[-1])
        with self._lock:
            self._advance(now_ns)
            due_ns = now_ns + int(self.settings.actuation_delay_s * 1e9)
            self._commands.append((due_ns, command))
            self._written_ns = now_ns

    def carry_off(self, by: tuple[float, float, float]) -> None:
        """Move the vehicle by (m, m, rad) in the world, as a person who carries it."""
        with self._lock:
            moved = self._row.copy()
            moved[:3] += np.array(by, self._dtype)
            self._row = moved

    def hold(self, held: bool) -> None:
        """Hold the vehicle fast, wheels included, or let it go."""
        with self._lock:
            self._held = held

    def rewire(
        self,
        acts: Callable[[tuple[float, ...]], tuple[float, ...]] = lambda command: command,
        reads: Callable[..., tuple[float, ...]] = lambda read, command: read,
    ) -> None:
        """Connect the actuators and the odometer in another way.

        Args:
            acts: what acts in place of a command.
            reads: what is read in place of the true reading while a command is obeyed.
        """
        with self._lock:
            self._acts, self._reads = acts, reads

    def move_markers(
        self, by_m: tuple[float, float, float], which: slice = slice(None), scale: float = 1.0
    ) -> None:
        """Move markers by so much in the world, or scale them."""
        with self._lock:
            Ts = self.markers.Ts_world_marker
            moved = Ts.wxyz_xyz.at[which, 4:].add(jnp.asarray(by_m, Ts.wxyz_xyz.dtype)[None])
            size_m = self.markers.size_m.at[which].multiply(scale)
            self.markers = eqx.tree_at(lambda m: m.size_m, self.markers, size_m)
            self.markers = eqx.tree_at(lambda m: m.Ts_world_marker.wxyz_xyz, self.markers, moved)

    def copy_markers(self, by: tuple[float, float, float]) -> None:
        """Add a copy of every marker, moved by (m, m, rad) about the origin."""
        with self._lock:
            markers = self.markers
            Ts = markers.Ts_world_marker.wxyz_xyz
            turn = T_world_vehicle_from_planar(jnp.asarray(by, Ts.dtype))
            copies = jax.vmap(lambda T: (turn @ jaxlie.SE3(T)).wxyz_xyz)(Ts)
            self.markers = MarkerMap(
                jaxlie.SE3(jnp.concatenate([Ts, copies])),
                jnp.concatenate([markers.size_m] * 2),
                markers.ids * 2,
                markers.families * 2,
            )

    def knock_camera(self, camera: int, turn_rad: tuple[float, float, float]) -> None:
        """Turn a camera about its own axes, by a rotation vector."""
        with self._lock:
            Ts = self.rig.Ts_camera_vehicle.wxyz_xyz
            turn = jaxlie.SE3.from_rotation(jaxlie.SO3.exp(jnp.asarray(turn_rad, Ts.dtype)))
            turned = Ts.at[camera].set((turn @ jaxlie.SE3(Ts[camera])).wxyz_xyz)
            self.rig = eqx.tree_at(lambda r: r.Ts_camera_vehicle.wxyz_xyz, self.rig, turned)

    def state(self, at_ns: int) -> Float[np.ndarray, " n"]:
        """The truth at an instant of the last two seconds.

        x_m, y_m, psi_rad, then speed_mps and steering_rad of a car, the twist of another base.
        """
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

    def reading(self, at_ns: int) -> Reading:
        """The reading of the odometer at an instant, without corrections."""
        read = self.odometry(at_ns)
        with self._lock:
            return reading_of(at_ns, self._reads(read, self._obeyed(at_ns)), valid=True)

    def odometry(self, at_ns: int) -> tuple[float, ...]:
        """The noisy (speed_mps, steering_rad) of a car's sensors, or another base's twist."""
        noise, state = self.settings.odometry, self.state(at_ns)
        with self._lock:
            errors = self.rng.standard_normal(len(state) - 3)
        scale = noise.speed_scale * float(noise.scale_at(at_ns * 1e-9))
        if len(errors) == 3:
            turn_radps = noise.turn_scale * state[5] + noise.turn_offset_radpm * state[3]
            sigmas = noise.speed_sigma_mps, noise.speed_sigma_mps, noise.turn_sigma_radps
            parts = zip((state[3], state[4], turn_radps), sigmas, errors, strict=True)
            return tuple(float(scale * part + sigma * error) for part, sigma, error in parts)
        return (
            float(scale * state[3] + noise.speed_sigma_mps * errors[0]),
            float(state[4] + noise.steering_offset_rad + noise.steering_sigma_rad * errors[1]),
        )

    def gyro(self, until_ns: int) -> tuple[GyroReading, ...]:
        """The gyro's readings since the last call, up to an instant; none without a gyro.

        It keeps those of half a second.
        """
        gyro = self.vehicle.gyro
        readings: list[GyroReading] = []
        self._gyro_ns = max(self._gyro_ns, until_ns - _GYRO_KEPT * _GYRO_NS)
        while gyro is not None and self._gyro_ns + _GYRO_NS <= until_ns:
            begin_ns, self._gyro_ns = self._gyro_ns, self._gyro_ns + _GYRO_NS
            late_s = float(gyro.delay_s) + float(gyro.delay_sigma_s) * self._gyro_late
            begin_rad, end_rad = (
                self.state(max(at_ns - int(max(late_s, 0.0) * 1e9), self._track[0][0]))[2]
                for at_ns in (begin_ns, self._gyro_ns)
            )
            with self._lock:
                error = float(self.rng.standard_normal())
            dt_s, most = _GYRO_NS / 1e9, float(gyro.saturation_radps)
            scale = 1 + float(gyro.scale_sigma) * self._gyro_scale
            rate = scale * float(end_rad - begin_rad) / dt_s
            rate += float(gyro.bias_sigma_radps) * self._gyro_bias
            rate += float(gyro.noise_density) / math.sqrt(dt_s) * error
            rate = float(min(max(rate, -most), most))
            readings.append(GyroReading(begin_ns + _GYRO_NS // 2, rate))
        return tuple(readings)

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
            command = np.array(self._acts(self._obeyed(self._time_ns)), self._dtype)
            dt_s = np.asarray(step_ns / 1e9, self._dtype)
            moved = np.asarray(_moved(self._plant, self._row, command, dt_s))
            if self._held:  # it keeps its pose; a car's wheels are steered nevertheless
                steered = moved[4:] if len(moved) == 5 else np.zeros(2)
                moved = np.array([*self._row[:3], 0, *steered], self._dtype)
            self._row = moved
            self._time_ns += step_ns
            self._track.append((self._time_ns, self._row))

    def _obeyed(self, time_ns: int) -> tuple[float, ...]:
        while len(self._commands) > 1 and self._commands[1][0] <= time_ns:
            self._commands.popleft()
        command = self._commands[0][1]
        silent_s = (time_ns - self._written_ns) / 1e9
        if silent_s <= self.settings.vehicle_timeout_s:
            return command
        return (command[0], 0.0) if len(command) == 2 else (0.0, 0.0, 0.0)
