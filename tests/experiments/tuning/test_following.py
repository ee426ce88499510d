"""The filter along recorded drives: the branch that it follows, and its derivatives."""

import dataclasses
import functools
from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter.fit import fit_poses
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.geometry import cayley, planar_from_T_world_vehicle
from jaxnav.core.models.imu import Gyro
from jaxnav.core.models.vehicle import DEFAULT_TWIST_SIGMA, TwistBase, advance_bicycle
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import parameters_of, with_parameters
from jaxnav.core.pose.observation import Observation, Snapshot
from jaxnav.experiments.tuning import branches
from jaxnav.experiments.tuning import filter as tuned_filter
from jaxnav.experiments.tuning.branches import SequenceStarts, find_starts
from jaxnav.experiments.tuning.filter import FilterCost, FilterScores, follow, trust_corners
from jaxnav.experiments.tuning.recorded import FrameSequences, simulate_sequences
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.sim.rollout import Rollout
from jaxnav.sim.scenarios import scenarios
from tests import worlds
from tests.helpers.spying import Spy

RIG, MARKERS = worlds.qcar_rig_by_hand().first(1), worlds.paper_markers()
CAR = worlds.qcar_by_hand()
SIGMA_PX, DECIDES, FRAMES = 0.5, 3, 12
NAVIGATOR = Navigator(
    RIG, MARKERS, CAR, corner_sigma_px=SIGMA_PX, max_candidates=2,
    selector=MultiHypothesis(
        hypotheses=6, outlier_log_evidence=-3.0, decided_mass=0.02, decided_sigma_rad=0.3
    ),
)  # fmt: skip
SPACE = Space.from_navigator(
    NAVIGATOR,
    dict.fromkeys(
        [
            "motion.acceleration_density", "motion.odometry_sigma", "motion.tilt_sigma_rad",
            "motion.height_sigma_m", "motion.slip_sigma", "motion.slip_length_m",
            "motion.vehicle.sensor_sigma", "rig.extrinsics_sigma",
            "selector.floor_m", "selector.floor_rad", "corner_sigma_px",
            "repeated_errors.least_share",
        ],
        True,
    ),
    frozenset({"motion.odometry_sigma"}),
)  # fmt: skip


class Drives(Spy):
    """The same command in every frame, decided in one frame."""

    def step(self, state, obs):
        after, out = super().step(state, obs)
        out.located, out.decided = jnp.asarray(True), state.belief.restarts == DECIDES
        return after, out


@functools.cache
def recorded() -> FrameSequences:
    """Three drives past the marker: it leaves the view after seven frames."""
    scenario = dataclasses.replace(
        scenarios()["paper"], start_pose=(0.9, -0.6, 2.2), start_spread=(0.0,) * 3,
        frame_period_s=0.2, duration_s=0.2 * FRAMES - 0.1,
    )  # fmt: skip
    rollout = Rollout(
        Drives(throttle=0.06, steering_rad=0.25, rig=RIG), CAR, MARKERS, scenario, SIGMA_PX
    )
    return simulate_sequences(rollout, jax.vmap(jax.random.key)(jnp.arange(3)))


@functools.cache
def starts() -> SequenceStarts:
    return find_starts(NAVIGATOR, recorded())


def first_of(tree):
    return jax.tree.map(lambda leaf: leaf[0], tree)


def likely(start, recorded, step, navigator=NAVIGATOR, space=SPACE) -> FilterScores:
    """One drive, the parameters a step away from where they start."""
    navigator = trust_corners(with_parameters(navigator, space.values(space.start + step)))
    return follow(navigator, start, recorded)


def sums(told: FilterScores, axis=None):
    """Of what losses are made of; position errors in cm."""
    leaves = told.log_likelihood, told.log_score, 1e4 * told.square_m2
    return jnp.stack([jnp.sum(leaf, axis=axis) for leaf in leaves])


def weighed(step, weights, start, recorded, navigator=NAVIGATOR, space=SPACE):
    return jnp.sum(weights * sums(likely(start, recorded, step, navigator, space)))


