"""The selectors: their costs, their choices and their flip probabilities."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scipy.linalg

from jaxnav.core.filter.bank import PoseBelief
from jaxnav.core.filter.choose import (
    LowestReprojection,
    Mahalanobis,
    ObjectSpace,
    Oracle,
    OrientationGiven,
    PaperCost,
    RatioTest,
    Selection,
    Selector,
    Ungated,
    judge_branch,
    position_error_m,
)
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.pose.observation import Snapshot
from jaxnav.core.pose.refine import Candidates
from tests import worlds
from tests.derivatives import in_float32
from tests.helpers.filters import find, select, snap
from tests.reference import paper
from tests.reference.rigid import matrix, wxyz_xyz

BANK = MultiHypothesis(hypotheses=8)
SELECTORS = [
    LowestReprojection(),
    RatioTest(),
    ObjectSpace(),
    PaperCost(),
    Ungated(PaperCost()),
    Mahalanobis(),
    OrientationGiven(),
    Oracle(),
    BANK,
]


def but_long(*kinds: type) -> list:
    """All of them, of which `make test` leaves out some kinds."""
    marks = {True: pytest.mark.long, False: ()}
    return [pytest.param(rule, marks=marks[isinstance(rule, kinds)]) for rule in SELECTORS]


TRUTH = worlds.START_VIEW
FRONTAL = (0.0, -0.4, np.pi / 2)
VIEWS = {
    "one camera": TRUTH,
    "two cameras": worlds.OVERLAP_VIEW,
    "frontal": FRONTAL,
    "none": worlds.NO_VIEW,
}


@functools.partial(jax.jit, static_argnames="count")
def belief(T_world_vehicle: jaxlie.SE3, initialised: bool = True, count: int = 1) -> PoseBelief:
    """A car's prediction; more hypotheses than one fan out from the pose."""
    eye, fan = jnp.eye(6), jnp.linspace(0.0, 1.0, count)
    Ts = jax.vmap(
        lambda s: (T_world_vehicle @ jaxlie.SE3.exp(s * jnp.asarray([0.2, 0, 0, 0, 0, 1]))).wxyz_xyz
    )(fan)
    return PoseBelief(
        T_world_vehicle=jaxlie.SE3(Ts),
        covariance=jnp.tile(1e-4 * eye, (count, 1, 1)),
        log_weight=jnp.full(count, -np.log(count), float),
        initialised=jnp.full(count, initialised),
        freedom=eye[:, jnp.asarray([0, 1, 5])],
        nuisance=0.005 * eye[:, jnp.asarray([2, 3, 4])],
        gate_nis=jnp.inf,
    )


judge = jax.jit(judge_branch)
inverses = jax.jit(jax.vmap(lambda pose: worlds.T_world_vehicle_from_planar(pose).inverse()))


def candidates_at(poses, e1_px2, valid=None, covariance=None) -> Candidates:
    """Candidates as given, sigma 1 px, and as many more lanes as `find` has, none of them valid."""
    lanes = 4
    count, rest = len(poses), lanes - len(poses)
    covariance = np.broadcast_to(np.eye(6), (count, 6, 6)) if covariance is None else covariance
    covariance = np.concatenate([covariance, np.broadcast_to(np.eye(6), (rest, 6, 6))])
    e1_px2 = jnp.asarray(np.append(e1_px2, np.zeros(rest)), float)
    poses = np.array([*poses, *[TRUTH] * rest], float)
    return Candidates(
        T_vehicle_world=inverses(jnp.asarray(poses, float)),
        e1_px2=e1_px2,
        cost=e1_px2,
        covariance=jnp.asarray(covariance, float),
        valid=jnp.asarray([*([True] * count if valid is None else valid), *[False] * rest]),
        converged=jnp.asarray(np.ones(lanes, bool)),
        steps=jnp.asarray(np.ones(lanes, int)),
    )


