"""The bundle adjustment of a camera and its board against SciPy's on OpenCV's projection."""

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.bundle import NO_CUT
from jaxnav.calibrate.lens.simulated_views import grid_points_m, seen_from, simulated_views
from jaxnav.core.models.camera import Camera

SIZE_PX, SIGMA_PX = (820, 410), 0.1
POINTS_M = grid_points_m(6, 5, 0.04)
TRUTHS = {
    "equidistant": (319.0, 320.0, 401.0, 202.0, 0.01, -5e-3, 2e-3, -4e-4),
    "radtan": (619.0, 620.0, 411.0, 212.0, -0.25, 0.08, 1e-3, -5e-4, 0.01),
}


def camera_of(lens):
    truth = TRUTHS[lens]
    return Camera.create(truth[:2], truth[2:4], lens, truth[4:])


def some_views(lens, count=6, seed=0):
    near = (0.15, 0.5) if lens == "equidistant" else (0.25, 0.8)
    rng = np.random.default_rng(seed)
    return simulated_views(camera_of(lens), SIZE_PX, POINTS_M, count, rng, SIGMA_PX, near)


def solved(lens, views, poses, fixed=(), weights=None, cut=NO_CUT):
    start = np.array([1.03 * f for f in TRUTHS[lens][:2]] + [405.0, 207.0] + [0.0] * 5)
    seen, unknowns = lens_bundle.padded(views, start, poses)
    if weights is None:
        weights = np.asarray(seen.present, float)
    return seen, lens_bundle.solve(
        lens,
        unknowns,
        seen,
        jnp.asarray(weights),
        jnp.asarray(lens_bundle.free_mask(lens, fixed)),
        jnp.asarray(SIGMA_PX),
        jnp.asarray(cut),
    )


def opencv_residuals(lens, views, x):
    """Of fx fy cx cy, the coefficients, and a rotation vector and translation a view."""
    count = len(TRUTHS[lens])
    fx, fy, cx, cy = x[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    residuals = []
    for view, pose in zip(views.views, x[count:].reshape(-1, 6), strict=True):
        points = views.points_board_m[view.ids].reshape(-1, 1, 3)
        if lens == "equidistant":
            drawn, _ = cv2.fisheye.projectPoints(points, pose[:3], pose[3:], matrix, x[4:count])
        else:
            drawn, _ = cv2.projectPoints(points, pose[:3], pose[3:], matrix, x[4:count])
        residuals.append(drawn.reshape(-1, 2) - view.corners_px)
    return np.concatenate(residuals).ravel()


@pytest.mark.parametrize("lens", TRUTHS)
def test_minimum_and_information_are_those_of_scipy(lens) -> None:
    views, poses = some_views(lens, count=4)
    seen, bundle = solved(lens, views, poses)
    count = len(TRUTHS[lens])
    rotations = Rotation.from_quat(np.roll(poses[:, :4], -1, axis=1)).as_rotvec()
    start = np.concatenate([TRUTHS[lens], np.hstack([rotations, poses[:, 4:]]).ravel()])
    expected = least_squares(
        lambda x: opencv_residuals(lens, views, x), start, x_scale="jac", xtol=1e-14, ftol=1e-14
    )
    assert bundle.converged
    cost = np.sum(np.asarray(bundle.residual_px) ** 2)
    np.testing.assert_allclose(cost, 2 * expected.cost, rtol=1e-8)
    found = np.asarray(bundle.unknowns.lens)[:count]
    free = jnp.asarray(lens_bundle.free_mask(lens))
    information = np.asarray(lens_bundle.lens_information(bundle.blocks, free))[:count, :count]
    of_all = np.linalg.inv(expected.jac.T @ expected.jac)[:count, :count]
    sigma = np.sqrt(np.diag(of_all))
    assert np.all(np.abs(found - expected.x[:count]) < 1e-3 * sigma)
    ratio = np.linalg.inv(information) / np.outer(sigma, sigma)
    np.testing.assert_allclose(ratio, of_all / np.outer(sigma, sigma), atol=2e-4)
    each, gradient = lens_bundle.view_information(
        lens, bundle.unknowns, seen, jnp.asarray(seen.present, float)
    )
    summed = np.sum(np.asarray(each), axis=0)[:count, :count]
    np.testing.assert_allclose(summed, information, rtol=1e-6, atol=1e-6 * information.max())
    # At the minimum the views' gradients balance, in sigmas.
    balance = np.sum(np.asarray(gradient), axis=0)[:count] * sigma
    assert np.max(np.abs(balance)) < 1e-2 < np.max(np.abs(np.asarray(gradient)[:, :count] * sigma))


def test_what_is_held_stays_at_zero_and_what_has_no_weight_is_not_heard() -> None:
    views, poses = some_views("equidistant")
    seen, alone = solved("equidistant", views, poses, fixed=("k3", "k4"))
    assert np.all(np.asarray(alone.unknowns.lens)[6:] == 0)
    weights = np.asarray(seen.present, float)
    weights[2] = 0
    _, without = solved("equidistant", views, poses, weights=weights)
    moved = views.views[2].corners_px.copy()
    seen.corners_px[2, views.views[2].ids] = moved + 50
    object.__setattr__(views.views[2], "corners_px", moved + 50)
    _, spoilt = solved("equidistant", views, poses, weights=weights)
    np.testing.assert_allclose(without.unknowns.lens, spoilt.unknowns.lens, rtol=1e-9, atol=1e-12)


def test_a_cut_keeps_far_corners_from_pulling() -> None:
    views, poses = some_views("radtan", seed=3)
    _, clean = solved("radtan", views, poses)
    corners_px = views.views[0].corners_px.copy()
    corners_px[:3] += 30
    object.__setattr__(views.views[0], "corners_px", corners_px)
    _, pulled = solved("radtan", views, poses)
    _, cut = solved("radtan", views, poses, cut=2.0)
    focal = [np.asarray(one.unknowns.lens)[:2] for one in (clean, pulled, cut)]
    assert np.abs(focal[1] - focal[0]).max() > 5 * np.abs(focal[2] - focal[0]).max()


def test_simulated_corners_are_opencvs() -> None:
    lens = "equidistant"
    _, poses = some_views(lens, count=2)
    drawn, inside = seen_from(camera_of(lens), SIZE_PX, POINTS_M, poses[0])
    rotation = Rotation.from_quat(np.roll(poses[0, :4], -1)).as_rotvec()
    fx, fy, cx, cy, *coefficients = TRUTHS[lens]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
    expected, _ = cv2.fisheye.projectPoints(
        POINTS_M.reshape(-1, 1, 3), rotation, poses[0, 4:], matrix, np.array(coefficients)
    )
    np.testing.assert_allclose(drawn[inside], expected.reshape(-1, 2)[inside], atol=1e-9)
