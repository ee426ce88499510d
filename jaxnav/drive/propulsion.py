"""Compare the odometer with the throttle, the only check of it while no marker is in view.

    propulsion.add_reading(speed_mps, wanted_mps, gap_s, seeing, disputed)
    propulsion.doubtful, propulsion.off_m

With nominal parameters, a low battery or a slope, the throttle tells the speed within a factor of
two, and the time constant within another. Without a marker, a reading outside of that is as likely
wrong as right: the car may be blocked, or its encoder dead.
"""

import math
from dataclasses import dataclass

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
class Propulsion:
    """The speed range of a driven part expected from its command, and the deviation from it.

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
