"""A process that runs before what else the computer has to do.

A nice value counts among the processes of one terminal only, where the kernel groups them by
session (sched(7), autogroups; so do most distributions): what another terminal runs gets as much
time as all of this one. So the group's value is lowered as well.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

NICE = -10
_GROUP = Path("/proc/self/autogroup")  # "/autogroup-42 nice 0"


@contextmanager
def before_others() -> Iterator[None]:
    """Meanwhile this process comes first, as far as it may. Then its terminal is as it was; after
    a kill -9 its other programs go on before others.

    Threads have the priority of the one that began them: those of XLA begin with the first array.
    """
    with suppress(OSError):
        os.setpriority(os.PRIO_PROCESS, 0, NICE)
    before = _group_nice()
    if before is None or before <= NICE:
        yield
        return
    _set_group_nice(NICE)
    try:
        yield
    finally:
        _set_group_nice(before)


def _group_nice() -> int | None:
    """None where the kernel has no such groups."""
    try:
        return int(_GROUP.read_text().rpartition(" ")[2])
    except (OSError, ValueError):
        return None


def _set_group_nice(nice: int) -> None:
    with suppress(OSError):  # PermissionError: it may not be raised here
        _GROUP.write_text(str(nice))
