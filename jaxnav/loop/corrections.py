"""Between what the sensors of a calibrated vehicle say and what is true.

Readings are corrected where they enter the pilot, commands where they leave the guard, so that
recordings hold what the sensors said, and everything inside is in true units. A vehicle that was
not calibrated changes nothing, not a bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the guard's process corrects without JAX and OpenCV
    from jaxnav.loop.frames import Sighted
    from jaxnav.loop.interfaces import Odometry
    from jaxnav.models.bicycle import Vehicle


@dataclass(frozen=True)
class Corrections:
    """Of one vehicle; see there."""

    speed_scale: float = 1.0
    steering_gain: float = 1.0
    steering_offset_rad: float = 0.0
    camera_delay_s: float = 0.0
    steering_limit_rad: float = math.inf  # of the servo, to either side

    @staticmethod
    def of(vehicle: Vehicle) -> Corrections:
        """Those of its description."""
        return Corrections(
            vehicle.speed_scale,
            vehicle.steering_gain,
            vehicle.steering_offset_rad,
            vehicle.camera_delay_s,
            float(vehicle.steering_limit_rad),
        )

    # Whoever is late is moved back, never the other ahead: no stamp lies in the future.
    @cached_property
    def frame_late_ns(self) -> int:
        """What is taken from the stamps of frames."""
        return round(max(self.camera_delay_s, 0.0) * 1e9)

    @cached_property
    def reading_late_ns(self) -> int:
        """What is taken from the stamps of readings."""
        return round(max(-self.camera_delay_s, 0.0) * 1e9)

    @cached_property
    def _is_neutral(self) -> bool:
        return (self.speed_scale, self.steering_gain, self.steering_offset_rad) == (1, 1, 0)

    def reading(self, read: Odometry) -> Odometry:
        """What was true when a reading was taken."""
        if self._is_neutral and not self.reading_late_ns:
            return read
        return replace(
            read,
            stamp_ns=read.stamp_ns - self.reading_late_ns,
            speed_mps=self.speed_scale * read.speed_mps,
            steering_rad=self.steering_gain * read.steering_rad + self.steering_offset_rad,
        )

    def read(self, speed_mps: float, steering_rad: float) -> tuple[float, float]:
        """What the sensors say of a true speed and steering: the inverse of `reading`."""
        if self._is_neutral:
            return speed_mps, steering_rad
        angle_rad = (steering_rad - self.steering_offset_rad) / self.steering_gain
        return speed_mps / self.speed_scale, angle_rad

    def frame(self, seen: Sighted) -> Sighted:
        """A frame with its stamp on the odometer's clock."""
        late_ns = self.frame_late_ns
        return replace(seen, stamp_ns=seen.stamp_ns - late_ns) if late_ns else seen

    def servo_rad(self, steering_rad: float) -> float:
        """What the servo is told so that the wheels stand at an angle, as far as it can turn."""
        if self._is_neutral:
            return steering_rad
        told_rad = self.read(0.0, steering_rad)[1]
        return min(max(told_rad, -self.steering_limit_rad), self.steering_limit_rad)

    def true_rad(self, servo_rad: float) -> float:
        """Where the wheels stand when the servo is told so: the inverse of `servo_rad`."""
        if self._is_neutral:
            return servo_rad
        return self.steering_gain * servo_rad + self.steering_offset_rad
