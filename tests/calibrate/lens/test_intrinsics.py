"""Lenses from corners: true within their sigmas, robust to bad data, refused if undetermined."""

from dataclasses import replace

import cv2
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens import start as lens_start
from jaxnav.calibrate.lens.bundle import NO_CUT
from jaxnav.calibrate.lens.checks import check_board, findings, rim_sigma_px
from jaxnav.calibrate.lens.choice import informative
from jaxnav.calibrate.lens.fit import fit_lens
from jaxnav.calibrate.lens.intrinsics import calibrate_lens, screened
from jaxnav.calibrate.lens.maps import projection_difference, projection_sigma
from jaxnav.calibrate.lens.simulated_views import grid_points_m, seen_from, simulated_views
from jaxnav.core.models.camera import Camera
from jaxnav.errors import BadInput

SIZE_PX, SIGMA_PX = (820, 410), 0.1
POINTS_M = grid_points_m(6, 5, 0.04)
TRUTHS = {
    "none": (600.0, 600.0, 411.0, 212.0),
    "radtan": (619.0, 620.0, 411.0, 212.0, -0.25, 0.08, 1e-3, -5e-4, 0.01),
    "equidistant": (319.0, 320.0, 401.0, 202.0, 0.01, -5e-3, 2e-3, -4e-4),
    "omni": (600.0, 602.0, 401.0, 202.0, 0.9, -0.05, 0.01, 1e-3, -5e-4),
    "double_sphere": (280.0, 281.0, 401.0, 202.0, -0.12, 0.58),
    "eucm": (319.0, 320.0, 401.0, 202.0, 0.62, 1.1),
}
WIDE = ("equidistant", "omni", "double_sphere", "eucm")


def camera_of(lens, truth):
    return Camera.create(truth[:2], truth[2:4], lens, truth[4:])


def views_of(lens, seed=0, count=16, points_m=POINTS_M, **how):
    how = {"distances_m": (0.15, 0.5) if lens in WIDE else (0.25, 0.8)} | how
    camera, rng = camera_of(lens, TRUTHS[lens]), np.random.default_rng(seed)
    return simulated_views(camera, SIZE_PX, points_m, count, rng, SIGMA_PX, **how)


def off_sigmas(fit, lens, count):
    """Errors of the first parameters, in their sigmas."""
    return (fit.parameters[:count] - TRUTHS[lens][:count]) / fit.sigma[:count]


def with_views(views, **changed):
    """Some views in place of others: v3=..."""
    all_views = list(views.views)
    for key, view in changed.items():
        all_views[int(key[1:])] = view
    return replace(views, views=tuple(all_views))


def test_errors_are_as_large_as_their_sigmas() -> None:
    truth = np.array(TRUTHS["equidistant"])
    ratios, squared, noise = [], [], []
    for seed in range(20):
        rough = np.array([330.0, 330.0, 409.5, 204.5, *[0.0] * 5])
        fit = fit_lens(views_of("equidistant", seed)[0], "equidistant", start=rough)
        error = fit.parameters[:8] - truth
        ratios.append(error / fit.sigma[:8])
        squared.append(error @ np.linalg.solve(fit.covariance[:8, :8], error))
        noise.append(fit.sigma_px)
        assert np.all(fit.view_weights == 1)
    assert np.mean(np.abs(ratios) < 3) >= 0.98
    low, high = stats.chi2.ppf([5e-4, 1 - 5e-4], 8 * 20) / 20
    assert low < np.mean(squared) < high
    assert np.mean(noise) == pytest.approx(SIGMA_PX, rel=0.02)


@pytest.mark.parametrize("lens", ["radtan", "equidistant"])
def test_rms_is_not_above_opencvs(lens) -> None:
    views, _ = views_of(lens, seed=5)
    points = [POINTS_M[view.ids].astype(np.float32) for view in views.views]
    corners = [view.corners_px.astype(np.float32) for view in views.views]
    if lens == "radtan":
        theirs, *_ = cv2.calibrateCamera(points, corners, SIZE_PX, None, None)
    else:
        theirs, *_ = cv2.fisheye.calibrate(
            [p.reshape(1, -1, 3) for p in points],
            [c.reshape(1, -1, 2) for c in corners],
            SIZE_PX,
            np.eye(3),
            np.zeros(4),
            flags=lens_start._fisheye_flag("CALIB_RECOMPUTE_EXTRINSIC")
            | lens_start._fisheye_flag("CALIB_FIX_SKEW"),
        )
    fit = fit_lens(views, lens)
    assert fit.used.sum() == sum(len(p) for p in points)
    assert fit.rms_px <= theirs * (1 + 1e-5)


