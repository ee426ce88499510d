"""Decide which odometry to believe: a wheel can't do everything that its sensor says.

Every driven part of the vehicle is judged by itself (see `chassis`), in m/s, and all of them are
believed or none is.
"""

import math
from collections import deque
from dataclasses import dataclass, field
from itertools import pairwise

from jaxnav.drive.chassis import Chassis
from jaxnav.drive.flags import Fault

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


class Odometers:
    """The judge of all driven parts of a vehicle."""

    def __init__(self, chassis: Chassis):
        self.parts = [Odometer(top_mps, chassis.time_constant_s) for top_mps in chassis.tops_mps]

    def judge(
        self,
        driven_mps: tuple[float, ...],
        values: tuple[float, ...],
        stamp_ns: int,
        believed: tuple[tuple[float, float], ...] | None,
        seeing: bool,
        wanted_mps: tuple[float, ...] | None,
        contradicted: bool = False,
    ) -> tuple[bool, Fault]:
        """Whether to fuse a reading, and the faults of the sensor; see `Odometer.judge`.

        Args:
            driven_mps: what it tells of each part.
            values: all that was read.
            believed, wanted_mps: of each part.
        """
        nothing = (None,) * len(self.parts)
        of_parts = driven_mps, believed or nothing, wanted_mps or nothing
        believable, faults = True, Fault(0)
        for part, speed_mps, of_part, wanted in zip(self.parts, *of_parts, strict=True):
            given = speed_mps, values, stamp_ns, of_part, seeing, wanted, contradicted
            taken, fault = part.judge(*given)
            believable, faults = believable and taken, faults | fault
        return believable, faults


@dataclass
class Odometer:
    """The judge of one driven part's readings: it refuses physically impossible ones."""

    max_mps: float
    time_constant_s: float
    last_mps: float | None = None  # believed
    _last_ns: int = 0
    _raw: tuple[float, tuple[float, ...]] | None = None
    _raw_ns: int = 0
    _repeated: int = 0
    _same_speed: int = 0
    _pulled_mps: float = 0.0  # speed expected from the commands
    _pulled_range_mps: tuple[float, float] = (0.0, 0.0)  # since the measured speed changed
    _refused_mps: float = 0.0
    _refusals: int = 0
    _path: deque[tuple[int, float, float]] = field(default_factory=deque)  # see _agrees

    def judge(
        self,
        speed_mps: float,
        values: tuple[float, ...],
        stamp_ns: int,
        believed: tuple[float, float] | None,
        seeing: bool,
        wanted_mps: float | None,
        contradicted: bool = False,
    ) -> tuple[bool, Fault]:
        """Whether to fuse a reading, and the faults of the sensor.

        Args:
            values: all that was read; it is only compared.
            believed: the estimate's speed and its sigma, m/s; None: not known.
            seeing: cameras tell the speed too, so persistent impossible readings stay refused.
            wanted_mps: last commanded; None: by somebody else, who may pull as hard as it goes.
            contradicted: corners have moved for a while, but the reading says that it stands.
        """
        if self._stuck(speed_mps, values, stamp_ns, wanted_mps) or contradicted:
            return False, Fault.ODOMETRY_STUCK
        if self._possible(speed_mps, stamp_ns, believed, wanted_mps):
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
        self.last_mps, self._last_ns = speed_mps, stamp_ns
        return True, Fault(0)

    def _possible(
        self,
        speed_mps: float,
        stamp_ns: int,
        believed: tuple[float, float] | None,
        wanted_mps: float | None,
    ) -> bool:
        if abs(speed_mps) > 1.5 * self.max_mps + _MARGIN_MPS:
            return False
        reference, sigma = believed or (None, 0.0)
        if reference is None:
            if self.last_mps is None:
                return True
            reference = self.last_mps
        gap_s = min(max(stamp_ns - self._last_ns, 0), _MAX_GAP_NS) / 1e9
        # The command pulls towards a speed of its own, brakes and friction towards zero.
        done = 1 - math.exp(-gap_s / self.time_constant_s)
        most_mps = math.copysign(self.max_mps, speed_mps - reference)
        pulled = most_mps if wanted_mps is None else wanted_mps
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

    def _stuck(
        self, speed_mps: float, values: tuple[float, ...], stamp_ns: int, wanted_mps: float | None
    ) -> bool:
        """Whether readings repeat too often: all of it, or only the speed although the command has
        changed it meanwhile (a driver without a steering sensor reports the commanded angle)."""
        gap_s = min(max(stamp_ns - self._raw_ns, 0), _MAX_GAP_NS) / 1e9
        done = 1 - math.exp(-gap_s / self.time_constant_s)
        towards_mps = self._pulled_mps if wanted_mps is None else wanted_mps
        self._pulled_mps += done * (towards_mps - self._pulled_mps)
        same_speed = speed_mps != 0 and self._raw is not None and self._raw[0] == speed_mps
        same = same_speed and self._raw == (speed_mps, values)
        self._raw, self._raw_ns = (speed_mps, values), stamp_ns
        self._repeated = self._repeated + 1 if same else 0
        self._same_speed = self._same_speed + 1 if same_speed else 0
        least, most = self._pulled_range_mps if same_speed else (math.inf, -math.inf)
        least, most = min(least, self._pulled_mps), max(most, self._pulled_mps)
        self._pulled_range_mps = least, most
        return self._repeated >= _STUCK_AFTER or (
            self._same_speed >= _STUCK_AFTER and most - least > _PULLED_MPS
        )
