"""The likelihood of corners against integrals over all poses, statistics and a rotated world."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from jaxnav.core.filter.bank import Bank
from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.filter.fit import fit_poses
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.kalman import white_acceleration
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.geometry import OFF_GROUND, T_world_vehicle_from_planar
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation, log_sigmas
from jaxnav.experiments.tuning.filter import trust_corners
from tests import worlds
from tests.helpers import filters
from tests.reference import kalman as textbook
from tests.reference.rigid import matrix

RIG, MARKERS, CAR = worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar()
VIEW = np.array(worlds.OVERLAP_VIEW)  # two cameras see the marker
BANK = MultiHypothesis(floor_m=0.0, floor_rad=0.0)
TINY = 1e-9


def navigator(selector, ground_plane=False, tilt_sigma_rad=TINY, height_sigma_m=TINY, **motion):
    motion = {"vision_floor": jnp.full(3, TINY)} | motion
    car = BicycleKalman(CAR, tilt_sigma_rad=tilt_sigma_rad, height_sigma_m=height_sigma_m, **motion)
    return trust_corners(
        Navigator(RIG, MARKERS, CAR, selector=selector, motion=car, ground_plane=ground_plane)
    )


believing = functools.partial(filters.believing, BicycleKalman(CAR))


@jax.jit
def at_rest(pose, P) -> Bank:
    covariance = jnp.eye(6).at[:3, :3].set(P)
    return believing(jnp.append(jnp.asarray(pose), jnp.zeros(3)), covariance)


@jax.jit
def look(nav: Navigator, belief: Bank, obs: Observation):
    """The log-likelihood, and the belief afterwards."""
    return looked(nav, belief, obs)


def looked(nav: Navigator, belief: Bank, obs: Observation):
    after, estimate = nav.sense(nav.believe(belief), obs)
    return estimate.log_likelihood, after.bank


def seen_from(pose, sigma_px=1.0, seed=0) -> Observation:
    noise_px = sigma_px * np.random.default_rng(seed).normal(size=(4, 1, 4, 2))
    obs = worlds.observe(RIG, MARKERS, worlds.planar(*pose), jnp.asarray(noise_px))
    return dataclasses.replace(obs, has_odometry=jnp.asarray(False))


@jax.jit
def squared_px2(obs: Observation, poses):
    """How far corners are from where each of many planar poses (N, 3) would put them."""

    def one(pose):
        T_vehicle_world = T_world_vehicle_from_planar(pose).inverse()
        gaps = RIG.project(T_vehicle_world, MARKERS.corners_world_m) - obs.corners_px
        return jnp.sum(jnp.where(obs.visible[:, :, None, None], gaps**2, 0))

    return jax.lax.map(one, poses, batch_size=4096)


def log_integral(obs: Observation, sigma_px, mean, P, about: Bank) -> float:
    """log of the prior times the density of the corners, summed over a grid of (x, y, psi)."""
    center = np.asarray(about.mean[0, :3])
    root = np.linalg.cholesky(np.asarray(about.covariance[0, :3, :3]))
    ticks = np.linspace(-6, 6, 37)
    grid = np.stack(np.meshgrid(ticks, ticks, ticks, indexing="ij"), -1).reshape(-1, 3)
    poses = center + grid @ root.T
    away = poses - mean
    exponents = np.asarray(squared_px2(obs, jnp.asarray(poses))) / sigma_px**2
    exponents = exponents + np.sum(away @ np.linalg.inv(P) * away, axis=1)
    cell = (ticks[1] - ticks[0]) ** 3 * np.linalg.det(root)
    coordinates = 8 * int(obs.visible.sum())
    constants = np.log(cell) - coordinates * np.log(sigma_px) - np.linalg.slogdet(P)[1] / 2
    least = exponents.min()
    log_sum = np.log(np.sum(np.exp((least - exponents) / 2))) - least / 2
    return log_sum + constants - 1.5 * np.log(2 * np.pi)


NEAR = VIEW + np.array([0.005, -0.01, 0.01])
ALONE = np.diag([0.01, 0.02, 0.015]) ** 2
MIX = np.diag([0.02, 0.01, 0.03]) @ [[1, 0, 0], [0.4, 1, 0], [-0.3, 0.5, 1]]
PARAMETERS = [
    (1.0, NEAR, ALONE),
    (1.5, NEAR, ALONE),
    (0.6, NEAR, ALONE),
    (1.0, NEAR, MIX @ MIX.T),
    (1.0, VIEW + np.array([-0.02, 0.03, -0.03]), ALONE),
    (1.0, VIEW, 100 * ALONE),
    (2.0, VIEW, ALONE / 100),
]


@pytest.mark.parametrize(
    ("selector", "atol"),
    [(BANK, 0.02), (LowestReprojection(), 0.3)],
    ids=["bank", "choosing"],
)
def test_differences_are_those_of_the_integral_over_all_poses(selector, atol):
    """Whoever chooses takes the corners for Gaussian about the candidate, on the ground as well."""
    obs = seen_from(VIEW)
    found, expected = [], []
    for sigma_px, mean, P in PARAMETERS:
        belief = at_rest(mean, P)
        nav = navigator(selector, ground_plane=selector is not BANK)
        nav, bank = (
            eqx.tree_at(lambda n: n.corner_sigma_px, n, jnp.asarray(sigma_px, float))
            for n in (nav, navigator(BANK))
        )
        found.append(float(look(nav, belief, obs)[0]))
        expected.append(log_integral(obs, sigma_px, mean, P, look(bank, belief, obs)[1]))
    assert np.ptp(expected) > 5
    np.testing.assert_allclose(
        np.subtract(found, found[0]), np.subtract(expected, expected[0]), atol=atol
    )


def test_nothing_is_likely_where_nothing_is_seen_or_believed():
    nav, obs = navigator(BANK), seen_from(VIEW)
    hidden = dataclasses.replace(obs, visible=jnp.zeros_like(obs.visible))
    belief = at_rest(NEAR, ALONE)
    assert float(look(nav, belief, hidden)[0]) == 0
    empty = eqx.tree_at(lambda b: b.initialised, belief, jnp.zeros(1, bool))
    assert float(look(navigator(LowestReprojection(), ground_plane=True), empty, obs)[0]) == 0


CHOOSING = pytest.param(LowestReprojection(), TINY, id="choosing", marks=pytest.mark.long)


@pytest.mark.parametrize(
    ("selector", "tilt_sigma_rad"), [pytest.param(BANK, 0.01, id="bank"), CHOOSING]
)
def test_the_truth_is_the_most_likely_on_average(selector, tilt_sigma_rad):
    """Poses drawn from the prior, corners from the poses: the slope of the log-likelihood at the
    true sigma and the true prior is zero on average, whatever a selector leaves out of account.

    Source: Fisher's score; Casella, Berger (2002), Eq. 7.3.8.
    """
    sigma_px, sigmas, count, step = 0.5, jnp.asarray([0.03, 0.03, 0.03]), 300, 0.02
    nav = navigator(selector, tilt_sigma_rad=tilt_sigma_rad, height_sigma_m=tilt_sigma_rad / 2)
    off_ground = jnp.asarray(OFF_GROUND * [tilt_sigma_rad / 2, tilt_sigma_rad, tilt_sigma_rad])
    steps = jnp.asarray([[step, 0], [-step, 0], [0, step], [0, -step]])

    @jax.jit
    @jax.vmap
    def slopes(key):
        on, off, noise = (
            jax.random.normal(k, shape)
            for k, shape in zip(jax.random.split(key, 3), [(3,), (3,), (4, 1, 4, 2)], strict=True)
        )
        pose = jnp.asarray(VIEW) + sigmas * on
        tilted = jaxlie.SE3.exp(jnp.sum(off_ground * off[None], axis=1))
        T_world_vehicle = T_world_vehicle_from_planar(pose) @ tilted
        obs = worlds.observe(RIG, MARKERS, T_world_vehicle, sigma_px * noise)
        obs = dataclasses.replace(obs, has_odometry=jnp.asarray(False))

        def log_likelihood(logs):
            sigma, scale = jnp.exp(logs)
            told = eqx.tree_at(lambda n: n.corner_sigma_px, nav, sigma_px * sigma)
            return looked(told, at_rest(VIEW, jnp.diag((sigmas * scale) ** 2)), obs)[0]

        ahead_behind = jax.vmap(log_likelihood)(steps).reshape(2, 2)
        return (ahead_behind[:, 0] - ahead_behind[:, 1]) / (2 * step)

    found = np.asarray(slopes(jax.random.split(jax.random.key(1), count)))
    assert np.all(np.isfinite(found))
    errors = found.std(axis=0) / np.sqrt(count)
    assert np.all(np.abs(found.mean(axis=0)) < 4 * errors + 0.05), (found.mean(axis=0), errors)
    assert np.all(errors < 0.3)


def test_without_a_floor_it_is_laplace_s_evidence():
    """What the corners say alone and what they say with the prediction, put together again."""
    for tilt_sigma_rad in (0.0, 0.01):
        motion = navigator(BANK, tilt_sigma_rad=tilt_sigma_rad or TINY).motion
        motion = eqx.tree_at(lambda m: m.tilt_sigma_rad, motion, jnp.asarray(tilt_sigma_rad))
        gaps = []
        for seed in range(4):
            snapshot = filters.snap(RIG, MARKERS, seen_from(VIEW, seed=seed), 0.7)
            offset = 0.01 * np.random.default_rng(seed).normal(size=3)
            found = fits(motion, at_rest(VIEW + offset, (1 + seed) * ALONE), snapshot)
            gaps.append(float(found.posterior.log_likelihood[0] - found.log_evidence[0]))
        told = float(jax.jit(log_sigmas)(snapshot.seen))
        assert told == pytest.approx(16 * np.log(0.7))
        # What the corners leave of the nuisance is in both.
        np.testing.assert_allclose(gaps, -told, atol=1e-5)


@jax.jit
def fits(motion, bank, snapshot):
    prior = motion.poses(bank)
    T, P = prior.T_world_vehicle, prior.covariance
    return fit_poses(T, P, None, prior, snapshot, jnp.zeros(6), 20)


def turned(angle_rad: float) -> jaxlie.SE3:
    return worlds.planar(0.0, 0.0, angle_rad)


def R6(angle_rad):
    block = turned(angle_rad).rotation().as_matrix()
    return jnp.kron(jnp.eye(2), block)


ROOT = np.random.default_rng(5).normal(size=(6, 6))
UNEVEN = {
    "acceleration_density": jnp.asarray([[0.5, 0.1, 0.02], [0.1, 0.05, 0.0], [0.02, 0.0, 0.2]]),
    "odometry_sigma": jnp.asarray(np.diag([0.02, 0.001, 0.03]) ** 2),
}


@functools.cache
def driven(selector):
    """A second of a drive in a world that is turned, from a belief that is turned with it."""
    nav = navigator(selector, tilt_sigma_rad=0.005, height_sigma_m=0.002, **UNEVEN)
    rng = np.random.default_rng(3)
    pose, poses = VIEW - [0, 0.1, 0], []
    speeds, steerings = rng.uniform(0.1, 0.4, 8), rng.uniform(-0.3, 0.3, 8)
    for speed, steering in zip(speeds, steerings, strict=True):
        pose = pose + 0.125 * speed * np.array([np.cos(pose[2]), np.sin(pose[2]), steering / 0.256])
        poses.append(pose)
    looks = [
        dataclasses.replace(
            seen_from(pose, seed=i), speed_mps=jnp.asarray(speeds[i]), dt_s=jnp.asarray(0.125),
            steering_rad=jnp.asarray(steerings[i]), has_odometry=jnp.asarray(True),
        )
        for i, pose in enumerate(poses)
    ]  # fmt: skip
    obs = jax.tree.map(lambda *leaves: np.stack(leaves), *looks)
    mean = jnp.append(jnp.asarray(VIEW - [0, 0.1, 0]), jnp.asarray([0.1, 0.1, 0.0]))
    P = 1e-3 * ROOT @ ROOT.T

    @jax.jit
    def run(angle_rad):
        T = turned(angle_rad)
        markers = jaxlie.SE3(jax.vmap(lambda wxyz_xyz: (T @ jaxlie.SE3(wxyz_xyz)).wxyz_xyz)(
            MARKERS.Ts_world_marker.wxyz_xyz
        ))  # fmt: skip
        there = eqx.tree_at(lambda n: n.markers.Ts_world_marker, nav, markers)
        R = R6(angle_rad)
        belief = believing(
            jnp.sum(R * mean[None], axis=1).at[2].set(mean[2] + angle_rad), R @ P @ R.T
        )

        def frame(belief, obs):
            log_likelihood, belief = looked(there, belief, obs)
            return belief, log_likelihood

        return jax.lax.scan(frame, belief, obs)

    return run


@pytest.mark.parametrize(
    "selector",
    [
        pytest.param(BANK, id="bank"),
        pytest.param(LowestReprojection(), id="choosing", marks=pytest.mark.long),
    ],
)
@settings(max_examples=25)
@given(angle_rad=st.floats(-7, 7))
@example(angle_rad=np.pi / 2)
def test_a_turned_world_is_followed_as_it_was(selector, angle_rad):
    """Q and the odometry's R are uneven in the vehicle's axes, and turn with it."""
    run = driven(selector)
    (before, log_likelihoods), (after, turned_log_likelihoods) = run(0.0), run(angle_rad)
    assert np.all(np.abs(log_likelihoods) > 1)
    np.testing.assert_allclose(turned_log_likelihoods, log_likelihoods, rtol=1e-6, atol=1e-6)
    R = np.kron(np.eye(2), matrix(filters.level(psi_rad=angle_rad))[:3, :3])
    mean, P = np.asarray(before.mean[0]), np.asarray(before.covariance[0])
    expected = R @ np.delete(mean, 2)[[0, 1, 1, 2, 3, 4]]
    np.testing.assert_allclose(after.mean[0, [0, 1, 3, 4, 5]], expected[[0, 1, 3, 4, 5]], atol=1e-7)
    np.testing.assert_allclose(textbook.wrap(after.mean[0, 2] - mean[2] - angle_rad), 0, atol=1e-7)
    np.testing.assert_allclose(after.covariance[0], R @ P @ R.T, rtol=1e-5, atol=1e-10)


@pytest.mark.parametrize("psi_rad", [0.0, -2.5])
def test_uneven_noise_is_the_world_s_at_that_heading(psi_rad):
    """The textbook's filter has its noise in the world's axes: of one that is the same along and
    across, the same; of one that is not, turned by hand."""
    c, s = np.cos(psi_rad), np.sin(psi_rad)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    mean = np.array([0.3, -0.2, psi_rad, 0.2, -0.1, 0.3])
    P, dt_s = 1e-2 * ROOT @ ROOT.T, 0.1
    obs = filters.reading(0.3, 0.2, dt_s=dt_s)
    even = {
        "acceleration_density": jnp.asarray([0.2, 0.2, 0.7]),
        "odometry_sigma": jnp.full(3, 0.1),
    }
    for noise in (UNEVEN, even):
        motion = BicycleKalman(CAR, **noise)
        after = filters.predicted(motion, believing(mean, P), obs)
        D, odometry = (
            np.asarray(noise[name]) for name in ("acceleration_density", "odometry_sigma")
        )
        D = D if D.ndim == 2 else np.diag(D)
        odometry = odometry if odometry.ndim == 2 else np.diag(odometry**2)
        x, moved = textbook.predict(mean, P, dt_s, np.zeros(3), (0.3, 0.2, 0.256))
        Q = np.kron([[dt_s**3 / 3, dt_s**2 / 2], [dt_s**2 / 2, dt_s]], R @ D @ R.T)
        np.testing.assert_allclose(
            np.asarray(white_acceleration(jnp.asarray(R @ D @ R.T), dt_s)), Q, atol=1e-15
        )
        # In axes in which the odometry's noise is diagonal: the vehicle's own, where it now is.
        R_now = matrix(filters.level(psi_rad=x[2]))[:3, :3]
        turn = np.kron(np.eye(2), R_now.T)
        x_own = turn @ np.append(x[:2], [0, *x[3:]])
        x_own[2] = 0
        x_own, P_own, _ = textbook.update(
            x_own, turn @ (moved + Q) @ turn.T, None, None, 0.3, 0.2, 0.256,
            np.sqrt(np.diagonal(odometry)),
        )  # fmt: skip
        np.testing.assert_allclose(after.covariance[0], turn.T @ P_own @ turn, atol=1e-10)
        expected = turn.T @ np.append(x_own[:2], [0, *x_own[3:]])
        np.testing.assert_allclose(np.delete(after.mean[0], 2), np.delete(expected, 2), atol=1e-9)
        np.testing.assert_allclose(textbook.wrap(after.mean[0, 2] - x_own[2] - x[2]), 0, atol=1e-9)
