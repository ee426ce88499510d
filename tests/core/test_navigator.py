"""Algorithm 1 as one pure step: the same alone, scanned and vmapped; its gradient; bad input."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxnav.core.filter.choose import LowestReprojection, PaperCost
from jaxnav.core.navigator import Navigator, Output, State
from jaxnav.core.parameters import parameters_of, with_parameters
from jaxnav.core.pose.observation import Observation
from tests import worlds
from tests.derivatives import in_float32
from tests.helpers.filters import derivative, planar_part, sense, snap, step, whitened_pixels
from tests.reference import kalman, paper
from tests.reference.rigid import cayley, inverse_cayley, matrix, twist_matrix, wxyz_xyz

WHEELBASE_M = 0.256
DT_S = 0.1
STEPS = 20
START = (1.2, -0.6, np.deg2rad(135.0))
SPEED_MPS, STEERING_RAD = 0.25, 0.12


def navigator(**options) -> Navigator:
    """The paper's rule, unless told otherwise: the bank has tests of its own."""
    options = {"selector": PaperCost(), "waypoints_m": worlds.WAYPOINTS_M} | options
    return Navigator(
        rig=worlds.qcar_rig(), markers=worlds.paper_markers(), vehicle=worlds.qcar(), **options
    )


def true_poses() -> np.ndarray:
    """(STEPS, 3): the car at constant speed and steering."""
    poses = paper.drive(START, SPEED_MPS, STEERING_RAD, STEPS * DT_S, WHEELBASE_M, STEPS * 50)
    return poses[:-1:50]


def drive(sigma_px: float = 0.2, seed: int = 0, blind: tuple[int, ...] = ()) -> Observation:
    """What the car senses on the way, leading axis (STEPS,)."""
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    noise = sigma_px * np.random.default_rng(seed).standard_normal((STEPS, 4, 1, 4, 2))
    told = jnp.asarray(true_poses()), jnp.asarray(noise), SPEED_MPS, STEERING_RAD, DT_S
    obs = jax.device_get(sense(rig, markers, *told))
    sees = ~np.isin(np.arange(STEPS), blind)[:, None, None]
    return eqx.tree_at(lambda o: o.visible, obs, obs.visible & sees)


def at(tree, index):
    return jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), tree)


def floats_of(tree):
    return jax.tree.leaves(eqx.filter(tree, eqx.is_inexact_array))


def step_by_step(nav: Navigator, obs: Observation, step=step) -> tuple[State, Output]:
    state, outputs = nav.init(), []
    for index in range(STEPS):
        state, out = step(nav, state, at(obs, index))
        outputs.append(jax.device_get(out))
    return state, jax.tree.map(lambda *leaves: np.stack(leaves), *outputs)


@pytest.mark.long
def test_step_scan_and_vmap_agree():
    """Everything a user reads; of a lane that no one takes as much as LM's stopping rule leaves."""
    nav = navigator()
    drives = [drive(seed=seed, blind=(7, 8)) for seed in range(2)]
    alone = [step_by_step(nav, obs) for obs in drives]
    scan = jax.jit(lambda navigator, state, obs: jax.lax.scan(navigator.step, state, obs))
    scanned = [scan(nav, nav.init(), obs) for obs in drives]
    mapped = jax.jit(jax.vmap(lambda obs: jax.lax.scan(nav.step, nav.init(), obs)))(
        jax.tree.map(lambda *leaves: np.stack(leaves), *drives)
    )

    def told(result):
        state, out = result
        return (
            state, out.pose, out.covariance, out.command, out.done, out.selected,
            out.T_world_vehicle,
        )  # fmt: skip

    def of_all_lanes(out):
        costs = np.where(out.candidates.valid, out.costs, 0)
        return np.append(costs.reshape(-1), out.flip_probability)

    for index in range(2):
        expected = jax.tree.leaves(told(alone[index]))
        for other in (scanned[index], at(mapped, index)):
            for leaf, value in zip(jax.tree.leaves(told(other)), expected, strict=True):
                np.testing.assert_allclose(leaf, value, rtol=1e-7, atol=1e-7)
            np.testing.assert_allclose(
                of_all_lanes(other[1]), of_all_lanes(alone[index][1]), rtol=1e-5, atol=1e-6
            )


@pytest.fixture(scope="module")
def bound():
    """The bound step in float32, as vehicles run it, and how often it is traced."""
    traces, step_of = [], Navigator.step
    with jax.enable_x64(False), pytest.MonkeyPatch.context() as patch:
        patch.setattr(Navigator, "step", lambda *given: traces.append(None) or step_of(*given))
        nav = navigator()
        jitted = jax.jit(nav.step)
        jitted(nav.init(), at(drive(), 0))
    assert nav.step == nav.step
    return nav, jitted, traces


