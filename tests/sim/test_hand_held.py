"""A simulated rig in a hand: its IMU tells its trajectory, and the filter its own errors."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav.core.filter.imu import InertialMotion
from jaxnav.core.filter.kalman import nis
from jaxnav.core.models.geometry import inverse_cayley
from jaxnav.core.models.imu import CONSUMER, ImuNoise
from jaxnav.core.navigator import Navigator
from jaxnav.sim.hand_held import HandHeld, imu_samples, observe
from jaxnav.sim.single_frames import pinhole_rig
from tests.worlds import marker_map, upright

EXACT = ImuNoise(1e-12, 1e-12, 0.0, 0.0, 0.0, 0.0)
CENTER_M = (0.0, 0.0, 1.0)
RIG = pinhole_rig(1, 600.0, 0.0)
MARKER = marker_map([(upright(0.0), list(CENTER_M))], [0.172])
PLACE = np.eye(4)
PLACE[:3, :3] = Rotation.from_rotvec([0.4, -1.0, 2.0]).as_matrix()
PLACE[:3, 3] = [0.1, -0.2, 0.3]
STAMPS_NS = np.arange(0, 10_000, 100) * 1_000_000


def walk(seed, stands_at_m=(1.8, 0.7, 1.3), noise=CONSUMER, hidden=None, gravity=None, **options):
    """The observations of ten seconds at 10 Hz, 1 px."""
    keys = jax.random.split(jax.random.key(seed), 3)
    path = HandHeld.draw(keys[0], CENTER_M, stands_at_m, **options)
    world = {} if gravity is None else {"gravity_mps2": gravity}
    samples = imu_samples(path, noise, keys[1], 10.0, T_vehicle_imu=PLACE, **world)
    return path, samples, observe(path, RIG, MARKER, samples, STAMPS_NS, keys[2], 1.0, hidden)


@pytest.mark.parametrize("roll_radps", [0.0, 5.0])
def test_the_readings_are_those_of_the_trajectory(roll_radps):
    """Integrated from frame to frame they lead along it, at the IMU's own place."""
    path, samples, obs = walk(0, noise=EXACT, roll_radps=roll_radps)
    T = np.asarray(obs.T_world_vehicle_true.as_matrix())
    arm = PLACE[:3, 3]

    def place(times_s):
        wxyz_xyz = jax.vmap(lambda t: path.T_world_vehicle(t).wxyz_xyz)(jnp.asarray(times_s))
        T = np.asarray(jaxlie.SE3(wxyz_xyz).as_matrix())
        return T[:, :3, 3] + T[:, :3, :3] @ arm

    times_s, h = STAMPS_NS / 1e9, 1e-4
    p, v = place(times_s), (place(times_s + h) - place(times_s - h)) / (2 * h)
    g, dt = np.array([0, 0, -9.81]), 0.1
    told = samples.between(STAMPS_NS)
    R, dR = T[:, :3, :3], np.asarray(told.R_begin_end.as_matrix())
    np.testing.assert_allclose(R[:-1] @ dR[1:], R[1:], atol=2e-4)
    dv = np.einsum("nij,nj->ni", R[:-1], told.velocity_mps[1:])
    np.testing.assert_allclose(v[:-1] + g * dt + dv, v[1:], atol=2e-3)
    dp = np.einsum("nij,nj->ni", R[:-1], told.position_m[1:])
    np.testing.assert_allclose(p[:-1] + v[:-1] * dt + g * dt**2 / 2 + dp, p[1:], atol=1e-4)


def test_biases_and_noise_are_as_large_as_told():
    path = HandHeld.draw(jax.random.key(0), CENTER_M, (2.0, 0.0, 1.0), swing_m=0.0, swing_rad=0.0)
    means, scatters = [], []
    for seed in range(60):
        samples = imu_samples(path, CONSUMER, jax.random.key(seed), 2.0)
        readings = np.hstack([samples.gyro_radps, samples.accel_mps2 - [0, 0, 9.81]])
        means.append(readings[0])
        scatters.append(np.diff(readings, axis=0).std(axis=0) / np.sqrt(2))
    sigma = np.repeat([CONSUMER.gyroscope_bias_sigma, CONSUMER.accelerometer_bias_sigma], 3)
    np.testing.assert_allclose(np.std(means, axis=0) / sigma, 1, atol=0.3)
    densities = CONSUMER.gyroscope_noise_density, CONSUMER.accelerometer_noise_density
    white = np.repeat(densities, 3) * np.sqrt(200)
    np.testing.assert_allclose(np.mean(scatters, axis=0) / white, 1, atol=0.05)


