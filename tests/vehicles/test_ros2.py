"""ROS 2 topics, on a stand-in for rclpy."""

import math
import sys
import threading
import time
from types import SimpleNamespace

import numpy as np
import pytest

from jaxnav.errors import BadInput
from jaxnav.loop.flags import Fault, Health, Reject
from jaxnav.loop.pilot import Outcome
from jaxnav.loop.plugins import open_vehicle as open_by_name
from jaxnav.testing import check_vehicle
from jaxnav.vehicles.ros2 import RosPublisher, open_vehicle
from tests.helpers.fake_ros import AckermannDriveStamped, Bus, OdometryMessage, fake_ros
from tests.helpers.setups import setup_with
from tests.worlds import qcar

SETUP = setup_with()
WHEELBASE_M = 0.256
SPEED_PER_THROTTLE_MPS = 10.0


@pytest.fixture
def bus(monkeypatch):
    bus = Bus()
    for name, module in fake_ros(bus).items():
        monkeypatch.setitem(sys.modules, name, module)
    yield bus
    assert not any(context.running for context in bus.contexts)  # everybody has left


@pytest.fixture
def vehicle(bus):
    vehicle = open_vehicle(SETUP)
    yield vehicle
    vehicle.close()


def odometry_message(bus, forward_mps, yaw_rate_radps, age_ns=0):
    message = OdometryMessage()
    message.header.stamp = bus.stamp(bus.now_ns() - age_ns)
    message.twist.twist.linear.x = forward_mps
    message.twist.twist.angular.z = yaw_rate_radps
    return message


def reading_after(bus, vehicle, topic, message):
    """What the vehicle reads once it has taken the message."""
    before = vehicle._reading
    bus.deliver(topic, message)
    until_s = time.monotonic() + 5.0
    while vehicle._reading is before and time.monotonic() < until_s:
        time.sleep(0.001)
    assert vehicle._reading is not before
    return vehicle.read()


def test_it_keeps_the_promises_of_a_vehicle(bus):
    done = threading.Event()

    def tell():
        while not done.wait(0.01):
            bus.deliver("/odom", odometry_message(bus, 0.0, 0.0))

    telling = threading.Thread(target=tell)
    telling.start()
    try:
        check_vehicle(open_vehicle, SETUP, lambda vehicle: bus.sent[-1][1].drive.speed)
    finally:
        done.set()
        telling.join()


def test_where_it_stands_the_steering_stays(bus, vehicle):
    driving = reading_after(bus, vehicle, "/odom", odometry_message(bus, 0.5, 0.8))
    standing = reading_after(bus, vehicle, "/odom", odometry_message(bus, 0.001, 0.0))
    assert driving.steering_rad == pytest.approx(math.atan(0.8 * WHEELBASE_M / 0.5))
    assert standing.steering_rad == driving.steering_rad
    assert abs(standing.speed_mps) < 0.002


def test_stamps_are_of_the_monotonic_clock(bus, vehicle):
    message = odometry_message(bus, 0.5, 0.0, age_ns=40_000_000)
    reading = reading_after(bus, vehicle, "/odom", message)
    assert 40_000_000 <= time.monotonic_ns() - reading.stamp_ns < 200_000_000
    assert vehicle.read() == reading  # the latest, for as long as it is the latest


@pytest.mark.parametrize("age_ns", [-(10**9), 60 * 10**9, Bus.OFFSET_NS])
def test_a_stamp_of_another_clock_is_the_time_of_arrival(bus, vehicle, age_ns):
    message = odometry_message(bus, 0.5, 0.0, age_ns=age_ns)
    reading = reading_after(bus, vehicle, "/odom", message)
    assert 0 <= time.monotonic_ns() - reading.stamp_ns < 10**8


def test_what_is_no_number_is_not_valid(bus, vehicle):
    message = odometry_message(bus, math.nan, 0.0)
    assert not reading_after(bus, vehicle, "/odom", message).valid


