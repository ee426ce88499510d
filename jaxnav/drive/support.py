"""Check what supports an estimate, and so decide whether to act on it.

The filter can't know that its pose is wrong: all data were fused into it. So a pose is trusted only
after CONFIRMED frames in a row have fitted it, and only until corners, or odometer and throttle,
contradict it. After a restart the pose is compared with the way of the wheels since the last fix: a
copy of the marker elsewhere looks like the marker.
"""

from collections.abc import Callable, Sequence

from jaxnav.drive.actuation import Propulsion
from jaxnav.drive.chassis import Chassis, Motion, pace_mps
from jaxnav.drive.flags import Fault
from jaxnav.drive.ways import Fix, Ranges, Ways

CONFIRMED = 2  # frames in a row, with the first: a single one never confirms
# Way driven slowly after a relocation, so that a person can look at the car: about five seconds at
# half of its speed in a room, and a car that sees nothing gets no more (see `health`).
SLOW_M = 1.0
# Every further restart on that way needs twice as many frames, up to three seconds of a camera's.
_MOST_CONFIRMED = 96
_NO_FAULT = Fault(0)


class Support:
    """The support of one drive's estimate.

    Attributes:
        refused: the pose is out of reach, which is not allowed (`relocate` is False).
        relocations: number of relocations so far.
        ranges: see `Ranges`.
    """

    def __init__(self, chassis: Chassis, relocate: bool = True):
        """Args:
        relocate: whether to believe, after a while, a pose that no slip explains.
        """
        self.refused = False
        self.relocations = 0
        self._relocate = relocate
        self._ways, self.ranges = Ways(chassis.slides_m), Ranges()
        self._propulsions = [Propulsion(chassis.time_constant_s) for _ in chassis.tops_mps]
        self._confirmations, self._needed = 0, CONFIRMED
        self._restarted = False
        self._slow_until_m = 0.0

    @property
    def confirmed(self) -> bool:
        """Whether enough frames in a row have fitted the pose."""
        return self._confirmations >= self._needed

    @property
    def relocated(self) -> bool:
        """Whether no slip explains the pose now, or one less than SLOW_M ago."""
        return self.refused or self._ways.way_m < self._slow_until_m

    @property
    def faults(self) -> Fault:
        """The faults that contradict the estimated pose."""
        faults = Fault.RELOCATED if self.relocated else _NO_FAULT
        if self._ways.disputed:
            faults |= Fault.WAYS_DISPUTED
        if self.ranges.contradicted:
            faults |= Fault.FILES_CONTRADICTED
        if self._doubtful:
            faults |= Fault.ODOMETRY_DOUBTFUL
        return faults

    @property
    def stands(self) -> bool:
        """Whether to drive no farther: refused, or the files contradict the drive for long."""
        return self.refused or self.ranges.lasting

    def add_odometry(
        self,
        driven_mps: tuple[float, ...],
        motion: Motion,
        heading_rad: float,
        gap_s: float,
        wanted_mps: tuple[float, ...] | None,
        seeing: bool,
    ) -> None:
        """Take a reading of the odometer that was believed; see `Ways` and `Propulsion`.

        Args:
            driven_mps, motion: that it tells; see `Chassis`.
            wanted_mps: None where somebody else commands them: they contradict nothing.
        """
        pace = pace_mps(driven_mps)
        self._ways.add_odometry(motion, pace, heading_rad, gap_s)
        self.ranges.add_way(pace * gap_s)
        if wanted_mps is not None:
            parts = zip(self._propulsions, driven_mps, wanted_mps, strict=True)
            for propulsion, speed_mps, part_mps in parts:
                propulsion.add_reading(speed_mps, part_mps, gap_s, seeing, self._ways.disputed)

    def note_restart(self) -> None:
        """The filter has restarted: confirm the pose anew, and check it against the last fix."""
        self._needed = min(2 * self._needed, _MOST_CONFIRMED) if self.relocated else CONFIRMED
        self._confirmations, self._restarted = 0, True

    def begin_anew(self) -> None:
        """Start anew and forget the last fix: anything may have happened meanwhile."""
        self._confirmations, self._needed = 0, CONFIRMED
        self._restarted = self.refused = False
        self._ways.forget()

    def add_corners(
        self,
        accepted: bool,
        agrees: bool,
        now_ns: int,
        fix: Fix | None,
        possible: Callable[[], Sequence[Fix]],
    ) -> bool:
        """Take a frame; return whether it gives a fix.

        Args:
            accepted: the filter has taken the frame.
            agrees: it agrees with the prediction. A frame that does not may still be accepted, with
                larger sigmas, but confirms nothing.
            fix: the estimated pose; None: several poses are possible.
            possible: returns these poses.
        """
        self._ways.note_corners(now_ns)
        if not agrees and not self.confirmed:
            self._confirmations = 0
        if not accepted:
            return False
        self._confirmations += agrees
        if not self.confirmed:
            return False
        slack_m = self._off_m
        if fix is None:
            if self._restarted and not self._relocate:
                self.refused = all(self._ways.out_of_reach(one, slack_m) for one in possible())
            return not self.refused
        if self._ways.out_of_reach(fix, slack_m):
            self.refused = not self._relocate
            if self.refused:
                return False
            self.relocations += 1
            self._slow_until_m = self._ways.way_m + SLOW_M
            self._ways.forget()
        self._restarted = self.refused = False
        for propulsion in self._propulsions:
            propulsion.confirm()
        self._ways.add_fix(now_ns, fix)
        return True

    def doubt_m(self, contradicted: bool) -> float | None:
        """By how much the estimate may be off beside its sigma; None: it is not doubted.

        Args:
            contradicted: the corners contradict it more often than not.
        """
        doubtful = self._doubtful
        off_m = self._off_m if doubtful else 0.0
        if contradicted or self.refused:
            off_m += self._ways.since_fix_m
        contradicted |= self.ranges.contradicted
        is_doubted = not self.confirmed or self.refused or contradicted or doubtful
        return off_m if is_doubted else None

    @property
    def _doubtful(self) -> bool:
        """Whether the command of any driven part contradicts the odometer; see `Propulsion`."""
        return any(propulsion.doubtful for propulsion in self._propulsions)

    @property
    def _off_m(self) -> float:
        """By how much the odometer contradicts the commands, of all driven parts together."""
        return sum(propulsion.off_m for propulsion in self._propulsions)
