"""The filters against textbook NumPy, statistics and simulated motion."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy import stats

from jaxnav.candidates import Candidates
from jaxnav.motion import Belief, BicycleKalman, ConstantVelocity, Motion, restarted_where_broken
from jaxnav.observation import Observation
from tests import worlds
from tests.reference import kalman, paper

WHEELBASE_M = 0.256


def weights(taken: bool) -> jax.Array:
    """All of candidate 0 for the only hypothesis, or nothing."""
    return jnp.asarray([[float(taken), 0.0]])


def candidate(T_world_vehicle: jaxlie.SE3, covariance) -> Candidates:
    """The pose in lane 0, and a lane that must never be looked at."""
    wxyz_xyz = T_world_vehicle.inverse().wxyz_xyz
    other = worlds.planar(9.0, -9.0, 1.0).inverse().wxyz_xyz
    return Candidates(
        T_vehicle_world=jaxlie.SE3(jnp.stack([wxyz_xyz, other])),
        e1_px2=jnp.zeros(2),
        cost=jnp.zeros(2),
        covariance=jnp.stack([jnp.asarray(covariance, float), 1e-9 * jnp.eye(6)]),
        valid=jnp.asarray([True, False]),
        converged=jnp.ones(2, bool),
        steps=jnp.ones(2, int),
    )


def reading(speed_mps=0.0, steering_rad=0.0, has_odometry=True) -> Observation:
    return Observation(
        jnp.zeros((1, 1, 4, 2)),
        jnp.zeros((1, 1), bool),
        jnp.asarray(speed_mps, float),
        jnp.asarray(steering_rad, float),
        has_odometry=jnp.asarray(has_odometry),
    )


@jax.jit
def drive_step(motion, belief, dt_s, pose, covariance, taken, obs):
    """Prediction and update with a planar pose."""
    T_world_vehicle = worlds.planar(*pose)
    prior = motion.predict(belief, dt_s)
    posterior, nis = motion.update(prior, candidate(T_world_vehicle, covariance), taken, obs)
    return prior, posterior, nis


def started(motion, pose, covariance, speed_mps=0.3, steering_rad=0.1) -> Belief:
    obs = reading(speed_mps, steering_rad)
    arguments = (jnp.asarray(0.1), jnp.asarray(pose), covariance, weights(True), obs)
    return drive_step(motion, motion.init(), *arguments)[1]


def planar_part(covariance, psi_rad):
    """Covariance of (x, y, psi) of a level vehicle from that of xi."""
    c, s = np.cos(psi_rad), np.sin(psi_rad)
    J = np.zeros((3, 6))
    J[:2, :2] = [[c, -s], [s, c]]
    J[2, 5] = 1
    return J @ covariance @ J.T


@pytest.mark.parametrize("with_pose", [True, False])
def test_200_steps_are_the_textbook_s(with_pose):
    """Random poses, odometry and intervals; with pose rows two thirds of the time, or never."""
    rng = np.random.default_rng(0)
    motion = BicycleKalman(worlds.qcar())
    first = np.array([0.5, -0.3, 3.0])
    root = 0.02 * rng.normal(size=(6, 6))
    floor = np.diag(np.asarray(motion.vision_floor) ** 2)
    belief = started(motion, first, root @ root.T)
    x, P = np.asarray(belief.mean[0]), np.asarray(belief.covariance[0])
    for _ in range(200):
        dt_s, speed, steering = rng.uniform(0.01, 0.2), rng.uniform(-0.5, 1), rng.uniform(-0.5, 0.5)
        root = 0.03 * rng.normal(size=(6, 6))
        x, P = kalman.predict(x, P, dt_s, np.asarray(motion.acceleration_density))
        pose = x[:3] + rng.normal(0, 0.05, 3)
        sees = with_pose and rng.uniform() < 2 / 3
        R_pose = planar_part(root @ root.T, pose[2]) + floor
        x, P, nis_expected = kalman.update(
            x,
            P,
            pose if sees else None,
            R_pose,
            speed,
            steering,
            WHEELBASE_M,
            np.asarray(motion.odometry_sigma),
        )
        _, belief, nis = drive_step(
            motion,
            belief,
            jnp.asarray(dt_s),
            jnp.asarray(pose),
            jnp.asarray(root @ root.T),
            weights(sees),
            reading(speed, steering),
        )
        np.testing.assert_allclose(kalman.wrap(belief.mean[0, 2] - x[2]), 0, atol=1e-9)
        np.testing.assert_allclose(np.delete(belief.mean[0], 2), np.delete(x, 2), atol=1e-9)
        np.testing.assert_allclose(belief.covariance[0], P, atol=1e-9)
        np.testing.assert_allclose(nis[0], nis_expected, rtol=1e-7)


def test_the_heading_s_column_of_H_is_the_derivative():
    """One odometry update with H by differences of the prediction v(psi) - (v_x, v_y, psi_dot)."""
    motion = BicycleKalman(worlds.qcar())
    belief = started(motion, (0.1, 0.2, 1.0), 1e-3 * jnp.eye(6))
    speed, steering = 0.8, 0.4
    prior, posterior, _ = drive_step(
        motion,
        belief,
        jnp.asarray(0.3),
        jnp.zeros(3),
        jnp.eye(6),
        weights(False),
        reading(speed, steering),
    )
    x, P = np.asarray(prior.mean[0]), np.asarray(prior.covariance[0])

    def residual(x):
        return paper.velocity(speed, steering, x[2], WHEELBASE_M) - x[3:]

    h = 1e-6
    H = -np.stack([(residual(x + h * e) - residual(x - h * e)) / (2 * h) for e in np.eye(6)], 1)
    assert np.max(np.abs(H[:, 2])) > 0.5
    R = np.diag(np.asarray(motion.odometry_sigma) ** 2)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    np.testing.assert_allclose(posterior.mean[0], x + K @ residual(x), atol=1e-8)
    np.testing.assert_allclose(posterior.covariance[0], (np.eye(6) - K @ H) @ P, atol=1e-8)
    assert posterior.mean[0, 2] != x[2]


def test_the_yaw_innovation_wraps():
    """Prediction at pi - 0.02, pose at -pi + 0.02: 0.04 rad apart and not 6.24."""
    motion = BicycleKalman(worlds.qcar())
    tight = 1e-6 * jnp.eye(6)
    belief = started(motion, (0.0, 0.0, np.pi - 0.02), tight, 0.0, 0.0)
    _, posterior, nis = drive_step(
        motion,
        belief,
        jnp.asarray(0.0),
        jnp.asarray([0.0, 0.0, -np.pi + 0.02]),
        tight,
        weights(True),
        reading(),
    )
    assert abs(kalman.wrap(float(posterior.mean[0, 2]) - np.pi)) < 0.02
    assert nis[0] == pytest.approx(0.04**2 / (2 * (1e-6 + 0.005**2)), rel=1e-3)
    assert -np.pi <= posterior.mean[0, 2] < np.pi


def test_odometry_alone_moves_the_car_along_its_arc(precision):
    motion = BicycleKalman(worlds.qcar())
    speed, steering, dt_s = 0.5, 0.3, 0.05
    belief = started(motion, (1.0, 0.5, 0.2), 1e-6 * jnp.eye(6), speed, steering)
    start = np.asarray(belief.mean[0, :3])
    variances = []
    for _ in range(40):
        _, belief, nis = drive_step(
            motion,
            belief,
            jnp.asarray(dt_s),
            jnp.zeros(3),
            jnp.eye(6),
            weights(False),
            reading(speed, steering),
        )
        assert nis[0] == 0
        variances.append(float(belief.covariance[0, 0, 0] + belief.covariance[0, 1, 1]))
    assert belief.mean.dtype == belief.covariance.dtype == precision
    truth = paper.drive(start, speed, steering, 40 * dt_s, WHEELBASE_M)[-1]
    np.testing.assert_allclose(belief.mean[0, :2], truth[:2], atol=0.05)
    assert abs(kalman.wrap(float(belief.mean[0, 2]) - truth[2])) < 0.05
    assert np.all(np.diff(variances) > 0)


def test_without_odometry_the_rows_are_gone():
    motion = BicycleKalman(worlds.qcar())
    belief = started(motion, (1.0, 0.5, 0.2), 1e-4 * jnp.eye(6))
    prior, posterior, _ = drive_step(
        motion,
        belief,
        jnp.asarray(0.1),
        jnp.zeros(3),
        jnp.eye(6),
        weights(False),
        reading(9.0, 0.4, False),
    )
    np.testing.assert_array_equal(posterior.mean, prior.mean)
    np.testing.assert_allclose(posterior.covariance, prior.covariance, rtol=1e-9, atol=1e-12)


def test_nis_of_a_matched_filter_is_chi_square():
    """Truth drawn from the filter's own model; poses only. 400 steps of 3 degrees of freedom."""
    rng = np.random.default_rng(1)
    motion = BicycleKalman(worlds.qcar())
    dt_s, density = 0.1, np.asarray(motion.acceleration_density)
    covariance = np.diag([0.02, 0.02, 0, 0, 0, 0.03]) ** 2 + 1e-18 * np.eye(6)
    R = np.diag([0.02, 0.02, 0.03]) ** 2 + np.diag(np.asarray(motion.vision_floor) ** 2)
    x = np.array([0.0, 0.0, 0.5, 0.3, -0.2, 0.1])
    belief = motion.init()
    values = []
    for _ in range(401):
        zero = np.zeros((6, 6))
        _, Q = kalman.predict(np.zeros(6), zero, dt_s, density)
        x = kalman.predict(x, zero, dt_s, density)[0] + rng.multivariate_normal(np.zeros(6), Q)
        pose = rng.multivariate_normal(x[:3], R)
        _, belief, nis = drive_step(
            motion,
            belief,
            jnp.asarray(dt_s),
            jnp.asarray(pose),
            jnp.asarray(covariance),
            weights(True),
            reading(has_odometry=False),
        )
        values.append(float(nis[0]))
    assert values[0] == 0
    values = np.array(values[1:])
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], 3 * len(values))
    assert low < np.sum(values) < high
    assert stats.kstest(values, stats.chi2(3).cdf).pvalue > 1e-3


