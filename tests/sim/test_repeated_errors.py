"""Errors that repeat from frame to frame: corners that drift or are late, wheels that spin."""

import dataclasses
import itertools

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.geometry import T_world_vehicle_from_planar
from jaxnav.core.navigator import Navigator
from jaxnav.sim.corners import see
from jaxnav.sim.plant import OdometryNoise
from jaxnav.sim.rollout import Keep, Rollout
from jaxnav.sim.scenarios import Scenario, on_laps, scenarios
from jaxnav.vehicles.world import SimWorld, WorldSettings
from tests import worlds
from tests.helpers.spying import CAR, MARKERS, QUIET, RIG, SEEDS, Spy, keys, run, short

LEFT = 3  # the camera that the marker passes where these cars drive
PERIOD_S = Scenario.frame_period_s


def corner_x_px(obs):
    """One corner's x in the left camera."""
    return jnp.where(obs.visible[LEFT, 0], obs.corners_px[LEFT, 0, 0, 0], jnp.nan)


def aside(**changes) -> Scenario:
    """Parked with the marker to the left."""
    return short("static", start_pose=(0.6, -0.6, 0.0), **changes)


def test_corners_drift_as_a_gauss_markov_process_each_for_itself():
    seeds, frames = 24, 150
    rollout = Rollout(Spy(), CAR, MARKERS, aside(duration_s=frames * PERIOD_S), 1.0)
    _, drift = rollout.run_keeping(keys(jnp.arange(seeds)), Drift())
    assert drift.shape == (seeds, frames, 4, 1, 4, 2)
    series = drift.reshape(seeds, frames, 32)
    assert np.var(series) == pytest.approx(1, abs=0.1)
    assert np.var(series[:, 0]) == pytest.approx(1, abs=0.25)  # stationary from the first frame
    assert abs(np.mean(series)) < 0.15
    for lag in (1, 20):
        alike = np.mean(series[:, lag:] * series[:, :-lag]) / np.var(series)
        assert alike == pytest.approx(0.95**lag, abs=0.003 * lag)
    between = np.corrcoef(series.reshape(-1, 32).T) - np.eye(32)
    assert np.abs(between).max() < 0.4
    of_drives = np.corrcoef(series.reshape(seeds, -1)) - np.eye(seeds)
    assert np.abs(of_drives).max() < 0.4


def test_corners_lie_off_by_the_drift():
    rollout = Rollout(Spy(told=corner_x_px), CAR, MARKERS, aside(), 0.0)
    exact, _ = rollout.run_keeping(keys(SEEDS), Drift())
    given = dataclasses.replace(rollout, scenario=aside(corner_drift_px=0.5))
    shown, drift = given.run_keeping(keys(SEEDS), Drift())
    off_px = shown.flip_probability - exact.flip_probability
    np.testing.assert_allclose(off_px, 0.5 * drift[:, :, LEFT, 0, 0, 0], atol=1e-9)
    assert np.ptp(off_px) > 0.5
    # Fully correlated, it stays.
    own = run(Spy(told=corner_x_px), aside(corner_drift_px=0.5, corner_correlation=1.0))
    off_px = own.flip_probability - exact.flip_probability
    np.testing.assert_allclose(off_px, off_px[:, :1].repeat(15, axis=1), atol=1e-9)
    assert np.ptp(off_px[:, 0]) > 0.1


def test_late_corners_are_those_of_an_earlier_pose():
    """In a turn: of the pose that the same car had then, of a drive with four times the frames."""
    lag_s = scenarios()["late"].corner_lag_s
    fine = PERIOD_S / 4
    back = round(lag_s / fine)
    assert back * fine == pytest.approx(lag_s)
    turning = {"start_pose": (0.8, -0.6, 0.0), "latency_s": 0.0, "duration_s": 1.5}
    spy = Spy(throttle=0.05, steering_rad=0.3, told=corner_x_px)
    late = run(spy, short("late", **turning))
    often = run(spy, short("paper", frame_period_s=fine, **turning), chunk_frames=60)
    # Frame 0 commands; the car moves from then on, in both.
    np.testing.assert_allclose(late.true_pose[:, :23], often.true_pose[:, :90:4], atol=1e-3)
    expected_px, shown = jax.jit(
        jax.vmap(lambda pose: see(RIG, MARKERS, T_world_vehicle_from_planar(pose)))
    )(often.true_pose[0])
    assert np.all(shown[:, LEFT, 0])
    x_px = np.asarray(expected_px[:, LEFT, 0, 0, 0])
    at_stamp, then = x_px[::4][1:23], x_px[4 - back :: 4][:22]
    found = late.flip_probability[0, 1:23]
    assert np.abs(then - at_stamp)[10:].min() > 3
    np.testing.assert_allclose(found, then, atol=0.5)  # straight between frames: it speeds up
    np.testing.assert_allclose(found[10:], then[10:], atol=0.1)


