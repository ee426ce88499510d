"""From events to commands: the deterministic half of the loop, without a clock, a thread or a file.

    pilot = Pilot(navigator)
    outcome = pilot.handle(Input(now_ns, odometry=reading))
    outcome = pilot.handle(Input(now_ns, frames=sighted))

The same events give the same outcomes: what is recorded can be replayed bit for bit (RELIABILITY
R11). Every event is one call of one compiled program.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxnav.navigator import Navigator
from jaxnav.origin import ZERO, Origin, planar_in_world, poses_in_world
from jaxnav.runtime.corrections import Corrections
from jaxnav.runtime.estimator import Estimator, Program
from jaxnav.runtime.flags import Fault, Health, Reject
from jaxnav.runtime.frames import Frames, Sighted
from jaxnav.runtime.health import SPEED_FACTOR, Monitor, Senses, Timeouts
from jaxnav.runtime.history import Told
from jaxnav.runtime.interfaces import Odometry
from jaxnav.runtime.limits import Limits
from jaxnav.runtime.odometer import Odometer
from jaxnav.runtime.stamps import Stamps
from jaxnav.timeline import Moment, Report

SLEPT_NS = 1_000_000_000  # a loop that was away for so long believes what is of another time
_SEEING_NS = 500_000_000  # for so long after a marker the estimate's speed is worth the odometer's
_NO_FAULT, _NO_REJECT = Fault(0), Reject(0)


@dataclass(frozen=True)
class Input:
    """What reaches the pilot at one instant: odometry, frames, both, or neither (a tick).

    Attributes:
        frames: of different cameras. Those that show markers were captured together.
        faults: found by whoever brings it.
    """

    now_ns: int
    odometry: Odometry | None = None
    frames: tuple[Sighted, ...] = ()
    faults: Fault = _NO_FAULT


@dataclass(frozen=True)
class Outcome:
    """What the pilot makes of an event. Its report and moment count from `origin_m`."""

    now_ns: int
    health: Health
    faults: Fault
    rejects: Reject
    steering_rad: float
    throttle: float
    report: Report  # NumPy's leaves, as of `moment`
    moment: Moment
    told: Told | None  # what was fused, and when it was true
    stamp_ns: int
    restarts: int  # so far, and why the last one
    restart_reason: str
    origin_m: Origin = ZERO  # see `MarkerMap`

    @property
    def pose(self) -> np.ndarray:
        """x_m, y_m, psi_rad in the world."""
        return np.asarray(planar_in_world(self.report.output.pose, self.origin_m))

    @property
    def T_world_vehicle(self) -> np.ndarray:
        """(7,) wxyz_xyz."""
        wxyz_xyz = self.report.output.T_world_vehicle.wxyz_xyz
        return np.asarray(poses_in_world(wxyz_xyz, self.origin_m))


class _Known(NamedTuple):
    """What the pilot looks at in a report: an attribute of an equinox module takes a us."""

    pose: np.ndarray  # x_m, y_m, psi_rad
    covariance: np.ndarray
    located: bool
    decided: bool
    selected: int
    nis: float
    steering_rad: float
    throttle: float
    mean: np.ndarray

    @staticmethod
    def of(report: Report) -> "_Known":
        output = report.output
        assert output.command is not None
        return _Known(
            np.asarray(output.pose),
            np.asarray(output.covariance),
            bool(output.located),
            bool(output.decided),
            int(output.selected),
            float(output.nis),
            float(output.command.steering_rad),
            float(output.command.throttle),
            np.asarray(report.mean),
        )

    def sigma(self, *states: int) -> float:
        """Of several states together."""
        return math.sqrt(max(sum(float(self.covariance[state, state]) for state in states), 0.0))


class Pilot:
    """One drive. Not for several threads."""

    def __init__(
        self,
        navigator: Navigator,
        timeouts: Timeouts | None = None,
        program: Program | None = None,
        corner_sigma_px: float | None = None,
    ):
        """Args:
        navigator: with a vehicle and waypoints.
        timeouts: see there.
        program: `advance_packed` of the navigator, compiled; by default by `jax.jit`.
        corner_sigma_px: of every corner along one axis; by default as each detection says.
        """
        if navigator.controller is None:
            raise ValueError("a pilot's navigator needs a vehicle and waypoints")
        self.navigator = navigator
        self._origin_m = navigator.markers.origin_m
        self.limits = Limits.of(navigator.controller.vehicle)
        self._corrections = Corrections.of(navigator.controller.vehicle)
        self._estimator = Estimator(navigator, program)
        self._gate_nis = float(getattr(navigator.motion, "gate_nis", math.inf))
        self._frames = Frames(len(navigator.rig), navigator.markers, corner_sigma_px)
        self._monitor = Monitor(timeouts or Timeouts())
        self._odometry_stamps = Stamps()
        self._odometer = Odometer.of(navigator.controller.vehicle)
        self._odometer_ns: int | None = None
        self._fix_ns: int | None = None
        self._distance_m = 0.0
        self._now_ns: int | None = None
        self._began_ns: int | None = None
        self._known: _Known | None = None
        self._restarts = self._restarts_before = 0
        self._restart_reason = ""
        self._left: _Known | None = None  # what was believed before a restart
        self._command = (0.0, 0.0)
        self._commanded_ns: int | None = None

    def warm_up(self) -> None:
        """Compile, and leave no trace of it."""
        self._estimator.warm_up()

    def handle(self, given: Input) -> Outcome:
        """Fuse what came in, frames first. `now_ns` is never less than that of the input before."""
        now_ns, faults = given.now_ns, given.faults | self._slept(given.now_ns)
        frames = [self._corrections.frame(frame) for frame in given.frames]
        told, stamp_ns, seen_faults = self._frames.told(frames, now_ns)
        faults |= seen_faults
        if told is not None:
            outcome = self._fuse(told, stamp_ns, now_ns, faults, _NO_REJECT)
        if given.odometry is not None:
            return self._odometry(self._corrections.reading(given.odometry), now_ns, faults)
        return outcome if told is not None else self._tick(now_ns, faults)

    def _odometry(self, reading: Odometry, now_ns: int, faults: Fault) -> Outcome:
        jumps = self._odometry_stamps.jumps
        stamp_ns = self._odometry_stamps.take(reading.stamp_ns, now_ns)
        if not reading.valid or not (
            math.isfinite(reading.speed_mps) and math.isfinite(reading.steering_rad)
        ):
            return self._tick(now_ns, faults | Fault.ODOMETRY_INVALID)
        if stamp_ns is None:
            return self._tick(now_ns, faults | Fault.STAMP_INVALID)
        faults |= Fault.CLOCK_JUMPED if self._odometry_stamps.jumps > jumps else _NO_FAULT
        believable, faults_seen = self._odometer.judge(
            reading.speed_mps,
            reading.steering_rad,
            stamp_ns,
            self._speed(),
            self._seeing(now_ns),
            self._command[1],
        )
        faults |= faults_seen
        if not believable:
            return self._tick(now_ns, faults, Reject.ODOMETRY)
        if self._odometer_ns is not None:
            self._distance_m += (
                abs(reading.speed_mps) * min(max(stamp_ns - self._odometer_ns, 0), SLEPT_NS) / 1e9
            )
        self._odometer_ns = max(stamp_ns, self._odometer_ns or 0)
        told = Told(odometry=(reading.speed_mps, reading.steering_rad))
        return self._fuse(told, stamp_ns, now_ns, faults, _NO_REJECT)

    def _tick(self, now_ns: int, faults: Fault, rejects: Reject = _NO_REJECT) -> Outcome:
        return self._fuse(None, now_ns, now_ns, faults, rejects)

    def _fuse(
        self, told: Told | None, stamp_ns: int, now_ns: int, faults: Fault, rejects: Reject
    ) -> Outcome:
        elapsed_ns = 0 if self._commanded_ns is None else now_ns - self._commanded_ns
        fused = self._estimator.fuse(told, stamp_ns, now_ns, elapsed_ns)
        known = _Known.of(fused.report)
        finite = all(np.isfinite(part).all() for part in (known.pose, known.covariance))
        if not finite:
            faults |= Fault.NOT_FINITE
            self._begin_anew("the estimate was no number")
        rejects |= Reject.TOO_LATE if fused.refused else _NO_REJECT
        if told is not None and told.corners_px is not None and not fused.refused:
            rejects |= self._judge(known, stamp_ns)
        restarts = self._restarts_before + int(fused.moment.restarts)
        if finite and restarts > self._restarts:
            self._restarts, self._restart_reason = restarts, "contradicted by the corners"
            faults |= Fault.RESTARTED
            self._left = self._known
        self._arrived_elsewhere(known)
        self._known, self._now_ns = known, now_ns
        health, faults = self._monitor.look(self._senses(known, now_ns, faults))
        steering_rad, throttle = self._limited(known, health, now_ns, elapsed_ns)
        return Outcome(
            now_ns,
            health,
            faults,
            rejects,
            steering_rad,
            throttle,
            fused.report,
            fused.moment,
            told,
            stamp_ns,
            self._restarts,
            self._restart_reason,
            self._origin_m,
        )

    def _arrived_elsewhere(self, known: _Known) -> None:
        """After a restart, once the pose is known again: how far it is from what was believed."""
        if self._left is None or not known.decided:
            return
        x_m, y_m, psi_rad = known.pose - self._left.pose
        psi_deg = math.degrees(math.remainder(float(psi_rad), math.tau))
        self._restart_reason += f"; {math.hypot(x_m, y_m):.2f} m and {psi_deg:.0f} deg away"
        self._left = None

    def _judge(self, known: _Known, stamp_ns: int) -> Reject:
        """Whether the corners were believed."""
        gate, nis = self._gate_nis, known.nis
        believed = known.selected >= 0 and nis <= gate
        self._monitor.corners(believed)
        if believed:
            self._fix_ns, self._distance_m = max(stamp_ns, self._fix_ns or 0), 0.0
            return Reject.INNOVATION_LARGE if nis > gate / 2 else _NO_REJECT
        return Reject.INNOVATION

    def _limited(
        self, known: _Known, health: Health, now_ns: int, elapsed_ns: int
    ) -> tuple[float, float]:
        self._command = self.limits.applied(
            known.steering_rad,
            known.throttle * SPEED_FACTOR[health],
            self._command[0],
            elapsed_ns / 1e9,
        )
        self._commanded_ns = now_ns
        return self._command

    def _senses(self, known: _Known, now_ns: int, faults: Fault) -> Senses:
        began_ns = self._began_ns if self._began_ns is not None else now_ns

        def age_s(stamp_ns: int | None) -> float:
            return max(now_ns - (began_ns if stamp_ns is None else stamp_ns), 0) / 1e9

        return Senses(
            located=known.located,
            decided=known.decided,
            fix_age_s=age_s(self._fix_ns),
            odometry_age_s=age_s(self._odometer_ns),
            cameras_age_s=tuple(age_s(stamp_ns) for stamp_ns in self._frames.newest_ns),
            position_sigma_m=known.sigma(0, 1),
            distance_m=self._distance_m,
            faults=faults,
        )

    def _slept(self, now_ns: int) -> Fault:
        """Whether the loop was away so long that what it believes is of another time."""
        self._began_ns = now_ns if self._began_ns is None else self._began_ns
        if self._now_ns is None or abs(now_ns - self._now_ns) <= SLEPT_NS:
            return _NO_FAULT
        self._begin_anew("the loop was away for over a second")
        self._now_ns = None
        return Fault.CLOCK_JUMPED | Fault.RESTARTED

    def _begin_anew(self, reason: str) -> None:
        self._estimator.reset()
        self._restarts += 1
        self._restarts_before, self._restart_reason = self._restarts, reason
        self._fix_ns, self._distance_m = None, 0.0
        self._left = self._known

    def _seeing(self, now_ns: int) -> bool:
        """Whether corners tell of late how fast the vehicle is."""
        return self._fix_ns is not None and now_ns - self._fix_ns < _SEEING_NS

    def _speed(self) -> tuple[float, float] | None:
        """Speed along the course and its sigma, m/s, as far as they are known."""
        known = self._known
        if known is None or not known.decided:
            return None
        heading, *velocity = map(float, known.mean[2:5])
        forward = math.cos(heading) * velocity[0] + math.sin(heading) * velocity[1]
        speed = math.copysign(math.hypot(*velocity), forward)
        return speed, known.sigma(3, 4)
