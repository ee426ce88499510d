"""A free body's odometry that is off in scale and direction: derivatives, drives, and banks."""

import functools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter import kalman
from jaxnav.core.filter.bank import merge_hypotheses
from jaxnav.core.filter.choose import MeasuredPose
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.smooth import smoothed
from jaxnav.core.models.geometry import cayley, inverse_cayley
from jaxnav.core.models.vehicle import OdometryErrors, default_odometry_sigma
from jaxnav.core.pose.observation import Observation
from tests import worlds
from tests.derivatives import check_derivatives
from tests.helpers.filters import believing

ARM_M = np.array([0.1, -0.05, 0.2])
ERRORS = OdometryErrors.create(default_odometry_sigma(), ARM_M)
MOTION = ConstantVelocity(odometry_errors=ERRORS)
DT_S = 0.2
# 12 s, of which a marker shows the body in the first and the last two, and for 1 s in the middle.
STEPS = 60
SEEN = np.array([step < 10 or 28 <= step < 33 or step >= 50 for step in range(STEPS)])
SIGMA = jnp.asarray([0.01] * 3 + [0.01] * 3)  # of a seen pose, m and rad
DRIVES = 100


def reading(twist, dt_s: float = DT_S) -> Observation:
    return Observation(jnp.zeros((0, 0, 4, 2)), jnp.zeros((0, 0), bool), dt_s=dt_s, twist=twist)


def told_by(errors, twist):
    """What an odometry at ARM_M tells whose way is too short by errors[0] and whose body is turned.

    By the step of its body, not by twists.
    """
    at_body = jaxlie.SE3.from_translation(jnp.asarray(ARM_M))
    turn = jaxlie.SO3.exp(errors[1:])
    step = at_body.inverse() @ jaxlie.SE3.exp(twist * DT_S) @ at_body
    told = jaxlie.SE3.from_rotation_and_translation(
        turn.inverse() @ step.rotation() @ turn,
        turn.inverse() @ step.translation() / (1 + errors[0]),
    )
    return (at_body @ told @ at_body.inverse()).log() / DT_S


def test_a_twist_is_corrected_as_the_step_of_the_odometry_s_body_is():
    rng = np.random.default_rng(1)
    errors, twist = jnp.asarray(0.1 * rng.normal(size=4)), jnp.asarray(rng.normal(size=6))
    found = jax.jit(lambda u, e: ERRORS.corrected(told_by(e, u), e))(twist, errors)
    np.testing.assert_allclose(found, twist, atol=1e-12)
    # With and without a turn, with and without errors.
    twists = rng.normal(size=(4, 6)) * np.repeat([[1, 1, 1, 0, 0, 0], [1] * 6], 2, axis=0)
    several = jnp.asarray(np.outer([1, 0, 1, 0], errors))
    check_derivatives(jax.vmap(ERRORS.corrected), jnp.asarray(twists), several)


@pytest.mark.parametrize("told", [True, False], ids=["told", "silent"])
def test_the_covariance_goes_with_the_derivatives_of_the_motion(precision, told):
    """P' - Q = F P F', with F by forward mode through the whole prediction."""
    rng = np.random.default_rng(2)
    dtype = precision
    T = jaxlie.SE3.exp(jnp.asarray(rng.normal(size=6), dtype))
    rest = jnp.asarray([*rng.normal(size=6), 0.05, 0.03, -0.02, 0.04], dtype)
    mean, root = jnp.concatenate([T.wxyz_xyz, rest]), jnp.asarray(rng.normal(size=(16, 16)), dtype)
    obs = reading(jnp.asarray(rng.normal(size=6) if told else np.full(6, np.nan), dtype))
    motion = jax.tree.map(lambda leaf: jnp.asarray(leaf, dtype), MOTION)
    P = 1e-2 * root @ root.T

    @jax.jit
    def both(mean, P):
        later, covariance = motion.evolve(mean, P, obs)
        _, Q = motion.evolve(mean, jnp.zeros_like(P), obs)

        def off(error):
            return motion.difference(motion.evolve(motion.moved(mean, error), P, obs)[0], later)

        F = jax.jacfwd(off)(jnp.zeros(16, dtype))
        return covariance, F @ P @ F.T + Q

    # Without odometry the filter leaves out how exp turns with the twist, half of the turn.
    tolerance = (2e-5 if dtype == np.float32 else 1e-10) if told else 0.1
    found, expected = both(mean, P)
    np.testing.assert_allclose(found, expected, atol=tolerance * np.max(expected))


