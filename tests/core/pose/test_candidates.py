"""The candidates: both poses of every sighting, merged and pruned, without what is no marker."""

import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scipy.optimize

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.candidates import both_poses, find_candidates, own_errors_px, remove_outliers
from jaxnav.core.pose.observation import Observation, Snapshot
from jaxnav.core.pose.refine import Candidates
from jaxnav.core.pose.residuals import e1
from tests import worlds
from tests.helpers.filters import snap
from tests.reference.rigid import matrix

ROOM_VIEW = (0.2, 0.1, 0.6)
SIZES = ("max_sightings", "max_candidates", "max_steps", "ground_plane")


@functools.partial(jax.jit, static_argnames=SIZES)
def _find(rig, markers, obs, sigmas_px, max_sightings, max_candidates, max_steps, ground_plane):
    snapshot = Snapshot.create(rig, markers, obs, *sigmas_px, max_sightings)
    return find_candidates(snapshot, max_candidates, max_steps, ground_plane)


def find(rig, markers, obs, corner_sigma_px=1.0, model_sigma_px=0.15, **sizes) -> Candidates:
    """In NumPy. One program whatever the numbers."""
    told = dict(zip(SIZES, (16, 4, 60, False), strict=True)) | sizes
    sigmas_px = jnp.asarray(corner_sigma_px, float), jnp.asarray(model_sigma_px, float)
    return jax.device_get(_find(rig, markers, obs, sigmas_px, **told))


def view(markers, pose, sigma_px=0.0, seed=0):
    rig = worlds.qcar_rig()
    noise = sigma_px * np.random.default_rng(seed).standard_normal((4, len(markers.ids), 4, 2))
    return rig, markers, worlds.observe(rig, markers, worlds.planar(*pose), jnp.asarray(noise))


def pose_errors(candidates: Candidates, pose) -> np.ndarray:
    """(N, 2): metres and radians to the truth, in the vehicle's axes."""
    Ts = matrix(candidates.T_vehicle_world.wxyz_xyz) @ matrix(worlds.planar(*pose).wxyz_xyz)
    off_m = np.linalg.norm(Ts[:, :3, 3], axis=1)
    return np.column_stack([off_m, worlds.rotation_angles_rad(Ts[:, :3, :3], np.eye(3))])


def test_one_camera_and_one_marker_give_two(precision):
    for sigma_px in (0.0, 0.5):
        candidates = find(*view(worlds.paper_markers(), worlds.START_VIEW, sigma_px))
        assert candidates.valid.tolist() == [True, True, False, False]
        errors = pose_errors(candidates, worlds.START_VIEW)
        assert candidates.e1_px2.dtype == precision
        if sigma_px == 0:
            assert errors[0, 0] < (0.01 if precision == np.float32 else 1e-7)
            # The mirror pose is far away and nearly as good: the problem the paper is about.
            assert errors[1, 1] > 0.5
            assert candidates.e1_px2[1] < 10
        else:
            assert errors[:2, 0].min() < 0.5


def test_two_cameras_on_one_marker_merge_to_two():
    rig, markers, obs = view(worlds.paper_markers(), worlds.OVERLAP_VIEW, 0.3, seed=3)
    candidates = find(rig, markers, obs)
    assert np.all(candidates.converged)
    assert 1 <= int(np.sum(candidates.valid)) <= 2
    distinct = pose_errors(candidates, worlds.OVERLAP_VIEW)[candidates.valid]
    assert distinct[0, 0] < 0.05
    # All four lanes were refined on the joint e1; what is left out repeats a kept one.
    Ts = matrix(candidates.T_vehicle_world.wxyz_xyz)
    for T in Ts[~candidates.valid]:
        assert np.min(np.abs(Ts[candidates.valid] - T).max(axis=(1, 2))) < 0.05


def test_what_still_falls_towards_another_minimum_is_no_candidate():
    """Where it is after a number of steps is decided by rounding."""
    for sigma_px, seed in ((0.3, 20), (0.3, 22), (0.3, 24), (1.0, 7), (1.0, 25), (1.0, 38)):
        seen = view(worlds.paper_markers(), worlds.OVERLAP_VIEW, sigma_px, seed)
        stopped, ended = (find(*seen, max_steps=steps) for steps in (12, 60))
        assert stopped.valid[0]
        e1_px2, at_end = (found.e1_px2[found.valid] for found in (stopped, ended))
        np.testing.assert_allclose(e1_px2, at_end[: len(e1_px2)], rtol=0.02)


