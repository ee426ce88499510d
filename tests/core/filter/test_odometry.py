"""Twists and gyros in the planar filter, against the car's filter and closed forms."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.filter import odometry
from jaxnav.core.filter.odometry import (
    SENSORS_END,
    SIX,
    read_velocity,
    slip_of,
    turn_of,
    velocity_of_twist,
)
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.imu import GYROS, Gyro
from jaxnav.core.models.vehicle import DEFAULT_TWIST_SIGMA, TwistBase
from jaxnav.core.pose.observation import Observation
from tests import worlds
from tests.derivatives import check_derivatives
from tests.helpers import filters
from tests.helpers.filters import believing, level, predicted, stepped
from tests.reference import paper

NOISE, BIAS_SIGMA = 1e-3, 0.02
GYRO = Gyro(NOISE, BIAS_SIGMA, bias_walk=0.0, saturation_radps=30.0)
ERRORS = np.array([0.05, -0.02, 0.03, 0.04, 0.01])  # s, k, g, o, tau
DT_S = 0.05


def base(gyro=None, sensor_sigma=None) -> TwistBase:
    return TwistBase.create(1.0, 4.0, 0.1, 1.0, sensor_sigma, gyro)


def reading(twist=(0.0, 0.0, 0.0), gyro_radps=np.nan, dt_s=DT_S, **car) -> Observation:
    x, y, turn = twist
    told = {"twist": [x, y, 0, 0, 0, turn], "gyro_radps": [0, 0, gyro_radps]}
    return filters.reading(dt_s=dt_s, **told, **car)


def begun(motion: BicycleKalman, *poses, sigma=0.02):
    """Hypotheses of the same weight at these poses, whose velocity says nothing of the heading."""
    bank = motion.init(len(poses))
    mean, P = np.array(bank.mean), np.array(bank.covariance)
    mean[:, :3], P[:, :SIX, :SIX] = poses, np.diag([sigma**2] * 3 + [1.0] * 3)
    return believing(motion, mean, P)


def test_a_twist_is_corrected_as_umbmark_says():
    """The errors in the order in which Borenstein and Feng name them, by hand."""
    mean = jnp.asarray(np.concatenate([[1.0, 2.0, 0.7], np.zeros(3), ERRORS]))
    read = jax.jit(velocity_of_twist)(jnp.asarray([0.5, 0.2, 9.0, 9.0, 9.0, 0.8]), mean)
    scale = 1 + 0.05 - 0.02
    x, y, turn = scale * 0.5, scale * 0.2, scale * (1.03 * 0.8 + 0.04 * 0.5)
    c, s = np.cos(0.7), np.sin(0.7)
    np.testing.assert_allclose(read.velocity, [c * x - s * y, s * x + c * y, turn], rtol=1e-12)

    def velocity(mean):
        return velocity_of_twist(jnp.asarray([0.5, 0.2, 0.0, 0.0, 0.0, 0.8]), mean).velocity

    check_derivatives(velocity, mean)
    slopes = jax.jit(jax.jacfwd(velocity))(mean)
    np.testing.assert_allclose(read.by_heading, slopes[:, 2], atol=1e-12)
    np.testing.assert_allclose(read.by_errors, slopes[:, SIX:], atol=1e-12)


def test_what_is_not_read_is_left_out():
    mean, read = jnp.zeros(SIX), jax.jit(read_velocity)
    for twist, present in (
        ((0.5, 0.0, np.nan), (1, 1, 0)),
        ((0.5, np.nan, 0.1), (0, 0, 1)),
        ((1e5, 0.0, 0.1), (0, 0, 1)),
        ((0.5, 0.0, 0.1), (1, 1, 1)),
    ):
        obs = reading(twist)
        found = read(base(), obs, mean)
        np.testing.assert_array_equal(found.present, present)
        assert np.all(np.isfinite(found.velocity))
        silent = dataclasses.replace(obs, has_odometry=jnp.asarray(False))
        np.testing.assert_array_equal(read(base(), silent, mean).present, 0)


def test_a_car_is_one_way_to_make_a_twist():
    """The filter of a base whose twist is the car's is the car's filter."""
    car = worlds.qcar()
    rng = np.random.default_rng(1)
    ours, theirs = BicycleKalman(base()), BicycleKalman(car)
    bank, expected = begun(ours, [0.1, 0.2, 3.0]), begun(theirs, [0.1, 0.2, 3.0])
    for _ in range(20):
        speed, angle = rng.uniform(-1, 1), rng.uniform(-0.5, 0.5)
        still = paper.velocity(speed, angle, 0.0, float(car.wheelbase_m))
        obs = reading(still, speed_mps=speed, steering_rad=angle)
        bank, expected = predicted(ours, bank, obs), predicted(theirs, expected, obs)
    np.testing.assert_allclose(bank.mean, expected.mean, atol=1e-12)
    np.testing.assert_allclose(bank.covariance, expected.covariance, atol=1e-12)


@pytest.mark.parametrize("gyro_radps", [np.nan, 30.0])
def test_a_gyro_that_is_silent_or_saturated_changes_nothing(gyro_radps):
    """Saturated at its limit, as a sensor reports it."""
    with_gyro = BicycleKalman(base(GYRO, DEFAULT_TWIST_SIGMA))
    without = BicycleKalman(base(None, DEFAULT_TWIST_SIGMA))
    bank, expected = begun(with_gyro, [0.0, 0.0, 0.5]), begun(without, [0.0, 0.0, 0.5])
    for twist in ((0.3, 0.1, 1.0), (0.4, 0.0, -1.0), (0.0, 0.0, 0.0)):
        bank = predicted(with_gyro, bank, reading(twist, gyro_radps))
        expected = predicted(without, expected, reading(twist))
    kept = slice(0, -odometry.GYRO)
    np.testing.assert_allclose(bank.mean[:, kept], expected.mean, atol=1e-13)
    np.testing.assert_allclose(bank.covariance[:, kept, kept], expected.covariance, atol=1e-13)
    np.testing.assert_allclose(bank.covariance[0, -1, -1], BIAS_SIGMA**2, rtol=1e-9)


@pytest.mark.parametrize(("gyro_radps", "length_m"), [(np.nan, 0.1), (0.0, 0.4)])
def test_a_slip_is_remembered_for_longer_while_a_gyro_tells(gyro_radps, length_m):
    motion = BicycleKalman(
        base(GYRO, DEFAULT_TWIST_SIGMA), slip_length_m=0.1, gyro_slip_length_m=0.4
    )
    bank = begun(motion, [0.0, 0.0, 0.5])
    bank = eqx.tree_at(lambda b: b.mean, bank, bank.mean.at[:, SIX].set(0.3).at[:, 3].set(1.0))
    obs = dataclasses.replace(reading(gyro_radps=gyro_radps), has_odometry=jnp.asarray(False))
    slip = predicted(motion, bank, obs).mean[0, SIX]
    np.testing.assert_allclose(slip, 0.3 * np.exp(-1.0 * DT_S / length_m), rtol=1e-12)


def test_the_heading_is_the_gyros_whatever_the_wheels_say():
    """With a bias that is constant, var psi = var psi_0 + N^2 t + sigma_b^2 t^2."""
    motion = BicycleKalman(base(GYRO, DEFAULT_TWIST_SIGMA))
    bank, turned = begun(motion, [0.0, 0.0, 0.3]), 0.0
    for index in range(40):
        rate = np.sin(0.3 * index)
        turned += rate * DT_S
        bank = predicted(motion, bank, reading((0.5, 0.0, 1.3 * rate), rate))
    time_s = 40 * DT_S
    assert float(bank.mean[0, 2]) == pytest.approx(0.3 + turned, abs=1e-3)
    expected = 0.02**2 + NOISE**2 * time_s + (BIAS_SIGMA * time_s) ** 2
    np.testing.assert_allclose(bank.covariance[0, 2, 2], expected, rtol=0.05)
    np.testing.assert_allclose(bank.covariance[0, 2, -1], -(BIAS_SIGMA**2) * time_s, rtol=0.05)
    assert np.all(np.linalg.eigvalsh(bank.covariance[0]) > -1e-12)


def test_errors_of_scale_and_delay_grow_with_the_turn_and_with_the_rate():
    """Three turns to one side and back leave none of the part that stays, but for d times a rate;
    the part that comes and goes is a walk of the angle, and a delay of each change."""
    off = dataclasses.replace(GYRO, scale_sigma=0.02, delay_sigma_s=0.01, bias_sigma_radps=0.0)
    motion = BicycleKalman(base(off, DEFAULT_TWIST_SIGMA))
    bank, sigmas = begun(motion, [0.0, 0.0, 0.0], sigma=1e-4), []
    for rate in np.repeat([4.0, -4.0, 0.0], 100):
        bank = predicted(motion, bank, reading((0.0, 0.0, rate), rate))
        sigmas.append(np.sqrt(bank.covariance[0, 2, 2]))
    turned_rad = 4.0 * 100 * DT_S
    for index, angle_rad, rate, changes, ways in (
        (99, turned_rad, 4, 4**2, 1),
        (199, 0.0, -4, 4**2 + 8**2, 2),
        (299, 0.0, 0, 2 * 4**2 + 8**2, 2),
    ):
        stays = (0.02 * angle_rad) ** 2 + (0.01 * rate) ** 2
        comes = 0.02**2 * ways * turned_rad + 0.01**2 * changes
        assert sigmas[index] == pytest.approx(np.sqrt(stays + comes), rel=0.02)


def test_a_turn_s_slopes_are_its_derivatives():
    off = dataclasses.replace(GYRO, scale_sigma=0.02, delay_s=0.01, delay_sigma_s=0.01)
    mean = jnp.asarray(np.random.default_rng(3).normal(size=SENSORS_END + odometry.GYRO) / 30)

    def of(mean):
        turn = turn_of(off, reading(gyro_radps=1.3), mean, jnp.asarray(0.0))
        return jnp.stack([mean[2] + turn.turn_rad, turn.rate_radps])

    slopes = jax.jit(turn_of)(off, reading(gyro_radps=1.3), mean, jnp.asarray(0.0)).slopes
    np.testing.assert_allclose(slopes, jax.jit(jax.jacfwd(of))(mean), atol=1e-12)


def test_a_late_gyro_is_brought_forward():
    """At a rate that grows steadily the turn of the last interval is known but for its end."""
    late = dataclasses.replace(GYRO, delay_s=0.02)
    motion = BicycleKalman(base(late, DEFAULT_TWIST_SIGMA))
    bank, slope = begun(motion, [0.0, 0.0, 0.0]), 2.0
    psi = lambda t: slope * max(t, 0.0) ** 2 / 2  # noqa: E731
    for index in range(1, 21):
        now = index * DT_S
        seen = (psi(now - 0.02) - psi(now - DT_S - 0.02)) / DT_S
        bank = predicted(motion, bank, reading((0.5, 0.0, slope * now), seen))
    # What is left is the growth of the rate over half an interval and the delay.
    left = slope * 0.02 * (DT_S / 2 + 0.02)
    assert float(bank.mean[0, 2]) == pytest.approx(psi(1.0), abs=left)
    without = psi(1.0) - psi(1.0 - 0.02)
    assert left < without / 8


def test_standing_teaches_the_bias_alone_and_every_hypothesis_alike():
    """The mean of n readings of variance R, beside a prior, whichever pose is true."""
    motion = BicycleKalman(base(GYRO, DEFAULT_TWIST_SIGMA))
    bank = begun(motion, [0.0, 0.0, 0.3], [1.0, 0.5, -0.8])
    rng, bias, noise = np.random.default_rng(2), 0.03, NOISE / np.sqrt(DT_S)
    readings = bias + noise * rng.normal(size=30)
    for z in readings:
        bank = predicted(motion, bank, reading(gyro_radps=z))
    used = readings[1:]  # before the first the turn rate was not known
    R = noise**2 + 0.01**2
    variance = 1 / (1 / BIAS_SIGMA**2 + len(used) / R)
    np.testing.assert_allclose(bank.mean[:, -1], variance * used.sum() / R, rtol=1e-2)
    np.testing.assert_allclose(bank.covariance[:, -1, -1], variance, rtol=1e-2)
    np.testing.assert_array_equal(bank.mean[:, SIX:SENSORS_END], 0)
    told = np.diag(np.append(0.05, DEFAULT_TWIST_SIGMA) ** 2)
    block = np.asarray(bank.covariance[:, SIX:SENSORS_END, SIX:SENSORS_END])
    np.testing.assert_allclose(block, [told, told], atol=1e-9)
    np.testing.assert_allclose(bank.mean[:, 2], [0.3, -0.8], atol=2e-3)


@pytest.mark.parametrize("rate_radps", [0.82, 1.3])
def test_a_gyro_teaches_wheels_their_errors_and_their_slip(rate_radps):
    """The rows of a dense Kalman gain that belong to s, k, g, o, where the mismatch is as likely as
    not; beyond, with a slip as wide as it takes."""
    rng = np.random.default_rng(4)
    n = SENSORS_END + odometry.GYRO
    of_gyro = [0.01, 0.005, BIAS_SIGMA]
    scale = np.concatenate([np.full(SIX, 0.02), [0.05], DEFAULT_TWIST_SIGMA, of_gyro])
    A = rng.normal(size=(n, 2 * n)) / np.sqrt(2 * n)
    P, mean = scale[:, None] * (A @ A.T) * scale, np.zeros(n)
    mean[5] = 0.8
    read = jax.jit(read_velocity)(base(), reading((0.5, 0.0, rate_radps)), jnp.asarray(mean))
    turn = jax.jit(turn_of)(GYRO, reading(gyro_radps=0.8), jnp.asarray(mean), jnp.asarray(0.0))
    after, P_after = jax.jit(slip_of)(
        turn, read, jnp.asarray(0.01), jnp.asarray(mean), jnp.asarray(P)
    )
    H = np.zeros(n)
    H[5], H[SIX:SENSORS_END] = 1, -np.asarray(read.by_errors[2])
    change = rate_radps - 0.8
    S = H @ P @ H + 0.01**2
    assert (change**2 > S) == (rate_radps == 1.3)
    if change**2 > S:
        P[SIX, SIX] += (change**2 - S) / H[SIX] ** 2
        S = change**2
    gain = P @ H / S
    gain[:SIX], gain[SENSORS_END - 1 :] = 0, 0
    left = np.eye(n) - np.outer(gain, H)
    np.testing.assert_allclose(after, mean + gain * change, atol=1e-12)
    np.testing.assert_allclose(P_after, left @ P @ left.T + 1e-4 * np.outer(gain, gain), atol=1e-12)
    np.testing.assert_allclose(P_after[:SIX, :SIX], P[:SIX, :SIX], atol=1e-15)
    assert after[SIX] < 0  # the wheels read too much


@pytest.mark.parametrize(
    ("twists", "readings"),
    [
        ([(0.5, 0.0, 0.0)] * 9, [0.03] * 9),  # it drives
        ([(0.0, 0.0, 0.2)] * 9, [0.23] * 9),  # it turns on the spot
        ([(0.0, 0.0, 0.0)] * 9, np.linspace(0.3, 1.3, 9)),  # it is turned by hand
        ([(np.nan, np.nan, np.nan)] * 9, [0.03] * 9),  # its wheels say nothing
    ],
)
def test_nothing_else_than_standing_teaches_the_bias(twists, readings):
    motion = BicycleKalman(base(GYRO, DEFAULT_TWIST_SIGMA))
    bank = begun(motion, [0.0, 0.0, 0.3])
    # It has driven before, or a car that starts off would count as one that stands.
    bank = eqx.tree_at(lambda b: b.mean, bank, bank.mean.at[:, 3].set(np.nan_to_num(twists[0][0])))
    for twist, z in zip(twists, readings, strict=True):
        bank = predicted(motion, bank, reading(twist, z))
    assert float(bank.mean[0, -1]) == 0
    np.testing.assert_allclose(bank.covariance[0, -1, -1], BIAS_SIGMA**2, rtol=1e-6)


@pytest.mark.parametrize("apart_rad", [0.0, 1.0])
def test_poses_teach_the_bias_only_once_the_heading_is_known(apart_rad):
    """Poses that turn by 0.05 rad/s less than a gyro of 0.05 rad/s says."""
    motion = BicycleKalman(base(dataclasses.replace(GYRO), DEFAULT_TWIST_SIGMA))
    bank = begun(motion, [0.0, 0.0, 0.3], [0.0, 0.0, 0.3 + apart_rad], sigma=0.01)
    seen = np.stack([level(psi_rad=0.3), level(psi_rad=0.3 + apart_rad)])
    told = reading((np.nan, np.nan, np.nan), 0.05), seen, 0.003**2 * np.eye(6)
    for _ in range(40):
        _, bank, _ = stepped(motion, bank, *told)
    bias, sigma = bank.mean[:, -1], np.sqrt(bank.covariance[:, -1, -1])
    if apart_rad:
        np.testing.assert_array_equal(bias, 0)
        np.testing.assert_allclose(sigma, BIAS_SIGMA, rtol=1e-6)
    else:
        np.testing.assert_allclose(bias, 0.05, atol=0.015)
        assert np.all(sigma < 0.6 * BIAS_SIGMA)


def test_a_rule_that_takes_one_pose_has_the_papers_states():
    motion = BicycleKalman(base(GYROS["consumer"], DEFAULT_TWIST_SIGMA))
    assert motion.for_rig(worlds.qcar_rig_by_hand(), 1).init(1).mean.shape == (1, SIX)
    many = motion.for_rig(worlds.qcar_rig_by_hand(), 2).init(2)
    assert many.mean.shape == (2, SENSORS_END + 12 + odometry.GYRO)


def test_gradients_are_finite_where_it_stands():
    motion = BicycleKalman(base(GYROS["consumer"], DEFAULT_TWIST_SIGMA))
    bank = begun(motion, [0.0, 0.0, 0.3])

    def heading(twist, z):
        obs = eqx.tree_at(lambda o: (o.twist, o.gyro_radps), reading(), (twist, z))
        return motion.predict(bank, obs).mean[0]

    slopes_of = jax.jit(jax.jacrev(heading, argnums=(0, 1)))
    for z in (0.0, np.nan):
        slopes = slopes_of(jnp.zeros(6), jnp.asarray([0.0, 0.0, z]))
        assert all(np.all(np.isfinite(slope)) for slope in slopes)
