"""The lane-parallel solver of marker poses against the general one, lane by lane."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.models.markers import CORNER_SIGNS
from jaxnav.core.pose import pair_lanes
from jaxnav.core.pose.ippe import ippe_square
from jaxnav.core.pose.refine import solve_marker, solve_markers
from tests import worlds
from tests.reference.rigid import matrix

BATCH, FOCAL_PX = 64, 500.0
general = jax.jit(jax.vmap(solve_marker))
closed = jax.jit(pair_lanes.ippe_squares)


def views() -> tuple[np.ndarray, np.ndarray]:
    """Corners (64, 4, 2) and sizes (64,): random, exact, frontal, far, tiny, huge, off the axis."""
    rng = np.random.default_rng(0)
    R, t, size = worlds.random_views(rng, BATCH, (0, 75), (0.02, 0.5))
    t[40:44] = [0, 0, 1.5]
    R[40:44] = np.diag([1.0, -1, -1])  # exactly frontal
    t[44:48] *= 10  # 1 px to 25 px wide
    size[48:52], t[48:52] = size[48:52] * 1e-3, t[48:52] * 1e-3
    t[52:56, :2] = 3 * t[52:56, 2:]  # at 75 degrees from the optical axis
    noise_px = rng.uniform(0, 0.5, (BATCH, 1, 1)) * rng.standard_normal((BATCH, 4, 2))
    noise_px[:8] = 0
    noise_px[40:42] = 0
    noise_px[44:48] *= 0.05
    return worlds.normalised_corners(R, t, size) + noise_px / FOCAL_PX, size


def garbage(corners: np.ndarray) -> np.ndarray:
    """The same, every third lane spoilt: NaN, infinite, all equal, on a line, crossed, mirrored."""
    corners = corners.copy()
    line = np.outer(np.arange(4), [0.1, 0.2])
    corners[0, 1, 0], corners[3, 2] = np.nan, np.inf
    corners[6], corners[9], corners[12] = 0.1, line, 1e20 * line
    corners[15] = corners[15][[0, 2, 1, 3]]
    corners[18] = corners[18][::-1]
    corners[21], corners[24] = 0.0, np.random.default_rng(1).normal(size=(4, 2))
    return corners


def costs_of(pair, corners: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Sums of squares (B, 2), in float64 whatever the poses' precision."""
    T = pair.T_camera_marker.wxyz_xyz
    wxyz = np.asarray(T[..., :4], float)
    w, x, y, z = np.moveaxis(wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True), -1, 0)
    R_x = np.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    R_y = np.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1)
    half = size[:, None, None, None] / 2
    points = half * (
        CORNER_SIGNS[:, :1] * R_x[:, :, None] + CORNER_SIGNS[:, 1:2] * R_y[:, :, None]
    ) + np.asarray(T[..., None, 4:], float)
    projected = points[..., :2] / points[..., 2:]
    return np.sum((projected - corners[:, None]) ** 2, axis=(2, 3))


def test_the_closed_form_is_that_of_one_marker(precision):
    corners, size = views()
    corners, size = jnp.asarray(corners, precision), jnp.asarray(size, precision)
    pair, expected = (
        jax.device_get(solve(corners, size)) for solve in (closed, jax.jit(jax.vmap(ippe_square)))
    )
    assert pair.reprojection_error.dtype == precision
    eps = jnp.finfo(precision).eps
    apart = np.abs(pair.reprojection_error - expected.reprojection_error)
    assert np.max(apart / np.max(np.abs(corners), axis=(1, 2))[:, None]) < 4 * eps
    clear = np.asarray(expected.reprojection_error[:, 1] > 1.01 * expected.reprojection_error[:, 0])
    clear = clear & (np.arange(BATCH) < 40)
    assert np.sum(clear) > 20
    angles = worlds.rotation_angles_rad(
        *(matrix(one.T_camera_marker.wxyz_xyz)[clear, :, :3, :3] for one in (pair, expected))
    )
    assert np.max(angles) < 100 * eps


def test_every_lane_reaches_the_minima_of_one_marker(precision):
    """In float32 to a ten thousandth of the cost."""
    exact, size = views()
    corners = np.asarray(exact, precision)
    pair = solve_markers(jnp.asarray(corners), jnp.asarray(size, precision))
    with jax.enable_x64(True):
        expected = general(jnp.asarray(corners, float), jnp.asarray(size))
        expected = jax.tree.map(np.asarray, expected)
    assert pair.T_camera_marker.wxyz_xyz.dtype == precision
    assert np.all(pair.reprojection_error[:, 0] <= pair.reprojection_error[:, 1])
    ours = np.sort(costs_of(pair, corners.astype(float), size), axis=1)
    theirs = np.sort(costs_of(expected, corners.astype(float), size), axis=1)
    spread = np.sum((corners - corners.mean(1, keepdims=True)) ** 2, axis=(1, 2))[:, None]
    share, rounding = (1e-4, 1e-11) if precision == np.float32 else (1e-6, 1e-20)
    assert np.all(ours <= theirs * (1 + share) + rounding * spread)
    assert np.all(theirs <= ours * (1 + 1e-6) + 1e-20 * spread)  # the same minimum, not another


