"""The node drives bases that are no cars over real DDS, and its last word is zero."""

import math
import signal
import threading
import time

import numpy as np
import pytest

from jaxnav.drive.interfaces import Setup, TwistOdometry
from jaxnav.errors import BadInput
from jaxnav.files import load_vehicle
from jaxnav.recordings.drive_log import read_drive
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.camera_messages import APRILTAG_ROS
from jaxnav.recordings.ros.odometry_messages import IMU, NAV_ODOMETRY, TWIST, TWIST_WITH_COVARIANCE
from jaxnav.vehicles.conformance import check_vehicle
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros2 import open_vehicle
from tests.real_ros.processes import node, sim_car, until
from tests.real_ros.sim_car import TOPICS, topic_of

VELOCITY = "geometry_msgs/msg/Twist"
BASE = """
base: differential
forward_limit_mps: 1.0
turn_limit_radps: 4.0
time_constant_s: 0.15
gyro: {class: consumer}
"""
OMNI = BASE.replace("differential", "omni") + "left_limit_mps: 0.5\n"


class Peer:
    """The other side of the topics."""

    def __init__(self, velocity: str = "/cmd_vel") -> None:
        self.connection = Connection("peer")
        self.commands: list = []
        self.truths: list = []
        self.banks: list = []
        self.connection.listen(VELOCITY, velocity, self.commands.append)
        self.connection.listen("geometry_msgs/msg/PoseStamped", "/truth", self.truths.append)
        self.connection.listen("jaxnav_msgs/msg/Bank", "/jaxnav/bank", self.banks.append)
        self.connection.run()
        self._publishers: dict = {}

    def send(self, kind: str, topic: str, edit) -> None:
        """Publish a message that is stamped now."""
        publisher = self._publishers.get((kind, topic))
        if publisher is None:
            publisher = self._publishers[kind, topic] = self.connection.publisher(kind, topic)
        message = message_type(kind)()
        message.header.stamp = self.connection.stamp(self.connection.now_ns())
        edit(message)
        self.connection.publish(publisher, message)


@pytest.fixture
def peer():
    peer = Peer()
    yield peer
    peer.connection.close()


def twist_of(command) -> tuple[float, ...]:
    return command.linear.x, command.linear.y, command.angular.z


def setup_of(folder, text, **options) -> Setup:
    path = folder / "vehicle.yaml"
    path.write_text(text)
    return Setup(None, None, load_vehicle(path), (0.0, 0.0, 0.0), options=options)


@pytest.mark.parametrize("stranger", ["crawler", "slider"], indirect=True)
def test_it_drives_a_stranger_to_its_goal(tmp_path, stranger):
    """Its files and its topics are called as nobody else's."""
    topics = {"/odom": "/its/wheels", "/cmd_vel": "/its/velocity", "/imu": "/its/gyro"}
    kinds = ("rig", "markers", "vehicle", "route")
    entries = {kind: f"'{getattr(stranger, kind).name}'" for kind in kinds}
    seen = {name: topic_of(name, TOPICS[APRILTAG_ROS]) for name in stranger.cameras}
    entries["cameras"] = str(seen)
    entries["odometry"], entries["command"] = topics["/odom"], topics["/cmd_vel"]
    has_gyro = len(stranger.cameras) == 2
    if has_gyro:
        upside_down = "{wxyz: [0, 1, 0, 0], xyz_m: [0, 0, 0]}"
        entries["imu"] = f"{{topic: {topics['/imu']}, T_vehicle_imu: {upside_down}}}"
    file, drive = stranger.folder / "its node.yaml", tmp_path / "a drive.mcap"
    file.write_text("".join(f"{key}: {value}\n" for key, value in entries.items()))
    words = str(file), "--timeout-s", "2", "--record", str(drive)
    robot = [f"--{kind}={getattr(stranger, kind)}" for kind in kinds]
    renamed = [word for old, new in topics.items() for word in ("-r", f"{old}:={new}")]
    peer = Peer(topics["/cmd_vel"])
    try:
        with (
            sim_car(tmp_path, *robot, "--ros-args", *renamed),
            node(tmp_path, *words) as program,
        ):

            def there() -> bool:
                at = [(one.pose.position.x, one.pose.position.y) for one in peer.truths[-1:]]
                return bool(at) and math.dist(at[0], stranger.goal_m) < 0.2

            until(there, 300.0, program)
            until(lambda: twist_of(peer.commands[-1]) == (0.0, 0.0, 0.0), 30.0, program)
            # A busy machine makes frames and readings stale: of health nothing is asked.
            assert any(one.decided for one in peer.banks)
            program.tell(signal.SIGTERM)
            assert program.ends() == 128 + signal.SIGTERM, program.said
    finally:
        peer.connection.close()
    twists = np.array([twist_of(command) for command in peer.commands])
    assert twists[-1].tolist() == [0.0, 0.0, 0.0]
    assert np.abs(twists[:, 1 if has_gyro else 2]).max() > 0.1
    assert has_gyro or not twists[:, 1].any()
    log = read_drive(drive)
    told = [one for given in log.inputs for one in given.gyro]
    assert len(told) > 100 if has_gyro else not told