def test_two_cameras_agree_on_two_distinct_poses():
    """Farther away, where the mirror pose is a minimum of the joint e1 as well."""
    pose = (1.2, -1.6, np.deg2rad(75.0))
    rig, markers, obs = view(worlds.paper_markers(), pose, 0.2, seed=1)
    assert int(np.sum(obs.visible)) == 2
    candidates = find(rig, markers, obs)
    assert int(np.sum(candidates.valid)) == 2
    errors = pose_errors(candidates, pose)[np.asarray(candidates.valid)]
    assert errors[:, 1].min() < 0.2
    assert errors[:, 1].max() > 0.5


def test_several_markers_leave_no_doubt():
    candidates = find(*view(worlds.room_markers(), ROOM_VIEW, 0.3))
    assert candidates.valid[0]
    assert candidates.converged[0]
    errors = pose_errors(candidates, ROOM_VIEW)
    assert errors[0, 0] < 0.01
    assert errors[0, 1] < 0.01
    others = np.flatnonzero(candidates.valid)[1:]
    assert np.all(np.asarray(candidates.e1_px2)[others] > 100 * candidates.e1_px2[0])


def test_costs_are_what_they_say():
    rig, markers, obs = view(worlds.room_markers(), ROOM_VIEW, 0.3)
    candidates = find(rig, markers, obs, corner_sigma_px=0.3)
    image_errors = jax.jit(jax.vmap(lambda T: e1(rig, markers, obs.corners_px, obs.visible, T)))(
        candidates.T_vehicle_world
    )
    np.testing.assert_allclose(candidates.e1_px2, image_errors, rtol=1e-9)
    np.testing.assert_allclose(candidates.cost, candidates.e1_px2 / 0.3**2, rtol=1e-9)
    valid = np.asarray(candidates.e1_px2)[np.asarray(candidates.valid)]
    assert np.all(np.diff(valid) >= 0)


def test_an_observation_s_own_sigma_is_used_with_the_model_s():
    rig, markers, obs = view(worlds.room_markers(), ROOM_VIEW, 0.3)
    own = Observation(obs.corners_px, obs.visible, corner_sigma_px=jnp.full((4, 4, 4), 0.4))
    seen = snap(rig, markers, own, 1.0, 0.3).seen
    np.testing.assert_allclose(np.asarray(seen.sigma_px)[np.asarray(seen.visible)], 0.5, rtol=1e-9)


def test_hidden_lanes_change_nothing():
    rig, markers, obs = view(worlds.room_markers(), ROOM_VIEW, 0.3)
    clean = jax.tree.leaves(find(rig, markers, obs))
    hidden = ~np.asarray(obs.visible)[:, :, None, None]
    for filler in (np.nan, np.inf, 1e25, -7.0):
        filled = jnp.asarray(np.where(hidden, filler, obs.corners_px))
        found = find(rig, markers, eqx.tree_at(lambda o: o.corners_px, obs, filled))
        for leaf, expected in zip(jax.tree.leaves(found), clean, strict=True):
            np.testing.assert_array_equal(leaf, expected)


def test_nothing_in_view_gives_no_candidate(precision):
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    for filler in (np.nan, 0.0):
        obs = view(markers, worlds.START_VIEW)[2]
        blind = jnp.full((4, 1, 4, 2), filler, float), jnp.zeros((4, 1), bool)
        blind = eqx.tree_at(lambda o: (o.corners_px, o.visible), obs, blind)
        candidates = find(rig, markers, blind)
        assert not np.any(candidates.valid)
        assert not np.any(candidates.converged)
        assert candidates.cost.dtype == precision
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(candidates))


def test_absurd_corners_are_no_candidate_in_float32():
    with jax.enable_x64(False):
        rig, markers, obs = view(worlds.paper_markers(), worlds.START_VIEW)
        absurd = eqx.tree_at(lambda o: o.corners_px, obs, obs.corners_px * 1e25)
        candidates = find(rig, markers, absurd)
        assert not np.any(candidates.valid)
        assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(candidates))


def test_corners_that_defeat_the_covariance_are_no_candidate():
    """The best fit is a marker at astronomic distance: finite e1, singular information."""
    rig, markers, obs = view(worlds.paper_markers(), worlds.START_VIEW)
    corners = np.array(obs.corners_px)
    corners[0, 0, :, 1] = [1498.0, 232430.0, 232616.0, 1603.0]
    candidates = find(rig, markers, eqx.tree_at(lambda o: o.corners_px, obs, jnp.asarray(corners)))
    assert all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(candidates))
    assert np.all(np.diagonal(candidates.covariance, axis1=1, axis2=2) > 0)


