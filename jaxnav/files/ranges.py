"""Ranges of the numbers in files, from the least to the most that a vehicle can have.

One table serves all formats, ours and others'; `docs/ranges.md` shows it to users. The ranges are
wide on purpose: they refuse slips of the pen and of the unit, and numbers that arithmetic can't
take, but no real car.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool
from pydantic import AfterValidator

REFUSED = "refused"
_ROUNDING = 1e-6  # relative

LEFT_OUT = "left out, and counted"
CARRIED = "kept as it came"


@dataclass(frozen=True)
class Range:
    """The allowed range of one quantity.

    Attributes:
        least, most: both are allowed.
        unit: empty for a pure number.
        what: the quantity, and where the bounds come from.
        outside: how a number outside the bounds is treated.
    """

    least: float
    most: float
    unit: str
    what: str
    outside: str = REFUSED

    def holds(self, values: Any) -> Any:
        """Which of these numbers are in the range; NaN and infinities are not. A margin allows for
        bounds that float32 has rounded."""
        if isinstance(self.least, int):
            return (values >= self.least) & (values <= self.most)
        least = self.least - _ROUNDING * abs(self.least)
        return (values >= least) & (values <= self.most + _ROUNDING * abs(self.most))


RANGES: dict[str, Range] = {
    # Cameras.
    "image_px": Range(1.0, 65536.0, "px", "width and height of an image: what JPEG can hold"),
    "focal": Range(
        1e-3, 1e3, "larger sides of the image", "focal length: 0.3 sees 180 deg, 1000 sees 0.06"
    ),
    "center": Range(
        -1.0, 2.0, "sides of the image", "principal point: at most one image beside it"
    ),
    "distortion": Range(-1e6, 1e6, "", "coefficient of a lens: k3 of a long lens is some 1e5"),
    "mount_m": Range(0.0, 1e3, "m", "how far a camera is from its vehicle's origin"),
    "baseline_m": Range(0.0, 2e3, "m", "how far a camera is from the one before it"),
    # Markers and places.
    "size_m": Range(1e-3, 100.0, "m", "side of a marker, of a board's square or tag"),
    "spacing": Range(1e-2, 10.0, "sides", "gap between the tags of a board"),
    "position_m": Range(-1e8, 1e8, "m", "place in the world: UTM's northings end at 1e7"),
    "angle_deg": Range(-3600.0, 3600.0, "deg", "angle: ten turns"),
    "angle_rad": Range(-63.0, 63.0, "rad", "angle: ten turns"),
    "radius_m": Range(1e-3, 1e5, "m", "how near a waypoint is passed, how far a route left"),
    # Vehicles.
    "wheelbase_m": Range(1e-2, 100.0, "m", "wheelbase: a toy's to a mining truck's"),
    "steering_limit_rad": Range(1e-3, math.pi / 2, "rad", "steering limit: below a right angle"),
    "steering_rate_radps": Range(1e-3, 1e3, "rad/s", "how fast the wheels are turned"),
    "throttle": Range(1e-6, 1e6, "driver's unit", "throttle limit: PWM duty, us or counts"),
    "speed_per_throttle_mps": Range(1e-6, 1e6, "m/s", "speed at throttle 1"),
    "time_constant_s": Range(1e-4, 1e3, "s", "time constant of the speed"),
    "base_speed_mps": Range(1e-3, 1e3, "m/s", "speed limit of a base that is no car"),
    "turn_limit_radps": Range(1e-3, 1e3, "rad/s", "turn limit of a base, range of a gyro"),
    "gyro_noise": Range(1e-9, 1.0, "rad/s/sqrt(Hz)", "noise density of a gyro"),
    "gyro_bias_radps": Range(1e-9, 10.0, "rad/s", "standard deviation of a gyro's bias"),
    "gyro_walk": Range(1e-12, 1.0, "rad/s/sqrt(s)", "random walk of a gyro's bias"),
    "gain": Range(0.1, 10.0, "", "scale of speed and steering readings"),
    "offset_rad": Range(-0.5, 0.5, "rad", "offset of the steering"),
    "delay_s": Range(-0.5, 0.5, "s", "delay of the cameras behind the odometer"),
    "exposure_s": Range(1e-7, 0.1, "s", "exposure of a camera's rows"),
    "row_time_s": Range(0.0, 1e-3, "s", "time from a row's exposure to the next one's"),
    "imu_noise": Range(0.0, 100.0, "SI", "noise, random walk and bias of an IMU"),
    "imu_range": Range(0.1, 1e6, "rad/s, m/s^2", "largest reading of an IMU"),
    # Noise and tuning.
    "corner_sigma_px": Range(1e-3, 100.0, "px", "standard deviation of a corner, of a whole file"),
    "sigma": Range(-1e9, 1e9, "", "standard deviation that a calibration tells; only shown"),
    "parameter": Range(1e-18, 1e9, "", "tuned parameter: float32 holds its square"),
    # Values of sensors, which a recording keeps because it must replay bit for bit.
    "stamp_ns": Range(
        -(2**62) + 1, 2**62 - 1, "ns", "stamp: 146 years, so that int64 holds differences"
    ),
    "index": Range(-1, 2**31, "", "number of a camera, of a hypothesis; of a camera, below theirs"),
    "id": Range(-(2**63), 2**63 - 1, "", "of a marker seen: int64; of a map, below its family's"),
    "corner_px": Range(-1e6, 1e6, "px", "corner of a marker seen", LEFT_OUT),
    "seen_sigma_px": Range(1e-6, 1e3, "px", "standard deviation of a corner seen", LEFT_OUT),
    "speed_mps": Range(-1e3, 1e3, "m/s", "speed read", LEFT_OUT),
    "steering_rad": Range(-63.0, 63.0, "rad", "steering angle read", LEFT_OUT),
    "turn_radps": Range(-1e3, 1e3, "rad/s", "turn rate read", LEFT_OUT),
    "pose": Range(-1e9, 1e9, "m, rad", "pose that a pilot reported", LEFT_OUT),
    "reported": Range(
        -math.inf, math.inf, "", "probability, covariance, cost that a pilot reported", CARRIED
    ),
}


def problem_of(name: str, value: float) -> str | None:
    """What is wrong with a number; None where it is in the range. NaN and infinities never are.

    Args:
        name: of a quantity in `RANGES`.
    """
    return None if RANGES[name].holds(value) else outside(RANGES[name], value)


def outside(allowed: Range, value: float) -> str:
    """The message that a number is out of a range."""
    got = f"{value:.6g}" if isinstance(value, float) else str(value)
    unit = f" {allowed.unit}" if allowed.unit else ""
    got = got if len(got) <= 40 else f"{got[:37]}..."
    return f"must be from {allowed.least:.9g} to {allowed.most:.9g}{unit}, got {got}"


def is_within(name: str, values: Any) -> Bool[np.ndarray, "..."]:
    """Which of an array's numbers are in the range; NaN and infinities are not."""
    inside: np.ndarray = np.asarray(RANGES[name].holds(np.asarray(values)))
    return inside


