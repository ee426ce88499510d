"""Corners of the edge fit against markers drawn by brute force."""

import warnings
from dataclasses import dataclass

import cv2
import jax
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from jaxnav.core.models.camera import Camera
from jaxnav.detection import image_model
from jaxnav.detection.families import marker_cells
from jaxnav.detection.lens import Lens
from jaxnav.detection.paper import blur_on_paper, generators, on_paper
from jaxnav.detection.refine import refine_corners
from tests.helpers.marker_images import Scene, random_scene, rotation

FAMILY = "tag36h11"
# A lens that draws a point as a Gaussian of this width: sharp, as lenses go.
OPTICS_PX = 0.4


@dataclass(frozen=True)
class Quality:
    """Of fitted corners: RMS and mean of their errors, px, the mean away from the marker's middle,
    and the RMS of the errors in their standard deviations."""

    rms_px: float
    mean_px: np.ndarray
    outward_px: float
    normalised: float


def quality(side_px: float, count: int, seed: int, coded: bool = False, **options) -> Quality:
    """Of markers that are drawn and decoded; each fit must be good."""
    rng = np.random.default_rng(seed)
    errors, sigmas, outwards = [], [], []
    for _ in range(count):
        scene = random_scene(rng, side_px, marker_cells(FAMILY, int(rng.integers(587))), **options)
        image, truth_px = scene.render(rng), scene.corners_px()
        image = for_screens(image) if coded else image
        # What a decoder gives: a contour's corners, some tenths of a pixel off.
        refined = refine_corners(image, truth_px + rng.normal(0, 0.4, (4, 2)), scene.cells, Lens())
        assert refined.good
        errors.append(refined.corners_px - truth_px)
        sigmas.append(refined.sigma_px[:, None])
        outward = truth_px - truth_px.mean(axis=0)
        outwards.append(outward / np.linalg.norm(outward, axis=1, keepdims=True))
    return Quality(
        np.sqrt(np.mean(np.square(errors))),
        np.mean(errors, axis=(0, 1)),
        np.mean(np.sum(np.multiply(errors, outwards), axis=-1)),
        np.sqrt(np.mean(np.square(np.divide(errors, sigmas)))),
    )


def for_screens(image: np.ndarray) -> np.ndarray:
    """Linear grey levels as cameras code them for screens (IEC 61966-2-1, sRGB)."""
    x = image / 255.0
    coded = np.where(x <= 0.0031308, 12.92 * x, 1.055 * np.maximum(x, 1e-9) ** (1 / 2.4) - 0.055)
    return np.round(255 * coded).astype(np.uint8)


@pytest.mark.parametrize(
    ("side_px", "count"), [pytest.param(320, 4, marks=pytest.mark.long), (60, 12), (28, 24)]
)
def test_levels_that_are_coded_for_screens_move_no_corner(side_px, count):
    """An edge's middle is then too light: taken for linear, outlines shrink by 0.2 px and more."""
    found = quality(side_px, count, seed=1, optics_px=0.6, coded=True)
    assert found.rms_px < 0.03
    assert abs(found.outward_px) < 0.012
    assert 0.6 < found.normalised < 1.4


@pytest.mark.parametrize(
    ("side_px", "options", "limit_px"),
    [
        (70, {"optics_px": OPTICS_PX}, 0.03),
        (17, {"optics_px": OPTICS_PX, "motion_px": (2.0, 0.0)}, 0.05),
        *(
            pytest.param(*repeated, marks=pytest.mark.long)
            for repeated in (
                (140, {"optics_px": OPTICS_PX}, 0.03),
                (28, {"optics_px": OPTICS_PX}, 0.03),
                (28, {}, 0.04),
                (28, {"optics_px": OPTICS_PX, "motion_px": (3.0, 2.0)}, 0.04),
                (17, {"optics_px": OPTICS_PX}, 0.04),
            )
        ),
    ],
)
def test_corners_are_exact_unbiased_and_know_their_error(side_px, options, limit_px):
    found = quality(side_px, 24 if side_px < 100 else 6, seed=int(side_px), **options)
    assert found.rms_px < limit_px
    assert np.max(np.abs(found.mean_px)) < 0.01
    assert abs(found.outward_px) < 0.01
    assert 0.7 < found.normalised < 1.3


@pytest.mark.parametrize(
    "levels", [(40, 420), pytest.param((-90, 190), marks=pytest.mark.long)],
    ids=["paper full", "ink empty"],
)  # fmt: skip
def test_light_beyond_what_a_pixel_holds_moves_no_corner(levels):
    """Half of an edge's pixels are as full as the paper: it looks larger, or the ink does."""
    found = quality(28, 12, seed=7, optics_px=0.6, black=levels[0], white=levels[1])
    assert found.rms_px < 0.02
    assert abs(found.outward_px) < 0.01
    assert 0.6 < found.normalised < 1.4


