"""The likelihood of corners against integrals over all poses, statistics and a rotated world."""

import dataclasses
import functools

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

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
from tests.reference.rigid import cayley, matrix, wxyz_xyz

RIG, MARKERS, CAR = worlds.qcar_rig(), worlds.paper_markers(), worlds.qcar()
VIEW = np.array(worlds.OVERLAP_VIEW)  # two cameras see the marker
BANK, CHOOSES = MultiHypothesis(floor_m=0.0, floor_rad=0.0), LowestReprojection()
SELECTORS = {
    "argvalues": [BANK, pytest.param(CHOOSES, marks=pytest.mark.long)],
    "ids": ["bank", "choosing"],
}
TINY = 1e-9
ROOT = np.random.default_rng(5).normal(size=(6, 6))
UNEVEN = {
    "acceleration_density": jnp.asarray([[0.5, 0.1, 0.02], [0.1, 0.05, 0.0], [0.02, 0.0, 0.2]]),
    "odometry_sigma": jnp.asarray(np.diag([0.02, 0.001, 0.03]) ** 2),
}


def navigator(selector, tilt_sigma_rad=TINY, height_sigma_m=TINY, level=None, **motion):
    """Of one shape: one program does for all that look through the same selector."""
    motion = {"vision_floor": jnp.full(3, TINY, float)} | UNEVEN | motion
    car = BicycleKalman(CAR, tilt_sigma_rad=tilt_sigma_rad, height_sigma_m=height_sigma_m, **motion)
    level = selector is CHOOSES if level is None else level
    nav = Navigator(RIG, MARKERS, CAR, selector=selector, motion=car, ground_plane=level)
    return trust_corners(nav)


believing = functools.partial(filters.believing, BicycleKalman(CAR))


@jax.jit
def at_rest(pose, P) -> Bank:
    covariance = jnp.eye(6).at[:3, :3].set(P)
    return believing(jnp.append(jnp.asarray(pose), jnp.zeros(3)), covariance)


@jax.jit
def look(nav: Navigator, belief: Bank, obs: Observation):
    """The log-likelihood, and the belief afterwards."""
    after, estimate = nav.sense(nav.believe(belief), obs)
    return estimate.log_likelihood, after.bank


def see(T: np.ndarray, noise_px, speed_mps=0.0, steering_rad=0.0, dt_s=0.0) -> Observation:
    """From a pose as a matrix; odometry that moves counts."""
    numbers = {"speed_mps": speed_mps, "steering_rad": steering_rad, "dt_s": dt_s}
    there = jaxlie.SE3(jnp.asarray(wxyz_xyz(T)))
    obs = worlds.observe(RIG, MARKERS, there, jnp.asarray(noise_px), **numbers)
    return dataclasses.replace(obs, has_odometry=jnp.asarray(dt_s > 0))


def seen_from(pose, sigma_px=1.0, seed=0, **odometry) -> Observation:
    noise_px = sigma_px * np.random.default_rng(seed).normal(size=(4, 1, 4, 2))
    return see(matrix(filters.level(*pose)), noise_px, **odometry)


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


@pytest.mark.parametrize("selector", **SELECTORS)
def test_differences_are_those_of_the_integral_over_all_poses(selector):
    """Whoever chooses takes the corners for Gaussian about the candidate, on the ground as well."""
    obs = seen_from(VIEW)
    found, expected = [], []
    for sigma_px, mean, P in PARAMETERS:
        belief = at_rest(mean, P)
        nav = navigator(selector)
        nav, bank = (
            eqx.tree_at(lambda n: n.corner_sigma_px, n, jnp.asarray(sigma_px, float))
            for n in (nav, navigator(BANK))
        )
        found.append(float(look(nav, belief, obs)[0]))
        expected.append(log_integral(obs, sigma_px, mean, P, look(bank, belief, obs)[1]))
    assert np.ptp(expected) > 5
    np.testing.assert_allclose(
        np.subtract(found, found[0]),
        np.subtract(expected, expected[0]),
        atol=0.02 if selector is BANK else 0.3,
    )


def test_nothing_is_likely_where_nothing_is_seen_or_believed():
    nav, obs = navigator(BANK), seen_from(VIEW)
    hidden = dataclasses.replace(obs, visible=jnp.zeros((4, 1), bool))
    belief = at_rest(NEAR, ALONE)
    assert float(look(nav, belief, hidden)[0]) == 0
    empty = dataclasses.replace(belief, initialised=jnp.zeros(1, bool))
    assert float(look(navigator(CHOOSES), empty, obs)[0]) == 0


