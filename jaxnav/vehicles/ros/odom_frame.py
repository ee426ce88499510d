"""The base's pose in the odometry's frame, from its own messages or from tf.

OdomPose     nav_msgs/Odometry, whose pose is odom -> base
OdomTf       /tf and /tf_static, where others send it: a filter of the wheels, say
"""

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from scipy.spatial.transform import Rotation

from jaxnav.files.poses import compose, inverse, pose_from_rotation_vector, rotated
from jaxnav.files.ranges import is_within
from jaxnav.vehicles.ros.source_clock import SourceClock

IDENTITY = np.array([1.0, 0, 0, 0, 0, 0, 0])  # wxyz xyz
_STALE_NS = 200_000_000  # an older odometry is not carried on
_KEPT = 64  # transforms of a frame, of which the estimate's time must lie near the last
_RATE_NS = 50_000_000  # a frame's motion is known from transforms at least so far apart
_LONGEST = 8  # frames from base to odom


class OdomFrame(Protocol):
    """What knows T_odom_base."""

    def at(self, now_ns: int) -> np.ndarray | None:
        """T_odom_base (7,) wxyz_xyz at a time; None where nothing is known."""
        ...


class OdomPose:
    """The pose of an odometry's last message, carried on to the present by its twist."""

    def __init__(self, T_base_sensor: np.ndarray = IDENTITY) -> None:
        """Args:
        T_base_sensor: (7,) where the body of the odometry is on the base.
        """
        self._last: tuple[int, np.ndarray, np.ndarray] | None = None
        self._T_sensor_base = inverse(T_base_sensor)

    def add(self, stamp_ns: int, message: Any) -> None:
        """Take a nav_msgs/Odometry, whose pose is T_odom_sensor."""
        pose = pose_of(message.pose.pose.position, message.pose.pose.orientation)
        twist = message.twist.twist
        v, w = twist.linear, twist.angular
        rates = np.array([v.x, v.y, v.z, w.x, w.y, w.z])
        speeds, turns = is_within("speed_mps", rates[:3]), is_within("turn_radps", rates[3:])
        if pose is not None and speeds.all() and turns.all():
            self._last = stamp_ns, pose, rates

    def at(self, now_ns: int) -> np.ndarray | None:
        """See `OdomFrame`."""
        if self._last is None:
            return None
        stamp_ns, pose, rates = self._last
        step = rates * min(max(now_ns - stamp_ns, 0), _STALE_NS) / 1e9
        return compose(compose(pose, _moved(step)), self._T_sensor_base)


@dataclass
class _Link:
    """The last transforms of a frame in its parent, by their times."""

    parent: str
    clock: SourceClock
    held: deque[tuple[int, np.ndarray]] = field(default_factory=lambda: deque(maxlen=_KEPT))

    def at(self, now_ns: int) -> np.ndarray:
        """T_parent_frame (7,): between two transforms, and carried on a little after the last."""
        held = list(self.held)  # the thread of ROS adds to it
        last_ns, last = held[-1]
        if now_ns >= last_ns:
            before_ns, before = next(
                (one for one in reversed(held) if last_ns - one[0] >= _RATE_NS), held[0]
            )
            now_ns = min(now_ns, last_ns + _STALE_NS)
        else:
            index = next((i for i, one in enumerate(held) if one[0] > now_ns), 0)
            if index == 0:
                return held[0][1]
            (before_ns, before), (last_ns, last) = held[index - 1 : index + 1]
        if last_ns <= before_ns:
            return last
        share = (now_ns - before_ns) / (last_ns - before_ns)
        return compose(before, _moved(share * _motion(before, last)))


class OdomTf:
    """The transform from odom to base on /tf, through any frames between them."""

    def __init__(self, odom: str, base: str, clock: Callable[[], SourceClock]):
        """Args:
        odom, base: names of the frames.
        clock: makes the clock of one frame's transforms.
        """
        self._odom, self._base, self._clock = odom, base, clock
        self._links: dict[str, _Link] = {}  # by the frame below

    def take(self, message: Any) -> None:
        """Take a tf2_msgs/TFMessage of /tf."""
        for one in message.transforms:
            self._add(one, is_static=False)

    def take_static(self, message: Any) -> None:
        """Take a tf2_msgs/TFMessage of /tf_static: it holds at all times."""
        for one in message.transforms:
            self._add(one, is_static=True)

    def at(self, now_ns: int) -> np.ndarray | None:
        """See `OdomFrame`."""
        frame, T = self._base, IDENTITY
        for _ in range(_LONGEST):
            link = self._links.get(frame)
            if link is None:
                return None
            T, frame = compose(link.at(now_ns), T), link.parent
            if frame == self._odom:
                return T
        return None

    def _add(self, stamped: Any, is_static: bool) -> None:
        frame, parent = stamped.child_frame_id.lstrip("/"), stamped.header.frame_id.lstrip("/")
        pose = pose_of(stamped.transform.translation, stamped.transform.rotation)
        if pose is None or frame == self._odom:  # above odom stands our own transform
            return
        link = self._links.get(frame)
        if link is None or link.parent != parent:
            link = _Link(parent, self._clock())
        stamp_ns = link.clock.time_ns(stamped.header.stamp)
        last_ns = link.held[-1][0] if link.held else None
        if last_ns is not None and (is_static or stamp_ns < last_ns - _STALE_NS):
            link.held.clear()  # sent again, or its clock was set back
        elif last_ns is not None and stamp_ns <= last_ns:
            return
        link.held.append((stamp_ns, pose))
        self._links[frame] = link  # only now, as `at` reads it in another thread


def pose_of(position: Any, orientation: Any) -> np.ndarray | None:
    """The pose (7,) in two parts of a message; None where it is none, or nowhere."""
    p, q = position, orientation
    pose = np.array([q.w, q.x, q.y, q.z, p.x, p.y, p.z])
    norm = math.hypot(*pose[:4].tolist())
    if not 0.5 < norm < 2.0 or not is_within("position_m", pose[4:]).all():
        return None
    pose[:4] /= norm
    return pose


def _motion(before: np.ndarray, after: np.ndarray) -> np.ndarray:
    """The small motion (6,) of which `_moved` makes the way from a pose to another."""
    there = compose(inverse(before), after)
    turn = Rotation.from_quat(np.roll(there[:4], -1)).as_rotvec()
    return np.concatenate([compose(inverse(_turned(turn / 2)), there)[4:], turn])


def _moved(step: np.ndarray) -> np.ndarray:
    """The pose (7,) after a small motion (6,): a turn, and a way along the turn's middle."""
    way_m, turn = step[:3].tolist(), step[3:]
    middle = _turned(turn / 2)[:4].tolist()
    return np.array([*_turned(turn)[:4], *rotated(middle, way_m)])


def _turned(turn: np.ndarray) -> np.ndarray:
    return pose_from_rotation_vector(turn.tolist(), [0.0] * 3)
