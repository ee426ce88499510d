"""The bank of hypotheses: its start, its fits and weights, its mergers and its decisions."""

import dataclasses
import functools
import itertools
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import scipy.linalg
import scipy.optimize
import scipy.stats

from jaxnav.core.filter.bank import PoseBelief, merge_hypotheses
from jaxnav.core.filter.choose import Selection
from jaxnav.core.filter.fit import fit_poses
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.hypotheses import MultiHypothesis, fan, nearer_to_another
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.geometry import on_ground
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation, Snapshot
from jaxnav.core.pose.refine import Candidates
from tests import worlds
from tests.derivatives import in_float32
from tests.helpers.filters import (
    believing,
    derivative,
    find,
    select,
    sense,
    snap,
    step,
    whitened_pixels,
)
from tests.helpers.simulated import make_setup
from tests.reference import kalman, paper
from tests.reference.rigid import cayley, inverse_cayley, twist_matrix, wxyz_xyz
from tests.reference.rigid import matrix as matrix_of

WHEELBASE_M = 0.256
EYE = np.eye(6)
PLANAR, TILT = EYE[:, [0, 1, 5]], EYE[:, [2, 3, 4]]
# Nothing bounded and nothing blurred: what remains is the textbook.
EXACT = MultiHypothesis(
    hypotheses=8,
    max_steps=40,
    floor_m=0.0,
    floor_rad=0.0,
    outlier_log_evidence=-1e9,
    decided_mass=0.0,
    max_inflation=1.0,
    gate=1e9,
    forget_log_weight=-1e9,
)


@functools.cache
def view(pose, sigma_px: float = 0.3, seed: int = 0) -> Snapshot:
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    noise = sigma_px * np.random.default_rng(seed).standard_normal((4, 1, 4, 2))
    obs = worlds.observe(rig, markers, worlds.planar(*pose), jnp.asarray(noise))
    return snap(rig, markers, obs, sigma_px)


def matrix(T: jaxlie.SE3) -> np.ndarray:
    return matrix_of(T.wxyz_xyz)


def priors(pose, freedom=PLANAR, nuisance=None, count=8, scale=1.0, seed=1) -> PoseBelief:
    """Predictions around a pose, each with a covariance of its own."""
    rng = np.random.default_rng(seed)
    d = freedom.shape[1]
    sigma = scale * (np.array([0.05, 0.05, 0.08]) if d == 3 else np.repeat([0.05, 0.08], 3))
    roots = [np.diag(sigma * rng.uniform(0.7, 1.5, d)) @ (np.eye(d) + 0.3 * rng.normal(size=(d, d)))
             for _ in range(count)]  # fmt: skip
    off = [0.7 * freedom @ (sigma * rng.normal(size=d)) for _ in range(count)]
    here = matrix(worlds.planar(*pose))
    Ts = np.stack([here @ scipy.linalg.expm(twist_matrix(xi)) for xi in off])
    return PoseBelief(
        T_world_vehicle=jaxlie.SE3(jnp.asarray(wxyz_xyz(Ts))),
        covariance=jnp.asarray([freedom @ L @ L.T @ freedom.T for L in roots]),
        log_weight=jnp.asarray(np.full(count, -np.log(count))),
        initialised=jnp.asarray(np.ones(count, bool)),
        freedom=jnp.asarray(freedom),
        nuisance=jnp.asarray(np.zeros((6, 0)) if nuisance is None else nuisance),
        gate_nis=jnp.inf,
    )


NEAR = worlds.OVERLAP_VIEW  # two cameras see the marker: well conditioned


@pytest.fixture(scope="module")
def exact() -> tuple[PoseBelief, Selection, Snapshot]:
    snapshot, prior = view(NEAR), priors(NEAR)
    return prior, select(EXACT, prior, find(snapshot), snapshot), snapshot


def textbook_fit(T_prior, covariance, directions, snapshot):
    """MAP of xi = directions @ u, u ~ N(0, covariance), by SciPy.

    Returns:
        u, the residuals' Jacobian there by u, the residuals.
    """
    root = np.linalg.cholesky(covariance)

    def pixels(u):
        return whitened_pixels(snapshot, T_prior @ cayley(directions @ u))

    solution = scipy.optimize.least_squares(
        lambda w: np.concatenate([pixels(root @ w), w]),
        np.zeros(len(root)), jac="3-point", method="lm", xtol=1e-14, ftol=1e-14, gtol=1e-14,
    )  # fmt: skip
    u = root @ solution.x
    return u, derivative(pixels, u), pixels(u)