def seen_from(pose, one_marker: bool = True, sigma_px: float = 0.0, **sensors) -> Snapshot:
    """What the car sees, and what other sensors may say of it."""
    view = _view(tuple(pose), one_marker, sigma_px, str(jnp.ones(()).dtype))
    obs = dataclasses.replace(view.obs, **sensors)
    return dataclasses.replace(view, obs=obs)


@functools.cache
def _view(pose, one_marker: bool, sigma_px: float, precision: str) -> Snapshot:
    """Made once in each precision."""
    del precision
    rig = worlds.qcar_rig()
    markers = worlds.paper_markers() if one_marker else worlds.room_markers()
    shape = (4, len(markers.ids), 4, 2)
    noise_px = sigma_px * np.random.default_rng(1).standard_normal(shape)
    T_world_vehicle = worlds.planar(*pose)
    obs = dataclasses.replace(
        worlds.observe(rig, markers, T_world_vehicle, jnp.asarray(noise_px)),
        heading_rad=jnp.asarray(pose[2], float),
        normals_camera=normals_at(rig, markers, pose),
        T_world_vehicle_true=T_world_vehicle,
    )
    return snap(rig, markers, obs)


def normals_at(rig, markers: MarkerMap, pose) -> jax.Array:
    """Unit normals (C, M, 3) of the markers in each camera: a loop over matrices."""
    T_vehicle_world = np.linalg.inv(matrix(worlds.planar(*pose).wxyz_xyz))
    Rs = [T[:3, :3] for T in matrix(rig.Ts_camera_vehicle.wxyz_xyz) @ T_vehicle_world]
    normals = matrix(markers.Ts_world_marker.wxyz_xyz)[:, :3, 2]
    return jnp.asarray([[R @ n for n in normals] for R in Rs], float)


def floats_of(tree) -> list[jax.Array]:
    return jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))


def check_selection(selection: Selection, selector: Selector, candidates: Candidates, precision):
    """Shapes, types, ranges and finite numbers, whatever was asked."""
    K, N = selector.hypotheses, candidates.valid.shape[0]
    measured = selection.measured
    assert (measured.innovation is None) == (K == 1)
    assert measured.T_world_vehicle.wxyz_xyz.shape == (K, 7)
    assert measured.covariance.shape == (K, 6, 6)
    if measured.innovation is not None:
        assert measured.innovation.shape == (K, 3)
    for mask in (measured.valid, selection.kept):
        assert mask.shape == (K,)
        assert mask.dtype == bool
    assert selection.log_weight.shape == selection.merged_into.shape == (K,)
    assert selection.costs.shape == (N,)
    assert selection.selected.shape == selection.flip_probability.shape == ()
    assert selection.decided.shape == ()
    assert selection.decided.dtype == bool
    floats = floats_of((measured, selection.log_weight, selection.flip_probability))
    for leaf in (*floats, selection.costs):
        assert leaf.dtype == precision
    # Masked lanes as well.
    assert all(np.all(np.isfinite(leaf)) for leaf in floats)
    np.testing.assert_array_equal(np.isfinite(selection.costs), candidates.valid)
    np.testing.assert_array_equal(np.isposinf(selection.costs), ~candidates.valid)
    assert np.all((selection.merged_into >= 0) & (selection.merged_into < K))
    assert -1 <= int(selection.selected) < N
    assert selection.selected == -1 or candidates.valid[selection.selected]
    assert 0 <= selection.flip_probability <= 1
    eigenvalues = np.linalg.eigvalsh(np.asarray(measured.covariance, float))
    assert np.all(eigenvalues > -1e-6 * np.max(eigenvalues, axis=1, keepdims=True))


