"""What a vehicle file says of a base that is no car, and of a gyro.

base: differential                     gyro:
forward_limit_mps: 1.0                   class: consumer
turn_limit_radps: 3.0                    delay_s: 0.004
time_constant_s: 0.15

`base` is differential or tracks; or omni, mecanum or swerve, which need a `left_limit_mps` as well.
`sigma` says how well its odometry is known, by the names of `TWIST_ERRORS`; left out it is 3 % of
the way, 5 % of the effective track width, 0.03 rad a metre of unequal wheels, and 20 ms between
cameras and odometer. Four zeros make it exact.

A gyro is that of its class, consumer where none is given, but for the figures that follow.
"""

import dataclasses
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, field_validator, model_validator

from jaxnav.core.models.imu import GYROS, Gyro
from jaxnav.core.models.vehicle import DEFAULT_TWIST_SIGMA, TWIST_ERRORS, TwistBase
from jaxnav.core.parameters import TUNABLES
from jaxnav.files.ranges import within
from jaxnav.files.validation import Entry, NonNegative, Number, Positive

ACKERMANN = "ackermann"
_MOST_SIGMA = TUNABLES["motion.vehicle.sensor_sigma"].most


class GyroEntry(Entry):
    """A gyro: its class, and what is known better."""

    class_: Annotated[Literal["consumer", "tactical"], Field(alias="class")] = "consumer"
    noise_density: Annotated[Positive, within("gyro_noise")] | None = None  # rad/s/sqrt(Hz)
    bias_sigma_radps: Annotated[Positive, within("gyro_bias_radps")] | None = None
    bias_walk: Annotated[Positive, within("gyro_walk")] | None = None  # rad/s/sqrt(s)
    saturation_radps: Annotated[Positive, within("turn_limit_radps")] | None = None
    scale_sigma: Annotated[NonNegative, Field(le=0.5)] | None = None
    delay_s: Annotated[Number, within("delay_s")] | None = None
    delay_sigma_s: Annotated[NonNegative, Field(le=0.5)] | None = None

    def gyro(self) -> Gyro:
        """The gyro."""
        return dataclasses.replace(
            GYROS[self.class_], **self.model_dump(exclude={"class_"}, exclude_none=True)
        )


class BaseFile(Entry):
    """A vehicle file of a base that is driven by a twist."""

    base: Literal["differential", "tracks", "omni", "mecanum", "swerve"]
    forward_limit_mps: Annotated[Positive, within("base_speed_mps")]
    left_limit_mps: Annotated[Positive, within("base_speed_mps")] | None = None
    turn_limit_radps: Annotated[Positive, within("turn_limit_radps")]
    time_constant_s: Annotated[Positive, within("time_constant_s")]
    sigma: dict[str, NonNegative] = Field(default_factory=dict)
    gyro: GyroEntry | None = None
    resume: bool = False

    @field_validator("sigma")
    @classmethod
    def _of_known_errors(cls, sigma: dict[str, float]) -> dict[str, float]:
        for name, value in sigma.items():
            if name not in TWIST_ERRORS:
                raise ValueError(f"unknown {name}: expected {', '.join(TWIST_ERRORS)}")
            most = _MOST_SIGMA[TWIST_ERRORS.index(name)]
            if value > most:
                raise ValueError(f"{name} must be at most {most:g}, got {value:g}")
        return sigma

    @model_validator(mode="after")
    def _moves_as_it_can(self) -> Self:
        turns_alone = self.base in ("differential", "tracks")
        if turns_alone and self.left_limit_mps is not None:
            raise ValueError(f"base {self.base} can't move to its left: leave out left_limit_mps")
        if not turns_alone and self.left_limit_mps is None:
            raise ValueError(f"base {self.base} needs left_limit_mps")
        return self

    def vehicle(self) -> TwistBase:
        """The base, in the process's precision."""
        defaults = zip(TWIST_ERRORS, DEFAULT_TWIST_SIGMA, strict=True)
        sigma = np.asarray([self.sigma.get(name, default) for name, default in defaults])
        return TwistBase.create(
            self.forward_limit_mps,
            self.turn_limit_radps,
            self.time_constant_s,
            self.left_limit_mps or 0.0,
            sigma if np.any(sigma) else None,
            None if self.gyro is None else self.gyro.gyro(),
        )


def base_data(base: TwistBase) -> dict[str, Any]:
    """The content of a base's file, all numbers bit for bit."""
    left_limit_mps = float(base.left_limit_mps)
    sigma = np.zeros(4) if base.sensor_sigma is None else np.asarray(base.sensor_sigma, float)
    data: dict[str, Any] = {
        "base": "omni" if left_limit_mps else "differential",
        "forward_limit_mps": float(base.forward_limit_mps),
        "turn_limit_radps": float(base.turn_limit_radps),
        "time_constant_s": float(base.time_constant_s),
        "sigma": dict(zip(TWIST_ERRORS, sigma.tolist(), strict=True)),
    }
    if left_limit_mps:
        data["left_limit_mps"] = left_limit_mps
    return data | gyro_data(base.gyro)


def gyro_data(gyro: Gyro | None) -> dict[str, Any]:
    """The block of a vehicle's file about its gyro; nothing without one."""
    if gyro is None:
        return {}
    figures = {field.name: float(getattr(gyro, field.name)) for field in dataclasses.fields(gyro)}
    return {"gyro": figures}
