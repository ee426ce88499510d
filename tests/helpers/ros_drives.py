"""A small drive in a ROS bag, and how tests read one."""

import functools
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.drive.pilot import Input
from jaxnav.errors import BadInput
from jaxnav.files import TopicMap, load_topics
from jaxnav.recordings.other.ros import read_ros_drive
from tests.helpers.ros_bags import Bag
from tests.worlds import qcar, qcar_rig, room_markers

BEGIN_NS = 1_700_000_000_123_456_789  # a float64 would lose its last digits
MS = 1_000_000
SQUARE_PX = np.array([[10.25, 30], [30, 30.5], [31, 10], [10, 10.75]])  # BL BR TR TL
OTHER_PX = SQUARE_PX + 70.0
TOPICS = """
cameras: {front: /front/detections, left: /left/tags}
odometry: /odom
corner_sigma_px: 0.25
"""


IMU = """
imu:
  topic: /imu
  T_vehicle_imu: {wxyz: [1, 0, 0, 0], xyz_m: [0.1, 0, 0.2]}
  gyroscope_noise_density: 0.001
  imu_delay_s: 0.004
  max_accel_mps2: 160.0
  level: false
"""


def drive(kind: str) -> Bag:
    """Two cameras, one of apriltag_ros and one of TagSLAM, and odometry."""
    bag = Bag(kind)
    t = BEGIN_NS
    bag.odometry("/odom", t, t - MS, 0.5, 0.4)
    bag.apriltags(
        "/front/detections",
        t + 30 * MS,
        t,
        [("tag36h11", 2, SQUARE_PX), ("tag25h9", 1, OTHER_PX)],
    )
    bag.odometry("/odom", t + 31 * MS, t + 30 * MS, 0.0, 0.3)
    bag.tagslam("/left/tags", t + 35 * MS, t, [(0, OTHER_PX), (99, SQUARE_PX)])
    bag.tagslam("/left/tags", t + 70 * MS, t + 40 * MS, [])
    return bag


def topic_map(folder: Path, text: str) -> TopicMap:
    """A topic map from a file."""
    path = folder / "topics.yaml"
    path.write_text(text)
    return load_topics(path)


@functools.cache
def _car() -> tuple[CameraRig, MarkerMap, Vehicle]:
    return qcar_rig(), room_markers(), qcar()


def read(path: Path, topics: TopicMap, markers: MarkerMap | None = None) -> list[Input]:
    """The inputs of a bag, with the QCar and its cameras."""
    rig, room, car = _car()
    return read_ros_drive(path, topics, rig, markers or room, car)


def problem(*args: Any) -> str:
    """The one line that a person gets from `read`."""
    with pytest.raises(BadInput) as caught:
        read(*args)
    line = str(caught.value)
    assert "\n" not in line
    assert len(line) < 1000
    return line
