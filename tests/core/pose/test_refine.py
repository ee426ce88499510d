"""Levenberg-Marquardt against OpenCV's, its covariance against Monte Carlo, its gradients against
differences."""

import functools

import cv2
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix
import pytest
from jax.extend.core import jaxprs_in_params

from jaxnav.core.linalg.levenberg_marquardt import KEEP_FOUND
from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.pose.ippe import PosePair
from jaxnav.core.pose.pair_lanes import solve_pairs
from jaxnav.core.pose.refine import refine_pose, solve_marker, solve_markers
from jaxnav.core.pose.residuals import e1
from tests import worlds
from tests.derivatives import in_float32
from tests.reference.rigid import matrix

FOCAL_PX, COUNT = 500.0, 960
VIEW = (0.2, 0.1, 0.6)  # of the room: three cameras, four markers

BATCH = 64  # of markers: one program does for all tests of them


@functools.partial(jax.jit, static_argnames="max_steps")
def refined_from(rig, markers, corners_px, visible, start, sigma_px, max_steps):
    return refine_pose(rig, markers, corners_px, visible, start, sigma_px, max_steps)


def refine(rig, markers, corners_px, visible, start, sigma_px=1.0, max_steps=100):
    """One program in each precision: corners have sigmas of their own."""
    sigma_px = jnp.asarray(np.broadcast_to(sigma_px, (4, 4, 4)), float)
    return refined_from(rig, markers, corners_px, visible, start, sigma_px, max_steps)


def solved(corners: np.ndarray, size: np.ndarray) -> PosePair:
    """The pairs of many markers, leading axis (N,), `BATCH` of them at once."""
    parts = [
        solve_markers(*(jnp.asarray(leaf[i : i + BATCH], float) for leaf in (corners, size)))
        for i in range(0, len(size), BATCH)
    ]
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)


image_error_of = jax.jit(e1)


def opencv_refined(corners_px: np.ndarray, size_m: float) -> np.ndarray:
    """e1 of OpenCV's refineLM from both of its IPPE poses, pixel^2, sorted."""
    corners_m = size_m / 2 * CORNER_SIGNS
    K = np.diag([FOCAL_PX, FOCAL_PX, 1.0])
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-12)
    _, rotation_vectors, translations, _ = cv2.solvePnPGeneric(
        corners_m, corners_px, K, None, flags=cv2.SOLVEPNP_IPPE_SQUARE
    )
    costs = []
    for rotvec, translation in zip(rotation_vectors, translations, strict=True):
        pose = cv2.solvePnPRefineLM(corners_m, corners_px, K, None, rotvec, translation, criteria)
        projected = cv2.projectPoints(corners_m, *pose, K, None)[0][:, 0]
        costs.append(np.sum((projected - corners_px) ** 2))
    return np.sort(costs)


def test_never_ends_above_opencv():
    """960 noisy views, tilts 0 to 75 degrees, 15 to 200 px wide, noise up to 1 px: neither of
    the two minima is above OpenCV's by more than 1e-6 of it."""
    rng = np.random.default_rng(1)
    R, t, size = worlds.random_views(rng, COUNT, (0, 75), (15 / FOCAL_PX, 200 / FOCAL_PX))
    sigma_px = rng.uniform(0.05, 1, (COUNT, 1, 1))
    noise_px = sigma_px * rng.standard_normal((COUNT, 4, 2))
    corners_px = FOCAL_PX * worlds.normalised_corners(R, t, size) + noise_px
    expected = np.array([opencv_refined(c, s) for c, s in zip(corners_px, size, strict=True)])
    pair = solved(corners_px / FOCAL_PX, size)
    costs = 8 * (FOCAL_PX * np.asarray(pair.reprojection_error)) ** 2
    assert np.all(costs[:, 0] <= costs[:, 1])
    assert np.all(np.isfinite(expected))
    assert np.max(costs / expected - 1) < 1e-6


