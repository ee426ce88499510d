"""What ROS is told of an estimate, against samples that are moved one by one."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.models.geometry import cayley
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.drive.flags import Fault, Health, Reject
from jaxnav.drive.pilot import Outcome
from jaxnav.recordings.ros.estimates import base_hypotheses, base_pose_covariance, base_twist
from jaxnav.vehicles.conformance.lockstep import Step
from tests.helpers.simulated import make_setup, simulated
from tests.worlds import paper_markers, qcar_rig

BASE_X_M = -0.128
SAMPLES = 100_000


@pytest.fixture(scope="module")
def steps() -> list[Step]:
    return simulated(make_setup(), 1.5)


def sampled(mean: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    return np.random.default_rng(0).multivariate_normal(mean, covariance, SAMPLES)


def close(found: np.ndarray, expected: np.ndarray) -> None:
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, atol=0.02)


def test_pose_and_twist_are_those_of_the_base(steps):
    outcome = steps[-1].outcome
    pose, _ = base_pose_covariance(outcome, BASE_X_M)
    x_m, y_m, psi_rad = outcome.pose
    ahead = np.array([np.cos(psi_rad), np.sin(psi_rad)])
    np.testing.assert_allclose(pose[4:6], [x_m, y_m] + BASE_X_M * ahead, atol=1e-6)
    assert 2 * np.arctan2(pose[3], pose[0]) == pytest.approx(psi_rad)
    vx_mps, vy_mps, rate_radps = outcome.output.velocity
    forward_mps = ahead @ [vx_mps, vy_mps]
    left_mps = np.array([-ahead[1], ahead[0]]) @ [vx_mps, vy_mps]
    expected = [forward_mps, left_mps + BASE_X_M * rate_radps, 0, 0, 0, rate_radps]
    np.testing.assert_allclose(base_twist(outcome, BASE_X_M)[0], expected, atol=1e-6)


def test_the_covariance_of_the_base_is_that_of_moved_samples(steps):
    outcome = steps[-1].outcome
    _, covariance = base_pose_covariance(outcome, 2.0)
    poses = sampled(np.asarray(outcome.output.pose, float), outcome.output.pose_covariance)
    psi_rad = poses[:, 2]
    places = poses[:, :2] + 2.0 * np.stack([np.cos(psi_rad), np.sin(psi_rad)], axis=1)
    planar = np.ix_([0, 1, 5], [0, 1, 5])
    close(covariance[planar], np.cov(np.column_stack([places, psi_rad]).T))
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_the_hypotheses_come_heaviest_first_and_weigh_one(steps):
    alive = [int(step.outcome.belief.bank.initialised.sum()) for step in steps]
    first = next(index for index, count in enumerate(alive) if count > 1)
    undecided = steps[first].outcome
    poses, _, weight = base_hypotheses(undecided, 0.0)
    assert len(weight) == alive[first]
    assert np.all(np.diff(weight) <= 0)
    assert np.sum(weight) == pytest.approx(1)
    # They are those of the last data, the pose is the present one: the car drives 0.5 m/s.
    np.testing.assert_allclose(poses[0, 4:6], undecided.pose[:2], atol=0.01)
    assert len(base_hypotheses(steps[0].outcome, 0.0)[2]) == alive[0]


def test_a_free_body_s_covariance_is_in_the_axes_of_the_map():
    rig, markers = qcar_rig(), paper_markers()
    navigator = Navigator(rig=rig, markers=markers)
    nothing = Observation(jnp.zeros((4, 1, 4, 2)), jnp.zeros((4, 1), bool))
    shapes = jax.eval_shape(lambda: navigator.step(navigator.init(), nothing))
    state, output = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    T = jaxlie.SE3.exp(jnp.asarray([1.0, 2.0, 3.0, 0.3, -0.5, 0.9]))
    root = 0.01 * np.random.default_rng(1).standard_normal((12, 12))
    P = jnp.asarray(root @ root.T)
    bank = state.belief.bank
    mean = bank.mean.at[0, :7].set(T.wxyz_xyz).at[0, 7:13].set(jnp.arange(6.0))
    covariance = bank.covariance.at[0, :12, :12].set(P)
    initialised = bank.initialised.at[0].set(True)
    bank = eqx.tree_at(
        lambda b: (b.mean, b.covariance, b.initialised), bank, (mean, covariance, initialised)
    )
    output = eqx.tree_at(lambda o: (o.T_world_vehicle, o.covariance), output, (T, P))
    belief = eqx.tree_at(lambda b: b.bank, state.belief, bank)
    nothing_wrong = Health.OK, Fault(0), Reject(0)
    outcome = Outcome(5, *nothing_wrong, 0.0, 0.0, output, belief, None, 5, 0, "")
    pose, pose_covariance = base_pose_covariance(outcome, 0.0)
    np.testing.assert_allclose(pose, T.wxyz_xyz, atol=1e-6)
    np.testing.assert_allclose(base_twist(outcome, 0.0)[0], np.arange(6.0), atol=1e-6)
    errors = jnp.asarray(sampled(np.zeros(6), np.asarray(P, float)[:6, :6]))
    moved = jax.vmap(lambda xi: (T @ cayley(xi)).translation())(errors)
    turn = T.rotation()
    turned = jax.vmap(lambda xi: (turn @ cayley(xi).rotation() @ turn.inverse()).log())(errors)
    expected = np.cov(np.column_stack([moved, turned]).T)
    close(pose_covariance, expected)
    (held,) = base_hypotheses(outcome, 0.0)[1]
    close(held, expected)
