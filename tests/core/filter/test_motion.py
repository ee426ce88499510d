"""The filters against textbook NumPy, statistics and simulated motion."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy import stats
from scipy.linalg import logm

from jaxnav.core.filter.bank import Bank, Offer, apply_gate, restart_broken
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.motion import Motion
from jaxnav.core.filter.planar import BicycleKalman
from tests import worlds
from tests.derivatives import in_float32
from tests.helpers.filters import believing, chosen, level, planar_part, predicted, reading, stepped
from tests.reference import kalman, paper
from tests.reference.rigid import matrix

WHEELBASE_M = 0.256


def drive_step(motion, belief, pose, covariance, taken, obs):
    """Prediction and update with a planar pose."""
    told = level(*pose), np.asarray(covariance, float), np.asarray(taken), np.asarray(True)
    return stepped(motion, belief, obs, *told)


def started(motion, pose, covariance, speed_mps=0.3, steering_rad=0.1) -> Bank:
    obs = reading(speed_mps, steering_rad)
    return drive_step(motion, motion.init(), pose, covariance, True, obs)[1]


@jax.jit
def _poses_of(motion, bank):
    return motion.poses(bank)


def poses_of(motion, bank) -> np.ndarray:
    """wxyz_xyz (K, 7)."""
    return np.asarray(_poses_of(motion, bank).T_world_vehicle.wxyz_xyz)


def patient_car() -> BicycleKalman:
    """Without a gate: every pose is believed."""
    return BicycleKalman(worlds.qcar(), gate_nis=np.inf)


@pytest.mark.parametrize("with_pose", [True, False])
def test_200_steps_are_the_textbook_s(with_pose):
    """Random poses, odometry and intervals; with pose rows two thirds of the time, or never."""
    rng = np.random.default_rng(0)
    motion = patient_car()
    first = np.array([0.5, -0.3, 3.0])
    root = 0.02 * rng.normal(size=(6, 6))
    floor = np.diag(np.asarray(motion.vision_floor) ** 2)
    belief = started(motion, first, root @ root.T)
    x, P = np.asarray(belief.mean[0]), np.asarray(belief.covariance[0])
    for _ in range(200):
        dt_s, speed = rng.uniform(0.01, 0.2), rng.uniform(-0.2, 0.6)
        steering = rng.uniform(-0.5, 0.5)
        root = 0.03 * rng.normal(size=(6, 6))
        told = speed, steering, WHEELBASE_M
        x, P = kalman.predict(x, P, dt_s, np.asarray(motion.acceleration_density), told)
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
            motion, belief, pose, root @ root.T, sees, reading(speed, steering, dt_s=dt_s)
        )
        np.testing.assert_allclose(kalman.wrap(belief.mean[0, 2] - x[2]), 0, atol=1e-9)
        np.testing.assert_allclose(np.delete(belief.mean[0], 2), np.delete(x, 2), atol=1e-9)
        np.testing.assert_allclose(belief.covariance[0], P, atol=1e-9)
        np.testing.assert_allclose(nis[0], nis_expected, rtol=1e-7)


def test_the_heading_s_column_of_H_is_the_derivative():
    """One odometry update with H by differences of the prediction v(psi) - (v_x, v_y, psi_dot)."""
    motion = BicycleKalman(worlds.qcar())
    belief = started(motion, (0.1, 0.2, 1.0), 1e-3 * np.eye(6))
    speed, steering = 0.8, 0.4
    _, posterior, _ = drive_step(
        motion, belief, np.zeros(3), np.eye(6), False, reading(speed, steering, dt_s=0.3)
    )
    x, P = kalman.predict(
        np.asarray(belief.mean[0]),
        np.asarray(belief.covariance[0]),
        0.3,
        np.asarray(motion.acceleration_density),
        (speed, steering, WHEELBASE_M),
    )

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
    motion = patient_car()
    tight = 1e-6 * np.eye(6)
    belief = started(motion, (0.0, 0.0, np.pi - 0.02), tight, 0.0, 0.0)
    _, posterior, nis = drive_step(
        motion, belief, (0.0, 0.0, -np.pi + 0.02), tight, True, reading(dt_s=0.0)
    )
    assert abs(kalman.wrap(float(posterior.mean[0, 2]) - np.pi)) < 0.02
    variance = 1e-6 + float(motion.vision_floor[2]) ** 2
    assert nis[0] == pytest.approx(0.04**2 / (2 * variance), rel=1e-3)
    assert -np.pi <= posterior.mean[0, 2] < np.pi


def test_without_odometry_the_rows_are_gone():
    motion = BicycleKalman(worlds.qcar())
    belief = started(motion, (1.0, 0.5, 0.2), 1e-4 * np.eye(6))
    prior, posterior, _ = drive_step(
        motion, belief, np.zeros(3), np.eye(6), False, reading(9.0, 0.4, False)
    )
    x, P = kalman.predict(
        np.asarray(belief.mean[0]),
        np.asarray(belief.covariance[0]),
        0.1,
        np.asarray(motion.acceleration_density),
    )
    np.testing.assert_allclose(posterior.mean[0], x, rtol=1e-12)
    np.testing.assert_allclose(posterior.covariance[0], P, rtol=1e-9, atol=1e-12)
    np.testing.assert_array_equal(posterior.mean, prior.mean)


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
            motion, belief, pose, covariance, True, reading(has_odometry=False, dt_s=dt_s)
        )
        values.append(float(nis[0]))
    assert values[0] == 0
    values = np.array(values[1:])
    low, high = stats.chi2.ppf([1e-4, 1 - 1e-4], 3 * len(values))
    assert low < np.sum(values) < high
    assert stats.kstest(values, stats.chi2(3).cdf).pvalue > 1e-3


ONSETS = {"into a turn": ((0.4, 0.0), (0.4, 0.45)), "a start": ((0.0, 0.0), (0.5, 0.3)),
          "a brake": ((0.6, -0.3), (0.0, -0.3))}  # fmt: skip


@pytest.mark.parametrize(("before", "after"), ONSETS.values(), ids=ONSETS)
def test_a_velocity_that_changed_inside_an_interval_surprises_nobody(before, after):
    """At its onset the NIS of the true pose is that of three numbers, whenever it changed.

    What the prediction would say of the truth without that noise, the textbook's filter tells.
    """
    motion = BicycleKalman(worlds.qcar(), gate_nis=np.inf)
    dt_s, start, density = 0.1, np.array([0.5, -0.3, 0.7]), np.asarray(motion.acceleration_density)
    sharp = np.diag([1e-3, 1e-3, 0, 0, 0, 1e-3]) ** 2 + 1e-18 * np.eye(6)
    R_pose = planar_part(sharp, start[2]) + np.diag(np.asarray(motion.vision_floor) ** 2)
    odometry = np.asarray(motion.odometry_sigma)
    belief, pose = motion.init(), start
    for _ in range(20):  # settled in the old velocity
        told = reading(*before, dt_s=dt_s)
        _, belief, _ = drive_step(motion, belief, pose, sharp, True, told)
        pose = paper.drive(pose, *before, dt_s, WHEELBASE_M)[-1]
    begun = paper.drive(start, *before, 19 * dt_s, WHEELBASE_M)[-1]
    x, P = np.asarray(belief.mean[0]), np.asarray(belief.covariance[0])

    with_change, without = [], []
    for share in (np.arange(10) + 0.5) / 10:
        truth = begun
        for command, part in ((before, share), (after, 1 - share)):
            truth = paper.drive(truth, *command, part * dt_s, WHEELBASE_M)[-1]
        told = reading(*after, dt_s=dt_s)
        *_, nis = drive_step(motion, belief, truth, sharp, True, told)
        with_change.append(float(nis[0]))
        x_later, P_later = kalman.predict(x, P, dt_s, density)
        without.append(
            kalman.update(x_later, P_later, truth, R_pose, *after, WHEELBASE_M, odometry)[2]
        )
    # Nothing but the instant is unknown here: one number of the three.
    assert 0.5 < np.mean(with_change) < 3
    assert np.max(with_change) < stats.chi2(3).ppf(0.95)
    assert np.max(without) > stats.chi2(3).ppf(0.9999)


def outlier_steps(kind: str, **options):
    """A step of one hypothesis of either model with a planar pose, at rest."""
    car = kind == "car"
    motion = BicycleKalman(worlds.qcar(), **options) if car else ConstantVelocity(**options)

    def step(belief, x_m, taken=True):
        return drive_step(motion, belief, (x_m,), 1e-4 * np.eye(6), taken, reading(dt_s=0.02))

    return motion, step


def settled(motion, step) -> Bank:
    """After twenty poses at the origin."""
    belief = motion.init()
    for _ in range(20):
        _, belief, _ = step(belief, 0.0)
    return belief


@pytest.mark.parametrize(("kind", "dof"), [("car", 3), ("free", 6)])
def test_the_gate_keeps_an_outlier_out(kind, dof):
    """The state is the prediction's, the NIS that of the pose that was offered."""
    motion, step = outlier_steps(kind)
    assert motion.gate_nis == pytest.approx(stats.chi2.ppf(0.9999, dof), abs=0.1)
    belief = settled(motion, step)
    assert belief.rejections.count[0] == 0
    prior, after, nis = step(belief, 0.3)
    blind_prior, blind, _ = step(belief, 0.3, taken=False)
    np.testing.assert_array_equal(prior.mean, blind_prior.mean)
    np.testing.assert_array_equal(after.mean, blind.mean)
    np.testing.assert_array_equal(after.covariance, blind.covariance)
    innovation, floor = np.zeros(6), np.zeros((6, 6))
    floor[np.diag_indices(6)] = 1e-4
    if kind == "car":
        innovation = np.array([0.3, 0, 0]) - np.asarray(prior.mean)[0, :3]
        S = np.asarray(prior.covariance)[0, :3, :3] + floor[:3, :3]
    else:
        T = worlds.planar(0.3, 0.0, 0.0)
        between = np.linalg.solve(matrix(prior.mean[0, :7]), matrix(T.wxyz_xyz))
        X = np.real(logm(between))
        innovation = np.array([*X[:3, 3], X[2, 1], X[0, 2], X[1, 0]])
        S = np.asarray(prior.covariance)[0, :6, :6] + floor
    S = S + np.diag(np.asarray(motion.vision_floor) ** 2)
    assert nis[0] == pytest.approx(innovation @ np.linalg.solve(S, innovation), rel=1e-9)
    assert nis[0] > motion.gate_nis
    assert after.rejections.count[0] == 1
    # Where nothing is offered it is not counted, and the next good one clears the count.
    _, unseen, _ = step(after, 0.0, taken=False)
    assert unseen.rejections.count[0] == 1
    _, again, nis = step(unseen, 0.0)
    assert nis[0] < motion.gate_nis
    assert again.rejections.count[0] == 0


