"""The vehicle frame of a rig is found from driving lines and circles in both directions."""

import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import pytest
import rig_rooms
from scipy.spatial.transform import Rotation

from jaxnav.calibrate.rig.calibrate import calibrate_rig
from jaxnav.calibrate.rig.vehicle_frame import _level, driven_frame, level_follows, moved_to_driven
from jaxnav.calibrate.rig.views import Ts_vehicle_camera, inverted
from jaxnav.core.models.vehicle import advance_bicycle
from jaxnav.errors import BadInput
from jaxnav.files.poses import transform

WHEELBASE_M, DT_S = 0.256, 0.02
SCALE, OFFSET_RAD, GAIN = 1.04, 0.015, 0.93  # of the odometry


@jax.jit
def driven(speed_mps: jax.Array, steering_rad: jax.Array) -> jax.Array:
    def along(pose, command):
        after = advance_bicycle(pose, *command, jnp.asarray(DT_S), jnp.asarray(WHEELBASE_M))
        return after, pose

    return jax.lax.scan(along, jnp.array([0.3, -0.2, 0.4]), (speed_mps, steering_rad))[1]


def drive(steering_rad: np.ndarray, noise: float = 1e-3):
    """(stamps, Ts_world_vehicle, odometry's stamps, speed, steering), as measured."""
    speed_mps = 0.5 + 0.2 * np.sin(0.3 * DT_S * np.arange(len(steering_rad)))

    poses = driven(speed_mps, steering_rad)
    rng = np.random.default_rng(0)
    count = len(steering_rad)
    measured = speed_mps / SCALE + rng.normal(0, 0.005, count)
    turned = (steering_rad - OFFSET_RAD) / GAIN + rng.normal(0, 0.005, count)
    noisy = np.asarray(poses) + rng.normal(0, noise, (count, 3))
    turn = Rotation.from_euler("z", noisy[:, 2:]).as_matrix()
    T = transform(turn, np.pad(noisy[:, :2], ((0, 0), (0, 1))))
    times = DT_S * np.arange(count)
    return times[::2] + 0.004, T[::2], times, measured, turned


CIRCLES = 0.45 * np.sign(np.sin(np.pi * DT_S * np.arange(2000) / 6.7))
EIGHT = 0.4 * np.sin(2 * np.pi * DT_S * np.arange(2000) / 10)


def test_a_drive_with_turns_both_ways_is_enough():
    stamps, Ts_world_vehicle, *odometry = drive(EIGHT)
    # Cameras were found about some frame of the rig: tilted, turned and 12 cm up.
    T_rig_vehicle = Ts_vehicle_camera(rig_rooms.spoiled(rig_rooms.qcar(), 4, 0.2, 70))[1]
    found = driven_frame(stamps, Ts_world_vehicle @ inverted(T_rig_vehicle), *odometry, WHEELBASE_M)
    driven = found.T_rig_level @ found.T_level_vehicle
    xi = rig_rooms.twists_to(driven[None], T_rig_vehicle[None])[0]
    assert np.linalg.norm(xi[:3]) < 0.01
    assert np.linalg.norm(xi[3:]) < np.deg2rad(0.3)
    sigma = np.sqrt(np.diag(found.covariance))[[0, 1, 5]]
    assert np.all(np.abs(xi[[0, 1, 5]]) < 4 * sigma)
    assert np.all(sigma < [0.01, 0.01, np.deg2rad(0.5)])


def test_the_ground_moves_with_all_frames():
    """Against the frame found anew when every frame is moved by a small twist."""
    T_rig_vehicle = Ts_vehicle_camera(rig_rooms.spoiled(rig_rooms.qcar(), 4, 0.2, 70))[1]
    Ts_world_rig = rig_rooms.lemniscate(30) @ inverted(T_rig_vehicle)
    rng = np.random.default_rng(3)
    follow = rng.normal(size=(30, 6, 1))
    step = 1e-8

    def moved(sign: float) -> np.ndarray:
        twists = jaxlie.SE3.exp(jnp.asarray(sign * step * follow[:, :, 0])).as_matrix()
        return _level(Ts_world_rig @ np.asarray(twists))[0]

    middle = inverted(_level(Ts_world_rig)[0])
    apart = (middle @ (moved(1) - moved(-1))) / (2 * step)
    twist = np.array([*apart[:3, 3], apart[2, 1], apart[0, 2], apart[1, 0]])
    predicted = level_follows(Ts_world_rig, follow)[:, 0]
    # About z the level frame is whatever it is.
    np.testing.assert_allclose(predicted[[2, 3, 4]], twist[[2, 3, 4]], atol=1e-5)


def test_a_straight_line_is_refused():
    stamps, Ts_world_vehicle, *odometry = drive(np.zeros(len(EIGHT)))
    with pytest.raises(BadInput, match=r"does not tell the vehicle's .*drive circles both ways"):
        driven_frame(stamps, Ts_world_vehicle, *odometry, WHEELBASE_M)


def test_a_rig_in_the_hand_is_refused():
    stamps, Ts_world_vehicle, *odometry = drive(EIGHT)
    angle_rad = 0.3 * np.sin(np.arange(len(stamps)) / 7)
    tilt = transform(
        Rotation.from_euler("x", angle_rad[:, None]).as_matrix(), np.zeros((len(stamps), 3))
    )
    with pytest.raises(BadInput, match=r"tilts by .* level ground"):
        driven_frame(stamps, Ts_world_vehicle @ tilt, *odometry, WHEELBASE_M)


def test_too_short_a_drive_is_refused():
    stamps, Ts_world_vehicle, *odometry = drive(EIGHT[:200])
    with pytest.raises(BadInput, match="at least 20 are needed"):
        driven_frame(stamps, Ts_world_vehicle, *odometry, WHEELBASE_M)


def test_a_drive_ties_the_cameras_to_the_vehicle_within_their_sigmas():
    """From corners to places on the vehicle, the ground being known by three markers."""
    stamps, Ts_world_vehicle, *odometry = drive(CIRCLES, noise=0.0)
    rig, room = rig_rooms.qcar(), rig_rooms.room()
    Ts_world_vehicle = Ts_world_vehicle[::8]
    Ts_world_vehicle[:, :2, 3] -= Ts_world_vehicle[:, :2, 3].mean(axis=0)
    views = rig_rooms.views_of(rig, room, Ts_world_vehicle, 0.3, seed=4)
    found = calibrate_rig(
        views, rig_rooms.spoiled(rig, 5), {index: room[index] for index in (0, 1, 2)}, 1
    )
    frames = views.only(np.ones(len(views), bool)).stamps_ns // 33_333_333
    driven = driven_frame(stamps[::8][frames], found.Ts_world_vehicle, *odometry, WHEELBASE_M)
    tied = moved_to_driven(found, driven)
    xi = rig_rooms.twists_to(tied.Ts_vehicle_camera, Ts_vehicle_camera(rig))
    assert np.all(np.abs(xi) < 4 * tied.sigmas()[:4])
    assert np.all(tied.sigmas()[:4, :3] < 0.01)
    assert np.linalg.norm(xi[:, :3], axis=1).max() < 0.01
    assert np.linalg.norm(xi[:, 3:], axis=1).max() < np.deg2rad(0.3)
