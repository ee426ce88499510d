"""A process that sends topics on, as a publisher that fails would: python -m tests.real_ros.relay.

What comes on /odom and /NAME/detections goes to /relayed/... A text on /fault, such as "odom
repeats", changes what goes: `odom` or `cameras`, and

    passes    as it comes
    repeats   the last message again and again, its stamp too
    stands    new content under the same stamp
    jumps     stamps set back by 1.1 s
"""

import copy
import signal
import threading

from jaxnav.recordings.ros.camera_messages import APRILTAG_ROS
from jaxnav.recordings.ros.odometry_messages import NAV_ODOMETRY
from jaxnav.vehicles.ros.connection import Connection

CAMERAS = ("front", "right", "rear", "left")
BACK_NS = 1_100_000_000


class Topic:
    """One topic that is sent on."""

    def __init__(self, ros, kind, topic, what):
        self.ros, self.what, self.how, self.last = ros, what, "passes", None
        self.publisher = ros.publisher(kind, f"/relayed{topic}")
        ros.listen(kind, topic, self.take)

    def take(self, message):
        if self.how == "repeats" and self.last is not None:
            message = self.last
        elif self.how == "stands" and self.last is not None:
            message.header.stamp = self.last.header.stamp
        elif self.how == "jumps":
            stamp = message.header.stamp
            back_ns = stamp.sec * 10**9 + stamp.nanosec - BACK_NS
            stamp.sec, stamp.nanosec = back_ns // 10**9, back_ns % 10**9
        else:
            self.last = copy.deepcopy(message)
        self.ros.publish(self.publisher, message)


def main():
    """Send on until a signal comes."""
    over = threading.Event()
    signal.signal(signal.SIGTERM, lambda *_: over.set())
    ros = Connection("relay")
    topics = [Topic(ros, NAV_ODOMETRY, "/odom", "odom")]
    topics += [Topic(ros, APRILTAG_ROS, f"/{name}/detections", "cameras") for name in CAMERAS]

    def change(message):
        what, how = message.data.split()
        for topic in topics:
            if topic.what == what:
                topic.how = how

    ros.listen("std_msgs/msg/String", "/fault", change)
    ros.run()
    over.wait()
    ros.close()


if __name__ == "__main__":
    main()
