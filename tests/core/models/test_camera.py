"""Every lens against OpenCV or its paper, and its inverse against itself, over the whole image.

The tests of `test_lens_...` are a contract: each runs for every lens the project knows.
"""

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.models.camera import LENS_COEFFICIENTS, Camera, stack_cameras
from jaxnav.core.models.lenses import LENSES
from tests.derivatives import check_derivatives, in_float32
from tests.reference import lenses as papers

# Lens, coefficients, focal length, image size, half angle of view in degrees along the diagonal.
# The equidistant two see 150 degrees: an ideal fisheye, and one with Kalibr's usual coefficients;
# those after them see backwards.
RATIONAL = [0.35, 0.05, 1e-3, 5e-4, 0.01, 0.5, 0.02, 0.005]
MODELS = {
    "none": ("none", [], 500.0, (640, 480), 38),
    "radtan": ("radtan", [-0.28, 0.07, 2e-4, -1e-4], 460.0, (752, 480), 44),
    "radtan k3": ("radtan", [0.11, -0.2, 1e-3, 5e-4, 0.09], 600.0, (1280, 720), 50),
    "rational": ("rational", RATIONAL, 600.0, (1280, 720), 50),
    "equidistant": ("equidistant", [0.0] * 4, 319.0, (836, 420), 75),
    "equidistant k": ("equidistant", [-0.013, 0.02, -0.012, 0.002], 319.0, (836, 420), 75),
    "thin_prism": ("thin_prism", [*RATIONAL, 2e-3, -1e-3, -3e-3, 5e-4], 600.0, (1280, 720), 50),
    "omni": ("omni", [1.4, -0.09, 0.02, 1e-3, -5e-4], 850.0, (836, 420), 100),
    "double_sphere": ("double_sphere", [-0.2, 0.59], 255.0, (836, 420), 110),
    "eucm": ("eucm", [0.62, 1.1], 319.0, (836, 420), 100),
}
# Of which the tests of derivatives and of finiteness take one a kind: `omni` and `thin_prism` have
# the terms of two of them.
ONE_A_KIND = [
    pytest.param(name, marks=[pytest.mark.long] if name in ("radtan", "rational") else [])
    for name in MODELS
    if name not in ("radtan k3", "equidistant")
]


def build(name: str) -> Camera:
    lens, distortion, focal, (width, height), _ = MODELS[name]
    return Camera.create((focal, focal + 3), (width / 2 + 1.5, height / 2 - 2), lens, distortion)


def points_in_view(name: str, count: int, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    theta = np.deg2rad(MODELS[name][4]) * np.sqrt(rng.uniform(0, 1, count))
    phi = rng.uniform(-np.pi, np.pi, count)
    rays = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)]
    return np.stack(rays, axis=1) * rng.uniform(0.1, 20, (count, 1))


def true_pixels(name: str, points: np.ndarray) -> np.ndarray:
    """By OpenCV, or by the formulas of a lens that it does not have."""
    lens, distortion, *_ = MODELS[name]
    K = np.asarray(build(name).K, float)
    if lens in papers.BY_NAME:
        images = np.array([papers.BY_NAME[lens](point, distortion) for point in points])
        return images @ K[:2, :2].T + K[:2, 2]
    if lens == "equidistant":
        k = np.array(distortion)
        return cv2.fisheye.projectPoints(points[:, None], np.zeros(3), np.zeros(3), K, k)[0][:, 0]
    k = np.array(distortion) if distortion else None
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), K, k)[0][:, 0]


def all_pixels(name: str) -> np.ndarray:
    width, height = MODELS[name][3]
    u, v = np.meshgrid(np.linspace(-0.5, width - 0.5, 40), np.linspace(-0.5, height - 0.5, 25))
    return np.stack([u.ravel(), v.ravel()], axis=1)


project = jax.jit(lambda camera, points: camera.project(points))


@jax.jit
def unproject(camera, pixels):
    """Rays, where they project to, and whether they can be seen."""
    rays = camera.unproject(pixels)
    return rays, camera.project(rays), camera.in_front(rays)


