"""Errors of sensors and cameras as states: against dense least squares and textbook filters."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from jaxnav.core.filter.choose import MeasuredPose
from jaxnav.core.filter.errors import EACH, ErrorsPosterior, common_turn, schmidt_update_along
from jaxnav.core.filter.fit import fit_poses
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.motion import follow_pose
from jaxnav.core.filter.odometry import SENSORS_END, SIX, SLIP
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.geometry import ON_GROUND, cayley
from jaxnav.core.models.rig import PLACED_BY_HAND
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.residuals import camera_slopes, reprojection_rows
from tests import worlds
from tests.helpers.filters import believing, predicted, reading, snap
from tests.reference import rigid
from tests.reference.rigid import matrix, wxyz_xyz

SIGMA = np.array([0.03, 0.03, 0.01, 0.02])
SLIP_SIGMA = 0.05
VIEW = worlds.OVERLAP_VIEW  # two cameras see the marker
PLANAR = jnp.asarray(ON_GROUND, float)


def off_rig():
    rig = worlds.qcar_rig()
    return dataclasses.replace(rig, extrinsics_sigma=jnp.tile(jnp.asarray(PLACED_BY_HAND), (4, 1)))


def off_car():
    return dataclasses.replace(worlds.qcar(), sensor_sigma=jnp.asarray(SIGMA))


def spd(n: int, rng: np.random.Generator, scale: np.ndarray) -> np.ndarray:
    A = rng.normal(size=(n, 2 * n)) / np.sqrt(2 * n)
    return scale[:, None] * (A @ A.T) * scale[None]


@pytest.fixture(scope="module")
def navigator() -> Navigator:
    return Navigator(off_rig(), worlds.paper_markers(), off_car(), selector=MultiHypothesis())


def bank_at(navigator: Navigator, rng: np.random.Generator):
    """A single hypothesis at VIEW, all of its states correlated."""
    n = navigator.motion.init(1).mean.shape[1]
    scale = np.concatenate(
        [[0.03, 0.03, 0.03], [0.1] * 3, [SLIP_SIGMA], SIGMA, np.ones(n - SENSORS_END)]
    )
    mean = np.zeros(n)
    mean[:3] = VIEW + 0.01 * rng.normal(size=3)
    mean[3:SIX] = 0.3, -0.1, 0.2
    mean[SIX:] = 0.3 * scale[SIX:] * rng.normal(size=n - SIX)
    return believing(navigator.motion, mean, spd(n, rng, scale))


@jax.jit
def first(bank):
    """Its first hypothesis, without an axis."""
    return jax.tree.map(lambda leaf: leaf[0], bank)


@jax.jit
def driven(motion, bank, readings, poses, sigma):
    """The last bank of one hypothesis, and its means, whose poses no gate looks at.

    Args:
        readings: (frames, reads, 3), speed, steering and time since the one before.
        poses: (frames, 3), planar.
        sigma: (3,) of the poses.
    """
    R = PLANAR @ jnp.diag(sigma**2) @ PLANAR.T

    def read(bank, told):
        speed_mps, steering_rad, dt_s = told
        return motion.predict(bank, reading(speed_mps, steering_rad, dt_s=dt_s)), None

    def frame(bank, told):
        bank, _ = jax.lax.scan(read, bank, told[0])
        seen = MeasuredPose(worlds.planar(*told[1]), R, jnp.zeros(()), jnp.asarray(True))
        mean, P = motion.offer(first(bank), seen).posterior
        return dataclasses.replace(bank, mean=mean[None], covariance=P[None]), mean

    return jax.lax.scan(frame, bank, (readings, poses))


def test_a_fit_with_cameras_that_are_off_is_dense_least_squares(navigator):
    """Pose, turns, places and the vehicle's tilt as the unknowns of one problem, by SciPy."""
    rng = np.random.default_rng(5)
    noise_px = rng.normal(size=(4, 1, 4, 2))
    obs = worlds.observe(
        off_rig(), worlds.paper_markers(), worlds.planar(*VIEW), jnp.asarray(noise_px)
    )
    snapshot = snap(off_rig(), worlds.paper_markers(), obs, 1.0)
    assert int(jnp.sum(snapshot.seen.visible)) == 2
    bank = bank_at(navigator, rng)
    prior = eqx.filter_jit(navigator.motion.poses)(bank)
    fit = jax.jit(fit_poses, static_argnums=6)(
        prior.T_world_vehicle, prior.covariance, prior.errors, prior, snapshot, jnp.zeros(6), 60
    )

    moves = jax.jit(camera_slopes)(snapshot.rig, snapshot.markers, snapshot.seen)
    corners = snapshot.markers.corners_world_m[snapshot.seen.marker_index].reshape(-1, 3)
    T_prior = jaxlie.SE3(prior.T_world_vehicle.wxyz_xyz[0])
    e = prior.errors.mean.shape[1]
    P = np.block(
        [
            [PLANAR.T @ prior.covariance[0] @ PLANAR, PLANAR.T @ prior.errors.cross[0]],
            [(PLANAR.T @ prior.errors.cross[0]).T, prior.errors.covariance[0]],
        ]
    )
    root = np.linalg.cholesky(P)
    turns = np.zeros((e, moves.turns.shape[1]))
    for group, camera in enumerate(np.asarray(moves.camera)):
        turns[EACH * camera : EACH * (camera + 1)] += np.asarray(moves.turns[:, :, group])
    places = np.asarray(moves.places).transpose(2, 0, 1).reshape(-1, turns.shape[1])

    # The vehicle's nuisance, as the estimator linearises it: at the prediction.
    @jax.jit
    def at(xi):
        rows = reprojection_rows(snapshot.rig, snapshot.seen)
        return rows(moved(T_prior @ cayley(xi), corners))[0].reshape(-1)

    tilt = jax.jit(jax.jacobian(lambda t: at(prior.nuisance @ t)))(
        jnp.zeros(prior.nuisance.shape[1])
    )

    def residuals(x):
        y, b, t = np.split(x, [3 + e, 3 + e + len(places)])
        xi, q = np.split(root @ y, [3])
        q = q + np.asarray(prior.errors.mean[0])
        r = np.asarray(at(ON_GROUND @ xi)) + q @ turns + b @ places + np.asarray(tilt) @ t
        return np.concatenate([r, x])

    found = least_squares(residuals, np.zeros(3 + e + len(places) + 3), method="lm", xtol=1e-14)
    y = root @ found.x[: 3 + e]
    C = root @ np.linalg.inv(found.jac.T @ found.jac)[: 3 + e, : 3 + e] @ root.T
    T_expected = matrix(T_prior.wxyz_xyz) @ rigid.cayley(ON_GROUND @ y[:3])
    T = jaxlie.SE3(fit.posterior.T_world_vehicle.wxyz_xyz[0])
    np.testing.assert_allclose(matrix(T.wxyz_xyz), T_expected, atol=2e-6)
    seen = np.asarray(fit.posterior.errors.rows[0]).sum(0) > 0
    assert seen.sum() == 2 * EACH
    q = np.asarray(fit.posterior.errors.rows[0]).T @ np.asarray(fit.posterior.errors.change[0])
    np.testing.assert_allclose(q[seen], y[3:][seen], atol=1e-4)

    # The rest of the state, by the joint Gaussian of all of it.
    offer = eqx.filter_jit(navigator.motion.offer)(first(bank), first(fit.posterior))
    mean, covariance = map(np.asarray, offer.posterior)
    np.testing.assert_allclose(mean[SENSORS_END:] - bank.mean[0, SENSORS_END:], y[3:], atol=1e-4)
    np.testing.assert_allclose(covariance[SENSORS_END:, SENSORS_END:], C[3:, 3:], atol=2e-3)
    assert np.all(np.linalg.eigvalsh(covariance) > 0)


