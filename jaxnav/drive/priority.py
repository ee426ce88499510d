"""Raise the priority of a process above others, and of a thread above its siblings.

Where the kernel groups processes by terminal (sched(7), autogroups), a nice value counts only
within one group: another terminal gets as much time as all of this one. So the group's value is
lowered as well.
"""

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

NICE, FIRST_NICE = -10, -20
_GROUP = Path("/proc/self/autogroup")  # "/autogroup-42 nice 0"


@contextmanager
def before_others() -> Iterator[None]:
    """Raise this process's priority inside the block, where permitted, then restore its terminal's;
    after a kill -9 the terminal's other programs keep the raised priority.

    A thread inherits the priority of its creator: XLA's threads start with the first array.
    """
    lower_nice(NICE)
    before = _group_nice()
    if before is None or before <= NICE:
        yield
        return
    _set_group_nice(NICE)
    try:
        yield
    finally:
        _set_group_nice(before)


@contextmanager
def before_siblings() -> Iterator[None]:
    """Raise the calling thread's priority above the process's running threads inside the block."""
    if sys.platform != "linux":  # a nice value is that of the whole process, siblings included
        yield
        return
    before = os.getpriority(os.PRIO_PROCESS, 0)
    if before <= FIRST_NICE or not lower_nice(FIRST_NICE):
        yield
        return
    try:
        yield
    finally:
        os.setpriority(os.PRIO_PROCESS, 0, before)


def lower_nice(nice: int) -> bool:
    """Set the nice value of the calling thread; return whether that was permitted."""
    with suppress(OSError):  # PermissionError: it may not be raised here
        os.setpriority(os.PRIO_PROCESS, 0, nice)
        return True
    return False


def _group_nice() -> int | None:
    """The nice value of the group; None where the kernel has no such groups."""
    try:
        return int(_GROUP.read_text().rpartition(" ")[2])
    except (OSError, ValueError):
        return None


def _set_group_nice(nice: int) -> None:
    with suppress(OSError):
        _GROUP.write_text(str(nice))
