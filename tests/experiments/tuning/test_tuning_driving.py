"""The loss of a drive and its derivatives: the costs, the soft switch, and the whole loop."""

import dataclasses
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.control import Command, ControlInput, ControlState, TwistCommand, follower_along
from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.models.geometry import planar_from_T_world_vehicle
from jaxnav.core.models.imu import Gyro
from jaxnav.core.models.vehicle import TwistBase, Vehicle
from jaxnav.core.navigator import Navigator, State
from jaxnav.core.parameters import with_parameters
from jaxnav.experiments.tuning import driving
from jaxnav.experiments.tuning.drive_loss import Costs, CostsOfFrame, DriveLoss
from jaxnav.experiments.tuning.driving import ClosedLoop, without_gradient
from jaxnav.experiments.tuning.soft_switch import SoftController, SoftState, soften_switch
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.sim.plant import CarState, OdometryNoise
from jaxnav.sim.queue import Slots
from jaxnav.sim.rollout import Rollout
from jaxnav.sim.scenarios import Scenario, scenarios
from jaxnav.sim.world import Spread, nominal
from tests import worlds

RIG, MARKERS, CAR = worlds.qcar_rig().first(1), worlds.paper_markers(), worlds.qcar()
BASE = TwistBase.create(0.8, 4.0, 0.15)
GAINS = [
    f"controller.{name}"
    for name in (
        "proportional_per_m", "integral_per_ms", "integral_limit_ms", "lookahead_m", "slows_at_rad"
    )
]  # fmt: skip
SPREAD = Spread()
DRIVES = 6  # the same number in several tests, which then share a program
keys = jax.vmap(jax.random.key)


class Knows(Navigator):
    """Is told the true pose, and steers by the real controller."""

    def step(self, state, obs):
        pose = planar_from_T_world_vehicle(obs.T_world_vehicle_true)
        yes = jnp.asarray(True)
        given = ControlInput(pose, yes, obs.steering_rad, obs.dt_s, yes, None, obs.speed_mps)
        control, command, done, _ = self.controller(state.control, given)
        return State(state.belief, control), SimpleNamespace(
            candidates=SimpleNamespace(valid=jnp.ones(1, bool), steps=jnp.ones(1, int)),
            pose=pose,
            covariance=jnp.eye(6, dtype=pose.dtype),
            located=yes,
            decided=yes,
            flip_probability=jnp.zeros_like(pose[0]),
            done=done,
            command=command,
        )


def driver(radius_m=0.15, **gains) -> Navigator:
    values = {"integral_limit_ms": 1.0, "lookahead_m": 1.0, "slows_at_rad": 1.0} | gains
    navigator = Knows(
        RIG, MARKERS, CAR, worlds.WAYPOINTS_M, radius_m, selector=LowestReprojection()
    )
    return with_parameters(
        navigator, {f"controller.{name}": jnp.asarray(value) for name, value in values.items()}
    )


def scenario(**changes) -> Scenario:
    return dataclasses.replace(scenarios()["paper"], **{"duration_s": 12.0} | changes)


def loop(softness_m=0.03, navigator=None, spread=SPREAD, **changes) -> ClosedLoop:
    rollout = Rollout(
        navigator or driver(), CAR, MARKERS, scenario(**changes), 1.0, spread=spread,
        chunk_frames=45,
    )  # fmt: skip
    return ClosedLoop(rollout, DriveLoss(), softness_m)


def space_of(closed: ClosedLoop) -> Space:
    return Space.from_navigator(closed.rollout.navigator, dict.fromkeys(GAINS, True))


def moved(space: Space, name: str, by: float) -> jax.Array:
    return space.start.at[space.labels.index(name)].add(by)


def of(space: Space, slopes, name: str):
    return np.asarray(slopes)[:, space.labels.index(name)]


def slopes_as_differences(closed: ClosedLoop, space: Space, seeds, step=1e-5, rtol=1e-4):
    """The slopes of every drive, which are central differences of its loss."""
    losses, slopes = closed.value_and_grad(space.start, space, seeds)
    assert np.all(np.isfinite(losses))
    for name in space.labels:
        ahead, behind = (
            closed.value_and_grad(moved(space, name, d), space, seeds)[0] for d in (step, -step)
        )
        np.testing.assert_allclose(
            of(space, slopes, name), (ahead - behind) / (2 * step), rtol, 1e-6, err_msg=name
        )
    return slopes