def test_noise_is_small_enough_for_both_minima_to_be_told_apart():
    """What the test above compares is not one minimum found twice."""
    corners, size = map(jnp.asarray, views())
    errors = np.asarray(solve_markers(corners, size).reprojection_error)
    assert np.mean(errors[:, 1] > 1.1 * errors[:, 0]) > 0.7


def test_float64_is_at_float64_accuracy():
    corners, size = views()
    pair, expected = solve_markers(jnp.asarray(corners), jnp.asarray(size)), general(corners, size)
    np.testing.assert_allclose(
        pair.reprojection_error[8:40], expected.reprojection_error[8:40], rtol=1e-9
    )
    assert np.max(pair.reprojection_error[:8, 0]) < 1e-15


def test_a_lane_knows_nothing_of_the_others(precision):
    """The same bits beside other neighbours, beside garbage and elsewhere in the batch."""
    corners, size = views()
    corners, size = corners.astype(precision), jnp.asarray(size, precision)
    pair = solve_markers(jnp.asarray(corners), size)
    moved = np.random.default_rng(2).permutation(BATCH)
    shuffled = solve_markers(jnp.asarray(corners[moved]), size[moved])
    spoilt = solve_markers(jnp.asarray(garbage(corners)), size)
    sound = np.arange(BATCH) % 3 != 0
    for here, there, beside in zip(*map(jax.tree.leaves, (pair, shuffled, spoilt)), strict=True):
        np.testing.assert_array_equal(np.asarray(here)[moved], there)
        np.testing.assert_array_equal(np.asarray(here)[sound], np.asarray(beside)[sound])
        assert np.all(np.isnan(np.asarray(beside)[[0, 3]]))
        assert np.all(np.isfinite(np.asarray(beside)[24]))


@pytest.mark.parametrize("batch", [pytest.param(1, marks=pytest.mark.long), 37])
def test_a_lane_does_not_know_how_many_there_are(batch):
    """The same bits from a batch of another length, which is another program."""
    corners, size = map(jnp.asarray, views())
    whole = jax.tree.leaves(solve_markers(corners, size))
    part = jax.tree.leaves(solve_markers(corners[:batch], size[:batch]))
    for of_all, of_part in zip(whole, part, strict=True):
        np.testing.assert_array_equal(np.asarray(of_all)[:batch], of_part)


def test_blocks_do_not_show(monkeypatch):
    """Many blocks with a part of one at the end give what one block gives."""
    corners, size = map(jnp.asarray, views())
    whole = jax.tree.leaves(solve_markers(corners, size))
    monkeypatch.setattr(pair_lanes, "_block_lanes", lambda *_: 24)
    split = jax.tree.leaves(jax.jit(lambda *a: pair_lanes.solve_pairs(*a))(corners, size))
    for of_all, of_part in zip(whole, split, strict=True):
        np.testing.assert_array_equal(of_all, of_part)


def test_an_empty_batch():
    for function in (solve_markers, pair_lanes.ippe_squares):
        pair = function(jnp.zeros((0, 4, 2)), jnp.zeros(0))
        assert pair.T_camera_marker.wxyz_xyz.shape == (0, 2, 7)
        assert pair.reprojection_error.shape == (0, 2)


CORNERS, SIZES = views()
WEIGHTS = np.random.default_rng(3).normal(size=(1, 2, 8))


def numbers(solve, corners, size):
    """A sum of all that is found of each marker (B,)."""
    pair = solve(corners, size)
    pose = pair.T_camera_marker.wxyz_xyz / size[:, None, None]
    told = jnp.concatenate([pose, pair.reprojection_error[..., None]], axis=-1)
    return jnp.sum(WEIGHTS * told, axis=(1, 2))


def slopes(solve):
    """By corners and size: the markers know nothing of each other."""

    @jax.jit
    def both(corners, size):
        values, pull = jax.vjp(lambda *x: numbers(solve, *x), corners, size)
        return values, pull(jnp.ones_like(values))

    return both


def in_proportion(by_corner):
    """How large the slopes are, and which count: not of exact corners, nor of poses so flat that a
    step of 1e-6 is not small."""
    scale = np.sqrt(np.sum(np.square(by_corner), axis=(1, 2)))
    fair = (scale < 300) & (np.arange(BATCH) >= 8)
    assert np.sum(fair) > 20
    return scale[fair], fair


def test_gradients_are_differences():
    both, step = slopes(solve_markers), 1e-6
    _, (by_corner, by_size) = jax.device_get(both(CORNERS, SIZES))
    change = np.random.default_rng(4).normal(size=(BATCH, 4, 2))
    ahead, behind = (
        np.asarray(both(CORNERS + h * change, SIZES * (1 + h))[0]) for h in (step, -step)
    )
    along = np.sum(by_corner * change, axis=(1, 2)) + by_size * SIZES
    scale, fair = in_proportion(by_corner)
    assert np.max(np.abs(along - (ahead - behind) / (2 * step))[fair] / scale) < 2e-3


@pytest.mark.long
def test_gradients_are_those_of_one_marker():
    ours, theirs = (
        jax.device_get(slopes(solve)(CORNERS, SIZES)[1])
        for solve in (solve_markers, jax.vmap(solve_marker))
    )
    scale, fair = in_proportion(ours[0])
    for mine, general_one in zip(ours, theirs, strict=True):
        apart = np.abs(mine - general_one).reshape(BATCH, -1)
        assert np.max(apart[fair] / scale[:, None]) < 1e-5