@jax.jit
def first_step(motion, pose, taken):
    """The belief after one look, its NIS, and the poses a selector sees."""
    prior = motion.predict(motion.init(), 0.1)
    belief, nis = motion.update(prior, candidate(pose, 1e-4 * jnp.eye(6)), taken, reading())
    return belief, nis, motion.poses(belief)


@pytest.mark.parametrize(("kind", "size"), [("car", 6), ("free", 12)])
def test_the_first_pose_starts_the_filter(precision, kind, size):
    motion = BicycleKalman(worlds.qcar()) if kind == "car" else ConstantVelocity()
    assert isinstance(motion, Motion)
    assert not motion.init().initialised[0]
    pose = worlds.planar(0.4, -0.2, 2.0)
    blind, *_ = first_step(motion, pose, weights(False))
    assert not blind.initialised[0]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(blind))
    belief, nis, found = first_step(motion, pose, weights(True))
    assert belief.initialised[0]
    assert nis[0] == 0
    assert belief.covariance.shape == (1, size, size)
    assert found.covariance.dtype == precision
    R, position_m = pose.rotation().as_matrix(), pose.translation()
    np.testing.assert_allclose(found.T_world_vehicle.rotation().as_matrix()[0], R, atol=1e-6)
    np.testing.assert_allclose(found.T_world_vehicle.translation()[0], position_m, atol=1e-6)