def test_levenberg_marquardt_is_optimistix(monkeypatch):
    solvers = []
    original = optimistix.least_squares

    def spy(fn, solver, *args, **kwargs):
        solvers.append(type(solver))
        return original(fn, solver, *args, **kwargs)

    monkeypatch.setattr(optimistix, "least_squares", spy)
    R, t, size = worlds.random_views(np.random.default_rng(2), 1, (30, 40), (0.1, 0.2))
    corners = jnp.asarray(worlds.normalised_corners(R, t, size)[0])
    jax.eval_shape(lambda c: solve_marker(c, 0.2), corners)
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    obs = worlds.observe(rig, markers, worlds.planar(*worlds.FRONT_VIEW))
    jax.eval_shape(
        lambda c: refine_pose(rig, markers, c, obs.visible, worlds.planar(0.0, 0.0, 1.5)),
        obs.corners_px,
    )
    jax.eval_shape(solve_pairs, jnp.zeros((4, 4, 2)), jnp.ones(4))
    assert len(solvers) >= 3
    assert all(issubclass(solver, optimistix.AbstractLeastSquaresSolver) for solver in solvers)


def test_solve_marker_finds_the_pose(precision):
    R, t, size = worlds.random_views(np.random.default_rng(3), COUNT, (20, 70), (0.1, 0.4))
    pair = solved(worlds.normalised_corners(R, t, size), size)
    single = precision == np.float32
    found = matrix(pair.T_camera_marker.wxyz_xyz)[:, 0, :3, :3]
    angles = worlds.rotation_angles_rad(found, R)
    assert angles.max() < (2e-4 if single else 1e-9)
    assert np.all(pair.reprojection_error[:, 0] < (1e-6 if single else 1e-12))
    assert np.all(np.isfinite(pair.T_camera_marker.wxyz_xyz))


@pytest.fixture(scope="module")
def room():
    """The room seen by three cameras of the car, without noise."""
    rig, markers = worlds.qcar_rig(), worlds.room_markers()
    T_world_vehicle = worlds.planar(*VIEW)
    obs = worlds.observe(rig, markers, T_world_vehicle)
    assert np.sum(np.any(obs.visible, axis=1)) >= 3
    assert np.sum(np.any(obs.visible, axis=0)) >= 3
    return rig, markers, obs, T_world_vehicle


@jax.jit
def errors_of(T_world_vehicle, T_vehicle_world):
    """xi in T_world_vehicle * exp(xi) = estimate."""
    return jax.vmap(lambda T: (T_world_vehicle.inverse() @ T.inverse()).log())(T_vehicle_world)


@pytest.fixture(scope="module")
def monte_carlo(room):
    """300 noisy views of the room refined: errors and covariances by set of lanes in use."""
    rig, markers, obs, T_world_vehicle = room
    sigma_px = 0.3
    noise = sigma_px * np.random.default_rng(4).standard_normal((300, *obs.corners_px.shape))

    @jax.jit
    def run(visible, noise):
        refined = jax.vmap(
            lambda n: refine_pose(
                rig, markers, obs.corners_px + n, visible, T_world_vehicle.inverse(), sigma_px
            )
        )(noise)
        return errors_of(T_world_vehicle, refined.T_vehicle_world), refined

    lanes = {"all": obs.visible}
    for camera, marker in ((0, 0), (3, 1), (2, 2)):
        only = np.zeros((4, 4), bool)
        only[camera, marker] = True
        assert obs.visible[camera, marker]
        lanes[f"camera {camera}, marker {marker}"] = jnp.asarray(only)
    return {
        name: jax.device_get(run(visible, jnp.asarray(noise))) for name, visible in lanes.items()
    }


