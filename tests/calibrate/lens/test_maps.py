"""Maps over the image: how unsure a lens is, and how two lenses differ."""

from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.calibrate.lens import bundle as lens_bundle
from jaxnav.calibrate.lens.fit import fit_lens
from jaxnav.calibrate.lens.maps import projection_difference, projection_sigma
from jaxnav.calibrate.lens.simulated_views import grid_points_m, simulated_views
from jaxnav.core.models.camera import Camera

SIZE_PX = (640, 480)
CAMERA = Camera.create((620.0, 621.0), (325.0, 236.0), "radtan", (-0.2, 0.06, 1e-3, -5e-4, 0.01))


@pytest.fixture(scope="module")
def fit():
    rng = np.random.default_rng(0)
    views, _ = simulated_views(
        CAMERA, SIZE_PX, grid_points_m(6, 5, 0.04), 16, rng, 0.2, distances_m=(0.3, 0.8)
    )
    return fit_lens(views, "radtan")


def test_the_sigma_of_a_ray_is_how_far_lenses_as_likely_draw_it(fit):
    """200 lenses drawn from the covariance, each turned to the best: by the other map."""
    sigma = projection_sigma(fit)
    rng = np.random.default_rng(1)
    drawn = rng.multivariate_normal(fit.parameters, fit.covariance, 200)
    shifts_px = [
        projection_difference(
            fit.camera, lens_bundle.camera_of("radtan", jnp.asarray(one, float)), SIZE_PX
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
        left_px = projection_difference(one, other, SIZE_PX).length_px
        assert least_px < left_px.max() < most_px
    same = projection_difference(CAMERA, CAMERA, SIZE_PX)
    np.testing.assert_allclose(same.shift_px, 0, atol=1e-9)


def test_a_longer_focal_length_draws_outwards():
    one = Camera.create((600.0,) * 2, (319.5, 239.5))
    other = Camera.create((606.0,) * 2, (319.5, 239.5))
    found = projection_difference(one, other, SIZE_PX)
    expected_px = 0.01 * (found.pixels - [319.5, 239.5])
    np.testing.assert_allclose(found.shift_px, expected_px, atol=1e-6)


def test_what_one_lens_does_not_draw_is_not_compared():
    """A fisheye's image is wider than a lens that folds at 42 degrees can draw."""
    fisheye = Camera.create((300.0,) * 2, (320.0, 240.0), "equidistant", (0.0,) * 4)
    folding = Camera.create((300.0,) * 2, (320.0, 240.0), "radtan", (-0.4, 0.0, 0.0, 0.0))
    found = projection_difference(fisheye, folding, SIZE_PX)
    assert np.isnan(found.length_px[0, 0])
    middle = found.length_px[8:10, 11:13]
    assert np.all(np.isfinite(middle))


def test_sigmas_do_not_depend_on_which_way_a_camera_looks(fit):
    """A sigma of the centre that a turn explains is none of the lens."""
    more = fit.covariance.copy()
    more[2, 2] += 25.0
    of_centre = projection_sigma(replace(fit, covariance=more)).length_px
    assert of_centre.max() < 5
