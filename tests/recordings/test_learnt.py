"""What a drive teaches of cameras and sensors, in the units and words of the files."""

import dataclasses

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest

from jaxnav.core.filter.planar import BicycleKalman
from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import DEFAULT_SENSOR_SIGMA, Vehicle
from jaxnav.core.navigator import Navigator
from jaxnav.recordings.learnt import Learnt, as_filed, errors_of
from tests import worlds
from tests.reference import paper

FRAMES, PERIOD_S, SPEED_MPS, STEERING_RAD = 400, 0.1, 0.35, 0.35
TURN_DEG, SPEED_SCALE = 1.5, 1.04
SIGMA = np.array([0.005] * 3 + [np.deg2rad(0.8)] * 3)
CAMERA = 1


def told_rig() -> CameraRig:
    rig = worlds.qcar_rig()
    return dataclasses.replace(rig, extrinsics_sigma=jnp.asarray(np.tile(SIGMA, (len(rig), 1))))


def turned(rig: CameraRig, camera: int, turn_rad: np.ndarray) -> CameraRig:
    """The rig with a camera turned in its place, about the vehicle's axes."""
    T = jaxlie.SE3(rig.Ts_camera_vehicle.wxyz_xyz[camera]).inverse()
    R = jaxlie.SO3.exp(jnp.asarray(turn_rad)) @ T.rotation()
    there = jaxlie.SE3.from_rotation_and_translation(R, T.translation()).inverse().wxyz_xyz
    wxyz_xyz = rig.Ts_camera_vehicle.wxyz_xyz.at[camera].set(there)
    return dataclasses.replace(rig, Ts_camera_vehicle=jaxlie.SE3(wxyz_xyz))


def sensors_as_told() -> Vehicle:
    vehicle = worlds.qcar()
    return dataclasses.replace(vehicle, sensor_sigma=jnp.asarray(DEFAULT_SENSOR_SIGMA))


@pytest.fixture(scope="module")
def drive():
    """Circles before the marker, one camera turned to the left, wheels that read too little."""
    rig, markers, vehicle = told_rig(), worlds.paper_markers(), sensors_as_told()
    true = turned(rig, CAMERA, np.deg2rad([0, 0, TURN_DEG]))
    nav = Navigator(rig=rig, markers=markers, vehicle=vehicle, corner_sigma_px=0.3,
                    waypoints_m=worlds.WAYPOINTS_M)  # fmt: skip
    wheelbase_m = float(vehicle.wheelbase_m)
    poses = paper.drive((0.6, -0.4, 1.2), SPEED_MPS, STEERING_RAD, FRAMES * PERIOD_S,
                        wheelbase_m, FRAMES * 10)[:-1:10]  # fmt: skip
    noise = 0.3 * np.random.default_rng(0).standard_normal((FRAMES, len(rig), 1, 4, 2))

    @jax.jit
    def run(poses, noise):
        def step(state, frame):
            pose, noise = frame
            T = worlds.T_world_vehicle_from_planar(pose)
            obs = worlds.observe(true, markers, T, noise, speed_mps=SPEED_MPS / SPEED_SCALE,
                                 steering_rad=STEERING_RAD, dt_s=PERIOD_S)  # fmt: skip
            state, out = nav.step(state, obs)
            return state, (out.decided, jnp.any(obs.visible, axis=1))

        return jax.lax.scan(step, nav.init(), (poses, noise))

    state, (decided, seen) = jax.device_get(run(jnp.asarray(poses), jnp.asarray(noise)))
    return Learnt.from_errors(*errors_of(state.belief.bank), rig, vehicle), decided, seen


@pytest.mark.long
def test_a_drive_tells_how_a_camera_is_turned_and_what_the_wheels_read(drive):
    learnt, decided, seen = drive
    assert np.all(np.sum(seen, axis=0) > 50)
    assert np.mean(decided) > 0.9
    true_deg = np.zeros((len(seen[0]), 3))
    true_deg[CAMERA, 2] = TURN_DEG
    off = learnt.turns_rad - np.deg2rad(true_deg)
    assert np.max(np.abs(off) / learnt.turns_sigma_rad) < 3.5
    assert np.all(learnt.turns_sigma_rad < learnt.turns_prior_rad / 3)
    scale, sigma = learnt.sensors[0], learnt.sensors_sigma[0]
    assert scale == pytest.approx(SPEED_SCALE - 1, abs=3 * sigma)
    assert sigma < 0.01


