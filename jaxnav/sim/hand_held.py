"""A rig that is held in a hand before markers: its smooth trajectory, its IMU and its corners.

    path = HandHeld.draw(key, looks_at_m=(0.0, 0.0, 0.0), stands_at_m=(2.0, 0.5, 0.3))
    samples = imu_samples(path, CONSUMER, key, duration_s=20.0)
    frames = observe(path, rig, markers, samples, stamps_ns, key)

Position and turn are sums of sines about a stand from which the vehicle's x axis points at a place;
velocity, acceleration and turn rate are their derivatives, of the IMU's place too.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key

from jaxnav.core.models.geometry import rotation_from_matrix, rotation_matrix, safe_norm
from jaxnav.core.models.imu import ImuNoise, ImuSamples, Preintegrated
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import Observation
from jaxnav.sim.corners import see

GRAVITY_MPS2 = (0.0, 0.0, -9.81)
_SINES = 3
_SLOWEST_HZ, _FASTEST_HZ = 0.2, 0.9  # of a hand that looks around
_SETTLES_S = 1.0  # from rest to full swing


class HandHeld(eqx.Module):
    """A trajectory. Columns of the sines: x, y, z in m, then a rotation vector in rad."""

    stands_at_m: Float[Array, " 3"]
    looks_at_m: Float[Array, " 3"]
    amplitude: Float[Array, "sines 6"]
    frequency_hz: Float[Array, "sines 6"]
    phase_rad: Float[Array, "sines 6"]
    still_s: Float[Array, ""] | float = 0.0  # at rest up to then
    roll_radps: Float[Array, ""] | float = 0.0  # turns steadily about its line of sight

    @staticmethod
    def draw(
        key: Key[Array, ""],
        looks_at_m: tuple[float, float, float],
        stands_at_m: tuple[float, float, float],
        swing_m: float = 0.25,
        swing_rad: float = 0.25,
        still_s: float = 0.0,
        roll_radps: float = 0.0,
    ) -> "HandHeld":
        """A random trajectory.

        Args:
            swing_m, swing_rad: standard deviations of place and turn along each axis.
        """
        shape = (_SINES, 6)
        key_frequency, key_phase = jax.random.split(key)
        sigma = jnp.repeat(jnp.asarray([swing_m, swing_rad]), 3)
        return HandHeld(
            jnp.asarray(stands_at_m, float),
            jnp.asarray(looks_at_m, float),
            jnp.broadcast_to(sigma * np.sqrt(2 / _SINES), shape),
            jax.random.uniform(key_frequency, shape, float, _SLOWEST_HZ, _FASTEST_HZ),
            jax.random.uniform(key_phase, shape, float, 0, 2 * np.pi),
            still_s,
            roll_radps,
        )

    def T_world_vehicle(self, time_s: Float[Array, ""]) -> jaxlie.SE3:
        """The pose at a time."""
        share = jnp.clip((time_s - self.still_s) / _SETTLES_S, 0, 1)
        share = jnp.where(
            jnp.asarray(self.still_s) > 0, share**3 * (10 + share * (6 * share - 15)), 1
        )
        angle = 2 * jnp.pi * self.frequency_hz * time_s + self.phase_rad
        swing = share * jnp.sum(self.amplitude * jnp.sin(angle), axis=0)
        ahead = self.looks_at_m - self.stands_at_m
        x = ahead / safe_norm(ahead)
        y = jnp.cross(jnp.asarray([0.0, 0.0, 1.0], x.dtype), x)
        y = y / safe_norm(y)
        stand = rotation_from_matrix(jnp.stack([x, y, jnp.cross(x, y)], axis=1))
        roll = jaxlie.SO3.from_x_radians(jnp.asarray(self.roll_radps * time_s, x.dtype))
        return jaxlie.SE3.from_rotation_and_translation(
            stand @ roll @ jaxlie.SO3.exp(swing[3:]), self.stands_at_m + swing[:3]
        )

    def readings(
        self,
        time_s: Float[Array, ""],
        lever_arm_m: Float[Array, " 3"],
        gravity_mps2: Float[Array, " 3"],
    ) -> tuple[Float[Array, " 3"], Float[Array, " 3"]]:
        """Turn rate, rad/s, and specific force, m/s^2, in the vehicle's axes, of a place on it."""

        def place(t: Array) -> Array:
            return self.T_world_vehicle(t) @ lever_arm_m

        def R_world_vehicle(t: Array) -> Array:
            return rotation_matrix(self.T_world_vehicle(t).rotation())

        one = jnp.ones_like(time_s)
        R, R_rate = jax.jvp(R_world_vehicle, (time_s,), (one,))
        spin = R.T @ R_rate
        rate = jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]])

        def velocity(t: Array) -> Array:
            return jax.jvp(place, (t,), (one,))[1]

        acceleration = jax.jvp(velocity, (time_s,), (one,))[1]
        return rate, R.T @ (acceleration - gravity_mps2)