@jax.jit
def slopes(camera, points, pixels):
    return (
        camera.project(points),
        jax.vmap(jax.jacrev(camera.project))(points),
        jax.vmap(jax.jacrev(camera.unproject))(pixels),
    )


IN_FLOAT64 = [pytest.param("float32", marks=pytest.mark.long), "float64"]


@pytest.mark.parametrize("name", MODELS)
def test_lens_projects_as_its_authors_do(name):
    points = points_in_view(name, 1000)
    pixels = project(build(name), jnp.asarray(points))
    np.testing.assert_allclose(pixels, true_pixels(name, points), atol=1e-9)


@pytest.mark.parametrize("name", MODELS)
@pytest.mark.parametrize("precision", IN_FLOAT64, indirect=True)
def test_lens_is_inverted_over_the_whole_image(name, precision):
    pixels = all_pixels(name)
    rays, again, in_front = unproject(build(name), jnp.asarray(pixels))
    assert rays.dtype == precision
    np.testing.assert_allclose(np.linalg.norm(rays, axis=1), 1, atol=1e-6)
    tolerance_px = 2e-3 if precision == np.float32 else 1e-8
    np.testing.assert_allclose(again, pixels, atol=tolerance_px)
    assert np.all(in_front)


@pytest.mark.parametrize("name", MODELS)
def test_lens_finds_the_ray_that_made_a_pixel(name):
    points = points_in_view(name, 1000, seed=1)
    rays, *_ = unproject(build(name), jnp.asarray(true_pixels(name, points)))
    expected = points / np.linalg.norm(points, axis=1, keepdims=True)
    np.testing.assert_allclose(rays, expected, atol=1e-9)


@pytest.mark.parametrize("name", ONE_A_KIND)
def test_lens_has_true_derivatives(name):
    """Of pixels and rays, with respect to points, pixels and the calibration; also on the axis."""
    camera = build(name)
    points = np.append(points_in_view(name, 9, seed=2), [[0.0, 0.0, 2.0]], axis=0)
    pixels = jnp.asarray(true_pixels(name, points))

    def see(focal_px, center_px, distortion, points, pixels):
        changed = Camera(focal_px, center_px, distortion, camera.lens_index, camera.lenses)
        return changed.project(points), changed.unproject(pixels)

    calibration = (camera.focal_px, camera.center_px, camera.distortion)
    check_derivatives(see, *calibration, jnp.asarray(points), pixels, atol=1e-5)


@pytest.mark.parametrize("name", ONE_A_KIND)
def test_lens_is_finite_everywhere(name, precision):
    camera = build(name)
    points = jnp.asarray(
        [
            [0.0, 0.0, 0.0],
            [0.0, 0.0, -1.0],
            [1.0, 0.0, 0.0],
            [0.0, -1.0, 1e-30],
            [1e-20, 0.0, 1.0],
            [1.0, 2.0, -3.0],
            [1e-12, -1e-12, -5.0],
        ]
    )
    pixels = [[-1e6, 0.0], [1e5, 1e5], [3000.0, -2000.0], [0.0, 0.0], camera.center_px]
    pixels = jnp.asarray(np.array(pixels), float)
    for values in slopes(camera, points, pixels):
        assert values.dtype == precision
        assert np.all(np.isfinite(values))


@pytest.mark.parametrize("name", ["none", "equidistant k"])
def test_lens_takes_any_batch(name):
    camera, flat = build(name), points_in_view(name, 6, seed=3)
    pixels = project(camera, jnp.asarray(flat.reshape(3, 1, 2, 3)))
    np.testing.assert_allclose(pixels.reshape(6, 2), true_pixels(name, flat), atol=1e-9)
    for batch in ((), (1,), (3, 1, 2)):
        rays, again, in_front = jax.eval_shape(unproject, camera, jnp.zeros((*batch, 2)))
        assert (rays.shape, again.shape, in_front.shape) == ((*batch, 3), (*batch, 2), batch)