@pytest.mark.parametrize("kind", ["car", "free"])
def test_ten_rejections_in_a_row_start_it_anew(kind):
    motion, step = outlier_steps(kind)
    belief = settled(motion, step)
    for count in range(1, motion.max_rejections + 1):
        prior, belief, nis = step(belief, 5.0)
        assert prior.initialised[0]
        assert nis[0] > motion.gate_nis
        assert int(belief.rejections.count[0]) == count
        assert abs(poses_of(motion, belief)[0, 4]) < 0.1
    prior, belief, nis = step(belief, 5.0)
    assert not prior.initialised[0]
    assert belief.initialised[0]
    assert (nis[0], belief.rejections.count[0]) == (0, 0)
    np.testing.assert_allclose(poses_of(motion, belief)[0, 4:], [5.0, 0, 0], atol=1e-6)


@pytest.mark.parametrize("kind", ["car", "free"])
def test_without_a_gate_every_pose_is_fused_and_nothing_starts_anew(kind):
    """Poses that run away ever faster: each is far off, all to one side, for longer than a row of
    rejections may last. The gain is the scalar one, P / (P + R), along x."""
    motion, step = outlier_steps(kind, gate_nis=np.inf, max_rejected_s=0.3)
    belief = settled(motion, step)
    R = 1e-4 + float(motion.vision_floor[0]) ** 2
    for count in range(1, 3 * motion.max_rejections):
        pose_m = 0.1 * count**2
        prior, belief, nis = step(belief, pose_m)
        predicted_m, fused_m = (float(poses_of(motion, bank)[0, 4]) for bank in (prior, belief))
        P = float(prior.covariance[0, 0, 0])
        assert nis[0] == pytest.approx((pose_m - predicted_m) ** 2 / (P + R))
        assert nis[0] > 30  # above either gate
        assert fused_m == pytest.approx(predicted_m + P / (P + R) * (pose_m - predicted_m))
        assert prior.initialised[0]
        assert (belief.rejections.count[0], belief.rejections.duration_s[0]) == (0, 0)


