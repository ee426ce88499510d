"""Errors of cameras, eliminated: against dense algebra, perturbed cameras and drawn errors."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy import linalg, stats
from scipy.spatial.transform import Rotation

from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.observation import sightings
from jaxnav.core.pose.refine import Candidates, refine_pose
from jaxnav.core.pose.residuals import Nuisance, camera_slopes
from tests import worlds
from tests.derivatives import check_derivatives, in_float32
from tests.reference.rigid import inverse_cayley, matrix, wxyz_xyz

VIEW = (0.2, 0.1, 0.6)  # of the room: three cameras, four markers
SIGMA = np.repeat([0.005, np.deg2rad(0.5)], 3)
SIGMA_PX = 0.3

refine = jax.jit(refine_pose, static_argnames="max_steps")


def uncertain(rig: CameraRig, sigma=SIGMA) -> CameraRig:
    """The rig with cameras that are known as well as these sigmas say, (6,) or (C, 6)."""
    return dataclasses.replace(rig, extrinsics_sigma=jnp.asarray(np.tile(sigma, (len(rig), 1))))


def moved(rig: CameraRig, errors: np.ndarray) -> CameraRig:
    """Cameras shifted along and turned about the vehicle's axes, each at its own place, (C, 6)."""
    matrices = []
    for T_camera_vehicle, error in zip(matrix(rig.Ts_camera_vehicle.wxyz_xyz), errors, strict=True):
        T_vehicle_camera = np.linalg.inv(T_camera_vehicle)
        T_vehicle_camera[:3, 3] += error[:3]
        turn = Rotation.from_rotvec(error[3:]).as_matrix()
        T_vehicle_camera[:3, :3] = turn @ T_vehicle_camera[:3, :3]
        matrices.append(np.linalg.inv(T_vehicle_camera))
    poses = jnp.asarray(wxyz_xyz(np.stack(matrices)), float)
    return dataclasses.replace(rig, Ts_camera_vehicle=jaxlie.SE3(poses))


# --- the elimination ------------------------------------------------------------------


def test_what_is_left_is_the_dense_quadratic_form():
    """r' (I + J_t J_t')^-1 r of three lanes, two groups of two unknowns in ten residuals: the same
    of derivatives, its gradient, the most probable error, and what is left of the prior."""
    rng = np.random.default_rng(0)
    slopes = rng.normal(size=(2, 10, 2, 3))
    slopes[:, 6:, 0] = 0
    slopes[:, :6, 1] = 0
    r, J = rng.normal(size=(10, 3)), rng.normal(size=(6, 10, 3))

    @jax.jit
    def found(slopes, r, J):
        nuisance = Nuisance.from_slopes(slopes)
        by_r = jax.grad(lambda r: jnp.sum(nuisance.eliminated(r) ** 2))(r)
        left = nuisance.eliminated(r), nuisance.eliminated(J)
        return *left, nuisance.at_best(r), by_r, nuisance.log_share

    left_r, left_J, best, by_r, log_share = map(np.asarray, found(slopes, r, J))
    assert left_r.shape == (14, 3)
    assert best.shape == (2, 2, 3)
    for lane, J_t in enumerate(slopes.transpose(3, 1, 0, 2).reshape(3, 10, 4)):
        S, r_k, J_k = np.eye(10) + J_t @ J_t.T, r[:, lane], J[:, :, lane].T
        weight = np.linalg.inv(S)
        assert np.sum(left_r[:, lane] ** 2) == pytest.approx(r_k @ weight @ r_k, rel=1e-12)
        gram = left_J[:, :, lane] @ left_J[:, :, lane].T
        np.testing.assert_allclose(gram, J_k.T @ weight @ J_k, rtol=1e-10)
        gradient = J_k.T @ weight @ r_k
        np.testing.assert_allclose(left_J[:, :, lane] @ left_r[:, lane], gradient, rtol=1e-10)
        # The moved residuals alone give the gradient too: the rest is zero at the best error.
        np.testing.assert_allclose(J_k.T @ left_r[:10, lane], gradient, rtol=1e-10)
        np.testing.assert_allclose(by_r[:, lane], 2 * weight @ r_k, rtol=1e-10)
        right = np.append(-r_k, np.zeros(4))
        expected = np.linalg.lstsq(np.vstack([J_t, np.eye(4)]), right, rcond=None)[0]
        np.testing.assert_allclose(best[:, :, lane].ravel(), expected, rtol=1e-10)
        share = -np.linalg.slogdet(S)[1] / 2
        assert log_share[lane] == pytest.approx(share, rel=1e-12)


# --- the cameras' errors --------------------------------------------------------------