@jax.jit
def steps_of(start, recorded, steps) -> FilterScores:
    return jax.lax.map(lambda step: likely(start, recorded, step), steps)


def at_start(start, recorded) -> FilterScores:
    """In the same program as all other steps."""
    return first_of(steps_of(start, recorded, jnp.zeros((2 * SPACE.start.size, SPACE.start.size))))


@functools.cache
def gradient():
    start, drive = first_of((starts().bank, recorded()))
    compiled = jax.jit(jax.grad(weighed)).lower(0 * SPACE.start, jnp.ones(3), start, drive)
    return compiled.compile()


def in_float32(tree):
    def cast(leaf):
        leaf = np.asarray(leaf)
        return jnp.asarray(leaf.astype(np.float32) if leaf.dtype == np.float64 else leaf)

    return jax.tree.map(cast, tree)


LONG = 1000


@functools.cache
def long_gradient():
    """Of a thousand frames, in float32."""
    start, drive = first_of((starts().bank, recorded().pad_to(LONG)))
    with jax.enable_x64(False):
        start, drive, navigator, space = in_float32((start, drive, NAVIGATOR, SPACE))

        def value(step, start, drive):
            return weighed(step, jnp.ones(3, np.float32), start, drive, navigator, space)

        lowered = jax.jit(jax.value_and_grad(value)).lower(0 * space.start, start, drive)
        return lowered.compile(), (0 * space.start, start, drive)


def mirrored(pose: np.ndarray) -> np.ndarray:
    """From where the marker looks the same but for perspective: across its normal, seen at the same
    range and bearing."""
    marker_m = np.asarray(MARKERS.Ts_world_marker.translation())[0, :2]
    away = pose[:2] - marker_m
    other = away * [-1, 1]  # the marker faces -y
    turn = np.arctan2(*other[::-1]) - np.arctan2(*away[::-1])
    return np.array([*(marker_m + other), pose[2] + turn])


def true_poses(recorded: FrameSequences) -> np.ndarray:
    return np.asarray(planar_from_T_world_vehicle(jaxlie.SE3(recorded.T_world_vehicle_true)))


def wrapped(angle_rad):
    return np.arctan2(np.sin(angle_rad), np.cos(angle_rad))


def test_what_is_recorded_is_what_was_sensed():
    """Judged from the decision on, for good; the last corners are out of view."""
    drives = recorded()
    assert len(drives) == 3
    assert np.all(drives.used)
    np.testing.assert_array_equal(np.argmax(drives.judged, axis=1), DECIDES)
    assert np.all(drives.judged[:, DECIDES:])
    assert drives.obs.T_world_vehicle_true is None
    assert drives.obs.heading_rad is None
    poses, seen = true_poses(drives), np.asarray(drives.obs.visible[:, :, 0, 0])
    np.testing.assert_allclose(poses[:, 0], [[0.9, -0.6, 2.2]] * 3)
    assert np.all(seen[:, 0])
    assert not np.any(seen[:, -1])
    expected = worlds.observe(RIG, MARKERS, worlds.planar(*poses[1, 4])).corners_px
    noise_px = np.asarray(drives.obs.corners_px[1, 4] - expected)
    assert 0.1 * SIGMA_PX < noise_px.std() < 3 * SIGMA_PX


def test_shorter_recordings_are_filled_with_frames_that_are_not_used():
    drives = recorded()
    short = FrameSequences(
        drives.markers,
        *jax.tree.map(
            lambda leaf: leaf[:, :5],
            (drives.obs, drives.used, drives.T_world_vehicle_true, drives.judged),
        ),
    ).rows(slice(0, 2))
    both = FrameSequences.concatenate([drives, short])
    assert both.used.shape == (5, FRAMES)
    np.testing.assert_array_equal(both.used.sum(axis=1), [12, 12, 12, 5, 5])
    np.testing.assert_array_equal(both.judged.sum(axis=1), [9, 9, 9, 2, 2])
    np.testing.assert_array_equal(both.obs.corners_px[3, :5], drives.obs.corners_px[0, :5])
    np.testing.assert_array_equal(both.obs.corners_px[4, 9], drives.obs.corners_px[1, 4])
    np.testing.assert_array_equal(both.rows(np.array([3])).used, both.used[3:4])