@pytest.mark.parametrize("kind", ["car", "free"])
def test_rejections_that_contradict_each_other_start_nothing(kind):
    """A reflection here, then there (docs/design.md, Restart): only later it starts anew."""
    patience = 30  # steps of 0.02 s
    motion, step = outlier_steps(kind, max_rejected_s=0.02 * patience - 0.001)
    belief = settled(motion, step)
    for count in range(patience):
        prior, belief, nis = step(belief, 5.0 if count % 2 else -5.0)
        assert prior.initialised[0]
        assert nis[0] > motion.gate_nis
        assert belief.rejections.count[0] == 1
        assert belief.rejections.duration_s[0] == pytest.approx(0.02 * (count + 1))
    prior, belief, _ = step(belief, 5.0)
    assert not prior.initialised[0]
    assert (belief.rejections.count[0], belief.rejections.duration_s[0]) == (0, 0)


@pytest.mark.parametrize("coasts", [1, 4])
def test_rejections_last_as_long_as_the_clock_says(coasts):
    """Whatever comes between two poses, odometry say, and however often: its time counts too."""
    motion, step = outlier_steps("car", max_rejected_s=0.5)
    belief, forgotten_s = settled(motion, step), None
    for count in range(40):
        for _ in range(coasts):
            belief = predicted(motion, belief, reading(dt_s=0.02))
        prior, belief, _ = step(belief, 5.0 if count % 2 else -5.0)
        if not prior.initialised[0]:
            forgotten_s = 0.02 * (1 + coasts) * count
            break
    assert forgotten_s == pytest.approx(0.5, abs=0.02 * (1 + coasts))


