"""Hold the state of one drive of a rollout, and the true car that its seed drew."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, Key, UInt32

from jaxnav.core.control import Command, TwistCommand
from jaxnav.core.filter.bank import Bank
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.navigator import State
from jaxnav.sim.gyro import GyroState
from jaxnav.sim.plant import BaseState, CarState
from jaxnav.sim.scenarios import Scenario


class Truth(eqx.Module):
    """The true car of one drive, unknown to the navigator."""

    vehicle: Vehicle | TwistBase
    odometer_scale: Float[Array, ""]  # reported speed over true speed
    latency_s: Float[Array, ""]  # from the stamp of a frame until its command acts
    sensor_errors: Float[Array, " 4"]  # see `SENSOR_ERRORS`, `TWIST_ERRORS`

    def sensed(self, car: CarState | BaseState) -> CarState | BaseState:
        """The car as its sensors would show it without noise."""
        scale, gain, offset_rad, _ = self.sensor_errors
        if isinstance(car, BaseState):
            x, y, turn = car.twist / (1 + scale)
            turn = (turn - offset_rad * x) / (1 + gain)  # here the offset is in rad/m
            return dataclasses.replace(car, twist=jnp.stack([x, y, turn]))
        return dataclasses.replace(
            car,
            speed_mps=car.speed_mps / (1 + scale),
            steering_rad=(car.steering_rad - offset_rad) / (1 + gain),
        )


class Spread(eqx.Module):
    """The ranges (low, high) from which each drive's true car is drawn uniformly.

    The first three are factors on the vehicle's or the scenario's own numbers, the first one a
    car's alone; the latency is added to the scenario's, and the sum is clipped to between 0 and a
    frame period.
    """

    speed_per_throttle: tuple[float, float] = (0.8, 1.2)
    speed_time_constant: tuple[float, float] = (0.5, 1.5)
    odometer_scale: tuple[float, float] = (0.95, 1.05)
    latency_s: tuple[float, float] = (-0.02, 0.03)

    def draw(self, key: Key[Array, ""], truth: Truth, longest_s: float) -> Truth:
        """Draw a car around the nominal one.

        Args:
            longest_s: upper limit of the latency, the frame period.
        """
        dtype = truth.latency_s.dtype
        ranges = (
            self.speed_per_throttle,
            self.speed_time_constant,
            self.odometer_scale,
            self.latency_s,
        )
        low, high = (jnp.asarray(ends, dtype) for ends in zip(*ranges, strict=True))
        gain, lag, scale, later_s = low + (high - low) * jax.random.uniform(key, (4,), dtype)
        car = truth.vehicle
        if isinstance(car, TwistBase):
            vehicle = eqx.tree_at(lambda v: v.time_constant_s, car, car.time_constant_s * lag)
        else:
            vehicle = eqx.tree_at(
                lambda v: (v.speed_per_throttle_mps, v.speed_time_constant_s),
                car,
                (car.speed_per_throttle_mps * gain, car.speed_time_constant_s * lag),
            )
        latency_s = jnp.clip(truth.latency_s + later_s, 0, longest_s)
        return dataclasses.replace(
            truth,
            vehicle=vehicle,
            odometer_scale=truth.odometer_scale * scale,
            latency_s=latency_s,
        )


class DriveState(eqx.Module):
    """The quantities that one seed drew, and the state of its drive."""

    key: UInt32[Array, " 2"]  # data of a JAX key
    rig: CameraRig  # the true one
    truth: Truth
    drift: Float[Array, "C M 4 2"]  # of the corners, in standard deviations
    start_pose: Float[Array, " 3"]
    car: CarState | BaseState
    acting: Command | TwistCommand  # in effect until the latency of `command` is over
    command: Command | TwistCommand
    gyro: GyroState | None
    state: State
    frame: Int[Array, ""]  # index of the next frame
    seen: Int[Array, ""]  # number of sightings in the last one
    passed: Int[Array, ""]
    ended: Bool[Array, ""]
    on_floor: Bool[Array, ""]

    @property
    def bank(self) -> Bank:
        """The navigator's hypotheses."""
        return self.state.belief.bank


def with_bank(world: DriveState, bank: Bank) -> DriveState:
    """A world whose navigator has these hypotheses."""
    replaced: DriveState = eqx.tree_at(lambda w: w.state.belief.bank, world, bank)
    return replaced


def nominal(
    vehicle: Vehicle | TwistBase, scenario: Scenario, key: Key[Array, ""], dtype: jnp.dtype
) -> Truth:
    """The scenario's car, without any spread."""
    errors = jnp.zeros(4, dtype).at[-1].set(scenario.corner_lag_s)
    if scenario.as_told and vehicle.sensor_sigma is not None:
        errors = errors + vehicle.sensor_sigma.astype(dtype) * jax.random.normal(key, (4,), dtype)
    return Truth(
        jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), vehicle),
        jnp.asarray(scenario.odometry.speed_scale, dtype),
        jnp.asarray(scenario.latency_s, dtype),
        errors,
    )
