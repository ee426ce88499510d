"""Find out of gyro, wheels and corners the gyro that contradicts the two others about the turn.

    votes.add_command(command, gap_s)   # with every cycle
    votes.add_reading(now_ns, motion)   # with every reading of the odometer, believed or not
    votes.add_fix(now_ns, psi_rad)      # with every pose that the corners have confirmed
    votes.gyro_is_wrong

Where the gyro and the wheels differ, the corners decide who is wrong, and where no marker is seen
the command does. What differs beyond the errors of all of them is summed and slowly forgotten.
"""

import math
from collections.abc import Callable

from jaxnav.drive.chassis import Chassis, Motion
from jaxnav.drive.limits import Command
from jaxnav.drive.propulsion import Apart, Reach

# Six degrees, a tenth of a rad for each metre of wheels that are 3 % apart, and what a turn's own
# gain may be off by (tracks slide).
_MARGIN_RAD, _SLACK_RADPM, _SHARE = 0.1, 0.1, 0.15
_CLEARLY = 2.0  # so much farther from the third than the wheels are
_FORGETS_S = 2.0
_SIGMAS = 3.0  # of the gyro's bias
_GAP_NS = 300_000_000  # after a longer one nothing is compared
_SEEN_NS = 300_000_000  # after a fix; then the command is the third


class TurnVotes:
    """The votes of one drive.

    Attributes:
        gyro_is_wrong: for the rest of the drive: it was contradicted.
    """

    def __init__(
        self, chassis: Chassis, bias_sigma_radps: float, mean_radps: Callable[[int, int], float]
    ):
        """Args:
        mean_radps: what the gyro tells of the interval between two times; NaN: nothing.
        """
        self.gyro_is_wrong = False
        self._chassis, self._mean_radps = chassis, mean_radps
        self._bias_radps = _SIGMAS * bias_sigma_radps
        self._part = chassis.parts[-1]
        self._reach = Reach(self._part.lag_s, self._part.factor)
        self._gyro_wheels, self._gyro_corners, self._wheels_corners = Apart(), Apart(), Apart()
        self._gyro_command, self._wheels_command = Apart(), Apart()
        self._reading: tuple[int, Motion] | None = None
        self._fix: tuple[int, float] | None = None
        self._wheels_rad = self._way_m = 0.0  # since the last fix

    def add_command(self, command: Command, gap_s: float) -> None:
        """Take the command that was in force for a time."""
        self._reach.go(self._chassis.targets(command)[-1], gap_s)

    def add_reading(self, now_ns: int, motion: Motion) -> None:
        """Hold the gyro against a reading of the odometer."""
        last, self._reading = self._reading, (now_ns, motion)
        if last is None or not 0 < now_ns - last[0] <= _GAP_NS:
            return
        gap_s = (now_ns - last[0]) / 1e9
        turned_rad, way_m = motion.turn_radps * gap_s, motion.forward_mps * gap_s
        self._wheels_rad += turned_rad
        self._way_m += abs(way_m)
        gyro_rad = self._mean_radps(last[0], now_ns) * gap_s
        if not math.isfinite(gyro_rad):
            return
        share_rad = _SHARE * max(abs(turned_rad), abs(gyro_rad))
        kept = math.exp(-gap_s / _FORGETS_S)
        slack_rad = _SLACK_RADPM * abs(way_m)
        bias_rad = self._bias_radps * gap_s
        per = way_m if self._part.by_way else gap_s
        least, most = sorted((per * self._reach.least, per * self._reach.most))
        for apart, rad, slack in (
            (self._gyro_command, gyro_rad, slack_rad + bias_rad),
            (self._wheels_command, turned_rad, slack_rad),
        ):
            apart.add(rad - most, rad - least, slack, kept)
        off_rad = gyro_rad - turned_rad
        self._gyro_wheels.add(off_rad, off_rad, share_rad + slack_rad + bias_rad, kept)
        if self._gyro_wheels.most > _MARGIN_RAD and not self.gyro_is_wrong:
            seen = self._fix is not None and now_ns - self._fix[0] < _SEEN_NS
            gyro, wheels = (
                (self._gyro_corners, self._wheels_corners)
                if seen
                else (self._gyro_command, self._wheels_command)
            )
            self.gyro_is_wrong = gyro.most > max(_MARGIN_RAD / 2, _CLEARLY * wheels.most)

    def add_fix(self, now_ns: int, psi_rad: float) -> None:
        """Hold the gyro and the wheels against a heading by the corners."""
        last, self._fix = self._fix, (now_ns, psi_rad)
        wheels_rad, self._wheels_rad = self._wheels_rad, 0.0
        way_m, self._way_m = self._way_m, 0.0
        if last is None or not 0 < now_ns - last[0] <= _GAP_NS:
            return
        gap_s = (now_ns - last[0]) / 1e9
        turned_rad = math.remainder(psi_rad - last[1], math.tau)
        gyro_rad = self._mean_radps(last[0], now_ns) * gap_s
        slack_rad = _SHARE * abs(turned_rad)
        kept = math.exp(-gap_s / _FORGETS_S)
        off_rad = wheels_rad - turned_rad
        self._wheels_corners.add(off_rad, off_rad, slack_rad + _SLACK_RADPM * way_m, kept)
        if math.isfinite(gyro_rad):
            off_rad = gyro_rad - turned_rad
            self._gyro_corners.add(off_rad, off_rad, slack_rad + self._bias_radps * gap_s, kept)

    def forget(self) -> None:
        """The next heading follows from no earlier one: the filter has begun anew."""
        self._fix = None
