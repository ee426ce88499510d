"""Which sightings count, and which parts of a broken observation are kept."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.pose.observation import Observation, Snapshot, sightings
from tests import worlds

VIEW = (0.2, 0.1, 0.6)


@pytest.fixture(scope="module")
def room():
    rig, markers = worlds.qcar_rig(), worlds.room_markers()
    return rig, markers, worlds.observe(rig, markers, worlds.planar(*VIEW))


def image_areas(corners_px):
    x, y = np.asarray(corners_px)[..., 0], np.asarray(corners_px)[..., 1]
    return np.abs(np.sum(x * np.roll(y, -1, -1) - y * np.roll(x, -1, -1), axis=-1)) / 2


@functools.partial(jax.jit, static_argnames="count")
def slots_of(room, corners_px, visible, sigma_px=1.0, count=16):
    return sightings(*room[:2], corners_px, visible, sigma_px, count)


usable = jax.jit(Observation.usable)


def test_every_lane_has_its_slot(room):
    obs = room[2]
    seen = slots_of(room, obs.corners_px, obs.visible)
    assert seen.visible.shape == (16,)
    np.testing.assert_array_equal(seen.visible.reshape(4, 4), obs.visible)
    lanes = np.asarray(seen.camera_index), np.asarray(seen.marker_index)
    shown = np.asarray(seen.visible)
    expected = np.asarray(obs.corners_px)[lanes]
    np.testing.assert_array_equal(np.asarray(seen.corners_px)[shown], expected[shown])


def test_few_slots_keep_the_largest_images(room):
    obs = room[2]
    areas = np.where(obs.visible, image_areas(obs.corners_px), -1).ravel()
    for count in (1, 3):
        seen = slots_of(room, obs.corners_px, obs.visible, count=count)
        kept = np.asarray(seen.camera_index) * 4 + np.asarray(seen.marker_index)
        shown = np.asarray(seen.visible)
        np.testing.assert_array_equal(kept[shown], np.argsort(-areas)[:count][shown])
        assert np.sum(shown) == min(count, np.sum(obs.visible))


def test_two_views_of_every_marker_have_a_slot_and_sixteen_at_most():
    rig = worlds.qcar_rig()
    for count, slots in ((1, 2), (4, 8), (9, 16)):
        markers = worlds.marker_map([(np.eye(3), [1.0, 0.2 * k, 0.2]) for k in range(count)],
                                    [0.172] * count)  # fmt: skip
        lanes = len(rig), count
        obs = Observation(jnp.zeros((*lanes, 4, 2)), jnp.zeros(lanes, bool))
        for most, expected in ((None, slots), (3, min(3, 4 * count))):
            create = functools.partial(Snapshot.create, max_sightings=most)
            assert jax.eval_shape(create, rig, markers, obs).seen.visible.shape == (expected,)


def test_hidden_lanes_are_finite_whatever_they_held(room):
    obs = room[2]
    hidden = ~np.asarray(obs.visible)
    for count in (16, 3):
        clean = slots_of(room, obs.corners_px, obs.visible, count=count)
        for filler in (np.nan, np.inf, 0.0, 1e30):
            corners = np.array(obs.corners_px)
            corners[hidden] = filler
            seen = slots_of(room, jnp.asarray(corners), obs.visible, count=count)
            np.testing.assert_array_equal(seen.corners_px, clean.corners_px)
            assert np.all(np.isfinite(seen.corners_px))


def test_a_lane_with_a_broken_corner_or_without_a_positive_sigma_is_not_visible(room):
    obs = room[2]
    cases = [(value, None) for value in (np.nan, np.inf, -np.inf)]
    cases += [(None, value) for value in (np.nan, np.inf, 0.0, -1.0)]
    for corner_px, sigma_px in cases:
        corners, sigmas = np.array(obs.corners_px), np.full((4, 4, 4), 0.3)
        if corner_px is None:
            sigmas[0, 1, 3] = sigma_px
        else:
            corners[0, 1, 2, 1] = corner_px
        corners, sigmas = jnp.asarray(corners), jnp.asarray(sigmas)
        seen = slots_of(room, corners, obs.visible, sigmas)
        assert not seen.visible[1], (corner_px, sigma_px)
        assert np.sum(seen.visible) == np.sum(obs.visible) - 1
        assert np.all(np.isfinite(seen.corners_px))
        assert np.all(np.asarray(seen.sigma_px) > 0)
        whole = usable(Observation(corners, obs.visible)).visible
        assert bool(whole[0, 1]) == (corner_px is None)


def test_broken_odometry_is_no_odometry(room):
    obs = room[2]

    def told(**reading):
        numbers = {"speed_mps": 0.4, "steering_rad": 0.1, "dt_s": 0.1} | reading
        numbers = {name: jnp.asarray(value) for name, value in numbers.items()}
        return usable(Observation(obs.corners_px, obs.visible, **numbers))

    good = told()
    assert good.has_odometry
    assert (good.speed_mps, good.steering_rad, good.dt_s) == (0.4, 0.1, 0.1)
    for broken in (np.nan, np.inf, -np.inf, 1e30):
        for key in ("speed_mps", "steering_rad"):
            found = told(**{key: broken})
            assert not found.has_odometry, (key, broken)
            assert np.isfinite(found.speed_mps)
            assert np.isfinite(found.steering_rad)
        assert told(dt_s=broken).dt_s == 0
    assert told(dt_s=-0.1).dt_s == 0


def test_wrong_shapes_are_told(room):
    rig, markers, obs = room
    with pytest.raises(ValueError, match=r"C, M = \(4, 4\) expected, got \(3, 4, 4, 2\)"):
        sightings(rig, markers, obs.corners_px[:3], obs.visible[:3])