@pytest.mark.parametrize("selector", but_long(Ungated), ids=repr)
class TestEverySelector:
    """The contract of a selector."""

    def test_says_what_a_selection_is(self, selector, precision):
        """In every view, before and after the start, in both precisions; a batch says what its
        members say, in one."""
        assert isinstance(selector, Selector)
        snapshots = [seen_from(pose, sigma_px=0.3) for pose in VIEWS.values()]
        found = [find(snapshot) for snapshot in snapshots]
        together = None
        for initialised in (False, True):
            prior = belief(worlds.planar(*TRUTH), initialised, selector.hypotheses)
            if precision == np.float64:
                batch = jax.tree.map(
                    lambda *leaves: np.stack(leaves), *zip(found, snapshots, strict=True)
                )
                together = jax.jit(jax.vmap(selector, in_axes=(None, 0, 0)))(prior, *batch)
            for index, name in enumerate(VIEWS):
                alone = select(selector, prior, found[index], snapshots[index])
                check_selection(alone, selector, found[index], precision)
                if name == "none":
                    assert int(alone.selected) == -1
                    assert not np.any(alone.measured.valid)
                    assert bool(alone.decided) <= initialised
                    np.testing.assert_array_equal(alone.kept, prior.initialised)
                    if selector.hypotheses == 1 or not initialised:
                        assert alone.flip_probability == 0
                elif not isinstance(selector, RatioTest):
                    assert int(alone.selected) >= 0
                    assert np.any(alone.measured.valid)
                if together is not None:
                    for one, leaf in zip(*map(jax.tree.leaves, (alone, together)), strict=True):
                        np.testing.assert_allclose(leaf[index], one, rtol=1e-9, atol=1e-9)

    def test_knows_one_valid_candidate_from_another(self, selector, precision):
        """The prediction, the other sensors and the image all speak for the second of three."""
        poses = [TRUTH, (1.0, -1.5, 1.0), (0.5, 0.0, 0.5)]
        candidates = candidates_at(poses, [1.0, 2.0, 300.0], [False, True, True])
        prior = belief(worlds.planar(*TRUTH), count=selector.hypotheses)
        selection = select(selector, prior, candidates, seen_from(TRUTH))
        check_selection(selection, selector, candidates, precision)
        assert int(selection.selected) == 1
        assert np.all(selection.measured.valid)
        if selector.hypotheses == 1:
            atol = 1e-6 if precision == np.float32 else 1e-12
            found = selection.measured.T_world_vehicle.wxyz_xyz[0]
            np.testing.assert_allclose(found, worlds.planar(*poses[1]).wxyz_xyz, atol=atol)
            np.testing.assert_array_equal(selection.measured.covariance[0], np.eye(6))
            np.testing.assert_array_equal(selection.kept, prior.initialised)
            np.testing.assert_array_equal(selection.log_weight, prior.log_weight)


# The bank's are those of a step, in test_hypotheses.py. What the long ones differentiate the
# paper's cost does too.
@pytest.mark.parametrize(
    "selector",
    but_long(LowestReprojection, RatioTest, ObjectSpace, Oracle, Ungated)[:-1],
    ids=repr,
)
@in_float32
def test_selections_have_finite_gradients(selector, precision):
    """Of all it says by all that goes in; frontally, with and without a prior, and blind."""
    first = seen_from(TRUTH)

    @jax.jit
    @jax.grad
    def slope(floats, masks, started):
        prior, candidates, corners_px = floats
        candidates = eqx.combine(candidates, masks[0])
        prior = eqx.tree_at(
            lambda p: p.initialised,
            belief(prior, True, selector.hypotheses),
            jnp.full(selector.hypotheses, started),
        )
        obs = dataclasses.replace(first.obs, corners_px=corners_px, visible=masks[1])
        snapshot = Snapshot.create(first.rig, first.markers, obs)
        selection = selector(prior, candidates, snapshot)
        costs = jnp.where(candidates.valid, selection.costs, 0)
        told = (selection.measured, selection.log_weight, selection.flip_probability, costs)
        return sum(jnp.sum(leaf) for leaf in floats_of(told))

    for pose in (TRUTH, FRONTAL, worlds.NO_VIEW):
        snapshot = seen_from(pose)
        candidates, masks = eqx.partition(find(snapshot), eqx.is_inexact_array)
        # The prediction is a candidate itself: distances are 0.
        here = jaxlie.SE3(candidates.T_vehicle_world.wxyz_xyz[0]).inverse()
        for started in (True, False):
            floats = (here, candidates, snapshot.obs.corners_px)
            slopes = slope(floats, (masks, snapshot.obs.visible), started)
            for leaf in jax.tree.leaves(slopes):
                assert leaf.dtype == precision
                assert np.all(np.isfinite(leaf))


