"""Decide which odometry to believe: a wheel can't do everything that its sensor says."""

import math
from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

from jaxnav.loop.flags import Fault
from jaxnav.models.bicycle import Vehicle

_MARGIN_MPS = 0.05  # beside what the vehicle can reach
_SIGMAS = 2.0
_AGREE_MPS = 0.2  # largest difference of two refused readings that agree
_AGREEING = 10  # this many of them in a row are believed where no camera knows better
_DISTRUSTED = 5  # after so many refusals in a row a fitting speed is not enough, the way must fit
_PATH_NS = 1_000_000_000
_PATH_M, _PATH_SHARE = 0.02, 0.1  # how well the way must fit
_STUCK_AFTER = 25  # identical readings of a moving vehicle
_PULLED_MPS = 0.1  # a change of speed that any encoder shows
_MAX_GAP_NS = 1_000_000_000


@dataclass
class Odometer:
    """The judge of an odometer's readings: it refuses physically impossible ones."""

    max_mps: float
    speed_per_throttle_mps: float
    time_constant_s: float
    last: tuple[float, float] | None = None  # speed_mps, steering_rad, believed
    _last_ns: int = 0
    _raw: tuple[float, float] | None = None
    _raw_ns: int = 0
    _repeated: int = 0
    _same_speed: int = 0
    _pulled_mps: float = 0.0  # speed expected from the throttle commands
    _pulled_range_mps: tuple[float, float] = (0.0, 0.0)  # since the measured speed changed
    _refused_mps: float = 0.0
    _refusals: int = 0
    _path: deque[tuple[int, float, float]] = field(default_factory=deque)  # see _agrees

    @staticmethod
    def of(vehicle: Vehicle) -> "Odometer":
        """The judge for a vehicle, with its top speed and its time constant."""
        speed_per_throttle_mps = float(vehicle.speed_per_throttle_mps)
        return Odometer(
            float(vehicle.throttle_limit) * speed_per_throttle_mps,
            speed_per_throttle_mps,
            float(vehicle.speed_time_constant_s),
        )

    def judge(
        self,
        speed_mps: float,
        steering_rad: float,
        stamp_ns: int,
        believed: tuple[float, float] | None,
        seeing: bool,
        throttle: float | None,
        contradicted: bool = False,
    ) -> tuple[bool, Fault]:
        """Whether to fuse a reading, and the faults of the sensor.

        Args:
            believed: the estimate's speed and its sigma, m/s; None: not known.
            seeing: cameras tell the speed too, so persistent impossible readings stay refused.
            throttle: last commanded; None: by somebody else, who may pull as hard as it goes.
            contradicted: corners have moved for a while, but the reading says that the car stands.
        """
        if self._stuck(speed_mps, steering_rad, stamp_ns, throttle) or contradicted:
            return False, Fault.ODOMETRY_STUCK
        if self._possible(speed_mps, stamp_ns, believed, throttle):
            if (
                seeing
                and self._refusals >= _DISTRUSTED
                and not self._agrees(speed_mps, stamp_ns, believed)
            ):
                return False, Fault(0)
            self._refusals = 0
            self._path.clear()
        else:
            self._agrees(speed_mps, stamp_ns, believed)
            agrees = abs(speed_mps - self._refused_mps) < _AGREE_MPS
            self._refusals = self._refusals + 1 if agrees else 1
            self._refused_mps = speed_mps
            insists = self._refusals > _AGREEING and abs(speed_mps) <= 1.5 * self.max_mps
            if seeing or not insists:
                return False, Fault(0)
        self.last, self._last_ns = (speed_mps, steering_rad), stamp_ns
        return True, Fault(0)

    def _possible(
        self,
        speed_mps: float,
        stamp_ns: int,
        believed: tuple[float, float] | None,
        throttle: float | None,
    ) -> bool:
        if abs(speed_mps) > 1.5 * self.max_mps + _MARGIN_MPS:
            return False
        reference, sigma = believed or (None, 0.0)
        if reference is None:
            if self.last is None:
                return True
            reference = self.last[0]
        gap_s = min(max(stamp_ns - self._last_ns, 0), _MAX_GAP_NS) / 1e9
        # The throttle pulls towards a speed of its own, brakes and friction towards zero.
        done = 1 - math.exp(-gap_s / self.time_constant_s)
        pulled = self._towards(throttle, math.copysign(self.max_mps, speed_mps - reference))
        targets = (reference, pulled, 0.0)
        reached = [reference + done * (target - reference) for target in targets]
        margin = _MARGIN_MPS + _SIGMAS * sigma
        return min(reached) - margin <= speed_mps <= max(reached) + margin

    def _agrees(
        self, speed_mps: float, stamp_ns: int, believed: tuple[float, float] | None
    ) -> bool:
        """Whether the way by a refused sensor has agreed with the cameras' way for a while.

        Cameras measure speeds roughly, but ways well.
        """
        if believed is None:
            self._path.clear()
            return False
        self._path.append((stamp_ns, speed_mps, believed[0]))
        while self._path[0][0] < stamp_ns - _PATH_NS:
            self._path.popleft()
        stamps, read, seen = zip(*self._path, strict=True)
        gaps_s = [max(b - a, 0) / 1e9 for a, b in pairwise(stamps)]
        off_m = sum((a - b) * dt for a, b, dt in zip(read, seen, gaps_s, strict=False))
        way_m = sum(abs(b) * dt for b, dt in zip(seen, gaps_s, strict=False))
        long_enough = stamp_ns - stamps[0] > _PATH_NS / 2
        return long_enough and abs(off_m) < _PATH_M + _PATH_SHARE * way_m

    def _towards(self, throttle: float | None, otherwise_mps: float) -> float:
        """The speed towards which the throttle pulls, or another one where it is not known."""
        return otherwise_mps if throttle is None else throttle * self.speed_per_throttle_mps

    def _stuck(
        self, speed_mps: float, steering_rad: float, stamp_ns: int, throttle: float | None
    ) -> bool:
        """Whether readings repeat too often: all of it, or only the speed although the throttle has
        changed it meanwhile (a driver without a steering sensor reports the commanded angle)."""
        gap_s = min(max(stamp_ns - self._raw_ns, 0), _MAX_GAP_NS) / 1e9
        done = 1 - math.exp(-gap_s / self.time_constant_s)
        self._pulled_mps += done * (self._towards(throttle, self._pulled_mps) - self._pulled_mps)
        same_speed = speed_mps != 0 and self._raw is not None and self._raw[0] == speed_mps
        same = same_speed and self._raw == (speed_mps, steering_rad)
        self._raw, self._raw_ns = (speed_mps, steering_rad), stamp_ns
        self._repeated = self._repeated + 1 if same else 0
        self._same_speed = self._same_speed + 1 if same_speed else 0
        least, most = self._pulled_range_mps if same_speed else (math.inf, -math.inf)
        least, most = min(least, self._pulled_mps), max(most, self._pulled_mps)
        self._pulled_range_mps = least, most
        return self._repeated >= _STUCK_AFTER or (
            self._same_speed >= _STUCK_AFTER and most - least > _PULLED_MPS
        )