@pytest.mark.parametrize("lane", [0, 3])
def test_a_fit_is_the_minimum_of_the_whitened_e(exact, lane):
    """Pose, covariance and NIS of a hypothesis against SciPy's least squares."""
    prior, selection, snapshot = exact
    T_prior = matrix(prior.T_world_vehicle)[lane]
    P = PLANAR.T @ np.asarray(prior.covariance)[lane] @ PLANAR
    u, J, r = textbook_fit(T_prior, P, PLANAR, snapshot)
    T = matrix(selection.measured.T_world_vehicle)[lane]
    np.testing.assert_allclose(T, T_prior @ cayley(PLANAR @ u), atol=1e-6)
    # xi of the minimum -> xi' at the minimum: cay^-1(cay(xi)^-1 cay(xi + d)).
    J_cay = derivative(
        lambda d: PLANAR.T @ inverse_cayley(
            np.linalg.inv(cayley(PLANAR @ u)) @ cayley(PLANAR @ (u + d))
        ),
        np.zeros(3),
    )  # fmt: skip
    expected = J_cay @ np.linalg.inv(J.T @ J + np.linalg.inv(P)) @ J_cay.T
    actual = PLANAR.T @ np.asarray(selection.measured.covariance)[lane] @ PLANAR
    np.testing.assert_allclose(actual, expected, rtol=1e-4, atol=1e-6 * np.max(expected))
    np.testing.assert_allclose(TILT.T @ np.asarray(selection.measured.covariance)[lane], 0, atol=0)
    R = np.linalg.inv(J.T @ J)
    alone = u - R @ J.T @ r
    nis = alone @ np.linalg.solve(P + R, alone)
    assert np.sum(selection.measured.innovation[lane] ** 2) == pytest.approx(nis, rel=1e-4)


def correlations(covariance, freedom) -> np.ndarray:
    P = np.einsum("ia,kij,jb->kab", freedom, np.asarray(covariance, float), freedom)
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    return P / (sigma[:, :, None] * sigma[:, None])


@jax.jit
def covariances_of(here, prior, snapshot, floors):
    fits = fit_poses(jaxlie.SE3(here), prior.covariance, None, prior, snapshot, floors, 20)
    return fits.posterior.covariance


@pytest.mark.parametrize(
    "freedom",
    [pytest.param(PLANAR, id="car"), pytest.param(EYE, id="free", marks=pytest.mark.long)],
)
def test_float32_keeps_what_corners_say_that_are_far_surer_than_the_prediction(freedom):
    """A drive's first frames: nothing known to a metre, corners known to a fiftieth of a pixel."""
    snapshot, prior = view(NEAR, 0.02), priors(NEAR, freedom, scale=20.0)
    here = jnp.tile(worlds.planar(*NEAR).wxyz_xyz, (8, 1))
    narrow = {np.float64: np.float32, np.int64: np.int32}
    for floor in (0.0, 1e-4):
        told = here, prior, snapshot, jnp.full(6, floor, float)
        exact = correlations(covariances_of(*told), freedom)
        with jax.enable_x64(False):
            rounded = jax.tree.map(
                lambda leaf: jnp.asarray(leaf, narrow.get(leaf.dtype.type, leaf.dtype)),
                jax.tree.map(np.asarray, told),
            )
            found = correlations(covariances_of(*rounded), freedom)
        np.testing.assert_allclose(found, exact, atol=0.01)
        assert np.all(np.linalg.eigvalsh(found) > 0)


def test_corners_that_contradict_all_predictions_are_trusted_less_and_so_are_these():
    """As if all variances were larger by the least NIS over three sigmas of chi-square."""
    snapshot, lane = view(NEAR), 3
    prior = priors(NEAR + np.array([0.02, -0.015, 0.01]), scale=0.05)
    T_prior = matrix(prior.T_world_vehicle)[lane]
    P = PLANAR.T @ np.asarray(prior.covariance)[lane] @ PLANAR
    u, J, _ = textbook_fit(T_prior, P, PLANAR, snapshot)
    T_expected = T_prior @ cayley(PLANAR @ u)
    for most in (1.0, 1.5, 1e9):
        selector = eqx.tree_at(lambda s: s.max_inflation, EXACT, most)
        measured = select(selector, prior, find(snapshot), snapshot).measured
        nis = np.sum(np.asarray(measured.innovation) ** 2, axis=1)
        excess = np.min(nis) / (3 + 3 * np.sqrt(6))
        assert excess > 1.8
        np.testing.assert_allclose(measured.inflation, min(excess, most), rtol=1e-6)
        expected = min(excess, most) * np.linalg.inv(J.T @ J + np.linalg.inv(P))
        sigma = np.sqrt(np.diagonal(expected))
        T = matrix(measured.T_world_vehicle)[lane]
        away = PLANAR.T @ inverse_cayley(np.linalg.inv(T_expected) @ T)
        np.testing.assert_allclose(away / sigma, 0, atol=0.02)
        gap = PLANAR.T @ np.asarray(measured.covariance)[lane] @ PLANAR - expected
        np.testing.assert_allclose(gap / np.outer(sigma, sigma), 0, atol=0.03)