def test_wrong_views_are_named_and_pull_at_nothing() -> None:
    rng = np.random.default_rng(1)
    views, poses = views_of("equidistant", seed=2)
    blurred, mixed, some = views.views[3], views.views[7], views.views[9]
    camera = camera_of("equidistant", TRUTHS["equidistant"])
    longer, inside = seen_from(camera, SIZE_PX, POINTS_M * [1.15, 1, 1], poses[12])
    ids = np.flatnonzero(inside)
    noise_px = rng.normal(scale=1.5, size=blurred.corners_px.shape)
    stray_px = some.corners_px.copy()
    stray_px[:2] += 12
    spoilt = with_views(
        views,
        v3=replace(blurred, corners_px=blurred.corners_px + noise_px),
        v7=replace(mixed, corners_px=rng.permutation(mixed.corners_px)),
        v9=replace(some, corners_px=stray_px),
        v12=replace(views.views[12], ids=ids, corners_px=longer[ids]),
    )
    found = calibrate_lens(spoilt, "equidistant")
    assert set(found.left_out) == {"view 3", "view 7", "view 12"}
    assert found.fit.used[9].sum() == len(some.ids) - 2
    assert np.all(np.abs(off_sigmas(found.fit, "equidistant", 8)) < 4)
    assert found.fit.sigma_px == pytest.approx(SIGMA_PX, rel=0.1)


@pytest.mark.parametrize(
    "lens", [*(pytest.param(lens, marks=pytest.mark.long) for lens in ("none", "radtan")), WIDE[0]]
)
def test_the_lens_is_chosen_by_views_it_was_not_fitted_to(lens) -> None:
    found = calibrate_lens(views_of(lens, seed=4)[0])
    assert found.fit.lens == lens
    assert not found.fit.fixed
    assert found.held_out_px[lens] == pytest.approx(SIGMA_PX, rel=0.15)


@pytest.mark.parametrize(
    "lens", ["omni", *(pytest.param(lens, marks=pytest.mark.long) for lens in WIDE[2:])]
)
def test_a_wide_lens_of_another_kind_is_fitted_where_it_is_asked_for(lens) -> None:
    """From no start, to within its sigmas; nothing keeps it from the true values."""
    truth = TRUTHS[lens]
    fit = fit_lens(views_of(lens, seed=1)[0], lens)
    assert fit.converged
    assert np.all(fit.view_weights == 1)
    assert fit.sigma_px == pytest.approx(SIGMA_PX, rel=0.1)
    assert np.all(np.abs(off_sigmas(fit, lens, len(truth))) < 4)
    # The focal length on the axis is known, whatever xi makes up for in the figure of the file.
    on_axis = np.asarray(fit.camera.axis_px) / np.asarray(camera_of(lens, truth).axis_px)
    assert np.all(np.abs(on_axis - 1) < 4 * fit.focal_sigma)
    assert np.all(fit.focal_sigma < 0.002)
    assert np.isfinite(rim_sigma_px(fit))
    assert rim_sigma_px(fit) < 0.5


def test_a_lens_that_does_not_fit_is_named() -> None:
    with pytest.raises(BadInput, match=r"lens none misses .* calibrate with --lens equidistant"):
        calibrate_lens(views_of("equidistant", seed=4)[0], "none")
    found = calibrate_lens(views_of("radtan", seed=4)[0], "none")
    assert found.fit.lens == "none"
    assert any("--lens radtan" in sentence for sentence in found.findings)


def test_what_corners_do_not_reach_is_held_and_named() -> None:
    views, _ = views_of("equidistant", seed=6, reach=0.35, distances_m=(0.4, 0.8))
    found = calibrate_lens(views, "equidistant")
    assert {"k3", "k4"} <= set(found.fit.fixed)
    assert "k4" in found.findings[0]
    assert "held at zero" in found.findings[0]
    assert np.all(found.fit.parameters[6:8] == 0)
    assert any("hold the board where" in sentence for sentence in found.advice)
    assert np.all(np.abs(off_sigmas(found.fit, "equidistant", 2)) < 4)
    # No other is known better for it.
    np.testing.assert_allclose(found.fit.sigma, fit_lens(views, "equidistant").sigma, rtol=1e-6)


