"""As much of rclpy and of two message packages as jaxnav uses, in one process."""

import threading
import time
from types import ModuleType, SimpleNamespace


class Bus:
    """All topics; time on the clock of ROS is the monotonic clock's plus an offset."""

    OFFSET_NS = 1_700_000_000_000_000_000

    def __init__(self):
        self.sent: list[tuple[str, object]] = []
        self.listening: dict[str, list] = {}
        self.waiting: list = []
        self.contexts: list = []
        self.arrived = threading.Condition()

    def now_ns(self) -> int:
        return time.monotonic_ns() + self.OFFSET_NS

    def stamp(self, ns: int) -> SimpleNamespace:
        return SimpleNamespace(sec=ns // 1_000_000_000, nanosec=ns % 1_000_000_000)

    def deliver(self, topic: str, message: object) -> None:
        """From another node."""
        with self.arrived:
            self.waiting += [(take, message) for take in self.listening.get(topic, [])]
            self.arrived.notify_all()


def _twist():
    return SimpleNamespace(
        linear=SimpleNamespace(x=0.0, y=0.0, z=0.0), angular=SimpleNamespace(x=0.0, y=0.0, z=0.0)
    )


def _header():
    return SimpleNamespace(stamp=None, frame_id="")


class OdometryMessage:
    """nav_msgs/Odometry."""

    def __init__(self):
        self.header, self.child_frame_id = _header(), ""
        pose = SimpleNamespace(
            position=SimpleNamespace(x=0.0, y=0.0, z=0.0),
            orientation=SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0),
        )
        self.pose = SimpleNamespace(pose=pose, covariance=[0.0] * 36)
        self.twist = SimpleNamespace(twist=_twist(), covariance=[0.0] * 36)


class AckermannDriveStamped:
    """ackermann_msgs/AckermannDriveStamped."""

    def __init__(self):
        self.header = _header()
        self.drive = SimpleNamespace(steering_angle=0.0, speed=0.0)


def fake_ros(bus: Bus) -> dict[str, ModuleType]:
    """Modules for `sys.modules`."""

    class Context:
        def __init__(self):
            self.running = None
            bus.contexts.append(self)

    class Time:
        def __init__(self, nanoseconds=0):
            self.nanoseconds = nanoseconds

        def to_msg(self):
            return bus.stamp(self.nanoseconds)

    class Publisher:
        def __init__(self, context, topic):
            self.context, self.topic = context, topic

        def publish(self, message):
            if not self.context.running:
                raise RuntimeError("publisher's context is invalid")
            bus.sent.append((self.topic, message))

    class Node:
        def __init__(self, name, context):
            assert context.running
            self.name, self.context, self.destroyed = name, context, False

        def create_publisher(self, message_type, topic, qos_profile):
            return Publisher(self.context, topic)

        def create_subscription(self, message_type, topic, callback, qos_profile):
            assert qos_profile == "sensor data"
            bus.listening.setdefault(topic, []).append(callback)

        def get_clock(self):
            return SimpleNamespace(now=lambda: Time(nanoseconds=bus.now_ns()))

        def destroy_node(self):
            self.destroyed = True

    class SingleThreadedExecutor:
        def __init__(self, context):
            self.context = context

        def add_node(self, node):
            self.node = node

        def spin_once(self, timeout_sec=None):
            assert self.context.running
            with bus.arrived:
                if not bus.waiting:
                    bus.arrived.wait(timeout_sec)
                now, bus.waiting = bus.waiting, []
            for take, message in now:
                take(message)

        def shutdown(self):
            pass

    def init(args=None, context=None):
        assert context.running is None
        context.running = True

    def shutdown(context=None):
        assert context.running
        context.running = False

    modules = {
        "rclpy": {
            "init": init,
            "shutdown": shutdown,
            "Context": Context,
            "create_node": lambda name, context: Node(name, context),
        },
        "rclpy.executors": {"SingleThreadedExecutor": SingleThreadedExecutor},
        "rclpy.qos": {"qos_profile_sensor_data": "sensor data"},
        "rclpy.time": {"Time": Time},
        "nav_msgs": {},
        "nav_msgs.msg": {"Odometry": OdometryMessage},
        "ackermann_msgs": {},
        "ackermann_msgs.msg": {"AckermannDriveStamped": AckermannDriveStamped},
    }
    made = {name: ModuleType(name) for name in modules}
    for name, members in modules.items():
        vars(made[name]).update(members)
    return made