def test_poses_of_a_car_are_level_and_carry_the_planar_covariance():
    motion = BicycleKalman(worlds.qcar())
    root = np.random.default_rng(2).normal(size=(6, 6))
    P = root @ root.T
    belief = Belief(
        jnp.asarray([[0.3, -0.4, 2.0, 0.1, 0.2, 0.3]]),
        jnp.asarray(P[None]),
        jnp.zeros(1),
        jnp.ones(1, bool),
    )
    found = motion.poses(belief)
    expected = np.asarray(worlds.planar(0.3, -0.4, 2.0).wxyz_xyz)
    np.testing.assert_allclose(found.T_world_vehicle.wxyz_xyz[0], expected, atol=1e-15)
    np.testing.assert_allclose(planar_part(found.covariance[0], 2.0), P[:3, :3], atol=1e-12)
    np.testing.assert_array_equal(found.covariance[0, 2:5], 0)


def test_broken_hypotheses_start_anew():
    start = BicycleKalman(worlds.qcar()).init()
    stack = jax.tree.map(lambda leaf: jnp.concatenate([leaf, leaf + 1, leaf + 2]), start)
    stack = eqx.tree_at(lambda b: b.initialised, stack, jnp.ones(3, bool))
    starts = jax.tree.map(lambda leaf: jnp.concatenate([leaf] * 3), start)
    broken = eqx.tree_at(lambda b: b.mean, stack, stack.mean.at[1, 4].set(jnp.nan))
    broken = eqx.tree_at(lambda b: b.covariance, broken, broken.covariance.at[2, 0, 5].set(jnp.inf))
    kept = restarted_where_broken(broken, starts)
    assert kept.initialised.tolist() == [True, False, False]
    np.testing.assert_array_equal(kept.mean[0], stack.mean[0])
    np.testing.assert_array_equal(kept.mean[1:], 0)
    assert np.all(np.isfinite(kept.covariance))