def test_what_lies_behind_is_not_in_front():
    behind = jnp.asarray([[0.1, 0.0, -1.0], [0.0, 0.0, 1.0], [1.0, 0.0, -0.5]])
    in_front = jax.jit(lambda camera: camera.in_front(behind))
    assert in_front(build("none")).tolist() == [False, True, False]
    assert in_front(build("radtan")).tolist() == [False, True, False]
    # A fisheye may see backwards, though not straight behind itself.
    assert in_front(build("equidistant")).tolist() == [False, True, True]


def test_behind_a_pinhole_lands_outside_on_the_right_side():
    pixel = project(build("none"), jnp.asarray([0.1, -0.2, -1.0]))
    assert pixel[0] > 640 * 10
    assert pixel[1] < -480 * 10


def test_a_pixel_without_a_ray_does_not_project_back():
    # This lens folds back at some radius: no ray reaches the far corner.
    camera = Camera.create((400.0, 400.0), (320.0, 240.0), "radtan", [-0.4])
    pixels = jnp.asarray(np.tile([1000.0, 900.0], (1000, 1)))
    rays, again, _ = unproject(camera, pixels)
    assert np.all(np.isfinite(rays))
    assert np.linalg.norm(again[0] - pixels[0]) > 50


def test_a_rig_of_mixed_lenses_keeps_each_camera_s_own():
    names = list(MODELS)
    cameras = stack_cameras([build(name) for name in names])
    assert set(cameras.lenses) == set(LENSES)
    points = jnp.asarray(points_in_view("none", 1000))
    pixels, rays = jax.jit(
        jax.vmap(lambda camera: (camera.project(points), camera.unproject(camera.project(points))))
    )(cameras)
    for index, name in enumerate(names):
        np.testing.assert_allclose(pixels[index], project(build(name), points), atol=1e-12)
        np.testing.assert_allclose(
            rays[index], unproject(build(name), pixels[index])[0], atol=1e-12
        )


def test_pinhole_matrix():
    K = build("radtan").K
    np.testing.assert_array_equal(K, [[460.0, 0, 377.5], [0, 463.0, 238.0], [0, 0, 1]])


@pytest.mark.parametrize("lens", LENSES)
def test_too_many_coefficients_are_refused(lens):
    with pytest.raises(ValueError, match="at most"):
        Camera.create((1.0, 1.0), (0.0, 0.0), lens, [0.0] * (LENS_COEFFICIENTS[lens] + 1))


def test_an_unknown_lens_is_refused():
    with pytest.raises(ValueError, match="unknown lens 'fisheye'"):
        Camera.create((1.0, 1.0), (0.0, 0.0), "fisheye")


# Lenses with other ends: at a fold, at infinity, at the last angle that a table has.
BARE_OMNI = [1.0, 0.0, 0.0, 0.0, 0.0]
FIELDS = {
    "radtan": [
        MODELS["radtan"][1],
        [-0.4],
        [0.1, 0.05, 0.0, 0.0, 0.01],
        [-0.26, 0.09, 1e-3, 1e-3],
        [-0.26, 0.09, 0.0, 0.0, -0.016],
    ],
    "rational": [MODELS["rational"][1], [-0.4, 0.0, 0.0, 0.0, 0.0, 0.1]],
    "thin_prism": [MODELS["thin_prism"][1]],
    "equidistant": [[0.0] * 4, MODELS["equidistant k"][1], [-0.2, 0.0, 0.0, 0.0]],
    "omni": [MODELS["omni"][1], [0.0, -0.1, 0.02, 0.0, 0.0], BARE_OMNI, [3.0, *BARE_OMNI[1:]]],
    "double_sphere": [MODELS["double_sphere"][1], [0.0, 0.0], [0.3, 0.4], [0.9, 0.95], [0.1, 0.5]],
    "eucm": [MODELS["eucm"][1], [0.0, 1.0], [0.3, 0.8], [0.5, 2.0], [0.9, 1.5]],
}


# By lens and k1 alone: the angle up to which its image moves outwards, degrees.
FOLDS_DEG = {
    ("radtan", -0.4): np.rad2deg(np.arctan(np.sqrt(1 / 1.2))),
    ("equidistant", -0.2): np.rad2deg(np.sqrt(1 / 0.6)),
}