@pytest.mark.long
def test_a_coefficient_that_is_known_is_not_held() -> None:
    """A webcam's lens, whose border no view shows: its k3 is 9 sigmas, its border 2 px unsure."""
    truth = (680.0, 680.0, 312.0, 222.0, 0.15, -1.19, 0.0, 0.0, 2.2)
    camera, rng = camera_of("radtan", truth), np.random.default_rng(3)
    views, _ = simulated_views(
        camera, (640, 480), POINTS_M, 17, rng, SIGMA_PX, distances_m=(0.35, 0.6), reach=0.75
    )
    found = calibrate_lens(views)
    assert found.fit.lens == "radtan"
    assert not {"k1", "k2", "k3"} & set(found.fit.fixed)
    assert np.all(np.abs(found.fit.parameters[:2] - 680) < 4 * found.fit.sigma[:2])


def test_a_coefficient_worth_its_noise_is_not_held() -> None:
    """At 2.1 sigmas unseen views are better with it, though 3 are needed to be sure of it."""
    found = calibrate_lens(views_of("radtan", 6, reach=0.5, distances_m=(0.6, 1.2))[0], "radtan")
    assert not found.fit.fixed
    assert 1.5 < abs(found.fit.parameters[8]) / found.fit.sigma[8] < 3


def test_a_view_a_little_worse_counts_less_only_where_the_lens_is_another_by_it() -> None:
    views, poses = views_of("radtan", 20)
    truth, row = TRUTHS["radtan"], views.views[3]
    noise_px = np.random.default_rng(20).normal(scale=3.2 * SIGMA_PX, size=row.corners_px.shape)
    noisy = with_views(views, v3=replace(row, corners_px=row.corners_px + noise_px))
    fit = fit_lens(noisy, "radtan")
    matrix, _ = lens_start.opencv_calibration(noisy, noisy.views, "radtan")
    assert np.all(fit.view_weights == 1)
    np.testing.assert_allclose(fit.parameters[:2], [matrix[0, 0], matrix[1, 1]], rtol=1e-6)

    camera = camera_of("radtan", truth)
    longer, inside = seen_from(camera, SIZE_PX, POINTS_M * [1.012, 1, 1], poses[3])
    ids = np.flatnonzero(inside)
    fit = fit_lens(with_views(views, v3=replace(row, ids=ids, corners_px=longer[ids])), "radtan")
    assert 0 < fit.view_weights[3] < 0.5
    assert np.all(np.abs(fit.parameters[:2] - truth[:2]) < 3 * fit.sigma[:2])


def test_a_lens_that_most_programs_read_is_taken_where_it_does() -> None:
    truth = (900.0, 900.0, 411.0, 212.0, 0.01, -5e-3, 2e-3, -4e-4)
    camera, rng = camera_of("equidistant", truth), np.random.default_rng(5)
    views, _ = simulated_views(camera, SIZE_PX, POINTS_M, 16, rng, SIGMA_PX, distances_m=(0.4, 1.2))
    assert calibrate_lens(views).fit.lens == "radtan"


def bent(views, rng, scale_px=0.3):
    """The views of a board that bends anew in each: corners shift by a smooth field."""

    def one(view):
        at = POINTS_M[view.ids, :2] / np.ptp(POINTS_M[:, :2], axis=0).max() * 2
        field = np.column_stack([at**2, at[:, :1] * at[:, 1:], at**3]) @ rng.normal(size=(5, 2))
        return replace(view, corners_px=view.corners_px + scale_px * field)

    return replace(views, views=tuple(map(one, views.views)))


def parts(views):
    """Every second view, and the others."""
    return [replace(views, views=views.views[first::2]) for first in (0, 1)]