def pixels_of(T_camera_vehicle: np.ndarray, points_vehicle: np.ndarray, camera) -> np.ndarray:
    """Of an equidistant lens: the angle off the axis times the focal length."""
    x, y, z = T_camera_vehicle[:3, :3] @ points_vehicle.T + T_camera_vehicle[:3, 3:]
    angle, across = np.arctan2(np.hypot(x, y), z), np.hypot(x, y)
    image = np.stack([x, y], axis=1) * (angle / across)[:, None]
    return image * np.asarray(camera.focal_px) + np.asarray(camera.center_px)


def ranged(T_camera_vehicle: np.ndarray, px: np.ndarray, camera, size_m: float) -> np.ndarray:
    """Corners in the vehicle frame, m, at the range at which their longest side has its size."""
    image = (px - np.asarray(camera.center_px)) / np.asarray(camera.focal_px)
    angle = np.linalg.norm(image, axis=1, keepdims=True)
    rays = np.hstack([image * np.sin(angle) / angle, np.cos(angle)])
    longest = np.max(np.linalg.norm(rays - np.roll(rays, 1, axis=0), axis=1))
    T_vehicle_camera = np.linalg.inv(T_camera_vehicle)
    return rays * size_m / longest @ T_vehicle_camera[:3, :3].T + T_vehicle_camera[:3, 3]


@pytest.mark.parametrize("slots", [3, 8])
def test_the_slopes_are_differences_of_projections(slots):
    """Cameras that were moved by a millimetre or a milliradian, of either sign.

    With fewer sightings than cameras, and more; several markers in a camera share its error. A
    camera that goes one way moves its residuals as points that go the other way: the prior is even.
    """
    rig, markers = worlds.qcar_rig(), worlds.room_markers()
    assert not np.any(rig.cameras.distortion)  # as `pixels_of` has it
    obs = worlds.observe(rig, markers, worlds.planar(*VIEW))
    visible = np.array(obs.visible)
    if slots < 4:  # two markers in one camera, and one in another
        lanes = np.argwhere(visible)
        camera = np.argmax(visible.sum(axis=1))
        kept = [*lanes[lanes[:, 0] == camera][:2], lanes[lanes[:, 0] != camera][0]]
        visible[:] = False
        visible[tuple(np.transpose(kept))] = True
    sigmas = SIGMA * np.linspace(0.5, 2.0, 24).reshape(4, 6)  # all different
    known = dataclasses.replace(rig, extrinsics_sigma=jnp.asarray(sigmas))
    seen = jax.jit(sightings, static_argnums=5)(
        rig, markers, obs.corners_px, jnp.asarray(visible), SIGMA_PX, slots
    )
    nuisance = jax.jit(lambda *seen: camera_slopes(*seen).nuisance())(known, markers, seen)
    assert nuisance is not None
    count = min(slots, 4)
    assert nuisance.slopes.shape == (6, 8 * slots, count, 1)
    cameras = np.where(seen.visible, seen.camera_index, -1)
    assert np.max(np.bincount(cameras[cameras >= 0])) >= 2  # one camera has two markers
    assert len(np.unique(cameras[cameras >= 0])) >= 2

    dense = np.zeros((2, 4 * slots, 4, 6))  # of the residuals (u, v), by camera and its error
    h, Ts = 1e-3, matrix(rig.Ts_camera_vehicle.wxyz_xyz)
    for slot, index in enumerate(cameras):
        if index < 0:
            continue
        size_m = float(markers.size_m[int(seen.marker_index[slot])])
        camera = rig.camera(int(index))
        points = ranged(Ts[index], np.asarray(seen.corners_px[slot]), camera, size_m)
        for axis in range(6):
            ends = []
            for sign in (1, -1):
                errors = np.zeros((4, 6))
                errors[index, axis] = sign * h
                T = matrix(moved(rig, errors).Ts_camera_vehicle.wxyz_xyz)[index]
                ends.append(pixels_of(T, points, camera))
            slope = (ends[0] - ends[1]) / (2 * h) * sigmas[index, axis] / SIGMA_PX
            dense[:, 4 * slot : 4 * slot + 4, index, axis] = slope.T
    dense = dense.reshape(8 * slots, 24)
    slopes = np.asarray(nuisance.slopes)[..., 0].transpose(1, 2, 0).reshape(8 * slots, -1)
    # The groups' order is no matter, nor their sign.
    np.testing.assert_allclose(slopes @ slopes.T, dense @ dense.T, rtol=1e-4, atol=1e-4)
    assert np.max(np.abs(dense)) > 1
    if slots >= 4:
        np.testing.assert_allclose(slopes, -dense, rtol=1e-4, atol=1e-4)
    share = -np.linalg.slogdet(np.eye(8 * slots) + dense @ dense.T)[1] / 2
    np.testing.assert_allclose(nuisance.log_share, share, rtol=1e-5)


