"""Simulate the car: its true motion under a command.

Speed follows the throttle with a first-order lag, the servo turns at a bounded rate, and the
bicycle model moves the car along arcs. Pure JAX functions, so that a rollout can be scanned,
vmapped and differentiated.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxnav.control import Command
from jaxnav.models import bicycle
from jaxnav.models.bicycle import Vehicle


class CarState(eqx.Module):
    """The true state of the car. The heading is not wrapped: it counts turns."""

    pose: Float[Array, "*batch 3"]  # x_m, y_m, psi_rad
    speed_mps: Float[Array, "*batch"]
    steering_rad: Float[Array, "*batch"]


class OdometryNoise(eqx.Module):
    """The errors of the wheel odometer and the steering sensor."""

    speed_sigma_mps: float = 0.01
    steering_sigma_rad: float = 0.005
    speed_scale: float = 1.0  # 1.1: the odometer reports 10 % too much
    steering_offset_rad: float = 0.0  # what the sensor reports with the wheels straight ahead
    spin: float = 0.0  # 0.5: while the wheels spin, the odometer reports another 50 % more
    spin_s: float = 1.0  # how long they spin
    spin_period_s: float = 3.0  # from the begin of one spin to that of the next
    spin_from_s: float = 2.0  # when one begins; 0: as the car starts off

    def scale_at(self, stamp_s: Float[Array, ""] | float) -> Float[Array, ""] | float:
        """What the spinning wheels multiply the reported speed by at a time."""
        return 1 + self.spin * ((stamp_s - self.spin_from_s) % self.spin_period_s < self.spin_s)


def move(vehicle: Vehicle, state: CarState, command: Command, dt_s: Float[Array, ""]) -> CarState:
    """The car's state after a time short against the speed's time constant and the turn."""
    turn_limit = vehicle.steering_rate_limit_radps * dt_s
    wanted = jnp.clip(command.steering_rad, -vehicle.steering_limit_rad, vehicle.steering_limit_rad)
    steering = state.steering_rad + jnp.clip(wanted - state.steering_rad, -turn_limit, turn_limit)
    throttle = jnp.clip(command.throttle, -vehicle.throttle_limit, vehicle.throttle_limit)
    final_mps = throttle * vehicle.speed_per_throttle_mps
    speed = final_mps + (state.speed_mps - final_mps) * jnp.exp(
        -dt_s / vehicle.speed_time_constant_s
    )
    pose = bicycle.advance(
        state.pose,
        (state.speed_mps + speed) / 2,
        (state.steering_rad + steering) / 2,
        dt_s,
        vehicle.wheelbase_m,
    )
    return CarState(pose, speed, steering)


def move_through(
    vehicle: Vehicle, state: CarState, command: Command, dt_s: Float[Array, ""], substeps: int
) -> CarState:
    """The car's state at `substeps` evenly spaced instants up to dt, leading axis (substeps,)."""

    def one(state: CarState, _: None) -> tuple[CarState, CarState]:
        moved = move(vehicle, state, command, dt_s / substeps)
        return moved, moved

    return jax.lax.scan(one, state, None, length=substeps)[1]


def read_odometry(
    state: CarState,
    noise: OdometryNoise,
    key: Key[Array, ""],
    speed_scale: Float[Array, ""] | float | None = None,
    stamp_s: Float[Array, ""] | float = 0.0,
) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """(speed_mps, steering_rad) as the sensors report them at a time since the start.

    The scale is `noise`'s by default; that of spinning wheels comes on top.
    """
    speed_scale = noise.speed_scale if speed_scale is None else speed_scale
    if noise.spin:
        speed_scale = speed_scale * noise.scale_at(stamp_s)
    speed_error, steering_error = jax.random.normal(key, (2,), state.speed_mps.dtype)
    return (
        speed_scale * state.speed_mps + noise.speed_sigma_mps * speed_error,
        state.steering_rad + noise.steering_offset_rad + noise.steering_sigma_rad * steering_error,
    )