def test_the_ground_beyond_the_white_zone_does_not_pull():
    for background in (20.0, 230.0):
        options = {"background": background, "optics_px": 0.5, "motion_px": (1.5, 0.5)}
        assert abs(quality(20, 10, seed=3, **options).outward_px) < 0.012


def fisheye_scene(azimuth_rad: float, rng: np.random.Generator) -> Scene:
    camera = Camera.create((160.0, 160.0), (60.0, 60.0), "equidistant", (0.02, -0.006, 0.001, 0.0))
    direction_rad = np.deg2rad(52)
    across = np.sin(direction_rad) * np.array([np.cos(azimuth_rad), np.sin(azimuth_rad)])
    towards = np.append(across, np.cos(direction_rad))
    return Scene(
        camera,
        (240, 240),
        rotation(rng.uniform(0, 0.3), azimuth_rad, rng.uniform(0, 6.3)),
        towards * 1.6,
        1.0,
        marker_cells(FAMILY, 11),
        optics_px=OPTICS_PX,
    )


def test_bent_edges_of_a_fisheye_are_straight_through_its_lens():
    rng = np.random.default_rng(0)
    through_lens, straight = [], []
    for azimuth_rad in (0.6, 0.9):
        scene = fisheye_scene(azimuth_rad, rng)
        image, truth_px = scene.render(rng), scene.corners_px()
        for lens, errors in ((Lens(scene.camera), through_lens), (Lens(), straight)):
            fit = refine_corners(image, truth_px + 0.3, scene.cells, lens)
            assert fit.good or lens.camera is None
            errors.append(fit.corners_px - truth_px)
    assert np.sqrt(np.mean(np.square(through_lens))) < 0.03
    assert np.sqrt(np.mean(np.square(straight))) > 0.2  # so the lens was put to the test


def test_a_wrong_picture_is_refused():
    rng = np.random.default_rng(5)
    scene = random_scene(rng, 30, marker_cells(FAMILY, 3), optics_px=OPTICS_PX)
    corners_px = scene.corners_px()
    noise = rng.integers(0, 255, scene.size_px[::-1]).astype(np.uint8)
    refused = refine_corners(noise, corners_px, scene.cells, Lens())
    assert not refused.good
    assert np.array_equal(refused.corners_px, corners_px)
    assert np.all(refused.sigma_px >= 0.9)
    assert not refine_corners(scene.render(rng), corners_px + 500, scene.cells, Lens()).good


@pytest.mark.long
def test_result_is_the_same_in_both_precisions():
    rng = np.random.default_rng(6)
    scene = random_scene(rng, 30, marker_cells(FAMILY, 3), optics_px=OPTICS_PX)
    image, start_px = scene.render(rng), scene.corners_px() + 0.4
    wide = refine_corners(image, start_px, scene.cells, Lens()).corners_px
    with jax.enable_x64(False):
        narrow = refine_corners(image, start_px, scene.cells, Lens()).corners_px
    assert np.max(np.abs(wide - narrow)) < 1e-3


def test_blurred_ink_equals_the_integral_and_its_slopes_the_differences():
    K = image_model.step_corners(marker_cells(FAMILY, 7))
    knots = np.linspace(-1, 1, 9)
    xy = np.array([[0.31, -0.92, 0.98, 0.1], [-0.47, 0.88, -1.01, 0.74]])
    variance = np.array(
        [[0.02, 0.03, 0.01, 0.05], [0.03, 0.02, 0.015, 0.04], [0.01, -0.012, 0, 0.02]]
    )
    split = np.array([[0.05, 0.0, 0.03, 0.1], [0.0, 0.06, 0.02, 0.05]])
    ink = jax.jit(image_model.ink)
    dark, slope = ink(xy, variance, split, K)
    sides = np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    for i in range(xy.shape[1]):
        xx, yy, both = variance[:, i]
        exact = sum(
            float(K[k, j])
            * multivariate_normal.cdf(
                xy[:, i] - [knots[j], knots[k]] + split[:, i] * side,
                cov=[[xx - split[0, i] ** 2, both], [both, yy - split[1, i] ** 2]],
            )
            / len(sides)
            for k in range(9)
            for j in range(9)
            for side in sides
        )
        assert abs(exact - float(dark[i])) < 5e-3  # what Mehler's series leaves out
    small = 1e-6
    for row, known in enumerate((xy, xy, variance, variance, variance)):
        index = row if row < 2 else row - 2
        values = []
        for sign in (1, -1):
            moved = known.copy()
            moved[index] += sign * small
            arguments = (moved, variance, split) if row < 2 else (xy, moved, split)
            values.append(np.asarray(ink(*arguments, K)[0]))
        difference = (values[0] - values[1]) / (2 * small)
        # By the blur the series is cut off one order apart; a blur that is off costs nothing else.
        tolerance = 1e-3 if row < 2 else 0.1 * np.max(np.abs(difference))
        assert np.max(np.abs(difference - np.asarray(slope[row]))) < tolerance


