"""The vehicle behind topics, with a peer that publishes odometry and hears commands."""

import math
import threading
import time
from collections.abc import Iterator

import pytest

from jaxnav.errors import BadInput
from jaxnav.recordings.ros import message_type
from jaxnav.recordings.ros.odometry_messages import (
    ACKERMANN,
    JOINTS,
    NAV_ODOMETRY,
    TWIST,
    TWIST_WITH_COVARIANCE,
)
from jaxnav.vehicles.conformance import check_vehicle
from jaxnav.vehicles.ros.connection import Connection
from jaxnav.vehicles.ros2 import open_vehicle
from tests.helpers.setups import setup_with
from tests.real_ros.processes import until

WHEELBASE_M = 0.256
SPEED_PER_THROTTLE_MPS = 10.0
SPEED_MPS, YAW_RATE_RADPS = 0.5, 0.8
STEERING_RAD = math.atan(YAW_RATE_RADPS * WHEELBASE_M / SPEED_MPS)
COURSE_MPS = SPEED_MPS * math.hypot(1.0, math.tan(STEERING_RAD) / 2)


class Peer:
    """The other side of the topics."""

    def __init__(self) -> None:
        self.connection = Connection("peer")
        self.heard: list = []
        for kind, topic in ((ACKERMANN, "/drive"), ("geometry_msgs/msg/Twist", "/cmd_vel")):
            self.connection.listen(kind, topic, self.heard.append)
        self.connection.run()
        self._publishers: dict = {}

    def send(self, kind: str, message, topic: str = "/odom", age_ns: int = 0) -> None:
        """Publish a message, stamped some time ago."""
        publisher = self._publishers.get((kind, topic))
        if publisher is None:
            publisher = self._publishers[kind, topic] = self.connection.publisher(kind, topic)
        message.header.stamp = self.connection.stamp(self.connection.now_ns() - age_ns)
        self.connection.publish(publisher, message)

    def listens(self, vehicle) -> None:
        """Wait until each end knows of the other: what is sent before may be lost."""
        until(vehicle._publisher.get_subscription_count, 30.0)
        vehicle.stop()
        until(lambda: self.heard or vehicle.stop(), 30.0)
        time.sleep(0.2)
        self.heard.clear()


@pytest.fixture
def peer() -> Iterator[Peer]:
    peer = Peer()
    yield peer
    peer.connection.close()


@pytest.fixture
def vehicle():
    vehicle = open_vehicle(setup_with())
    yield vehicle
    vehicle.close()


def twist_into(twist) -> None:
    twist.linear.x, twist.angular.z = SPEED_MPS, YAW_RATE_RADPS


def nav_odometry(forward_mps=SPEED_MPS, yaw_rate_radps=YAW_RATE_RADPS):
    message = message_type(NAV_ODOMETRY)()
    message.twist.twist.linear.x = forward_mps
    message.twist.twist.angular.z = yaw_rate_radps
    return message


def message_of(kind: str):
    """A message of the kind, of the same motion as all others."""
    message = message_type(kind)()
    if kind == ACKERMANN:
        message.drive.speed, message.drive.steering_angle = COURSE_MPS, STEERING_RAD
    elif kind == JOINTS:
        message.name = ["rear", "front", "other"]
        message.velocity = [SPEED_MPS / 0.05, 0.0, 7.0]
        message.position = [3.0, STEERING_RAD, 7.0]
    else:
        twist_into(message.twist if kind == TWIST else message.twist.twist)
    return message


def reading_after(vehicle, send):
    """What the vehicle reads once it has taken what is sent."""
    before = vehicle._reading
    # What is sent before both ends know of each other is lost.
    until(lambda: vehicle._reading is not before or send(), 20.0)
    time.sleep(0.1)  # for those still on their way
    return vehicle.read()


@pytest.mark.parametrize("kind", [NAV_ODOMETRY, ACKERMANN, TWIST_WITH_COVARIANCE, TWIST, JOINTS])
def test_every_kind_of_odometry_tells_the_same_motion(peer, kind):
    joints = {"driven": "rear", "steered": "front", "wheel_radius_m": "0.05"}
    more = joints if kind == JOINTS else {}
    vehicle = open_vehicle(setup_with(odometry_topic="/wheels", odometry_type=kind, **more))
    try:
        reading = reading_after(vehicle, lambda: peer.send(kind, message_of(kind), "/wheels"))
        assert reading.valid
        assert reading.speed_mps == pytest.approx(COURSE_MPS, rel=1e-6)
        assert reading.steering_rad == pytest.approx(STEERING_RAD, rel=1e-6)
    finally:
        vehicle.close()


