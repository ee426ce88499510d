"""Sightings that are no marker, or that others outvote, are left out; the rest is unchanged."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.candidates import both_poses, own_errors_px, remove_outliers
from jaxnav.core.pose.observation import Observation
from tests import worlds


@pytest.fixture(scope="module")
def navigator() -> Navigator:
    markers = worlds.marker_map(
        [(worlds.upright(-np.pi / 2), [x_m, 1.47, 0.226]) for x_m in (-0.5, 0.0, 0.5)],
        [0.172] * 3,
    )
    return Navigator(worlds.qcar_rig(), markers, corner_sigma_px=0.3)


@pytest.fixture(scope="module")
def told():
    @jax.jit
    def told(navigator, obs):
        snapshot = navigator.snapshot(obs)
        found = remove_outliers(snapshot, navigator.find_candidates, navigator.no_candidates())
        return snapshot, found, own_errors_px(snapshot, both_poses(snapshot))

    return told


def seen(navigator: Navigator, moved: dict[int, tuple] | None = None, seed=0) -> Observation:
    """From before the middle marker, some of them elsewhere than the map says."""
    Ts = np.array(navigator.markers.Ts_world_marker.wxyz_xyz)
    for index, by_m in (moved or {}).items():
        Ts[index, 4:] += by_m
    true = eqx.tree_at(lambda m: m.Ts_world_marker.wxyz_xyz, navigator.markers, jnp.asarray(Ts))
    shape = (4, 3, 4, 2)
    noise_px = jnp.asarray(0.3 * np.random.default_rng(seed).standard_normal(shape))
    obs = worlds.observe(navigator.rig, true, worlds.planar(*worlds.FRONT_VIEW), noise_px)
    sigma_px = jnp.full(shape[:3], 0.3)
    return eqx.tree_at(
        lambda o: o.corner_sigma_px, obs, sigma_px, is_leaf=lambda leaf: leaf is None
    )


def markers_in_view(found) -> set[int]:
    sightings = found.snapshot.seen
    return set(np.asarray(sightings.marker_index)[np.asarray(sightings.visible)].tolist())


@pytest.mark.parametrize("seed", range(3))
def test_what_agrees_stays_bit_for_bit(navigator, told, seed):
    snapshot, found, _ = told(navigator, seen(navigator, seed=seed))
    assert markers_in_view(found) == {0, 1, 2}
    assert not found.outvoted.any()
    np.testing.assert_array_equal(found.snapshot.seen.visible, snapshot.seen.visible)
    np.testing.assert_array_equal(
        found.candidates.cost, jax.jit(navigator.find_candidates)(snapshot).cost
    )


@pytest.mark.parametrize("index", range(3))
@pytest.mark.parametrize("by_m", [(0.3, 0.0, 0.0), (0.0, -0.5, 0.0), (0.1, 0.1, 0.05)])
def test_one_that_was_moved_is_outvoted_and_the_pose_is_the_others(navigator, told, index, by_m):
    _, found, _ = told(navigator, seen(navigator, {index: by_m}))
    np.testing.assert_array_equal(np.flatnonzero(found.outvoted), [index])
    assert markers_in_view(found) == {0, 1, 2} - {index}
    T = found.candidates.T_vehicle_world.wxyz_xyz[np.argmin(found.candidates.cost)]
    at_m = np.asarray(worlds.jaxlie.SE3(T).inverse().translation())[:2]
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
    crossed = obs.corners_px.at[:, 1].set(obs.corners_px[:, 1, jnp.array([0, 2, 1, 3])])
    _, found, errors_px = told(navigator, eqx.tree_at(lambda o: o.corners_px, obs, crossed))
    assert markers_in_view(found) == {0, 2}
    assert not found.outvoted.any()
    sound = np.asarray(found.snapshot.seen.visible)
    assert np.asarray(errors_px)[sound].max() < 1.0
