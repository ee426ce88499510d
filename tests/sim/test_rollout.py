"""Rollouts at corner level: their observations, and the events of each scenario."""

import dataclasses
import os

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxnav.core.filter.choose import PaperCost
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.models.geometry import planar_from_T_world_vehicle
from jaxnav.core.navigator import Navigator
from jaxnav.sim import queue
from jaxnav.sim import rollout as rollout_module
from jaxnav.sim.corners import MIN_SIDE_PX, see
from jaxnav.sim.rollout import Keep, Rollout
from jaxnav.sim.scenarios import HEADING_SIGMA_RAD, scenarios
from tests import worlds
from tests.helpers.spying import CAR, MARKERS, QUIET, RIG, SEEDS, Spy, keys, run, short
from tests.reference import paper


def test_corners_are_what_the_cameras_see():
    """As the tests' own `observe`, less what is too small to be read."""
    rng = np.random.default_rng(0)
    markers = worlds.room_markers()
    poses = np.column_stack([rng.uniform(-2.5, 2.5, (300, 2)), rng.uniform(-np.pi, np.pi, 300)])

    @jax.jit
    @jax.vmap
    def both(pose):
        T = worlds.T_world_vehicle_from_planar(pose)
        obs = worlds.observe(RIG, markers, T)
        return see(RIG, markers, T), (obs.corners_px, obs.visible)

    (corners_px, visible), (expected_px, in_view) = jax.device_get(both(jnp.asarray(poses)))
    x, y = np.moveaxis(expected_px, -1, 0)
    area = np.abs(np.sum(x * np.roll(y, -1, -1) - y * np.roll(x, -1, -1), axis=-1)) / 2
    np.testing.assert_array_equal(visible, in_view & (area > MIN_SIDE_PX**2))
    np.testing.assert_allclose(corners_px[visible], expected_px[visible], atol=1e-9)
    assert np.sum(visible) > 100
    assert np.sum(in_view & ~visible) > 5


@pytest.mark.parametrize("name", scenarios())
def test_every_scenario_runs(name):
    scenario = dataclasses.replace(scenarios()[name], duration_s=0.5)
    assert scenario.frames == 8
    trace = run(Spy(throttle=0.05), scenario, 1.0, chunk_frames=4)
    assert trace.true_pose.shape == (3, 8, 3)
    for field in dataclasses.fields(trace):
        value = getattr(trace, field.name)
        assert value.shape[:2] == (3, 8)
        assert np.all(np.isfinite(value))
    assert np.all(trace.active)
    assert np.all(trace.located)
    spread = np.array(scenario.start_spread)
    off = trace.true_pose[:, 0] - scenario.start_pose
    assert np.all(np.abs(off) <= spread)
    assert np.all(np.ptp(off, axis=0) > 0)
    still = np.ptp(trace.true_pose, axis=1).max() == 0
    assert still == (not scenario.drives)


@pytest.fixture(scope="module")
def real() -> Rollout:
    navigator = Navigator(
        RIG, MARKERS, CAR, waypoints_m=worlds.WAYPOINTS_M, selector=PaperCost(), max_candidates=2
    )
    scenario = dataclasses.replace(scenarios()["paper"], duration_s=1.2)
    return Rollout(navigator, CAR, MARKERS, scenario, 1.0, chunk_frames=9)


def test_a_seed_s_drive_does_not_depend_on_the_others(real):
    """Nor on their number, where the programs are those of one number."""
    ended = []
    first = real.run(keys(jnp.asarray([3, 5, 8])), ended.append)
    assert sum(ended) == 3
    other, _ = real.run_keeping(keys(jnp.asarray([5, 1, 8, 3])), Keep(), like=3)
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(other), strict=True):
        np.testing.assert_array_equal(a, b[[3, 0, 2]])
    assert not np.allclose(first.true_pose[0], first.true_pose[1])
    assert not np.allclose(first.pose[0] - first.true_pose[0], 0)
    alone, _ = real.run_keeping(keys(jnp.asarray([8])), Keep(), like=3)
    own = alone.active[0]
    for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(first), strict=True):
        assert len(a) == 1
        np.testing.assert_array_equal(a[0][own], b[2][: len(own)][own])


