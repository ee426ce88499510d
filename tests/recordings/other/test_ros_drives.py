"""Drives from ROS bags: the written inputs are read back, whatever the format."""

import bz2
import dataclasses
import math
import sqlite3

import numpy as np
import pytest

from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.interfaces import GyroReading, TwistOdometry
from jaxnav.errors import BadInput
from jaxnav.recordings.other.recordings import read_recording
from jaxnav.recordings.other.ros import TOGETHER_NS, join_frames, read_ros_drive
from tests.helpers.ros_bags import FORMATS, Bag
from tests.helpers.ros_drives import (
    BEGIN_NS,
    MS,
    OTHER_PX,
    SQUARE_PX,
    TOPICS,
    drive,
    read,
    topic_map,
)
from tests.worlds import qcar, qcar_rig, room_markers

# --- what is written comes back -------------------------------------------------------------------


@pytest.mark.parametrize("kind", FORMATS)
def test_the_inputs_that_were_written_come_back(tmp_path, kind):
    path, topics = drive(kind).write(tmp_path), topic_map(tmp_path, TOPICS)
    first, second, both, empty = read(path, topics)
    t = BEGIN_NS
    assert [g.now_ns for g in (first, second, both, empty)] == [
        t, t + 31 * MS, t + 35 * MS, t + 70 * MS
    ]  # fmt: skip
    assert first.odometry.stamp_ns == t - MS
    forward_mps = first.odometry.speed_mps * math.cos(math.atan(0.4 * 0.256 / 0.5 / 2))
    assert forward_mps == pytest.approx(0.5, abs=1e-12)
    assert first.frames == second.frames == ()
    assert second.odometry.stamp_ns == t + 30 * MS
    assert second.odometry.steering_rad == first.odometry.steering_rad > 0.1  # held
    assert both.odometry is None
    front, left = both.frames
    names = qcar_rig().names
    assert (names[front.camera], names[left.camera]) == ("front", "left")
    assert front.stamp_ns == left.stamp_ns == t
    assert front.detections.ids.tolist() == [2, 1]
    assert front.detections.families == ("tag36h11", "tag25h9")
    # apriltag_ros counts from the edge of the image; TagSLAM's pixels are taken as they are.
    np.testing.assert_array_equal(front.detections.corners_px[0], SQUARE_PX[::-1] - 0.5)
    np.testing.assert_array_equal(left.detections.corners_px, [OTHER_PX[::-1], SQUARE_PX[::-1]])
    assert left.detections.ids.tolist() == [0, 99]
    assert left.detections.families == ("tag36h11", "")  # of the map; not in the map
    np.testing.assert_array_equal(front.detections.sigma_px, np.full((2, 4), 0.25))
    assert left.detections.refined.all()
    (frame,) = empty.frames
    assert (frame.stamp_ns, len(frame.detections), frame.faults) == (t + 40 * MS, 0, Fault(0))
    assert frame.detections.corners_px.shape == (0, 4, 2)


def test_a_compressed_bag_and_a_single_file_hold_the_same(tmp_path):
    topics = topic_map(tmp_path, TOPICS)
    plain = drive("bag").write(tmp_path)
    packed = tmp_path / "drive.bag.bz2"
    packed.write_bytes(bz2.compress(plain.read_bytes()))
    (storage,) = drive("mcap").write(tmp_path).glob("*.mcap")
    stamps = [given.now_ns for given in read(plain, topics)]
    assert [given.now_ns for given in read(packed, topics)] == stamps
    assert [given.now_ns for given in read(storage, topics)] == stamps


@pytest.mark.parametrize("kind", FORMATS)
def test_a_steering_angle_is_taken_as_it_is(tmp_path, kind):
    bag = Bag(kind)
    bag.apriltags("/front", BEGIN_NS, BEGIN_NS, [])
    bag.ackermann("/drive", BEGIN_NS + 1, BEGIN_NS - MS, -0.75, -0.375)
    topics = topic_map(tmp_path, "cameras: {front: front}\nodometry: drive\n")
    _, given = read(bag.write(tmp_path), topics)
    odometry = given.odometry
    assert (odometry.stamp_ns, odometry.speed_mps, odometry.steering_rad, odometry.valid) == (
        BEGIN_NS - MS, -0.75, -0.375, True
    )  # fmt: skip


def test_an_older_ros2_bag_has_no_definitions_of_its_own(tmp_path):
    """As rosbag2 wrote them before Iron: no definitions, neither in a table nor in the version."""
    bag = drive("db3")
    bag.rows = [row for row in bag.rows if row[0] != "/left/tags"]
    bag.ackermann("/drive", BEGIN_NS + 80 * MS, BEGIN_NS + 80 * MS, 1.0, 0.125)
    path = bag.write(tmp_path)
    (storage,) = path.glob("*.db3")
    with sqlite3.connect(storage) as database:
        database.execute("DELETE FROM message_definitions")
    database.close()
    topics = topic_map(tmp_path, "cameras: {front: /front/detections}\nodometry: /odom\n")
    _, seen, odometry = read(path, topics)
    np.testing.assert_array_equal(seen.frames[0].detections.corners_px[1], OTHER_PX[::-1] - 0.5)
    assert odometry.odometry.stamp_ns == BEGIN_NS + 30 * MS
    topics = topic_map(tmp_path, "cameras: {front: /front/detections}\nodometry: /drive\n")
    assert read(path, topics)[-1].odometry.steering_rad == 0.125


