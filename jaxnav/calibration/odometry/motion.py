"""Statistics of a car's motion in a drive, which decide which parameters it can determine."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxnav.calibration.odometry.drive import Intervals, ReadingSigma
from jaxnav.errors import BadInput

_VARIED_RAD, _VARIED_MPS = 0.03, 0.03  # below, noise could pass for steering or driving
_VARIED_SHARE = 0.2  # of the speed: a single start tells little about the delay
_ASIDE_RAD = 0.05  # at a constant steering this far from straight, gain and offset are one
_BLOCK = 15  # readings to average, some 0.3 s

STEERED_LITTLE = (
    "the steering hardly changed while the car moved: drive eights, at full lock both ways, to "
    "find it"
)
_TURNED_LITTLE = "the car hardly turned: drive circles at full lock both ways to find it"
_CHANGED_LITTLE = "neither speed nor steering changed: stop and start, or drive eights, to find it"


def _means(intervals: Intervals, values: np.ndarray) -> tuple[np.ndarray, int]:
    """Means of blocks of readings, and the number of readings in each."""
    linked = values[intervals.linked > 0]
    size = min(_BLOCK, len(linked))
    return linked[: len(linked) // size * size].reshape(-1, size).mean(axis=1), size


def driven_m(intervals: Intervals) -> float:
    """The distance driven by the odometry, m, without the length that noise would add."""
    speed_mps, size = _means(intervals, intervals.speed_mps)
    dt_s, _ = _means(intervals, intervals.dt_s)
    return float(np.sum(np.abs(speed_mps) * dt_s * size))


@dataclass(frozen=True)
class DriveStatistics:
    """Mean and spread of a car's speed and steering, with the sensors' noise subtracted.

    Attributes:
        speed_mps: mean of the absolute speed.
        varied_mps: standard deviation of the speed.
        steering_rad: mean of the steering, weighted by distance.
        varied_rad: standard deviation of the steering, weighted by distance.
    """

    speed_mps: float
    varied_mps: float
    steering_rad: float
    varied_rad: float

    @staticmethod
    def of(intervals: Intervals, sigma: ReadingSigma) -> "DriveStatistics":
        """Compute the motion from means of blocks of readings, which have little noise."""
        speed, size = _means(intervals, intervals.speed_mps)
        steering, _ = _means(intervals, intervals.steering_rad)
        weight = np.abs(speed) / np.sum(np.abs(speed))

        def beyond_noise(variance: float, noise: float) -> float:
            return float(np.sqrt(max(variance - noise**2 / size, 0.0)))

        middle = float(weight @ steering)
        return DriveStatistics(
            float(np.mean(np.abs(speed))),
            beyond_noise(float(np.var(speed)), sigma.speed_mps),
            middle,
            beyond_noise(float(weight @ (steering - middle) ** 2), sigma.steering_rad),
        )

    def cannot_tell(self, where: str, fixed: Sequence[str]) -> dict[str, str]:
        """Name -> why this motion can't determine the parameter, whatever was seen.

        Raises:
            BadInput: the steering was turned and constant, so its gain and its offset are one.
        """
        steered = self.varied_rad >= _VARIED_RAD
        aside = abs(self.steering_rad) >= _ASIDE_RAD
        if aside and not steered and not {"steering_gain", "steering_offset_rad"} & set(fixed):
            problem = (
                f"the steering stood at {self.steering_rad:.2f} rad all the time, where its gain "
                "and its offset are one: drive eights, to both sides, or give --fix "
                "steering_offset_rad"
            )
            raise BadInput(where, problem)
        reasons = {}
        if not steered and not aside:
            reasons["steering_gain"] = STEERED_LITTLE
            reasons["wheelbase_m"] = _TURNED_LITTLE
        if not steered and self.varied_mps < max(_VARIED_MPS, _VARIED_SHARE * self.speed_mps):
            reasons["camera_delay_s"] = _CHANGED_LITTLE
        return {name: why for name, why in reasons.items() if name not in fixed}
