"""The selectors: what they compare, what they pick, what they say of the doubt."""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.ambiguity import LowestReprojection, PaperCost, PoseBelief, Selector
from jaxnav.candidates import Candidates, find_candidates
from jaxnav.observation import Observation
from tests import worlds
from tests.reference import paper

SELECTORS = [LowestReprojection(), PaperCost(), PaperCost(length_unit_m=1.0)]
TRUTH = worlds.START_VIEW
find = jax.jit(find_candidates)


def belief(T_world_vehicle: jaxlie.SE3, initialised: bool = True) -> PoseBelief:
    return PoseBelief(
        T_world_vehicle=jaxlie.SE3(T_world_vehicle.wxyz_xyz[None]),
        covariance=1e-4 * jnp.eye(6)[None],
        log_weight=jnp.zeros(1),
        initialised=jnp.asarray([initialised]),
    )


def candidates_at(poses, e1_px2, valid=None) -> Candidates:
    """Candidates as given, sigma 1 px."""
    count = len(poses)
    return Candidates(
        T_vehicle_world=jaxlie.SE3(
            jnp.stack([worlds.planar(*pose).inverse().wxyz_xyz for pose in poses])
        ),
        e1_px2=jnp.asarray(e1_px2, float),
        cost=jnp.asarray(e1_px2, float),
        covariance=jnp.broadcast_to(jnp.eye(6), (count, 6, 6)),
        valid=jnp.ones(count, bool) if valid is None else jnp.asarray(valid),
        converged=jnp.ones(count, bool),
        steps=jnp.ones(count, int),
    )


def seen_from(pose) -> Observation:
    return worlds.observe(worlds.qcar_rig(), worlds.paper_markers(), worlds.planar(*pose))


@pytest.mark.parametrize("selector", SELECTORS, ids=repr)
class TestEverySelector:
    """The contract of a selector."""

    def test_is_one(self, selector):
        assert isinstance(selector, Selector)

    def test_gives_all_to_one_valid_candidate(self, selector):
        poses = [TRUTH, (1.0, -1.5, 1.0), (0.5, 0.0, 0.5)]
        candidates = candidates_at(poses, [1.0, 2.0, 3.0], [False, True, True])
        selection = selector(
            belief(worlds.planar(*TRUTH)), candidates, seen_from(TRUTH), worlds.paper_markers()
        )
        assert selection.weights.tolist() == [[0, 1, 0]]
        assert int(selection.selected) == 1
        assert selection.costs[0] == np.inf
        assert np.all(np.isfinite(selection.costs[1:]))
        assert 0 <= selection.flip_probability <= 1

    @pytest.mark.parametrize("initialised", [False, True])
    def test_selects_nothing_where_nothing_is_valid(self, selector, initialised):
        candidates = candidates_at([TRUTH, TRUTH], [0.0, 0.0], [False, False])
        selection = selector(
            belief(worlds.planar(*TRUTH), initialised),
            candidates,
            seen_from(worlds.NO_VIEW),
            worlds.paper_markers(),
        )
        assert int(selection.selected) == -1
        assert not np.any(selection.weights)
        assert selection.flip_probability == 0

    def test_knows_its_doubt(self, selector):
        """Equal poses, so equal e2: the doubt is that of two Gaussians."""
        for excess in (0.0, 1.0, 50.0):
            candidates = candidates_at([TRUTH, TRUTH], [3.0, 3.0 + excess])
            selection = selector(
                belief(worlds.planar(*TRUTH)), candidates, seen_from(TRUTH), worlds.paper_markers()
            )
            expected = 1 / (1 + np.exp(excess / 2))
            assert selection.flip_probability == pytest.approx(expected, abs=1e-12)

    def test_is_differentiable_and_vmaps(self, selector):
        candidates = candidates_at([TRUTH, (1.0, -1.5, 1.0)], [1.0, 2.0])
        obs, markers = seen_from(TRUTH), worlds.paper_markers()

        def loss(poses):
            at = eqx.tree_at(
                lambda c: c.T_vehicle_world,
                candidates,
                jax.vmap(lambda T: T.inverse())(jaxlie.SE3(poses)),
            )
            selection = selector(belief(worlds.planar(*TRUTH)), at, obs, markers)
            return jnp.sum(selection.costs) + selection.flip_probability

        poses = jax.vmap(lambda T: T.inverse())(candidates.T_vehicle_world).wxyz_xyz
        slopes = jax.jit(jax.vmap(jax.grad(loss)))(jnp.stack([poses, poses]))
        assert np.all(np.isfinite(slopes))


