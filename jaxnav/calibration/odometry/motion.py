"""What a car did while it was observed, as far as that decides which figures can be told."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from jaxnav.calibration.odometry.drive import Intervals, ReadingSigma
from jaxnav.errors import BadInput

_VARIED_RAD, _VARIED_MPS = 0.03, 0.03  # below, noise could pass for steering or driving
_VARIED_SHARE = 0.2  # of the speed: setting off once tells little of the delay
_ASIDE_RAD = 0.05  # about a steering so far from straight, gain and offset are one
_BLOCK = 15  # readings whose mean tells what the car did, some 0.3 s

STEERED_LITTLE = (
    "the steering hardly changed while the car moved: drive eights, at full lock both ways, to "
    "find it"
)
_TURNED_LITTLE = "the car hardly turned: drive circles at full lock both ways to find it"
_CHANGED_LITTLE = "neither speed nor steering changed: stop and start, or drive eights, to find it"


def _means(intervals: Intervals, values: np.ndarray) -> tuple[np.ndarray, int]:
    """Of blocks of readings, and how many are in each."""
    linked = values[intervals.linked > 0]
    size = min(_BLOCK, len(linked))
    return linked[: len(linked) // size * size].reshape(-1, size).mean(axis=1), size


def driven_m(intervals: Intervals) -> float:
    """The way by the odometry, without what its noise alone would add."""
    speed_mps, size = _means(intervals, intervals.speed_mps)
    dt_s, _ = _means(intervals, intervals.dt_s)
    return float(np.sum(np.abs(speed_mps) * dt_s * size))


@dataclass(frozen=True)
class Motion:
    """What the car did, the noise of its sensors taken off: noise is no motion.

    Attributes:
        speed_mps: mean.
        varied_mps: standard deviation.
        steering_rad: mean, along the way.
        varied_rad: standard deviation, along the way.
    """

    speed_mps: float
    varied_mps: float
    steering_rad: float
    varied_rad: float

    @staticmethod
    def of(intervals: Intervals, sigma: ReadingSigma) -> "Motion":
        """Of blocks of readings, whose means have little noise."""
        speed, size = _means(intervals, intervals.speed_mps)
        steering, _ = _means(intervals, intervals.steering_rad)
        weight = np.abs(speed) / np.sum(np.abs(speed))

        def beyond_noise(variance: float, noise: float) -> float:
            return float(np.sqrt(max(variance - noise**2 / size, 0.0)))

        middle = float(weight @ steering)
        return Motion(
            float(np.mean(np.abs(speed))),
            beyond_noise(float(np.var(speed)), sigma.speed_mps),
            middle,
            beyond_noise(float(weight @ (steering - middle) ** 2), sigma.steering_rad),
        )

    def cannot_tell(self, where: str, fixed: Sequence[str]) -> dict[str, str]:
        """What such driving does not tell, whatever was seen, and why.

        Raises:
            BadInput: the steering stood aside, so that every figure of it hangs on the others.
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
        found = {}
        if not steered and not aside:
            found["steering_gain"] = STEERED_LITTLE
            found["wheelbase_m"] = _TURNED_LITTLE
        if not steered and self.varied_mps < max(_VARIED_MPS, _VARIED_SHARE * self.speed_mps):
            found["camera_delay_s"] = _CHANGED_LITTLE
        return {name: why for name, why in found.items() if name not in fixed}