@pytest.mark.long
def test_the_covariance_is_that_of_the_estimates(monte_carlo):
    errors, refined = monte_carlo["all"]
    assert np.all(refined.converged)
    roots = np.linalg.cholesky(refined.covariance)
    whitened = np.linalg.solve(roots, np.asarray(errors)[..., None])[..., 0]
    count = len(whitened)
    # Unit normal: k-sigma bounds for mean, variances, correlations and the sum of squares.
    assert np.all(np.abs(np.mean(whitened, axis=0)) < 4 / np.sqrt(count))
    deviation = np.abs(whitened.T @ whitened / count - np.eye(6))
    assert np.all(deviation < 4.5 * np.sqrt((1 + np.eye(6)) / count))
    assert abs(np.mean(np.sum(whitened**2, axis=1)) - 6) < 4 * np.sqrt(12 / count)


def test_the_cost_is_chi_square(monte_carlo, room):
    """Eight coordinates a sighting, less six unknowns."""
    _, refined = monte_carlo["all"]
    freedom = 8 * int(np.sum(room[2].visible)) - 6
    assert abs(np.mean(refined.cost) - freedom) < 4 * np.sqrt(2 * freedom / len(refined.cost))


def test_all_cameras_and_markers_together_beat_each_alone(monte_carlo):
    joint_errors, joint = monte_carlo.pop("all")
    joint_rms = np.sqrt(np.mean(np.square(joint_errors), axis=0))
    for errors, alone in monte_carlo.values():
        rms = np.sqrt(np.mean(np.square(errors), axis=0))
        assert np.all(joint_rms < rms)
        gain = np.linalg.eigvalsh(alone.covariance[0] - joint.covariance[0])
        assert np.all(gain > 0)


def test_no_visible_corner_is_a_result(precision):
    rig, markers = worlds.qcar_rig(), worlds.room_markers()
    start = worlds.planar(0.4, -0.3, 1.0).inverse()
    for filler in (0.0, np.nan):
        corners = jnp.full((4, 4, 4, 2), filler, float)
        refined = refine(rig, markers, corners, jnp.zeros((4, 4), bool), start)
        assert not refined.converged
        assert refined.cost == 0
        np.testing.assert_allclose(refined.T_vehicle_world.wxyz_xyz, start.wxyz_xyz, atol=1e-6)
        assert refined.covariance.dtype == precision
        for leaf in jax.tree.leaves(refined):
            assert np.all(np.isfinite(leaf))
        # As uncertain as can be: a radian, and the distance to the world's origin or more.
        assert np.all(np.linalg.eigvalsh(np.asarray(refined.covariance)) > 0)
        assert np.all(np.diagonal(refined.covariance)[3:] > 0.9)


started = jax.jit(lambda T, xi: (T @ jaxlie.SE3.exp(jnp.stack(xi))).inverse())


def test_the_number_of_steps_is_bounded(room):
    rig, markers, obs, T_world_vehicle = room
    far = started(T_world_vehicle, [0.3, -0.3, 0.2, 0.2, 0.1, 0.5])
    hasty = refine(rig, markers, obs.corners_px, obs.visible, far, max_steps=2)
    assert int(hasty.steps) == 2
    assert not hasty.converged
    full = refine(rig, markers, obs.corners_px, obs.visible, far)
    assert full.converged
    assert 2 < int(full.steps) < 30
    assert full.cost < 1e-12 < hasty.cost


def test_the_cost_is_e1(room, precision):
    rig, markers, obs = worlds.qcar_rig(), worlds.room_markers(), room[2]
    corners = jnp.asarray(
        np.asarray(obs.corners_px) + np.random.default_rng(5).normal(size=(4, 4, 4, 2))
    )
    start = worlds.planar(*VIEW).inverse()
    refined = refine(rig, markers, corners, obs.visible, start)
    image_error = image_error_of(rig, markers, corners, obs.visible, refined.T_vehicle_world)
    assert refined.converged
    assert image_error.dtype == precision
    rtol = 2e-4 if precision == np.float32 else 1e-10
    np.testing.assert_allclose(refined.cost, image_error, rtol=rtol)
    assert refined.cost < image_error_of(rig, markers, corners, obs.visible, start)


