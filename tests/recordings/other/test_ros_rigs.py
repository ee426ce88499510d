"""A rig with an IMU in a ROS bag: what is read of it, and where it is found to be."""

import dataclasses
import json

import jax
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxnav.cli import main
from jaxnav.core.filter.choose import LowestReprojection
from jaxnav.core.filter.free import ConstantVelocity
from jaxnav.core.filter.imu import InertialMotion
from jaxnav.core.models.conventions import APRILTAG_PIXEL_EDGE_PX, TL_TR_BR_BL
from jaxnav.core.models.imu import CONSUMER, TACTICAL
from jaxnav.files import calib_dir
from jaxnav.recordings.other.recordings import read_recording
from jaxnav.recordings.other.replay import motion_of, replay
from jaxnav.sim.hand_held import HandHeld, imu_samples, observe
from tests.helpers.bad_input import problem
from tests.helpers.ros_bags import FORMATS, Bag
from tests.helpers.ros_drives import BEGIN_NS, MS, SQUARE_PX, topic_map
from tests.worlds import qcar_rig, room_markers

PLACE = "{wxyz: [0.7071067811865476, 0.7071067811865476, 0, 0], xyz_m: [0.1, 0, 0.2]}"
TOPICS = f"""
cameras: {{front: /front/detections, left: /left/tags}}
odometry: /odom
imu: {{topic: /imu, T_vehicle_imu: {PLACE}, imu_delay_s: 0.004}}
"""
KALIBR = f"""
cameras: {{front: /front/detections}}
imu:
  rostopic: imu
  update_rate: 200.0
  accelerometer_noise_density: 0.02
  accelerometer_random_walk: 0.003
  gyroscope_noise_density: 0.001
  gyroscope_random_walk: 0.0002
  T_vehicle_imu: {PLACE}
  max_gyro_radps: 8.0
  level: false
"""


def small_bag(kind: str) -> Bag:
    bag, t = Bag(kind), BEGIN_NS
    bag.odometry("/odom", t, t, 0.5, 0.4)
    for i in range(30):
        stamp = t + 5 * i * MS
        bag.imu("/imu", stamp + MS, stamp, np.array([0.1, 0.2, i / 10]), np.array([0, 9.8, 0.5]))
    bag.imu("/imu", t + 200 * MS, t, np.full(3, 9.0), np.full(3, np.nan))  # a stamp once more
    bag.apriltags("/front/detections", t + 30 * MS, t + 20 * MS, [("tag36h11", 2, SQUARE_PX)])
    bag.tagslam("/left/tags", t + 31 * MS, t + 20 * MS, [(0, SQUARE_PX + 50), (99, SQUARE_PX)])
    bag.tagslam("/left/tags", t + 130 * MS, t + 120 * MS, [])
    return bag


@pytest.mark.parametrize("kind", FORMATS)
def test_frames_and_samples_come_back(tmp_path, kind):
    path, topics = small_bag(kind).write(tmp_path), topic_map(tmp_path, TOPICS)
    recording = read_recording(path, qcar_rig(), room_markers(), topics)
    np.testing.assert_array_equal(recording.stamps_ns, BEGIN_NS + np.array([20, 120]) * MS)
    front, left = (recording.rig.names.index(name) for name in ("front", "left"))
    np.testing.assert_array_equal(recording.seen_at.T, sorted([[0, front, 2], [0, left, 0]]))
    of_front = recording.seen_px[recording.seen_at[1].tolist().index(front)]
    order = TL_TR_BR_BL["bottom_left"]
    np.testing.assert_allclose(of_front, SQUARE_PX[order] - APRILTAG_PIXEL_EDGE_PX)
    of_left = recording.seen_px[recording.seen_at[1].tolist().index(left)]
    np.testing.assert_allclose(of_left, SQUARE_PX[order] + 50)
    assert recording.unmapped_detections == 1

    imu = recording.imu
    np.testing.assert_array_equal(imu.stamps_ns, BEGIN_NS + 5 * np.arange(30) * MS)
    np.testing.assert_allclose(imu.gyro_radps[:, 2], np.arange(30) / 10)
    assert (imu.delay_s, imu.noise) == (0.004, CONSUMER)
    np.testing.assert_allclose(imu.lever_arm_m, [0.1, 0, 0.2])
    told = recording.preintegrated
    np.testing.assert_allclose(told.duration_s, [0, 0.1])
    # Its y is the vehicle's z: the specific force points up.
    assert told.velocity_mps[1, 2] == pytest.approx(0.98, abs=0.02)
    motion = motion_of(recording)
    assert isinstance(motion, InertialMotion)
    assert motion.gravity_mps2[2] == -9.81
    assert isinstance(motion_of(dataclasses.replace(recording, imu=None)), ConstantVelocity)


def test_kalibr_s_figures_go_by_name(tmp_path):
    path, topics = small_bag("mcap").write(tmp_path), topic_map(tmp_path, KALIBR)
    recording = read_recording(path, qcar_rig(), room_markers(), topics)
    noise = recording.imu.noise
    assert noise == dataclasses.replace(
        CONSUMER,
        accelerometer_noise_density=0.02,
        accelerometer_random_walk=0.003,
        gyroscope_noise_density=0.001,
        gyroscope_random_walk=0.0002,
    )
    np.testing.assert_array_equal(motion_of(recording).gravity_mps2, 0)
    text = TOPICS.replace("topic: /imu,", "topic: /imu, preset: tactical,")
    assert topic_map(tmp_path, text).imu.noise() == TACTICAL
    # A turned 4x4 is the same place.
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix(), [0.1, 0, 0.2]
    rows = np.round(T, 12).tolist()
    text = f"cameras: {{front: /a}}\nimu: {{topic: /imu, T_vehicle_imu: {rows}}}\n"
    entry = topic_map(tmp_path, text).imu
    np.testing.assert_allclose(entry.T_matrix(), recording.imu.T_vehicle_imu, atol=1e-12)