@pytest.mark.parametrize("tilt_sigma", [0.005, pytest.param(0.02, marks=pytest.mark.long)])
def test_a_nuisance_is_an_unknown_with_that_prior(tilt_sigma):
    """Height, roll and pitch: six unknowns by SciPy, of which three are looked at."""
    pose, lane = worlds.FRONT_VIEW, 1
    snapshot = view(pose)
    tilting = priors(pose, nuisance=tilt_sigma * TILT, scale=0.3)
    level = priors(pose, scale=0.3)
    T_prior = matrix(level.T_world_vehicle)[lane]
    P = PLANAR.T @ np.asarray(level.covariance)[lane] @ PLANAR
    both = scipy.linalg.block_diag(P, tilt_sigma**2 * np.eye(3))
    u, J, _ = textbook_fit(T_prior, both, np.hstack([PLANAR, TILT]), snapshot)
    expected = np.linalg.inv(J.T @ J + np.linalg.inv(both))[:3, :3]
    sigma = np.sqrt(np.diagonal(expected))
    there = T_prior @ cayley(PLANAR @ u[:3])

    def gaps(prior):
        """In sigmas of the six-unknown problem: of the mean, of the covariance."""
        measured = select(EXACT, prior, find(snapshot), snapshot).measured
        T = matrix(measured.T_world_vehicle)[lane]
        error = PLANAR.T @ inverse_cayley(np.linalg.inv(there) @ T)
        covariance = PLANAR.T @ np.asarray(measured.covariance)[lane] @ PLANAR
        apart = (covariance - expected) / np.outer(sigma, sigma)
        return np.max(np.abs(error / sigma)), np.max(np.abs(apart))

    # Linear in the nuisance, and in the step from the prediction to the minimum.
    mean, covariance = gaps(tilting)
    assert mean < 0.01
    assert covariance < 0.03
    # And it matters: without it the pose is off, and far more certain than it may be.
    mean, covariance = gaps(level)
    assert mean > 0.1
    assert covariance > 0.3


def test_the_evidence_is_the_integral(exact):
    """Differences of log-weights against a quadrature over x, y and heading.

    Gauss-Hermite of 11^3 nodes laid over the posterior."""
    prior, selection, snapshot = exact
    nodes, node_weights = np.polynomial.hermite_e.hermegauss(11)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes), axis=-1).reshape(-1, 3)
    log_measure = np.sum(
        np.log(np.stack(np.meshgrid(*[node_weights] * 3), axis=-1)).reshape(-1, 3), axis=1
    )
    visible = snapshot.obs.visible[:, :, None, None]

    @jax.jit
    @jax.vmap
    def misfit(T_prior, xi):
        T = jaxlie.SE3(T_prior) @ jaxlie.SE3.exp(xi)
        pixels = snapshot.rig.project(T.inverse(), snapshot.markers.corners_world_m)
        gap = jnp.where(visible, pixels - snapshot.obs.corners_px, 0)
        return jnp.sum(gap**2) / snapshot.seen.sigma_px[0, 0] ** 2

    expected = []
    for lane in range(4):
        T_prior = matrix(prior.T_world_vehicle)[lane]
        P = PLANAR.T @ np.asarray(prior.covariance)[lane] @ PLANAR
        T = matrix(selection.measured.T_world_vehicle)[lane]
        mode = PLANAR.T @ inverse_cayley(np.linalg.inv(T_prior) @ T)
        root = np.linalg.cholesky(
            PLANAR.T @ np.asarray(selection.measured.covariance)[lane] @ PLANAR
        )
        xi = mode + grid @ root.T
        count = len(xi)
        wxyz_xyz = jnp.tile(prior.T_world_vehicle.wxyz_xyz[lane], (count, 1))
        cost = np.asarray(misfit(wxyz_xyz, jnp.asarray(xi @ PLANAR.T)))
        cost = cost + np.sum(np.linalg.solve(np.linalg.cholesky(P), xi.T) ** 2, axis=0)
        # The nodes' own Gaussian is divided out.
        exponent = -cost / 2 + np.sum(grid**2, axis=1) / 2 + log_measure
        highest = exponent.max()
        volume = np.linalg.slogdet(root)[1] - np.linalg.slogdet(P)[1] / 2
        expected.append(highest + np.log(np.sum(np.exp(exponent - highest))) + volume)
    actual = np.asarray(selection.log_weight)[:4]
    assert np.ptp(expected) > 0.5
    np.testing.assert_allclose(actual - actual[0], np.array(expected) - expected[0], atol=0.05)
    assert np.sum(np.exp(selection.log_weight)) == pytest.approx(1, abs=1e-9)


def viewing_directions(Ts_world_vehicle: np.ndarray, snapshot: Snapshot) -> np.ndarray:
    """(K, 3): from the marker to the camera that sees it, in marker axes, unit vectors."""
    camera = int(np.flatnonzero(np.asarray(snapshot.obs.visible)[:, 0])[0])
    T_vehicle_camera = np.linalg.inv(matrix(snapshot.rig.Ts_camera_vehicle)[camera])
    T_marker_world = np.linalg.inv(matrix(snapshot.markers.Ts_world_marker)[0])
    towards = (T_marker_world @ Ts_world_vehicle @ T_vehicle_camera)[:, :3, 3]
    return towards / np.linalg.norm(towards, axis=1, keepdims=True)