@pytest.mark.parametrize(
    "selector", [BANK, pytest.param(CHOOSES, marks=pytest.mark.long)], ids=type
)
def test_the_truth_is_the_most_likely_on_average(selector):
    """Poses drawn from the prior, corners from the poses: the slope of the log-likelihood at the
    true sigma and the true prior is zero on average, whatever a selector leaves out of account.

    Source: Fisher's score; Casella, Berger (2002), Eq. 7.3.8.
    """
    sigma_px, sigma, count, step = 0.5, 0.03, 200, 0.02
    tilt = 0.01 if selector is BANK else TINY
    nav = navigator(selector, tilt, tilt / 2, level=False)
    off_ground, rng = OFF_GROUND * [tilt / 2, tilt, tilt], np.random.default_rng(1)
    # Ahead and behind, by the logarithm of sigma_px, and of the prior's.
    moves = [(step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step)]
    told = [
        (
            eqx.tree_at(lambda n: n.corner_sigma_px, nav, jnp.asarray(sigma_px * np.exp(by_px))),
            at_rest(VIEW, (sigma * np.exp(by_prior)) ** 2 * np.eye(3)),
        )
        for by_px, by_prior in moves
    ]
    found = []
    for _ in range(count):
        T = matrix(filters.level(*(VIEW + sigma * rng.normal(size=3))))
        T = T @ cayley(off_ground @ rng.normal(size=3))
        obs = see(T, sigma_px * rng.normal(size=(4, 1, 4, 2)))
        values = [float(look(*one, obs)[0]) for one in told]
        found.append([(values[i] - values[i + 1]) / (2 * step) for i in (0, 2)])
    assert np.all(np.isfinite(found))
    errors = np.std(found, axis=0) / np.sqrt(count)
    assert np.all(np.abs(np.mean(found, axis=0)) < 4 * errors + 0.05), errors
    assert np.all(errors < 0.4)


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


def turned(angle_rad: float) -> np.ndarray:
    return matrix(filters.level(psi_rad=angle_rad))


@functools.cache
def drive() -> list[Observation]:
    """A second of a drive."""
    rng = np.random.default_rng(3)
    pose, looks = VIEW - [0, 0.1, 0], []
    speeds, steerings = rng.uniform(0.1, 0.4, 8), rng.uniform(-0.3, 0.3, 8)
    for i, (speed, steering) in enumerate(zip(speeds, steerings, strict=True)):
        pose = pose + 0.125 * speed * np.array([np.cos(pose[2]), np.sin(pose[2]), steering / 0.256])
        odometry = {"speed_mps": speed, "steering_rad": steering, "dt_s": 0.125}
        looks.append(seen_from(pose, seed=i, **odometry))
    return looks


MEAN = np.append(VIEW - [0, 0.1, 0], [0.1, 0.1, 0.0])


def followed(selector, angle_rad: float):
    """In a world that is turned, from a belief that is turned with it."""
    nav = navigator(selector, tilt_sigma_rad=0.005, height_sigma_m=0.002)
    markers = wxyz_xyz(turned(angle_rad) @ matrix(MARKERS.Ts_world_marker.wxyz_xyz))
    there = eqx.tree_at(lambda n: n.markers.Ts_world_marker.wxyz_xyz, nav, jnp.asarray(markers))
    R = np.kron(np.eye(2), turned(angle_rad)[:3, :3])
    mean = R @ MEAN
    mean[2] = MEAN[2] + angle_rad
    belief, log_likelihoods = believing(mean, R @ (1e-3 * ROOT @ ROOT.T) @ R.T), []
    for obs in drive():
        log_likelihood, belief = look(there, belief, obs)
        log_likelihoods.append(float(log_likelihood))
    return belief, np.array(log_likelihoods)


@pytest.mark.parametrize("selector", **SELECTORS)
def test_a_turned_world_is_followed_as_it_was(selector):
    """Q and the odometry's R are uneven in the vehicle's axes, and turn with it."""
    before, log_likelihoods = followed(selector, 0.0)
    assert np.all(np.abs(log_likelihoods) > 1)
    mean, P = np.asarray(before.mean[0]), np.asarray(before.covariance[0])
    anywhere = np.random.default_rng(7).uniform(-7, 7, 10)
    for angle_rad in (np.pi / 2, np.pi, 0.01, *anywhere):
        after, turned_log_likelihoods = followed(selector, angle_rad)
        np.testing.assert_allclose(turned_log_likelihoods, log_likelihoods, rtol=1e-6, atol=1e-6)
        R = np.kron(np.eye(2), turned(angle_rad)[:3, :3])
        expected = R @ [*mean[:2], 0, *mean[3:]]
        expected[2] = textbook.wrap(mean[2] + angle_rad)
        gap = np.asarray(after.mean[0]) - expected
        gap[2] = textbook.wrap(gap[2])
        np.testing.assert_allclose(gap, 0, atol=1e-7)
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
        "odometry_sigma": jnp.full(3, 0.1, float),
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