def test_views_that_disagree_grow_the_sigmas() -> None:
    rough = np.array([330.0, 330.0, 409.5, 204.5, *[0.0] * 5])
    apart, white = [], []
    for seed in range(8):
        views = views_of("equidistant", seed, count=32)[0]
        white.append(fit_lens(parts(views)[0], "equidistant", start=rough).inflation)
        views = bent(views, np.random.default_rng(seed))
        halves = [fit_lens(half, "equidistant", start=rough) for half in parts(views)]
        assert min(half.inflation for half in halves) > 2
        difference = halves[0].parameters[:8] - halves[1].parameters[:8]
        apart.append(difference / np.hypot(halves[0].sigma[:8], halves[1].sigma[:8]))
    assert np.sum(np.array(white) == 1) >= 7
    assert np.mean(np.abs(apart) < 3) > 0.98
    assert 0.7 < np.sqrt(np.mean(np.square(apart))) < 1.5


def spoilt(kind):
    """Views that can't tell a lens."""
    if kind == "parallel":
        return views_of("none", seed=1, most_tilt_deg=0)[0]
    if kind == "another board":
        return replace(views_of("none")[0], points_board_m=grid_points_m(5, 6, 0.04))
    few, _ = views_of("none", count=4)
    again = tuple(replace(view, name=f"copy of {view.name}") for view in few.views)
    return replace(few, views=few.views + again) if kind == "copies" else few


@pytest.mark.parametrize(
    ("kind", "line"),
    [
        ("parallel", r"tilt .* by 30 to 45 deg"),
        ("few", r"4 different, sharp views of the board are too few: take at least 5"),
        ("copies", r"left out: copy of view 0 \(the same picture as view 0\), and 3 more"),
        ("another board", r"is it the board of the file"),
    ],
)
@pytest.mark.parametrize("lens", ["none", pytest.param("equidistant", marks=pytest.mark.long)])
def test_views_that_determine_no_lens_are_refused_in_one_line(kind, line, lens) -> None:
    with pytest.raises(BadInput, match=rf"^shots: .*{line}") as error:
        calibrate_lens(spoilt(kind), lens, where="shots")
    assert "\n" not in str(error.value)


def test_a_board_that_is_not_square_is_named() -> None:
    views, _ = views_of("equidistant", seed=8, points_m=POINTS_M * [1.005, 1, 1])
    fit = fit_lens(replace(views, points_board_m=POINTS_M), "equidistant")
    board = check_board(fit)
    assert board.stretch == pytest.approx(1 / 1.005 - 1, abs=4 * board.stretch_sigma)
    assert abs(board.stretch) > 5 * board.stretch_sigma
    true_board = check_board(fit_lens(views_of("equidistant", seed=8)[0], "equidistant"))
    assert abs(true_board.stretch) < 4 * true_board.stretch_sigma
    assert true_board.p_value > 1e-3


def test_a_board_that_is_not_that_of_its_file_is_named() -> None:
    moved = POINTS_M + np.where(np.arange(len(POINTS_M)) % 2, 5e-4, -5e-4)[:, None] * [1, 0, 0]
    views, _ = views_of("equidistant", seed=9, points_m=moved)
    fit = fit_lens(replace(views, points_board_m=POINTS_M), "equidistant")
    assert any("from where its file says" in line for line in findings(fit, "equidistant"))
    views, _ = views_of("none", seed=7, points_m=POINTS_M[:-6])
    fit = fit_lens(replace(views, points_board_m=POINTS_M), "none")
    assert findings(fit, "none") == (
        "no view shows the bottom row of the board's points: are there as many rows and columns "
        "as its file says?",
    )


def test_the_views_that_are_chosen_determine_more() -> None:
    views, _ = views_of("equidistant", seed=10)
    truth = np.append(TRUTHS["equidistant"], 0.0)
    chosen = informative(views, "equidistant", truth, 6)
    assert len(chosen) == len(set(chosen)) == 6

    def spread(numbers):
        some = replace(views, views=tuple(views.views[i] for i in numbers))
        return np.linalg.slogdet(fit_lens(some, "equidistant").covariance[:8, :8])[1]

    assert spread(chosen) < spread(range(0, 16, 3)) - 1


def test_a_single_marker_will_do() -> None:
    square_m = 0.086 * np.array([[-1.0, 1, 0], [1, 1, 0], [1, -1, 0], [-1, -1, 0]])
    views, _ = views_of("equidistant", seed=12, count=32, points_m=square_m, fewest=4)
    fit = fit_lens(views, "equidistant")
    assert np.all(fit.view_weights == 1)
    assert np.all(np.abs(off_sigmas(fit, "equidistant", 8)) < 4)
    assert np.all(fit.sigma[:2] < 0.005 * 319)