grounded = jax.jit(on_ground)
fan_of = jax.jit(fan, static_argnames="hypotheses")


@pytest.mark.parametrize("pose", [worlds.START_VIEW, (0.0, -0.4, np.pi / 2), NEAR])
@pytest.mark.parametrize("kind", ["car", "free"])
def test_the_fan_covers_all_viewing_angles(kind, pose):
    """Range and bearing stay; the direction the marker is seen from goes all the way round."""
    snapshot = view(pose, 0.1)
    candidates = find(snapshot)
    bank = MultiHypothesis(hypotheses=24 if kind == "car" else 60)
    freedom = PLANAR if kind == "car" else EYE
    prior = priors(pose, freedom=freedom, count=bank.hypotheses)
    start = fan_of(prior, candidates, snapshot, bank.hypotheses)
    assert start.initialised.shape == (bank.hypotheses,)
    assert np.sum(np.exp(start.log_weight)) == pytest.approx(1)
    Ts = matrix(start.T_world_vehicle)
    members = Ts[: -min(candidates.valid.shape[0], 3)]
    directions = viewing_directions(members, snapshot)
    if kind == "car":
        np.testing.assert_allclose(Ts[:, 2, 3], 0, atol=1e-12)
        np.testing.assert_allclose(Ts[:, 2, 2], 1, atol=1e-12)
        azimuth_deg = np.rad2deg(np.arctan2(directions[:, 0], directions[:, 2]))
        # Lifting a candidate onto the ground takes it a little off.
        np.testing.assert_allclose(
            np.sort(azimuth_deg), np.linspace(-80, 80, len(members)), atol=3.0
        )
    else:
        rng = np.random.default_rng(0)
        wanted = rng.normal(size=(2000, 3))
        wanted /= np.linalg.norm(wanted, axis=1, keepdims=True)
        wanted = wanted[wanted[:, 2] > np.cos(np.deg2rad(75))]
        gaps_deg = np.rad2deg(np.arccos(np.clip(wanted @ directions.T, -1, 1))).min(axis=1)
        assert gaps_deg.max() < 20
        centers = np.linalg.inv(members)[:, :3] @ np.append(
            np.asarray(snapshot.markers.Ts_world_marker.wxyz_xyz)[0, 4:], 1
        )
        np.testing.assert_allclose(centers, np.broadcast_to(centers[:1], centers.shape), atol=1e-9)
    # The truth and every candidate, as an upright marker's mirror image is one, are near a member
    # by its own covariance.
    valid = np.asarray(candidates.valid)
    Ts = np.linalg.inv(matrix(candidates.T_vehicle_world)[valid])
    wanted = np.concatenate([matrix(worlds.planar(*pose))[None], Ts])
    if kind == "car":
        wanted = np.stack([matrix(grounded(jaxlie.SE3(jnp.asarray(wxyz_xyz(T))))) for T in wanted])
    for T in wanted:
        xi = np.stack([inverse_cayley(np.linalg.inv(member) @ T) for member in members])
        P = freedom.T @ np.asarray(start.covariance)[: len(members)] @ freedom
        distances = [
            x @ freedom @ np.linalg.solve(C, freedom.T @ x) for x, C in zip(xi, P, strict=True)
        ]
        assert min(distances) < (9 if kind == "car" else 16)


def test_merging_keeps_the_mixture_s_mean_and_covariance():
    """Against NumPy, the dead left out and headings across the seam."""
    rng = np.random.default_rng(2)
    count, n = 6, 6
    means = rng.normal(size=(count, n))
    means[:, 2] = np.pi + 0.1 * rng.normal(size=count)
    means[:, 2] = kalman.wrap(means[:, 2])
    roots = 0.3 * rng.normal(size=(count, n, n))
    covariances = roots @ np.swapaxes(roots, 1, 2)
    alive = np.array([True, True, True, True, False, True])
    weights = np.where(alive, rng.uniform(0.1, 1, count), 0.7)
    merged_into = np.array([0, 0, 2, 0, 2, 2])
    motion = BicycleKalman(worlds.qcar())
    belief = believing(motion, means, covariances, weights)
    belief = dataclasses.replace(belief, initialised=jnp.asarray(alive))

    @jax.jit
    def merged(bank, into):
        return merge_hypotheses(bank, into, motion.difference, motion.moved)

    after = merged(belief, jnp.asarray(merged_into))
    assert after.initialised.tolist() == [True, False, True, False, False, False]
    for receiver in (0, 2):
        who = np.flatnonzero((merged_into == receiver) & alive)
        share = weights[who] / weights[who].sum()
        unrolled = means[who].copy()
        unrolled[:, 2] = np.mod(unrolled[:, 2], 2 * np.pi)
        mean = share @ unrolled
        spread = unrolled - mean
        covariance = np.einsum("i,ide->de", share, covariances[who])
        covariance += np.einsum("i,id,ie->de", share, spread, spread)
        error = np.asarray(after.mean)[receiver] - mean
        error[2] = kalman.wrap(error[2])
        np.testing.assert_allclose(error, 0, atol=1e-12)
        np.testing.assert_allclose(after.covariance[receiver], covariance, atol=1e-12)
        assert np.exp(after.log_weight[receiver]) == pytest.approx(weights[who].sum())
    alone = merged(belief, jnp.arange(count))
    for one, other in zip(jax.tree.leaves(alone), jax.tree.leaves(belief), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-15)


