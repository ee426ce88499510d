"""Smoothing against a dense least squares, and along a bank's slots; drives in `test_free.py`."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter import kalman
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.filter.smooth import Trail, doubt, smoothed
from jaxnav.core.models.geometry import cayley, inverse_cayley
from jaxnav.core.pose.observation import Observation
from tests import worlds
from tests.helpers.filters import believing, level, predicted

STEPS = 12
DT_S = 0.1
SIGMA = jnp.asarray([0.03, 0.02, 0.04, 0.01, 0.02, 0.015])  # of a measured pose, m and rad
P_FIRST = jnp.diag(jnp.asarray([0.1] * 6 + [0.5] * 6) ** 2)


def after(dt_s: float) -> Observation:
    return Observation(jnp.zeros((0, 0, 4, 2)), jnp.zeros((0, 0), bool), dt_s=dt_s)


def filter_and_smooth(motion, first, measured):
    """Means and covariances (STEPS, ...) of a filter of measured poses, and those smoothed."""
    obs, R, H = after(DT_S), jnp.diag(SIGMA**2), jnp.eye(6, 12)

    def correct(moments, pose):
        mean, P = moments
        innovation = inverse_cayley(jaxlie.SE3(mean[:7]).inverse() @ jaxlie.SE3(pose))
        correction, P, _ = kalman.update(P, innovation, H, R)
        return motion.moved(mean, correction), P

    def forward(moments, pose):
        filtered = correct(motion.evolve(*moments, obs), pose)
        return filtered, filtered

    start = correct(first, measured[0])
    _, rest = jax.lax.scan(forward, start, measured[1:])
    filtered = jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), start, rest)

    def backward(later, moments):
        earlier = smoothed(motion, moments, later, obs)
        return earlier, earlier

    last = jax.tree.map(lambda leaf: leaf[-1], filtered)
    before = jax.tree.map(lambda leaf: leaf[:-1], filtered)
    _, rest = jax.lax.scan(backward, last, before, reverse=True)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), rest, last)
    return filtered, both


run = jax.jit(filter_and_smooth)


def test_small_motions_are_smoothed_as_by_one_least_squares_over_all_of_them():
    """Where a motion is so small that it is linear, against the normal equations of the whole."""
    motion, rng, small = ConstantVelocity(), np.random.default_rng(3), 1e-7
    F = np.block([[np.eye(6), DT_S * np.eye(6)], [np.zeros((6, 6)), np.eye(6)]])
    Q = np.asarray(kalman.white_acceleration(motion.acceleration_density, DT_S))
    z = small * rng.normal(size=(STEPS, 6))
    size = 12 * STEPS
    information, right = np.zeros((size, size)), np.zeros(size)
    information[:12, :12] += np.linalg.inv(P_FIRST)
    for step in range(STEPS):
        at = slice(12 * step, 12 * step + 6)
        information[at, at] += np.diag(1 / np.asarray(SIGMA) ** 2)
        right[at] += z[step] / np.asarray(SIGMA) ** 2
        if step:
            rows = np.zeros((12, size))
            rows[:, 12 * step - 12 : 12 * step], rows[:, 12 * step : 12 * step + 12] = (
                -F,
                np.eye(12),
            )
            information += rows.T @ np.linalg.solve(Q, rows)
    covariance = np.linalg.inv(information)
    expected = (covariance @ right).reshape(STEPS, 12)

    still = jnp.asarray(np.eye(13)[0])
    poses = jax.jit(jax.vmap(lambda xi: cayley(xi).wxyz_xyz))(jnp.asarray(z))
    _, (mean, P) = run(motion, (still, P_FIRST), poses)
    found = jax.jit(jax.vmap(lambda one: motion.difference(one, still)))(mean)
    np.testing.assert_allclose(found, expected, atol=1e-4 * small)
    for step in range(STEPS):
        block = covariance[12 * step : 12 * step + 12, 12 * step : 12 * step + 12]
        np.testing.assert_allclose(P[step], block, atol=1e-4 * block.max())


def test_a_car_is_smoothed_with_its_odometry_as_by_one_least_squares():
    """Straight on at 1 m/s: deviations are linear, and the wheels measure v against the heading."""
    car, small, rng = worlds.qcar(), 1e-7, np.random.default_rng(5)
    motion = BicycleKalman(dataclasses.replace(car, sensor_sigma=None))
    obs = dataclasses.replace(
        after(DT_S), speed_mps=jnp.asarray(1.0), steering_rad=jnp.asarray(0.0)
    )
    nominal = np.zeros((STEPS, 6))
    nominal[:, 0], nominal[:, 3] = DT_S * np.arange(STEPS), 1
    P, R, H = (np.diag([0.1] * 3 + [0.5] * 3) ** 2, np.diag([0.02, 0.03, 0.01]) ** 2, np.eye(3, 6))
    z = small * rng.normal(size=(STEPS, 3))

    @jax.jit
    def correct(mean, P, measured):
        innovation = measured - mean[:3]
        correction, P, _ = kalman.update(P, innovation, jnp.asarray(H), jnp.asarray(R))
        return motion.moved(mean, correction), P

    measured = nominal[:, :3] + z
    filtered = [correct(*map(jnp.asarray, (nominal[0], P, measured[0])))]
    for pose in measured[1:]:
        bank = predicted(motion, believing(motion, *filtered[-1]), obs)
        filtered.append(correct(bank.mean[0], bank.covariance[0], pose))
    trail, earlier = filtered[-1:], jax.jit(smoothed)
    for moments in filtered[-2::-1]:
        trail.insert(0, earlier(motion, moments, trail[0], obs))

    A = np.eye(6) + DT_S * np.eye(6, k=3)
    Q = np.asarray(kalman.white_acceleration(motion.acceleration_density, DT_S))
    wheels = np.eye(3, 6, k=3)
    wheels[1, 2] = -1  # v_y - v psi
    of_wheels = np.diag(1 / np.asarray(motion.odometry_sigma) ** 2)
    size = 6 * STEPS
    information, right = np.zeros((size, size)), np.zeros(size)
    information[:6, :6] += np.linalg.inv(P)
    for step in range(STEPS):
        at = slice(6 * step, 6 * step + 6)
        information[at, at] += H.T @ np.linalg.solve(R, H)
        right[at] += H.T @ np.linalg.solve(R, z[step])
        if step:
            rows = np.zeros((6, size))
            rows[:, 6 * step - 6 : 6 * step], rows[:, at] = -A, np.eye(6)
            information += rows.T @ np.linalg.solve(Q, rows)
            information[at, at] += wheels.T @ of_wheels @ wheels
    covariance = np.linalg.inv(information)
    expected = (covariance @ right).reshape(STEPS, 6)
    for step, (mean, found) in enumerate(trail):
        block = covariance[6 * step : 6 * step + 6, 6 * step : 6 * step + 6]
        np.testing.assert_allclose(mean - nominal[step], expected[step], atol=1e-4 * small)
        np.testing.assert_allclose(found, block, atol=1e-5 * block.max())


begin, back = jax.jit(Trail.begin), jax.jit(Trail.back)
doubted = jax.jit(lambda motion, trail, bank: doubt(motion, trail.as_bank(bank), 0.5))


def bank_of(motion, turns_rad, log_weight, initialised, parent):
    """Four hypotheses at the origin that look in different directions."""
    bank = motion.init(4)
    mean = np.array(bank.mean)
    mean[:, :7] = [level(psi_rad=turn) for turn in turns_rad]
    return dataclasses.replace(
        bank,
        mean=jnp.asarray(mean),
        covariance=jnp.asarray(np.asarray(bank.covariance) * 1e-4),
        log_weight=jnp.asarray(log_weight, float),
        initialised=jnp.asarray(initialised),
        parent=jnp.asarray(parent),
    )


def test_a_trail_goes_back_through_the_slots_that_its_hypotheses_were_in():
    """Slot 2 was the heaviest; of its branch in slot 0 comes the one that wins."""
    motion, yes, no, obs = ConstantVelocity(), True, False, after(0.1)
    forked = bank_of(motion, (0.0, 1.5, 0.1, 0.0), (-9, -2, -0.1, -9), (no, yes, yes, no), range(4))
    chosen = bank_of(
        motion, (0.1, 1.5, 0.9, 0), (-0.1, -5, -3, -9), (yes, yes, yes, no), (2, 1, 2, 3)
    )
    trail = begin(chosen, jnp.asarray(True))
    np.testing.assert_array_equal(trail.slots, [0, 1, 2, -1])
    earlier = back(trail, motion, forked, jnp.asarray(False), chosen.parent, obs)
    np.testing.assert_array_equal(earlier.slots, [2, 1, 2, -1])
    assert bool(earlier.decided)
    np.testing.assert_allclose(earlier.mean[:7], forked.mean[2, :7], atol=1e-3)

    # Both of what became of slot 2 were the same there: 1.4 rad off is slot 1 alone.
    mass = np.exp([-0.1, -5, -3]) / np.exp([-0.1, -5, -3]).sum()
    far = doubted(motion, trail, chosen)
    assert float(far) == pytest.approx(mass[1] + mass[2], abs=1e-6)
    far = doubted(motion, earlier, forked)
    assert float(far) == pytest.approx(mass[1], abs=1e-6)


@pytest.mark.parametrize("end", ["a start", "a bank without hypotheses"])
def test_a_trail_ends_where_its_hypotheses_began(end):
    motion, obs = ConstantVelocity(), after(0.1)
    lives = (True, False, False, False)
    before = bank_of(motion, (0.7, 0.0, 0.0, 0.0), (0.0, 0, 0, 0), lives, range(4))
    parent = (-1, -1, -1, -1)
    if end != "a start":
        before, parent = dataclasses.replace(before, initialised=jnp.zeros(4, bool)), range(4)
    later = bank_of(motion, (0.0,) * 4, (0.0,) * 4, lives, parent)
    trail = begin(later, jnp.asarray(True))
    trail = back(trail, motion, before, jnp.asarray(False), later.parent, obs)
    assert not bool(trail.decided)
    assert bool(trail.as_bank(before).initialised[0]) == (end == "a start")
    np.testing.assert_array_equal(trail.mean, before.mean[0])


def test_what_is_not_finite_leaves_the_filters_state():
    motion = ConstantVelocity()
    mean, P = jnp.asarray(np.eye(13)[0]), P_FIRST
    broken = np.array(P)
    broken[3, 3] = np.nan
    broken = mean, jnp.asarray(broken)
    found = jax.jit(smoothed)(motion, (mean, P), broken, after(0.1))
    np.testing.assert_array_equal(found[0], mean)
    np.testing.assert_array_equal(found[1], P)