def test_pruning_keeps_what_explains_all_corners_best():
    seen = view(worlds.room_markers(), ROOM_VIEW, 0.3)
    every, one = find(*seen), find(*seen, max_candidates=1)
    assert (every.valid.shape, one.valid.shape) == ((4,), (1,))
    np.testing.assert_allclose(one.e1_px2[0], every.e1_px2[0], rtol=1e-6)
    T_one, T_every = (matrix(c.T_vehicle_world.wxyz_xyz[0]) for c in (one, every))
    np.testing.assert_allclose(T_one, T_every, atol=1e-6)


def test_pruning_calls_no_library():
    """As XLA's TopK: a program that does can't be kept, and is compiled anew at every start."""
    rig, room = worlds.qcar_rig(), worlds.room_markers()
    for copies in (1, 3):  # few lanes, and many
        markers = MarkerMap(
            jaxlie.SE3(jnp.tile(room.Ts_world_marker.wxyz_xyz, (copies, 1))),
            jnp.tile(room.size_m, copies),
            room.ids * copies,
            room.families * copies,
        )
        obs = Observation(jnp.zeros((4, 4 * copies, 4, 2)), jnp.zeros((4, 4 * copies), bool))
        program = jax.make_jaxpr(lambda *seen: find_candidates(Snapshot.create(*seen)))
        assert " top_k[" not in str(program(rig, markers, obs)), copies


GROUND_VIEWS = [worlds.START_VIEW, worlds.OVERLAP_VIEW]


@pytest.mark.parametrize("pose", GROUND_VIEWS)
def test_on_the_ground_only_three_numbers_are_refined(pose):
    seen = view(worlds.paper_markers(), pose, 0.5, seed=2)
    free, level = find(*seen), find(*seen, ground_plane=True)
    assert level.valid[0]
    T = np.linalg.inv(matrix(level.T_vehicle_world.wxyz_xyz))
    np.testing.assert_allclose(T[:, 2], np.tile([0, 0, 1, 0], (4, 1)), atol=1e-7)
    # Three numbers can't explain the corners better than six.
    assert level.e1_px2[0] >= free.e1_px2[0] * (1 - 1e-4)
    # And what is left is noise.
    assert level.e1_px2[0] < 8 * 0.5**2 * 8
    kept = level.covariance
    np.testing.assert_array_equal(kept[:, 2:5], 0)
    np.testing.assert_array_equal(kept[:, :, 2:5], 0)
    assert np.all(np.linalg.eigvalsh(kept[:, [0, 1, 5]][:, :, [0, 1, 5]]) > 0)
    assert pose_errors(level, pose)[level.valid, 0].min() < 0.2


@jax.jit
def projected(rig, markers, planar):
    T_vehicle_world = worlds.T_world_vehicle_from_planar(planar).inverse()
    return rig.project(T_vehicle_world, markers.corners_world_m)


@pytest.mark.parametrize("pose", GROUND_VIEWS)
def test_on_the_ground_the_minimum_is_scipy_s(pose):
    """Pose, cost and covariance of (x, y, psi) by least squares on the projected pixels."""
    sigma_px = 0.5
    rig, markers, obs = view(worlds.paper_markers(), pose, sigma_px, seed=2)
    level = find(rig, markers, obs, sigma_px, ground_plane=True)
    shown = np.asarray(obs.visible)[:, :, None, None]

    for index in np.flatnonzero(level.valid):
        T = np.linalg.inv(matrix(level.T_vehicle_world.wxyz_xyz[index]))
        found = np.array([*T[:2, 3], np.arctan2(T[1, 0], T[0, 0])])
        solution = scipy.optimize.least_squares(
            lambda x: np.where(shown, projected(rig, markers, x) - obs.corners_px, 0).ravel()
            / sigma_px,
            found + 0.01, jac="3-point", method="lm", xtol=1e-15, ftol=1e-15, gtol=1e-15,
        )  # fmt: skip
        np.testing.assert_allclose(found, solution.x, atol=1e-5)
        assert level.cost[index] == pytest.approx(2 * solution.cost, rel=1e-6)
        # xi is in the vehicle's axes.
        c, s = np.cos(found[2]), np.sin(found[2])
        to_world = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        covariance = np.asarray(level.covariance)[index][np.ix_([0, 1, 5], [0, 1, 5])]
        expected = np.linalg.inv(solution.jac.T @ solution.jac)
        sigma = np.sqrt(np.diagonal(expected))
        scale = np.outer(sigma, sigma)
        # A weak prior bounds the estimator's covariance.
        np.testing.assert_allclose(
            to_world @ covariance @ to_world.T / scale, expected / scale, atol=0.02
        )