@pytest.mark.parametrize(("kind", "size"), [("car", 6), ("free", 12)])
def test_the_reported_covariance_is_that_of_the_error(kind, size):
    """Truths drawn from the bank: their distance to the heaviest hypothesis, in units of the
    reported covariance, is chi-square on average, though the truth is often another one's."""
    motion = BicycleKalman(worlds.qcar()) if kind == "car" else ConstantVelocity()
    rng = np.random.default_rng(5)
    shifts = 0.15 * rng.normal(size=(4, size))
    moved = jax.jit(jax.vmap(motion.moved))
    seam = np.array(motion.init(4).mean)
    seam[:, 2] += 3.1 if kind == "car" else 0.0
    means = np.asarray(moved(jnp.asarray(seam), jnp.asarray(shifts)))
    roots = 0.02 * rng.normal(size=(4, size, size)) + 0.03 * np.eye(size)
    share = np.array([0.5, 0.3, 0.2, 0.9])
    belief = believing(motion, means, roots @ np.swapaxes(roots, 1, 2), share)
    belief = dataclasses.replace(belief, initialised=jnp.asarray([True, True, True, False]))
    drawn = rng.choice(3, size=20_000, p=share[:3])
    errors = np.einsum("sde,se->sd", roots[drawn], rng.normal(size=(len(drawn), size)))
    truths = moved(means[drawn], jnp.asarray(errors))
    away = np.asarray(jax.jit(jax.vmap(motion.difference, (0, None)))(truths, means[0]))
    error_covariance = eqx.filter_jit(motion.error_covariance)
    covariance = np.asarray(error_covariance(belief, jnp.asarray(0)))
    nees = np.einsum("sd,sd->s", away, np.linalg.solve(covariance, away.T).T)
    assert nees.mean() == pytest.approx(size, rel=0.03)
    own = np.einsum("sd,sd->s", away, np.linalg.solve(belief.covariance[0], away.T).T)
    assert own.mean() > 3 * size
    # Nobody there, and nobody else.
    for nobody in (motion.init(4), motion.init(1)):
        np.testing.assert_array_equal(
            error_covariance(nobody, jnp.asarray(0)), nobody.covariance[0]
        )


# Drives: 15 Hz, corner noise 1 px, the odometer's noise that of the simulations.
FRAMES, PERIOD_S, SEEDS = 75, 1 / 15, 8


class Seen(eqx.Module):
    """What is kept of a drive, leading axes (seeds, frames)."""

    pose: jax.Array
    hypothesis: jax.Array
    decided: jax.Array
    flip_probability: jax.Array
    nis: jax.Array
    hypotheses: jax.Array
    rejections: jax.Array
    started: jax.Array


def car() -> Navigator:
    return _car(str(jnp.ones(()).dtype))


@functools.cache
def _car(precision: str) -> Navigator:
    """Made once in each precision."""
    del precision
    return make_setup().navigator()


def run(nav: Navigator, obs: Observation, seeds: Sequence[int] = range(SEEDS)) -> Seen:
    """Of some of the drives."""
    seen, state = [], None
    for seed, frame in itertools.product(seeds, range(FRAMES)):
        state = state if frame else nav.init()
        given = jax.tree.map(lambda leaf, at=(seed, frame): leaf[at], obs)
        state, out = step(nav, state, given)
        bank = state.belief.bank
        told = (
            out.pose, out.hypothesis, out.decided, out.flip_probability, out.nis, bank.initialised,
            bank.rejections.count, out.located,
        )  # fmt: skip
        seen.append(Seen(*jax.device_get(told)))
    shape = len(seeds), FRAMES
    seen = jax.tree.map(lambda *x: np.stack(x).reshape(*shape, *x[0].shape), *seen)
    return dataclasses.replace(
        seen,
        hypotheses=np.sum(seen.hypotheses, axis=2),
        rejections=np.max(np.where(seen.hypotheses, seen.rejections, 0), axis=2),
    )