def drive(motion, errors, key, states: int):
    """One body: true poses, those of the filter and of the smoother, with their covariances."""
    keys = jax.random.split(key, 3)
    times_s = DT_S * jnp.arange(STEPS)
    phases = jax.random.uniform(keys[0], (6,), maxval=6.0)
    swing = jnp.sin(times_s[:, None] * jnp.linspace(0.5, 1.5, 6)[None] + phases[None])
    twists = jnp.asarray([[0.6, 0.3, 0.3, 0.3, 0.3, 0.5]]) * swing
    D = jax.vmap(lambda u: motion._drift(u, jnp.asarray(DT_S))[:6, :6])(twists)
    drifts = jnp.sqrt(jnp.diagonal(D, axis1=1, axis2=2)) * jax.random.normal(keys[1], (STEPS, 6))
    noise = SIGMA[None] * jax.random.normal(keys[2], (STEPS, 6))
    told = jax.vmap(lambda u: told_by(errors, u))(twists)

    def move(T, step):
        twist, drift = step
        later = jaxlie.SE3(T) @ jaxlie.SE3.exp(twist * DT_S) @ jaxlie.SE3.exp(drift)
        return later.normalize().wxyz_xyz, later.normalize().wxyz_xyz

    _, truth = jax.lax.scan(move, jaxlie.SE3.identity().wxyz_xyz, (twists, drifts))
    seen = jax.vmap(lambda T, xi: (jaxlie.SE3(T) @ cayley(xi)).wxyz_xyz)(truth, noise)
    H = jnp.eye(6, states)

    def forward(moments, step):
        twist, pose, visible = step
        mean, P = motion.evolve(*moments, reading(twist))
        innovation = inverse_cayley(jaxlie.SE3(mean[:7]).inverse() @ jaxlie.SE3(pose))
        R = jnp.diag(SIGMA**2)
        correction, after, _ = kalman.update(
            P, *kalman.hide_rows(innovation, H, R, jnp.full(6, visible))
        )
        filtered = motion.moved(mean, correction), after
        return filtered, filtered

    rest, P_rest = motion.at_first()
    first = jnp.append(jaxlie.SE3.identity().wxyz_xyz, rest)
    P = jax.scipy.linalg.block_diag(1e-8 * jnp.eye(6), P_rest)
    rows = told, seen, jnp.asarray(SEEN, float)
    _, filtered = jax.lax.scan(forward, (first, P), rows)

    def backward(later, step):
        moments, twist = step
        earlier = smoothed(motion, moments, later, reading(twist))
        return earlier, earlier

    last = jax.tree.map(lambda leaf: leaf[-1], filtered)
    before = jax.tree.map(lambda leaf: leaf[:-1], filtered)
    _, rest = jax.lax.scan(backward, last, (before, told[1:]), reverse=True)
    both = jax.tree.map(lambda a, b: jnp.concatenate([a, b[None]]), rest, last)
    return truth, filtered, both


def judged(motion, errors):
    """Over many drives, (STEPS,): NEES of the pose over its 6 dof, and position errors in m."""
    states = 6 + motion.at_first()[0].shape[0]
    both, bias, P_bias = jax.device_get(many_drives(motion, errors, KEYS, states))
    scores = []
    for off, P in both:
        nees = np.sum(off * np.linalg.solve(P, off[..., None])[..., 0], axis=-1)
        rms_m = np.sqrt(np.mean(np.sum(off[..., :3] ** 2, axis=-1), axis=0))
        scores.append((np.mean(nees, axis=0) / 6, rms_m))
    return scores, bias, P_bias


KEYS = jax.random.split(jax.random.key(3), DRIVES)


@functools.partial(jax.jit, static_argnames="states")
@functools.partial(jax.vmap, in_axes=(None, 0, 0, None))
def many_drives(motion, errors, key, states):
    """Of the filter and the smoother: errors of poses, and their covariances; the odometry's errors
    as they are found at the end."""
    truth, *both = drive(motion, errors, key, states)

    def off(one, found, P):
        return inverse_cayley(jaxlie.SE3(found[:7]).inverse() @ jaxlie.SE3(one)), P[:6, :6]

    mean, P = both[0]
    told = [jax.vmap(off)(truth, *moments) for moments in both]
    return told, mean[-1, 13:], P[-1, 12:, 12:]


@pytest.fixture(scope="module")
def off_by_7_percent_and_2_degrees():
    """Every drive the same: 0.93 of the way, and the body turned by 2 degrees."""
    errors = np.array([1 / 0.93 - 1, 0, 0, np.deg2rad(2.0)])
    return errors, jnp.asarray(np.tile(errors, (DRIVES, 1)))


