"""A process that runs before what else the computer has to do, and a thread before its siblings.

A nice value counts among the processes of one terminal only, where the kernel groups them so
(sched(7), autogroups): what another terminal runs gets as much time as all of this one. So the
group's value is lowered as well.
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
    """Meanwhile this process comes first, as far as it may. Then its terminal is as it was; after
    a kill -9 its other programs go on before others.

    Threads have the priority of the one that began them: those of XLA begin with the first array.
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
    """Meanwhile the calling thread comes before the others of its process that run already."""
    if sys.platform != "linux":  # a nice value is the process's, and its siblings have it as well
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
    """Give the calling thread a nice value, if that may be."""
    with suppress(OSError):  # PermissionError: it may not be raised here
        os.setpriority(os.PRIO_PROCESS, 0, nice)
        return True
    return False


def _group_nice() -> int | None:
    """None where the kernel has no such groups."""
    try:
        return int(_GROUP.read_text().rpartition(" ")[2])
    except (OSError, ValueError):
        return None


def _set_group_nice(nice: int) -> None:
    with suppress(OSError):
        _GROUP.write_text(str(nice))