def test_a_pause_without_poses_contradicts_for_a_second_at_most():
    motion, step = outlier_steps("car")
    belief = settled(motion, step)
    for seconds in (1.0, 2.0):
        for _ in range(20):
            belief = predicted(motion, belief, reading(dt_s=0.5))
        assert belief.initialised[0]
        _, belief, _ = step(belief, 5000.0 * (-1) ** seconds)
        assert belief.rejections.duration_s[0] == pytest.approx(seconds)


@pytest.mark.parametrize("kind", ["car", "free"])
def test_hypotheses_are_filters_of_their_own(kind):
    """Three at once are three alone; one that is not kept starts anew."""
    motion, _ = outlier_steps(kind)
    poses = np.array([[0.0, 0.0, 0.0], [1.0, 0.5, 2.0], [0.3, -1.0, -3.0]])

    def drive(belief, poses, kept):
        for offset in (0.0, 0.01, 0.03):
            Ts = np.squeeze([level(*pose) for pose in poses + offset])
            told = reading(0.2, 0.1), Ts, 1e-3 * np.eye(6), np.asarray(True), np.squeeze(kept)
            _, belief, nis = stepped(motion, belief, *told)
        return belief, nis

    kept = np.array([True, False, True])
    together, nis = drive(motion.init(3), poses, kept)
    for index in range(3):
        alone, own = drive(motion.init(), poses[index][None], kept[index][None])
        np.testing.assert_allclose(together.mean[index], alone.mean[0], atol=1e-12)
        np.testing.assert_allclose(together.covariance[index], alone.covariance[0], atol=1e-12)
        assert nis[index] == pytest.approx(float(own[0]), rel=1e-9)
    assert nis[1] == 0
    found = poses_of(motion, together)[1, 4:]
    np.testing.assert_allclose(found, level(*(poses[1] + 0.03))[4:], atol=1e-9)


@pytest.mark.parametrize(("kind", "size"), [("car", 6), ("free", 12)])
def test_the_first_pose_starts_the_filter(kind, size):
    motion = BicycleKalman(worlds.qcar()) if kind == "car" else ConstantVelocity()
    assert isinstance(motion, Motion)
    assert not motion.init().initialised[0]
    pose = (0.4, -0.2, 2.0)
    _, blind, _ = drive_step(motion, motion.init(), pose, 1e-4 * np.eye(6), False, reading())
    assert not blind.initialised[0]
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(blind))
    _, belief, nis = drive_step(motion, motion.init(), pose, 1e-4 * np.eye(6), True, reading())
    assert belief.initialised[0]
    assert nis[0] == 0
    assert belief.covariance.shape == (1, size, size)
    np.testing.assert_allclose(poses_of(motion, belief)[0], level(*pose), atol=1e-6)