def test_it_keeps_the_promises_of_a_vehicle(peer):
    done = threading.Event()

    def tell():
        publisher = peer.connection.publisher(NAV_ODOMETRY, "/odom")
        while not done.wait(0.01):
            message = nav_odometry(0.0, 0.0)
            message.header.stamp = peer.connection.stamp(peer.connection.now_ns())
            peer.connection.publish(publisher, message)

    telling = threading.Thread(target=tell)
    telling.start()
    try:
        check_vehicle(open_vehicle, setup_with())
    finally:
        done.set()
        telling.join()


def test_stamps_are_of_the_monotonic_clock(peer, vehicle):
    reading = reading_after(
        vehicle, lambda: peer.send(NAV_ODOMETRY, nav_odometry(), age_ns=40_000_000)
    )
    assert 40_000_000 <= time.monotonic_ns() - reading.stamp_ns < 5_000_000_000
    assert vehicle.read() == reading  # the latest, for as long as it is the latest


@pytest.mark.parametrize("age_ns", [-(10**9), 60 * 10**9, 10**18])
def test_a_stamp_of_another_clock_is_the_time_of_arrival(peer, vehicle, age_ns):
    before_ns = time.monotonic_ns()
    reading = reading_after(vehicle, lambda: peer.send(NAV_ODOMETRY, nav_odometry(), age_ns=age_ns))
    assert before_ns <= reading.stamp_ns <= time.monotonic_ns()


def test_what_is_no_number_is_not_valid(peer, vehicle):
    for bad in (math.nan, math.inf, 1e308):
        told = nav_odometry(bad)
        assert not reading_after(vehicle, lambda told=told: peer.send(NAV_ODOMETRY, told)).valid
    assert reading_after(vehicle, lambda: peer.send(NAV_ODOMETRY, nav_odometry())).valid


def test_commands_are_speeds_inside_the_limits(peer, vehicle):
    peer.listens(vehicle)
    vehicle.write(0.4, 0.1)
    time.sleep(0.02)
    vehicle.write(9.0, 9.0)
    vehicle.write(math.nan, 0.1)
    until(lambda: len(peer.heard) == 3, 20.0)
    speeds = [message.drive.speed for message in peer.heard]
    full = 0.3 * SPEED_PER_THROTTLE_MPS
    assert speeds == pytest.approx([0.1 * SPEED_PER_THROTTLE_MPS, full, 0])
    steering = [message.drive.steering_angle for message in peer.heard]
    assert steering[0] == 0  # no time has passed in which it could have turned
    assert 0.1 <= steering[1] <= 0.5 + 1e-6  # a float32
    assert steering[2] == steering[1]
    clock = peer.connection.source_clock()
    age_ns = time.monotonic_ns() - clock.time_ns(peer.heard[0].header.stamp)
    assert 0 <= age_ns < 5 * 10**9


def test_a_twist_is_that_of_the_rear_axle(peer):
    vehicle = open_vehicle(setup_with(command_type="twist", command_topic="/cmd_vel"))
    try:
        peer.listens(vehicle)
        vehicle._sent = STEERING_RAD, 0.0
        vehicle.write(STEERING_RAD, COURSE_MPS / SPEED_PER_THROTTLE_MPS)
        until(lambda: peer.heard, 20.0)
        twist = peer.heard[0]
        assert (twist.linear.x, twist.angular.z) == pytest.approx((SPEED_MPS, YAW_RATE_RADPS))
    finally:
        vehicle.close()


def test_who_does_not_drive_says_nothing(peer):
    vehicle = open_vehicle(setup_with(command_type="none"))
    vehicle.write(0.1, 0.1)
    vehicle.stop()
    vehicle.close()
    time.sleep(0.2)
    assert peer.heard == []