def test_a_camera_alone_leaves_what_two_have_learnt():
    """The floor is an error of the pose: did the cameras' errors follow it, theirs would grow."""
    rig, markers = off_rig(), worlds.paper_markers()
    motion = Navigator(rig, markers, selector=MultiHypothesis()).motion
    floor = jnp.repeat(jnp.asarray([MultiHypothesis().floor_m, MultiHypothesis().floor_rad]), 3)

    @jax.jit
    def frame(bank, obs):
        bank = motion.predict(bank, obs)
        prior = motion.poses(bank)
        fit = fit_poses(
            prior.T_world_vehicle, prior.covariance, prior.errors, prior,
            snap(rig, markers, obs, 0.2), floor, 60,
        )  # fmt: skip
        mean, P = motion.offer(first(bank), first(fit.posterior)).posterior
        return dataclasses.replace(bank, mean=mean[None], covariance=P[None])

    T = worlds.planar(*VIEW)
    both = worlds.observe(rig, markers, T, jnp.zeros((4, 1, 4, 2)))
    both = dataclasses.replace(both, dt_s=jnp.asarray(1 / 30))
    seen_by = np.flatnonzero(np.asarray(both.visible)[:, 0])
    assert len(seen_by) == 2
    alone = dataclasses.replace(both, visible=both.visible & (np.arange(4)[:, None] == seen_by[0]))
    start = np.append(np.full(6, 0.01), np.append(np.full(6, 0.3), np.ones(4 * EACH)))
    mean = np.append(T.wxyz_xyz, np.zeros(len(start) - 6))
    bank = believing(motion, mean, np.diag(start**2))
    for _ in range(30):
        bank = frame(bank, both)
    learnt = np.diagonal(np.asarray(bank.covariance[0]))[12:]
    for _ in range(30):
        bank = frame(bank, alone)
    P = np.asarray(bank.covariance[0])
    assert np.all(np.diagonal(P)[12:] < learnt + 1e-9)
    assert np.linalg.eigvalsh(P)[0] > 0


