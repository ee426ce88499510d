"""The messages that were built from source travel between two processes, as types that other
machines know."""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rclpy
from ackermann_msgs.msg import AckermannDrive, AckermannDriveStamped
from apriltag_msgs.msg import AprilTagDetection, AprilTagDetectionArray, Point
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseWithCovariance, Transform, TransformStamped, Vector3
from jaxnav_msgs.msg import Bank, Hypothesis
from jaxnav_msgs.srv import LoadMarkers
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage

from tests.helpers.ros_bags import ACKERMANN, APRILTAGS, Bag
from tests.real_ros.mirror import KEPT, message_type

PATIENCE_S = 30.0
HEADER = Header(stamp=Time(sec=1_700_000_000, nanosec=5), frame_id="map")
TF = "tf2_msgs/msg/TFMessage"
SENT = {
    TF: TFMessage(
        transforms=[
            TransformStamped(
                header=HEADER,
                child_frame_id="odom",
                transform=Transform(translation=Vector3(x=1.0, y=-2.0, z=0.5)),
            )
        ]
    ),
    ACKERMANN: AckermannDriveStamped(
        header=HEADER, drive=AckermannDrive(steering_angle=0.25, speed=-0.5)
    ),
    APRILTAGS: AprilTagDetectionArray(
        header=HEADER,
        detections=[
            AprilTagDetection(
                family="tag36h11",
                id=3,
                hamming=1,
                decision_margin=50.0,
                centre=Point(x=320.0, y=240.0),
                corners=[Point(x=float(x), y=float(y)) for x, y in np.eye(4, 2)],
                homography=np.arange(9.0),
            )
        ],
    ),
    "jaxnav_msgs/msg/Bank": Bank(
        header=HEADER,
        child_frame_id="base_link",
        hypotheses=[
            Hypothesis(pose=PoseWithCovariance(covariance=np.arange(36.0)), weight=weight)
            for weight in (0.75, 0.25)
        ],
        located=True,
        accepted=True,
        flip_probability=0.01,
        nis=7.5,
        restarts=2,
        health="OK",
        faults=["CAMERA_SILENT"],
        rejects=["TOO_OBLIQUE", "TOO_SMALL"],
    ),
}
# What `ros2 topic info --verbose` says of upstream's packages on Jazzy and later.
UPSTREAM = {
    TF: "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    ACKERMANN: "RIHS01_48ca7612a08d3bb72744fd98b71b7cf2ea24c6ad50fa4e1aa0bbad963c90d8cf",
}


@pytest.fixture(scope="module")
def node() -> Iterator[Node]:
    """A node of this process, with a mirror in another one."""
    script = Path(__file__).with_name("mirror.py")
    command = [sys.executable, script, *SENT]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE}
    with subprocess.Popen(command, text=True, **pipes) as mirror:
        assert mirror.stdout.readline() == "ready\n"
        context = rclpy.Context()
        rclpy.init(context=context)
        node = rclpy.create_node("messages", context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        yield node
        executor.shutdown()
        node.destroy_node()
        rclpy.shutdown(context=context)
        mirror.stdin.close()
        assert mirror.wait(PATIENCE_S) == 0


def _spin_until(node: Node, is_done: Callable[[], Any]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not is_done():
        assert time.monotonic() < end_s, "nothing came"
        node.executor.spin_once(timeout_sec=0.1)


@pytest.mark.parametrize("name", SENT)
def test_a_message_goes_to_another_process_and_back(node: Node, name: str) -> None:
    kind, topic, came = message_type(name), name.split("/")[-1], []
    node.create_subscription(kind, f"/back/{topic}", came.append, KEPT)
    node.create_publisher(kind, f"/there/{topic}", KEPT).publish(SENT[name])
    _spin_until(node, lambda: came)
    assert came == [SENT[name]]


def test_a_service_is_called_in_another_process(node: Node) -> None:
    client = node.create_client(LoadMarkers, "/load_markers")
    assert client.wait_for_service(PATIENCE_S)
    answer = client.call_async(LoadMarkers.Request(path="markers.yaml"))
    _spin_until(node, answer.done)
    assert answer.result() == LoadMarkers.Response(success=True, message="markers.yaml")


@pytest.mark.parametrize("name", [TF, ACKERMANN, APRILTAGS])
def test_a_type_is_upstreams(node: Node, name: str) -> None:
    """Its hash, which peers hold against their own, follows from the names, types and order of its
    fields."""
    topic = f"/back/{name.split('/')[-1]}"
    _spin_until(node, lambda: node.get_publishers_info_by_topic(topic))
    (mirror,) = node.get_publishers_info_by_topic(topic)
    assert str(mirror.topic_type_hash) == Bag("mcap").type_hash(name)
    assert str(mirror.topic_type_hash) == UPSTREAM.get(name, str(mirror.topic_type_hash))