def test_exact_cameras_have_no_nuisance():
    rig, markers = worlds.qcar_rig(), worlds.room_markers()
    obs = worlds.observe(rig, markers, worlds.planar(*VIEW))

    def slopes(corners_px, visible):
        return camera_slopes(rig, markers, sightings(rig, markers, corners_px, visible))

    assert jax.eval_shape(slopes, obs.corners_px, obs.visible) is None


# --- poses found with them ------------------------------------------------------------


def errors_of(T_world_vehicle: jaxlie.SE3, refined: Candidates) -> np.ndarray:
    """xi (6,) in T_world_vehicle * cay(xi) = estimate."""
    there, found = (matrix(T.wxyz_xyz) for T in (T_world_vehicle, refined.T_vehicle_world))
    return inverse_cayley(np.linalg.inv(found @ there))


def test_a_camera_that_is_off_by_a_degree_turns_itself_and_not_the_vehicle():
    """One marker in two cameras, which disagree by a bearing that no pose explains."""
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    T_world_vehicle = worlds.planar(*worlds.OVERLAP_VIEW)
    visible = worlds.observe(rig, markers, T_world_vehicle).visible
    pair = np.flatnonzero(np.any(visible, axis=1))
    assert len(pair) == 2
    off = np.zeros((4, 6))
    off[pair[0], 5] = np.deg2rad(1.0)
    obs = worlds.observe(moved(rig, off), markers, T_world_vehicle)
    start = T_world_vehicle.inverse()
    exact, sigma = (
        refine(known, markers, obs.corners_px, visible, start, SIGMA_PX)
        for known in (rig, uncertain(rig))
    )
    assert exact.converged
    assert sigma.converged
    xi = errors_of(T_world_vehicle, sigma)
    assert np.linalg.norm(xi[:3]) < 0.003
    # The two share what they can't tell apart: half a degree each.
    assert np.linalg.norm(xi[3:]) < np.deg2rad(0.6)
    assert sigma.cost < 4
    lost = errors_of(T_world_vehicle, exact)
    assert np.linalg.norm(lost[:3]) > 0.1
    assert np.linalg.norm(lost[3:]) > np.deg2rad(5)
    assert exact.cost > 100


@in_float32
def test_the_covariance_covers_the_cameras_errors(precision):
    """200 draws of all cameras' errors and of the corners' noise, in a room: NEES is chi-square."""
    rig, markers = worlds.qcar_rig(), worlds.room_markers()
    T_world_vehicle = worlds.planar(*VIEW)
    rng = np.random.default_rng(5)
    count = 200
    rigs = [moved(rig, SIGMA * rng.standard_normal((4, 6))) for _ in range(count)]
    Ts = jnp.asarray(np.stack([other.Ts_camera_vehicle.wxyz_xyz for other in rigs]))
    visible = worlds.observe(rig, markers, T_world_vehicle).visible
    noise = jnp.asarray(SIGMA_PX * rng.standard_normal((count, 4, 4, 4, 2)))
    T_vehicle_world = T_world_vehicle.inverse()

    @jax.jit
    def run(known: CameraRig) -> tuple[jax.Array, jax.Array, jax.Array]:
        def one(T_camera_vehicle, noise):
            other = dataclasses.replace(rig, Ts_camera_vehicle=jaxlie.SE3(T_camera_vehicle))
            corners_px = other.project(T_vehicle_world, markers.corners_world_m) + noise
            refined = refine_pose(known, markers, corners_px, visible, T_vehicle_world, SIGMA_PX)
            xi = (T_world_vehicle.inverse() @ refined.T_vehicle_world.inverse()).log()
            return xi, refined.covariance, refined.converged

        return jax.vmap(one)(Ts, noise)

    told = run(uncertain(rig))
    assert {leaf.dtype for leaf in told[:2]} == {np.dtype(precision)}
    xi, covariance, converged = (np.asarray(leaf, float) for leaf in told)
    assert np.all(converged)
    nees = np.einsum("ni,nij,nj->n", xi, np.linalg.inv(covariance), xi)
    assert abs(np.mean(nees) - 6) < 4 * np.sqrt(12 / count)
    assert stats.kstest(nees, stats.chi2(6).cdf).pvalue > 1e-3


