"""The fixed-lag smoother of `Navigator(lag_s=...)` against a pass back from the end."""

from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.smooth import Trail
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from tests import worlds
from tests.helpers.filters import sense

BANK = pytest.param(MultiHypothesis(hypotheses=8), marks=pytest.mark.long)
FRAMES, DT_S, LAG_S, SIGMA_PX = 24, 0.1, 0.8, 0.2


@pytest.fixture(scope="module", params=[LowestReprojection(), BANK], ids=["rule", "bank"])
def navigator(request) -> Callable[..., Navigator]:
    def made(**further):
        return Navigator(
            worlds.qcar_rig(),
            worlds.paper_markers(),
            motion=ConstantVelocity(),
            selector=request.param,
            corner_sigma_px=SIGMA_PX,
            **further,
        )

    return made


@pytest.fixture(scope="module")
def drive() -> tuple[Observation, np.ndarray]:
    """A rig that passes a marker, seen in all frames but three, and its true positions."""
    rng, rig, markers = np.random.default_rng(4), worlds.qcar_rig(), worlds.paper_markers()
    times_s = DT_S * np.arange(FRAMES)[:, None]
    poses = np.array([-0.3, -0.9, 1.4]) + times_s * [0.5, 0.1, 0.2]
    noise_px = SIGMA_PX * rng.normal(size=(FRAMES, 4, 1, 4, 2))
    obs = sense(rig, markers, jnp.asarray(poses), jnp.asarray(noise_px), 0.0, 0.0, DT_S)
    shown = np.asarray(obs.visible) & ~np.isin(np.arange(FRAMES), (10, 11, 12))[:, None, None]
    obs = eqx.tree_at(lambda o: o.visible, obs, jnp.asarray(shown))
    return obs, np.column_stack([poses[:, :2], np.zeros(FRAMES)])


begin, back = jax.jit(Trail.begin), jax.jit(Trail.back)


@jax.jit
def run(navigator, obs):
    """The beliefs and outputs of all frames."""

    def step(state, obs):
        state, out = navigator.step(state, obs)
        return state, (state.belief, out)

    return jax.lax.scan(step, navigator.init(), obs)[1]


@pytest.fixture(scope="module")
def filtered(navigator, drive):
    return jax.device_get(run(navigator(), drive[0]))


@pytest.fixture(scope="module")
def lagged(navigator, drive):
    return jax.device_get(run(navigator(lag_s=LAG_S, lag_observations=16), drive[0]))


@pytest.mark.long
def test_a_lag_leaves_the_filter_as_it_is(filtered, lagged):
    (belief, out), (same, also) = filtered, lagged
    assert out.lagged is None
    assert also.lagged is not None
    also = eqx.tree_at(lambda o: o.lagged, also, None)
    for one, other in zip(
        jax.tree.leaves((belief, out)), jax.tree.leaves((same, also)), strict=True
    ):
        np.testing.assert_array_equal(one, other)


def test_a_lagged_pose_is_that_of_a_pass_back_from_the_present(navigator, drive, lagged):
    """From every fifth frame back, over the three in which no marker is seen as well."""
    motion, (obs, _), (belief, out) = navigator().motion, drive, lagged
    at = lambda tree, frame: jax.tree.map(lambda leaf: leaf[frame], tree)  # noqa: E731
    for last in range(4, FRAMES, 5):
        trail = begin(at(belief.bank, last), belief.decided[last])
        steps = min(last, int(LAG_S / DT_S + 0.5))
        for frame in range(last, last - steps, -1):
            bank = at(belief.bank, frame - 1)
            parent = belief.bank.parent[frame]
            trail = back(trail, motion, bank, belief.decided[frame - 1], parent, at(obs, frame))
        found = at(out.lagged, last)
        assert float(found.age_s) == pytest.approx(steps * DT_S)
        np.testing.assert_allclose(found.T_world_vehicle.wxyz_xyz, trail.mean[:7], atol=1e-9)
        np.testing.assert_allclose(found.covariance, trail.covariance, atol=1e-9)


def test_a_lagged_pose_is_nearer_to_the_truth_and_says_so(drive, lagged):
    (_, truth), (_, out) = drive, lagged
    steps = int(LAG_S / DT_S + 0.5)
    then, now = slice(0, FRAMES - steps), slice(steps, FRAMES)
    filtered_m = np.linalg.norm(out.T_world_vehicle.wxyz_xyz[then, 4:] - truth[then], axis=1)
    lagged_m = np.linalg.norm(out.lagged.T_world_vehicle.wxyz_xyz[now, 4:] - truth[then], axis=1)
    assert np.sqrt(np.mean(lagged_m**2)) < 0.8 * np.sqrt(np.mean(filtered_m**2))
    trace = [
        np.trace(P[:, :3, :3], axis1=1, axis2=2) for P in (out.covariance, out.lagged.covariance)
    ]
    assert np.all(trace[1][now] <= trace[0][then] * (1 + 1e-9))


@pytest.mark.parametrize("lag", [{"lag_s": -1.0}, {"lag_s": float("nan")}, {"lag_observations": 0}])
def test_a_lag_is_a_time_and_some_observations(navigator, lag):
    with pytest.raises(ValueError, match="no lag"):
        navigator(**lag)