@pytest.fixture(scope="module")
def tame() -> ClosedLoop:
    """One compilation for all that drive with the true pose."""
    return loop()


def test_derivatives_are_those_of_the_soft_drive(tame):
    """Against central differences of every drive, each gain by itself."""
    space, seeds = space_of(tame), keys(jnp.arange(DRIVES))
    slopes = slopes_as_differences(tame, space, seeds)
    assert np.abs(of(space, slopes, "controller.proportional_per_m")).min() > 1e-3
    assert without_gradient(slopes, space.labels) == []


class TurnsByGyro(Knows):
    """Steers by a heading that is off by what the gyro reads, as a filter's is."""

    def step(self, state, obs):
        true, (_, _, rate) = obs.T_world_vehicle_true, obs.gyro_radps
        turn = jaxlie.SE3.from_rotation(jaxlie.SO3.from_z_radians(0.05 * jnp.nan_to_num(rate)))
        still = jnp.zeros_like(rate)
        obs = dataclasses.replace(
            obs, T_world_vehicle_true=true @ turn, speed_mps=still, steering_rad=still
        )
        return super().step(state, obs)


@pytest.mark.long
@pytest.mark.parametrize("left_limit_mps", [0.0, 0.6], ids=["differential", "omni"])
def test_derivatives_of_a_base_s_drive(left_limit_mps):
    """Against central differences, with a gyro that reads what the gains have made it turn."""
    gyro = Gyro(2e-3, 0.02, 1e-4, 30.0, 0.01, delay_s=0.03)
    base = TwistBase.create(0.8, 4.0, 0.15, left_limit_mps, gyro=gyro)
    names = [f"controller.{name}" for name in ("speed_mps", "slows_per_s", "turns_per_s")]
    steers = TurnsByGyro(RIG, MARKERS, base, worlds.WAYPOINTS_M, selector=LowestReprojection())
    rollout = Rollout(steers, base, MARKERS, scenario(), 1.0, spread=SPREAD, chunk_frames=45)
    closed = ClosedLoop(rollout, DriveLoss(), 0.03)
    space, seeds = Space.from_navigator(steers, dict.fromkeys(names, True)), keys(jnp.arange(3))
    slopes = slopes_as_differences(closed, space, seeds)
    # What moves to its left never turns on the spot.
    idle = names[2:] if left_limit_mps else []
    assert without_gradient(slopes, space.labels) == idle


@pytest.mark.long
def test_derivatives_are_those_of_the_hard_drives_on_average(tame):
    """Over many seeds: differences of the loss as the car would drive, with the same seeds. The
    switch is a whole number of frames there, so the step is wide."""
    seeds, step = keys(jnp.arange(150)), 0.2
    for weights, softness_m, names in (
        (DriveLoss(cross_track=0, effort=0, smoothness=0), 0.01, GAINS[:3]),
        (DriveLoss(), 0.03, GAINS[3:4]),
    ):
        closed = dataclasses.replace(tame, loss=weights, softness_m=jnp.asarray(softness_m))
        space = space_of(closed)
        _, slopes = closed.value_and_grad(space.start, space, seeds)
        for name in names:
            ahead, behind = (
                closed.value(space.values(moved(space, name, d)), seeds)[0] for d in (step, -step)
            )
            numeric = (ahead - behind) / (2 * step)
            sigma = np.std(numeric - of(space, slopes, name)) / np.sqrt(len(seeds))
            mean = np.mean(of(space, slopes, name))
            assert abs(mean - np.mean(numeric)) < 3 * sigma + 0.05 * abs(mean), name
            assert abs(mean) > 0.02, name