def of_the_vehicle(rig: CameraRig, index: int) -> np.ndarray:
    """Covariance Ad Sigma Ad' of the vehicle's twist that a camera's error is taken for."""
    x, y, z = np.linalg.inv(matrix(rig.Ts_camera_vehicle.wxyz_xyz[index]))[:3, 3]
    adjoint = np.eye(6)
    adjoint[:3, 3:] = [[0, -z, y], [z, 0, -x], [-y, x, 0]]
    return adjoint @ np.diag(SIGMA**2) @ adjoint.T


def test_one_camera_s_error_is_the_vehicle_s_error():
    """Ad Sigma Ad', exactly: a frontal marker on the axis is as far as its sides tell."""
    rig = worlds.qcar_rig()
    height_m = 0.0953  # of the cameras
    markers = worlds.marker_map([(worlds.upright(-np.pi / 2), [0.0, 1.5, height_m])], [0.172])
    T_world_vehicle = worlds.planar(0.0, 0.9, np.pi / 2)
    obs = worlds.observe(rig, markers, T_world_vehicle)
    np.testing.assert_array_equal(np.flatnonzero(np.any(obs.visible, axis=1)), [0])
    exact, wide = (
        refine(known, markers, obs.corners_px, obs.visible, T_world_vehicle.inverse(), 0.1)
        for known in (rig, uncertain(rig))
    )
    expected = of_the_vehicle(rig, 0)
    sigmas = np.sqrt(np.diagonal(expected))
    wider = np.asarray(wide.covariance - exact.covariance)
    np.testing.assert_allclose(
        wider / np.outer(sigmas, sigmas), expected / np.outer(sigmas, sigmas), atol=1e-3
    )


@pytest.mark.parametrize("view", [worlds.FRONT_VIEW, worlds.START_VIEW])
def test_one_camera_alone_finds_the_same_minimum(view):
    """It can't tell its error from the vehicle's pose: the same pose, less surely known.

    Slopes at the range that the sides tell, not at the pose's: a small part is left to tell.
    """
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    T_world_vehicle = worlds.planar(*view)
    noise = SIGMA_PX * np.random.default_rng(6).standard_normal((4, 1, 4, 2))
    obs = worlds.observe(rig, markers, T_world_vehicle, jnp.asarray(noise))
    (index,) = np.flatnonzero(np.any(obs.visible, axis=1))
    exact, wide = (
        refine(known, markers, obs.corners_px, obs.visible, T_world_vehicle.inverse(), SIGMA_PX)
        for known in (rig, uncertain(rig))
    )
    gap, error = (
        np.linalg.solve(np.linalg.cholesky(wide.covariance), xi)
        for xi in (
            errors_of(T_world_vehicle, wide) - errors_of(T_world_vehicle, exact),
            errors_of(T_world_vehicle, exact),
        )
    )
    assert np.linalg.norm(gap) < 0.02 < 0.5 < np.linalg.norm(error)
    assert wide.cost == pytest.approx(float(exact.cost), rel=1e-3)
    both = np.asarray(exact.covariance) + of_the_vehicle(rig, index)
    ratios = linalg.eigvalsh(wide.covariance, both)
    assert 0.95 < np.min(ratios) <= np.max(ratios) < 1.05
    assert np.max(linalg.eigvalsh(both, exact.covariance)) > 20


@pytest.mark.long
def test_gradients_are_differences():
    """Of pose, covariance and cost by the corners, the cameras' places and their sigmas."""
    rig, markers = worlds.qcar_rig(), worlds.room_markers()
    T_world_vehicle = worlds.planar(*VIEW)
    obs = worlds.observe(rig, markers, T_world_vehicle)
    noise = SIGMA_PX * np.random.default_rng(7).standard_normal(obs.corners_px.shape)

    def estimate(corners_px, extrinsic_xi, shares):
        Ts = jax.vmap(lambda T, x: T @ jaxlie.SE3.exp(x))(rig.Ts_camera_vehicle, extrinsic_xi)
        known = dataclasses.replace(
            rig, Ts_camera_vehicle=Ts, extrinsics_sigma=shares * jnp.asarray(SIGMA)[None]
        )
        start = T_world_vehicle.inverse()
        refined = refine_pose(known, markers, corners_px, obs.visible, start, SIGMA_PX)
        xi = (T_world_vehicle.inverse() @ refined.T_vehicle_world.inverse()).log()
        return xi, jnp.log(jnp.diagonal(refined.covariance)), refined.cost

    arguments = (obs.corners_px + noise, jnp.zeros((4, 6)), jnp.ones((4, 6)))
    check_derivatives(estimate, *arguments, step=1e-5, rtol=1e-4, atol=1e-6)
