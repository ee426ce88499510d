"""Simulated bases that are no cars, and gyros, against physics."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.control import TwistCommand
from jaxnav.core.filter.choose import Oracle
from jaxnav.core.filter.odometry import velocity_of_twist
from jaxnav.core.models.imu import GYROS, Gyro
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.core.navigator import Navigator
from jaxnav.sim.bases import equipped
from jaxnav.sim.gyro import read_gyro, switched_on
from jaxnav.sim.plant import BaseState, OdometryNoise, at_rest, move_through, read_twist
from jaxnav.sim.rollout import Rollout
from jaxnav.sim.scenarios import scenarios
from jaxnav.sim.world import Truth
from tests import worlds
from tests.helpers.spying import keys

BASE = TwistBase.create(1.0, 4.0, 0.2, left_limit_mps=0.5)
through = jax.jit(move_through, static_argnums=4)
gyro_reads = jax.jit(read_gyro)


def command(*twist: float) -> TwistCommand:
    return TwistCommand(*map(jnp.asarray, twist))


def test_each_part_of_the_twist_follows_with_its_time_constant_inside_its_limits():
    states = through(
        BASE, at_rest(BASE, jnp.zeros(3)), command(0.6, 2.0, -9.0), jnp.asarray(2.0), 1000
    )
    follows = 1 - np.exp(-2.0 * np.arange(1, 1001) / 1000 / 0.2)
    expected = np.array([0.6, 0.5, -4.0]) * follows[:, None]
    np.testing.assert_allclose(states.twist, expected, atol=1e-9)
    turned = -4.0 * (2.0 - 0.2 * (1 - np.exp(-10.0)))
    np.testing.assert_allclose(states.pose[-1, 2], turned, atol=1e-4)


def test_a_differential_base_never_moves_to_its_side():
    base = equipped(worlds.qcar(), "differential", "none")
    states = through(
        base, at_rest(base, jnp.zeros(3)), command(1.0, 1.0, 2.0), jnp.asarray(1.0), 50
    )
    np.testing.assert_array_equal(states.twist[:, 1], 0)


def test_odometry_is_wrong_as_it_is_told():
    noise = OdometryNoise(
        0.0, turn_sigma_radps=0.0, speed_scale=1.1, turn_scale=0.9, turn_offset_radpm=0.02
    )
    state = BaseState(jnp.zeros(3), jnp.asarray([0.5, 0.2, 1.0]))
    read = read_twist(state, noise, jax.random.key(0))
    expected = [0.55, 0.22, 0.0, 0.0, 0.0, 1.1 * (0.9 + 0.02 * 0.5)]
    np.testing.assert_allclose(read, expected, rtol=1e-12)


def test_the_filter_takes_back_what_the_simulation_adds():
    """The twist that sensors with these errors show is, corrected by them, the true one."""
    errors = jnp.asarray([0.04, -0.06, 0.05, 0.01])
    truth = Truth(BASE, jnp.asarray(1.0), jnp.asarray(0.0), errors)
    state = BaseState(jnp.zeros(3), jnp.asarray([0.5, 0.2, 1.0]))
    x, y, turn = truth.sensed(state).twist
    mean = jnp.concatenate([jnp.zeros(7), errors])
    read = velocity_of_twist(jnp.stack([x, y, x * 0, x * 0, x * 0, turn]), mean)
    np.testing.assert_allclose(read.velocity, state.twist, rtol=1e-12)


def test_a_gyro_reads_the_whole_turn_late_scaled_and_biased():
    gyro = Gyro(0.0, 0.1, 0.0, 30.0, scale_sigma=0.01, delay_s=0.02)
    state = switched_on(gyro, 0.01, 0.1, jax.random.key(3), jnp.dtype(float))
    assert float(state.late_s) == pytest.approx(0.03)
    turns, dt_s, read = np.sin(np.arange(50)), 0.1, 0.0
    state, first = gyro_reads(gyro, state, jnp.asarray(0.0), jnp.asarray(0.0), jax.random.key(0))
    assert np.isnan(first[2])
    for index, turned in enumerate(turns):
        key = jax.random.key(index)
        state, z = gyro_reads(gyro, state, jnp.asarray(turned), jnp.asarray(dt_s), key)
        read += float(z[2]) * dt_s
    seen = turns.sum() - 0.3 * turns[-1]  # of the last interval 0.03 of 0.1 s are to come
    assert read == pytest.approx(float(state.scale) * seen + float(state.bias_radps) * 5.0)


def test_a_gyro_s_noise_and_walk_are_those_of_its_data_sheet():
    gyro, dt_s = Gyro(1e-2, 0.05, 1e-2, 0.5), 0.04

    @jax.vmap
    def drive(key):
        state = switched_on(gyro, 0.0, dt_s, key, jnp.dtype(float))

        def frame(state, key):
            state, z = read_gyro(gyro, state, jnp.zeros(()), jnp.asarray(dt_s), key)
            return state, (z[2], state.bias_radps)

        return jax.lax.scan(frame, state, jax.random.split(key, 25))[1]

    z, bias = jax.jit(drive)(keys(jnp.arange(2000)))
    assert np.std(bias[:, 0]) == pytest.approx(0.05, rel=0.1)
    assert np.std(bias[:, -1] - bias[:, 0]) == pytest.approx(1e-2 * np.sqrt(24 * dt_s), rel=0.1)
    assert np.std(z[:, 1:] - bias[:, :-1]) == pytest.approx(1e-2 / np.sqrt(dt_s), rel=0.1)
    wild = gyro_reads(
        gyro,
        switched_on(gyro, 0.0, dt_s, jax.random.key(0), jnp.dtype(float)),
        jnp.asarray(3.0),
        jnp.asarray(dt_s),
        jax.random.key(0),
    )[1]
    assert float(wild[2]) == 0.5


def test_names_of_bases_and_gyros():
    car = worlds.qcar()
    assert equipped(car, "ackermann", "none") is car
    assert equipped(car, "ackermann", "tactical").gyro == GYROS["tactical"]
    assert float(equipped(car, "omni", "none").left_limit_mps) > 0
    assert float(equipped(car, "differential", "consumer").left_limit_mps) == 0


@pytest.mark.long
@pytest.mark.parametrize("name", ["paper", "gyro-late"])
def test_a_base_with_a_gyro_drives_and_turns(name):
    """By the truth: what is tested is the loop of plant, gyro, filter and controller."""
    base = equipped(worlds.qcar(), "differential", "consumer")
    scenario = dataclasses.replace(scenarios()[name], duration_s=6.0 if name == "paper" else 1.0)
    navigator = Navigator(
        worlds.qcar_rig(), worlds.paper_markers(), base, scenario.waypoints_m, selector=Oracle()
    )
    rollout = Rollout(navigator, base, worlds.paper_markers(), scenario, 0.1, chunk_frames=15)
    trace = jax.device_get(rollout.run(keys(jnp.arange(2))))
    assert np.all(np.isfinite(trace.pose))
    if name == "paper":
        assert np.all(trace.passed.max(axis=1) == 2)
        assert np.all(trace.done[:, -1])
    else:
        psi = trace.true_pose[:, -1, 2] - trace.true_pose[:, 0, 2]
        # After the latency of the first command and the lag of the base.
        np.testing.assert_allclose(psi, 2 * np.pi * (14 / 15 - 0.03 - 0.15), atol=0.05)
        np.testing.assert_array_equal(np.ptp(trace.true_pose[..., :2], axis=1), 0)
