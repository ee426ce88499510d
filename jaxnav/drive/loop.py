"""The loop on the vehicle: it feeds sensor data to the pilot and commands to the guard.

    loop = Loop(pilot, guard, vehicle, eyes)
    loop.run()

One thread reads the odometer at a steady rate, takes the sightings of the cameras' threads, and
writes a command after each. Nothing here waits for a disk or a screen. While the clock stands, as
that of a paused simulation does, the command is no speed.
"""

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from jaxtyping import Float, Int

from jaxnav.drive.expect import Expectation
from jaxnav.drive.flags import Fault, Health
from jaxnav.drive.frames import FrameDetections
from jaxnav.drive.guard import Guard
from jaxnav.drive.interfaces import (
    MOST_TURNS,
    AnyVehicle,
    Ending,
    Frame,
    GyroReading,
    HasGyro,
    Reading,
)
from jaxnav.drive.pilot import Input, Outcome, Pilot
from jaxnav.drive.priority import before_siblings
from jaxnav.drive.seeing import Eyes, group_frames
from jaxnav.drive.standing_clock import StandingClock
from jaxnav.errors import Containment

_THREAD = "the loop"
_STAYS_S = 0.5  # the drive ends this long after the last waypoint is reached
_WELL_S = 2.0  # of health OK without a break, before a vehicle that the guard holds drives on


class Observer(Protocol):
    """An observer of the loop: a recorder, a view, a status line. It does not wait. What it raises
    is contained, see `Fenced`."""

    def on_outcome(self, given: Input, outcome: Outcome) -> None:
        """Take an input that the pilot has handled, and its outcome."""
        ...

    def on_frame(self, name: str, frame: Frame, sighted: FrameDetections) -> None:
        """Take a camera's frame after the search for markers, and the markers found."""
        ...

    @property
    def faults(self) -> Fault:
        """The faults of the observer."""
        ...


class Fenced:
    """An observer whose exceptions reach nobody: they are said, counted, and a fault. Implements
    `Observer`."""

    def __init__(self, observer: Observer, contained: Containment):
        def fence(name: str, function: Callable[..., Any]) -> Callable[..., Any]:
            return contained.wrap(f"{type(observer).__name__}.{name}", function, self._failed)

        self.on_outcome = fence("on_outcome", observer.on_outcome)
        self.on_frame = fence("on_frame", observer.on_frame)
        self._faults = fence("faults", lambda: observer.faults)
        self._raised = Fault(0)

    @property
    def faults(self) -> Fault:
        """Those of the observer, and whether it has raised since the last call."""
        faults = self._faults() | self._raised
        self._raised = Fault(0)
        return faults

    def _failed(self, problem: str, *arguments: Any) -> Fault:
        self._raised = Fault.RECORDER_FAILED
        return self._raised


@dataclass
class Statistics:
    """Histograms of durations, ms, in logarithmic bins: their memory does not grow."""

    edges_ms: Float[np.ndarray, " edges"] = field(
        default_factory=lambda: np.geomspace(0.01, 10_000, 241)
    )
    counts: dict[str, Int[np.ndarray, " bins"]] = field(default_factory=dict)
    deadlines_missed: int = 0

    def add(self, name: str, duration_ms: float) -> None:
        """Count one duration."""
        if name not in self.counts:
            self.counts[name] = np.zeros(len(self.edges_ms) + 1, np.int64)
        self.counts[name][int(np.searchsorted(self.edges_ms, duration_ms))] += 1

    def quantile_ms(self, name: str, share: float) -> float:
        """The duration below which this share of them lies, to 6 %; NaN if none was counted."""
        counts = self.counts.get(name)
        if counts is None or not counts.sum():
            return float("nan")
        index = int(np.searchsorted(np.cumsum(counts), share * counts.sum()))
        return float(self.edges_ms[min(index, len(self.edges_ms) - 1)])


