"""Clamp commands to the limits of the vehicle, whatever was computed."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the guard's process knows a vehicle's numbers without JAX
    from jaxnav.models.bicycle import Vehicle


@dataclass(frozen=True)
class Limits:
    """The limits of one vehicle's commands."""

    steering_rad: float
    steering_rate_radps: float
    throttle: float

    @staticmethod
    def of(vehicle: Vehicle) -> Limits:
        """The limits in a vehicle's description."""
        return Limits(
            float(vehicle.steering_limit_rad),
            float(vehicle.steering_rate_limit_radps),
            float(vehicle.throttle_limit),
        )

    def apply(
        self, steering_rad: float, throttle: float, last_steering_rad: float, elapsed_s: float
    ) -> tuple[float, float]:
        """Steering and throttle inside the limits.

        A command that is not finite gives zero throttle; such steering keeps its last value.

        Args:
            last_steering_rad: the steering angle commanded before.
            elapsed_s: time since then; 0 replaces a value that is not positive and finite.
        """
        last = _clamped(last_steering_rad, self.steering_rad, 0.0)
        steering = _clamped(steering_rad, self.steering_rad, last)
        elapsed_s = elapsed_s if math.isfinite(elapsed_s) and elapsed_s > 0 else 0.0
        step = min(self.steering_rate_radps * elapsed_s, 2 * self.steering_rad)
        steering = min(max(steering, last - step), last + step)
        drives = math.isfinite(steering_rad) and math.isfinite(throttle)
        return steering, _clamped(throttle, self.throttle, 0.0) if drives else 0.0


def _clamped(value: float, limit: float, instead: float) -> float:
    return min(max(value, -limit), limit) if math.isfinite(value) else instead
