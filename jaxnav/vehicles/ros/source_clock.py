"""Convert the stamps of one topic to the clock of the program.

Once a source has given stamps of this computer's clock they are used as they are: those that repeat
or jump are left for the pilot to refuse. For stamps of another computer's clock, and missing ones,
the time is that of arrival.
"""

import time
from collections.abc import Callable

from jaxnav.recordings.ros import time_ns

_OLDEST_NS = 1_000_000_000  # a message that claims to be older was stamped by another clock
_BELIEVED_AFTER = 10  # messages in a row with stamps of this clock, after others
_STEP_NS = 2_000_000  # ROS's clock was set anew, or has drifted off the monotonic one


class SteadyOffset:
    """ROS's clock against the monotonic one, the same from call to call: so equal stamps are equal
    times."""

    def __init__(self, ros_ns: Callable[[], int]):
        self._ros_ns = ros_ns
        self._offset_ns: int | None = None

    def ns(self) -> int:
        """Monotonic time less ROS's, ns."""
        offset_ns = time.monotonic_ns() - self._ros_ns()
        if self._offset_ns is None or abs(offset_ns - self._offset_ns) > _STEP_NS:
            self._offset_ns = offset_ns
        return self._offset_ns


class SourceClock:
    """The clock of one source of messages. For one thread at a time."""

    def __init__(self, offset: SteadyOffset | None):
        """Args:
        offset: None: the program's times are ROS's, as they are stamped.
        """
        self._offset = offset
        self._believed: bool | None = None  # None: before the first message
        self._in_a_row = 0
        self._last: tuple[int, int] = (0, 0)  # stamp, and the time that it was taken for

    def time_ns(self, stamp: object) -> int:
        """The time of a message with this ROS stamp."""
        stamped_ns = time_ns(stamp)
        if self._offset is None:
            return stamped_ns
        now_ns = time.monotonic_ns()
        ours_ns = stamped_ns + self._offset.ns()
        is_ours = -_STEP_NS <= now_ns - ours_ns <= _OLDEST_NS
        self._in_a_row = self._in_a_row + 1 if is_ours else 0
        if not self._believed:
            first = self._believed is None
            self._believed = self._in_a_row >= (1 if first else _BELIEVED_AFTER)
        if self._believed:
            return ours_ns
        if not stamped_ns or stamped_ns != self._last[0]:
            self._last = stamped_ns, now_ns
        return self._last[1]
