"""Simulate the vehicle: its true motion under a command.

A car's speed follows the throttle with a first-order lag, its servo turns at a bounded rate, and
the bicycle model moves it along arcs. Each part of another base's twist follows the one commanded
with a first-order lag. Pure JAX functions, so that a rollout can be scanned, vmapped and
differentiated.
"""

from collections.abc import Callable
from typing import Any, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxnav.core.control import Command, TwistCommand
from jaxnav.core.models.vehicle import TwistBase, Vehicle, advance_bicycle, advance_twist


class CarState(eqx.Module):
    """The true state of the car. The heading is not wrapped: it counts turns."""

    pose: Float[Array, "*batch 3"]  # x_m, y_m, psi_rad
    speed_mps: Float[Array, "*batch"]
    steering_rad: Float[Array, "*batch"]


class BaseState(eqx.Module):
    """The true state of a base that is no car. The heading is not wrapped: it counts turns."""

    pose: Float[Array, "*batch 3"]  # x_m, y_m, psi_rad
    twist: Float[Array, "*batch 3"]  # v_x_mps, v_y_mps, omega_radps in its own axes


_State = TypeVar("_State", bound=CarState | BaseState)


class OdometryNoise(eqx.Module):
    """The errors of the wheel odometer and the steering sensor, or of a base's twist."""

    speed_sigma_mps: float = 0.01
    steering_sigma_rad: float = 0.005
    speed_scale: float = 1.0  # 1.1: the odometer reports 10 % too much
    steering_offset_rad: float = 0.0  # what the sensor reports with the wheels straight ahead
    turn_sigma_radps: float = 0.01  # of a base that is no car, as are the next two
    turn_scale: float = 1.0  # 1.1: it reports 10 % more turn than its wheels' way means
    turn_offset_radpm: float = 0.0  # what it reports on a straight way, unequal wheels
    spin: float = 0.0  # 0.5: while the wheels spin, the odometer reports another 50 % more
    spin_s: float = 1.0  # how long they spin
    spin_period_s: float = 3.0  # from the begin of one spin to that of the next
    spin_from_s: float = 2.0  # when one begins; 0: as the car starts off

    def scale_at(self, stamp_s: Float[Array, ""] | float) -> Float[Array, ""] | float:
        """What the spinning wheels multiply the reported speed by at a time."""
        return 1 + self.spin * ((stamp_s - self.spin_from_s) % self.spin_period_s < self.spin_s)

    def scaled(
        self, speed_scale: Float[Array, ""] | float | None, stamp_s: Float[Array, ""] | float
    ) -> Float[Array, ""] | float:
        """A drive's scale of the speed, or that of these errors, with what spinning adds."""
        speed_scale = self.speed_scale if speed_scale is None else speed_scale
        return speed_scale * self.scale_at(stamp_s)


def move_car(
    vehicle: Vehicle, state: CarState, command: Command, dt_s: Float[Array, ""]
) -> CarState:
    """The car's state after a time short against the speed's time constant and the turn."""
    turn_limit = vehicle.steering_rate_limit_radps * dt_s
    wanted = jnp.clip(command.steering_rad, -vehicle.steering_limit_rad, vehicle.steering_limit_rad)
    steering = state.steering_rad + jnp.clip(wanted - state.steering_rad, -turn_limit, turn_limit)
    throttle = jnp.clip(command.throttle, -vehicle.throttle_limit, vehicle.throttle_limit)
    final_mps = throttle * vehicle.speed_per_throttle_mps
    speed = final_mps + (state.speed_mps - final_mps) * jnp.exp(
        -dt_s / vehicle.speed_time_constant_s
    )
    pose = advance_bicycle(
        state.pose,
        (state.speed_mps + speed) / 2,
        (state.steering_rad + steering) / 2,
        dt_s,
        vehicle.wheelbase_m,
    )
    return CarState(pose, speed, steering)