def within(name: str) -> AfterValidator:
    """A validator for the range of a field of a pydantic model."""

    def check(value: Any) -> Any:
        if problem := problem_of(name, value):
            raise ValueError(problem)
        return value

    return AfterValidator(check)


def placed_within(name: str) -> AfterValidator:
    """A validator for the range of a place: x y z, a 4x4 as rows, or a pose that has `xyz_m`.

    For a quantity whose least is 0 it checks the distance from the origin, else every axis.
    """

    def check(place: Any) -> Any:
        if not isinstance(place, list):
            xyz_m = place.xyz_m
        else:
            xyz_m = [row[3] for row in place[:3]] if len(place) == 4 else place
        is_distance = RANGES[name].least == 0
        for value in [math.hypot(*xyz_m)] if is_distance else xyz_m:
            if problem := problem_of(name, value):
                raise ValueError(f"{'the distance' if is_distance else 'the place'} {problem}")
        return place

    return AfterValidator(check)


def pinhole_problem(pinhole_px: Sequence[float], image_size_px: Sequence[float]) -> str | None:
    """What is wrong with a pinhole for images of a size, the quantity first; None where nothing is.

    Args:
        pinhole_px: fx, fy, cx, cy.
        image_size_px: width, height.
    """
    width, height = image_size_px
    longer = max(width, height)
    for value, name, side, what in zip(
        pinhole_px,
        ("focal", "focal", "center", "center"),
        (longer, longer, width, height),
        ("focal length fx", "focal length fy", "principal point's cx", "principal point's cy"),
        strict=True,
    ):
        least, most = RANGES[name].least * side, RANGES[name].most * side
        allowed = Range(least, most, "px", RANGES[name].what)
        if not allowed.holds(value):
            problem = outside(allowed, float(value))
            return f"the {what} {problem} for images of {width:g} x {height:g} px"
    return None
