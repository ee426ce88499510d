"""Drives of a base that is no car, from ROS bags: its twist, and its gyro about the vertical."""

import dataclasses

import numpy as np
import pytest

from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.interfaces import GyroReading, TwistOdometry
from jaxnav.errors import BadInput
from jaxnav.recordings.other.ros import read_ros_drive
from tests.helpers.ros_bags import Bag
from tests.helpers.ros_drives import BEGIN_NS, MS, SQUARE_PX, topic_map
from tests.worlds import qcar, qcar_rig, room_markers

TOPICS = """
cameras: {front: /front/detections}
odometry: /odom
imu: {topic: /imu, T_vehicle_imu: {wxyz: [0, 1, 0, 0], xyz_m: [0.1, 0, 0.2]}}
"""
BASE = TwistBase.create(1.0, 4.0, 0.15, gyro=GYROS["consumer"])


def drive(kind: str) -> Bag:
    """An IMU upside down, odometry and a camera."""
    bag, down = Bag(kind), np.array([0.0, 0.0, -9.8])
    t = BEGIN_NS
    bag.odometry("/odom", t, t - MS, 0.5, 0.4)
    bag.imu("/imu", t + 5 * MS, t + 4 * MS, np.array([0.1, 0.2, -0.3]), down)
    bag.imu("/imu", t + 15 * MS, t + 14 * MS, np.array([0.1, 0.2, -0.4]), down)
    bag.apriltags("/front/detections", t + 18 * MS, t, [("tag36h11", 2, SQUARE_PX)])
    bag.odometry("/odom", t + 20 * MS, t + 19 * MS, 0.0, 0.3)
    return bag


def read(tmp_path, vehicle, bag: Bag):
    topics = topic_map(tmp_path, TOPICS)
    return read_ros_drive(bag.write(tmp_path), topics, qcar_rig(), room_markers(), vehicle)


def test_twists_and_turn_rates_come_back(tmp_path):
    first, frames, second = read(tmp_path, BASE, drive("db3"))
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
        assert not any(given.gyro for given in read(folder, vehicle, drive("db3")))


def test_a_car_with_a_gyro_reads_it_too(tmp_path):
    car = dataclasses.replace(qcar(), gyro=GYROS["consumer"])
    assert [len(given.gyro) for given in read(tmp_path, car, drive("db3"))] == [0, 0, 2]


def test_what_only_a_car_tells_is_refused(tmp_path):
    bag = Bag("db3")
    bag.ackermann("/odom", BEGIN_NS, BEGIN_NS, 0.5, 0.1)
    bag.imu("/imu", BEGIN_NS, BEGIN_NS, np.zeros(3), np.zeros(3))
    bag.apriltags("/front/detections", BEGIN_NS, BEGIN_NS, [])
    with pytest.raises(BadInput, match=r"/odom: ackermann_msgs.* is a car's odometry"):
        read(tmp_path, BASE, bag)