@pytest.mark.long
def test_it_says_only_what_it_has_learnt(drive):
    learnt, _, _ = drive
    camera, wheels = learnt.sentences()
    name = learnt.rig.names[CAMERA]
    assert camera.startswith(f"camera {name} looks 1.")
    assert "deg too far left (sigma 0." in camera
    assert wheels.startswith("speed_scale is off by +0.04")


@pytest.mark.parametrize(
    ("axis", "positive", "negative"),
    [(0, "high", "low"), (1, "right", "left"), (2, " clockwise", "anticlockwise")],
)
@pytest.mark.parametrize("camera", [0, 1])
def test_the_words_are_those_of_one_who_stands_behind_the_camera(camera, axis, positive, negative):
    """A point straight ahead in the file's camera moves the other way in the image."""
    rig = told_rig()
    R_vehicle_camera = np.asarray(rig.Ts_camera_vehicle.inverse().as_matrix())[camera, :3, :3]
    for sign, word in ((1, positive), (-1, negative)):
        turn = sign * 0.02 * R_vehicle_camera[:, axis]
        e = np.zeros(4 + 3 * len(rig))
        e[4 + 3 * camera : 7 + 3 * camera] = -turn / SIGMA[3:]
        learnt = Learnt.from_errors(e, np.full(len(e), 1e-3), rig, sensors_as_told())
        (sentence,) = learnt.sentences()
        assert word in sentence
        there = turned(rig, camera, turn)
        T, T_turned = (np.asarray(r.Ts_camera_vehicle.as_matrix())[camera] for r in (rig, there))
        ahead = np.linalg.inv(T) @ [0.1, 0, 1, 1]  # right of the middle: it moves down if rolled
        before, after = T @ ahead, T_turned @ ahead
        if axis == 0:
            assert np.sign(after[1] - before[1]) == sign  # looks up: things move down
        elif axis == 1:
            assert np.sign(after[0] - before[0]) == -sign
        else:
            assert np.sign(after[1] - before[1]) == -sign


def test_a_camera_that_has_seen_nothing_is_no_less_sure_than_before():
    e = np.zeros(4 + 3 * len(told_rig()))
    sigma = np.nextafter(np.ones(len(e), np.float32), 2).astype(float)
    learnt = Learnt.from_errors(e, sigma, told_rig(), sensors_as_told())
    assert np.all(learnt.turns_sigma_rad <= learnt.turns_prior_rad)


def test_a_rule_that_doubts_nothing_has_learnt_nothing():
    assert Learnt.from_errors(np.zeros(0), np.zeros(0), told_rig(), sensors_as_told()) is None


def test_an_error_beyond_what_its_file_allows_for_is_named_so():
    e = np.zeros(4 + 3 * 4)
    e[0], e[4 + 2] = 0.2, 3.5  # of 3 % and of a sigma
    told = Learnt.from_errors(e, np.full(len(e), 1e-3), told_rig(), sensors_as_told()).sentences()
    camera, wheels = told
    assert camera.endswith("3.5 times the sigma of its file")
    assert wheels.endswith("6.7 times the sigma of its file")


def test_a_gyro_s_errors_are_those_of_no_camera():
    """They stand behind the cameras', as many as a camera has."""
    rig, vehicle = told_rig(), dataclasses.replace(sensors_as_told(), gyro=GYROS["consumer"])
    bank = jax.device_get(BicycleKalman(vehicle).for_rig(rig, 2).init(2))
    errors, sigma = errors_of(bank)
    assert len(errors) == len(sigma) == 4 + 3 * len(rig) + 3
    marked = np.arange(len(errors), dtype=float)
    sensors, turns = as_filed(marked, rig)
    np.testing.assert_array_equal(sensors, marked[:4])
    np.testing.assert_array_equal(turns, -marked[4:-3])
    exact = dataclasses.replace(rig, extrinsics_sigma=None)
    assert as_filed(marked, exact)[1].size == as_filed(marked, None)[1].size == 0
    learnt = Learnt.from_errors(errors, sigma, rig, vehicle)
    np.testing.assert_allclose(learnt.turns_sigma_rad, learnt.turns_prior_rad)