OF_THE_IMAGE = [LowestReprojection(), RatioTest(1.0), ObjectSpace(), PaperCost(), Mahalanobis()]


@pytest.mark.parametrize("selector", [*OF_THE_IMAGE, OrientationGiven()], ids=repr)
def test_it_knows_its_doubt(selector):
    """Equal poses, so equal e2: the doubt is that of two Gaussians."""
    for excess in (0.0, 1.0, 50.0):
        candidates = candidates_at([TRUTH, TRUTH], [3.0, 3.0 + excess])
        selection = select(selector, belief(worlds.planar(*TRUTH)), candidates, seen_from(TRUTH))
        expected = 1 / (1 + np.exp(excess / 2))
        assert selection.flip_probability == pytest.approx(expected, abs=1e-12)


@pytest.mark.parametrize("selector", OF_THE_IMAGE[:4], ids=repr)
def test_a_wide_minimum_holds_more_probability(selector):
    """Both minima are Gaussians over poses: exp(-cost / 2) times the root of det(covariance)."""
    rng = np.random.default_rng(5)
    roots = rng.normal(size=(2, 6, 6))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    candidates = candidates_at([TRUTH, TRUTH], [3.0, 4.0], covariance=covariances)
    mass = np.exp([-1.5, -2.0]) * np.sqrt(np.linalg.det(covariances))
    selection = select(selector, belief(worlds.planar(*TRUTH)), candidates, seen_from(TRUTH))
    assert int(selection.selected) == 0
    assert selection.flip_probability == pytest.approx(mass[1] / mass.sum(), abs=1e-12)


RATIOS = [
    ((1.0, 3.1), 1 / 3, True),
    ((1.0, 2.9), 1 / 3, False),
    ((0.9, 1.0), 0.8, False),
    ((0.7, 1.0), 0.8, True),
    ((0.0, 0.0), 0.5, True),
]


def test_ratio_test_discards_what_is_not_clear():
    """The ratio is that of errors in pixels, as AprilTag users know it, not of their squares."""
    prior, seen = belief(worlds.planar(*TRUTH)), seen_from(TRUTH)
    for errors_px, max_ratio, taken in RATIOS:
        for errors in (errors_px, errors_px[::-1]):
            candidates = candidates_at([TRUTH, (1.0, -1.5, 1.0)], np.square(errors))
            selection = select(RatioTest(max_ratio), prior, candidates, seen)
            np.testing.assert_allclose(selection.costs[:2], np.square(errors))
            assert bool(selection.measured.valid[0]) == taken, (errors, max_ratio)
            assert int(selection.selected) == (int(np.argmin(errors)) if taken else -1)
            # Of a pose that is not given nothing is doubtful.
            assert taken or selection.flip_probability == 0


def test_ratio_test_takes_an_only_candidate():
    prior, snapshot = belief(worlds.planar(*TRUTH)), seen_from(TRUTH)
    for candidates in (
        candidates_at([TRUTH], [4.0]),
        candidates_at([TRUTH, TRUTH, TRUTH], [4.0, 4.1, 4.2], [True, False, False]),
    ):
        selection = select(RatioTest(), prior, candidates, snapshot)
        assert int(selection.selected) == 0
        assert selection.flip_probability == 0


