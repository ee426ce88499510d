"""The filter with an IMU against `ConstantVelocity`, GTSAM, samples, and simulated hands."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.imu import InertialMotion
from jaxnav.core.models.imu import ImuNoise, Preintegrated, Readings, preintegrate
from jaxnav.core.pose.observation import Observation
from tests import worlds
from tests.core.models.test_imu import gtsam_of, need_gtsam, readings
from tests.derivatives import in_float32
from tests.helpers.filters import believing, predicted
from tests.reference.rigid import matrix, twist_matrix, wxyz_xyz

NOISE = ImuNoise(2e-3, 3e-2, 4e-3, 5e-2, 0.05, 0.2)
ARM_M = np.array([0.2, -0.1, 0.3])
TWIST = np.array([0.4, -0.2, 0.1, 0.3, -0.5, 0.8])


integrated = eqx.filter_jit(preintegrate)


def at(dt_s=0.1, imu=None) -> Observation:
    """An observation without corners."""
    nothing = jnp.zeros((1, 1, 4, 2)), jnp.zeros((1, 1), bool)
    return Observation(*nothing, dt_s=jnp.asarray(dt_s, float), imu=imu)


def random_state(seed=0, size=0.01):
    """A mean (22,) and a covariance (21, 21)."""
    rng = np.random.default_rng(seed)
    T = expm(twist_matrix(rng.normal(size=6)))
    biases = np.array([0.02, -0.01, 0.03, 0.1, 0.2, -0.1])
    mean = np.concatenate([wxyz_xyz(T), TWIST, biases, [0.3, -0.2, -9.8]])
    root = size * rng.normal(size=(21, 21))
    return mean, root @ root.T + 1e-10 * np.eye(21)


def measured(seed=0, count=40, dt_s=0.005) -> Preintegrated:
    rng = np.random.default_rng(seed)
    gyro = np.array([0.4, -1.0, 0.7]) + 0.3 * rng.normal(size=(count, 3))
    accel = np.array([1.0, -2.0, 9.0]) + rng.normal(size=(count, 3))
    return integrated(readings(gyro, accel, dt_s), NOISE)


def test_without_a_reading_it_is_the_constant_velocity_s():
    """And the biases walk."""
    (mean, P), some = random_state(), measured()
    nothing = jax.tree.map(lambda x, like: jnp.asarray(x, like.dtype), Preintegrated.none(), some)
    broken = dataclasses.replace(some, velocity_mps=jnp.full(3, jnp.nan, float))
    ours, plain = InertialMotion(NOISE), ConstantVelocity()
    theirs = predicted(plain, believing(plain, mean[:13], P[:12, :12]), at(0.2))
    for imu in (None, nothing, broken, measured(count=30)):  # the last is of another interval
        after = predicted(ours, believing(ours, mean, P), at(0.2, imu))
        np.testing.assert_allclose(after.mean[0, :13], theirs.mean[0], atol=1e-12)
        np.testing.assert_allclose(after.covariance[0, :12, :12], theirs.covariance[0], atol=1e-12)
        np.testing.assert_array_equal(after.mean[0, 13:], mean[13:])
        walked = np.diag(np.asarray(after.covariance[0]) - P)[12:]
        np.testing.assert_allclose(walked, np.repeat([16e-6, 25e-4, 0], 3) * 0.2, atol=1e-12)


def test_with_a_lever_arm_it_is_the_vehicle_that_goes_straight():
    """The IMU's place has another velocity, from which the vehicle's follows."""
    mean, P = random_state(size=0.0)
    motion = InertialMotion(NOISE, lever_arm_m=jnp.asarray(ARM_M))
    mean[7:10] = TWIST[:3] + np.cross(TWIST[3:], ARM_M)
    after = predicted(motion, believing(motion, mean, P), at(0.3))
    T = matrix(mean[:7]) @ expm(twist_matrix(TWIST * 0.3))
    np.testing.assert_allclose(matrix(after.mean[0, :7]), T, atol=1e-12)
    np.testing.assert_allclose(after.mean[0, 7:13], mean[7:13], atol=1e-12)
    _, velocity = jax.jit(lambda motion, mean: motion.on_ground(mean))(motion, jnp.asarray(mean))
    R = matrix(mean[:7])[:3, :3]
    np.testing.assert_allclose(velocity[:2], (R @ TWIST[:3])[:2], atol=1e-12)


def R_of(imu: Preintegrated) -> np.ndarray:
    return Rotation.from_quat(np.roll(imu.R_begin_end.wxyz, -1)).as_matrix()


def textbook(T, v, biases, g, imu: Preintegrated, arm):
    """R, p, v (in the world) of the vehicle after the interval: Forster et al. (2017), Eq. 26."""
    R, p = T[:3, :3], T[:3, 3]
    change = np.asarray(imu.by_bias) @ biases
    dR = R_of(imu) @ Rotation.from_rotvec(change[:3]).as_matrix()
    dv, dp = imu.velocity_mps + change[3:6], imu.position_m + change[6:]
    t = float(imu.duration_s)
    p_imu = p + R @ arm + v * t + g * t**2 / 2 + R @ dp
    return R @ dR, p_imu - R @ dR @ arm, v + g * t + R @ dv


def test_the_prediction_is_the_textbook_s_in_the_world():
    mean, P = random_state(3)
    motion = InertialMotion(NOISE, lever_arm_m=jnp.asarray(ARM_M))
    imu = measured()
    after = predicted(motion, believing(motion, mean, P), at(0.2, imu))
    T = matrix(mean[:7])
    R, p, v = textbook(T, T[:3, :3] @ mean[7:10], mean[13:19], mean[19:], imu, ARM_M)
    T_after = matrix(after.mean[0, :7])
    np.testing.assert_allclose(T_after[:3, :3], R, atol=1e-9)
    np.testing.assert_allclose(T_after[:3, 3], p, atol=1e-9)
    np.testing.assert_allclose(R @ np.asarray(after.mean[0, 7:10]), v, atol=1e-9)
    np.testing.assert_array_equal(after.mean[0, 13:], mean[13:])
    turn = Rotation.from_matrix(T[:3, :3].T @ R).as_rotvec()
    np.testing.assert_allclose(after.mean[0, 10:13], turn / 0.2, atol=1e-9)


def test_gtsam_s_combined_factor_has_the_same_mean_and_covariance_of_the_prediction():
    """Two nodes, a prior and the factor, whose marginal at the second is the prediction.

    With biases that hardly walk: between what they walk and the increments GTSAM 4.3 has a
    covariance of the other sign than its own residuals (see `test_preintegration`).
    """
    noise = dataclasses.replace(NOISE, gyroscope_random_walk=1e-6, accelerometer_random_walk=1e-6)
    gtsam = need_gtsam()
    mean, _ = random_state(5)
    mean[19:] = [0, 0, -9.81]
    gyro = np.tile([0.4, -1.0, 0.7], (200, 1))
    accel = np.random.default_rng(1).normal([1.0, -2.0, 9.0], 1, (200, 3))
    dt_s = 0.001
    gyro_bias, accel_bias = mean[13:16], mean[16:19]
    biases = accel_bias, gyro_bias
    theirs = gtsam_of(gtsam, gyro, accel, dt_s, noise, biases, combined=True)
    bias = gtsam.imuBias.ConstantBias(*biases)

    T = matrix(mean[:7])
    R, v_world = T[:3, :3], T[:3, :3] @ mean[7:10]
    X, V, B = (lambda i, c=c: gtsam.symbol(c, i) for c in "xvb")
    sigmas = {
        "pose": np.array([0.02, 0.03, 0.01, 0.05, 0.04, 0.06]),
        "v": np.array([0.1, 0.2, 0.3]),
        "b": np.array([0.1, 0.2, 0.15, 0.02, 0.01, 0.03]),
    }
    graph = gtsam.NonlinearFactorGraph()

    def diagonal(name):
        return gtsam.noiseModel.Diagonal.Sigmas(sigmas[name])

    graph.add(gtsam.PriorFactorPose3(X(0), gtsam.Pose3(T), diagonal("pose")))
    graph.add(gtsam.PriorFactorVector(V(0), v_world, diagonal("v")))
    graph.add(gtsam.PriorFactorConstantBias(B(0), bias, diagonal("b")))
    graph.add(gtsam.CombinedImuFactor(X(0), V(0), X(1), V(1), B(0), B(1), theirs))
    state = theirs.predict(gtsam.NavState(gtsam.Pose3(T), v_world), bias)
    values = gtsam.Values()
    values.insert(X(0), gtsam.Pose3(T))
    values.insert(V(0), v_world)
    values.insert(B(0), bias)
    values.insert(X(1), state.pose())
    values.insert(V(1), state.velocity())
    values.insert(B(1), bias)
    keys = gtsam.KeyVector([X(1), V(1), B(1)])
    marginals = gtsam.Marginals(graph, values)
    order = [X(1), V(1), B(1)]
    joint = marginals.jointMarginalCovariance(keys)
    P_theirs = np.block([[joint.at(i, j) for j in order] for i in order])

    # The velocity of GTSAM is the world's, its pose's error (turn, shift); its biases begin with
    # the accelerometer's.
    def to_ours(R, v):
        J = np.zeros((15, 15))
        J[0:3, 3:6] = J[3:6, 0:3] = np.eye(3)
        J[6:9, 6:9] = R.T
        J[6:9, 0:3] = np.cross(np.eye(3), R.T @ v)
        J[9:12, 12:15] = J[12:15, 9:12] = np.eye(3)
        return J

    P = np.zeros((21, 21))
    before = np.diag(np.concatenate([sigmas[name] for name in ("pose", "v", "b")]) ** 2)
    J = to_ours(R, v_world)
    ours_of = np.r_[0:9, 12:18]
    P[np.ix_(ours_of, ours_of)] = J @ before @ J.T
    imu = integrated(
        readings(gyro, accel, dt_s), noise, jnp.asarray(gyro_bias), jnp.asarray(accel_bias)
    )
    motion = InertialMotion(noise)
    after = predicted(motion, believing(motion, mean, P), at(0.2, imu))

    T_after = matrix(after.mean[0, :7])
    np.testing.assert_allclose(T_after, state.pose().matrix(), atol=1e-9)
    v_after = T_after[:3, :3] @ np.asarray(after.mean[0, 7:10])
    np.testing.assert_allclose(v_after, state.velocity(), atol=1e-9)
    J = to_ours(T_after[:3, :3], v_after)
    expected = J @ P_theirs @ J.T
    scale = np.sqrt(np.diag(expected))
    ours = np.asarray(after.covariance[0])[np.ix_(ours_of, ours_of)]
    gap = np.abs(ours - expected) / scale / scale[:, None]
    assert np.max(gap) < 2e-3
    # The prior alone is far from it, and so is the noise alone.
    assert np.max(np.abs(J @ before @ J.T - expected) / scale / scale[:, None]) > 0.1


def test_a_filter_that_carries_samples_has_their_covariance():
    """20 000 bodies off by P, whose increments are off by theirs, and whose biases walk."""
    mean, P = random_state(8, size=0.005)
    motion = InertialMotion(NOISE, lever_arm_m=jnp.asarray(ARM_M))
    imu = measured(2)
    after = predicted(motion, believing(motion, mean, P), at(0.2, imu))
    rng = np.random.default_rng(0)
    errors = jnp.asarray(rng.normal(size=(20_000, 21)) @ np.linalg.cholesky(P).T)
    off = rng.normal(size=(20_000, 15)) @ np.linalg.cholesky(imu.covariance + 1e-16 * np.eye(15)).T

    @jax.jit
    @jax.vmap
    def ends(error, off):
        """In matrices of the world, as Forster et al. have it."""
        start = motion.moved(jnp.asarray(mean), error)
        T, t = jaxlie.SE3(start[:7]), imu.duration_s
        R, g = T.rotation(), start[19:]
        dR, dv, dp = imu.at_biases(start[13:16], start[16:19])
        dR = dR @ jaxlie.SO3.exp(off[:3])
        R_after = R @ dR
        p = T.translation() + R @ ARM_M + R @ start[7:10] * t + g * t**2 / 2 + R @ (dp + off[6:9])
        v = R @ (start[7:10] + dv + off[3:6]) + g * t
        T_after = jaxlie.SE3.from_rotation_and_translation(R_after, p - R_after @ ARM_M)
        rest = R_after.inverse() @ v, after.mean[0, 10:13], start[13:19] + off[9:], g
        return motion.difference(jnp.concatenate([T_after.wxyz_xyz, *rest]), after.mean[0])

    found = np.asarray(ends(errors, jnp.asarray(off)))
    free = np.r_[0:9, 12:21]  # the turn rate has its own white acceleration
    P_after = np.asarray(after.covariance[0])[np.ix_(free, free)]
    whitened = np.linalg.solve(np.linalg.cholesky(P_after), found[:, free].T)
    # Sampling noise, and 2 % for what is not linear.
    tolerance = 0.02 + 5 / np.sqrt(20_000)
    np.testing.assert_allclose(whitened @ whitened.T / 20_000, np.eye(18), atol=tolerance)


def test_a_body_at_rest_tells_the_gyroscope_s_bias_and_the_lean_of_the_map():
    """Ten seconds on a table, in a map that leans by 2 degrees."""
    motion = InertialMotion(NOISE)
    bias, lean = np.array([0.04, -0.03, 0.02]), np.deg2rad(2.0)
    gravity = 9.81 * np.array([np.sin(lean), 0, -np.cos(lean)])
    rows = np.tile(bias, (20, 1)), np.tile(-gravity, (20, 1))
    imu = integrated(readings(*rows, 0.005, True), NOISE)
    first = motion.at_first()
    mean = np.concatenate([[1, 0, 0, 0, 0, 0, 0], first[0]])
    P = np.zeros((21, 21))
    P[6:, 6:], P[:6, :6] = first[1], 1e-6 * np.eye(6)
    bank = believing(motion, mean, P)
    for _ in range(100):
        bank = predicted(motion, bank, at(0.1, imu))
    found, P = np.asarray(bank.mean[0]), np.asarray(bank.covariance[0])
    np.testing.assert_allclose(found[7:13], 0, atol=0.01)
    np.testing.assert_allclose(found[13:16], bias, atol=0.003)
    assert np.all(np.sqrt(np.diag(P))[12:15] < 0.005)
    # Lean and accelerometer's bias look alike on a table: what they do together is known.
    along = found[16:19] - found[19:22]
    np.testing.assert_allclose(along, -gravity, atol=0.05)
    assert abs(found[19]) > 0.1
    # In flight nothing of it is done.
    moving = dataclasses.replace(imu, still=jnp.asarray(False))
    free = predicted(motion, believing(motion, mean, P), at(0.1, moving))
    np.testing.assert_array_equal(free.mean[0, 13:], mean[13:])


def test_rest_weighs_the_hypotheses_by_how_well_they_rest():
    """One lies as gravity says, the other on its side; and a fast one is not stopped."""
    motion = InertialMotion(NOISE)
    first = motion.at_first()
    P = np.zeros((21, 21))
    P[6:, 6:], P[:6, :6] = first[1], 1e-4 * np.eye(6)
    P[6:9, 6:9] = 1e-4 * np.eye(3)
    side = np.array([np.cos(0.4), np.sin(0.4), 0, 0])
    means = np.stack([np.concatenate([q, np.zeros(3), first[0]]) for q in (side, [1, 0, 0, 0.0])])
    bank = believing(motion, means, P)
    imu = integrated(readings(np.zeros((20, 3)), np.tile([0, 0, 9.81], (20, 1)), 0.01, True), NOISE)
    weights = np.exp(np.asarray(predicted(motion, bank, at(0.2, imu)).log_weight))
    assert weights.sum() == pytest.approx(1)
    assert weights[0] < 0.01
    anywhere = InertialMotion.in_any_world(NOISE)
    P[18:, 18:] = 100 * np.eye(3)
    wide = believing(motion, means, P)
    weights = np.exp(np.asarray(predicted(anywhere, wide, at(0.2, imu)).log_weight))
    assert 0.2 < weights[0] < 0.6
    means[:, 7] = 1.0
    fast = dataclasses.replace(bank, mean=jnp.asarray(means))
    after = predicted(motion, fast, at(0.2, imu))
    assert after.mean[1, 7] == pytest.approx(1.0, abs=1e-6)
    np.testing.assert_allclose(after.log_weight, bank.log_weight)


@pytest.mark.long
@in_float32
def test_gradients_are_finite_at_rest_and_without_a_reading(precision):
    """Of a prediction by its readings, the priors, and the state."""

    @jax.jit
    @jax.grad
    def slope(floats, still):
        motion, mean, gyro, accel, dt_s = floats
        rows = gyro, accel, dt_s
        imu = preintegrate(Readings(*rows, jnp.zeros(4, bool), still), motion.noise)
        bank = believing(motion, jnp.eye(22)[0], 1e-4 * jnp.eye(21))
        bank = eqx.tree_at(lambda b: b.mean, bank, bank.mean + mean[None])
        obs = at(jnp.sum(dt_s), imu)
        bank = motion.predict(motion.predict(bank, obs), obs)
        return jnp.sum(bank.mean) + jnp.sum(bank.covariance) + jnp.sum(bank.log_weight)

    zero = jnp.zeros((4, 3))
    for still in (True, False):
        for dt_s in (jnp.full(4, 0.01, float), jnp.zeros(4)):
            floats = InertialMotion(), jnp.zeros(22), zero, zero, dt_s
            for leaf in jax.tree.leaves(slope(floats, jnp.asarray(still))):
                assert np.all(np.isfinite(leaf))
                assert leaf.dtype == precision


def test_the_cameras_errors_stay_and_keep_what_they_have_to_do_with_the_pose():
    """Twelve of a rig of four behind the state; the rest is as without them."""
    mean, P = random_state(4)
    rig = worlds.qcar_rig_by_hand()
    motion = InertialMotion(NOISE).for_rig(rig, 24)
    assert motion.camera_states == 12
    rng = np.random.default_rng(9)
    root = 0.1 * rng.normal(size=(33, 33))
    whole = root @ root.T
    whole[:21, :21] += P
    plain = InertialMotion(NOISE)
    alone = predicted(plain, believing(plain, mean, whole[:21, :21]), at(0.2, measured()))
    bank = believing(motion, np.append(mean, np.arange(12.0)), whole)
    after = predicted(motion, bank, at(0.2, measured()))
    np.testing.assert_allclose(after.mean[0, :22], alone.mean[0], atol=1e-12)
    np.testing.assert_array_equal(after.mean[0, 22:], np.arange(12.0))
    found = np.asarray(after.covariance[0])
    np.testing.assert_allclose(found[:21, :21], alone.covariance[0], atol=1e-10)
    np.testing.assert_allclose(found[21:, 21:], whole[21:, 21:], atol=1e-12)
    assert np.linalg.eigvalsh(found)[0] > 0
    errors = jax.jit(lambda motion, bank: motion.poses(bank))(motion, after).errors
    np.testing.assert_array_equal(errors.mean[0], np.arange(12.0))
    np.testing.assert_array_equal(errors.cross[0], found[:6, 21:])
    assert np.max(np.abs(found[:6, 21:] - whole[:6, 21:])) > 1e-3