def test_the_car_is_located_in_both_precisions(bound):
    """In float32 by the bound step, which is traced once a drive."""
    with jax.enable_x64(False):
        nav, jitted, traces = bound
        single = step_by_step(nav, drive(), lambda _, *told: jitted(*told))
        assert (len(traces), jitted._cache_size()) == (1, 1)
    outputs = {}
    for precision, run in ("float32", single), ("float64", step_by_step(navigator(), drive())):
        assert {leaf.dtype for leaf in floats_of(run)} == {np.dtype(precision)}
        assert np.all(run[1].located)
        outputs[precision] = np.asarray(run[1].pose, float), run[1].command.steering_rad
    np.testing.assert_allclose(outputs["float32"][0], outputs["float64"][0], atol=3e-3)
    np.testing.assert_allclose(outputs["float32"][1], outputs["float64"][1], atol=5e-3)
    errors = outputs["float64"][0] - true_poses()
    assert np.max(np.abs(errors[-5:, :2])) < 0.05
    assert np.max(np.abs(errors[-5:, 2])) < 0.03


def reference_pose_covariance(nav: Navigator, pose, sigma_px: float) -> np.ndarray:
    """Covariance of (x, y, psi) at a pose from the pixels' derivatives: equations and loops."""
    obs = worlds.observe(nav.rig, nav.markers, worlds.planar(*pose))
    snapshot, T = snap(nav.rig, nav.markers, obs, sigma_px), matrix(worlds.planar(*pose).wxyz_xyz)
    J = derivative(lambda xi: whitened_pixels(snapshot, T @ cayley(xi)), np.zeros(6))
    return planar_part(np.linalg.inv(J.T @ J), pose[2])


def test_the_first_two_steps_by_hand():
    """Pose and covariance from the pixels, the filter's and the controller's equations."""
    truth = true_poses()
    # Ahead and far enough: on a waypoint inside the smallest circle the controller turns no wheel.
    direction = truth[0, 2] + np.deg2rad(20.0)
    waypoint = truth[0, :2] + 3.0 * np.array([np.cos(direction), np.sin(direction)])
    nav = navigator(corner_sigma_px=0.25, waypoints_m=[waypoint.tolist(), (0.5, 0.65)])
    motion = nav.motion
    obs = drive(sigma_px=0.0)
    state, out = step(nav, nav.init(), at(obs, 0))
    floor = np.diag(np.asarray(motion.vision_floor) ** 2)
    noise = (WHEELBASE_M, np.asarray(motion.odometry_sigma))

    x = np.append(truth[0], np.zeros(3))
    P = np.zeros((6, 6))
    P[:3, :3] = reference_pose_covariance(nav, truth[0], 0.25) + floor
    P[3:, 3:] = np.diag(np.asarray(motion.initial_velocity_sigma) ** 2)
    x, P, _ = kalman.update(x, P, None, None, SPEED_MPS, STEERING_RAD, *noise)
    np.testing.assert_allclose(state.belief.bank.mean[0], x, atol=2e-4)
    np.testing.assert_allclose(out.covariance, P, rtol=0.02, atol=1e-6)
    assert out.nis == 0
    assert out.flip_probability < 0.5

    angle, distance, _ = paper.steering(out.pose, waypoint, STEERING_RAD, WHEELBASE_M)
    assert abs(angle) < 0.5
    assert out.command.steering_rad == pytest.approx(angle, abs=1e-9)
    gains = nav.controller
    throttle = (gains.proportional_per_m + gains.integral_per_ms * DT_S) * distance
    assert out.command.throttle == pytest.approx(float(throttle))

    state, out = step(nav, state, at(obs, 1))
    told = SPEED_MPS, STEERING_RAD, WHEELBASE_M
    x, P = kalman.predict(x, P, DT_S, np.asarray(motion.acceleration_density), told)
    R_pose = reference_pose_covariance(nav, truth[1], 0.25) + floor
    x, P, nis = kalman.update(x, P, truth[1], R_pose, SPEED_MPS, STEERING_RAD, *noise)
    np.testing.assert_allclose(state.belief.bank.mean[0], x, atol=2e-3)
    np.testing.assert_allclose(out.covariance, P, rtol=0.05, atol=1e-5)
    np.testing.assert_allclose(out.nis, nis, atol=0.02)


def test_without_a_marker_odometry_carries_on():
    nav = navigator()
    _, out = step_by_step(nav, drive(blind=tuple(range(8, STEPS))))
    blind = np.arange(STEPS) >= 8
    np.testing.assert_array_equal(np.asarray(out.selected) == -1, blind)
    np.testing.assert_array_equal(np.asarray(out.nis)[blind], 0)
    assert np.all(out.located)
    # The volume grows. The position's part alone may shrink: it swings about the marker with the
    # heading, and the car drives towards the marker.
    volumes = np.linalg.slogdet(np.asarray(out.covariance)[:, :3, :3])[1]
    assert np.all(np.diff(volumes[8:]) > 0)
    errors = np.asarray(out.pose) - true_poses()
    assert np.max(np.abs(errors[-1, :2])) < 0.1
    assert np.all(np.asarray(out.command.throttle) > 0)


