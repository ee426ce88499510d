"""ROS messages from and to jaxnav's types; read without ROS, JAX or OpenCV."""

import importlib
from functools import cache
from typing import Any


@cache
def message_type(kind: str) -> Any:
    """The class of a message or service, by a name such as nav_msgs/msg/Odometry.

    Raises:
        ImportError: its package is not there, or is an older one without it.
    """
    package, group, name = kind.split("/")
    module = importlib.import_module(f"{package}.{group}")
    if not hasattr(module, name):
        raise ImportError(f"{package} has no {name}")
    return getattr(module, name)


def time_ns(stamp: Any) -> int:
    """A ROS stamp as ns."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)