@pytest.mark.long
@pytest.mark.parametrize("body", ["car", "free"])
def test_a_start_far_from_its_guess_keeps_a_covariance(navigator, body):
    """Hypotheses of the fan turn by degrees onto the corners, and 3 m away a degree is 5 cm: the
    turns of the cameras go with the corrected pose, not with the guess."""
    if body == "free":
        navigator = Navigator(off_rig(), worlds.paper_markers(), selector=MultiHypothesis())
    rng = np.random.default_rng(0)
    noise_px = rng.normal(size=(4, 1, 4, 2))
    obs = worlds.observe(
        off_rig(), worlds.paper_markers(), worlds.planar(0.0, -1.7, 1.7), jnp.asarray(noise_px)
    )
    bank = jax.jit(navigator.sense)(navigator.believe(navigator.motion.init(24)), obs)[0].bank
    alive = np.asarray(bank.initialised)
    assert alive.sum() > 5
    P = np.asarray(bank.covariance)[alive]
    states = navigator.motion.states
    known = np.r_[0 : states // 2, P.shape[1] - 4 * EACH : P.shape[1]]
    P = P[:, known][:, :, known]
    sigma = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    least = np.linalg.eigvalsh(P / sigma[:, :, None] / sigma[:, None])[:, 0]
    assert np.all(least > 0)


follow = jax.jit(follow_pose, static_argnums=4)


def after_turn(T: jaxlie.SE3, xi: np.ndarray) -> jaxlie.SE3:
    """T * cay(xi), by NumPy."""
    return jaxlie.SE3(jnp.asarray(wxyz_xyz(matrix(T.wxyz_xyz) @ rigid.cayley(xi))))


def moved(T_world_vehicle: jaxlie.SE3, corners):
    return jax.vmap(T_world_vehicle.inverse().apply)(corners).T[..., None]


@pytest.mark.parametrize("seen", ["none", "all", "one hidden"])
@pytest.mark.parametrize("freedom", [ON_GROUND, np.eye(6)], ids=["car", "free"])
def test_the_rest_follows_pose_and_errors_as_a_gaussian_does(freedom, seen):
    """The textbook's joint update by a measurement of pose and errors, of which some are unseen."""
    rng, d, e = np.random.default_rng(7), freedom.shape[1], 4
    n, k = 2 * d + 6, 0 if seen == "none" else 2
    P = spd(n, rng, np.full(n, 0.01))
    H = np.zeros((d + k, n))
    H[:d, :d] = np.eye(d)
    H[d:, n - e :] = np.eye(e)[:k]
    R = spd(d + k, rng, np.full(d + k, 0.01))
    z = 0.003 * rng.normal(size=d + k)
    K = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
    expected, P_expected = K @ z, P - K @ H @ P
    y, C = H @ expected, H @ P_expected @ H.T
    rows, slope = np.eye(e)[:k], C[d:, :d] @ np.linalg.inv(C[:d, :d])
    given = C[d:, d:] - slope @ C[:d, d:]
    if seen == "one hidden":
        y, slope = np.append(y, 0), np.vstack([slope, np.zeros((1, d))])
        given, rows = block_diag(given, 1), np.vstack([rows, np.zeros((1, e))])
    T_prior = worlds.planar(0.3, -0.2, 0.7)
    errors = ErrorsPosterior(*map(jnp.asarray, (y[d:], slope, given, rows)))
    corrected = MeasuredPose(
        after_turn(T_prior, freedom @ y[:d]),
        jnp.asarray(freedom @ C[:d, :d] @ freedom.T),
        jnp.asarray(0.0),
        jnp.asarray(True),
        jnp.asarray(np.zeros(d)),
        jnp.asarray(1.0),
        errors if k else None,
    )
    freedom = jnp.asarray(freedom)
    correction, after = follow(jnp.asarray(P), T_prior, corrected, freedom, n - e)
    np.testing.assert_allclose(correction[:d], y[:d], atol=1e-8)
    np.testing.assert_allclose(correction, expected, atol=2e-5)
    np.testing.assert_allclose(after, P_expected, atol=3e-6)


@jax.jit
def considering(motion, learns, before, after):
    return motion.schmidt_update(learns, before, after)


def test_what_is_considered_keeps_mean_and_covariance(navigator):
    """Schmidt's filter: pose and velocity and their correlations as in the optimal one."""
    motion, rng = navigator.motion, np.random.default_rng(2)
    before = bank_at(navigator, rng)
    x, P = np.asarray(before.mean[0]), np.asarray(before.covariance[0])
    after = x + 0.1, P / 2
    mean, covariance = considering(motion, jnp.asarray(False), (x, P), after)
    np.testing.assert_array_equal(mean[SIX:], x[SIX:])
    np.testing.assert_array_equal(covariance[SIX:, SIX:], P[SIX:, SIX:])
    np.testing.assert_array_equal(mean[:SIX], after[0][:SIX])
    np.testing.assert_array_equal(covariance[:SIX], after[1][:SIX])
    learnt = considering(motion, jnp.asarray(True), (x, P), after)
    for one, other in zip(learnt, after, strict=True):
        np.testing.assert_array_equal(one, other)


def test_a_pose_that_is_inflated_keeps_errors_that_are_considered_in_proportion(navigator):
    """Whatever the prior: with its errors at their prior again the covariance is still one."""
    motion, rng = navigator.motion, np.random.default_rng(5)
    bank = bank_at(navigator, rng)
    x, n, states, d = bank.mean[0], bank.covariance.shape[1], motion.states, 3
    # As correlated as they are after a while: pose, velocity and errors vary as one, nearly.
    alike = rng.normal(size=(n, d))
    P = 0.01**2 * (alike @ alike.T + 0.05 * np.eye(n))
    C, T_prior = P[:d, :d] / 2, worlds.planar(0.3, -0.2, 0.7)
    for inflation in (1.0, 3.0, 10.0):
        corrected = MeasuredPose(
            T_prior,
            jnp.asarray(inflation * ON_GROUND @ C @ ON_GROUND.T),
            jnp.asarray(0.0),
            jnp.asarray(True),
            jnp.asarray(np.zeros(d)),
            jnp.asarray(inflation),
        )
        _, after = follow(jnp.asarray(P), T_prior, corrected, PLANAR, states)
        np.testing.assert_allclose(after[:d, :d], inflation * C, rtol=1e-7, atol=1e-12)
        posterior = jnp.zeros_like(x), after
        _, considered = considering(motion, jnp.asarray(False), (x, jnp.asarray(P)), posterior)
        sigma = np.sqrt(np.diagonal(considered))
        assert np.linalg.eigvalsh(considered / np.outer(sigma, sigma)).min() > -1e-9
        np.testing.assert_array_equal(considered[states:, states:], P[states:, states:])


def test_nothing_is_learnt_while_the_heading_is_open_or_from_odometry(navigator):
    motion = navigator.motion
    bank = motion.init(2)
    P, mean = np.array(bank.covariance), np.array(bank.mean)
    P[:, 2, 2] = 0.01**2
    bank = believing(motion, mean, P, [0.9, 0.1])
    learns = jax.jit(lambda motion, bank: motion.learns(bank))
    assert bool(learns(motion, bank))
    mean[1, 2] = 1.0
    assert not bool(learns(motion, dataclasses.replace(bank, mean=jnp.asarray(mean))))
    obs = reading(0.5, 0.3)
    later = predicted(motion, predicted(motion, bank, obs), obs)
    np.testing.assert_array_equal(later.mean[:, SIX:], 0)
    errors = bank.covariance[:, SIX:, SIX:]
    np.testing.assert_allclose(later.covariance[:, SIX:, SIX:], errors, rtol=1e-12)


def test_a_slip_fades_with_the_way_and_another_comes(navigator):
    """A Gauss-Markov process: the covariance of two slips falls with the way between them."""
    motion, rng = navigator.motion, np.random.default_rng(3)
    bank = bank_at(navigator, rng)
    obs = reading(has_odometry=False)
    way_m = 0.1 * float(jnp.linalg.norm(bank.mean[0, 3:5]))
    f = np.exp(-way_m / motion.slip_length_m)
    later = predicted(motion, bank, obs)
    n = bank.mean.shape[1]
    F = np.eye(n)
    F[SLIP, SLIP] = f
    expected = F @ np.asarray(bank.covariance[0]) @ F.T
    expected[SLIP, SLIP] += (1 - f**2) * SLIP_SIGMA**2
    np.testing.assert_allclose(later.covariance[0, SIX:, SIX:], expected[SIX:, SIX:], rtol=1e-10)
    assert 0.5 < f < 0.95
    assert float(later.mean[0, SLIP]) == pytest.approx(f * float(bank.mean[0, SLIP]))
    still = motion.init(1)  # at its prior it stays there, whatever the way
    moving = eqx.tree_at(lambda b: b.mean, still, still.mean.at[:, 3].set(0.5))
    variance = predicted(motion, moving, obs).covariance[0, SLIP, SLIP]
    assert float(variance) == pytest.approx(SLIP_SIGMA**2)


@pytest.mark.parametrize("slip_sigma", [SLIP_SIGMA, 0.0])
def test_the_pose_follows_where_wheels_spin(slip_sigma):
    """Straight on at 0.3 m/s; after four seconds the odometer reads a quarter more. Two seconds on
    the slip is known and the pose has followed; without one the constant scale takes it along."""
    car = dataclasses.replace(off_car(), sensor_sigma=jnp.asarray([0.03, 0.0, 0.0, 0.0]))
    motion = BicycleKalman(car, slip_sigma=slip_sigma)
    start = motion.init(1)
    bank = believing(motion, start.mean, start.covariance.at[:, :SIX, :SIX].multiply(0.01**2))
    times_s = np.arange(1, 91) / 15
    told = np.tile([0.3, 0, 1 / 15], (90, 1, 1))
    told[times_s >= 4, :, 0] *= 1.25
    poses = np.outer(0.3 * times_s, [1, 0, 0])
    mean = np.asarray(driven(motion, bank, told, poses, np.full(3, 0.01))[1])
    slip, scale = mean[:, SLIP], mean[:, SLIP + 1]
    behind_m = abs(mean[-1, 0] - 0.3 * times_s[-1])
    assert max(abs(slip[times_s < 4]).max(), abs(scale[times_s < 4]).max()) < 0.015
    if slip_sigma:
        assert slip[-1] < -1.5 * SLIP_SIGMA
        assert behind_m < 0.01
    else:
        assert behind_m > 0.03


def steered(rng: np.random.Generator, duration_s: float, by_frame: bool):
    """Planar poses (N, 3) and steering (N,), rad, each ms at 0.35 m/s.

    A servo of 5 rad/s follows targets that change at random times, or 25 ms after each frame.
    """
    times_s = np.arange(0, duration_s, 1e-3)
    if by_frame:
        walk = np.zeros(int(duration_s * 15) + 2)
        for k in range(1, len(walk)):
            walk[k] = np.clip(0.95 * walk[k - 1] + 0.1 * rng.normal(), -0.45, 0.45)
        target = walk[np.clip((times_s - FIRST_S - 0.025) * 15, 0, None).astype(int)]
    else:
        steps = np.cumsum(rng.uniform(0.3, 1.2, int(duration_s / 0.3)))
        target = rng.uniform(-0.4, 0.4, len(steps) + 1)[np.searchsorted(steps, times_s)]
    steering = np.zeros_like(target)
    for k in range(1, len(target)):
        steering[k] = steering[k - 1] + np.clip(target[k] - steering[k - 1], -0.005, 0.005)
    beta = np.arctan(np.tan(steering) / 2)
    rate = 0.35 * np.cos(beta) * np.tan(steering) / float(worlds.qcar().wheelbase_m)
    psi = np.cumsum(rate) * 1e-3
    velocity = 0.35 * np.stack([np.cos(psi + beta), np.sin(psi + beta)], axis=1)
    return np.column_stack([np.cumsum(velocity, axis=0) * 1e-3, psi]), steering


FIRST_S = 0.25  # of the frames, where the poses are zero


DELAYS = [
    # s, Hz, by_frame, most_off_s
    (0.0, 150, False, 0.002),
    (0.05, 15, False, 0.004),
    (0.05, 15, True, 0.004),
    pytest.param(-0.02, 15, False, 0.004, marks=pytest.mark.long),
    pytest.param(0.05, 150, False, 0.002, marks=pytest.mark.long),
]


@pytest.mark.parametrize(("delay_s", "odometry_hz", "by_frame", "most_off_s"), DELAYS)
def test_the_delay_of_corners_is_learnt_as_well_as_it_claims(
    delay_s, odometry_hz, by_frame, most_off_s
):
    """Poses as they were `delay_s` earlier, from a car that steers between two frames.

    An odometer that is read ten times a frame must not look like a delay of 4 ms, and steps that
    are not seen yet not like cameras that are 5 ms less late.
    """
    cars, period, reads = 8, 1 / 15, odometry_hz // 15
    motion = BicycleKalman(off_car())
    sigma = np.array([0.004, 0.004, 0.004])
    start = motion.init(1)
    P, mean = np.array(start.covariance), np.array(start.mean)
    P[:, :3, :3] *= 0.03**2
    P[:, 3:SIX, 3:SIX] *= 0.01**2
    mean[0, 3] = 0.35
    start = believing(motion, mean, P)
    rng, frames = np.random.default_rng(8), 450
    poses, readings = [], []
    for _ in range(cars):
        pose, steering = steered(rng, frames * period + 0.5, by_frame)
        at_ms = 1e3 * FIRST_S + 1e3 * period * np.arange(frames)
        seen = pose[np.round(at_ms - 1e3 * delay_s).astype(int)] - [*pose[250, :2], 0]
        poses.append(seen + sigma * rng.normal(size=(frames, 3)))
        ends = at_ms[:, None] - 1e3 * period * np.arange(reads)[::-1] / reads
        angles = steering[np.round(ends).astype(int)]
        speed, dt_s = np.full(angles.shape, 0.35), np.full(angles.shape, period / reads)
        readings.append(np.stack([speed, angles, dt_s], axis=-1))

    drive = jax.vmap(driven, (None, None, 0, 0, None))
    bank, _ = drive(motion, start, np.array(readings), np.array(poses), sigma)
    tau = np.asarray(bank.mean[:, 0, SENSORS_END - 1])
    sigma_s = np.sqrt(np.asarray(bank.covariance[:, 0, SENSORS_END - 1, SENSORS_END - 1]))
    assert np.all(sigma_s < 0.01)
    z = (tau - delay_s) / sigma_s
    assert np.mean(z**2) < 2, (tau, sigma_s)
    assert abs(np.mean(tau) - delay_s) < most_off_s, (tau, sigma_s)


def test_a_body_that_moves_freely_learns_how_cameras_differ_and_not_how_they_turn_alike():
    """Two of four cameras in view: what turns both alike turns a body the other way, unseen."""
    rng, rig = np.random.default_rng(11), off_rig()
    navigator = Navigator(rig, worlds.paper_markers(), selector=MultiHypothesis())
    bank, n = navigator.motion.init(1), 12 + 4 * EACH
    T = worlds.planar(*VIEW)
    before = dataclasses.replace(
        first(bank),
        mean=jnp.asarray(np.append(T.wxyz_xyz, np.zeros(n - 6))),
        covariance=jnp.asarray(spd(n, rng, np.append(np.full(12, 0.05), np.ones(12)))),
        initialised=jnp.asarray(True),
    )
    seen = [0, 2]
    rows = np.zeros((2 * EACH, 4 * EACH))
    for slot, camera in enumerate(seen):
        rows[EACH * slot : EACH * slot + EACH, EACH * camera : EACH * camera + EACH] = np.eye(EACH)
    errors = ErrorsPosterior(
        change=jnp.asarray(0.3 * rng.normal(size=2 * EACH)),
        slope=jnp.asarray(rng.normal(size=(2 * EACH, 6))),
        covariance=jnp.asarray(spd(2 * EACH, rng, np.full(2 * EACH, 0.2))),
        rows=jnp.asarray(rows),
    )
    measured = MeasuredPose(
        T_world_vehicle=after_turn(T, 0.01 * rng.normal(size=6)),
        covariance=jnp.asarray(spd(6, rng, np.full(6, 0.005))),
        log_likelihood=jnp.asarray(0.0),
        innovation=jnp.zeros(6),
        inflation=jnp.asarray(1.0),
        valid=jnp.asarray(True),
        errors=errors,
    )
    mean, P = jax.jit(ConstantVelocity.offer)(navigator.motion, before, measured).posterior
    alike = np.zeros((4, EACH, EACH))
    alike[seen] = np.eye(EACH) / np.sqrt(2)
    alike = alike.reshape(4 * EACH, EACH)
    np.testing.assert_allclose(alike.T @ mean[13:], 0, atol=1e-12)
    block, prior = P[12:, 12:], before.covariance[12:, 12:]
    np.testing.assert_allclose(alike.T @ block @ alike, alike.T @ prior @ alike, rtol=1e-12)
    differ = np.zeros((4, EACH, EACH))
    differ[seen] = np.eye(EACH)[None] * np.array([1, -1])[:, None, None] / np.sqrt(2)
    differ = differ.reshape(4 * EACH, EACH)
    assert np.all(np.abs(differ.T @ mean[13:]) > 1e-3)
    assert np.all(np.diag(differ.T @ block @ differ) < 0.9 * np.diag(differ.T @ prior @ differ))
    assert np.linalg.eigvalsh(P)[0] > 0


def test_the_turn_of_cameras_alike_counts_in_radians_and_those_in_view():
    sigma_rad = np.array([[0.01, 0.02, 0.005], [0.02, 0.01, 0.005]])
    turn_of = jax.jit(common_turn)
    for unseen in ((), (1,), (0, 1)):
        rows = np.eye(2 * EACH)
        for camera in unseen:
            rows[EACH * camera : EACH * camera + EACH] = 0
        errors = ErrorsPosterior(
            *map(jnp.asarray, (np.zeros(6), np.zeros((6, 6)), np.eye(6), rows))
        )
        found = np.asarray(turn_of(errors, jnp.asarray(sigma_rad))).reshape(2, EACH, EACH)
        for axis in range(EACH):
            turns = np.where(np.isin(np.arange(2), unseen), 0, 0.1) / sigma_rad[:, axis]
            length = np.linalg.norm(turns)
            expected = np.zeros((2, EACH))
            expected[:, axis] = turns / length if length else 0
            np.testing.assert_allclose(found[:, :, axis], expected, atol=1e-14)
    # Nothing in view: nothing is kept from being corrected.
    correction, P = jnp.arange(8.0), jnp.eye(8)
    kept, wider = jax.jit(schmidt_update_along)(jnp.zeros((6, EACH)), 4 * P, correction, P)
    np.testing.assert_array_equal(kept, correction)
    np.testing.assert_array_equal(wider, P)