def test_never_located_never_drives():
    nav = navigator()
    state, out = step_by_step(nav, drive(blind=tuple(range(STEPS))))
    assert not np.any(out.located)
    assert not np.any(out.command.throttle)
    assert not np.any(out.command.steering_rad)
    assert all(np.all(np.isfinite(leaf)) for leaf in floats_of(state))


@pytest.fixture(scope="module")
def located():
    nav = navigator()
    obs = at(drive(), 0)
    state, _ = step(nav, nav.init(), obs)
    return nav, state, obs


ANYTHING = st.floats(allow_nan=True, allow_infinity=True)


@settings(max_examples=150)
@example((9.35e155, 1.0, 0.0), [None] * 7 + [1.3407807929942597e154])
@example((0.0, 0.0, 0.0), [None, 1498.0, None, 232430.0, None, 232616.0, None, 1603.0])
@given(
    st.tuples(*[ANYTHING] * 3), st.lists(st.one_of(st.just(None), ANYTHING), min_size=8, max_size=8)
)
def test_state_and_command_survive_any_reading(located, odometry, corners):
    nav, state, obs = located
    spoilt = np.array(obs.corners_px)
    visible = np.flatnonzero(obs.visible[:, 0])[0]
    flat = spoilt[visible, 0].reshape(8)
    for index, value in enumerate(corners):
        flat[index] = flat[index] if value is None else value
    readings = (jnp.asarray(value, float) for value in odometry)
    state, out = step(
        nav,
        state,
        eqx.tree_at(
            lambda o: (o.corners_px, o.speed_mps, o.steering_rad, o.dt_s),
            obs,
            (jnp.asarray(spoilt), *readings),
        ),
    )
    check_contained(state, out)
    # And it finds back.
    for _ in range(2):
        state, out = step(nav, state, obs)
    check_contained(state, out)


def check_contained(state: State, out: Output) -> None:
    assert all(np.all(np.isfinite(leaf)) for leaf in floats_of(state))
    told = (out.pose, out.covariance, out.T_world_vehicle, out.command, out.candidates, out.nis)
    assert all(np.all(np.isfinite(leaf)) for leaf in floats_of(told))
    assert abs(float(out.command.steering_rad)) <= 0.5
    assert abs(float(out.command.throttle)) <= 0.3


BROKEN = [np.nan, np.inf, -np.inf, 1e30, -1e30, 1e10]


@pytest.mark.parametrize("field", ["speed_mps", "steering_rad", "dt_s", "corners_px"])
def test_broken_readings_are_contained(bound, field):
    """In float32: the range is smaller."""
    nav, jitted, _ = bound
    with jax.enable_x64(False):
        obs = at(drive(), 0)
        located, _ = jitted(nav.init(), obs)
        for value in BROKEN:
            broken = jnp.asarray(np.full_like(getattr(obs, field), value))
            state, out = jitted(located, dataclasses.replace(obs, **{field: broken}))
            check_contained(state, out)
            if field == "corners_px" and not np.isfinite(value):
                assert int(out.selected) == -1
            state, out = jitted(state, obs)
            check_contained(state, out)
            assert out.located


def test_nan_odometry_is_a_step_without_odometry(located):
    nav, state, obs = located
    expected, _ = step(nav, state, dataclasses.replace(obs, has_odometry=jnp.asarray(False)))
    for field in ("speed_mps", "steering_rad"):
        actual, _ = step(
            nav, state, dataclasses.replace(obs, **{field: jnp.asarray(np.nan, float)})
        )
        for one in ("mean", "covariance"):
            found, told = (getattr(after.belief.bank, one) for after in (actual, expected))
            np.testing.assert_array_equal(found, told)


# Motion noise and gains: what a tuner varies.
TUNED = ("corner_sigma_px", "motion.acceleration_density", "motion.odometry_sigma",
         "motion.vision_floor", "controller.proportional_per_m",
         "controller.integral_per_ms")  # fmt: skip


def tunable(nav: Navigator) -> dict[str, jax.Array]:
    known = parameters_of(nav)
    return {name: known[name] for name in TUNED}


