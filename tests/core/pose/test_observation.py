"""Which sightings count, and which parts of a broken observation are kept."""

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


def test_every_lane_has_its_slot(room):
    rig, markers, obs = room
    seen = sightings(rig, markers, obs.corners_px, obs.visible)
    assert seen.visible.shape == (16,)
    np.testing.assert_array_equal(seen.visible.reshape(4, 4), obs.visible)
    for slot in np.flatnonzero(seen.visible):
        lane = (int(seen.camera_index[slot]), int(seen.marker_index[slot]))
        np.testing.assert_array_equal(seen.corners_px[slot], obs.corners_px[lane])


def test_few_slots_keep_the_largest_images(room):
    rig, markers, obs = room
    areas = np.where(obs.visible, image_areas(obs.corners_px), -1).ravel()
    for count in (1, 3, 8):
        seen = sightings(rig, markers, obs.corners_px, obs.visible, 1.0, count)
        kept = np.asarray(seen.camera_index) * 4 + np.asarray(seen.marker_index)
        np.testing.assert_array_equal(kept[seen.visible], np.argsort(-areas)[:count][seen.visible])
        assert np.sum(seen.visible) == min(count, np.sum(obs.visible))


@pytest.mark.parametrize(("count", "slots"), [(1, 2), (4, 8), (9, 16)])
def test_two_views_of_every_marker_have_a_slot_and_sixteen_at_most(count, slots):
    rig = worlds.qcar_rig()
    markers = worlds.marker_map(
        [(worlds.upright(0.3 * k), [1.0, 0.2 * k, 0.2]) for k in range(count)], [0.172] * count
    )
    obs = Observation(jnp.zeros((len(rig), count, 4, 2)), jnp.zeros((len(rig), count), bool))
    assert Snapshot.create(rig, markers, obs).seen.visible.shape == (slots,)
    assert Snapshot.create(rig, markers, obs, max_sightings=3).seen.visible.shape == (3,)


def test_hidden_lanes_are_finite_whatever_they_held(room):
    rig, markers, obs = room
    for filler in (np.nan, np.inf, 0.0, 1e30):
        corners = jnp.where(obs.visible[:, :, None, None], obs.corners_px, filler)
        for count in (16, 4):
            seen = sightings(rig, markers, corners, obs.visible, 1.0, count)
            clean = sightings(rig, markers, obs.corners_px, obs.visible, 1.0, count)
            np.testing.assert_array_equal(seen.corners_px, clean.corners_px)
            assert np.all(np.isfinite(seen.corners_px))


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf])
def test_a_lane_with_a_broken_corner_is_not_visible(room, broken):
    rig, markers, obs = room
    corners = obs.corners_px.at[0, 0, 2, 1].set(broken)
    seen = sightings(rig, markers, corners, obs.visible)
    assert not seen.visible[0]
    assert np.sum(seen.visible) == np.sum(obs.visible) - 1
    assert np.all(np.isfinite(seen.corners_px))
    assert not Observation(corners, obs.visible).usable().visible[0, 0]


@pytest.mark.parametrize("broken", [np.nan, np.inf, 0.0, -1.0])
def test_a_lane_without_a_positive_sigma_is_not_visible(room, broken):
    rig, markers, obs = room
    sigma = jnp.full((4, 4, 4), 0.3).at[0, 1, 3].set(broken)
    seen = sightings(rig, markers, obs.corners_px, obs.visible, sigma)
    assert not seen.visible[1]
    assert np.sum(seen.visible) == np.sum(obs.visible) - 1
    assert np.all(seen.sigma_px > 0)


@pytest.mark.parametrize("broken", [np.nan, np.inf, -np.inf, 1e30])
def test_broken_odometry_is_no_odometry(room, broken):
    *_, obs = room
    good = {"speed_mps": jnp.asarray(0.4), "steering_rad": jnp.asarray(0.1)}
    usable = Observation(obs.corners_px, obs.visible, **good, dt_s=0.1).usable()
    assert usable.has_odometry
    assert (usable.speed_mps, usable.steering_rad, usable.dt_s) == (0.4, 0.1, 0.1)
    for key in good:
        reading = good | {key: jnp.asarray(broken)}
        usable = Observation(obs.corners_px, obs.visible, **reading).usable()
        assert not usable.has_odometry
        assert np.isfinite(usable.speed_mps)
        assert np.isfinite(usable.steering_rad)
    for dt_s in (broken, -0.1):
        assert Observation(obs.corners_px, obs.visible, dt_s=dt_s).usable().dt_s == 0


def test_wrong_shapes_are_told(room):
    rig, markers, obs = room
    with pytest.raises(ValueError, match=r"C, M = \(4, 4\) expected, got \(3, 4, 4, 2\)"):
        sightings(rig, markers, obs.corners_px[:3], obs.visible[:3])