def test_a_seed_draws_what_it_always_drew():
    """Start, corner noise and odometer: figures are kept by seed."""

    def told(obs):
        return obs.corners_px[0, 0, 0, 0] + 1000 * obs.speed_mps

    scenario = dataclasses.replace(scenarios()["paper"], duration_s=1.0)
    trace = run(Spy(throttle=0.05, told=told), scenario, 1.0)
    starts = [
        [1.980457314121, -1.018542189995, 2.101630870133],
        [1.939298361826, -1.00734215694, 2.15005870793],
        [2.091889978389, -1.047823478801, 2.346960326744],
    ]
    drawn = [
        [333.433910183174, 736.847615198157, 817.567972967497],
        [385.90858361589, 756.502441721687, 858.161781255728],
        [430.230539962741, 804.01755377159, 897.077325334529],
    ]
    np.testing.assert_allclose(trace.true_pose[:, 0], starts, rtol=1e-9)
    np.testing.assert_allclose(trace.flip_probability[:, ::7], drawn, rtol=1e-7)


def test_a_drive_takes_the_place_of_one_that_has_ended(monkeypatch):
    """Drives of unequal length, more of them than places, on two threads."""
    scenario = short(
        "paper", start_pose=(1.9, 0.0, 0.0), start_spread=(0.6, 0.1, 0.0), duration_s=2.0
    )
    seeds, counted = jnp.arange(45), []
    rollout = Rollout(Spy(throttle=0.05), CAR, MARKERS, scenario, 0.5, chunk_frames=5)
    together = rollout.run(keys(seeds))
    lengths = np.sum(together.active, axis=1)
    assert lengths.min() < 10 < lengths.max() == scenario.frames
    monkeypatch.setattr(queue, "_POOL", 17)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    queued = rollout.run(keys(seeds[::-1]), counted.append)
    assert sum(counted) == 45
    for a, b in zip(jax.tree.leaves(together), jax.tree.leaves(queued), strict=True):
        np.testing.assert_array_equal(a, b[::-1])


@pytest.mark.parametrize("bank", [False, pytest.param(True, marks=pytest.mark.long)])
def test_programs_with_fewer_slots_compute_the_same(bank, monkeypatch):
    """From a start with all hypotheses to one; one sighting, two and none; the marker seen again
    after a tunnel, and a car that is carried off."""
    scenario = dataclasses.replace(
        scenarios()["kidnapped"], duration_s=4.0, hidden_s=(1.5, 2.0), kidnapped_s=2.5
    )
    selector = MultiHypothesis(hypotheses=12) if bank else PaperCost()
    navigator = Navigator(RIG, MARKERS, CAR, worlds.WAYPOINTS_M, selector=selector)
    rollout = Rollout(navigator, CAR, MARKERS, scenario, 1.0, chunk_frames=6)
    used, original = set(), rollout_module._advance

    def spy(rollout, keep, worlds, slots):
        used.add(slots)
        return original(rollout, keep, worlds, slots)

    monkeypatch.setattr(rollout_module, "_advance", spy)
    seeds = keys(jnp.arange(6))
    few = rollout.run(seeds)
    assert len(used) == 1
    used.clear()
    many, _ = rollout.run_keeping(seeds, Keep(), like=1000)
    assert len(used) == (3 if bank else 2)
    for name in ("located", "decided", "active", "done", "passed", "on_floor"):
        np.testing.assert_array_equal(getattr(few, name), getattr(many, name))
    for name in ("true_pose", "pose", "nees", "flip_probability"):
        ours, theirs = getattr(many, name), getattr(few, name)
        np.testing.assert_allclose(ours, theirs, rtol=1e-5, atol=1e-7)


def test_the_navigator_s_errors_are_measured(real):
    trace = real.run(keys(SEEDS))
    assert trace.located.all()
    distance_m = np.linalg.norm((trace.pose - trace.true_pose)[..., :2], axis=-1)
    assert np.all((distance_m > 0) & (distance_m < 5))  # a mirror image may be taken
    assert np.all(trace.nees > 0)
    assert np.ptp(trace.true_pose[:, :, :2], axis=1).max() > 0.01  # it drives