def test_poses_of_a_car_are_level_and_carry_the_planar_covariance():
    motion = BicycleKalman(worlds.qcar())
    root = np.random.default_rng(2).normal(size=(6, 6))
    P = root @ root.T
    belief = believing(motion, [0.3, -0.4, 2.0, 0.1, 0.2, 0.3], P)
    found = _poses_of(motion, belief)
    expected = level(0.3, -0.4, 2.0)
    np.testing.assert_allclose(found.T_world_vehicle.wxyz_xyz[0], expected, atol=1e-15)
    np.testing.assert_allclose(planar_part(found.covariance[0], 2.0), P[:3, :3], atol=1e-12)
    np.testing.assert_array_equal(found.covariance[0, 2:5], 0)


def test_broken_hypotheses_start_anew():
    starts = BicycleKalman(worlds.qcar()).init(3)
    mean, covariance = np.array(starts.mean) + np.arange(3)[:, None], np.array(starts.covariance)
    mean[1, 4], covariance[2, 0, 5] = np.nan, np.inf
    alive = jnp.asarray(np.ones(3, bool))
    broken = dataclasses.replace(
        starts, mean=jnp.asarray(mean), covariance=jnp.asarray(covariance), initialised=alive
    )
    kept = jax.jit(restart_broken)(broken, starts)
    assert kept.initialised.tolist() == [True, False, False]
    np.testing.assert_array_equal(kept.mean[0], mean[0])
    np.testing.assert_array_equal(kept.mean[1:], 0)
    assert np.all(np.isfinite(kept.covariance))


def test_what_the_gate_accepts_is_told():
    """Wider where prediction and corners vary more than they say; counted all the same."""
    bank = jax.tree.map(lambda leaf: jnp.asarray(leaf[0]), BicycleKalman(worlds.qcar()).init())
    bank = dataclasses.replace(bank, initialised=jnp.asarray(True))
    posterior, gate = (jnp.asarray(np.ones(6)), bank.covariance), jax.jit(apply_gate)
    for nis, inflation, taken in ((20.0, 1.0, True), (22.0, 1.0, False), (22.0, 2.0, True)):
        numbers = (jnp.asarray(number) for number in (0.0, inflation))
        innovation = jnp.asarray(np.array([np.sqrt(nis), 0, 0]))
        offer = Offer(innovation, posterior, 21.1, *numbers)
        after, own, accepted = gate(bank, offer, posterior, jnp.asarray(True))
        assert (float(own), bool(accepted)) == (pytest.approx(nis), taken)
        np.testing.assert_array_equal(after.mean, bank.mean + taken)
        assert int(after.rejections.count) == (nis > 21.1)


@pytest.mark.parametrize("kind", ["car", "free"])
def test_a_state_on_the_ground_and_its_covariance(kind):
    """Pose and velocity as a small time later tells, covariances as samples do."""
    rng = np.random.default_rng(3)
    car = BicycleKalman(worlds.qcar())
    motion = car if kind == "car" else ConstantVelocity(acceleration_density=jnp.zeros(6))
    if kind == "car":
        mean = jnp.asarray([0.4, -0.2, 1.1, 0.3, -0.1, 0.5])
    else:
        tilted = jaxlie.SE3.exp(jnp.asarray([0.3, -0.4, 0.1, 0.2, -0.3, 0.9]))
        mean = jnp.append(tilted.wxyz_xyz, jnp.asarray([0.3, -0.1, 0.2, 0.4, -0.2, 0.5]))
    size = motion.init().covariance.shape[-1]
    root = 1e-3 * rng.standard_normal((size, size))
    told = eqx.filter_jit(motion.planar)(mean, jnp.asarray(root @ root.T))
    dt_s = 1e-6
    bank = believing(motion, mean, np.eye(size))
    on_ground = (lambda mean: (mean[:3], mean[3:6])) if kind == "car" else motion.on_ground
    if kind == "free":
        later = predicted(motion, bank, reading(dt_s=dt_s))
        moved = eqx.filter_jit(on_ground)(later.mean[0])[0]
    else:
        moved = mean[:3] + dt_s * mean[3:]
    np.testing.assert_allclose((moved - told.pose) / dt_s, told.velocity, atol=1e-5)
    errors = jnp.asarray(rng.standard_normal((20_000, size)) @ root.T)
    poses, velocities = jax.jit(jax.vmap(lambda error: on_ground(motion.moved(mean, error))))(
        errors
    )
    for samples, covariance in (
        (poses, told.pose_covariance),
        (velocities, told.velocity_covariance),
    ):
        scale = np.sqrt(np.outer(np.diagonal(covariance), np.diagonal(covariance)))
        np.testing.assert_allclose(
            np.cov(np.asarray(samples).T) / scale, covariance / scale, atol=0.05
        )


