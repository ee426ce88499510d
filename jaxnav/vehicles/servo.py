"""Model the steering servo of a car that does not measure its steering angle."""

from dataclasses import dataclass


@dataclass
class Servo:
    """A steering servo that turns at its full rate until it reaches the commanded angle."""

    rate_limit_radps: float
    angle_rad: float = 0.0
    target_rad: float = 0.0
    _time_ns: int | None = None

    def turn_to(self, target_rad: float, now_ns: int) -> None:
        """Command an angle from this instant on."""
        self.angle_at(now_ns)
        self.target_rad = target_rad

    def angle_at(self, now_ns: int) -> float:
        """The angle at a time, rad. Times must not decrease."""
        elapsed_s = 0.0 if self._time_ns is None else max(now_ns - self._time_ns, 0) / 1e9
        self._time_ns = now_ns
        reach_rad = self.rate_limit_radps * elapsed_s
        way_rad = self.target_rad - self.angle_rad
        self.angle_rad += min(max(way_rad, -reach_rad), reach_rad)
        return self.angle_rad