def test_a_narrow_switch_is_the_hard_one(tame):
    space, seeds = space_of(tame), keys(jnp.arange(DRIVES))
    hard, costs, trace = tame.value(space.values(space.start), seeds)
    assert np.all(trace.done[:, -1])
    far = []
    for softness_m in (0.03, 1e-3, 1e-6, 0.0):
        soft = dataclasses.replace(tame, softness_m=jnp.asarray(softness_m))
        losses, slopes = soft.value_and_grad(space.start, space, seeds)
        assert np.all(np.isfinite(slopes))
        far.append(np.abs(np.asarray(losses) - hard))
    assert far[0].mean() < 0.2
    np.testing.assert_allclose(far[2:], 0, atol=1e-6)
    assert far[1].mean() < far[0].mean()
    # The time to the last waypoint is the stamp of the frame in which it was reached.
    reached = np.argmax(trace.done, axis=1) * tame.rollout.scenario.frame_period_s
    np.testing.assert_allclose(costs.time_s, reached)


def test_a_gain_that_does_nothing_is_found(tame):
    """The throttle never gets so far as to feel the bound of its integral."""
    space = space_of(tame)
    start = moved(space, "controller.integral_limit_ms", 1000.0)
    _, slopes = tame.value_and_grad(start, space, keys(jnp.arange(DRIVES)))
    assert without_gradient(slopes, space.labels) == ["controller.integral_limit_ms"]


@pytest.mark.long
def test_a_long_drive_needs_no_more_memory(tame):
    """Nothing is remembered on the way: the program of some frames is all there is."""
    space = space_of(tame)
    rollout = dataclasses.replace(tame.rollout, scenario=scenario(duration_s=67.0))
    closed = dataclasses.replace(tame, rollout=rollout)
    asked = closed, space.start, space
    drives = driving._start(*asked, jax.random.key_data(keys(jnp.arange(1))))
    program = driving._advance.jitted.lower(*asked, drives, Slots(1)).compile()
    assert rollout.scenario.frames > 1000
    assert program.memory_analysis().temp_size_in_bytes < 2**20


@pytest.mark.long
def test_through_the_whole_navigator():
    """The filter and the fit to the corners included; straight before the marker and at rest, where
    angles and distances have no derivative, without noise as well."""
    navigator = Navigator(
        RIG, MARKERS, CAR, [(0.0, 0.3)], selector=LowestReprojection(), max_candidates=2
    )
    route = scenario(
        waypoints_m=((0.0, 0.3),), start_pose=(0.0, -0.9, np.pi / 2), start_spread=(0.0,) * 3,
        duration_s=1.2, odometry=OdometryNoise(0.0, 0.0),
    )  # fmt: skip
    rollout = Rollout(navigator, CAR, MARKERS, route, 1.0, spread=SPREAD, chunk_frames=18)
    closed = ClosedLoop(rollout)
    space, seeds = (
        Space.from_navigator(navigator, {GAINS[0]: True, GAINS[3]: True}),
        keys(jnp.arange(2)),
    )
    slopes_as_differences(closed, space, seeds, step=1e-4, rtol=1e-3)
    silent = dataclasses.replace(rollout, corner_noise_px=0.0 * rollout.corner_noise_px)
    closed = dataclasses.replace(closed, rollout=silent)
    assert np.all(np.isfinite(closed.value_and_grad(space.start, space, seeds)[1]))


@pytest.mark.long
def test_the_hard_losses_are_those_of_the_hard_controller(tame):
    """By the program that differentiates; a drive does not depend on their number."""
    short = dataclasses.replace(tame.rollout, scenario=scenario(duration_s=1.0), chunk_frames=5)
    closed = dataclasses.replace(tame, rollout=short)
    space, seeds = space_of(closed), keys(jnp.arange(20))
    hard, _, _ = closed.value(space.values(space.start), seeds)
    programs = driving._advance.jitted._cache_size()
    by_the_same = closed.hard_losses(space.start, space, seeds)
    assert driving._advance.jitted._cache_size() == programs + 1
    np.testing.assert_allclose(by_the_same, hard, rtol=1e-9, atol=1e-9)
    closed.value_and_grad(space.start, space, seeds)
    assert driving._advance.jitted._cache_size() == programs + 1


