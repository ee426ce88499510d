"""Closed-form poses against OpenCV where OpenCV is right, and against the truth elsewhere."""

import cv2
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.pose.ippe import ippe_from_rays, ippe_square
from tests import worlds
from tests.derivatives import check_derivatives, in_float32
from tests.reference.rigid import matrix

GENERIC = 10_000
solve = jax.jit(jax.vmap(ippe_square))


def R_of(T: jaxlie.SE3) -> np.ndarray:
    return matrix(T.wxyz_xyz)[..., :3, :3]


def t_of(T: jaxlie.SE3) -> np.ndarray:
    return np.asarray(T.wxyz_xyz)[..., 4:]


def opencv_pairs(corners_n: np.ndarray, size_m: np.ndarray):
    """(R (N, 2, 3, 3), t (N, 2, 3), error (N, 2), distance to a half turn (N,) rad)."""
    R, t, errors = [], [], []
    half_turn_gap = np.empty(len(size_m))
    for i, (corners, size) in enumerate(zip(corners_n, size_m, strict=True)):
        _, rotation_vectors, translations, error = cv2.solvePnPGeneric(
            size / 2 * CORNER_SIGNS, corners, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE_SQUARE
        )
        R.append([cv2.Rodrigues(rotvec)[0] for rotvec in rotation_vectors])
        t.append(np.reshape(translations, (2, 3)))
        errors.append(error.ravel())
        half_turn_gap[i] = np.pi - np.max(np.linalg.norm(rotation_vectors, axis=1))
    return np.array(R), np.array(t), np.array(errors), half_turn_gap


@pytest.mark.parametrize("noise_px", [0.0, 0.05])
def test_both_solutions_are_opencv_s_on_generic_poses(noise_px):
    """10 000 poses: tilts of 5 to 75 degrees, 25 to 250 px wide at a focal length of 500 px.

    Left out: rotations within 0.01 rad of a half turn, of which OpenCV's rotation vectors know
    less than 1e-6 rad.
    """
    rng = np.random.default_rng(0)
    count = GENERIC + 500
    R, t, size = worlds.random_views(rng, count, (5, 75), (0.05, 0.5))
    noise = noise_px / 500 * rng.standard_normal((count, 4, 2))
    corners = worlds.normalised_corners(R, t, size) + noise
    R_opencv, t_opencv, error_opencv, gap = opencv_pairs(corners, size)
    generic = np.flatnonzero(gap > 0.01)[:GENERIC]
    assert len(generic) == GENERIC

    pair = solve(jnp.asarray(corners[generic]), jnp.asarray(size[generic]))
    angles = worlds.rotation_angles_rad(R_of(pair.T_camera_marker), R_opencv[generic])
    shifts = np.linalg.norm(t_of(pair.T_camera_marker) - t_opencv[generic], axis=2)
    assert angles.max() < 1e-6
    assert shifts.max() < 1e-9
    # OpenCV's error: root mean square over the eight coordinates, in its image's unit.
    np.testing.assert_allclose(pair.reprojection_error, error_opencv[generic], rtol=1e-5, atol=1e-8)
    if noise_px == 0:
        assert (
            worlds.rotation_angles_rad(R_of(pair.T_camera_marker)[:, 0], R[generic]).max() < 1e-12
        )
        np.testing.assert_allclose(t_of(pair.T_camera_marker)[:, 0], t[generic], rtol=0, atol=1e-12)


POSITIONS = [(0, 0, 1.0), (0, 0, 3.2), (0.5, 0, 2), (0.5, 0.3, 2), (-1.2, -0.2, 1.5), (0, 0.1, 0.4)]


def upright_views(turned: bool) -> tuple[np.ndarray, np.ndarray]:
    """Upright markers in a level camera, R (P, 2001, 3, 3), t (P, 2001, 3), yaw -75 to 75 deg."""
    yaws = np.deg2rad(np.linspace(-75, 75, 2001))
    c, s, zero = np.cos(yaws), np.sin(yaws), np.zeros_like(yaws)
    R = np.stack([[c, zero, -s], [zero, zero - 1, zero], [-s, zero, -c]]).transpose(2, 0, 1)
    if turned:
        R = R @ np.diag([-1.0, -1.0, 1.0])
    shape = (len(POSITIONS), len(yaws))
    return (
        np.broadcast_to(R, (*shape, 3, 3)),
        np.broadcast_to(np.array(POSITIONS, float)[:, None], (*shape, 3)),
    )


@pytest.mark.parametrize("turned", [False, True])
def test_upright_markers_in_a_level_camera(precision, turned):
    """Half turns exactly. OpenCV 5.0 returns a wrong or no rotation for every one of these views,
    and, with the marker upside down, for the frontal one; so the truth is the oracle."""
    R, t = (array.reshape(-1, *array.shape[2:]) for array in upright_views(turned))
    size = np.full(len(R), 0.172)
    pair = solve(jnp.asarray(worlds.normalised_corners(R, t, size)), jnp.asarray(size))
    R_found = R_of(pair.T_camera_marker)
    angles = worlds.rotation_angles_rad(R_found, R[:, None])
    if precision == np.float64:
        assert angles[:, 0].max() < 1e-5
        assert angles[:, 0].max() < 1e-11  # what is really reached
        np.testing.assert_allclose(t_of(pair.T_camera_marker)[:, 0], t, rtol=0, atol=1e-13)
    else:
        # Foreshortening is quadratic in the tilt: sqrt(6e-8) is the angle of one rounding.
        assert angles.min(axis=1).max() < 3e-3
        np.testing.assert_allclose(t_of(pair.T_camera_marker)[:, 0], t, rtol=0, atol=2e-5)
    assert np.all(np.isfinite(pair.reprojection_error))


