"""Rows of the fault matrix where something stands still while others move, or rates matter."""

import dataclasses
import itertools
from collections.abc import Callable

import numpy as np

from jaxnav.loop.flags import Fault, Health
from jaxnav.loop.interfaces import Odometry
from jaxnav.testing import injections as inject
from jaxnav.testing.faults import ALL_CAMERAS, BEGIN_S, END_S, FaultRow, Happens, lasting
from jaxnav.testing.lockstep import BEGIN_NS, Change, Rates
from jaxnav.vehicles.world import SimWorld

_LATEST = np.inf  # to the end of the drive
_SLOW = Health.DEGRADED
# Largest difference of a corner between a search near its expected place and one everywhere.
_JITTER_PX = 0.01


def standstill() -> list[FaultRow]:
    """Rows in which something stands still while others move."""

    def still(cameras: range) -> Callable[[], Change]:
        return lambda: inject.frames(inject.frozen(cameras, _JITTER_PX))

    def stopped(reading: Odometry) -> Odometry:
        return dataclasses.replace(reading, speed_mps=0.0)

    def all_of_it() -> Change:
        return inject.both(still(ALL_CAMERAS)(), inject.odometry(inject.repeated()))

    def held() -> Happens:
        def happens(now_ns: int, world: SimWorld) -> None:
            world.hold(now_ns >= BEGIN_NS + int(BEGIN_S * 1e9))

        return happens

    return [
        FaultRow(
            "frozen images, found anew",
            lasting(still(ALL_CAMERAS)),
            faults=Fault.FRAME_FROZEN,
            at_most=_SLOW,
            error_m=0.15,
        ),
        FaultRow(
            "one camera frozen, found anew",
            lasting(still(range(1))),
            faults=Fault.FRAME_FROZEN,
            at_most=_SLOW,
            error_m=0.15,
        ),
        FaultRow(
            "frozen images for 9 s",
            lasting(still(ALL_CAMERAS), BEGIN_S + 9.0),
            faults=Fault.FRAME_FROZEN,
            at_least=Health.STOP,
            at_most=Health.STOP,
            error_m=0.35,
            ends_s=BEGIN_S + 9.0,
            drive_s=BEGIN_S + 12.0,
        ),
        FaultRow(
            "odometry stuck at 0",
            lasting(lambda: inject.odometry(stopped)),
            faults=Fault.ODOMETRY_STUCK,
            at_least=_SLOW,
            at_most=_SLOW,
            error_m=0.10,
        ),
        FaultRow(
            "odometry at 0 from the start",
            lambda: inject.between(0.0, END_S, inject.odometry(stopped)),
            faults=Fault.ODOMETRY_STUCK,
            at_least=_SLOW,
            at_most=_SLOW,
            error_m=0.20,
            begins_s=0.0,
        ),
        FaultRow(
            "odometry stuck, steering not",
            lasting(lambda: inject.odometry(inject.speed(inject.constant())), BEGIN_S + 4.0),
            faults=Fault.ODOMETRY_STUCK,
            at_most=_SLOW,
            error_m=0.10,
            ends_s=BEGIN_S + 4.0,
            drive_s=BEGIN_S + 7.0,
        ),
        FaultRow(
            "cameras and odometry frozen",
            lasting(all_of_it, BEGIN_S + 4.0),
            faults=Fault.NOTHING_MOVES | Fault.ODOMETRY_STALE,
            at_least=Health.STOP,
            at_most=Health.STOP,
            error_m=0.8,
            ends_s=BEGIN_S + 4.0,
            # The car has gone farther than the frozen odometer explains: RELOCATED, and slow.
            well=Health.DEGRADED,
            drive_s=BEGIN_S + 7.0,
        ),
        FaultRow(
            "the car is held fast",
            happens=held,
            faults=Fault.NOTHING_MOVES,
            at_least=Health.STOP,
            at_most=Health.STOP,
            error_m=0.15,
            ends_s=_LATEST,
        ),
    ]


def rates() -> list[FaultRow]:
    """Rows that depend on the rates of sensors or of restarts."""

    def to_and_fro() -> Happens:
        turn_ns = iter(itertools.count(BEGIN_NS + int(BEGIN_S * 1e9), 700_000_000))
        due_ns, side = next(turn_ns), itertools.cycle((1.0, -1.0))

        def happens(now_ns: int, world: SimWorld) -> None:
            nonlocal due_ns
            if due_ns <= now_ns < BEGIN_NS + int((BEGIN_S + 7.0) * 1e9):
                due_ns = next(turn_ns)
                world.move_markers((next(side), 0.0, 0.0))

        return happens

    return [
        FaultRow(
            "frames 150 ms late, odometry at 500 Hz",
            rates=Rates(odometry_period_s=0.002, frame_delay_s=0.15),
            begins_s=2.0,
            ends_s=_LATEST,
            drive_s=4.0,
        ),
        FaultRow(
            "a marker to and fro for 7 s",
            happens=to_and_fro,
            faults=Fault.RESTARTED_OFTEN,
            at_least=Health.STOP,
            at_most=Health.STOP,
            error_m=1.5,
            ends_s=_LATEST,
            drive_s=BEGIN_S + 7.0,
        ),
    ]