def test_before_the_first_message_and_after_the_last_there_is_no_reading(vehicle):
    with pytest.raises(OSError, match="no message on /odom yet"):
        vehicle.read()
    vehicle.close()
    for call in (vehicle.read, lambda: vehicle.write(0.0, 0.1)):
        with pytest.raises(OSError, match="the ROS vehicle is closed"):
            call()
    vehicle.stop()  # has nothing left to stop


def test_a_ros_that_is_gone_is_an_oserror(vehicle):
    vehicle._connection._rclpy.shutdown(context=vehicle._connection._context)
    with pytest.raises(OSError, match="ROS: "):
        vehicle.write(0.0, 0.1)
    vehicle._closed = True  # nothing is left to close


def test_whatever_a_callback_raises_it_is_called_again(peer, capfd):
    connection, calls = Connection("raises"), dict.fromkeys(("take", "failed", "timer"), 0)

    def raises(name):
        def call(*arguments):
            calls[name] += 1
            raise ValueError(f"{name} at {calls[name]}")

        return call

    trigger = "std_srvs/srv/Trigger"
    try:
        connection.listen(NAV_ODOMETRY, "/odom", raises("take"), failed=raises("failed"))
        connection.every(0.02, "the timer", raises("timer"))
        connection.serve(trigger, "~/answers", lambda request, response: 1 / 0)
        connection.serve(trigger, "~/beside", lambda *told: None, lambda request: 1 / 0)
        connection.run()
        until(lambda: min(calls.values()) > 2 or peer.send(NAV_ODOMETRY, nav_odometry()), 30.0)
        for name in ("answers", "beside", "answers"):
            service = message_type(trigger)
            client = peer.connection.node.create_client(service, f"/raises/{name}")
            assert client.wait_for_service(30.0)
            answer = client.call_async(service.Request())
            until(answer.done, 30.0)
            assert not answer.result().success
            problem = "ZeroDivisionError: division by zero"
            assert answer.result().message == f"~/{name}: {problem}"
        before = calls["timer"]
        until(lambda: calls["timer"] > before, 10.0)
    finally:
        connection.close()
    said = capfd.readouterr().err
    assert said.count("/odom: ValueError: take at 1") == 1
    assert said.count("the timer: ValueError: timer at 1") == 1
    assert set(connection.contained.counts) == {"/odom", "the timer", "~/answers", "~/beside"}


def test_a_message_that_raises_is_an_invalid_reading_and_the_next_is_none(
    peer, vehicle, monkeypatch
):
    with monkeypatch.context() as patch:
        patch.setattr("jaxnav.vehicles.ros2.odometry", lambda *told: 1 / 0)
        bad = reading_after(vehicle, lambda: peer.send(NAV_ODOMETRY, nav_odometry()))
        assert not bad.valid
        assert abs(time.monotonic_ns() - bad.stamp_ns) < 5 * 10**9
    assert reading_after(vehicle, lambda: peer.send(NAV_ODOMETRY, nav_odometry())).valid


def test_a_message_that_hangs_holds_up_neither_a_stop_nor_the_end(vehicle, monkeypatch):
    hangs, let_go, sent = threading.Event(), threading.Event(), []

    def stuck(publisher, message):
        if message.drive.speed > 0 and not hangs.is_set():
            hangs.set()
            let_go.wait(20.0)
        sent.append(message.drive.speed)

    monkeypatch.setattr(vehicle._connection, "publish", stuck)
    writer = threading.Thread(target=vehicle.write, args=(0.0, 0.2), daemon=True)
    writer.start()
    assert hangs.wait(10.0)
    begin_s = time.monotonic()
    vehicle.stop()
    assert time.monotonic() - begin_s < 5.0
    assert sent == [0.0]
    let_go.set()
    writer.join(10.0)
    assert sent == pytest.approx([0.0, 2.0, 0.0])


@pytest.mark.parametrize(
    ("options", "expected"),
    [
        ({"odometry_type": "pose"}, "--option odometry_type: expected nav_msgs/msg/Odometry or"),
        ({"odometry_type": JOINTS}, "--option driven: missing"),
        ({"command_type": "joy"}, "--option command_type: expected ackermann or twist or none"),
    ],
)
def test_wrong_options_are_named(options, expected):
    with pytest.raises(BadInput, match=expected):
        open_vehicle(setup_with(**options))