@pytest.mark.long
def test_it_starts_in_the_true_branch():
    found, poses = starts(), true_poses(recorded())[:, 0]
    assert np.all(found.chosen)
    gaps = np.asarray(found.bank.mean[:, 0, :3]) - poses
    assert np.abs(gaps[:, :2]).max() < 0.3
    assert np.abs(wrapped(gaps[:, 2])).max() < 0.3
    assert np.linalg.norm(mirrored(poses[0])[:2] - poses[0, :2]) > 1
    np.testing.assert_array_equal(found.bank.mean[:, 0, 3:], 0)


@pytest.mark.long
def test_the_mirror_image_is_less_likely():
    """Followed as well, from as wide a start, and at the end of the drive still mirrored."""
    start, drive = first_of((starts().bank, recorded()))
    pose = true_poses(recorded())[0, 0]
    other = eqx.tree_at(
        lambda b: b.mean, start, start.mean.at[0, :3].set(jnp.asarray(mirrored(pose)))
    )
    true, false = at_start(start, drive), at_start(other, drive)
    assert np.sum(true.log_likelihood) > np.sum(false.log_likelihood) + 10
    assert np.sum(true.log_score) > np.sum(false.log_score) + 10
    in_view = np.asarray(drive.obs.visible[:, 0, 0])
    assert np.all(true.log_likelihood[in_view] != 0)
    np.testing.assert_array_equal(true.log_likelihood[~in_view], 0)
    np.testing.assert_array_equal(true.log_score[:DECIDES], 0)
    assert np.sqrt(true.square_m2[-1]) < 0.2
    assert np.sqrt(false.square_m2[-1]) > 0.5


