"""Several markers on one wall, solved together, form one larger plane, and still flip.

A single frame's flip probability must be right for joint solves as it is for single markers.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.filter.choose import LowestReprojection, judge_branch
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.candidates import find_candidates
from jaxnav.core.pose.observation import Snapshot
from jaxnav.sim.statistics import Reliability
from tests import worlds

FRAMES, FEW, NOISE_PX, SIZE_M = 4000, 500, 1.0, 0.12
RIG = worlds.qcar_rig()


def wall(lift_rad: float = 0.0):
    """Three small markers side by side at y = 1.5 m; the outer ones turned out of the plane."""
    return worlds.marker_map(
        [
            (worlds.upright(-np.pi / 2 + turn), [x, 1.5, 0.2])
            for x, turn in ((-0.16, -lift_rad), (0.0, 0.0), (0.16, lift_rad))
        ],
        [SIZE_M] * 3,
    )


def look(markers, key):
    """One random place some 3 m away; (probability, flipped, whether there were two poses)."""
    place, noise = jax.random.split(key)
    x, y, turn = jax.random.uniform(place, (3,), minval=-1.0, maxval=1.0)
    pose = jnp.stack([1.2 * x, -1.8 + 0.4 * y, jnp.pi / 2 + 0.6 * turn])
    T_world_vehicle = T_world_vehicle_from_planar(pose)
    noise_px = NOISE_PX * jax.random.normal(noise, (4, 3, 4, 2))
    obs = worlds.observe(RIG, markers, T_world_vehicle, noise_px)
    snapshot = Snapshot.create(RIG, markers, obs, NOISE_PX, max_sightings=6)
    candidates = find_candidates(snapshot, max_steps=20)
    navigator = Navigator(RIG, markers, worlds.qcar(), selector=LowestReprojection())
    prior = navigator.motion.poses(navigator.motion.init())
    selection = navigator.selector(prior, candidates, snapshot)
    branch = judge_branch(candidates, selection.selected, T_world_vehicle)
    return selection.flip_probability, branch.wrong, branch.ambiguous & ~branch.outlier


@pytest.fixture(scope="module")
def frames():
    keys = jax.random.split(jax.random.key(0), FRAMES)
    look_all = jax.jit(jax.vmap(look, in_axes=(None, 0)))

    @functools.cache
    def seen(lift_rad, count=FRAMES):
        markers = wall(lift_rad)
        parts = [look_all(markers, some) for some in keys[:count].reshape(-1, FEW)]
        return [np.concatenate(leaves) for leaves in zip(*parts, strict=True)]

    return seen


@pytest.mark.long
def test_a_wall_of_markers_flips_and_says_how_probably(frames):
    probability, flipped, pair = frames(0.0)
    assert np.mean(pair) > 0.1
    assert np.mean(flipped[pair]) > 0.1
    found = Reliability.from_predictions(probability[pair], flipped[pair], bins=10)
    assert found.expected_calibration_error < 0.07
    assert np.mean(probability[pair]) == pytest.approx(np.mean(flipped[pair]), rel=0.15)


@pytest.mark.long
def test_markers_that_do_not_share_a_plane_leave_little_doubt(frames):
    flat, _, _ = frames(0.0, FEW)
    bent, flipped, pair = frames(np.deg2rad(35.0), FEW)
    assert np.mean(bent) < 0.2 * np.mean(flat)
    assert np.mean(flipped & pair) < 0.005
