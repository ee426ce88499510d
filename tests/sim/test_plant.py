"""The simulated car against physics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from jaxnav.core.control import Command
from jaxnav.core.models.vehicle import Vehicle, curvature_per_m
from jaxnav.sim.plant import CarState, OdometryNoise, move, move_through, read_odometry

VEHICLE = Vehicle.create(0.256, 0.5, 0.3, 6.0, 0.3)
AT_REST = CarState(jnp.zeros(3), jnp.zeros(()), jnp.zeros(()))
through = jax.jit(move_through, static_argnums=4)
one_move = jax.jit(move)


def command(steering_rad: float, throttle: float) -> Command:
    return Command(jnp.asarray(steering_rad), jnp.asarray(throttle))


def test_speed_settles_with_its_time_constant():
    states = through(VEHICLE, AT_REST, command(0.0, 0.1), jnp.asarray(3.0), 1000)
    times_s = 3.0 * np.arange(1, 1001) / 1000
    expected = 0.6 * (1 - np.exp(-times_s / 0.3))
    np.testing.assert_allclose(states.speed_mps, expected, atol=1e-9)
    # Distance is the integral of that speed.
    np.testing.assert_allclose(states.pose[-1, 0], 0.6 * (3 - 0.3 * (1 - np.exp(-10.0))), atol=1e-5)


def test_the_servo_turns_at_its_rate_and_stops_at_its_limit():
    states = through(VEHICLE, AT_REST, command(2.0, 0.0), jnp.asarray(0.2), 100)
    np.testing.assert_allclose(np.diff(states.steering_rad)[:40], 5.0 * 0.002, atol=1e-12)
    assert states.steering_rad[-1] == pytest.approx(0.5)


def test_a_steady_turn_is_a_circle():
    radius_m = 1 / float(curvature_per_m(jnp.asarray(0.4), VEHICLE.wheelbase_m))
    start = CarState(jnp.zeros(3), jnp.asarray(0.6), jnp.asarray(0.4))
    period_s = 2 * np.pi * radius_m / 0.6
    states = through(VEHICLE, start, command(0.4, 0.1), jnp.asarray(period_s), 1000)
    np.testing.assert_allclose(states.pose[-1, :2], 0, atol=1e-9)
    np.testing.assert_allclose(states.pose[-1, 2], 2 * np.pi, atol=1e-9)
    spread = np.ptp(np.asarray(states.pose[:, :2]), axis=0)
    np.testing.assert_allclose(spread, 2 * radius_m, rtol=1e-4)


@settings(max_examples=60)
@given(st.floats(-1e6, 1e6), st.floats(-1e6, 1e6), st.floats(-2.0, 2.0), st.floats(-0.5, 0.5))
def test_no_command_takes_the_car_beyond_its_limits(steering, throttle, speed, angle):
    state = CarState(jnp.zeros(3), jnp.asarray(speed), jnp.asarray(angle))
    moved = one_move(VEHICLE, state, command(steering, throttle), jnp.asarray(0.01))
    assert abs(moved.steering_rad) <= 0.5 + 1e-12
    assert abs(moved.steering_rad - angle) <= 0.05 + 1e-12
    assert abs(moved.speed_mps) <= max(abs(speed), 0.3 * 6.0) + 1e-12


def test_odometry_is_noisy_and_scaled():
    state = CarState(jnp.zeros(3), jnp.asarray(0.5), jnp.asarray(0.1))
    noise = OdometryNoise(0.02, 0.01, speed_scale=1.1, steering_offset_rad=0.03)
    keys = jax.random.split(jax.random.key(0), 4000)
    speed, steering = jax.vmap(lambda key: read_odometry(state, noise, key))(keys)
    assert np.mean(speed) == pytest.approx(0.55, abs=4 * 0.02 / np.sqrt(4000))
    assert np.std(speed) == pytest.approx(0.02, rel=0.06)
    assert np.mean(steering) == pytest.approx(0.13, abs=4 * 0.01 / np.sqrt(4000))
    assert np.std(steering) == pytest.approx(0.01, rel=0.06)
