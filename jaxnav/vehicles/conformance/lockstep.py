"""Drive the simulated vehicle event by event, without threads, as fast as the machine can.

Data may be changed on their way to the pilot: that is how faults are tried.
"""

import dataclasses
import heapq
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from jaxnav.drive.camera_delays import CameraDelays
from jaxnav.drive.flags import Fault
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.pilot import Input, Outcome, Pilot
from jaxnav.vehicles.world import SimWorld

BEGIN_NS = 1_000_000_000


@dataclass(frozen=True)
class Rates:
    """The periods and delays of the sensors."""

    odometry_period_s: float = 0.02
    frame_period_s: float = 1 / 30
    frame_delay_s: float = 0.03  # from the exposure until its corners are known
    camera_skew_s: float = 0.0  # delay of each camera after the one before


@dataclass(frozen=True)
class Step:
    """One event, the pilot's outcome, and the truth as `SimWorld.state` has it."""

    input: Input
    outcome: Outcome
    truth: Float[np.ndarray, " n"]


# An input -> the inputs that reach the pilot instead, each at its own time, not before.
Change = Callable[[Input], list[Input]]


def drive(
    pilot: Pilot,
    world: SimWorld,
    duration_s: float,
    change: Change = lambda given: [given],
    rates: Rates | None = None,
    happens: Callable[[int, SimWorld], None] = lambda now_ns, world: None,
    delays: CameraDelays | None = None,
) -> Iterator[Step]:
    """Drive event by event until the time is over.

    Args:
        change: changes an input on its way.
        delays: estimates the cameras' delays; None: not estimated.
        happens: changes the world; called with the time before each input is made.
    """
    pilot.warm_up()  # as before every drive
    rates = rates or Rates()
    end_ns = BEGIN_NS + int(duration_s * 1e9)
    waiting: list[tuple[int, int, Input]] = []
    count = 0
    sources = _inputs(world, rates, end_ns, happens)
    upcoming = next(sources, None)
    while upcoming is not None or waiting:
        if upcoming is not None and (not waiting or upcoming[0] <= waiting[0][0]):
            for given in change(upcoming[1]()):
                heapq.heappush(waiting, (given.now_ns, count, given))
                count += 1
            upcoming = next(sources, None)
            continue
        given = heapq.heappop(waiting)[2]
        if delays is not None and delays.late:
            given = dataclasses.replace(given, faults=given.faults | Fault.CAMERA_LATE)
        outcome = pilot.handle(given)
        if delays is not None:
            delays.add_outcome(outcome)
            while delays.due:
                delays.solve()
        world.write(*outcome.command, given.now_ns)
        yield Step(given, outcome, world.state(given.now_ns))


def _inputs(
    world: SimWorld, rates: Rates, end_ns: int, happens: Callable[[int, SimWorld], None]
) -> Iterator[tuple[int, Callable[[], Input]]]:
    """Yield the time of each input and the function that makes it, in order of time."""
    odometry_ns = int(rates.odometry_period_s * 1e9)
    frame_ns, delay_ns = int(rates.frame_period_s * 1e9), int(rates.frame_delay_s * 1e9)
    cameras = len(world.rig)
    skewed = rates.camera_skew_s > 0
    groups = [(c,) for c in range(cameras)] if skewed else [tuple(range(cameras))]
    due = [(BEGIN_NS, -1)] + [
        (BEGIN_NS + delay_ns + int(number * rates.camera_skew_s * 1e9), number)
        for number in range(len(groups))
    ]
    heapq.heapify(due)
    while due[0][0] < end_ns:
        now_ns, number = heapq.heappop(due)
        heapq.heappush(due, (now_ns + (odometry_ns if number < 0 else frame_ns), number))

        def made(now_ns: int = now_ns, number: int = number) -> Input:
            happens(now_ns, world)
            if number < 0:
                return Input(now_ns, world.reading(now_ns), gyro=world.gyro(now_ns))
            stamp_ns = now_ns - delay_ns
            detections = world.detections(stamp_ns)
            return Input(
                now_ns,
                frames=tuple(FrameDetections(c, stamp_ns, detections[c]) for c in groups[number]),
            )

        yield now_ns, made