@pytest.mark.parametrize("kind", [NAV_ODOMETRY, TWIST_WITH_COVARIANCE, TWIST])
def test_every_kind_of_odometry_tells_the_same_twist(tmp_path, peer, kind):
    vehicle = open_vehicle(
        setup_of(tmp_path, OMNI, odometry_type=kind, imu_topic="/imu", imu_axis="0,0,-1")
    )

    def edit(message):
        twist = message.twist if kind == TWIST else message.twist.twist
        twist.linear.x, twist.linear.y, twist.angular.z = 0.3, -0.2, 1.5

    def turn(message):
        message.angular_velocity.z = 1.4

    try:
        until(lambda: vehicle._reading or peer.send(kind, "/odom", edit), 20.0)
        reading = vehicle.read()
        assert isinstance(reading, TwistOdometry)
        assert reading.values == (0.3, -0.2, 1.5)
        assert abs(time.monotonic_ns() - reading.stamp_ns) < 5 * 10**9
        until(lambda: vehicle._turns or peer.send(IMU, "/imu", turn), 20.0)
        told = vehicle.read_gyro()
        assert {one.turn_radps for one in told} == {-1.4}  # its IMU is mounted upside down
        assert abs(time.monotonic_ns() - told[-1].stamp_ns) < 5 * 10**9
    finally:
        vehicle.close()


def test_a_twist_is_cut_at_its_limits_and_zero_is_the_last_word(tmp_path, peer):
    vehicle = open_vehicle(setup_of(tmp_path, OMNI))
    try:
        until(vehicle._publisher.get_subscription_count, 30.0)
        until(lambda: peer.commands or vehicle.stop(), 30.0)
        time.sleep(0.2)
        peer.commands.clear()
        vehicle.write(9.0, -9.0, 9.0)
        until(lambda: peer.commands, 20.0)
        assert twist_of(peer.commands[-1]) == (1.0, -0.5, 4.0)
    finally:
        vehicle.close()
    until(lambda: len(peer.commands) > 1, 20.0)
    assert twist_of(peer.commands[-1]) == (0.0, 0.0, 0.0)


def test_it_keeps_the_promises_of_a_plug_in(tmp_path, peer):
    done = threading.Event()

    def tell():
        while not done.wait(0.01):
            peer.send(NAV_ODOMETRY, "/odom", lambda message: None)

    telling = threading.Thread(target=tell)
    telling.start()
    try:
        check_vehicle(open_vehicle, setup_of(tmp_path, OMNI))
    finally:
        done.set()
        telling.join()


@pytest.mark.parametrize(
    ("options", "line"),
    [
        ({"command_type": "ackermann"}, "--option command_type: expected twist or none"),
        ({"odometry_type": "sensor_msgs/msg/JointState"}, "--option odometry_type: expected nav"),
        ({"imu_topic": "/imu", "imu_axis": "0,0,2"}, "--option imu_axis: expected three numbers"),
    ],
)
def test_what_a_base_can_not_do_is_refused(tmp_path, options, line):
    with pytest.raises(BadInput, match=line):
        open_vehicle(setup_of(tmp_path, BASE, **options))
