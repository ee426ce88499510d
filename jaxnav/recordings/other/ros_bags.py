"""Reading of messages from ROS 1 and ROS 2 bags without ROS, in the order of their reception.

    ROS 1   drive.bag, drive.bag.bz2
    ROS 2   a folder with metadata.yaml and .db3 or .mcap files, or one such file alone

Message definitions come from the bag itself. ROS 2 wrote none into .db3 files up to its release
Humble: these are read by rosbags' definitions of that release, and a few of packages outside it.
"""

from collections.abc import Callable, Collection, Generator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from jaxnav.errors import BadInput
from jaxnav.files.ranges import problem_of
from jaxnav.recordings.other import bags
from jaxnav.recordings.other.bag_readers import RULE, Ros1Reader, Ros2Reader, messages

_ROS2_FILES = (".db3", ".mcap")
_LONGEST = 200  # characters of a library's message about broken bytes, which may quote all of them

# Of apriltag_msgs 2 and ackermann_msgs 2.
_DEFINITIONS = {
    "apriltag_msgs/msg/AprilTagDetectionArray": f"""std_msgs/Header header
AprilTagDetection[] detections
{RULE}MSG: apriltag_msgs/AprilTagDetection
string family
int32 id
int32 hamming
float32 goodness
float32 decision_margin
Point centre
Point[4] corners
float64[9] homography
{RULE}MSG: apriltag_msgs/Point
float64 x
float64 y
""",
    "ackermann_msgs/msg/AckermannDriveStamped": f"""std_msgs/Header header
AckermannDrive drive
{RULE}MSG: ackermann_msgs/AckermannDrive
float32 steering_angle
float32 steering_angle_velocity
float32 speed
float32 acceleration
float32 jerk
""",
}


@dataclass(frozen=True)
class ReceivedMessage:
    """A message, with its topic, its type, and the time at which the recorder received it."""

    topic: str
    kind: str  # its type, as `nav_msgs/msg/Odometry`
    received_ns: int
    message: Any


# All topics of a bag with their types -> those to read; raises BadInput where they do not suffice.
Choose = Callable[[Mapping[str, str]], Collection[str]]


def read_messages(path: Path, choose: Choose) -> Generator[ReceivedMessage, None, None]:
    """Read the messages of some topics of a bag.

    Raises:
        BadInput: the path is no bag, a broken one, or one that ends too early; or `choose` raises.
    """
    if path.is_dir():
        if not (path / "metadata.yaml").exists():
            raise BadInput(path, "is no ROS 2 bag: it holds no metadata.yaml")
        yield from _read(path, path, Ros2Reader, choose)
    elif path.suffix in _ROS2_FILES and path.exists():
        yield from _read(path, path, Ros2Reader, choose)
    elif bags.is_bag(path):
        with bags.decompress_bag(path) as plain:
            yield from _read(path, plain, Ros1Reader, choose)
    elif not path.exists():
        raise BadInput(path, "there is no such file or folder")
    else:
        raise BadInput(
            path, "is no ROS bag: expected a .bag, a .bag.bz2 or the folder of a ROS 2 bag"
        )


def one_line(error: Exception) -> str:
    """An exception in one line, short enough to be read."""
    text = " ".join(str(error).split())
    text = text if len(text) <= _LONGEST else f"{text[:_LONGEST]}..."
    return f"{type(error).__name__}: {text}"


def _read(
    path: Path, plain: Path, reader_class: type[Ros1Reader | Ros2Reader], choose: Choose
) -> Generator[ReceivedMessage, None, None]:
    try:
        with reader_class(plain) as reader:
            chosen = choose({c.topic: c.msgtype for c in reader.connections})
            connections = [c for c in reader.connections if c.topic in chosen]
            for connection, received_ns, message in messages(reader, connections, _DEFINITIONS):
                if not isinstance(received_ns, int):
                    raise ValueError(f"a message of {connection.topic} has no time")
                if problem := problem_of("stamp_ns", received_ns):
                    raise ValueError(f"the time of a message of {connection.topic} {problem}")
                yield ReceivedMessage(connection.topic, connection.msgtype, received_ns, message)
    except BadInput:
        raise
    except Exception as error:
        # The reader may meet any bytes, and raises whatever they lead to.
        raise BadInput(path, f"is not a readable ROS bag ({one_line(error)})") from None