def test_opencv_is_not_needed(monkeypatch) -> None:
    def throws(*_):
        raise cv2.error("ill-conditioned")

    views, _ = views_of("equidistant", seed=11)
    expected = fit_lens(views, "equidistant")
    monkeypatch.setattr(lens_start, "opencv_calibration", throws)
    # Steps end where they promise a cost of 1e-12 of the sum, here 1e-4 of a standard deviation.
    away = fit_lens(views, "equidistant").parameters - expected.parameters
    assert np.max(np.abs(away) - 1e-4 * expected.sigma) <= 0


def test_blurred_and_empty_views_are_screened() -> None:
    views, _ = views_of("none", count=6)
    sharp = [replace(view, edge_width_px=2.0) for view in views.views]
    sharp[1] = replace(sharp[1], edge_width_px=7.0)
    sharp[2] = replace(sharp[2], ids=sharp[2].ids[:3], corners_px=sharp[2].corners_px[:3])
    kept, left_out = screened(replace(views, views=tuple(sharp)))
    assert len(kept.views) == 4
    assert "blurred" in left_out["view 1"]
    assert "only 3 points" in left_out["view 2"]


# --- the bundle adjustment: SciPy's on OpenCV's projection ---


def solved(lens, views, poses, fixed=(), weights=None, cut=NO_CUT):
    start = np.array([1.03 * f for f in TRUTHS[lens][:2]] + [405.0, 207.0] + [0.0] * 5)
    seen, unknowns = lens_bundle.padded(views, start, poses)
    if weights is None:
        weights = np.asarray(seen.present, float)
    free = lens_bundle.free_mask(lens, fixed)
    return seen, lens_bundle.solve(lens, unknowns, seen, weights, free, SIGMA_PX, cut)


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


@pytest.mark.parametrize("lens", ["equidistant", "radtan"])
def test_minimum_and_information_are_those_of_scipy(lens) -> None:
    views, poses = views_of(lens, count=4)
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
    weights = seen.present.astype(float)
    each, gradient = lens_bundle.view_information(lens, bundle.unknowns, seen, weights)
    information = np.sum(np.asarray(each), axis=0)[:count, :count]
    of_all = np.linalg.inv(expected.jac.T @ expected.jac)[:count, :count]
    sigma = np.sqrt(np.diag(of_all))
    assert np.all(np.abs(found - expected.x[:count]) < 1e-3 * sigma)
    ratio = np.linalg.inv(information) / np.outer(sigma, sigma)
    np.testing.assert_allclose(ratio, of_all / np.outer(sigma, sigma), atol=2e-4)
    # At the minimum the views' gradients balance, in sigmas.
    balance = np.sum(np.asarray(gradient), axis=0)[:count] * sigma
    assert np.max(np.abs(balance)) < 1e-2 < np.max(np.abs(np.asarray(gradient)[:, :count] * sigma))


def test_what_is_held_stays_at_zero_and_what_has_no_weight_does_not_count() -> None:
    views, poses = views_of("equidistant", count=6)
    seen, alone = solved("equidistant", views, poses, fixed=("k3", "k4"))
    assert np.all(np.asarray(alone.unknowns.lens)[6:] == 0)
    weights = np.asarray(seen.present, float)
    weights[2] = 0
    _, without = solved("equidistant", views, poses, weights=weights)
    moved = replace(views.views[2], corners_px=views.views[2].corners_px + 50)
    _, other = solved("equidistant", with_views(views, v2=moved), poses, weights=weights)
    np.testing.assert_allclose(without.unknowns.lens, other.unknowns.lens, rtol=1e-9, atol=1e-12)


def test_a_cut_keeps_far_corners_from_pulling() -> None:
    views, poses = views_of("radtan", seed=3, count=6)
    _, clean = solved("radtan", views, poses)
    corners_px = views.views[0].corners_px.copy()
    corners_px[:3] += 30
    views = with_views(views, v0=replace(views.views[0], corners_px=corners_px))
    _, pulled = solved("radtan", views, poses)
    _, cut = solved("radtan", views, poses, cut=2.0)
    focal = [np.asarray(one.unknowns.lens)[:2] for one in (clean, pulled, cut)]
    assert np.abs(focal[1] - focal[0]).max() > 5 * np.abs(focal[2] - focal[0]).max()