def sensed(poses, speed_mps, steering_rad=0.0, sigma_px=1.0, seed=0) -> Observation:
    """(SEEDS, FRAMES) readings along true poses (FRAMES, 3)."""
    rng = np.random.default_rng(seed)
    shape = (SEEDS, FRAMES)
    obs = sense(
        car().rig,
        car().markers,
        jnp.asarray(np.broadcast_to(poses, (*shape, 3))),
        jnp.asarray(sigma_px * rng.standard_normal((*shape, 4, 1, 4, 2))),
        jnp.asarray(speed_mps + 0.01 * rng.standard_normal(shape)),
        jnp.asarray(steering_rad + 0.005 * rng.standard_normal(shape)),
        PERIOD_S,
    )
    sigmas_px = np.full((*shape, 4, 1, 4), float(sigma_px))
    return eqx.tree_at(
        lambda o: o.corner_sigma_px, jax.device_get(obs), sigmas_px, is_leaf=lambda x: x is None
    )


def arc(start, speed_mps, steering_rad, frames=FRAMES) -> np.ndarray:
    poses = paper.drive(start, speed_mps, steering_rad, frames * PERIOD_S, WHEELBASE_M, frames * 20)
    return poses[:-1:20]


def errors_of(seen: Seen, poses) -> tuple[np.ndarray, np.ndarray]:
    """Position in m, heading in rad, (seeds, frames)."""
    gap = np.asarray(seen.pose) - poses
    return np.linalg.norm(gap[..., :2], axis=-1), np.abs(kalman.wrap(gap[..., 2]))


AHEAD_M = 3.2  # from the marker, where it is some 17 px wide
# Across the line of sight: the left camera sees the marker.
SIDEWAYS = arc((-0.9, 1.47 - AHEAD_M, 0.1), 0.4, 0.0)


PARKED = (0.8, 1.47 - AHEAD_M, np.deg2rad(100.0))


def parked(sigma_px: float) -> Seen:
    return run(car(), sensed(np.broadcast_to(PARKED, (FRAMES, 3)), 0.0, sigma_px=sigma_px))


@pytest.mark.long
def test_a_parked_car_whose_image_says_nothing_stays_undecided():
    """One look does not tell the poses apart. Many, of independent noise, may in the end; of
    corners that are four times worse, the five seconds are over before it could know."""
    seen, worse = parked(1.0), parked(4.0)
    assert np.all(seen.started)
    assert not np.any(seen.decided[:, 0])
    assert np.mean(seen.flip_probability[:, 0]) > 0.2
    assert np.all(seen.hypotheses[:, 0] > 1)
    wrong = errors_of(seen, np.asarray(PARKED))[1] > np.deg2rad(20)
    assert np.mean(wrong[:, 0]) > 0.2
    # Where it has come to know it is right.
    assert np.mean(wrong[np.asarray(seen.decided)]) < 0.01
    assert np.all(worse.started)
    assert not np.any(worse.decided)
    assert np.all(worse.hypotheses > 1)
    assert np.mean(worse.flip_probability) > 0.1


@pytest.mark.long
def test_a_short_drive_across_decides_for_the_truth():
    """Two metres, of which the mirror image would have seen another side of the marker."""
    seen = run(car(), sensed(SIDEWAYS, 0.4))
    position_m, heading_rad = errors_of(seen, SIDEWAYS)
    assert not np.any(seen.decided[:, 0])
    assert np.all(seen.decided[:, -1])
    assert np.all(seen.flip_probability[:, -1] < 1e-3)
    # Whenever it says so it is right. The mirror image is some 25 degrees and 1.3 m off.
    sure = np.asarray(seen.decided)
    assert np.max(heading_rad[sure]) < np.deg2rad(12)
    assert np.max(position_m[sure]) < 0.7
    assert np.median(position_m[:, -1]) < 0.1
    assert np.max(position_m[:, -1]) < 0.3
    # The reported pose jumps to the other branch only where the reported hypothesis changes.
    jumped = np.abs(kalman.wrap(np.diff(seen.pose[..., 2], axis=1))) > np.deg2rad(20)
    changed = np.diff(seen.hypothesis, axis=1) != 0
    assert np.any(jumped)
    assert np.all(changed[jumped])
    assert not np.any(jumped & sure[:, :-1])


@pytest.mark.parametrize("seed", [1, pytest.param(3, marks=pytest.mark.long)])
def test_wheels_that_slip_choose_no_branch(seed):
    """They turn a car a tenth less than they say, so that all branches are contradicted alike."""
    poses = arc((2.0, -1.0, np.deg2rad(125.0)), 0.5, -0.4)
    slipping = sensed(poses, 1.1 * 0.5, -0.4, seed=seed)

    def wrong_once_decided(max_inflation: float, *seeds: int) -> np.ndarray:
        nav = eqx.tree_at(lambda n: n.selector.max_inflation, car(), max_inflation)
        seen = run(nav, slipping, seeds)
        assert np.all(np.any(seen.decided, axis=1))
        return (errors_of(seen, poses)[1] > np.deg2rad(20)) & np.asarray(seen.decided)

    assert not np.any(wrong_once_decided(car().selector.max_inflation, *range(SEEDS)))
    assert any(np.any(wrong_once_decided(1.0, seed)) for seed in range(SEEDS))


