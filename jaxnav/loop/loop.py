"""The loop on the vehicle: the sensors tell the pilot, the pilot tells the guard.

    loop = Loop(pilot, guard, vehicle, eyes)
    loop.run()

One thread: it reads the odometer at a steady rate, takes what the cameras' threads have seen, and
writes a command after each. Nothing here waits for a disk or a screen.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import jax
import numpy as np

from jaxnav.loop.expect import Expected, expected
from jaxnav.loop.flags import Fault
from jaxnav.loop.frames import Sighted
from jaxnav.loop.guard import Guard
from jaxnav.loop.interfaces import Ending, Frame, Vehicle
from jaxnav.loop.pilot import Input, Outcome, Pilot
from jaxnav.loop.priority import before_siblings
from jaxnav.loop.seeing import Eyes, Region, groups

_THREAD = "the loop"
_STAYS_S = 0.5  # at the last waypoint, before the drive is over
# Hypotheses are searched for where the reported one is: regions are not narrower than this.
_MIN_COVARIANCE = np.diag([0.01**2, 0.01**2, np.deg2rad(0.5) ** 2])


class Observer(Protocol):
    """Who looks on: a recorder, a view, a status line. Neither waits nor raises."""

    def handled(self, given: Input, outcome: Outcome) -> None:
        """The pilot has made something of an input."""
        ...

    def seen(self, name: str, frame: Frame, sighted: Sighted) -> None:
        """A camera's frame was looked at."""
        ...

    @property
    def faults(self) -> Fault:
        """What it can't do any more."""
        ...


@dataclass
class Statistics:
    """How long things took, ms: histograms with logarithmic bins, so that nothing grows."""

    edges_ms: np.ndarray = field(default_factory=lambda: np.geomspace(0.01, 10_000, 241))
    counts: dict[str, np.ndarray] = field(default_factory=dict)
    deadlines_missed: int = 0
    handled: int = 0

    def add(self, name: str, duration_ms: float) -> None:
        """Count one."""
        if name not in self.counts:
            self.counts[name] = np.zeros(len(self.edges_ms) + 1, np.int64)
        self.counts[name][int(np.searchsorted(self.edges_ms, duration_ms))] += 1

    def quantile_ms(self, name: str, share: float) -> float:
        """Below which so large a share lies, to 6 %; NaN where nothing was counted."""
        counts = self.counts.get(name)
        if counts is None or not counts.sum():
            return float("nan")
        index = int(np.searchsorted(np.cumsum(counts), share * counts.sum()))
        return float(self.edges_ms[min(index, len(self.edges_ms) - 1)])