@pytest.mark.long
def test_errors_that_are_as_large_as_told_leave_poses_as_far_off_as_they_say():
    errors = ERRORS.sigma[None] * jax.random.normal(jax.random.key(1), (DRIVES, 4))
    ((filtered, _), (both, _)), found, P = judged(MOTION, errors)
    # 100 drives of 6 dof: a sigma of 0.058; the filter's 60 values are not independent.
    assert np.all(np.abs(filtered - 1) < 0.25), filtered
    assert np.all(np.abs(both - 1) < 0.25), both
    assert abs(np.mean(filtered) - 1) < 0.12
    assert abs(np.mean(both) - 1) < 0.12
    off = np.asarray(errors - found)
    nees = np.einsum("ni,nij,nj->n", off, np.linalg.inv(P), off) / 4
    assert abs(np.mean(nees) - 1) < 0.21  # three sigmas
    assert np.sqrt(np.mean(off[:, 0] ** 2)) < 0.75 * ERRORS.sigma[0]


def test_a_scale_that_is_far_off_is_found_and_taken_out(off_by_7_percent_and_2_degrees):
    errors, all_alike = off_by_7_percent_and_2_degrees
    ((learnt, learnt_m), (both, both_m)), found, P = judged(MOTION, all_alike)
    ((_, plain_m), (plain_both, plain_both_m)), _, _ = judged(ConstantVelocity(), all_alike)
    hidden = ~SEEN
    # 2.5 and 2 sigmas of the prior: as far off as one drive in a hundred.
    assert np.max(learnt) < 2.2
    assert np.mean(both[hidden]) < 1.4
    assert np.mean(plain_both[hidden]) > 1.3 * np.mean(both[hidden])
    late = np.arange(STEPS) >= 33  # after the middle
    assert np.max(learnt_m[late & hidden]) < 0.9 * np.max(plain_m[late & hidden])
    assert np.mean(both_m[hidden]) < np.mean(plain_both_m[hidden])
    mean, sigma = np.mean(found, axis=0), np.sqrt(np.mean(np.diagonal(P, axis1=1, axis2=2), axis=0))
    assert abs(mean[0] - errors[0]) < 0.5 * errors[0]
    assert abs(mean[3] - errors[3]) < 0.5 * errors[3]
    assert np.all(sigma < np.asarray(ERRORS.sigma))


def test_a_bank_keeps_what_it_has_learnt_where_it_merges_and_begins_anew_at_the_prior():
    """As all errors beside pose and twist: considered while the orientation is not known."""
    bank = MOTION.init(2)
    rest, P_rest = MOTION.at_first()
    np.testing.assert_array_equal(bank.mean[0, 7:], rest)
    errors = np.array([[0.02, 0.01, 0.0, 0.03], [0.04, 0.01, 0.02, -0.01]])
    mean, P = np.array(bank.mean), 1e-6 * np.asarray(bank.covariance)
    mean[:, 13:] = errors
    bank = believing(MOTION, mean, P, [0.75, 0.25])

    @jax.jit
    def merged_in_one(bank):
        return merge_hypotheses(bank, jnp.asarray([0, 0]), MOTION.difference, MOTION.moved)

    merged = merged_in_one(bank)
    np.testing.assert_array_equal(merged.initialised, [True, False])
    np.testing.assert_allclose(merged.mean[0, 13:], 0.75 * errors[0] + 0.25 * errors[1], atol=1e-12)
    spread = (errors[0] - errors[1]) * np.sqrt(0.75 * 0.25)
    np.testing.assert_allclose(
        merged.covariance[0, 12:, 12:],
        np.outer(spread, spread) + np.asarray(bank.covariance[0, 12:, 12:]),
        atol=1e-12,
    )

    @jax.jit
    def begun(bank):
        here = jaxlie.SE3.identity(), 1e-4 * jnp.eye(6), jnp.zeros(()), jnp.asarray(True)
        first = jax.tree.map(lambda leaf: leaf[0], bank)
        return MOTION.start(first, MeasuredPose(*here), reading(jnp.zeros(6)))

    mean, P = begun(bank)
    np.testing.assert_array_equal(mean[13:], 0)
    np.testing.assert_array_equal(P[6:, 6:], P_rest)


def test_without_errors_and_for_a_single_rule_there_are_no_states():
    rig = worlds.handheld_rig()
    assert MOTION.for_rig(rig, 24).init(3).mean.shape == (3, 17)
    for motion in (MOTION.for_rig(rig, 1), ConstantVelocity().for_rig(rig, 24)):
        assert motion.odometry_errors is None
        assert motion.init(1).mean.shape == (1, 13)
