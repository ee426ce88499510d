"""The odometer held against the throttle: all that can contradict it where no marker is in view.

    propulsion.look(speed_mps, throttle, gap_s, seeing, disputed)
    propulsion.doubtful, propulsion.off_m

Nominal parameters of a vehicle, a battery that runs low, a slope: the throttle tells the speed
within a factor of two, and when within another. What the odometer says beyond that, without a
marker, is as likely wrong as right: the car may be blocked, or its encoder dead.
"""

import math
from dataclasses import dataclass

from jaxnav.models.bicycle import Vehicle

_FACTOR = 2.0  # of speed and of time constant, see above
_MARGIN_MPS = 0.05  # below it a motor may well not turn at all, and `Odometer` allows as much
DOUBT_M = 0.05  # parted so far, nothing is decided any more: what a fault-free drive may err by
_UNTRUE = 10  # readings more that contradict than agree, markers in view: then the throttle lies


@dataclass
class Propulsion:
    """What the throttle should come to, and how far the odometer is from it.

    Attributes:
        off_m: way between the odometer's and the throttle's since the last `confirmed`, as far as
            they contradict each other.
    """

    speed_per_throttle_mps: float
    time_constant_s: float
    off_m: float = 0.0
    _nominal_mps: float = 0.0
    _least_mps: float = 0.0
    _most_mps: float = 0.0
    _untrue: int = 0

    @staticmethod
    def of(vehicle: Vehicle) -> "Propulsion":
        """For a vehicle."""
        return Propulsion(
            float(vehicle.speed_per_throttle_mps), float(vehicle.speed_time_constant_s)
        )

    @property
    def doubtful(self) -> bool:
        """Whether the odometer is contradicted, and nothing has confirmed it since."""
        return self.off_m > DOUBT_M

    def look(
        self, speed_mps: float, throttle: float, gap_s: float, seeing: bool, disputed: bool
    ) -> None:
        """A reading that was believed.

        Args:
            throttle: commanded since the reading before.
            gap_s: since then.
            seeing: corners tell the way too.
            disputed: another one than the odometer. Where they agree it is the throttle that is
                wrong: the car is carried, towed or replayed, or other than its file says.
        """
        target = throttle * self.speed_per_throttle_mps
        slow = 1 - math.exp(-gap_s / (_FACTOR * self.time_constant_s))
        least, most = sorted((target / _FACTOR, target * _FACTOR))
        # Brakes and a better motor act at once.
        self._least_mps = min(least, self._least_mps + slow * (least - self._least_mps))
        self._most_mps = max(most, self._most_mps + slow * (most - self._most_mps))
        lagged = 1 - math.exp(-gap_s / self.time_constant_s)
        self._nominal_mps += lagged * (target - self._nominal_mps)
        contradicts = not (
            self._least_mps - _MARGIN_MPS <= speed_mps <= self._most_mps + _MARGIN_MPS
        )
        if disputed:
            self._untrue = 0
        elif seeing:
            self._untrue = max(min(self._untrue + (1 if contradicts else -1), 2 * _UNTRUE), 0)
        if contradicts and self._untrue < _UNTRUE:
            self.off_m += abs(speed_mps - self._nominal_mps) * gap_s

    def confirmed(self) -> None:
        """Corners tell where the car is."""
        self.off_m = 0.0