def test_a_drive_without_arrival_pays_for_all_its_time():
    """It ends before, has left the floor, or believes in having arrived where it has not."""
    cut = loop(duration_s=1.0)
    _, costs, trace = cut.value({}, keys(jnp.arange(3)))
    np.testing.assert_allclose(costs.time_s, 1.0)
    small = loop(floor_m=(1.7, 2.5, -2.5, 2.5))
    _, costs, trace = small.value({}, keys(jnp.arange(3)))
    assert not np.any(trace.on_floor[:, -1])
    assert np.all(costs.under_way_s < 5.0)
    np.testing.assert_allclose(costs.time_s, 12.0)
    everywhere = loop(navigator=driver(radius_m=9.0))
    _, costs, trace = everywhere.value({}, keys(jnp.arange(3)))
    assert np.all(trace.done[:, -1])
    np.testing.assert_allclose(costs.time_s, 12.0)


def frame_costs(
    state, car=(0.0, 0.0, 0.0), old=(0.0, 0.0), new=(0.0, 0.0), was=None, of=Command, **others
) -> Costs:
    """Of one frame of a route from (0, 0) to (2, 0) and on to (2, 2), with the commands `of`."""
    route = scenario(waypoints_m=((2.0, 0.0), (2.0, 2.0)))
    zero = jnp.zeros(())
    common = {
        "truth": nominal(
            CAR if of is Command else BASE, route, jax.random.key(0), jnp.zeros(()).dtype
        ),
        "start_pose": jnp.zeros(3),
        "passed": 2,
        "on_floor": jnp.asarray(True),
    }
    before = SimpleNamespace(
        command=of(*map(jnp.asarray, old)),
        ended=jnp.asarray(False),
        frame=jnp.asarray(9),
        state=SimpleNamespace(control=was),
    )
    after = SimpleNamespace(
        command=of(*map(jnp.asarray, new)),
        car=CarState(jnp.asarray(car), zero, zero),
        state=SimpleNamespace(control=state),
        **common | {"ended": jnp.asarray(False)} | others,
    )
    return CostsOfFrame(route)(before, None, after)


def heading_for(index) -> ControlState:
    return ControlState(jnp.asarray(index), *(jnp.zeros(()),) * 3)


def test_what_a_frame_costs():
    period_s = 1 / 15
    first = frame_costs(heading_for(0), (0.5, -0.3, 1.0), (0.5, 0.0), (-0.25, 0.15))
    np.testing.assert_allclose(first.time_s, period_s)
    np.testing.assert_allclose(first.off_line_m2s, 0.09 * period_s)
    np.testing.assert_allclose(first.effort_s, 0.5 * period_s)
    np.testing.assert_allclose(first.change, 2.25 + 0.25)
    second = frame_costs(heading_for(1), (0.5, -0.3, 1.0))
    np.testing.assert_allclose(second.off_line_m2s, 1.5**2 * period_s)
    # A quarter done, the rest half and half.
    # A quarter done; of the rest a third has just come from the first waypoint to the second.
    zero, commands = jnp.zeros(()), jnp.asarray([[0.0, 0.0], [0.15, -0.15]])
    shares, moved = jnp.asarray([0.375, 0.375, 0.25]), jnp.asarray([0.25, 0.0])
    old = SoftState(jnp.asarray(0), zero, zero, zero, shares, moved, jnp.zeros(2), commands)
    new = dataclasses.replace(old, commands=jnp.asarray([[0.25, 0.0], [0.15, -0.15]]))
    soft = frame_costs(new, (0.5, -0.3, 1.0), was=old)
    np.testing.assert_allclose(soft.time_s, 0.75 * period_s)
    np.testing.assert_allclose(soft.off_line_m2s, 0.375 * (0.09 + 2.25) * period_s)
    np.testing.assert_allclose(soft.effort_s, 0.375 * (0.5 + 0.25) * period_s)
    np.testing.assert_allclose(soft.change, 0.375 * 0.25 + 0.25 * 1.0)
    done = frame_costs(heading_for(2), (0.5, -0.3, 1.0), new=(0.5, 0.3), ended=jnp.asarray(True))
    assert all(leaf == 0 for leaf in jax.tree.leaves(done))
    lost = frame_costs(heading_for(2), ended=jnp.asarray(True), passed=1)
    np.testing.assert_allclose(lost.time_s, (180 - 9) * period_s)


def test_what_a_frame_of_a_base_costs():
    """Its twist as fractions of its limits; to its left it can't be told to move."""
    twists = (0.2, 0.0, 1.0), (0.4, 0.0, -2.0)  # of 0.8 m/s, 0, 4 rad/s
    costs = frame_costs(heading_for(0), old=twists[0], new=twists[1], of=TwistCommand)
    np.testing.assert_allclose(costs.effort_s, (0.25 + 0.25) / 15)
    np.testing.assert_allclose(costs.change, 0.25**2 + 0.75**2)