def test_a_command_acts_after_the_latency():
    """From the stamp of its frame; straight on, the speed a first-order lag."""
    scenario = short("paper", start_pose=(0.0, 0.0, 0.0))
    throttle = 0.1
    trace = run(Spy(throttle=throttle), scenario)
    time_s = np.arange(15) * scenario.frame_period_s - scenario.latency_s
    tau = float(CAR.speed_time_constant_s)
    final_mps = throttle * float(CAR.speed_per_throttle_mps)
    elapsed = np.maximum(time_s, 0)
    expected_m = final_mps * (elapsed - tau * (1 - np.exp(-elapsed / tau)))
    np.testing.assert_allclose(trace.true_pose[0, :, 0], expected_m, atol=1e-3)
    np.testing.assert_allclose(trace.true_pose[..., 1:], 0, atol=1e-12)
    # flip_probability is here the speed that the odometer told.
    np.testing.assert_allclose(
        trace.flip_probability[0], final_mps * (1 - np.exp(-elapsed / tau)), atol=1e-9
    )


def test_a_parked_car_stays_whatever_it_is_told():
    trace = run(Spy(throttle=0.3, steering_rad=0.5), short("static"))
    np.testing.assert_array_equal(trace.true_pose, trace.true_pose[:, :1].repeat(15, axis=1))
    assert np.all(trace.active)


def test_a_kidnapped_car_is_somewhere_else_at_once():
    scenario = short("kidnapped", kidnapped_s=0.5)
    trace = run(Spy(), scenario)
    moved = np.diff(trace.true_pose, axis=1)
    when = int(np.ceil(0.5 / scenario.frame_period_s)) - 1
    np.testing.assert_allclose(moved[:, when], np.tile(scenario.kidnapped_by, (3, 1)), atol=1e-12)
    np.testing.assert_array_equal(np.delete(moved, when, axis=1), 0)
    # Its wheels have not turned.
    np.testing.assert_array_equal(trace.flip_probability, 0)


def test_in_a_tunnel_nothing_is_seen():
    scenario = short("tunnel", hidden_s=(0.3, 0.7))
    trace = run(Spy(), scenario)
    stamps_s = np.arange(15) * scenario.frame_period_s
    hidden = (stamps_s >= 0.3) & (stamps_s < 0.7)
    assert hidden.any()
    np.testing.assert_array_equal(trace.located, np.tile(~hidden, (3, 1)))


def test_a_miscalibrated_rig_has_every_camera_elsewhere():
    scenario = scenarios()["miscalibrated"]
    turn_rad, shift_m = scenario.extrinsics_off
    rigs = [scenario.true_rig(RIG, jax.random.key(seed)) for seed in range(2)]
    turns = []
    for rig in rigs:
        for before, after in zip(
            np.asarray(RIG.Ts_camera_vehicle.as_matrix()),
            np.asarray(rig.Ts_camera_vehicle.as_matrix()),
            strict=True,
        ):
            off = np.linalg.inv(before) @ after
            assert worlds.rotation_angles_rad(off[:3, :3], np.eye(3)) == pytest.approx(turn_rad)
            assert np.linalg.norm(off[:3, 3]) == pytest.approx(shift_m, rel=0.02)
            turns.append(off[:3, :3])
    assert worlds.rotation_angles_rad(turns[0], turns[1]) > 0
    assert worlds.rotation_angles_rad(turns[0], turns[4]) > 0
    exact = scenarios()["paper"].true_rig(RIG, jax.random.key(0))
    jax.tree.map(np.testing.assert_array_equal, exact, RIG)

    def first_px(obs):
        return jnp.sum(jnp.where(obs.visible[..., None, None], obs.corners_px, 0))

    # Without noise the right rig sees the same for every seed, the wrong ones do not.
    right = run(Spy(told=first_px), short("static")).flip_probability
    wrong = run(Spy(told=first_px), short("static", extrinsics_off=(turn_rad, shift_m)))
    assert np.ptp(right) == 0
    assert np.ptp(wrong.flip_probability, axis=1).max() == 0
    assert np.abs(wrong.flip_probability[:, 0] - right[0, 0]).min() > 1
    assert np.ptp(wrong.flip_probability[:, 0]) > 1