def test_one_gross_outlier_changes_nothing():
    """One frame in which another thing was taken for the marker, or, in every other drive, its
    corners were mixed up."""
    poses, frame = arc((1.2, 0.2, np.deg2rad(170.0)), 0.3, 0.0), 40
    obs = sensed(poses, 0.3)
    clean = run(car(), obs, range(4))
    assert np.all(clean.decided[:, frame - 1 :])
    assert np.max(errors_of(clean, poses)[0][:, frame - 1 :]) < 0.05
    corners_px = obs.corners_px.copy()
    corners_px[::2, frame] += [60.0, -25.0]
    corners_px[1::2, frame] = np.roll(corners_px[1::2, frame], 1, axis=3)
    spoilt = run(car(), eqx.tree_at(lambda o: o.corners_px, obs, corners_px), range(4))
    assert np.all(spoilt.nis[:, frame] > 100)
    assert np.all(spoilt.rejections[:, frame] == 1)
    assert np.all(spoilt.rejections[:, frame + 1] == 0)
    assert np.all(spoilt.decided[:, frame:])
    assert np.all(spoilt.flip_probability[:, frame] < 1e-6)
    # Later two poses of the marker come close, and it is in doubt which one is nearer anyway.
    more = np.asarray(spoilt.flip_probability) - np.asarray(clean.flip_probability)
    assert np.max(more[:, frame:]) < 1e-3
    gaps_m, gaps_rad = errors_of(spoilt, np.asarray(clean.pose))
    assert np.max(gaps_m) < 0.01
    assert np.max(gaps_rad) < np.deg2rad(0.5)


def test_the_reported_pose_s_own_tails_are_part_of_the_flip_probability():
    """One hypothesis alone, and nothing in view: what its heading's sigma says."""
    far_deg = 20.0
    snapshot = view(NEAR)
    blind = dataclasses.replace(snapshot.obs, visible=jnp.asarray(np.zeros((4, 1), bool)))
    nothing = snap(snapshot.rig, snapshot.markers, blind, 0.3)
    prior = priors(NEAR)
    only = eqx.tree_at(lambda p: p.initialised, prior, jnp.asarray(np.arange(8) == 3))
    decides = eqx.tree_at(lambda s: s.decided_mass, EXACT, MultiHypothesis().decided_mass)
    for sigma_deg in (2.0, 10.0, 40.0):
        P = np.diag([0.05, 0.05, 0, 0, 0, np.deg2rad(sigma_deg)]) ** 2
        wide = eqx.tree_at(lambda p: p.covariance, only, jnp.asarray(np.tile(P, (8, 1, 1))))
        selection = select(decides, wide, find(nothing), nothing)
        expected = 2 * scipy.stats.norm.sf(far_deg / sigma_deg)
        assert float(selection.flip_probability) == pytest.approx(expected, rel=1e-3, abs=1e-12)
        assert bool(selection.decided) == (sigma_deg < 12)


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"hypotheses": 4}, "at least 5"),
        ({"outlier_log_evidence": -12.0}, "a single frame would decide.*decided_mass, 3e-05"),
        ({"outlier_log_evidence": float(np.log(3e-5))}, "a single frame would decide"),
        ({"outlier_log_evidence": -5.0, "decided_mass": 0.01}, "decided_mass, 0.01"),
    ],
)
def test_a_bank_without_room_for_a_fan_or_in_which_one_frame_decides_is_refused(options, told):
    with pytest.raises(ValueError, match=told):
        MultiHypothesis(**options)
    # One that never decides, or needs two frames, is made.
    MultiHypothesis(outlier_log_evidence=-1e9, decided_mass=0.0)
    MultiHypothesis(outlier_log_evidence=float(np.log(3e-5)) + 1e-6, decided_mass=3e-5)


def test_it_recovers_from_being_carried_off():
    """After 2 s, by a metre and a quarter turn; the wheels tell nothing of it. Ten rejected frames
    start a new fan."""
    frame, patience = 30, car().motion.max_rejections
    before = arc((1.2, 0.2, np.deg2rad(170.0)), 0.3, 0.0, frame)
    after = arc((-0.9, -0.4, np.deg2rad(20.0)), 0.3, 0.0, FRAMES - frame)
    poses = np.concatenate([before, after])
    seen = run(car(), sensed(poses, 0.3), range(4))
    rejected = seen.rejections[:, frame - 1 : frame + patience + 1]
    np.testing.assert_array_equal(rejected, [[*range(patience + 1), 0]] * 4)
    assert np.all(seen.hypotheses[:, frame + patience] > seen.hypotheses[:, frame - 1])
    position_m, _ = errors_of(seen, poses)
    assert np.max(position_m[:, frame - 1]) < 0.05
    assert np.min(position_m[:, frame]) > 1
    two_seconds = frame + round(2 / PERIOD_S)
    assert np.max(position_m[:, two_seconds:]) < 0.1
    assert np.all(seen.decided[:, two_seconds:])