class Loop:
    """One drive.

    Attributes:
        stopped: whether it was the guard that ended it.
    """

    def __init__(
        self,
        pilot: Pilot,
        guard: Guard,
        vehicle: Vehicle,
        eyes: Eyes,
        observers: Sequence[Observer] = (),
        period_s: float = 0.02,
        now_ns: Callable[[], int] = time.monotonic_ns,
    ):
        """Args:
        pilot: warmed up.
        guard: of the vehicle; armed when the loop runs.
        eyes: not started yet.
        period_s: between two readings of the odometer.
        """
        self.pilot, self.guard, self.statistics = pilot, guard, Statistics()
        self.stopped = False
        self._vehicle, self._eyes, self._observers = vehicle, eyes, list(observers)
        self._period_ns = int(period_s * 1e9)
        self._now_ns = now_ns
        self._outcome: Outcome | None = None
        self._odometry_ns: int | None = None
        self._blank: tuple[Sighted, ...] = ()  # frames that show nothing and wait for the next tick
        self._belief: tuple[np.ndarray, np.ndarray] | None = None
        self._expectation: tuple[tuple[np.ndarray, np.ndarray], Expected] | None = None  # of it
        dtype = np.asarray(pilot.navigator.corner_sigma_px).dtype
        self._min_covariance = _MIN_COVARIANCE.astype(dtype)
        # Compiled now: whoever looks for markers is watched.
        self._expected(np.array([1, 0, 0, 0, 0, 0, 0], dtype), self._min_covariance)

    def run(self, duration_s: float = float("inf")) -> str:
        """Drive until the last waypoint, the guard's word, or the end of the time or the vehicle.

        Returns:
            Why it ended: "arrived", "time is over", what an `Ending` vehicle or the guard says.
        """
        self._eyes.expected = self._region
        self._eyes.start()
        with before_siblings():  # a late image is one image less, a late command ends the drive
            return self._driven(duration_s)

    def _driven(self, duration_s: float) -> str:
        ending = self._vehicle if isinstance(self._vehicle, Ending) else None
        begin_ns = self._now_ns()
        due_ns = begin_ns
        arrived_ns: int | None = None
        self.guard.arm()
        self.guard.beat(_THREAD)
        while not self.guard.tripped:
            now_ns = self._now_ns()
            if now_ns >= due_ns:
                late = now_ns - due_ns > self._period_ns
                self._tick(Fault.DEADLINE_MISSED if late else Fault(0))
                self.statistics.deadlines_missed += late
                due_ns = max(due_ns + self._period_ns, now_ns)
            for group in self._sighted():
                self._handle(Input(self._now_ns(), frames=group, faults=self._failures()))
            self.guard.beat(_THREAD)
            if (now_ns - begin_ns) / 1e9 > duration_s:
                return "time is over"
            if ending is not None and (why := ending.over) is not None:
                return why
            if self._outcome is not None and self._outcome.output.done:
                arrived_ns = arrived_ns or now_ns
                if now_ns - arrived_ns > _STAYS_S * 1e9:
                    return "arrived"
            self._eyes.wait((due_ns - self._now_ns()) / 1e9)
        self.stopped = True
        return self.guard.reason or "stopped"

    def _tick(self, faults: Fault) -> None:
        frames, self._blank = self._blank, ()
        faults |= self._failures()
        reading = None
        try:
            reading = self._vehicle.read()
        except OSError:
            faults |= Fault.VEHICLE_FAILED
        if reading is not None and reading.stamp_ns == self._odometry_ns:
            reading = None  # nothing new yet
        if reading is not None:
            self._odometry_ns = reading.stamp_ns
        self._handle(Input(self._now_ns(), reading, frames, faults))

    def _sighted(self) -> list[tuple[Sighted, ...]]:
        """What shows markers; the rest waits for the next tick."""
        seen = self._eyes.take()
        for one in seen:
            for observer in self._observers:
                observer.seen(one.camera_name, one.frame, one.sighted)
        shows, blank = groups(seen)
        self._blank += blank
        return shows

    def _handle(self, given: Input) -> None:
        begin_s = time.perf_counter()
        outcome = self.pilot.handle(given)
        taken = self.guard.write(outcome.steering_rad, outcome.throttle)
        end_s = time.perf_counter()
        kind = "odometry" if given.odometry else "frames" if given.frames else "tick"
        self.statistics.add(f"handle {kind}", (end_s - begin_s) * 1e3)
        self.statistics.handled += 1
        if kind == "frames" and taken:
            self.statistics.add(
                "frame to command", (self._now_ns() - given.frames[0].stamp_ns) / 1e6
            )
        self._outcome = outcome
        output = outcome.output
        # In one go: who looks for markers reads it at any time.
        self._belief = (
            (
                np.asarray(output.T_world_vehicle.wxyz_xyz),
                np.asarray(output.pose_covariance + self._min_covariance),
            )
            if output.decided
            else None
        )
        for observer in self._observers:
            observer.handled(given, outcome)

    def _failures(self) -> Fault:
        faults = Fault(0)
        for observer in self._observers:
            faults |= observer.faults
        return faults

    def _region(self, camera: int) -> Region | None:
        """Where a camera should see markers. Called by the threads that look for them."""
        belief = self._belief
        if belief is None:
            return None
        known = self._expectation
        if known is None or known[0] is not belief:  # the same for all cameras of a set
            known = self._expectation = belief, self._expected(*belief)
        quads_px, visible, radius_px = (np.asarray(part)[camera] for part in known[1])
        return Region(quads_px[visible], radius_px[visible])

    def _expected(self, wxyz_xyz: np.ndarray, covariance: np.ndarray) -> Expected:
        navigator = self.pilot.navigator
        found = expected(navigator.rig, navigator.markers, wxyz_xyz, covariance)
        return Expected(*jax.device_get(found))