def test_an_imu_that_is_none_or_says_nothing_is_one_line(tmp_path):
    path = small_bag("mcap").write(tmp_path)
    short = Bag("mcap")
    short.apriltags("/front/detections", BEGIN_NS, BEGIN_NS, [])
    short.imu("/imu", BEGIN_NS, BEGIN_NS, np.zeros(3), np.zeros(3))
    (tmp_path / "short").mkdir()
    for bag, old, new, message in (
        (path, "topic: /imu", "topic: /gyro", f"imu: {path} has no topic /gyro; topics found: "),
        (path, "topic: /imu", "topic: /odom", f"imu: /odom of {path} is of nav_msgs/msg/Odometry,"),
        (short.write(tmp_path / "short"), ", left: /left/tags", "", "1 samples: 2 are needed"),
    ):
        topics = topic_map(tmp_path, TOPICS.replace(old, new))
        assert message in problem(read_recording, bag, qcar_rig(), room_markers(), topics)


@pytest.fixture(scope="module")
def walk():
    """4 s in a hand, one marker in view but for the last second; the truth at every frame."""
    rig, markers = qcar_rig(), room_markers()
    target = tuple(float(x) for x in markers.Ts_world_marker.translation()[0])
    keys = jax.random.split(jax.random.key(3), 3)
    path = HandHeld.draw(keys[0], target, (0.1, 0.2, 0.3), swing_m=0.1, swing_rad=0.1)
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = Rotation.from_rotvec([np.pi / 2, 0, 0]).as_matrix(), [0.1, 0, 0.2]
    stamps_ns = np.arange(0, 4000, 50) * MS
    samples = imu_samples(path, CONSUMER, keys[1], 4.0, T_vehicle_imu=T, delay_s=0.004)
    obs = observe(path, rig, markers, None, stamps_ns, keys[2], 0.3, stamps_ns >= 3000 * MS)
    return samples, obs, stamps_ns


def bag_of(walk) -> Bag:
    samples, obs, stamps_ns = walk
    bag = Bag("mcap")
    for stamp, gyro, accel in zip(
        samples.stamps_ns + BEGIN_NS, samples.gyro_radps, samples.accel_mps2, strict=True
    ):
        bag.imu("/imu", int(stamp), int(stamp), gyro, accel)
    order = np.argsort(TL_TR_BR_BL["bottom_left"])
    for stamp, corners_px, visible in zip(
        stamps_ns + BEGIN_NS, np.asarray(obs.corners_px), np.asarray(obs.visible), strict=True
    ):
        for camera, topic in ((0, "/front/detections"), (3, "/left/tags")):
            tags = [
                ("tag36h11", i, corners_px[camera, i][order] + APRILTAG_PIXEL_EDGE_PX)
                for i in np.flatnonzero(visible[camera])
            ]
            bag.apriltags(topic, int(stamp), int(stamp), tags)
    return bag


@pytest.mark.long
def test_a_walk_goes_on_by_the_imu_where_no_marker_is_in_view(walk, tmp_path):
    """And without it ends elsewhere."""
    topics = topic_map(tmp_path, TOPICS)
    recording = read_recording(bag_of(walk).write(tmp_path), qcar_rig(), room_markers(), topics)
    truth = walk[1].T_world_vehicle_true.translation()
    off_m = []
    for one in (recording, dataclasses.replace(recording, imu=None)):
        result = replay(one, LowestReprojection(), corner_sigma_px=0.3)
        assert result.seen[59]
        assert not result.seen[60:].any()
        off_m.append(np.linalg.norm(result.T_world_vehicle[:, 0, 4:] - truth, axis=1))
    with_imu, without = off_m
    assert with_imu[-1] < 0.08
    assert np.median(with_imu[20:60]) < 0.01
    assert without[-1] > 5 * with_imu[-1]


@pytest.mark.long
def test_replay_takes_a_topic_map_with_an_imu_for_a_rig_s(walk, tmp_path, capsys):
    path = bag_of(walk).write(tmp_path)
    topic_map(tmp_path, TOPICS)
    calib = [
        "--rig", str(calib_dir() / "qcar" / "rig.yaml"),
        "--markers", str(calib_dir() / "qcar" / "markers.yaml"),
    ]  # fmt: skip
    command = ["replay", str(path), "--topics", str(tmp_path / "topics.yaml"), *calib]
    command += ["--selector", "lowest-reprojection", "--limit", "20", "--headless"]
    out = tmp_path / "out"
    assert main([*command, "--out", str(out)]) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["imu"]
    assert summary["frames"] == 20
    assert ", with an IMU: " in capsys.readouterr().out
    assert main([*command, "--out", str(out), "--images"]) == 2
    assert "--images: is for drives" in capsys.readouterr().err
    assert main([*command, "--out", str(out), "--without-odometry"]) == 0
    assert not json.loads((out / "summary.json").read_text())["imu"]
    # With a vehicle it is a drive, whose car does not look at the IMU.
    assert main([*command, "--vehicle", "nowhere.yaml"]) == 2
    assert "nowhere.yaml" in capsys.readouterr().err