def imu_samples(
    path: HandHeld,
    noise: ImuNoise,
    key: Key[Array, ""],
    duration_s: float,
    rate_hz: float = 200.0,
    T_vehicle_imu: Float[np.ndarray, "4 4"] | None = None,
    delay_s: float = 0.0,
    gravity_mps2: tuple[float, float, float] = GRAVITY_MPS2,
) -> ImuSamples:
    """The samples of an IMU with biases that wander, and noise, from -0.5 s on.

    Args:
        delay_s: stamps are so late; `ImuSamples.delay_s` says so.
    """
    T = np.eye(4) if T_vehicle_imu is None else T_vehicle_imu
    arm, gravity = jnp.asarray(T[:3, 3], float), jnp.asarray(gravity_mps2, float)
    times_s = jnp.arange(-0.5, duration_s + 0.1, 1 / rate_hz)
    gyro, accel = _all_readings(path, times_s, arm, gravity)
    start_key, walk_key, white_key = jax.random.split(key, 3)
    densities = jnp.sqrt(noise.densities())
    shape = (len(times_s), 6)
    sigma = jnp.stack(
        [jnp.asarray(noise.gyroscope_bias_sigma), jnp.asarray(noise.accelerometer_bias_sigma)]
    )
    first = jax.random.normal(start_key, (6,)) * jnp.repeat(sigma, 3)
    steps = jax.random.normal(walk_key, shape) * (densities[None, 6:] / np.sqrt(rate_hz))
    white = jax.random.normal(white_key, shape) * (densities[None, :6] * np.sqrt(rate_hz))
    # Biases are those of the sensor's axes, which turn with it.
    off = np.asarray(first[None] + jnp.cumsum(steps, axis=0) + white)
    stamps_ns = np.round((np.asarray(times_s, np.float64) + delay_s) * 1e9).astype(np.int64)
    R = T[:3, :3]
    return ImuSamples(
        stamps_ns, np.asarray(gyro) @ R + off[:, :3], np.asarray(accel) @ R + off[:, 3:], T, noise,
        delay_s,
    )  # fmt: skip


def observe(
    path: HandHeld,
    rig: CameraRig,
    markers: MarkerMap,
    samples: ImuSamples | None,
    stamps_ns: Int[np.ndarray, " F"],
    key: Key[Array, ""],
    corner_noise_px: float = 1.0,
    hidden: Bool[np.ndarray, " F"] | None = None,
) -> Observation:
    """The observations (F,) along a path, with the truth in `T_world_vehicle_true`.

    Args:
        samples: of the IMU; None: there is none.
        hidden: frames in which no marker is in view, whatever the rig would see.
    """
    count = len(stamps_ns)
    times_s = jnp.asarray(stamps_ns / 1e9, float)
    dt_s = jnp.asarray(np.diff(stamps_ns, prepend=stamps_ns[:1]) / 1e9, float)
    shown = jnp.ones(count, bool) if hidden is None else ~jnp.asarray(hidden)
    imu = None if samples is None else jax.tree.map(jnp.asarray, samples.between(stamps_ns))
    rows = times_s, dt_s, shown, jax.random.split(key, count), imu
    frames: Observation = _all_frames(path, rig, markers, corner_noise_px, rows)
    return frames


@jax.jit
def _all_readings(
    path: HandHeld, times_s: Array, arm: Array, gravity: Array
) -> tuple[Array, Array]:
    return jax.vmap(lambda t: path.readings(t, arm, gravity))(times_s)


@jax.jit
def _all_frames(
    path: HandHeld,
    rig: CameraRig,
    markers: MarkerMap,
    corner_noise_px: Array,
    rows: tuple[Array, Array, Array, Array, Preintegrated | None],
) -> Observation:
    def frame(
        t: Array, dt_s: Array, shown: Array, key: Array, imu: Preintegrated | None
    ) -> Observation:
        T_world_vehicle = path.T_world_vehicle(t)
        corners_px, visible = see(rig, markers, T_world_vehicle)
        noise_px = corner_noise_px * jax.random.normal(key, corners_px.shape, corners_px.dtype)
        return Observation(
            corners_px + noise_px,
            visible & shown,
            dt_s=dt_s,
            has_odometry=jnp.asarray(False),
            imu=imu,
            T_world_vehicle_true=T_world_vehicle,
        )

    return jax.vmap(frame)(*rows)
