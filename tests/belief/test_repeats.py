"""Repeated sightings against the variance of a mean of correlated errors."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.belief.repeats import RepeatedErrors, Repeats
from jaxnav.pose.observation import Snapshot
from tests import worlds
from tests.derivatives import in_float32

SIGMA_PX, SHARE = 0.5, 0.3
MODEL = RepeatedErrors(share=SHARE, renewal_px=40.0)


def snapshot(shift_px=0.0, visible=True) -> Snapshot:
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    obs = worlds.observe(rig, markers, worlds.planar(*worlds.FRONT_VIEW))
    obs = dataclasses.replace(
        obs,
        corners_px=obs.corners_px + jnp.asarray([shift_px, 0.0]).reshape(1, 1, 1, 2),
        visible=obs.visible & visible,
    )
    return Snapshot.create(rig, markers, obs, SIGMA_PX)


def nothing() -> Repeats:
    return Repeats.none(worlds.qcar_rig(), worlds.paper_markers())


@jax.jit
def weigh(repeats, shot):
    weighed, after = MODEL.weighed(repeats, shot)
    seen = weighed.seen
    return jnp.max(jnp.where(seen.visible, seen.sigma_px[:, 0], 0)), after


def test_a_parked_car_s_sightings_add_up_to_the_mean_of_correlated_errors():
    """Their weights 1 / sigma_n^2 sum to the inverse variance of the mean of n equal-correlated
    errors, 1 / (sigma^2 ((1 - s) / n + s))."""
    repeats, weights = nothing(), []
    for n in range(1, 31):
        sigma_px, repeats = weigh(repeats, snapshot())
        weights.append(float(sigma_px) ** -2)
        covariance = SIGMA_PX**2 * ((1 - SHARE) * np.eye(n) + SHARE)
        information = np.ones(n) @ np.linalg.solve(covariance, np.ones(n))
        assert sum(weights) == pytest.approx(information, rel=1e-9)
    assert weights[0] == pytest.approx(SIGMA_PX**-2)
    assert sum(weights) < 1 / (SHARE * SIGMA_PX**2)


def test_what_has_moved_counts_anew():
    _, repeats = weigh(nothing(), snapshot())
    near, far = (float(weigh(repeats, snapshot(shift))[0]) for shift in (4.0, 400.0))
    assert far == pytest.approx(SIGMA_PX, rel=1e-4)
    n = np.exp(-4.0 / 40.0)
    growth = (1 - SHARE + (n + 1) * SHARE) * (1 - SHARE + n * SHARE) / (1 - SHARE)
    assert near == pytest.approx(SIGMA_PX * np.sqrt(growth))


def test_a_pause_changes_nothing():
    """The errors of the last sighting are those of the next at the same place."""
    _, seen = weigh(nothing(), snapshot())
    _, after = weigh(seen, snapshot(visible=False))
    np.testing.assert_array_equal(after.count, seen.count)
    np.testing.assert_array_equal(after.corners_px, seen.corners_px)


def test_white_errors_are_told_by_a_share_of_nothing():
    repeats = nothing()
    for _ in range(5):
        weighed, repeats = RepeatedErrors(share=0.0).weighed(repeats, snapshot())
        np.testing.assert_allclose(weighed.seen.sigma_px, snapshot().seen.sigma_px, rtol=1e-12)


def test_derivatives_are_finite_where_nothing_moves():
    def sigma(shift_px, share):
        model = eqx.tree_at(lambda m: m.share, MODEL, share)
        _, repeats = model.weighed(nothing(), snapshot())
        return jnp.sum(model.weighed(repeats, snapshot(shift_px))[0].seen.sigma_px)

    for at in ((0.0, 0.1), (3.0, 0.5)):
        slopes = jax.grad(sigma, argnums=(0, 1))(*map(jnp.asarray, at))
        assert np.all(np.isfinite(slopes))
    assert float(slopes[1]) > 0


@in_float32
def test_it_works_in_float32(precision):
    weighed, after = MODEL.weighed(nothing(), snapshot())
    assert after.count.dtype == precision
    assert weighed.seen.sigma_px.dtype == precision