def test_it_can_listen_to_ackermann_messages(bus):
    options = {"odometry_topic": "/wheel", "odometry_type": "ackermann", "command_topic": "/go"}
    vehicle = open_vehicle(setup_with(**options))
    message = AckermannDriveStamped()
    message.header.stamp = bus.stamp(bus.now_ns())
    message.drive.speed, message.drive.steering_angle = 1.25, -0.3
    reading = reading_after(bus, vehicle, "/wheel", message)
    assert (reading.speed_mps, reading.steering_rad, reading.valid) == (1.25, -0.3, True)
    vehicle.write(0.0, 0.1)
    vehicle.close()
    assert {topic for topic, _ in bus.sent} == {"/go"}


def test_commands_are_speeds_inside_the_limits(bus, vehicle):
    vehicle.write(0.4, 0.1)
    time.sleep(0.02)
    vehicle.write(9.0, 9.0)
    vehicle.write(math.nan, 0.1)
    topics, messages = zip(*bus.sent, strict=True)
    assert topics == ("/drive",) * 3
    speeds = [message.drive.speed for message in messages]
    assert speeds == pytest.approx([0.1 * SPEED_PER_THROTTLE_MPS, 0.3 * SPEED_PER_THROTTLE_MPS, 0])
    steering = [message.drive.steering_angle for message in messages]
    assert steering[0] == 0  # no time has passed in which it could have turned
    assert 0.1 <= steering[1] <= 0.5
    assert steering[2] == steering[1]
    stamp = messages[0].header.stamp
    age_ns = bus.now_ns() - (stamp.sec * 10**9 + stamp.nanosec)
    assert 0 <= age_ns < 10**9


def test_before_the_first_message_and_after_the_last_there_is_no_reading(bus, vehicle):
    with pytest.raises(OSError, match="no message on /odom yet"):
        vehicle.read()
    vehicle.close()
    for call in (vehicle.read, lambda: vehicle.write(0.0, 0.1)):
        with pytest.raises(OSError, match="the ROS vehicle is closed"):
            call()
    vehicle.stop()  # has nothing left to stop
    assert [message.drive.speed for _, message in bus.sent] == [0.0]


def test_a_ros_that_is_gone_is_an_oserror(bus, vehicle):
    (context,) = bus.contexts
    context.running = False
    with pytest.raises(OSError, match="ROS: RuntimeError: publisher's context is invalid"):
        vehicle.write(0.0, 0.1)
    context.running = True


def test_a_message_that_hangs_holds_up_neither_a_stop_nor_the_end(bus, vehicle, monkeypatch):
    hangs, let_go, publish = threading.Event(), threading.Event(), vehicle._publisher.publish

    def stuck(message):
        if message.drive.speed > 0 and not hangs.is_set():
            hangs.set()
            let_go.wait(5.0)
        publish(message)

    monkeypatch.setattr(vehicle._publisher, "publish", stuck)
    writer = threading.Thread(target=vehicle.write, args=(0.0, 0.2), daemon=True)
    writer.start()
    assert hangs.wait(2.0)
    begin_s = time.monotonic()
    vehicle.stop()
    assert time.monotonic() - begin_s < 1.0
    assert bus.sent[-1][1].drive.speed == 0
    let_go.set()
    writer.join(2.0)
    assert [message.drive.speed for _, message in bus.sent][-2:] == [2.0, 0.0]
    vehicle.close()


def test_an_unknown_type_of_message_is_named(bus):
    with pytest.raises(
        BadInput, match="--option odometry_type: expected odometry or ackermann, got 'pose'"
    ):
        open_vehicle(setup_with(odometry_type="pose"))


@pytest.mark.parametrize(
    ("missing", "hint"),
    [("rclpy", "source its setup.bash"), ("ackermann_msgs", "install ackermann-msgs")],
)
def test_without_ros_a_person_hears_what_is_missing(bus, monkeypatch, missing, hint):
    for name in [name for name in sys.modules if name.split(".")[0] == missing]:
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(BadInput, match=rf"--car: .* needs the module {missing}.*{hint}"):
        open_by_name("jaxnav.vehicles.ros2:open_vehicle", SETUP)


POSE = np.array([1.5, -0.5, 2.0])
VELOCITY = np.array([0.3, 0.4, -0.7])


