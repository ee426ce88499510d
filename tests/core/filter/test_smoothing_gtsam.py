"""Smoothing against GTSAM: a free body with odometry whose scale and direction are a state.

Both get the same corners, poses and odometry. GTSAM solves for all poses at once (Levenberg and
Marquardt, then marginals), with its own camera and its own group; we filter and go back. What is
drawn is a ten-thousandth of its sigma, so that everything is linear in it.
"""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.linalg import block_diag, expm

from jaxnav.core.filter import kalman
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.smooth import smoothed
from jaxnav.core.models.camera import Camera
from jaxnav.core.models.geometry import inverse_cayley
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import OdometryErrors
from jaxnav.core.pose.observation import Observation
from tests.reference import rigid

gtsam = pytest.importorskip("gtsam", reason="gtsam, the oracle, has no wheel here")

DT_S, STEPS, LINEAR = 0.2, 16, 1e-4
CORNERS_AT = (0, 1, 2, 12, 13, 15)  # a marker is in view; at 7 a pose comes from elsewhere
POSE_AT, STATES = 7, 16
CORNERS_M = np.array([[2.0, 0.1, 0.2], [2.0, -0.1, 0.2], [2.1, -0.1, 0.0], [2.1, 0.1, 0.0]])
FOCAL_PX, CENTER_PX, CORNER_PX = 400.0, (320.0, 240.0), 0.5
ARM_M = np.array([0.1, -0.05, 0.2])
ODOMETRY_SIGMA = np.array([0.05, 0.03, 0.02, 0.04])
PRIOR_SIGMA = np.array([0.1, 0.2, 0.15, 0.05, 0.1, 0.08])  # shift, turn
POSE_SIGMA = np.array([0.03, 0.02, 0.04, 0.02, 0.03, 0.01])
# The camera looks along the vehicle's x.
T_VEHICLE_CAMERA = np.array([[0, 0, 1.0, 0.1], [-1, 0, 0, 0.05], [0, -1, 0, 0.2], [0, 0, 0, 1]])
MOTION = ConstantVelocity(odometry_errors=OdometryErrors.create(ODOMETRY_SIGMA, ARM_M))
TURN_FIRST = np.r_[3:6, 0:3]  # GTSAM's poses err by (turn, shift), ours by (shift, turn)


def world():
    """True poses, odometry as it tells them, and what is measured, off by `LINEAR` sigmas."""
    rng = np.random.default_rng(11)
    twists = 0.3 * rng.normal(size=(STEPS - 1, 6)) * np.array([1, 1, 1, 0.3, 0.3, 0.3])
    truth = [np.eye(4)]
    for twist in twists:
        truth.append(truth[-1] @ expm(rigid.twist_matrix(twist * DT_S)))
    rig = CameraRig.create(
        [Camera.create((FOCAL_PX, FOCAL_PX), CENTER_PX)],
        [se3(np.linalg.inv(T_VEHICLE_CAMERA))],
        ["front"],
        [(640, 480)],
    )
    told = twists + LINEAR * 0.05 * rng.normal(size=twists.shape)
    project = jax.jit(
        lambda T_vehicle_world: rig.project(T_vehicle_world, jnp.asarray(CORNERS_M))[0]
    )
    px = np.stack([project(se3(np.linalg.inv(T))) for T in truth])
    px = px + LINEAR * CORNER_PX * rng.normal(size=px.shape)
    noise = rigid.twist_matrix(LINEAR * POSE_SIGMA * rng.normal(size=6))
    return rig, truth, told, px, truth[POSE_AT] @ expm(noise)


def se3(T: np.ndarray) -> jaxlie.SE3:
    return jaxlie.SE3(jnp.asarray(rigid.wxyz_xyz(T)))