def object_space_m2(candidates: Candidates, prior: jaxlie.SE3, snapshot: Snapshot) -> list[float]:
    return [
        paper.e2(
            np.asarray(snapshot.markers.corners_world_m),
            np.any(np.asarray(snapshot.obs.visible), axis=0),
            T,
            np.linalg.inv(matrix(prior.wxyz_xyz)),
        )
        for T in matrix(candidates.T_vehicle_world.wxyz_xyz)[np.asarray(candidates.valid)]
    ]


def test_object_space_is_equation_14_and_the_paper_s_cost_adds_equation_13():
    snapshot = seen_from((0.2, 0.1, 0.6), one_marker=False)
    prior = worlds.planar(0.25, 0.05, 0.7)
    for rule, e1_px2, weight in (
        (ObjectSpace(), np.array([0.1, 1e4]), (0, 1)),
        (PaperCost(), np.array([3.0, 4.0]), (1, 100**2)),
    ):
        candidates = candidates_at([(0.5, -0.2, 0.1), (0.2, 0.1, 0.6)], e1_px2)
        selection = select(rule, belief(prior), candidates, snapshot)
        metres = np.array(object_space_m2(candidates, prior, snapshot))
        expected = weight[0] * e1_px2 + weight[1] * metres
        np.testing.assert_allclose(selection.costs[:2], expected, rtol=1e-11)
        assert metres[1] < metres[0]
        assert int(selection.selected) == 1
        # Without a prediction there is only the image.
        first = select(rule, belief(prior, initialised=False), candidates, snapshot)
        np.testing.assert_array_equal(first.costs[:2], e1_px2)
        assert int(first.selected) == 0


def test_mahalanobis_is_the_whitened_error():
    """-2 log of N(corners) N(distance; 0, P + C) sqrt(det C), logarithms from SciPy."""
    rng = np.random.default_rng(6)
    poses = [(2.1, -0.9, 2.3), (1.7, -1.2, 1.6), (2.0, -1.0, -2.5)]
    roots = 0.1 * rng.normal(size=(3, 6, 6))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    cost = np.array([8.0, 5.0, 2.0])
    candidates = candidates_at(poses, cost, covariance=covariances)
    candidates = dataclasses.replace(candidates, e1_px2=jnp.asarray([1.0, 2.0, 3.0, 4.0]))
    P = 0.2 * rng.normal(size=(6, 6))
    P = P @ P.T
    prior = eqx.tree_at(lambda b: b.covariance, belief(worlds.planar(*TRUTH)), jnp.asarray(P[None]))
    expected = []
    for pose, C, own in zip(poses, covariances, cost, strict=True):
        there, then = (matrix(worlds.planar(*at).wxyz_xyz) for at in (pose, TRUTH))
        between = np.linalg.solve(then, there)
        X = np.real(scipy.linalg.logm(between))
        away = np.array([X[0, 3], X[1, 3], X[2, 3], X[2, 1], X[0, 2], X[1, 0]])
        S = P + C
        expected.append(
            own
            - np.linalg.slogdet(C)[1]
            + away @ np.linalg.solve(S, away)
            + np.linalg.slogdet(S)[1]
        )
    expected = np.array(expected)
    selection = select(Mahalanobis(), prior, candidates, seen_from(TRUTH))
    np.testing.assert_allclose(selection.costs[:3], expected, rtol=1e-9)
    best = int(np.argmin(expected))
    assert int(selection.selected) == best
    mass = np.exp(-(expected - expected[best]) / 2)
    assert selection.flip_probability == pytest.approx(1 - mass[best] / mass.sum(), abs=1e-9)
    # Before the first pose: the image, and the width of its minima.
    prior = eqx.tree_at(lambda b: b.initialised, prior, jnp.asarray([False]))
    first = select(Mahalanobis(), prior, candidates, seen_from(TRUTH))
    np.testing.assert_allclose(first.costs[:3], cost - np.linalg.slogdet(covariances)[1], rtol=1e-9)


PAIR = [(1.2, -1.4, 1.0), TRUTH]  # e1 speaks for the first, the other sensors for the second