class Loop:
    """The loop of one drive.

    Attributes:
        stopped: whether the guard ended the drive.
        late: whether it did because something did not come in time.
        contained: what observers have raised.
    """

    def __init__(
        self,
        pilot: Pilot,
        guard: Guard,
        vehicle: AnyVehicle,
        eyes: Eyes,
        observers: Sequence[Observer] = (),
        period_s: float = 0.02,
        now_ns: Callable[[], int] = time.monotonic_ns,
        say: Callable[[str], object] = lambda text: None,
    ):
        """Args:
        pilot: must be warmed up.
        guard: of the vehicle; `run` arms it.
        eyes: not started yet.
        period_s: time between two readings of the odometer.
        say: takes a line for a person where the guard holds the vehicle, and lets it go.
        """
        self.pilot, self.guard, self.statistics = pilot, guard, Statistics()
        self.stopped = self.late = False
        self.contained = Containment()
        self._say, self._held = say, False
        self._well_ns: int | None = None  # since when all is well, of a vehicle that is held
        self._vehicle, self._eyes = vehicle, eyes
        self._observers = [Fenced(observer, self.contained) for observer in observers]
        self._period_ns = int(period_s * 1e9)
        self._now_ns, self._clock = now_ns, StandingClock()
        self._outcome: Outcome | None = None
        self._odometry_ns: int | None = None
        self._due_ns = 0  # when the odometer is read next
        # Frames without markers, kept for the next tick.
        self._blank: tuple[FrameDetections, ...] = ()
        self._expectation = Expectation(pilot.navigator)

    def run(self, duration_s: float = float("inf"), until_arrival: bool = True) -> str:
        """Drive until the last waypoint, a trip of the guard, the time limit or the vehicle's end.

        Args:
            until_arrival: whether the last waypoint ends it.

        Returns:
            Why it ended: "arrived", "time is over", or the reason of an `Ending` vehicle or guard.
        """
        self._eyes.expected = self._expectation.region
        self._eyes.start()
        with before_siblings():  # a late image costs one image, a late command ends the drive
            return self._driven(duration_s, until_arrival)

    def _driven(self, duration_s: float, until_arrival: bool) -> str:
        ending = self._vehicle if isinstance(self._vehicle, Ending) else None
        begin_ns = self._due_ns = self._now_ns()
        arrived_ns: int | None = None
        self.guard.arm()
        self.guard.beat(_THREAD)
        while not self.guard.tripped or self._waits():
            now_ns = self._now_ns()
            if self._clock.stands(now_ns):
                self._hold()
            self._tick_if_due()
            for group in self._sighted():
                self._handle(Input(self._now_ns(), frames=group, faults=self._failures()))
                self._tick_if_due()  # frames that have waited must not keep the odometer waiting
            self.guard.beat(_THREAD)
            if (now_ns - begin_ns) / 1e9 > duration_s:
                if self.guard.tripped:
                    break
                return "time is over"
            if ending is not None and (why := ending.over) is not None:
                return why
            if until_arrival and self._outcome is not None and self._outcome.output.done:
                arrived_ns = arrived_ns or now_ns
                if now_ns - arrived_ns > _STAYS_S * 1e9:
                    return "arrived"
            self._eyes.wait((self._due_ns - self._now_ns()) / 1e9)
        self.stopped, self.late = True, self.guard.late
        return self.guard.reason or "stopped"

    def _waits(self) -> bool:
        """Whether the guard, which has tripped, may let the vehicle drive on; let it where all has
        been well for a while."""
        if not self.guard.pauses:
            return False
        now_ns, outcome = self._now_ns(), self._outcome
        if not self._held:
            self._held, self._well_ns = True, None
            self._say(f"held: {self.guard.reason}")
        if outcome is None or outcome.health is not Health.OK:
            self._well_ns = None
        elif self._well_ns is None:
            self._well_ns = now_ns
        elif (now_ns - self._well_ns) / 1e9 > _WELL_S and self.guard.resume():
            self._held = False
            self._say(f"drives on: all was well for {_WELL_S:g} s")
        return True

    def _hold(self) -> None:
        """Command no speed while the clock stands: no input comes, and the guard waits for none."""
        limits, outcome = self.pilot.limits, self._outcome
        self.guard.write(*limits.standing(limits.zero if outcome is None else outcome.command))

    def _tick_if_due(self) -> None:
        now_ns = self._now_ns()
        if now_ns < self._due_ns:
            return
        late = now_ns - self._due_ns > self._period_ns
        self._tick(Fault.DEADLINE_MISSED if late else Fault(0))
        self.statistics.deadlines_missed += late
        self._due_ns = max(self._due_ns + self._period_ns, now_ns)

    def _tick(self, faults: Fault) -> None:
        frames, self._blank = self._blank, ()
        faults |= self._failures()
        reading: Reading | None = None
        try:
            reading = self._vehicle.read()
        except OSError:
            faults |= Fault.VEHICLE_FAILED
        if reading is not None and reading.stamp_ns == self._odometry_ns:
            reading = None  # nothing new yet
        if reading is not None:
            self._odometry_ns = reading.stamp_ns
        self._handle(Input(self._now_ns(), reading, frames, faults, self._gyro()))

    def _gyro(self) -> tuple[GyroReading, ...]:
        """What the vehicle's gyro has told since the tick before; nothing without one."""
        with suppress(OSError):
            if isinstance(self._vehicle, HasGyro):
                return tuple(self._vehicle.read_gyro()[-MOST_TURNS:])
        return ()

    def _sighted(self) -> list[tuple[FrameDetections, ...]]:
        """The frames that show markers, in groups; the other frames wait for the next tick."""
        seen = self._eyes.take()
        for one in seen:
            for observer in self._observers:
                observer.on_frame(one.camera_name, one.frame, one.sighted)
        shows, blank = group_frames(seen)
        self._blank += blank
        return shows

    def _handle(self, given: Input) -> None:
        begin_s = time.perf_counter()
        outcome = self.pilot.handle(given)
        command = outcome.command
        if self._clock.stands(given.now_ns):
            command = self.pilot.limits.standing(command)
        success = self.guard.write(*command)
        end_s = time.perf_counter()
        kind = "odometry" if given.odometry else "frames" if given.frames else "tick"
        self.statistics.add(f"handle {kind}", (end_s - begin_s) * 1e3)
        if kind == "frames" and success:
            age_ms = (self._now_ns() - given.frames[0].stamp_ns) / 1e6
            self.statistics.add("frame to command", age_ms)
        self._outcome = outcome
        self._expectation.update(outcome.output, outcome.belief.bank, outcome.now_ns)
        for observer in self._observers:
            observer.on_outcome(given, outcome)

    def _failures(self) -> Fault:
        faults = Fault.HELD if self.guard.pauses else Fault(0)
        for observer in self._observers:
            faults |= observer.faults
        return faults