def test_slipping_wheels_count_too_much():
    honest, slipping = (
        run(Spy(throttle=0.1), short("paper", odometry=dataclasses.replace(QUIET, speed_scale=s)))
        for s in (1.0, scenarios()["slip"].odometry.speed_scale)
    )
    np.testing.assert_array_equal(honest.true_pose, slipping.true_pose)
    assert honest.flip_probability.max() > 0.1
    np.testing.assert_allclose(
        slipping.flip_probability, 1.1 * honest.flip_probability, rtol=1e-9, atol=1e-12
    )


def test_blurred_corners_lie_where_they_were():
    """On a straight line at constant speed: those of the pose `corner_lag_s` ago."""

    def lag_m(obs):
        believed, _ = see(RIG, MARKERS, obs.T_world_vehicle_true)
        backed = obs.T_world_vehicle_true @ worlds.planar(-obs.speed_mps * lag_s, 0.0, 0.0)
        earlier, _ = see(RIG, MARKERS, backed)
        shown = obs.visible[..., None, None]
        worst = jnp.max(jnp.abs(jnp.where(shown, obs.corners_px - earlier, 0)))
        return jnp.where(jnp.max(jnp.abs(jnp.where(shown, earlier - believed, 0))) > 0.1, worst, 9)

    lag_s = scenarios()["blur"].corner_lag_s
    scenario = short("blur", duration_s=2.0, start_pose=(0.6, -0.6, 0.0), latency_s=0.0)
    trace = run(Spy(throttle=0.05, told=lag_m), scenario)
    assert np.all(trace.active)
    # Once the speed has settled.
    assert np.max(trace.flip_probability[:, -5:]) < 0.05


def test_other_sensors_are_told_the_truth_and_their_sigma():
    def heading_error(obs):
        assert obs.heading_sigma_rad == HEADING_SIGMA_RAD
        return obs.heading_rad - planar_from_T_world_vehicle(obs.T_world_vehicle_true)[2]

    trace = run(Spy(told=heading_error), short("static", duration_s=4.0), seeds=jnp.arange(20))
    errors = np.asarray(trace.flip_probability)
    errors = errors[np.abs(errors) < 1]  # else a whole turn apart
    assert np.std(errors) == pytest.approx(HEADING_SIGMA_RAD, rel=0.1)
    assert abs(np.mean(errors)) < 0.01


def test_a_drive_ends_off_the_floor_and_counts_no_further():
    scenario = short("paper", start_pose=(2.3, 0.0, 0.0), duration_s=6.0)
    trace = run(Spy(throttle=0.3), scenario)
    assert trace.active.shape[1] < scenario.frames  # all drives had ended
    last = np.flatnonzero(trace.active[0])[-1]
    assert np.all(trace.active[0, : last + 1])
    assert np.all(trace.on_floor[0, :last])
    assert not np.any(trace.on_floor[0, last:])
    assert trace.true_pose[0, last, 0] > 2.5 > trace.true_pose[0, last - 1, 0]
    np.testing.assert_array_equal(np.diff(trace.true_pose[0, last:], axis=0), 0)


def test_waypoints_are_passed_in_their_order():
    """Straight through both; the second one first does not count."""
    ahead = ((0.8, 0.1), (1.4, -0.1))
    scenario = short("paper", start_pose=(0.0, 0.0, 0.0), duration_s=4.0)
    for waypoints_m, passed in ((ahead, 2), (ahead[::-1], 1)):
        trace = run(Spy(throttle=0.2), dataclasses.replace(scenario, waypoints_m=waypoints_m))
        active = trace.active[0]
        assert trace.passed[0][active][-1] == passed
        assert np.all(np.diff(trace.passed[0]) >= 0)
        near = np.linalg.norm(trace.true_pose[0, :, :2] - waypoints_m[0], axis=1) <= 0.3
        assert int(np.argmax(trace.passed[0] > 0)) == int(np.argmax(near))


def test_the_car_turns_as_a_bicycle():
    scenario = short("paper", start_pose=(0.0, 0.0, 0.0), duration_s=2.0, latency_s=0.0)
    trace = run(Spy(throttle=0.1, steering_rad=0.3), scenario)
    settled = 20  # wheels at their angle, speed constant
    speed_mps = float(trace.flip_probability[0, -1])
    poses = paper.drive(
        trace.true_pose[0, settled], speed_mps, 0.3, 9 * scenario.frame_period_s, 0.256
    )
    np.testing.assert_allclose(trace.true_pose[0, settled + 9], poses[-1], atol=0.01)
