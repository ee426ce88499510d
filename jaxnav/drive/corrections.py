"""Convert between the sensor values of a calibrated vehicle and the true ones.

Readings are corrected where they enter the pilot, commands where they leave the guard. So
recordings hold the raw sensor values, and everything inside is in true units. Without a calibration
every value stays the same, bit for bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import TYPE_CHECKING

from jaxnav.drive.interfaces import Odometry
from jaxnav.drive.limits import turns_by_twist

if TYPE_CHECKING:  # the guard's process corrects without JAX and OpenCV
    from jaxnav.core.models.vehicle import TwistBase, Vehicle
    from jaxnav.drive.frames import FrameDetections
    from jaxnav.drive.interfaces import Reading
    from jaxnav.drive.limits import Command


@dataclass(frozen=True)
class Corrections:
    """The corrections of one vehicle, named as in `Vehicle`. Other bases have none."""

    speed_scale: float = 1.0
    steering_gain: float = 1.0
    steering_offset_rad: float = 0.0
    camera_delay_s: float = 0.0
    steering_limit_rad: float = math.inf  # of the servo, to either side

    @staticmethod
    def from_vehicle(vehicle: Vehicle | TwistBase) -> Corrections:
        """The corrections in a vehicle's description."""
        if turns_by_twist(vehicle):
            return Corrections()
        names = (field.name for field in fields(Corrections))
        return Corrections(*(float(getattr(vehicle, name)) for name in names))

    # The late sensor is moved back, never the other one ahead: no stamp lies in the future.
    @cached_property
    def frame_late_ns(self) -> int:
        """The delay subtracted from the stamps of frames."""
        return round(max(self.camera_delay_s, 0.0) * 1e9)

    @cached_property
    def reading_late_ns(self) -> int:
        """The delay subtracted from the stamps of readings."""
        return round(max(-self.camera_delay_s, 0.0) * 1e9)

    @cached_property
    def _is_neutral(self) -> bool:
        return (self.speed_scale, self.steering_gain, self.steering_offset_rad) == (1, 1, 0)

    def correct_reading(self, read: Reading) -> Reading:
        """A reading in true units, its stamp corrected."""
        if (self._is_neutral and not self.reading_late_ns) or not isinstance(read, Odometry):
            return read
        return replace(
            read,
            stamp_ns=read.stamp_ns - self.reading_late_ns,
            speed_mps=self.speed_scale * read.speed_mps,
            steering_rad=self.steering_gain * read.steering_rad + self.steering_offset_rad,
        )

    def read(self, speed_mps: float, steering_rad: float) -> tuple[float, float]:
        """The sensor values of a true speed and steering angle: the inverse of
        `correct_reading`."""
        if self._is_neutral:
            return speed_mps, steering_rad
        angle_rad = (steering_rad - self.steering_offset_rad) / self.steering_gain
        return speed_mps / self.speed_scale, angle_rad

    def correct_frame(self, seen: FrameDetections) -> FrameDetections:
        """A frame with its stamp corrected to the odometer's clock."""
        late_ns = self.frame_late_ns
        return replace(seen, stamp_ns=seen.stamp_ns - late_ns) if late_ns else seen

    def command_for(self, command: Command) -> Command:
        """The command that the vehicle's driver gets for a true one; see `servo_rad`."""
        return command if self._is_neutral else (self.servo_rad(command[0]), command[1])

    def servo_rad(self, steering_rad: float) -> float:
        """The servo angle that turns the wheels to an angle, within the servo's limit."""
        if self._is_neutral:
            return steering_rad
        servo_rad = self.read(0.0, steering_rad)[1]
        return min(max(servo_rad, -self.steering_limit_rad), self.steering_limit_rad)

    def true_rad(self, servo_rad: float) -> float:
        """The angle of the wheels at a servo angle: the inverse of `servo_rad`."""
        if self._is_neutral:
            return servo_rad
        return self.steering_gain * servo_rad + self.steering_offset_rad