def test_simulated_corners_are_opencvs() -> None:
    lens = "equidistant"
    _, poses = views_of(lens, count=2)
    drawn, inside = seen_from(camera_of(lens, TRUTHS[lens]), SIZE_PX, POINTS_M, poses[0])
    rotation = Rotation.from_quat(np.roll(poses[0, :4], -1)).as_rotvec()
    fx, fy, cx, cy, *coefficients = TRUTHS[lens]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]], float)
    expected, _ = cv2.fisheye.projectPoints(
        POINTS_M.reshape(-1, 1, 3), rotation, poses[0, 4:], matrix, np.array(coefficients)
    )
    np.testing.assert_allclose(drawn[inside], expected.reshape(-1, 2)[inside], atol=1e-9)


# --- maps over the image ---

MAP_SIZE_PX = (640, 480)
MAP_CAMERA = Camera.create(
    (620.0, 621.0), (325.0, 236.0), "radtan", (-0.2, 0.06, 1e-3, -5e-4, 0.01)
)


@pytest.fixture(scope="module")
def fitted_map():
    rng = np.random.default_rng(0)
    views, _ = simulated_views(
        MAP_CAMERA, MAP_SIZE_PX, POINTS_M, 16, rng, 0.2, distances_m=(0.3, 0.8)
    )
    return fit_lens(views, "radtan")


def test_the_sigma_of_a_ray_is_how_far_lenses_as_likely_draw_it(fitted_map):
    """200 lenses drawn from the covariance, each turned to the best: by the other map."""
    sigma = projection_sigma(fitted_map)
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(fitted_map.parameters, fitted_map.covariance, 200)
    shifts_px = [
        projection_difference(
            fitted_map.camera, lens_bundle.camera_of("radtan", jnp.asarray(one, float)), MAP_SIZE_PX
        ).shift_px
        for one in drawn
    ]
    spread_px = np.sqrt(np.mean(np.square(shifts_px), axis=0))
    np.testing.assert_allclose(spread_px, sigma.shift_px, rtol=0.25, atol=0.02)
    middle = sigma.length_px[sigma.length_px.shape[0] // 2, sigma.length_px.shape[1] // 2]
    assert middle < sigma.length_px[0, 0] / 3


def test_a_camera_that_looks_aside_is_no_other_lens():
    """A centre off by 3 px is a turn: a tele lens can't tell them apart, a wide one can."""
    for focal_px, least_px, most_px in ((6000.0, 0.0, 0.02), (300.0, 1.0, 3.1)):
        one = Camera.create((focal_px,) * 2, (320.0, 240.0))
        other = Camera.create((focal_px,) * 2, (323.0, 241.0))
        left_px = projection_difference(one, other, MAP_SIZE_PX).length_px
        assert least_px < left_px.max() < most_px
    same = projection_difference(MAP_CAMERA, MAP_CAMERA, MAP_SIZE_PX)
    np.testing.assert_allclose(same.shift_px, 0, atol=1e-9)


def test_a_longer_focal_length_draws_outwards():
    one = Camera.create((600.0,) * 2, (319.5, 239.5))
    other = Camera.create((606.0,) * 2, (319.5, 239.5))
    found = projection_difference(one, other, MAP_SIZE_PX)
    expected_px = 0.01 * (found.pixels - [319.5, 239.5])
    np.testing.assert_allclose(found.shift_px, expected_px, atol=1e-6)


def test_what_one_lens_does_not_draw_is_not_compared():
    """A fisheye's image is wider than a lens that folds at 42 degrees can draw."""
    fisheye = Camera.create((300.0,) * 2, (320.0, 240.0), "equidistant", (0.0,) * 4)
    folding = Camera.create((300.0,) * 2, (320.0, 240.0), "radtan", (-0.4, 0.0, 0.0, 0.0))
    found = projection_difference(fisheye, folding, MAP_SIZE_PX)
    assert np.isnan(found.length_px[0, 0])
    middle = found.length_px[8:10, 11:13]
    assert np.all(np.isfinite(middle))


def test_sigmas_do_not_depend_on_which_way_a_camera_looks(fitted_map):
    """A sigma of the centre that a turn explains is none of the lens."""
    more = fitted_map.covariance.copy()
    more[2, 2] += 25.0
    of_centre = projection_sigma(replace(fitted_map, covariance=more)).length_px
    assert of_centre.max() < 5