def test_a_late_corner_does_not_see_a_car_half_way_to_where_it_was_carried():
    def error_px(obs):
        exact_px, _ = see(RIG, MARKERS, obs.T_world_vehicle_true)
        off_px = jnp.where(obs.visible[..., None, None], obs.corners_px - exact_px, 0)
        return jnp.max(jnp.abs(off_px))

    trace = run(Spy(told=error_px), short("kidnapped", kidnapped_s=0.5, corner_lag_s=0.05))
    assert np.ptp(trace.true_pose[0, :, 0]) > 0.5
    np.testing.assert_allclose(trace.flip_probability, 0, atol=1e-6)


@pytest.mark.parametrize(
    "changes", [{"corner_lag_s": 0.07}, {"corner_lag_s": -0.01}, {"corner_correlation": 1.1}]
)
def test_a_lag_or_correlation_that_cannot_be_is_refused(changes):
    with pytest.raises(ValueError, match=next(iter(changes))):
        dataclasses.replace(scenarios()["paper"], **changes)


def test_wheels_spin_one_second_in_three():
    route = {"start_pose": (-1.0, -1.0, 0.0), "duration_s": 9.0}
    honest, spinning = (
        run(Spy(throttle=0.02), short("paper", odometry=odometry, **route))
        for odometry in (QUIET, dataclasses.replace(QUIET, spin=0.5, speed_scale=1.1))
    )
    np.testing.assert_array_equal(honest.true_pose, spinning.true_pose)
    frames = np.arange(135)
    inside = frames % 15 > 0  # not at full seconds, which may be rounded either way
    told = frames[inside & (honest.flip_probability[0] > 0.01)]
    ratio = spinning.flip_probability[0, told] / honest.flip_probability[0, told]
    expected = np.where(told // 15 % 3 == 2, 1.5 * 1.1, 1.1)
    assert len(told) > 120
    np.testing.assert_allclose(ratio, expected, rtol=1e-9)


def test_the_steering_sensor_is_off_and_the_car_is_not():
    scenario = scenarios()["uneven-wheels"]
    offset_rad = scenario.odometry.steering_offset_rad
    assert offset_rad == pytest.approx(np.deg2rad(1))
    odometry = dataclasses.replace(QUIET, steering_offset_rad=offset_rad)
    straight = short("paper", start_pose=(0.0, 0.0, 0.0), odometry=odometry)
    trace = run(Spy(throttle=0.1, told=lambda obs: obs.steering_rad), straight)
    np.testing.assert_allclose(trace.flip_probability, offset_rad, rtol=1e-9)
    np.testing.assert_allclose(trace.true_pose[..., 1:], 0, atol=1e-12)


def test_the_car_that_run_drives_in_simulation_has_the_same_odometer():
    noise = OdometryNoise(0.0, 0.0, speed_scale=1.1, steering_offset_rad=0.02, spin=0.5)
    world = SimWorld(
        RIG, MARKERS, CAR, worlds.FRONT_VIEW, 0, WorldSettings(odometry=noise, vehicle_timeout_s=9)
    )
    world.write(0.1, 0.05, 0)
    for stamp_s, scale in ((1.5, 1.1), (2.5, 1.65)):
        at_ns = int(stamp_s * 1e9)
        speed_mps, steering_rad = world.odometry(at_ns)
        assert speed_mps == pytest.approx(scale * world.state(at_ns)[3])
        assert steering_rad == pytest.approx(0.12)
        assert world.state(at_ns)[3] > 0.3


class Drift(Keep):
    def __call__(self, before, obs, after):
        return after.drift


def test_cameras_and_sensors_are_off_as_their_files_tell():
    """Shifted along and turned about the vehicle's axes; the true car is (1 + k) times the read."""
    car, rig = worlds.qcar_by_hand(), worlds.qcar_rig_by_hand()
    rollout = Rollout(Spy(rig=rig), car, MARKERS, scenarios()["as-told"], 0.0)
    drawn = rollout.start(keys(jnp.arange(400)))
    errors = np.asarray(drawn.truth.sensor_errors) / np.asarray(car.sensor_sigma)

    def off(wxyz_xyz):
        (T, T_told) = (jaxlie.SE3(x).inverse() for x in (wxyz_xyz, rig.Ts_camera_vehicle.wxyz_xyz))
        turn = jax.vmap(lambda R, told: (R @ told.inverse()).log())(T.rotation(), T_told.rotation())
        return jnp.concatenate([T.translation() - T_told.translation(), turn], axis=1)

    turned = np.asarray(jax.jit(jax.vmap(off))(drawn.rig.Ts_camera_vehicle.wxyz_xyz))
    turned = turned / np.asarray(rig.extrinsics_sigma)
    for drawn_sigmas in (errors, turned.reshape(400, -1)):
        np.testing.assert_allclose(np.std(drawn_sigmas, axis=0), 1, atol=0.15)
        np.testing.assert_allclose(np.mean(drawn_sigmas, axis=0), 0, atol=0.2)
        count = drawn_sigmas.shape[1]
        assert np.abs(np.corrcoef(drawn_sigmas.T) - np.eye(count)).max() < 0.25
    one = jax.tree.map(lambda leaf: leaf[7], drawn)
    moving = dataclasses.replace(one.car, speed_mps=jnp.asarray(0.4), steering_rad=jnp.asarray(0.2))
    scale, gain, offset_rad, _ = one.truth.sensor_errors
    read = one.truth.sensed(moving)
    assert float((1 + scale) * read.speed_mps) == pytest.approx(0.4)
    assert float((1 + gain) * read.steering_rad + offset_rad) == pytest.approx(0.2)
    exact = Rollout(Spy(), CAR, MARKERS, scenarios()["as-told"], 0.0).start(keys(jnp.arange(2)))
    np.testing.assert_array_equal(exact.truth.sensor_errors, 0)
    for wxyz_xyz in exact.rig.Ts_camera_vehicle.wxyz_xyz:
        np.testing.assert_array_equal(wxyz_xyz, RIG.Ts_camera_vehicle.wxyz_xyz)


@pytest.mark.long
def test_what_the_default_claims_is_true_where_errors_are_as_told():
    """Its covariance is that of its errors, within a third; half or twice of it would show."""
    scenario = dataclasses.replace(scenarios()["as-told"], duration_s=2.0)
    car = worlds.qcar_by_hand()
    motion = BicycleKalman(car, tilt_sigma_rad=0.0, height_sigma_m=0.0)
    navigator = Navigator(
        worlds.qcar_rig_by_hand(), MARKERS, car, scenario.waypoints_m, motion=motion
    )
    trace = Rollout(navigator, car, MARKERS, scenario, 1.0).run(keys(jnp.arange(32)))
    counted = np.asarray(trace.active & trace.decided)
    nees = np.where(counted, trace.nees, 0).sum(axis=1) / counted.sum(axis=1)
    assert np.all(np.isfinite(nees))
    assert 2.0 < np.mean(nees) < 4.6
    off_rad = np.abs(np.asarray(trace.pose - trace.true_pose)[..., 2])
    assert np.all(np.minimum(off_rad, 2 * np.pi - off_rad)[counted] < np.deg2rad(20))


def test_everything_is_half_of_each():
    named = scenarios()
    every = named["everything"]
    assert every.corner_lag_s == named["late"].corner_lag_s / 2
    assert every.corner_drift_px == named["drifting-corners"].corner_drift_px / 2
    off = named["each-camera-off"].extrinsics_off
    assert every.extrinsics_off == pytest.approx((off[0] / 2, off[1] / 2))
    slip, uneven = named["slip"].odometry, named["uneven-wheels"].odometry
    assert every.odometry.speed_scale - 1 == pytest.approx((slip.speed_scale - 1) / 2)
    assert every.odometry.spin == uneven.spin / 2
    assert every.odometry.steering_offset_rad == pytest.approx(uneven.steering_offset_rad / 2)
    # Of all this the navigator is told nothing.
    for name in ("late", "drifting-corners", "each-camera-off", "uneven-wheels", "everything"):
        assert named[name].told_tilt_sigma_rad == named[name].told_height_sigma_m == 0


def test_laps_keep_the_marker_in_view():
    laps = on_laps(scenarios()["slip"], 2)
    assert laps.odometry == scenarios()["slip"].odometry
    once, again = laps.waypoints_m[:4], laps.waypoints_m[4:]
    assert once == again
    poses = [
        (*np.add(a, share * np.subtract(b, a)), np.arctan2(*np.subtract(b, a)[::-1]))
        for a, b in itertools.pairwise((*once, once[0]))
        for share in np.linspace(0, 1, 9)
    ]
    _, shown = jax.jit(jax.vmap(lambda pose: see(RIG, MARKERS, T_world_vehicle_from_planar(pose))))(
        jnp.asarray(poses)
    )
    assert np.all(np.any(shown[:, :, 0], axis=1))
    way_m = sum(np.linalg.norm(np.subtract(b, a)) for a, b in itertools.pairwise((*once, once[0])))
    assert way_m == pytest.approx(6, abs=0.1)