def test_orientation_given_believes_the_heading():
    candidates = candidates_at(PAIR, [1.0, 5.0])
    prior = belief(worlds.planar(*TRUTH), initialised=False)
    sensed = {"heading_sigma_rad": 0.1, "normals_camera": None}
    # Seen across the seam: -179 and 181 degrees are one.
    for heading in (TRUTH[2] + 0.05, TRUTH[2] + 0.05 - 2 * np.pi):
        snapshot = seen_from(TRUTH, heading_rad=jnp.asarray(heading), **sensed)
        selection = select(OrientationGiven(), prior, candidates, snapshot)
        gaps = np.array([TRUTH[2] + 0.05 - 1.0, 0.05]) / 0.1
        np.testing.assert_allclose(selection.costs[:2], [1.0, 5.0] + gaps**2, rtol=1e-9)
        assert int(selection.selected) == 1
        assert selection.flip_probability < 1e-6
    for heading in (jnp.asarray(np.nan), jnp.asarray(np.inf), None):
        snapshot = seen_from(TRUTH, heading_rad=heading, **sensed)
        selection = select(OrientationGiven(), prior, candidates, snapshot)
        np.testing.assert_array_equal(selection.costs[:2], [1.0, 5.0])
        assert int(selection.selected) == 0


def test_orientation_given_believes_the_normals():
    """Two cameras see the marker; one of them has no reading. Angles by the dot product."""
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    pose, other = worlds.OVERLAP_VIEW, (0.1, 0.2, 1.4)
    candidates = candidates_at([other, pose], [1.0, 5.0])
    tilted = normals_at(rig, markers, (0.0, 0.0, pose[2] + 0.03))
    sensed = {"heading_rad": None, "normal_sigma_rad": 0.05}
    visible = np.asarray(seen_from(pose).obs.visible)
    assert visible.sum() == 2
    first, second = np.flatnonzero(visible[:, 0])
    prior = belief(worlds.planar(*TRUTH))
    for broken in ([], [first], [first, second]):
        measured = np.array(tilted)
        measured[broken, 0, 1] = np.nan
        snapshot = seen_from(pose, normals_camera=jnp.asarray(measured), **sensed)
        selection = select(OrientationGiven(), prior, candidates, snapshot)
        expected = [1.0, 5.0]
        for index, candidate in enumerate((other, pose)):
            believed = np.asarray(normals_at(rig, markers, candidate))
            for camera in {first, second} - set(broken):
                cosine = believed[camera, 0] @ np.asarray(tilted)[camera, 0]
                expected[index] += (np.arccos(cosine) / 0.05) ** 2
        np.testing.assert_allclose(selection.costs[:2], expected, rtol=1e-6)
        assert int(selection.selected) == (0 if len(broken) == 2 else 1)


def test_the_oracle_picks_what_is_nearest_to_the_truth_in_angle():
    """Even far away, with the higher errors and against the prediction."""
    poses = [(TRUTH[0], TRUTH[1], TRUTH[2] + 0.4), (9.0, 9.0, TRUTH[2] - 0.3), (2.0, -1.0, 1.0)]
    candidates = candidates_at(poses, [1.0, 50.0, 0.0])
    prior = belief(worlds.planar(*poses[2]))
    selection = select(Oracle(), prior, candidates, seen_from(TRUTH))
    np.testing.assert_allclose(selection.costs[:3], [0.4, 0.3, TRUTH[2] - 1.0], atol=1e-9)
    assert int(selection.selected) == 1
    assert selection.flip_probability == 0


def test_the_oracle_says_what_it_lacks():
    snapshot = seen_from(TRUTH)
    obs = dataclasses.replace(snapshot.obs, T_world_vehicle_true=None)
    snapshot = dataclasses.replace(snapshot, obs=obs)
    with pytest.raises(ValueError, match="T_world_vehicle_true"):
        Oracle()(belief(worlds.planar(*TRUTH)), candidates_at(PAIR, [1.0, 5.0]), snapshot)