def killer(dtype) -> tuple[jnp.ndarray, float]:
    corners_px = [
        [326.14478, 244.11597],
        [318.32449, 244.11569],
        [318.32449, 235.88431],
        [326.14478, 235.88403],
    ]
    focal_px = jnp.asarray([[512.1070492931361, 539.048825737012]], dtype)
    return (
        jnp.asarray(corners_px, dtype) - jnp.asarray([[320.0, 240.0]], dtype)
    ) / focal_px, 0.1524


def test_the_known_killer(precision):
    """A nearly frontal half turn 10 m away, on which OpenCV 5.0 fails in float32.

    See docs/design.md, Half turns.
    """
    corners, size_m = killer(precision)
    pair = jax.jit(ippe_square)(corners, size_m)
    R = np.asarray(R_of(pair.T_camera_marker), float)
    # Corners given to 1e-5 px: sides to 1e-6, tilts to about sqrt(1e-5).
    np.testing.assert_allclose(t_of(pair.T_camera_marker)[0], [0.04354, 0, 9.97989], atol=1e-4)
    for rotation in R:
        assert worlds.rotation_angles_rad(rotation, np.diag([-1.0, 1.0, -1.0])) < 0.01
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-6)
        assert np.linalg.det(rotation) == pytest.approx(1, abs=1e-6)
    assert np.all(pair.reprojection_error < 5e-7)
    assert pair.reprojection_error[0] <= pair.reprojection_error[1]


def flat(corners_n, size_m):
    pair = ippe_square(corners_n, size_m)
    return pair.T_camera_marker.wxyz_xyz, pair.reprojection_error


def awkward_corners() -> np.ndarray:
    square = CORNER_SIGNS[:, :2] * [1.0, -1.0] * 0.05
    rng = np.random.default_rng(1)
    yaws = [0.0, 1e-12, 1e-6, 1e-3]
    R = np.stack(
        [[[np.cos(a), 0, -np.sin(a)], [0, -1, 0], [-np.sin(a), 0, -np.cos(a)]] for a in yaws]
    )
    nearly = worlds.normalised_corners(R, np.tile([0, 0, 2.0], (4, 1)), np.full(4, 0.2))
    return np.stack(
        [
            square,  # exactly frontal, on the axis
            square + np.array([0.3, -0.2]),  # exactly frontal to a parallel plane
            square @ np.array([[0.6, 0.8], [-0.8, 0.6]]),
            np.zeros((4, 2)),
            np.full((4, 2), 0.3),
            square * [1.0, 0.0],  # on a line
            square[[0, 0, 2, 3]],  # two corners at one place
            square[[0, 2, 1, 3]],  # a bow tie
            square[::-1],  # seen from behind
            square * 1e-7,  # millionths of a pixel wide
            square * 1e3,
            rng.normal(size=(4, 2)),
            *nearly,
        ]
    )


@in_float32
def test_gradients_are_finite_everywhere_and_corners_of_no_square_have_a_large_error(precision):
    corners = jnp.asarray(awkward_corners(), precision)
    size = jnp.full(len(corners), 0.2, float)

    @jax.jit
    @jax.vmap
    def both(corners, size):
        return flat(corners, size), jax.jacrev(flat)(corners, size)

    values, slopes = both(corners, size)
    for leaf in jax.tree.leaves((values, slopes)):
        assert leaf.dtype == precision
        assert np.all(np.isfinite(leaf))
    assert np.all(values[1][6:8] > 0.03)


def test_gradients_are_differences_on_generic_views():
    R, t, size = worlds.random_views(np.random.default_rng(2), 20, (15, 70), (0.05, 0.4))
    noisy = worlds.normalised_corners(R, t, size)
    noisy = noisy + 1e-4 * np.random.default_rng(3).standard_normal(noisy.shape)
    function = jax.vmap(flat)
    check_derivatives(
        function, jnp.asarray(noisy), jnp.asarray(size), step=1e-8, rtol=2e-5, atol=1e-4
    )


def test_any_camera_direction_is_as_good(precision):
    """From rays: a marker at the side of a fisheye, and behind it, like one in the middle."""
    R_sight, t_sight, size = worlds.random_views(
        np.random.default_rng(4), 200, (10, 70), (0.05, 0.4)
    )
    turns = Rotation.random(200, rng=5).as_matrix()
    R, t = turns @ R_sight, np.einsum("nij,nj->ni", turns, t_sight)
    corners = size[:, None, None] / 2 * CORNER_SIGNS @ np.swapaxes(R, 1, 2) + t[:, None]
    rays = corners / np.linalg.norm(corners, axis=2, keepdims=True)
    assert np.sum(t[:, 2] < 0) > 50
    pair = jax.jit(jax.vmap(ippe_from_rays))(jnp.asarray(rays), jnp.asarray(size))
    angles = worlds.rotation_angles_rad(R_of(pair)[:, 0], R)
    shifts = np.linalg.norm(t_of(pair)[:, 0] - t, axis=1) / np.linalg.norm(t, axis=1)
    assert angles.max() < (5e-3 if precision == np.float32 else 1e-11)
    assert shifts.max() < (1e-4 if precision == np.float32 else 1e-12)