def ours(rig, told, px, pose):
    """Means and covariances of all instants by our filter and smoother."""

    def seen(mean, error):
        T_vehicle_world = MOTION.T_world_vehicle(MOTION.moved(mean, error)).inverse()
        return rig.project(T_vehicle_world, jnp.asarray(CORNERS_M))[0].ravel()

    def reading(twist):
        return Observation(jnp.zeros((0, 0, 4, 2)), jnp.zeros((0, 0), bool), dt_s=DT_S, twist=twist)

    still, pose = jnp.zeros(STATES), se3(pose)

    @jax.jit
    def step(mean, P, twist, corners, by_corners, by_pose):
        mean, P = jax.lax.cond(
            jnp.all(jnp.isfinite(twist)),
            lambda: MOTION.evolve(mean, P, reading(twist)),
            lambda: (mean, P),
        )
        H = jax.jacfwd(lambda error: seen(mean, error))(still)
        R = CORNER_PX**2 * jnp.eye(8)
        of_corners = corners.ravel() - seen(mean, still)
        change, P, _ = kalman.update(
            P, *kalman.hide_rows(of_corners, H, R, jnp.full(8, by_corners))
        )
        mean = MOTION.moved(mean, change)
        away = inverse_cayley(jaxlie.SE3(mean[:7]).inverse() @ pose)
        rows = away, jnp.eye(6, STATES), jnp.diag(jnp.asarray(POSE_SIGMA) ** 2)
        change, P, _ = kalman.update(P, *kalman.hide_rows(*rows, jnp.full(6, by_pose)))
        return MOTION.moved(mean, change), P

    rest, P_rest = MOTION.at_first()
    moments = (
        jnp.asarray(np.append([1.0, 0, 0, 0, 0, 0, 0], rest)),
        jnp.asarray(block_diag(np.diag(PRIOR_SIGMA**2), P_rest)),
    )
    filtered = []
    for k in range(STEPS):
        twist = jnp.asarray(told[k - 1] if k else np.full(6, np.nan))
        marks = jnp.asarray(float(k in CORNERS_AT)), jnp.asarray(float(k == POSE_AT))
        moments = step(*moments, twist, jnp.asarray(px[k]), *marks)
        filtered.append(moments)
    back = jax.jit(lambda earlier, later, twist: smoothed(MOTION, earlier, later, reading(twist)))
    trail = filtered[-1:]
    for k in range(STEPS - 2, -1, -1):
        trail.insert(0, back(filtered[k], trail[0], jnp.asarray(told[k])))
    return trail


def told_step(twist, errors) -> "gtsam.Pose3":
    """The step of the vehicle where the odometry tells `twist`, by the step of its own body."""
    at_body = gtsam.Pose3(gtsam.Rot3(), ARM_M)
    step = at_body.inverse() * gtsam.Pose3.Expmap(twist[TURN_FIRST] * DT_S) * at_body
    turn = gtsam.Rot3.Expmap(errors[1:])
    turned = turn * step.rotation() * turn.inverse()
    way = (1 + errors[0]) * turn.rotate(step.translation())
    return at_body * gtsam.Pose3(turned, way) * at_body.inverse()


def link(twist, first, second, noise, errors_key):
    """A factor on two poses and the odometry's errors."""

    def error(this, values, jacobians):
        before, after = values.atPose3(first), values.atPose3(second)
        errors = values.atVector(errors_key)
        moved = before.inverse() * after
        off = gtsam.Pose3.Logmap(told_step(twist, errors).inverse() * moved)
        if jacobians is not None:
            jacobians[0], jacobians[1] = -moved.inverse().AdjointMap(), np.eye(6)
            columns = []
            for axis in np.eye(4) * 1e-6:
                ends = [
                    gtsam.Pose3.Logmap(told_step(twist, errors + side * axis).inverse() * moved)
                    for side in (1, -1)
                ]
                columns.append((ends[0] - ends[1]) / 2e-6)
            jacobians[2] = np.stack(columns, axis=1)
        return off

    return gtsam.CustomFactor(noise, [first, second, errors_key], error)