def test_derivatives_of_a_step():
    """With respect to corners, odometry, interval, motion noise and gains: reverse mode against
    differences of the step that all tests here run."""
    nav, obs = navigator(), drive()
    state, _ = step(nav, nav.init(), at(obs, 0))
    second, fields = at(obs, 1), ("corners_px", "speed_mps", "steering_rad", "dt_s")

    def moved(floats):
        sensed, parameters = floats
        return with_parameters(nav, parameters), dataclasses.replace(second, **sensed)

    def told(after, out):
        leaves = jax.tree.leaves(
            (after.belief.bank.mean, after.belief.bank.covariance, out.command)
        )
        return [leaf.reshape(-1) for leaf in leaves]

    @jax.jit
    def pulled(floats, weights):
        def outcome(floats):
            moved_nav, reading = moved(floats)
            return jnp.concatenate(told(*moved_nav.step(state, reading)))

        return jax.vjp(outcome, floats)[1](weights)[0]

    floats = {name: getattr(second, name) for name in fields}, jax.device_get(tunable(nav))
    rng, h = np.random.default_rng(0), 1e-6
    directions = [jax.tree.map(lambda x: rng.normal(size=np.shape(x)), floats) for _ in range(3)]

    def ahead(direction, h):
        changed = jax.tree.map(lambda x, d: jnp.asarray(x + h * d), floats, direction)
        nav, reading = moved(changed)
        return np.concatenate(told(*step(nav, state, reading)))

    slopes = np.array([(ahead(d, h) - ahead(d, -h)) / (2 * h) for d in directions])
    count = slopes.shape[1]
    weights = np.concatenate([np.eye(6, count), rng.normal(size=(4, count))])
    for weight in weights:
        back = pulled(jax.tree.map(jnp.asarray, floats), jnp.asarray(weight))
        found = [sum(map(np.vdot, *map(jax.tree.leaves, (back, d)))) for d in directions]
        np.testing.assert_allclose(found, slopes @ weight, rtol=1e-4, atol=1e-5)


@pytest.mark.long
@in_float32
def test_a_rollout_of_20_steps_has_a_finite_gradient(precision):
    """With respect to the filter's noise and the gains, through frames without a marker."""
    nav = navigator()
    obs = drive(blind=(5, 6, 7))

    @jax.jit
    @jax.value_and_grad
    def loss(parameters):
        changed = with_parameters(nav, parameters)
        _, out = jax.lax.scan(changed.step, changed.init(), obs)
        error = out.pose - jnp.asarray(true_poses())
        return jnp.sum(error**2) + jnp.sum(out.command.throttle**2) + jnp.sum(out.nis)

    value, gradient = loss(tunable(nav))
    assert np.isfinite(value)
    for name, leaf in gradient.items():
        assert leaf.dtype == precision
        assert np.all(np.isfinite(leaf)), name
        assert np.all(leaf != 0), name


@pytest.mark.parametrize(
    "selector", [LowestReprojection(), pytest.param(None, marks=pytest.mark.long)], ids=type
)
def test_it_locates_a_hand_held_rig_without_a_route(selector):
    """Constant velocity on SE(3), six degrees of freedom, no command."""
    rig, markers = worlds.handheld_rig(), worlds.room_markers()
    nav = Navigator(rig=rig, markers=markers, corner_sigma_px=0.3, selector=selector)
    rng = np.random.default_rng(1)
    upright = np.eye(4)
    upright[:3, :3] = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    T = matrix(worlds.planar(0.2, 0.1, 0.6).wxyz_xyz) @ upright
    moves = expm(twist_matrix(0.05 * np.array([0.2, -0.05, 0.1, 0.1, 0.4, -0.1])))
    look = jax.jit(lambda T, n: worlds.observe(rig, markers, jaxlie.SE3(T), n, dt_s=0.05))
    state = nav.init()
    for _ in range(15):
        T = T @ moves
        noise = jnp.asarray(0.3 * rng.standard_normal((4, 4, 4, 2)))
        state, out = step(nav, state, look(jnp.asarray(wxyz_xyz(T)), noise))
    assert out.command is None
    assert not out.done
    assert out.covariance.shape == (12, 12)
    error = inverse_cayley(np.linalg.solve(matrix(out.T_world_vehicle.wxyz_xyz), T))
    assert np.linalg.norm(error[:3]) < 0.01
    assert np.linalg.norm(error[3:]) < 0.01
    # 6 degrees of freedom and the floor
    assert 0 < float(out.nis) < 30


def test_what_cannot_be_built_is_told():
    rig, markers = worlds.qcar_rig(), worlds.paper_markers()
    with pytest.raises(ValueError, match="needs a vehicle"):
        Navigator(rig=rig, markers=markers, waypoints_m=[(1.0, 0.0)])
    with pytest.raises(ValueError, match=r"\(W, 2\)"):
        Navigator(rig=rig, markers=markers, vehicle=worlds.qcar(), waypoints_m=[(1.0, 0.0, 0.0)])