@jax.jit
def free_step(motion, belief, dt_s, wxyz_xyz, covariance, taken):
    prior = motion.predict(belief, dt_s)
    return motion.update(prior, candidate(jaxlie.SE3(wxyz_xyz), covariance), taken, reading())


def test_constant_velocity_carries_its_covariance_as_samples_do():
    """Without process noise 20 000 samples moved by the exact motion have the predicted one."""
    motion = ConstantVelocity(acceleration_density=jnp.zeros(6))
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(12, 12))
    twist = jnp.asarray([0.4, -0.2, 0.1, 0.3, -0.5, 0.8])
    T = jaxlie.SE3.exp(jnp.asarray(rng.normal(size=6)))
    belief = Belief(
        jnp.append(T.wxyz_xyz, twist)[None],
        jnp.asarray((root @ root.T)[None]),
        jnp.zeros(1),
        jnp.ones(1, bool),
    )
    dt_s = 0.1
    predicted = motion.predict(belief, dt_s)

    @jax.jit
    @jax.vmap
    def moved(error):
        truth = T @ jaxlie.SE3.exp(error[:6]) @ jaxlie.SE3.exp((twist + error[6:]) * dt_s)
        believed = jaxlie.SE3(predicted.mean[0, :7])
        return jnp.append((believed.inverse() @ truth).log(), error[6:])

    count = 20_000
    errors = np.asarray(moved(jnp.asarray(rng.normal(size=(count, 12)) @ root.T)))
    P = np.asarray(predicted.covariance[0])
    whitened = np.linalg.solve(np.linalg.cholesky(P), errors.T)
    # Sampling noise, and 5 % for the Jacobian of exp that F leaves out (half the turn, 0.05 rad).
    np.testing.assert_allclose(
        whitened @ whitened.T / count, np.eye(12), atol=0.05 + 5 / np.sqrt(count)
    )