def test_constant_velocity_carries_its_covariance_as_samples_do():
    """Without process noise 20 000 samples moved by the exact motion have the predicted one."""
    motion = ConstantVelocity(acceleration_density=jnp.zeros(6))
    rng = np.random.default_rng(3)
    root = 0.01 * rng.normal(size=(12, 12))
    twist = jnp.asarray([0.4, -0.2, 0.1, 0.3, -0.5, 0.8])
    T = jaxlie.SE3.exp(jnp.asarray(rng.normal(size=6)))
    belief = believing(motion, jnp.append(T.wxyz_xyz, twist), root @ root.T)
    dt_s = 0.1
    later = predicted(motion, belief, reading(dt_s=dt_s))

    @jax.jit
    @jax.vmap
    def moved(error):
        truth = T @ jaxlie.SE3.exp(error[:6]) @ jaxlie.SE3.exp((twist + error[6:]) * dt_s)
        believed = jaxlie.SE3(later.mean[0, :7])
        return jnp.append((believed.inverse() @ truth).log(), error[6:])

    errors = moved(jnp.asarray(rng.normal(size=(20_000, 12)) @ root.T))
    # 5 % for the Jacobian of exp that F leaves out (half the turn, 0.05 rad).
    check_samples(errors, later, 0.05)


def check_samples(errors, bank: Bank, share: float = 0.0) -> None:
    """Whether samples (N, 12) have the covariance of a hypothesis, but for a share and noise."""
    whitened = np.linalg.solve(np.linalg.cholesky(bank.covariance[0]), np.asarray(errors).T)
    found, count = whitened @ whitened.T, whitened.shape[1]
    np.testing.assert_allclose(found / count, np.eye(12), atol=share + 5 / np.sqrt(count))


def test_odometry_s_motion_carries_its_covariance_as_samples_do():
    """20 000 bodies that start off by P, and drift off the motion that is told."""
    drift = jnp.asarray([0.05, 0.04, 0.03, 0.02])
    A = jnp.asarray([0.3, 0.2, 0.1, 0.2, 0.3, 0.1])
    motion = ConstantVelocity(acceleration_density=A, odometry_drift=drift)
    rng = np.random.default_rng(5)
    root = 0.01 * rng.normal(size=(12, 12))
    told = np.array([0.4, -0.2, 0.1, 0.3, -0.1, 0.2])
    T = jaxlie.SE3.exp(jnp.asarray(rng.normal(size=6)))
    # What the state believes of the twist is not looked at.
    start = believing(motion, jnp.append(T.wxyz_xyz, jnp.full(6, 9.0)), root @ root.T)
    dt_s = 0.2
    after = predicted(motion, start, reading(dt_s=dt_s, twist=told))
    np.testing.assert_allclose(after.mean[0, 7:], told)
    way_m, angle_rad = (dt_s * np.linalg.norm(part) for part in (told[:3], told[3:]))
    linear = 0.05**2 * way_m + 0.03**2 * dt_s
    angular = 0.04**2 * angle_rad + 0.02**2 * dt_s

    @jax.jit
    @jax.vmap
    def off(error, drifted, later):
        truth = T @ jaxlie.SE3.exp(error) @ jaxlie.SE3.exp(told * dt_s) @ jaxlie.SE3.exp(drifted)
        believed = jaxlie.SE3(after.mean[0, :7])
        return jnp.append((believed.inverse() @ truth).log(), drifted / dt_s + later)

    count = 20_000
    errors = off(
        jnp.asarray(rng.normal(size=(count, 12)) @ root.T)[:, :6],
        jnp.asarray(rng.normal(size=(count, 6)) * np.sqrt(np.repeat([linear, angular], 3))),
        jnp.asarray(rng.normal(size=(count, 6)) * np.sqrt(A * dt_s / 3)),
    )
    check_samples(errors, after)


