"""Compare the vehicle's motion by the corners with what it was commanded to do.

Each part of a command, the throttle and the steering of a car or the three of a twist, makes a
motion due that lies between two bounds: its gain is right to a factor, and it may lag. What the
corners show beyond the bounds is summed and slowly forgotten, so that neither a late servo nor
noise adds up, while a part that is reversed, dead, or connected to another one does. The odometer
is no witness here: of many vehicles it tells what was commanded.

A part that is hardly used shows nothing, and does no harm. What little the filter believes of a
wrong odometer is the same from fix to fix, so it does not show in the differences.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

from jaxnav.drive.chassis import Chassis, Motion, Part
from jaxnav.drive.flags import Fault
from jaxnav.drive.limits import Command
from jaxnav.drive.standstill import between
from jaxnav.drive.ways import Fix

_FORGETS_S = 3.0  # time constant: a way of one or two metres
_GAP_NS = 300_000_000  # after a longer one between two fixes the way between them is unknown
_SIGMAS = 3.0
_ROUGH_RAD = 0.05  # headings less sure than this are those of a marker far off: noise
_LEAP_RAD = 0.1  # from frame to frame no vehicle turns farther beyond what is commanded
# Driven slowly while a part is contradicted, before the vehicle stands for good: half of the metre
# after which it must stand is for the naming.
_GIVES_UP_M = 0.25
_CLEARS = 0.5  # share of its margin below which a part is believed again

_FACTOR = 2.0  # of speed and of time constant, see above
_MARGIN_MPS = 0.05  # below it a motor may not turn at all, and `Odometer` allows as much
DOUBT_M = 0.05  # beyond it nothing is decided any more: the error allowed in a fault-free drive
_UNTRUE = 10  # excess of contradicting readings with markers in view: then the throttle is wrong


@dataclass
class Reach:
    """The range in which a driven part is, as it follows its commands.

    Attributes:
        factor: of its gain; that of its time constant is two.
    """

    time_constant_s: float
    factor: float = _FACTOR
    least: float = 0.0
    most: float = 0.0

    def go(self, target: float, gap_s: float) -> None:
        """Take what a command drives it towards, and for how long."""
        slow = 1 - math.exp(-gap_s / (_FACTOR * self.time_constant_s))
        least, most = sorted((target / self.factor, target * self.factor))
        # Brakes and a better motor act at once.
        self.least = min(least, self.least + slow * (least - self.least))
        self.most = max(most, self.most + slow * (most - self.most))


@dataclass
class Apart:
    """By how much two motions differ, m or rad, beyond what they may: summed, slowly forgotten."""

    above: float = 0.0
    below: float = 0.0

    def add(self, least: float, most: float, allowed: float, kept: float) -> None:
        """Take the bounds of a difference.

        Args:
            allowed: it may be off by this much.
            kept: share of the sum that is not forgotten meanwhile.
        """
        self.above = max(0.0, kept * self.above + least - allowed)
        self.below = max(0.0, kept * self.below - most - allowed)

    @property
    def most(self) -> float:
        """Either way."""
        return max(self.above, self.below)


@dataclass
class _Follows:
    """How well one part follows its commands."""

    part: Part
    reach: Reach
    least: float = 0.0  # due since the last fix; by way: the least and most curvature meanwhile
    most: float = 0.0
    beyond: Apart = field(default_factory=Apart)  # what was seen beyond the bounds
    sigma: float = 0.0  # the largest of those that were seen with, forgotten as `beyond` is
    contradicted_m: float | None = None  # way since it is contradicted

    def command(self, target: float, gap_s: float) -> None:
        reach = self.reach
        reach.go(target, gap_s)
        if self.part.by_way:
            self.least, self.most = min(self.least, reach.least), max(self.most, reach.most)
        else:
            self.least += reach.least * gap_s
            self.most += reach.most * gap_s

    def begin(self) -> None:
        """Begin a new way from fix to fix."""
        by_way = self.part.by_way
        self.least, self.most = (self.reach.least, self.reach.most) if by_way else (0.0, 0.0)

    def see(
        self, seen: float, paths_m: tuple[float, float], way_m: float, sigma: float, kept: float
    ) -> None:
        """Hold what corners show of the part against what was due on a path of this length."""
        part, least, most = self.part, self.least, self.most
        if part.by_way:
            due = [path_m * bound for path_m in paths_m for bound in (least, most)]
            least, most = min(due), max(due)
        self.beyond.add(seen - most, seen - least, part.slack_per_m * way_m, kept)
        self.sigma = max(kept * self.sigma, sigma)
        beyond = self.beyond.most
        if self.contradicted_m is not None:
            self.contradicted_m += way_m
            if beyond < _CLEARS * part.margin:
                self.contradicted_m = None
        elif beyond > part.margin + _SIGMAS * self.sigma:
            self.contradicted_m = 0.0


class Actuation:
    """The judge of one drive's actuators.

    Attributes:
        gives_up: a part was contradicted for so long that the vehicle must not drive any more.
    """

    def __init__(self, chassis: Chassis):
        self.gives_up = False
        self._chassis = chassis
        self._parts = [_Follows(part, Reach(part.lag_s, part.factor)) for part in chassis.parts]
        self._last: tuple[int, Fix] | None = None
        self._placed_ns = 0  # when the place, and not the heading alone, was as in the last fix

    @property
    def faults(self) -> Fault:
        """The parts that are contradicted."""
        faults = Fault(0)
        for follows in self._parts:
            if follows.contradicted_m is not None:
                faults |= follows.part.fault
        return faults

    def add_command(self, command: Command, gap_s: float) -> None:
        """Take the command that was in force for a time."""
        for follows, target in zip(self._parts, self._chassis.targets(command), strict=True):
            follows.command(target, gap_s)

    def forget(self) -> None:
        """The next fix follows from no earlier one: anything may have happened."""
        self._last = None

    def forget_place(self) -> None:
        """The filter has restarted: the next place does not follow from the last one."""
        self._placed_ns = -_GAP_NS

    def add_fix(self, now_ns: int, fix: Fix) -> None:
        """Hold the way since the last fix against the commands since then."""
        last, self._last = self._last, (now_ns, fix)
        is_placed = now_ns - self._placed_ns <= _GAP_NS
        self._placed_ns = now_ns
        if last is not None and 0 < now_ns - last[0] <= _GAP_NS:
            gap_s, before = (now_ns - last[0]) / 1e9, last[1]
            ahead_m, left_m, turn_rad = between(before[:3], fix[:3])
            turn_rad = math.remainder(turn_rad, math.tau)
            c, s = math.cos(turn_rad / 2), math.sin(turn_rad / 2)
            moved = Motion(c * ahead_m + s * left_m, c * left_m - s * ahead_m, turn_rad)
            path_m = math.copysign(math.hypot(ahead_m, left_m), moved.forward_mps)
            way_m = abs(path_m) + self._chassis.lever_m * abs(turn_rad)
            kept = math.exp(-gap_s / _FORGETS_S)
            for follows, seen in zip(self._parts, self._chassis.seen(moved), strict=True):
                turns = follows.part.turns
                sigma = max((one.sigma_rad if turns else one.sigma_m) for one in (before, fix))
                if is_placed or turns:
                    follows.see(seen, (path_m, path_m), way_m, sigma, kept)
        self._begin(self._parts)

    def add_headings(self, now_ns: int, headings: Sequence[tuple[float, float]]) -> None:
        """Go on with a turn alone, while corners contradict the estimate: each pose that they may
        mean says where the vehicle heads, psi_rad, and how surely, sigma_rad."""
        if self._last is None or not 0 < now_ns - self._last[0] <= _GAP_NS:
            self._last = None
            return
        drive, turn = self._parts[0], self._parts[-1]
        gap_s, before = (now_ns - self._last[0]) / 1e9, self._last[1]
        turns_rad = [
            (math.remainder(psi - before.psi_rad, math.tau), sigma) for psi, sigma in headings
        ]
        turn_rad, sigma_rad = min(turns_rad, key=lambda one: abs(one[0]), default=(math.inf, 0.0))
        if sigma_rad > _ROUGH_RAD:
            return
        most_radps = max(map(abs, (turn.reach.least, turn.reach.most)))
        most_radps *= (
            max(map(abs, (drive.reach.least, drive.reach.most))) if turn.part.by_way else 1
        )
        if abs(turn_rad) > _LEAP_RAD + most_radps * gap_s:
            self._last = None  # carried off, or another pose of the marker
            return
        fix = before._replace(psi_rad=before.psi_rad + turn_rad, sigma_rad=sigma_rad)
        self._last = now_ns, fix
        ways_m = gap_s * drive.reach.least, gap_s * drive.reach.most
        way_m = max(map(abs, ways_m)) + self._chassis.lever_m * abs(turn_rad)
        kept = math.exp(-gap_s / _FORGETS_S)
        turn.see(turn_rad, ways_m, way_m, sigma_rad, kept)
        self._begin([turn])

    def _begin(self, parts: list[_Follows]) -> None:
        """Begin a new way from fix to fix."""
        for follows in parts:
            follows.begin()
            way_m = follows.contradicted_m
            self.gives_up = self.gives_up or (way_m is not None and way_m > _GIVES_UP_M)


@dataclass
class Propulsion:
    """The odometer's speed of a driven part against its command: its only check without a marker.

    With nominal parameters, a low battery or a slope, the throttle tells the speed within a factor
    of two, and the time constant within another. Without a marker, a reading outside of that is as
    likely wrong as right: the car may be blocked, or its encoder dead.

    Attributes:
        off_m: difference of the ways by odometer and by throttle since the last `confirm`, summed
            while they contradict each other.
    """

    time_constant_s: float
    off_m: float = 0.0
    _nominal_mps: float = 0.0
    _untrue: int = 0

    def __post_init__(self) -> None:
        self._reach_mps = Reach(self.time_constant_s)

    @property
    def doubtful(self) -> bool:
        """Whether the throttle contradicts the odometer, and nothing has confirmed it since."""
        return self.off_m > DOUBT_M

    def add_reading(
        self, speed_mps: float, wanted_mps: float, gap_s: float, seeing: bool, disputed: bool
    ) -> None:
        """Take a reading that was believed.

        Args:
            wanted_mps: towards which the command since the reading before drives.
            gap_s: time since then.
            seeing: corners tell the way too.
            disputed: the corners' way differs from the odometer's. Where the two agree, the
                throttle is wrong: the car is carried, towed, replayed, or not as in its file.
        """
        self._reach_mps.go(wanted_mps, gap_s)
        lagged = 1 - math.exp(-gap_s / self.time_constant_s)
        self._nominal_mps += lagged * (wanted_mps - self._nominal_mps)
        least_mps, most_mps = self._reach_mps.least, self._reach_mps.most
        contradicts = not least_mps - _MARGIN_MPS <= speed_mps <= most_mps + _MARGIN_MPS
        if disputed:
            self._untrue = 0
        elif seeing:
            self._untrue = max(min(self._untrue + (1 if contradicts else -1), 2 * _UNTRUE), 0)
        if contradicts and self._untrue < _UNTRUE:
            self.off_m += abs(speed_mps - self._nominal_mps) * gap_s

    def confirm(self) -> None:
        """Forget the deviation, since corners tell where the car is."""
        self.off_m = 0.0