def test_sigma_weighs_corners(room):
    """A corner with a huge sigma is as good as not there; halving all of them quarters P."""
    rig, markers, obs, T_world_vehicle = room
    start = T_world_vehicle.inverse()
    spoilt, sigma_px = np.array(obs.corners_px), np.ones((4, 4, 4))
    spoilt[0, 0, 1] += 40.0
    sigma_px[0, 0, 1] = 1e6
    refined = refine(rig, markers, jnp.asarray(spoilt), obs.visible, start, sigma_px)
    T = np.linalg.inv(matrix(refined.T_vehicle_world.wxyz_xyz))
    np.testing.assert_allclose(T, matrix(T_world_vehicle.wxyz_xyz), atol=1e-6)
    one, half = (
        refine(rig, markers, obs.corners_px, obs.visible, start, sigma).covariance
        for sigma in (0.2, 0.1)
    )
    np.testing.assert_allclose(half, np.asarray(one) / 4, rtol=1e-2)


def test_gradients_never_call_the_host():
    """No error check that raises from inside jit: failure is a value, and the compile is cached."""
    corners = jnp.asarray(CORNER_SIGNS[:, :2] * 0.1)
    slope = jax.jit(jax.jacrev(lambda c: solve_marker(c, 0.2).T_camera_marker.wxyz_xyz))
    assert "callback" not in slope.lower(corners).as_text()
    assert np.all(np.isfinite(slope(jnp.zeros((4, 2)))))


def searches(jaxpr) -> int:
    return sum(
        (eqn.primitive.name == "while") + sum(map(searches, jaxprs_in_params(eqn.params)))
        for eqn in jaxpr.eqns
    )


def test_a_gradient_that_keeps_the_minima_searches_nothing_twice():
    corners = jnp.asarray(CORNER_SIGNS[:, :2] * 0.1 + [[0, 0], [0, 0.01], [0, 0], [0, 0]])

    def loss(c):
        return jnp.sum(solve_marker(c, 0.2, 5).T_camera_marker.wxyz_xyz[:, 4:] ** 3)

    for policy, count in (jax.checkpoint_policies.nothing_saveable, 2), (KEEP_FOUND, 1):
        gradient = jax.grad(jax.checkpoint(loss, policy=policy))
        assert searches(jax.make_jaxpr(gradient)(corners).jaxpr) == count


@in_float32
def test_gradients_are_finite_and_the_start_and_hidden_lanes_have_none(precision):
    """Exactly frontal, at the start itself and beside it, and with every lane masked."""
    rig, markers = worlds.qcar_rig(), worlds.room_markers()

    @jax.jit
    @functools.partial(jax.grad, argnums=(0, 3))
    def gradients(corners_px, visible, T_world_vehicle, xi):
        start = (T_world_vehicle @ jaxlie.SE3.exp(xi)).inverse()
        refined = refine_pose(rig, markers, corners_px, visible, start)
        return (
            jnp.sum(refined.T_vehicle_world.wxyz_xyz) + refined.cost + jnp.sum(refined.covariance)
        )

    nan, none = jnp.full((4, 4, 4, 2), jnp.nan, float), jnp.zeros((4, 4), bool)
    for T in (worlds.planar(*VIEW), worlds.planar(0.1, -0.4, np.pi / 2)):
        obs = worlds.observe(rig, markers, T)
        for corners_px, visible in ((obs.corners_px, obs.visible), (nan, obs.visible), (nan, none)):
            for off in (0.0, 0.01):
                by_corner, by_start = gradients(corners_px, visible, T, jnp.full(6, off, float))
                np.testing.assert_array_equal(by_start, 0)
                assert by_corner.dtype == by_start.dtype == precision
                assert np.all(np.isfinite(by_corner))
                seen = np.asarray(visible & ~jnp.isnan(corners_px[:, :, 0, 0]))
                np.testing.assert_array_equal(np.asarray(by_corner)[~seen], 0)
                assert np.all(np.any(np.asarray(by_corner)[seen] != 0, axis=(1, 2)))