def test_odometry_s_drift_does_not_depend_on_how_often_it_is_read():
    motion = ConstantVelocity(odometry_drift=jnp.asarray([0.05, 0.0, 0.03, 0.0]))
    twist = [0.5, 0, 0, 0, 0, 0]
    start = believing(motion, np.append(level(0.3, 0.1, 1.0), np.zeros(6)), 1e-8 * np.eye(12))
    seldom = predicted(motion, start, reading(dt_s=2.0, twist=twist))
    often = start
    for _ in range(20):
        often = predicted(motion, often, reading(dt_s=0.1, twist=twist))
    np.testing.assert_allclose(often.mean[0, :7], seldom.mean[0, :7], atol=1e-12)
    np.testing.assert_allclose(
        often.covariance[0, :3, :3], seldom.covariance[0, :3, :3], rtol=1e-3, atol=1e-7
    )


def test_a_twist_that_is_no_motion_is_not_used():
    motion = ConstantVelocity()
    start = believing(motion, np.append(level(), np.zeros(6)), np.eye(12))
    expected = jax.tree.leaves(predicted(motion, start, reading()))
    for bad in (np.nan, np.inf, 1e4):
        found = predicted(motion, start, reading(twist=[bad, 0, 0, 0, 0, 0]))
        for left, right in zip(jax.tree.leaves(found), expected, strict=True):
            np.testing.assert_array_equal(left, right)


def test_constant_velocity_converges_on_a_moving_body():
    """Noisy poses of a body that screws through space: pose and twist are found, errors as said."""
    motion = ConstantVelocity(acceleration_density=jnp.full(6, 0.05**2, float))
    rng = np.random.default_rng(4)
    twist = jnp.asarray([0.5, 0.1, -0.2, 0.2, -0.1, 0.6])
    T = jaxlie.SE3.identity()
    sigma = np.array([0.01] * 3 + [0.02] * 3)
    dt_s = 0.05
    belief, normalised, values = motion.init(), [], []
    advance = jax.jit(lambda T, xi: T @ jaxlie.SE3.exp(xi))
    for step in range(200):
        T = advance(T, twist * dt_s)
        noisy = advance(T, jnp.asarray(sigma * rng.standard_normal(6)))
        told = reading(dt_s=dt_s), noisy.wxyz_xyz, np.diag(sigma**2), True
        _, belief, nis = stepped(motion, belief, *told)
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
    motion, sharp = ConstantVelocity(), 1e-4 * np.eye(6)
    belief = drive_step(motion, motion.init(), (0.3, 0.1, 1.0), sharp, True, reading())[1]
    assert predicted(motion, belief, reading(dt_s=0.1)).initialised[0]
    there, late = (-3.0, 2.0, -2.0), reading(dt_s=10.0)
    prior, again, nis = drive_step(motion, belief, there, sharp, True, late)
    assert not prior.initialised[0]
    np.testing.assert_allclose(again.mean[0, :7], level(*there), atol=1e-12)
    np.testing.assert_array_equal(again.mean[0, 7:], 0)
    assert nis[0] == 0


FREE_ALONE = pytest.param("free", marks=pytest.mark.long)


@pytest.mark.parametrize("kind", ["car", FREE_ALONE, "free with odometry"])
@in_float32
def test_gradients_are_finite_at_rest_and_at_the_prediction(precision, kind):
    """Of everything by noise parameters, pose and odometry, where innovations are 0."""
    motion = BicycleKalman(worlds.qcar()) if kind == "car" else ConstantVelocity()
    pose = jnp.asarray(level(0.3, 0.1, 1.0))

    @jax.jit
    @jax.grad
    def slope(floats, taken):
        motion, wxyz_xyz, speed_mps, dt_s = floats
        obs = reading(speed_mps, dt_s=dt_s)
        if kind == "free with odometry":
            obs = dataclasses.replace(obs, twist=jnp.zeros(6) * speed_mps)

        def look(prior, taken):
            here = chosen(prior, wxyz_xyz, 1e-4 * jnp.eye(6), taken)
            return motion.update(prior, here, obs)[:2]

        belief, _ = look(motion.init(), True)
        belief, nis = look(motion.predict(belief, obs), taken)
        return jnp.sum(belief.mean) + jnp.sum(belief.covariance) + jnp.sum(nis)

    for taken in (True, False):
        zero = jnp.asarray(0.0)
        for leaf in jax.tree.leaves(slope((motion, pose, zero, zero), taken)):
            assert leaf.dtype == precision
            assert np.all(np.isfinite(leaf))