def test_paper_moves_as_its_generators_say():
    rng = np.random.default_rng(2)
    M = np.eye(3) + rng.normal(0, 0.1, (3, 3))
    rays = rng.normal(0, 0.3, (3, 5)) + np.array([[0], [0], [3]])
    rays_px = rng.normal(0, 1, (2, 3, 5))
    xy, xy_px = on_paper(M, rays, rays_px)
    step = rng.normal(0, 1e-7, 8)
    moved, _ = on_paper(M + np.append(step, 0).reshape(3, 3) @ M, rays, rays_px)
    expected = np.einsum("ijn,j->in", generators(xy), step)
    assert np.max(np.abs(moved - xy - expected)) < 1e-11
    shifted, _ = on_paper(M, rays + 1e-7 * rays_px[1], rays_px)
    assert np.max(np.abs((shifted - xy) / 1e-7 - xy_px[1])) < 1e-5
    S = np.array([[0.5, 0.2], [0.2, 0.4]])
    xx, yy, both = blur_on_paper(xy_px, np.array([0.5, 0.2, 0.4]))
    for n in range(5):
        assert np.allclose(
            xy_px[:, :, n].T @ S @ xy_px[:, :, n], [[xx[n], both[n]], [both[n], yy[n]]]
        )


def test_no_warning_on_a_flat_image():
    cells = marker_cells(FAMILY, 0)
    square_px = np.array([[20.0, 20], [60, 20], [60, 60], [20, 60]])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert not refine_corners(np.full((80, 80), 90, np.uint8), square_px, cells, Lens()).good


def textured(side_px: float, seed: int, oversampled: int) -> tuple[np.ndarray, ...]:
    """A dim marker as a game engine draws it: a texture sampled at points, without a lens's blur.

    Returns:
        the picture, the corners (4, 2), and the pattern.
    """
    rng = np.random.default_rng(seed)
    cells, cell_px = marker_cells(FAMILY, int(rng.integers(587))), 32
    texture = np.kron(np.pad(cells, 2, constant_values=1), np.ones((cell_px, cell_px)))
    square = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) * side_px / 2
    turn = rng.uniform(0, 2 * np.pi)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    corners_px = 100 + square * [1, rng.uniform(0.6, 1)] @ R.T + rng.uniform(-0.5, 0.5, 2)
    corners_px += rng.uniform(-0.06, 0.06, (4, 2)) * side_px
    inner = np.array([2, 2 + len(cells)]) * cell_px - 0.5
    ink = np.array([[inner[i], inner[j]] for i, j in ((0, 0), (1, 0), (1, 1), (0, 1))])
    drawn_px = (corners_px + 0.5) * oversampled - 0.5
    H = cv2.getPerspectiveTransform(ink.astype(np.float32), drawn_px.astype(np.float32))
    size_px = (200 * oversampled, 200 * oversampled)
    image = cv2.warpPerspective(texture, H, size_px, flags=cv2.INTER_NEAREST, borderValue=1)
    image = cv2.resize(image, (200, 200), interpolation=cv2.INTER_AREA)
    return np.round(15 + 50 * image).astype(np.uint8), corners_px, cells


@pytest.mark.parametrize(
    ("oversampled", "limit_px"),
    [(1, 0.2), *(pytest.param(*case, marks=pytest.mark.long) for case in ((2, 0.06), (4, 0.03)))],
)
def test_pictures_sharper_than_any_lens_draws_give_corners_that_know_their_error(
    oversampled, limit_px
):
    """Their errors are alike along an edge: sigmas of independent noise were 2 to 4 times less."""
    rng, errors, sigmas, good = np.random.default_rng(0), [], [], 0
    for seed in range(40):
        image, truth_px, cells = textured(25 + seed, seed, oversampled)
        refined = refine_corners(image, truth_px + rng.normal(0, 0.4, (4, 2)), cells, Lens())
        good += refined.good
        if refined.good:
            errors.append(refined.corners_px - truth_px)
            sigmas.append(refined.sigma_px)
    assert good >= 38
    assert np.sqrt(np.mean(np.square(errors))) < limit_px
    assert 0.5 < np.sqrt(np.mean((np.array(errors) / np.array(sigmas)[..., None]) ** 2)) < 1.6
