"""What the commands of a drive say of a base that is no car, and of its gyro."""

import dataclasses
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from jaxnav.commands.drive.observers import WIDTH, notice, status_line
from jaxnav.commands.drive.ros_setup import check_vehicle
from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.vehicle import TwistBase
from jaxnav.drive.flags import Fault
from jaxnav.errors import BadInput
from jaxnav.files.ros import load_ros
from tests import worlds
from tests.helpers.drives import make_outcome

NODE = """
rig: rig.yaml
markers: markers.yaml
vehicle: base.yaml
cameras: {front: /front/detections}
odometry: /odom
"""
IMU = "imu: {topic: /imu, T_vehicle_imu: {wxyz: [0, 1, 0, 0], xyz_m: [0, 0, 0]}}\n"
FLOATS = st.floats() | st.floats(-9, 9)


def base(**how) -> TwistBase:
    return TwistBase.create(1.0, 3.0, 0.1, **how)


@given(st.tuples(FLOATS, FLOATS, FLOATS))
def test_the_status_line_of_a_base_has_its_twist_and_always_one_width(twist):
    outcome = dataclasses.replace(make_outcome(1), twist=(0.25, -0.5, math.radians(-90)))
    line = status_line(outcome, 30.0, 4.0, True)
    assert line.endswith("go  0.25 -0.50  -90.0")
    other = dataclasses.replace(outcome, twist=twist)
    assert len(status_line(other, 30.0, 4.0, True)) == len(line) <= WIDTH


def test_a_gyro_that_begins_to_fail_is_named_once():
    invalid = dataclasses.replace(make_outcome(1), faults=Fault.GYRO_INVALID)
    assert "the gyro's readings are not finite" in notice(invalid, Fault(0))
    assert notice(invalid, Fault.GYRO_INVALID) is None
    stale = dataclasses.replace(invalid, faults=Fault.GYRO_STALE)
    assert notice(stale, Fault(0)) == "the gyro tells nothing: the drive goes on without it"
    silent = dataclasses.replace(stale, faults=Fault.GYRO_STALE | Fault.ODOMETRY_STALE)
    assert notice(silent, Fault(0)) is None  # the whole vehicle tells nothing


def node(tmp_path, text):
    path = tmp_path / "node.yaml"
    path.write_text(NODE + text)
    return load_ros(path)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        (
            "odometry_type: ackermann_msgs/msg/AckermannDriveStamped\n",
            "odometry_type: of a base that is no car must be one of nav_msgs/msg/Odometry, ",
        ),
        ("command_type: ackermann\n", "command_type: of a base that is no car must be twist"),
        ("base_x_m: 0.1\n", "base_x_m: of a base that is no car must be 0"),
        (IMU, "imu: base.yaml has no gyro"),
    ],
)
def test_a_node_refuses_what_does_not_go_with_its_vehicle(tmp_path, text, line):
    with pytest.raises(BadInput) as caught:
        check_vehicle(node(tmp_path, text), base())
    assert str(caught.value).startswith(f"{tmp_path / 'node.yaml'}: {line}")


def test_a_node_tells_its_plug_in_what_the_file_says(tmp_path):
    file = node(tmp_path, IMU + "command_type: twist\n")
    check_vehicle(file, base(gyro=GYROS["consumer"]))
    check_vehicle(node(tmp_path, ""), worlds.qcar())
    options = file.options(drives=True, sim_time=False)
    assert (options["imu_topic"], options["command_type"]) == ("/imu", "twist")
    axis = [float(part) for part in options["imu_axis"].split(",")]
    assert axis == pytest.approx([0.0, 0.0, -1.0], abs=1e-12)  # mounted upside down
    assert "command_topic" not in options
    assert file.options(drives=False, sim_time=False)["command_type"] == "none"
    # Left out, the plug-in knows by the vehicle what is sent.
    assert "command_type" not in node(tmp_path, "").options(drives=True, sim_time=False)


def test_an_imu_needs_a_vehicle(tmp_path):
    path = tmp_path / "node.yaml"
    path.write_text(NODE.replace("vehicle: base.yaml\n", "") + IMU)
    with pytest.raises(BadInput, match="imu needs a vehicle"):
        load_ros(path)