def outcome_with(**output):
    root = np.random.default_rng(3).standard_normal((6, 6))
    given = {"pose": POSE, "velocity": VELOCITY, "covariance": root @ root.T}
    told = SimpleNamespace(**given | {"located": np.asarray(True)} | output)
    now_ns = time.monotonic_ns() - 30_000_000
    flags = Health.OK, Fault(0), Reject(0)
    return Outcome(now_ns, *flags, -0.25, 0.06, told, None, None, now_ns, 0, "")


@pytest.fixture
def publisher(bus):
    publisher = RosPublisher(qcar())
    yield publisher
    publisher.close()
    publisher.close()


def test_an_outcome_becomes_two_messages(bus, publisher):
    outcome = outcome_with()
    publisher.publish(outcome)
    (command_topic, command), (pose_topic, odometry) = bus.sent
    assert (command_topic, pose_topic) == ("jaxnav/command", "jaxnav/odometry")
    assert command.drive.speed == pytest.approx(0.06 * SPEED_PER_THROTTLE_MPS)
    assert command.drive.steering_angle == -0.25
    for message in (command, odometry):
        stamp = message.header.stamp
        stamp_ns = stamp.sec * 10**9 + stamp.nanosec
        assert stamp_ns - Bus.OFFSET_NS == pytest.approx(outcome.now_ns, abs=5_000_000)
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("map", "base_link")
    position, orientation = odometry.pose.pose.position, odometry.pose.pose.orientation
    assert (position.x, position.y, position.z) == (1.5, -0.5, 0.0)
    assert 2 * math.atan2(orientation.z, orientation.w) == pytest.approx(2.0)
    assert (orientation.x, orientation.y) == (0.0, 0.0)


def test_the_covariance_stands_where_ros_wants_it(bus, publisher):
    outcome = outcome_with()
    publisher.publish(outcome)
    message = bus.sent[1][1]
    numbers = message.pose.covariance
    assert len(numbers) == 36
    assert all(type(number) is float for number in numbers)
    P = outcome.output.covariance
    expected = {0: P[0, 0], 1: P[0, 1], 5: P[0, 2], 6: P[1, 0], 7: P[1, 1], 11: P[1, 2]}
    expected |= {30: P[2, 0], 31: P[2, 1], 35: P[2, 2]}
    assert {i: n for i, n in enumerate(numbers) if n} == pytest.approx(expected)


def test_the_twist_is_in_the_axes_of_the_vehicle(bus, publisher):
    """By Monte Carlo: velocities drawn in the world, turned one by one."""
    outcome = outcome_with()
    publisher.publish(outcome)
    message = bus.sent[1][1]
    turn = np.exp(-1j * POSE[2])
    forward = (VELOCITY[0] + 1j * VELOCITY[1]) * turn
    twist = message.twist.twist
    assert (twist.linear.x, twist.linear.y) == pytest.approx((forward.real, forward.imag))
    assert twist.angular.z == VELOCITY[2]
    P = outcome.output.covariance[3:, 3:]
    drawn = np.random.default_rng(0).multivariate_normal(VELOCITY, P, 200_000)
    turned = (drawn[:, 0] + 1j * drawn[:, 1]) * turn
    sampled = np.cov(np.stack([turned.real, turned.imag, drawn[:, 2]]))
    found = np.array(message.twist.covariance).reshape(6, 6)[np.ix_([0, 1, 5], [0, 1, 5])]
    np.testing.assert_allclose(found, sampled, atol=0.02 * np.abs(sampled).max())


@pytest.mark.parametrize(
    "outcome",
    [
        outcome_with(located=np.asarray(False)),
        outcome_with(pose=np.array([1.0, np.nan, 0.0])),
    ],
)
def test_a_pose_that_is_not_known_is_not_published(bus, publisher, outcome):
    publisher.publish(outcome)
    assert [topic for topic, _ in bus.sent] == ["jaxnav/command"]


def test_topics_and_frames_can_be_named(bus):
    publisher = RosPublisher(qcar(), "/pose", "/told", "odom", "car")
    publisher.publish(outcome_with())
    publisher.close()
    assert [topic for topic, _ in bus.sent] == ["/told", "/pose"]
    odometry = bus.sent[1][1]
    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "car")
    with pytest.raises(OSError, match="ROS: RuntimeError"):
        publisher.publish(outcome_with())