@pytest.fixture(scope="module")
def ambiguous():
    """Real candidates at the paper's start, noise 1 px: the first draw whose mirror pose has the
    lower e1, by 0.3 px^2."""
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    truth = worlds.planar(*TRUTH)
    for seed in range(40):
        noise = np.random.default_rng(seed).standard_normal((4, 1, 4, 2))
        snapshot = snap(rig, markers, worlds.observe(rig, markers, truth, jnp.asarray(noise)))
        candidates = find(snapshot)
        if int(np.sum(candidates.valid)) != 2:
            continue
        Rs = np.linalg.inv(matrix(candidates.T_vehicle_world.wxyz_xyz[:2]))[:, :3, :3]
        off = worlds.rotation_angles_rad(Rs, matrix(truth.wxyz_xyz)[:3, :3])
        if off[1] < off[0] and candidates.e1_px2[1] - candidates.e1_px2[0] > 0.3:
            return candidates, snapshot
    raise AssertionError("no such draw")


def test_the_unit_of_length_decides(ambiguous):
    """In centimetres the prediction outweighs the image's error, in metres it hardly counts and
    the rule is the lowest reprojection error (docs/design.md, Units of the cost)."""
    prior = belief(worlds.planar(TRUTH[0] + 0.05, TRUTH[1] - 0.05, TRUTH[2] + 0.05))
    lowest = select(LowestReprojection(), prior, *ambiguous)
    centimetres = select(PaperCost(), prior, *ambiguous)
    metres = select(PaperCost(length_unit_m=1.0), prior, *ambiguous)
    assert int(lowest.selected) == 0
    assert int(centimetres.selected) == 1
    assert int(metres.selected) == 0
    np.testing.assert_allclose(metres.costs[:2], lowest.costs[:2], atol=1.0)
    assert centimetres.costs[0] - centimetres.costs[1] > 100


def test_a_misled_prediction_misleads_the_paper_s_rule(ambiguous):
    """Near the mirror pose the rule defends it (docs/design.md, Ambiguity)."""
    candidates, snapshot = ambiguous
    T = np.linalg.inv(matrix(candidates.T_vehicle_world.wxyz_xyz[0]))
    mirror = jaxlie.SE3(jnp.asarray(wxyz_xyz(T)))
    assert int(select(PaperCost(), belief(mirror), candidates, snapshot).selected) == 0


BRANCHES = [
    # degrees, valid, selected: judged, wrong, outlier, ambiguous
    ((1.0, 40.0), [True, True], 0, (True, False, False, True)),
    ((1.0, 40.0), [True, True], 1, (True, True, False, True)),
    ((40.0, 41.0), [True, True], 0, (True, False, True, True)),
    ((40.0, 1.0), [True, False], 0, (True, False, True, False)),
    ((3.0, 1.0), [True, False], 0, (True, False, False, False)),
    # Equally far, but for rounding.
    ((-7.0, 7.0), [True, True], 0, (True, False, False, True)),
    ((-7.0, 7.0), [True, True], 1, (True, False, False, True)),
    ((1.0, 40.0), [True, True], -1, (False, False, False, False)),
    ((1.0, 40.0), [False, False], -1, (False, False, False, False)),
]


def test_a_branch_is_wrong_when_another_candidate_is_closer_in_angle():
    for degrees, valid, selected, expected in BRANCHES:
        seen = candidates_at(
            [(1.0, 2.0, np.deg2rad(angle)) for angle in degrees], [0.0, 1.0], valid
        )
        branch = judge(seen, jnp.asarray(selected), worlds.planar(1.0, 2.0, 0.0))
        told = branch.judged, branch.wrong, branch.outlier, branch.ambiguous
        assert tuple(map(bool, told)) == expected, (degrees, valid, selected)


def test_a_distance_is_that_of_the_positions():
    here, there = worlds.planar(1.0, 2.0, 0.3), worlds.planar(1.0, 4.0, -0.4)
    assert position_error_m(here, there) == pytest.approx(2.0)