def move_base(
    base: TwistBase, state: BaseState, command: TwistCommand, dt_s: Float[Array, ""]
) -> BaseState:
    """The base's state after a time short against its time constant and the turn."""
    wanted = jnp.stack([command.forward_mps, command.left_mps, command.turn_radps])
    wanted = jnp.clip(wanted, -base.limits, base.limits)
    twist = wanted + (state.twist - wanted) * jnp.exp(-dt_s / base.time_constant_s)
    return BaseState(advance_twist(state.pose, (state.twist + twist) / 2, dt_s), twist)


def move(
    vehicle: Vehicle | TwistBase,
    state: _State,
    command: Command | TwistCommand,
    dt_s: Float[Array, ""],
) -> _State:
    """The state of a car or of another base after a short time."""
    mover: Callable[..., Any] = move_base if isinstance(vehicle, TwistBase) else move_car
    moved: _State = mover(vehicle, state, command, dt_s)
    return moved


def move_through(
    vehicle: Vehicle | TwistBase,
    state: _State,
    command: Command | TwistCommand,
    dt_s: Float[Array, ""],
    substeps: int,
) -> _State:
    """Its state at `substeps` evenly spaced instants up to dt, leading axis (substeps,)."""

    def one(state: _State, _: None) -> tuple[_State, _State]:
        moved = move(vehicle, state, command, dt_s / substeps)
        return moved, moved

    states: _State = jax.lax.scan(one, state, None, length=substeps)[1]
    return states


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
    speed_scale = noise.scaled(speed_scale, stamp_s)
    speed_error, steering_error = jax.random.normal(key, (2,), state.speed_mps.dtype)
    return (
        speed_scale * state.speed_mps + noise.speed_sigma_mps * speed_error,
        state.steering_rad + noise.steering_offset_rad + noise.steering_sigma_rad * steering_error,
    )


def read_twist(
    state: BaseState,
    noise: OdometryNoise,
    key: Key[Array, ""],
    speed_scale: Float[Array, ""] | float | None = None,
    stamp_s: Float[Array, ""] | float = 0.0,
) -> Float[Array, " 6"]:
    """The twist as a base's odometry reports it at a time since the start; see `read_odometry`."""
    speed_scale = noise.scaled(speed_scale, stamp_s)
    errors = jax.random.normal(key, (3,), state.twist.dtype)
    x, y, turn = state.twist
    turn = noise.turn_scale * turn + noise.turn_offset_radpm * x
    sigmas = (noise.speed_sigma_mps, noise.speed_sigma_mps, noise.turn_sigma_radps)
    x, y, turn = (
        speed_scale * part + sigma * error
        for part, sigma, error in zip((x, y, turn), sigmas, errors, strict=True)
    )
    zero = jnp.zeros_like(x)
    return jnp.stack([x, y, zero, zero, zero, turn])


def at_rest(vehicle: Vehicle | TwistBase, pose: Float[Array, " 3"]) -> CarState | BaseState:
    """The state of a car or of another base that stands."""
    if isinstance(vehicle, TwistBase):
        return BaseState(pose, jnp.zeros_like(pose))
    zero = jnp.zeros_like(pose[0])
    return CarState(pose, zero, zero)


def standing(vehicle: Vehicle | TwistBase, dtype: jnp.dtype) -> Command | TwistCommand:
    """The command that lets it stand."""
    zero = jnp.zeros((), dtype)
    return TwistCommand(zero, zero, zero) if isinstance(vehicle, TwistBase) else Command(zero, zero)


def odometry(
    vehicle: Vehicle | TwistBase, state: Any, noise: OdometryNoise, *args: Any
) -> dict[str, Any]:
    """The fields of an `Observation` that the wheels fill; `args` as `read_odometry` takes them."""
    if isinstance(vehicle, TwistBase):
        return {"twist": read_twist(state, noise, *args)}
    speed_mps, steering_rad = read_odometry(state, noise, *args)
    return {"speed_mps": speed_mps, "steering_rad": steering_rad}