def test_a_rig_that_is_put_down_first_is_still_and_then_is_not():
    *_, obs = walk(1, still_s=4.0)
    still = np.asarray(obs.imu.still)
    np.testing.assert_array_equal(still[1:40], True)
    assert not still[46:].any()
    T = obs.T_world_vehicle_true.wxyz_xyz
    np.testing.assert_allclose(T[:40], np.tile(T[:1], (40, 1)), atol=1e-12)


@jax.jit
def localise(navigator, obs):
    """Of each frame: error, NEES, whether decided, sigma of the position, error of the biases."""

    def step(state, obs):
        state, out = navigator.step(state, obs)
        error = inverse_cayley(out.T_world_vehicle.inverse() @ obs.T_world_vehicle_true)
        P = out.covariance[:6, :6]
        bank = state.belief.bank
        best = jnp.argmax(jnp.where(bank.initialised, bank.log_weight, -jnp.inf))
        told = error, nis(error, P), out.decided, out.located, jnp.diagonal(out.covariance)
        return state, (*told, bank.mean[best, 13:22])

    return jax.lax.scan(step, navigator.init(), obs)[1]


def navigator(motion=None) -> Navigator:
    arm = jnp.asarray(PLACE[:3, 3])
    motion = motion or InertialMotion()
    motion = dataclasses.replace(motion, lever_arm_m=arm)
    return Navigator(RIG, MARKER, motion=motion)


@pytest.mark.long
def test_errors_are_as_large_as_said_with_a_marker_now_and_then():
    """Eight hands; the marker is hidden from 4 to 6.5 s and from 8 to 9 s."""
    times_s = STAMPS_NS / 1e9
    hidden = ((times_s >= 4) & (times_s < 6.5)) | ((times_s >= 8) & (times_s < 9))
    seen, blind, ends_m, of_gyro = [], [], [], []
    for seed in range(8):
        path, samples, obs = walk(seed, hidden=hidden)
        error, nees, _, located, variance, rest = localise(navigator(), obs)
        assert np.all(located)
        seen.append(np.mean(nees[(times_s > 1.5) & ~hidden]))
        blind.append(np.mean(nees[hidden]))
        ends_m.append(np.linalg.norm(error[64, :3]))
        exact = imu_samples(path, EXACT, jax.random.key(0), 10.0, T_vehicle_imu=PLACE)
        late = samples.stamps_ns > 9e9
        bias = PLACE[:3, :3] @ np.mean((samples.gyro_radps - exact.gyro_radps)[late], axis=0)
        of_gyro.append((bias - rest[-1, :3]) / np.sqrt(variance[-1, 12:15]))
        assert np.all(np.sqrt(variance[-1, 12:15]) < 0.5 * CONSUMER.gyroscope_bias_sigma)
    # Six numbers each; successive ones are alike, so that a hand's mean scatters widely.
    assert 3 < np.mean(seen) < 10
    assert 2.5 < np.mean(blind) < 12
    assert 0.3 < np.mean(np.square(of_gyro)) < 2.5
    assert np.median(ends_m) < 0.35  # after 2.5 s; without an IMU it is metres


@pytest.mark.long
def test_gravity_decides_for_a_body_at_rest_where_it_is_known():
    """3.5 m off at 1 px both poses of the marker, seen from above, fit; nothing moves for 4 s."""
    decided, wrong = {True: [], False: []}, []
    for seed in range(4):
        lean = np.deg2rad(2.0) * (seed % 2)  # of the map, which is called level
        gravity = 9.81 * np.sin(lean), 0.0, -9.81 * np.cos(lean)
        above = 3.3, 0.1, 2.2
        *_, obs = walk(seed, stands_at_m=above, still_s=4.0, gravity=gravity)
        for level in (True, False):
            motion = None if level else InertialMotion.in_any_world()
            error, _, known, *_ = localise(navigator(motion), obs)
            turn_rad = np.linalg.norm(np.asarray(error)[:, 3:], axis=1)
            decided[level].append(np.mean(known[10:40]))
            wrong.append(np.max(turn_rad[np.asarray(known)], initial=0))
    assert np.mean(decided[True]) > 0.9
    assert np.mean(decided[False]) < 0.6
    assert np.max(wrong) < np.deg2rad(20)