def rays_all_over(angles: np.ndarray) -> np.ndarray:
    """Unit vectors (N, 3) at these angles off the axis, to all sides."""
    phi = np.random.default_rng(5).uniform(-np.pi, np.pi, len(angles))
    sides = [np.sin(angles) * np.cos(phi), np.sin(angles) * np.sin(phi), np.cos(angles)]
    return np.stack(sides, axis=1)


@jax.jit
def seen_again(camera, rays):
    return camera.in_front(rays), camera.unproject(camera.project(rays))


@pytest.mark.parametrize("lens", FIELDS)
def test_a_lens_finds_every_ray_that_it_sees(lens, precision):
    """From the axis to the last angle: what it would not find, it does not see."""
    angles = np.linspace(1e-6, np.pi, 4001)
    rays = jnp.asarray(rays_all_over(angles), precision)
    for coefficients in FIELDS[lens]:
        camera = Camera.create((1.0, 1.0), (0.0, 0.0), lens, coefficients)
        seen, again = (np.asarray(array) for array in seen_again(camera, rays))
        last = angles[seen].max()
        assert np.mean(seen[angles <= last]) > 0.9, coefficients
        fold_deg = FOLDS_DEG.get((lens, coefficients[0])) if coefficients else None
        assert fold_deg is None or fold_deg - 1.2 < np.rad2deg(last) < fold_deg, coefficients
        errors = np.linalg.norm(again - rays, axis=1)
        tolerance = 1e-5 if precision == np.float32 else 1e-9
        assert errors[seen].max() < tolerance, coefficients


@pytest.mark.parametrize("lens", papers.BY_NAME)
@in_float32
def test_a_wide_lens_ends_where_its_image_turns_back(lens, precision):
    """Or where it goes to infinity; what lies beyond is drawn into the image, and refused."""
    angles = np.linspace(0.001, 3.14, 4001)
    rays = np.stack([np.sin(angles), 0 * angles, np.cos(angles)], axis=1)
    for coefficients in FIELDS[lens]:
        camera = Camera.create((1.0, 1.0), (0.0, 0.0), lens, coefficients)
        seen = np.asarray(seen_again(camera, jnp.asarray(rays, float))[0])
        radii = np.array([papers.BY_NAME[lens](ray, coefficients)[0] for ray in rays])
        falls = np.diff(radii, append=-1) <= 0  # past infinity they are negative
        end = angles[np.argmax(falls)]
        assert not np.any(seen[angles > end]), coefficients
        # The table of a bent image ends at 89 degrees; next to infinity alpha of 0.5 is steep.
        least_deg = 0 if lens == "omni" else 6 if 0.5 in coefficients else 3
        assert least_deg == 0 or np.rad2deg(end - angles[seen].max()) < least_deg, coefficients


def test_neighbouring_lenses_agree_where_one_is_a_case_of_the_other():
    points = jnp.asarray(points_in_view("double_sphere", 200, seed=6))

    def images(lens, coefficients, focal=1.0):
        return project(Camera.create((focal, focal), (0.0, 0.0), lens, coefficients), points)

    alpha, xi = 0.55, 0.55 / 0.45
    unified = images("double_sphere", [0.0, alpha])
    np.testing.assert_allclose(images("eucm", [alpha, 1.0]), unified, rtol=1e-12)
    omni = images("omni", [xi, 0.0, 0.0, 0.0, 0.0], focal=1 + xi)
    np.testing.assert_allclose(omni, unified, rtol=1e-12)
    ahead = points[:, 2] > 0.05
    for lens, count in (("omni", 5), ("double_sphere", 2), ("eucm", 2)):
        plain = images(lens, [0.0] * count)
        np.testing.assert_allclose(plain[ahead], images("none", [])[ahead], rtol=1e-12)


@pytest.mark.parametrize("name", ["radtan", "omni", "double_sphere"])
def test_a_thing_on_the_axis_is_as_large_as_its_focal_length_says(name):
    camera, angle = build(name), 1e-6
    on_axis = project(camera, jnp.asarray([[0.0, 0.0, 1.0], [angle, angle, 1.0]]))
    np.testing.assert_allclose(camera.axis_px, (on_axis[1] - on_axis[0]) / angle, rtol=1e-4)
