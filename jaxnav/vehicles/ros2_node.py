"""Run a ROS 2 node in a context of its own, so that the process's signals stay with the loop."""

import threading
import time
from collections.abc import Callable
from typing import Any

_QUEUE = 10
_WAIT_S = 0.05  # how long the thread sleeps where no message comes
_OLDEST_NS = 1_000_000_000  # a message that claims to be older was stamped by another clock


class Node:
    """A node with topics, and with times on the monotonic clock. It must be closed."""

    def __init__(self, name: str):
        """Enter ROS.

        Raises:
            ImportError: ROS 2 or one of its message packages is not there.
        """
        import rclpy
        from ackermann_msgs.msg import AckermannDriveStamped
        from rclpy.executors import SingleThreadedExecutor
        from rclpy.time import Time

        self._rclpy, self._Time, self._Drive = rclpy, Time, AckermannDriveStamped
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self._node = rclpy.create_node(name, context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def publisher(self, message_type: type, topic: str) -> Any:
        """A publisher on a topic, for `publish`."""
        return self._node.create_publisher(message_type, topic, _QUEUE)

    def listen(self, message_type: type, topic: str, take: Callable[[Any], None]) -> None:
        """Pass every message of a topic to a function, in a thread of the node."""
        from rclpy.qos import qos_profile_sensor_data  # reliable publishers suit it too

        self._node.create_subscription(message_type, topic, take, qos_profile_sensor_data)
        self._thread = threading.Thread(target=self._run, name="ros", daemon=True)
        self._thread.start()

    def publish(self, publisher: Any, message: Any) -> None:
        """Send a message.

        Raises:
            OSError: ROS refused it.
        """
        try:
            publisher.publish(message)
        except Exception as error:
            # rclpy raises exceptions of its own for a context that is gone.
            raise OSError(f"ROS: {type(error).__name__}: {error}") from error

    def publish_drive(
        self, publisher: Any, steering_rad: float, speed_mps: float, now_ns: int
    ) -> None:
        """Send an AckermannDriveStamped.

        Raises:
            OSError: ROS refused it.
        """
        message = self._Drive()
        message.header.stamp = self.stamp(now_ns)
        message.drive.steering_angle = float(steering_rad)
        message.drive.speed = float(speed_mps)
        self.publish(publisher, message)

    def stamp(self, monotonic_ns: int) -> Any:
        """Convert a time of the monotonic clock to a ROS stamp."""
        age_ns = time.monotonic_ns() - monotonic_ns
        return self._Time(nanoseconds=max(self._now_ns() - age_ns, 0)).to_msg()

    def monotonic_ns(self, stamp: Any) -> int:
        """Convert a ROS stamp to the monotonic clock; a missing or foreign one gives now."""
        age_ns = self._now_ns() - (int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec))
        return time.monotonic_ns() - (age_ns if 0 <= age_ns <= _OLDEST_NS else 0)

    def close(self) -> None:
        """Leave ROS. May be called any number of times."""
        if self._closing.is_set():
            return
        self._closing.set()
        if self._thread is not None:
            self._thread.join(1.0)
        self._executor.shutdown()
        self._node.destroy_node()
        self._rclpy.shutdown(context=self._context)

    def _now_ns(self) -> int:
        return int(self._node.get_clock().now().nanoseconds)

    def _run(self) -> None:
        while not self._closing.is_set():
            self._executor.spin_once(timeout_sec=_WAIT_S)