def theirs(truth, told, px, pose):
    """Poses, errors and marginals of GTSAM."""
    diagonal = gtsam.noiseModel.Diagonal.Sigmas
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    X, errors = [gtsam.symbol("x", k) for k in range(STEPS)], gtsam.symbol("o", 0)
    points = [gtsam.symbol("l", k) for k in range(4)]
    graph.add(gtsam.PriorFactorPose3(X[0], gtsam.Pose3(), diagonal(PRIOR_SIGMA[TURN_FIRST])))
    graph.add(gtsam.PriorFactorVector(errors, np.zeros(4), diagonal(ODOMETRY_SIGMA)))
    graph.add(
        gtsam.PriorFactorPose3(X[POSE_AT], gtsam.Pose3(pose), diagonal(POSE_SIGMA[TURN_FIRST]))
    )
    calibration = gtsam.Cal3_S2(FOCAL_PX, FOCAL_PX, 0.0, *CENTER_PX)
    of_corner = diagonal(np.full(2, CORNER_PX))
    for point, corner_m in zip(points, CORNERS_M, strict=True):
        graph.add(gtsam.PriorFactorPoint3(point, corner_m, diagonal(np.full(3, 1e-5))))
        values.insert(point, corner_m)
    for k in CORNERS_AT:
        for point, corner_px in zip(points, px[k], strict=True):
            graph.add(
                gtsam.GenericProjectionFactorCal3_S2(
                    corner_px, of_corner, X[k], point, calibration, gtsam.Pose3(T_VEHICLE_CAMERA)
                )
            )
    drift = jax.jit(lambda twist: MOTION._drift(twist, jnp.asarray(DT_S)))
    for k, twist in enumerate(told):
        D = np.asarray(drift(jnp.asarray(twist)))[:6, :6]
        noise = diagonal(np.sqrt(np.diagonal(D))[TURN_FIRST])
        graph.add(link(twist, X[k], X[k + 1], noise, errors))
    for key, T in zip(X, truth, strict=True):
        values.insert(key, gtsam.Pose3(T))
    values.insert(errors, np.zeros(4))
    params = gtsam.LevenbergMarquardtParams()
    params.setRelativeErrorTol(1e-14)
    params.setAbsoluteErrorTol(1e-20)
    found = gtsam.LevenbergMarquardtOptimizer(graph, values, params).optimize()
    marginals = gtsam.Marginals(graph, found)
    joints = []
    for key in X:
        joint = marginals.jointMarginalCovariance(gtsam.KeyVector([key, errors]))
        joints.append(np.block([[joint.at(i, j) for j in (key, errors)] for i in (key, errors)]))
    return [found.atPose3(key).matrix() for key in X], found.atVector(errors), joints


def test_a_body_with_odometry_is_smoothed_as_by_gtsam():
    """Means to a thousandth of what was drawn, covariances to 2e-4 of their own sigmas squared."""
    rig, truth, told, px, pose = world()
    poses, errors, joints = theirs(truth, told, px, pose)
    trail = ours(rig, told, px, pose)
    kept = np.r_[0:6, 12:16]
    to_ours = np.eye(10)[np.r_[TURN_FIRST, 6:10]]
    largest = 0.0
    for (mean, P), T, joint, true in zip(trail, poses, joints, truth, strict=True):
        T_found = rigid.matrix(mean[:7])
        apart, drawn = (
            rigid.inverse_cayley(np.linalg.solve(there, T_found)) for there in (T, true)
        )
        largest = max(largest, np.abs(drawn).max())
        np.testing.assert_allclose(apart, 0, atol=2e-6 * LINEAR)
        expected = to_ours @ joint @ to_ours.T
        scale = np.sqrt(np.diagonal(expected))
        gap = (np.asarray(P)[np.ix_(kept, kept)] - expected) / scale[:, None] / scale
        np.testing.assert_allclose(gap, 0, atol=2e-4)
        np.testing.assert_allclose(mean[13:], errors, atol=2e-6 * LINEAR)
    # What was drawn moved them by far more than they differ.
    assert largest > 2e-3 * LINEAR
    assert np.max(np.abs(errors)) > 2e-3 * LINEAR


def test_the_step_of_gtsam_is_ours():
    """Two ways to write one correction: of the step of the odometry's body, and of its twist."""
    rng = np.random.default_rng(4)
    twist, errors = rng.normal(size=6), 0.1 * rng.normal(size=4)
    correct = jax.jit(lambda *given: MOTION.odometry_errors.corrected(*given))
    corrected = correct(jnp.asarray(twist), jnp.asarray(errors))
    expected = expm(rigid.twist_matrix(np.asarray(corrected) * DT_S))
    np.testing.assert_allclose(told_step(twist, errors).matrix(), expected, atol=1e-12)
