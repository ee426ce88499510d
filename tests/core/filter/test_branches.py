"""The second posterior of one prediction: what it is, when it is taken, what it is good for."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.core.filter.bank import PoseBelief
from jaxnav.core.filter.fit import fit_poses
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.hypotheses import MultiHypothesis, SecondPoses, give_slots, second_poses
from jaxnav.core.models.geometry import rotation_error_rad
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.core.pose.refine import Candidates
from tests import worlds
from tests.core.filter.test_hypotheses import EYE, PLANAR, matrix, view
from tests.helpers.filters import derivative, whitened_pixels
from tests.reference.rigid import cayley, inverse_cayley, wxyz_xyz
from tests.reference.rigid import matrix as matrix_of

POSE = worlds.OVERLAP_VIEW
SIGMA = {3: np.array([0.06, 0.05, 0.07]), 6: np.array([0.06, 0.05, 0.04, 0.05, 0.07, 0.06])}


def prediction(freedom: np.ndarray) -> PoseBelief:
    d = freedom.shape[1]
    root = np.diag(SIGMA[d]) @ (EYE[:d, :d] + 0.2 * np.random.default_rng(d).normal(size=(d, d)))
    P = freedom @ root @ root.T @ freedom.T
    T = worlds.planar(*POSE).wxyz_xyz
    return PoseBelief(
        jaxlie.SE3(jnp.stack([T, T])),
        jnp.asarray(np.stack([P, P])),
        jnp.asarray([0.0, -jnp.inf]),
        jnp.asarray([True, False]),
        jnp.asarray(freedom),
        jnp.zeros((6, 0)),
        27.9,
    )


@jax.jit
def both_fits(prior, snapshot, elsewhere):
    T, P = prior.T_world_vehicle, prior.covariance
    return fit_poses(T, P, None, prior, snapshot, jnp.zeros(6), 40, elsewhere)


@pytest.mark.parametrize(
    "freedom",
    [pytest.param(PLANAR, id="car", marks=pytest.mark.long), pytest.param(EYE, id="free")],
)
def test_a_branch_is_the_product_of_two_gaussians(freedom):
    """Prediction times corners, these linear about another pose: mean, covariance, evidence."""
    d = freedom.shape[1]
    prior, snapshot = prediction(freedom), view(POSE)
    xi = 0.8 * SIGMA[d] * np.where(np.arange(d) % 2, -1, 1)
    elsewhere = jnp.asarray([False, True]), jnp.asarray(np.stack([np.zeros(d), xi]))
    fits = both_fits(prior, snapshot, elsewhere)
    T_prior = matrix(prior.T_world_vehicle)[0]
    P = freedom.T @ np.asarray(prior.covariance)[0] @ freedom

    def pixels(x):
        return whitened_pixels(snapshot, T_prior @ cayley(freedom @ x))

    J, r = derivative(pixels, xi), pixels(xi)
    information = J.T @ J + np.linalg.inv(P)
    mean = np.linalg.solve(information, J.T @ (J @ xi - r))
    T = matrix(fits.posterior.T_world_vehicle)[1]
    np.testing.assert_allclose(T, T_prior @ cayley(freedom @ mean), atol=2e-6)
    # The integral of exp(-|r + J (x - xi)|^2 / 2) N(x; 0, P) over x.
    left = r + J @ (mean - xi)
    cost = left @ left + mean @ np.linalg.solve(P, mean)
    log_evidence = -(cost + np.linalg.slogdet(information @ P)[1]) / 2
    assert float(fits.log_evidence[1]) == pytest.approx(log_evidence, rel=1e-5)
    # The other slot searched, and found a lower cost.
    assert float(fits.log_evidence[0]) > log_evidence
    volume = np.linalg.slogdet(np.linalg.inv(information))[1]
    C = freedom.T @ np.asarray(fits.posterior.covariance)[1] @ freedom
    assert np.linalg.slogdet(C)[1] == pytest.approx(volume, abs=0.3)  # in axes that are turned


def test_a_branch_about_the_minimum_is_the_minimum():
    prior, snapshot = prediction(PLANAR), view(POSE)
    found = both_fits(prior, snapshot, (jnp.zeros(2, bool), jnp.zeros((2, 3))))
    T_prior, T_found = matrix(prior.T_world_vehicle)[0], matrix(found.posterior.T_world_vehicle)[0]
    xi = PLANAR.T @ inverse_cayley(np.linalg.inv(T_prior) @ T_found)
    elsewhere = jnp.asarray([False, True]), jnp.asarray(np.stack([0 * xi, xi]))
    again = both_fits(prior, snapshot, elsewhere)
    for name in ("posterior", "log_evidence", "finite"):
        leaves = (jax.tree.leaves(getattr(fits, name)) for fits in (again, found))
        for a, b in zip(*leaves, strict=True):
            np.testing.assert_allclose(a[1], b[0], rtol=1e-6, atol=1e-9)


def candidates(turns_rad, costs, valid) -> Candidates:
    """Candidates turned about the vertical from `POSE`, known to 2 degrees and 2 cm."""
    poses = [worlds.planar(POSE[0], POSE[1], POSE[2] + turn).wxyz_xyz for turn in turns_rad]
    Ts = wxyz_xyz(np.linalg.inv(matrix_of(np.stack(poses))))
    C = np.diag([0.02**2] * 3 + [0.035**2] * 3)
    empty = Candidates.none(len(turns_rad), jnp.result_type(float))
    return dataclasses.replace(
        empty,
        T_vehicle_world=jaxlie.SE3(jnp.asarray(Ts)),
        cost=jnp.asarray(costs, float),
        covariance=jnp.asarray(np.tile(C, (len(turns_rad), 1, 1))),
        valid=jnp.asarray(valid),
    )


wanted_of = jax.jit(lambda prior, seen: second_poses(prior, 0, seen, -20.0))


WANTED = [
    # turns_deg, costs, valid, wanted
    ((2.0, 12.0, 14.0), (1, 2, 3), (True, True, True), (False, True, True)),
    ((12.0, 2.0, 14.0), (1, 2, 60), (True, True, True), (True, False, False)),  # misfits
    ((2.0, 120.0, 9.0), (1, 2, 1), (True, True, True), (False, False, True)),  # too far
    ((2.0, 12.0, 9.0), (1, 2, 1), (True, False, True), (False, False, True)),  # no candidate
    ((2.0, 12.0, 9.0), (1, 2, 1), (False, False, False), (False, False, False)),
    ((12.0, 60.0, 9.0), (1, 99, 99), (True, True, True), (True, False, False)),  # the best one
]


def test_the_candidates_wanted_are_probable_and_not_the_nearest():
    prior = prediction(PLANAR)
    for turns_deg, costs, valid, wanted in WANTED:
        second = wanted_of(prior, candidates(np.deg2rad(turns_deg), costs, valid))
        assert tuple(np.asarray(second.wanted)) == wanted, (turns_deg, costs, valid)
        for n in np.flatnonzero(wanted):
            # A turn at the vehicle's own place: cay's half tangent, and no shift.
            expected = [0, 0, 2 * np.tan(np.deg2rad(turns_deg[n]) / 2)]
            np.testing.assert_allclose(second.xi[n], expected, atol=1e-9)


def test_a_bank_that_has_seen_nothing_has_no_second_pose():
    prior = eqx.tree_at(lambda p: p.initialised, prediction(PLANAR), jnp.zeros(2, bool))
    seen = candidates(np.deg2rad([2.0, 12.0, 14.0]), (1, 1, 1), (True, True, True))
    assert not np.any(wanted_of(prior, seen).wanted)


given_slots = jax.jit(give_slots)


@given(
    st.lists(st.booleans(), min_size=4, max_size=4), st.lists(st.booleans(), min_size=6, max_size=6)
)
def test_every_second_pose_gets_an_empty_slot_of_its_own(wanted, empty):
    xi = np.arange(1, 13, dtype=float).reshape(4, 3)
    branches = given_slots(SecondPoses(jnp.asarray(wanted), jnp.asarray(xi)), jnp.asarray(empty))
    taken = np.asarray(branches.wanted)
    assert not np.any(taken & ~np.asarray(empty))
    expected = xi[np.asarray(wanted)][: np.sum(empty)]
    np.testing.assert_array_equal(np.asarray(branches.xi)[taken], expected)
    assert not np.any(np.asarray(branches.xi)[~taken])


class Alone(MultiHypothesis):
    """The bank without second poses."""

    def second_poses(self, bank, heaviest, candidates, snapshot):
        second = super().second_poses(bank, heaviest, candidates, snapshot)
        return second._replace(wanted=jnp.zeros_like(second.wanted))


FRAMES, PERIOD_S, SIGMA_PX, DRIVES = 30, 0.05, 0.3, 8


@functools.cache
def through_the_frontal_view(selector: MultiHypothesis):
    """A free body swings from 3 to 28 degrees beside the normal, believed in the mirrored pose.

    Returns:
        Angle of the reported pose to the truth, rad, the flip probability, and `decided`,
        (drives, frames) each.
    """
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    rig, markers = (jax.tree.map(jnp.asarray, part) for part in (rig, markers))
    marker = np.asarray(markers.Ts_world_marker.as_matrix())[0]
    center, normal = marker[:3, 3], marker[:3, 2]
    facing = np.arctan2(normal[1], normal[0])
    nav = Navigator(rig=rig, markers=markers, selector=selector, motion=ConstantVelocity(),
                    corner_sigma_px=SIGMA_PX)  # fmt: skip

    def pose(view_rad):
        x, y = center[:2] + 3.0 * np.array([np.cos(facing + view_rad), np.sin(facing + view_rad)])
        return worlds.planar(float(x), float(y), float(facing + view_rad + np.pi))

    views_rad = np.deg2rad(np.linspace(3.0, 28.0, FRAMES))
    truth = jnp.stack([pose(view).wxyz_xyz for view in views_rad])
    mirrored = pose(-views_rad[0])
    noise = SIGMA_PX * np.random.default_rng(4).standard_normal((DRIVES, FRAMES, 4, 1, 4, 2))

    @jax.jit
    def run(noise):
        bank = nav.motion.init(selector.hypotheses)
        P = jnp.diag(jnp.asarray([0.05] * 3 + [0.07] * 3 + [0.3] * 6) ** 2)
        P = jnp.eye(bank.covariance.shape[1]).at[:12, :12].set(P)
        bank = dataclasses.replace(
            bank,
            mean=bank.mean.at[0, :7].set(mirrored.wxyz_xyz),
            covariance=bank.covariance.at[0].set(P),
            initialised=bank.initialised.at[0].set(True),
        )
        state = dataclasses.replace(nav.init(), belief=nav.believe(bank))

        def step(state, frame):
            wxyz_xyz, noise = frame
            T = jaxlie.SE3(wxyz_xyz)
            seen = worlds.observe(rig, markers, T, noise)
            obs = Observation(seen.corners_px, seen.visible, dt_s=PERIOD_S)
            state, out = nav.step(state, obs)
            return state, (
                rotation_error_rad(out.T_world_vehicle, T),
                out.flip_probability,
                out.decided,
            )

        return jax.lax.scan(step, state, (truth, noise))[1]

    drives = [jax.device_get(run(each)) for each in jnp.asarray(noise)]
    return tuple(np.stack(leaves) for leaves in zip(*drives, strict=True))


@pytest.mark.long
def test_a_bank_that_took_the_wrong_pose_at_the_frontal_view_finds_back():
    """Three metres off, the marker 18 px wide: further on the image contradicts what it follows."""

    def judged(selector):
        apart_rad, flip_probability, decided = through_the_frontal_view(selector)
        wrong = np.rad2deg(apart_rad) > 10
        return wrong, wrong & decided & (flip_probability < 1e-3)

    (wrong, claimed), (wrong_alone, claimed_alone) = judged(MultiHypothesis()), judged(Alone())
    assert np.sum(wrong_alone[:, -1]) >= DRIVES / 2
    assert not np.any(wrong[:, -1])
    assert np.sum(wrong) < 0.6 * np.sum(wrong_alone)
    assert np.sum(claimed_alone) > 50
    assert np.sum(claimed) < np.sum(claimed_alone) / 5
