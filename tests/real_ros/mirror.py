"""A process that sends back every message that it gets, until its input ends.

    python tests/real_ros/mirror.py tf2_msgs/msg/TFMessage ...

What comes on /there/TFMessage goes to /back/TFMessage. /load_markers answers with its question.
"""

import contextlib
import sys
import threading
from functools import partial
from importlib import import_module

import rclpy
from jaxnav_msgs.srv import LoadMarkers
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile

# Whoever comes late gets the last message too: so nobody waits for the other.
KEPT = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)


def message_type(name: str) -> type:
    """The class of e.g. tf2_msgs/msg/TFMessage."""
    package, kind, message = name.split("/")
    return getattr(import_module(f"{package}.{kind}"), message)


def _answer(request: LoadMarkers.Request, response: LoadMarkers.Response) -> LoadMarkers.Response:
    response.success, response.message = True, request.path
    return response


def _spin(node: Node) -> None:
    with contextlib.suppress(ExternalShutdownException):
        rclpy.spin(node)


def main(names: list[str]) -> None:
    rclpy.init()
    node = rclpy.create_node("mirror")
    for name in names:
        kind, topic = message_type(name), name.split("/")[-1]
        back = node.create_publisher(kind, f"/back/{topic}", KEPT)
        node.create_subscription(kind, f"/there/{topic}", partial(back.publish), KEPT)
    node.create_service(LoadMarkers, "/load_markers", _answer)
    spinning = threading.Thread(target=_spin, args=(node,))
    spinning.start()
    print("ready", flush=True)
    sys.stdin.read()
    rclpy.shutdown()
    spinning.join()


if __name__ == "__main__":
    main(sys.argv[1:])
