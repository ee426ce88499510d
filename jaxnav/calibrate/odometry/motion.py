"""Statistics of a car's motion in a drive, which decide which parameters it can determine."""

from collections.abc import Sequence

import numpy as np

from jaxnav.calibrate.odometry.drive import Intervals, ReadingSigma
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


def cannot_tell(
    intervals: Intervals, sigma: ReadingSigma, where: str, fixed: Sequence[str]
) -> tuple[dict[str, str], float]:
    """Name -> why this motion can't determine the parameter, whatever was seen.

    Mean and spread of speed and steering, the latter weighted by distance, are those of means of
    blocks of readings, which have little noise; what noise they have is subtracted.

    Returns:
        The reasons, and the mean steering, rad.

    Raises:
        BadInput: the steering was turned and constant, so its gain and its offset are one.
    """
    speed, size = _means(intervals, intervals.speed_mps)
    steering, _ = _means(intervals, intervals.steering_rad)
    weight = np.abs(speed) / np.sum(np.abs(speed))

    def beyond_noise(variance: float, noise: float) -> float:
        return float(np.sqrt(max(variance - noise**2 / size, 0.0)))

    steering_rad = float(weight @ steering)
    varied_mps = beyond_noise(float(np.var(speed)), sigma.speed_mps)
    varied_rad = beyond_noise(float(weight @ (steering - steering_rad) ** 2), sigma.steering_rad)
    steered = varied_rad >= _VARIED_RAD
    aside = abs(steering_rad) >= _ASIDE_RAD
    if aside and not steered and not {"steering_gain", "steering_offset_rad"} & set(fixed):
        problem = (
            f"the steering stood at {steering_rad:.2f} rad all the time, where its gain "
            "and its offset are one: drive eights, to both sides, or give --fix "
            "steering_offset_rad"
        )
        raise BadInput(where, problem)
    reasons = {}
    if not steered and not aside:
        reasons["steering_gain"] = STEERED_LITTLE
        reasons["wheelbase_m"] = _TURNED_LITTLE
    speed_mps = float(np.mean(np.abs(speed)))
    if not steered and varied_mps < max(_VARIED_MPS, _VARIED_SHARE * speed_mps):
        reasons["camera_delay_s"] = _CHANGED_LITTLE
    return {name: why for name, why in reasons.items() if name not in fixed}, steering_rad