def test_a_pose_is_carried_back_along_its_arcs():
    """Exact odometry: back to where the drive began, from whatever frame, and no further. Frames
    between two readings hold the last one."""
    rng, count = np.random.default_rng(0), 3
    drives = recorded()
    shape = drives.used.shape
    speeds, steerings = rng.uniform(-0.5, 0.5, shape), rng.uniform(-0.5, 0.5, shape)
    obs = eqx.tree_at(
        lambda o: (o.speed_mps, o.steering_rad, o.has_odometry),
        drives.obs,
        (jnp.asarray(speeds), jnp.asarray(steerings), jnp.asarray(rng.uniform(size=shape) < 0.5)),
    )
    frames, begins, ends = np.array([0, 4, 11]), rng.uniform(-2, 2, (count, 3)), []
    for row in range(count):
        pose = jnp.asarray(begins[row])
        for frame in range(1, frames[row] + 1):
            told = (speeds[row, frame], steerings[row, frame], obs.dt_s[row, frame])
            pose = advance_bicycle(pose, *map(jnp.asarray, told), CAR.wheelbase_m)
        ends.append(worlds.planar(*pose).wxyz_xyz)
    back = branches._carried_back(NAVIGATOR, obs, jnp.stack(ends), jnp.asarray(frames))
    poses = np.asarray(planar_from_T_world_vehicle(jaxlie.SE3(back)))
    np.testing.assert_allclose(poses[:, :2], begins[:, :2], atol=1e-9)
    np.testing.assert_allclose(wrapped(poses[:, 2] - begins[:, 2]), 0, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("loss", [0, 1, 2], ids=["likelihood", "score", "error"])
def test_gradients_are_central_differences(loss):
    """Every entry of x by itself, in a drive that loses sight of its marker."""
    start, drive = first_of((starts().bank, recorded()))
    size, step = SPACE.start.size, 1e-4
    told = steps_of(start, drive, jnp.asarray(step * np.vstack([np.eye(size), -np.eye(size)])))
    ahead, behind = np.split(np.asarray(sums(told, axis=1))[loss], 2)
    numeric = (ahead - behind) / (2 * step)
    found = gradient()(0 * SPACE.start, jnp.eye(3)[loss], start, drive)
    np.testing.assert_allclose(found, numeric, rtol=1e-4, atol=1e-5 * np.abs(numeric).max())
    named = [np.abs(found[np.array(SPACE.labels) == name]).max() for name in SPACE.free]
    assert np.min(named) > 1e-5  # the floors are a tenth of a millimetre


@pytest.mark.long
def test_a_gyro_s_numbers_are_learned_by_their_gradients():
    """Of a base that drives, slips and stands: against central differences of what is predicted."""
    gyro = Gyro(2e-3, 0.02, 0.02, 30.0, 0.02, delay_sigma_s=0.02)
    base = TwistBase.create(1.0, 4.0, 0.15, sensor_sigma=DEFAULT_TWIST_SIGMA, gyro=gyro)
    navigator = Navigator(RIG, MARKERS, base)
    names = [name for name in parameters_of(navigator) if ".gyro." in name]
    assert len(names) == 5
    space = Space.from_navigator(navigator, dict.fromkeys(names, True))
    turns = jnp.asarray([[0.3, 1.0, 1.03], [0.3, 1.4, 0.9], [0.0, 0.0, 0.02], [0.0, 0.0, 0.02]])
    weights = jnp.asarray(
        np.random.default_rng(0).normal(size=(navigator.motion.init().mean.size,))
    )

    @jax.jit
    @jax.value_and_grad
    def value(step):
        motion = with_parameters(navigator, space.values(space.start + step)).motion
        bank = eqx.tree_at(lambda b: b.initialised, motion.init(), jnp.ones(1, bool))

        def interval(bank, told):
            ahead_mps, wheels, read = told
            zero = jnp.zeros(())
            obs = Observation(
                jnp.zeros((1, 1, 4, 2)), jnp.zeros((1, 1), bool), dt_s=0.2,
                twist=jnp.stack([ahead_mps, zero, zero, zero, zero, wheels]),
                gyro_radps=jnp.stack([zero, zero, read]),
            )  # fmt: skip
            return motion.predict(bank, obs), None

        bank = jax.lax.scan(interval, bank, turns)[0]
        return jnp.sum(weights * bank.mean[0]) + weights @ bank.covariance[0] @ weights

    step = 1e-4 * jnp.eye(space.start.size)
    found = value(0 * space.start)[1]
    numeric = [(value(d)[0] - value(-d)[0]) / 2e-4 for d in step]
    np.testing.assert_allclose(found, numeric, rtol=1e-5, atol=1e-9)
    assert np.abs(found).min() > 1e-6


@pytest.mark.long
def test_frames_that_are_not_used_say_nothing():
    """Whatever they hold; and what was said before them stays, bit for bit."""
    start, drive = first_of((starts().bank, recorded()))
    unused = eqx.tree_at(lambda r: r.used, drive, drive.used.at[5:].set(False))
    garbled = eqx.tree_at(
        lambda r: (r.obs.corners_px, r.obs.speed_mps, r.obs.dt_s, r.obs.visible),
        unused,
        (
            drive.obs.corners_px.at[5:].multiply(1.1),
            drive.obs.speed_mps.at[5:].add(3.0),
            drive.obs.dt_s.at[5:].set(9.0),
            jnp.ones_like(drive.obs.visible),
        ),
    )
    told, garbled, whole = (at_start(start, item) for item in (unused, garbled, drive))
    for leaf, other, full in zip(*map(jax.tree.leaves, (told, garbled, whole)), strict=True):
        np.testing.assert_array_equal(leaf, other)
        np.testing.assert_array_equal(leaf[5:], 0)
        np.testing.assert_array_equal(leaf[:5], full[:5])
    slope = gradient()(0 * SPACE.start, jnp.ones(3), start, unused)
    assert np.all(np.isfinite(slope))


def test_a_filter_that_breaks_is_worth_nothing():
    """Once nothing is believed any more there is nothing to be wrong about: no way to save cost."""
    start, drive = first_of((starts().bank, recorded()))
    broken = at_start(eqx.tree_at(lambda b: b.mean, start, jnp.nan * start.mean), drive)
    np.testing.assert_array_equal(broken.log_likelihood, -np.inf)
    np.testing.assert_array_equal(broken.log_score[DECIDES:], -np.inf)
    np.testing.assert_array_equal(broken.square_m2[DECIDES:], np.inf)
    np.testing.assert_array_equal(broken.square_m2[:DECIDES], 0)


@pytest.mark.long
def test_a_thousand_frames_need_little_memory():
    """What is carried from frame to frame, the bank, and what each search has found, which is less
    than half as much: without checkpoints it is 26 banks a frame."""
    program, (_, start, _) = long_gradient()
    bank_bytes = start.mean.nbytes + start.covariance.nbytes
    assert program.memory_analysis().temp_size_in_bytes < 1.4 * bank_bytes * LONG


def standing(drive: FrameSequences, pose, visible=True) -> FrameSequences:
    """A car that does not move, and corners without noise."""
    obs = worlds.observe(RIG, MARKERS, worlds.planar(*pose))
    frames = drive.used.shape[0]
    return eqx.tree_at(
        lambda r: (
            r.obs.corners_px, r.obs.visible, r.obs.speed_mps, r.obs.steering_rad,
            r.T_world_vehicle_true,
        ),
        drive,
        (
            jnp.tile(obs.corners_px[None], (frames, 1, 1, 1, 1)),
            jnp.tile(obs.visible[None], (frames, 1, 1)) & visible,
            0 * drive.obs.speed_mps,
            0 * drive.obs.steering_rad,
            jnp.tile(worlds.planar(*pose).wxyz_xyz[None], (frames, 1)),
        ),
    )  # fmt: skip


@pytest.mark.long
@pytest.mark.parametrize("kind", ["padded", "frontal", "oblique", "nothing seen", "no time"])
def test_gradients_are_finite(kind):
    """In float32; a frontal view has no mirror image, and the long ones use all their frames."""
    program, (step, start, drive) = long_gradient()
    if kind != "padded":
        pose = (0.9, -0.6, 2.2) if kind == "oblique" else (0.0, -0.4, np.pi / 2)
        start, drive = first_of((starts().bank, recorded().pad_to(LONG)))
        drive = standing(drive, pose, visible=kind != "nothing seen")
        start = eqx.tree_at(lambda b: b.mean, start, start.mean.at[0, :3].set(jnp.asarray(pose)))
        used = jnp.ones_like(drive.used)
        drive = eqx.tree_at(lambda r: (r.used, r.judged), drive, (used, used))
        if kind == "no time":
            drive = eqx.tree_at(lambda r: r.obs.dt_s, drive, 0 * drive.obs.dt_s)
        with jax.enable_x64(False):
            start, drive = in_float32((start, drive))
    value, slope = program(step, start, drive)
    assert slope.dtype == np.float32
    assert np.isfinite(value)
    assert np.all(np.isfinite(slope))
    assert np.any(slope != 0)


@pytest.mark.long
def test_the_implicit_gradient_is_that_of_all_steps():
    """Twenty steps of Gauss and Newton, each differentiated, against the minimum that moves."""
    pose, sigma_px = np.array([0.9, -0.6, 2.2]), 0.7
    noise_px = np.random.default_rng(0).normal(size=(1, 1, 4, 2))
    obs = worlds.observe(RIG, MARKERS, worlds.planar(*pose), jnp.asarray(noise_px))
    exact = worlds.qcar_rig().first(1)
    motion = BicycleKalman(worlds.qcar(), tilt_sigma_rad=0.0, height_sigma_m=0.0)
    belief = first_of(starts().bank)
    mean = jnp.asarray([[*(pose + np.array([0.02, -0.01, 0.02])), 0, 0, 0]])
    belief = eqx.tree_at(lambda b: b.mean, belief, mean)
    freedom = jnp.asarray(np.eye(6)[:, [0, 1, 5]])

    def root(logs):
        return jnp.diag(jnp.exp(logs[:3])).at[1, 0].set(logs[3])

    def prior_of(logs):
        P = jnp.eye(6).at[:3, :3].set(root(logs) @ root(logs).T)
        return motion.poses(eqx.tree_at(lambda b: b.covariance, belief, P[None]))

    def minimum(corners_px, logs):
        now = dataclasses.replace(obs, corners_px=corners_px)
        snapshot = Snapshot.create(exact, MARKERS, now, sigma_px)
        prior = prior_of(logs)
        found = fit_poses(
            prior.T_world_vehicle, prior.covariance, None, prior, snapshot, jnp.zeros(6), 20
        )
        return found.posterior.T_world_vehicle.wxyz_xyz[0]

    def unrolled(corners_px, logs):
        prior = prior_of(logs)
        T_prior = first_of(prior.T_world_vehicle)
        L = jnp.linalg.cholesky(freedom.T @ prior.covariance[0] @ freedom)

        def moved(u):
            return T_prior @ cayley(freedom @ L @ u)

        def residuals(u):
            px = RIG.project(moved(u).inverse(), MARKERS.corners_world_m)
            gaps = jnp.where(obs.visible[:, :, None, None], (px - corners_px) / sigma_px, 0)
            return jnp.append(gaps.reshape(-1), u)

        def step(u, _):
            r, J = residuals(u), jax.jacfwd(residuals)(u)
            return u - jnp.linalg.solve(J.T @ J, J.T @ r), None

        return moved(jax.lax.scan(step, jnp.zeros(3), length=20)[0]).wxyz_xyz

    @jax.jit
    def both(corners_px, logs):
        weights = jnp.asarray([0.3, 0.0, 0.0, -1.0, 1.0, 0.7, 0.0])
        told = []
        for way in (minimum, unrolled):
            value, pull = jax.vjp(way, corners_px, logs)
            told.append((value, pull(weights)))
        return told

    (T, slopes), (T_expected, expected) = both(obs.corners_px, jnp.asarray([-4.0, -3.5, -4, 0.01]))
    assert np.linalg.norm(T - worlds.planar(*mean[0, :3]).wxyz_xyz) > 1e-3
    np.testing.assert_allclose(T, T_expected, atol=1e-7)
    for slope, other in zip(slopes, expected, strict=True):
        assert np.abs(other).max() > 1e-5
        np.testing.assert_allclose(slope, other, rtol=1e-4, atol=1e-5 * np.abs(other).max())


def test_a_cost_is_what_its_loss_says(monkeypatch):
    """Signs and units, and which frames are counted."""
    drives = recorded()
    told = FilterScores(*(jnp.full(FRAMES, value) for value in (3.0, 5.0, 0.02, 1.0)))
    seen = []

    def stub(navigator, start, recorded):
        seen.append(navigator)
        used, judged = (jnp.sum(mask) / FRAMES for mask in (recorded.used, recorded.judged))
        return FilterScores(
            told.log_likelihood * used, told.log_score * judged, told.square_m2, told.nees
        )

    decided = jnp.asarray([True, False, True])
    monkeypatch.setattr(tuned_filter, "follow", stub)
    monkeypatch.setattr(
        tuned_filter, "find_starts", lambda n, r: SequenceStarts(starts().bank, decided)
    )
    for loss, cost, frames in (("likelihood", -3.0, 24), ("score", -5.0 * 9 / 12, 18)):
        of = FilterCost(NAVIGATOR, SPACE, loss)
        [batch] = of.batches(SPACE.start, drives)
        assert float(batch.frames) == frames
        np.testing.assert_array_equal(np.any(batch.items.recorded.used, axis=1), decided)
        item = first_of(batch.items)
        np.testing.assert_allclose(of(SPACE.start, item, jnp.zeros(())), np.full(FRAMES, cost))
        mean = of.mean(SPACE.start, batch)
        np.testing.assert_allclose(mean, cost * 2 * FRAMES / frames)
    error = FilterCost(NAVIGATOR, SPACE, "error")
    np.testing.assert_allclose(error(SPACE.start, item, jnp.zeros(())), 200.0)
    nobody = SimpleNamespace(bank=starts().bank, chosen=jnp.zeros(3, bool))
    monkeypatch.setattr(tuned_filter, "find_starts", lambda n, r: nobody)
    assert float(error.batches(SPACE.start, drives)[0].frames) == 1
    assert seen[0].selector.max_inflation == seen[0].selector.max_misfit == 1
    assert np.isinf(seen[0].motion.gate_nis)