def test_a_real_bag_is_frames_of_four_cameras(tmp_path, data_dir):
    folder = data_dir / "tagslam" / "test_7"
    whole = read_recording(folder)
    places = ("bottom_left", "bottom_right", "top_left", "top_right")
    rig = CameraRig(
        whole.rig.cameras, whole.rig.Ts_camera_vehicle, places, whole.rig.image_sizes_px
    )
    cameras = "".join(f"  {place}: /quadruple/{place}/tags\n" for place in places)
    topics = topic_map(tmp_path, f"cameras:\n{cameras}")
    inputs = read_ros_drive(folder / "tag_detections.bag.bz2", topics, rig, whole.markers, qcar())
    assert [given.now_ns for given in inputs] == whole.stamps_ns.tolist()
    assert all(given.odometry is None for given in inputs)
    assert all([f.camera for f in given.frames] == [0, 1, 2, 3] for given in inputs)
    seen = 0
    for index, instant in enumerate(inputs):
        for shown in instant.frames:
            for row, marker_id in enumerate(shown.detections.ids):
                lane = index, shown.camera, whole.markers.ids.index(marker_id)
                assert whole.visible[lane]
                np.testing.assert_array_equal(
                    shown.detections.corners_px[row], whole.corners_px[lane]
                )
                seen += 1
    assert seen == whole.visible.sum() == 3235


# --- frames that belong together ------------------------------------------------------------------


def frame(camera: int, stamp_ns: int) -> FrameDetections:
    return FrameDetections(camera, stamp_ns, None)


def test_frames_with_one_stamp_are_one_input():
    frames = [
        (10, frame(1, 5)),
        (11, frame(0, 5)),  # the same instant
        (12, frame(2, 6)),  # another
        (13, frame(2, 5)),  # the same, after another
        (14, frame(1, 5)),  # the same camera again: a repeated stamp, for the pilot to refuse
        (15 + TOGETHER_NS, frame(3, 5)),  # far too late
    ]
    grouped = [(g.now_ns, [f.camera for f in g.frames]) for g in join_frames(frames)]
    assert grouped == [(13, [0, 1, 2]), (12, [2]), (14, [1]), (15 + TOGETHER_NS, [3])]


# --- a base that is no car: its twist, and its gyro about the vertical ---

BASE_TOPICS = """
cameras: {front: /front/detections}
odometry: /odom
imu: {topic: /imu, T_vehicle_imu: {wxyz: [0, 1, 0, 0], xyz_m: [0.1, 0, 0.2]}}
"""
BASE = TwistBase.create(1.0, 4.0, 0.15, gyro=GYROS["consumer"])


def base_drive(kind: str) -> Bag:
    """An IMU upside down, odometry and a camera."""
    bag, down = Bag(kind), np.array([0.0, 0.0, -9.8])
    t = BEGIN_NS
    bag.odometry("/odom", t, t - MS, 0.5, 0.4)
    bag.imu("/imu", t + 5 * MS, t + 4 * MS, np.array([0.1, 0.2, -0.3]), down)
    bag.imu("/imu", t + 15 * MS, t + 14 * MS, np.array([0.1, 0.2, -0.4]), down)
    bag.apriltags("/front/detections", t + 18 * MS, t, [("tag36h11", 2, SQUARE_PX)])
    bag.odometry("/odom", t + 20 * MS, t + 19 * MS, 0.0, 0.3)
    return bag


def read_by(tmp_path, vehicle, bag: Bag):
    topics = topic_map(tmp_path, BASE_TOPICS)
    return read_ros_drive(bag.write(tmp_path), topics, qcar_rig(), room_markers(), vehicle)


def test_twists_and_turn_rates_come_back(tmp_path):
    first, frames, second = read_by(tmp_path, BASE, base_drive("db3"))
    t = BEGIN_NS
    assert first.odometry == TwistOdometry(t - MS, 0.5, 0.0, 0.4)
    assert second.odometry == TwistOdometry(t + 19 * MS, 0.0, 0.0, 0.3)  # on the spot
    assert (first.gyro, frames.gyro) == ((), ())
    assert len(frames.frames) == 1
    told = [GyroReading(t + 4 * MS, 0.3), GyroReading(t + 14 * MS, 0.4)]
    assert [one.stamp_ns for one in second.gyro] == [one.stamp_ns for one in told]
    rates = [one.turn_radps for one in second.gyro]
    assert rates == pytest.approx([one.turn_radps for one in told], abs=1e-12)


def test_without_a_gyro_in_its_file_nobody_looks_at_the_imu(tmp_path):
    for name, vehicle in (("base", dataclasses.replace(BASE, gyro=None)), ("car", qcar())):
        (folder := tmp_path / name).mkdir()
        assert not any(given.gyro for given in read_by(folder, vehicle, base_drive("db3")))


def test_a_car_with_a_gyro_reads_it_too(tmp_path):
    car = dataclasses.replace(qcar(), gyro=GYROS["consumer"])
    assert [len(given.gyro) for given in read_by(tmp_path, car, base_drive("db3"))] == [0, 0, 2]


def test_what_only_a_car_tells_is_refused(tmp_path):
    bag = Bag("db3")
    bag.ackermann("/odom", BEGIN_NS, BEGIN_NS, 0.5, 0.1)
    bag.imu("/imu", BEGIN_NS, BEGIN_NS, np.zeros(3), np.zeros(3))
    bag.apriltags("/front/detections", BEGIN_NS, BEGIN_NS, [])
    with pytest.raises(BadInput, match=r"/odom: ackermann_msgs.* is a car's odometry"):
        read_by(tmp_path, BASE, bag)
