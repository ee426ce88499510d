"""Speed and steering from the twist of a body, without ROS, OpenCV or JAX, for plug-ins."""

import math
from dataclasses import dataclass

STANDSTILL_MPS = 0.02  # below it noise in the yaw rate makes any steering angle


def twist_of(speed_mps: float, steering_rad: float, wheelbase_m: float) -> tuple[float, float]:
    """Velocity along the vehicle's x axis, m/s, and yaw rate, rad/s: what `TwistReader` reads."""
    slope = math.tan(steering_rad)
    forward_mps = speed_mps / math.hypot(1.0, slope / 2)
    return forward_mps, forward_mps * slope / wheelbase_m


@dataclass
class TwistReader:
    """Converts the twists of a body to speed along the course and steering of a bicycle.

    With v the speed along the course, l the wheelbase and beta = atan(tan(steering) / 2), the
    velocity along the vehicle's own x axis is v cos(beta), the same wherever on that axis
    base_link is, and the yaw rate v cos(beta) tan(steering) / l. So

        tan(steering) = yaw_rate l / forward,  v = forward sqrt(1 + tan^2(steering) / 4).

    Source: Liu, Schofield, Shan (2023), Eqs. 4 to 6.

    Attributes:
        wheelbase_m: of the bicycle.
        steering_limit_rad: bound on the result; a faster turn is noise or slip.
    """

    wheelbase_m: float
    steering_limit_rad: float
    _held_rad: float = 0.0

    def read(self, forward_mps: float, yaw_rate_radps: float) -> tuple[float, float]:
        """(speed_mps, steering_rad), both NaN where either number is not finite.

        At a standstill the steering is held.
        """
        if not (math.isfinite(forward_mps) and math.isfinite(yaw_rate_radps)):
            return math.nan, math.nan
        if abs(forward_mps) >= STANDSTILL_MPS:
            steering_rad = math.atan(yaw_rate_radps * self.wheelbase_m / forward_mps)
            limit_rad = self.steering_limit_rad
            self._held_rad = min(max(steering_rad, -limit_rad), limit_rad)
        return forward_mps * math.hypot(1.0, math.tan(self._held_rad) / 2), self._held_rad