@pytest.fixture(scope="module")
def navigator() -> Navigator:
    markers = worlds.marker_map(
        [(worlds.upright(-np.pi / 2), [x_m, 1.47, 0.226]) for x_m in (-0.5, 0.0, 0.5)], [0.172] * 3
    )
    return Navigator(worlds.qcar_rig(), markers, corner_sigma_px=0.3)


@pytest.fixture(scope="module")
def told():
    @jax.jit
    def told(navigator, obs):
        snapshot = navigator.snapshot(obs)
        found = remove_outliers(snapshot, navigator.find_candidates, navigator.no_candidates())
        return snapshot, found, own_errors_px(snapshot, both_poses(snapshot))

    return lambda *given: jax.device_get(told(*given))


def seen(navigator: Navigator, moved: dict[int, tuple] | None = None, seed=0) -> Observation:
    """From before the middle marker, some of them elsewhere than the map says."""
    Ts = np.array(navigator.markers.Ts_world_marker.wxyz_xyz)
    for index, by_m in (moved or {}).items():
        Ts[index, 4:] += by_m
    true = eqx.tree_at(lambda m: m.Ts_world_marker.wxyz_xyz, navigator.markers, jnp.asarray(Ts))
    shape = (4, 3, 4, 2)
    noise_px = jnp.asarray(0.3 * np.random.default_rng(seed).standard_normal(shape))
    obs = worlds.observe(navigator.rig, true, worlds.planar(*worlds.FRONT_VIEW), noise_px)
    sigma_px = jnp.full(shape[:3], 0.3, float)
    return eqx.tree_at(
        lambda o: o.corner_sigma_px, obs, sigma_px, is_leaf=lambda leaf: leaf is None
    )


def markers_in_view(found) -> set[int]:
    sightings = found.snapshot.seen
    return set(np.asarray(sightings.marker_index)[np.asarray(sightings.visible)].tolist())


def test_what_agrees_stays_bit_for_bit(navigator, told):
    for seed in range(3):
        snapshot, found, _ = told(navigator, seen(navigator, seed=seed))
        assert markers_in_view(found) == {0, 1, 2}
        assert not found.outvoted.any()
        np.testing.assert_array_equal(found.snapshot.seen.visible, snapshot.seen.visible)
        assert np.all(found.candidates.valid[0])


@pytest.mark.parametrize("by_m", [(0.3, 0.0, 0.0), (0.0, -0.5, 0.0), (0.1, 0.1, 0.05)])
def test_one_that_was_moved_is_outvoted_and_the_pose_is_the_others(navigator, told, by_m):
    for index in range(3):
        _, found, _ = told(navigator, seen(navigator, {index: by_m}))
        np.testing.assert_array_equal(np.flatnonzero(found.outvoted), [index])
        assert markers_in_view(found) == {0, 1, 2} - {index}
        best = found.candidates.T_vehicle_world.wxyz_xyz[np.argmin(found.candidates.cost)]
        at_m = np.linalg.inv(matrix(best))[:2, 3]
        assert np.hypot(*(at_m - worlds.FRONT_VIEW[:2])) < 0.05


def test_two_that_were_moved_apart_leave_nobody_to_decide(navigator, told):
    _, found, _ = told(navigator, seen(navigator, {0: (0.4, 0.0, 0.0), 2: (0.0, -0.6, 0.0)}))
    assert not found.outvoted.any()
    assert markers_in_view(found) == {0, 1, 2}


def test_corners_at_random_places_are_hardly_ever_a_marker(navigator, told):
    obs, rng, kept = seen(navigator), np.random.default_rng(1), 0
    for _ in range(40):
        corners_px = jnp.asarray(rng.uniform([0, 0], [820, 410], obs.corners_px.shape))
        _, found, _ = told(navigator, eqx.tree_at(lambda o: o.corners_px, obs, corners_px))
        kept += int(np.sum(found.snapshot.seen.visible))
    assert kept <= 0.08 * 40 * int(np.sum(obs.visible))


def test_one_that_makes_no_sense_does_not_touch_the_others(navigator, told):
    obs = seen(navigator)
    crossed = np.array(obs.corners_px)
    crossed[:, 1] = crossed[:, 1][:, [0, 2, 1, 3]]
    crossed = jnp.asarray(crossed)
    _, found, errors_px = told(navigator, eqx.tree_at(lambda o: o.corners_px, obs, crossed))
    assert markers_in_view(found) == {0, 2}
    assert not found.outvoted.any()
    sound = np.asarray(found.snapshot.seen.visible)
    assert np.asarray(errors_px)[sound].max() < 1.0