def test_constant_velocity_converges_on_a_moving_body():
    """Noisy poses of a body that screws through space: pose and twist are found, errors as said."""
    motion = ConstantVelocity(acceleration_density=jnp.full(6, 0.05**2))
    rng = np.random.default_rng(4)
    twist = jnp.asarray([0.5, 0.1, -0.2, 0.2, -0.1, 0.6])
    T = jaxlie.SE3.identity()
    sigma = np.array([0.01] * 3 + [0.02] * 3)
    dt_s = jnp.asarray(0.05)
    belief, normalised, values = motion.init(), [], []
    advance = jax.jit(lambda T, xi: T @ jaxlie.SE3.exp(xi))
    for step in range(200):
        T = advance(T, twist * dt_s)
        noisy = advance(T, jnp.asarray(sigma * rng.standard_normal(6)))
        belief, nis = free_step(
            motion, belief, dt_s, noisy.wxyz_xyz, jnp.asarray(np.diag(sigma**2)), weights(True)
        )
        if step >= 50:
            values.append(float(nis[0]))
            gap = (jaxlie.SE3(belief.mean[0, :7]).inverse() @ T).log()
            error = np.append(gap, twist - belief.mean[0, 7:])
            normalised.append(error @ np.linalg.solve(belief.covariance[0], error))
    np.testing.assert_allclose(belief.mean[0, 7:], twist, atol=0.06)
    assert np.linalg.norm(gap[:3]) < 0.01
    assert np.linalg.norm(gap[3:]) < 0.02
    # The floor adds to R what the simulation leaves out; successive errors are correlated.
    assert 4 < np.mean(values) < 7
    assert 4 < np.mean(normalised) < 16


def test_constant_velocity_forgets_what_it_lost():
    motion = ConstantVelocity()
    pose = worlds.planar(0.3, 0.1, 1.0)
    belief, _ = free_step(
        motion, motion.init(), jnp.asarray(0.1), pose.wxyz_xyz, 1e-4 * jnp.eye(6), weights(True)
    )
    assert motion.predict(belief, 0.1).initialised[0]
    assert not motion.predict(belief, 10.0).initialised[0]
    there = worlds.planar(-3.0, 2.0, -2.0)
    again, nis = free_step(
        motion, belief, jnp.asarray(10.0), there.wxyz_xyz, 1e-4 * jnp.eye(6), weights(True)
    )
    np.testing.assert_allclose(again.mean[0, :7], there.wxyz_xyz, atol=1e-12)
    np.testing.assert_array_equal(again.mean[0, 7:], 0)
    assert nis[0] == 0


@pytest.mark.parametrize("kind", ["car", "free"])
def test_gradients_are_finite_at_rest_and_at_the_prediction(precision, kind):
    """Of everything by noise parameters, pose and odometry, where innovations are 0."""
    motion = BicycleKalman(worlds.qcar()) if kind == "car" else ConstantVelocity()
    pose = worlds.planar(0.3, 0.1, 1.0)

    @jax.jit
    @jax.grad
    def slope(floats, taken):
        motion, wxyz_xyz, speed_mps, dt_s = floats
        here = candidate(jaxlie.SE3(wxyz_xyz), 1e-4 * jnp.eye(6))
        obs = reading(speed_mps)
        belief, _ = motion.update(motion.init(), here, weights(True), obs)
        for _ in range(2):
            belief = motion.predict(belief, dt_s)
            belief, nis = motion.update(belief, here, taken, obs)
        return jnp.sum(belief.mean) + jnp.sum(belief.covariance) + jnp.sum(nis)

    for taken in (True, False):
        zero = jnp.asarray(0.0)
        for leaf in jax.tree.leaves(slope((motion, pose.wxyz_xyz, zero, zero), weights(taken))):
            assert leaf.dtype == precision
            assert np.all(np.isfinite(leaf))