@pytest.mark.long
@in_float32
def test_a_step_has_finite_gradients(precision):
    """Of the whole step with the bank, started and not, seeing (from the side, and exactly
    frontally and where it believes to be) and blind."""
    rig, markers, count = car().rig, car().markers, 8
    selector = MultiHypothesis(hypotheses=count)
    nav = Navigator(rig, markers, worlds.qcar(), selector=selector, max_candidates=2)
    frontal = np.asarray((0.0, -0.4, np.pi / 2))
    sideways, frontally = (
        jax.tree.map(lambda leaf: leaf[0, 0], sensed(*view))
        for view in ((SIDEWAYS, 0.4), (frontal, 0.0, 0.0, 0.0))
    )
    # A bank that has started: two of its members are the same to the last digit, one is right.
    off = np.linspace(-1, 1, count)
    off[1], off[4] = -1, 0

    def started(pose):
        mean = np.append(pose, [0, 0, 0]) + np.outer(off, [0.3, 0.1, 0.3, 0, 0, 0])
        return eqx.tree_at(
            lambda s: (s.belief.bank.mean, s.belief.bank.covariance, s.belief.bank.initialised),
            nav.init(),
            (
                jnp.asarray(mean),
                jnp.tile(0.05**2 * jnp.eye(6), (count, 1, 1)),
                jnp.ones(count, bool),
            ),
        )

    @jax.jit
    @jax.grad
    def slope(floats, state, visible, steering_rad):
        corners_px, speed_mps, dt_s, sigma_px, density, mean, covariance = floats
        changed = eqx.tree_at(
            lambda n: (n.corner_sigma_px, n.motion.acceleration_density), nav, (sigma_px, density)
        )
        state = eqx.tree_at(
            lambda s: (s.belief.bank.mean, s.belief.bank.covariance), state, (mean, covariance)
        )
        reading = Observation(corners_px, visible, speed_mps, steering_rad, dt_s)
        state, out = changed.step(state, reading)
        belief = state.belief.bank
        told = (belief.mean, belief.covariance, belief.log_weight, out.flip_probability, out.nis)
        return sum(jnp.sum(leaf) for leaf in told)

    at_first = nav.init()
    for before, obs in (
        (at_first, sideways),
        (started(SIDEWAYS[0]), sideways),
        (at_first, frontally),
        (started(frontal), frontally),
    ):
        for visible in (obs.visible, jnp.zeros_like(obs.visible)):
            belief = before.belief.bank
            floats = (
                obs.corners_px, obs.speed_mps, obs.dt_s, nav.corner_sigma_px,
                nav.motion.acceleration_density, belief.mean, belief.covariance,
            )  # fmt: skip
            slopes = slope(floats, before, visible, obs.steering_rad)
            assert all(leaf.dtype == precision and np.all(np.isfinite(leaf)) for leaf in slopes)
            seen_slope = np.asarray(slopes[0])[np.asarray(obs.visible)]
            assert np.any(seen_slope != 0) == bool(jnp.any(visible))


def test_what_is_no_other_candidate_is_no_flip():
    """Not the selected one itself, which a compiler may compute twice, nor one that merges with it;
    wherever it lies, the probability has a slope."""
    yaw_rad = jnp.asarray(np.deg2rad([0.0, 0.0, 0.5, 40.0]))
    here = worlds.planar(0.0, 0.0, np.deg2rad(2.0)).wxyz_xyz

    def of(nudge_rad, selected, valid) -> jax.Array:
        turns_rad = yaw_rad + nudge_rad * jnp.array([0.0, 1.0, 0.0, 0.0])
        Ts = jax.vmap(lambda psi: worlds.planar(0.0, 0.0, psi).inverse())(turns_rad)
        found = dataclasses.replace(Candidates.none(4, float), T_vehicle_world=Ts, valid=valid)
        return nearer_to_another(
            jaxlie.SE3(here[None]), 0.1**2 * jnp.eye(6)[None], found, selected
        )[0]

    value_and_slope = jax.jit(jax.value_and_grad(of))

    def probability(nudge_rad, selected: int, valid: list[bool]) -> float:
        value, slope = value_and_slope(nudge_rad, selected, jnp.asarray(valid))
        assert np.isfinite(slope)
        return float(value)

    expected = scipy.stats.norm.sf((20.0 - 2.0) / np.rad2deg(0.1))
    for nudge_rad in (0.0, 1e-12, 1e-9, 1e-7):
        alone = probability(nudge_rad, 0, [True, False, False, True])
        np.testing.assert_allclose(alone, expected, rtol=0.3)
        for selected in (0, 1, 2):
            several = probability(nudge_rad, selected, [True] * 4)
            np.testing.assert_allclose(several, alone, rtol=0.2)
        assert probability(nudge_rad, 0, [True, True, True, False]) == 0
    assert probability(0.0, 3, [True] * 4) > 0.99