def test_each_part_is_weighed_by_itself():
    costs = Costs(*map(jnp.asarray, (8.0, 4.0, 0.36, 2.0, 5.0)))
    parts = DriveLoss(0.5, 10.0, 0.25, 2.0).parts(costs)
    expected = {"time": 4.0, "cross_track": 3.0, "effort": 0.5, "smoothness": 10.0}
    assert {name: float(part) for name, part in parts.items()} == pytest.approx(expected)
    assert float(DriveLoss(0.5, 10.0, 0.25, 2.0)(costs)) == pytest.approx(17.5)
    nothing = Costs(*(jnp.zeros(()),) * 5)
    slopes = jax.grad(DriveLoss())(nothing)
    assert all(np.isfinite(leaf) for leaf in jax.tree.leaves(slopes))


@pytest.mark.parametrize("vehicle", [CAR, BASE], ids=["car", "base"])
def test_the_soft_switch_has_finite_derivatives_wherever_the_car_is(precision, vehicle):
    """On a waypoint, standing still, far away."""
    hard = driver().controller if vehicle is CAR else follower_along(worlds.WAYPOINTS_M, BASE, 0.15)
    controller = jax.tree.map(lambda leaf: jnp.asarray(leaf, precision), hard)

    @jax.jit
    @jax.grad
    def slope(floats):
        softness_m, pose, dt_s, steering_rad = floats
        soft = SoftController(controller, softness_m)
        state, total = soft.init(), jnp.zeros((), precision)
        for _ in range(3):
            given = ControlInput(pose, jnp.asarray(True), steering_rad, dt_s)
            state, command, _, log = soft(state, given)
            total = total + sum(jax.tree.leaves(command)) + log.alpha_rad
        return total + jnp.sum(state.integrals_ms) + state.shares[-1]

    for pose in ((1.3, 0.0, 0.0), (0.5, 0.65, 1.0), (1.3, 0.15, 0.0), (1e3, -1e3, 9.0)):
        for softness_m in (0.0, 1e-6, 0.03, 1.0):
            floats = [jnp.asarray(x, precision) for x in (softness_m, pose, 0.0, 0.1)]
            assert all(np.all(np.isfinite(leaf)) for leaf in slope(floats))


def test_a_navigator_without_a_route_has_nothing_to_tune():
    with pytest.raises(ValueError, match="without waypoints"):
        soften_switch(Navigator(RIG, MARKERS), 0.1)


def test_each_drive_has_a_car_of_its_own():
    wide = Spread((0.5, 2.0), (0.5, 2.0), (0.9, 1.1), (-1.0, 1.0))
    rollout = loop(spread=wide).rollout
    truth = jax.jit(jax.vmap(lambda key: rollout.first(key).truth))(keys(jnp.arange(200)))
    for value, usual, low, high in (
        (truth.vehicle.speed_per_throttle_mps, CAR.speed_per_throttle_mps, 0.5, 2.0),
        (truth.vehicle.speed_time_constant_s, CAR.speed_time_constant_s, 0.5, 2.0),
        (truth.odometer_scale, 1.0, 0.9, 1.1),
    ):
        ratio = np.asarray(value) / float(usual)
        middle, width = (low + high) / 2, high - low
        assert np.all((ratio >= low) & (ratio <= high))
        assert abs(ratio.mean() - middle) < 4 * width / np.sqrt(12 * 200)
        assert np.std(ratio) == pytest.approx(width / np.sqrt(12), rel=0.2)
    assert set(np.round([truth.latency_s.min(), truth.latency_s.max()], 6)) == {0, 0.066667}
    usual = dataclasses.replace(rollout, spread=None).first(jax.random.key(0)).truth
    assert isinstance(usual.vehicle, Vehicle)
    assert (usual.odometer_scale, usual.latency_s) == (1.0, pytest.approx(0.03))
    for a, b in zip(jax.tree.leaves(usual.vehicle), jax.tree.leaves(CAR), strict=True):
        assert a == b