def test_paper_cost_is_equations_13_and_14():
    markers, obs = (
        worlds.room_markers(),
        worlds.observe(worlds.qcar_rig(), worlds.room_markers(), worlds.planar(0.2, 0.1, 0.6)),
    )
    prior = worlds.planar(0.25, 0.05, 0.7)
    candidates = candidates_at([(0.2, 0.1, 0.6), (0.5, -0.2, 0.1)], [4.0, 3.0])
    selection = PaperCost()(belief(prior), candidates, obs, markers)
    in_view = np.any(np.asarray(obs.visible), axis=0)
    for index, e1_px2 in enumerate((4.0, 3.0)):
        metres = paper.e2(
            np.asarray(markers.corners_world_m),
            in_view,
            np.asarray(candidates.T_vehicle_world.as_matrix())[index],
            np.asarray(prior.inverse().as_matrix()),
        )
        assert selection.costs[index] == pytest.approx(e1_px2 + 100**2 * metres, rel=1e-11)
    assert int(selection.selected) == 0


def test_before_the_first_pose_e_is_e1():
    candidates = candidates_at([TRUTH, (1.0, -1.5, 1.0)], [2.0, 1.0])
    arguments = (candidates, seen_from(TRUTH), worlds.paper_markers())
    unaware = PaperCost()(belief(worlds.planar(*TRUTH), initialised=False), *arguments)
    np.testing.assert_array_equal(unaware.costs, [2.0, 1.0])
    assert int(unaware.selected) == 1
    assert int(PaperCost()(belief(worlds.planar(*TRUTH)), *arguments).selected) == 0


@pytest.fixture(scope="module")
def ambiguous():
    """Real candidates at the paper's start, noise 1 px, of which the mirror pose has the lower e1,
    and by the most of 40 draws."""
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    truth = worlds.planar(*TRUTH)
    worst = None
    for seed in range(40):
        noise = np.random.default_rng(seed).standard_normal((4, 1, 4, 2))
        obs = worlds.observe(rig, markers, truth, jnp.asarray(noise))
        candidates = find(rig, markers, obs)
        if int(np.sum(candidates.valid)) != 2:
            continue
        R = np.asarray(candidates.T_vehicle_world.inverse().rotation().as_matrix())[:2]
        off = worlds.rotation_angles_rad(R, np.asarray(truth.rotation().as_matrix()))
        margin = float(candidates.e1_px2[1] - candidates.e1_px2[0])
        if off[1] < off[0] and (worst is None or margin > worst[0]):
            worst = (margin, candidates, obs, markers)
    assert worst is not None
    return worst


def test_the_unit_of_length_decides(ambiguous):
    """In centimetres the prediction outweighs the image's error, in metres it hardly counts and
    the rule is the lowest reprojection error (DESIGN 3.1)."""
    margin, *arguments = ambiguous
    assert margin > 0.3
    prior = belief(worlds.planar(TRUTH[0] + 0.05, TRUTH[1] - 0.05, TRUTH[2] + 0.05))
    lowest = LowestReprojection()(prior, *arguments)
    centimetres = PaperCost()(prior, *arguments)
    metres = PaperCost(length_unit_m=1.0)(prior, *arguments)
    assert int(lowest.selected) == 0
    assert int(centimetres.selected) == 1
    assert int(metres.selected) == 0
    np.testing.assert_allclose(metres.costs[:2], lowest.costs[:2], atol=1.0)
    assert centimetres.costs[0] - centimetres.costs[1] > 100


def test_a_misled_prediction_misleads_the_paper_s_rule(ambiguous):
    """DESIGN 3.7: near the mirror pose the rule defends it."""
    _, candidates, obs, markers = ambiguous
    mirror = jaxlie.SE3(candidates.T_vehicle_world.wxyz_xyz[0]).inverse()
    assert int(PaperCost()(belief(mirror), candidates, obs, markers).selected) == 0
