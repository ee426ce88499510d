"""Clamp commands to the limits of the vehicle, whatever was computed.

A command is a tuple of numbers: a car's steering_rad and throttle, of another base forward_mps,
left_mps and turn_radps.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the guard's process knows a vehicle's numbers without JAX
    from typing_extensions import TypeIs

    from jaxnav.core.models.vehicle import TwistBase, Vehicle

Command = tuple[float, ...]


@dataclass(frozen=True)
class Limits:
    """The limits of one car's commands."""

    steering_rad: float
    steering_rate_radps: float
    throttle: float

    @staticmethod
    def from_vehicle(vehicle: Vehicle) -> Limits:
        """The limits in a car's description."""
        return Limits(
            float(vehicle.steering_limit_rad),
            float(vehicle.steering_rate_limit_radps),
            float(vehicle.throttle_limit),
        )

    @property
    def zero(self) -> Command:
        """The command of a vehicle that has never moved."""
        return 0.0, 0.0

    def within(self, command: Command, before: Command, elapsed_s: float) -> Command:
        """The command inside the limits.

        One that is not finite gives zero throttle; such steering keeps its last value.

        Args:
            before: the last command.
            elapsed_s: time since then; 0 replaces a value that is not positive and finite.
        """
        steering_rad, throttle = command
        last = _clamped(before[0], self.steering_rad, 0.0)
        steering = _clamped(steering_rad, self.steering_rad, last)
        elapsed_s = elapsed_s if math.isfinite(elapsed_s) and elapsed_s > 0 else 0.0
        step = min(self.steering_rate_radps * elapsed_s, 2 * self.steering_rad)
        steering = min(max(steering, last - step), last + step)
        drives = math.isfinite(steering_rad) and math.isfinite(throttle)
        return steering, _clamped(throttle, self.throttle, 0.0) if drives else 0.0

    def slowed(self, command: Command, factor: float) -> Command:
        """The command at a share of its speed."""
        return command[0], command[1] * factor

    def standing(self, command: Command) -> Command:
        """The command of a vehicle that stands: a car keeps its wheels turned."""
        return command[0], 0.0


@dataclass(frozen=True)
class TwistLimits:
    """The limits of the commands of a base that is driven by a twist; methods as of `Limits`."""

    forward_mps: float
    left_mps: float
    turn_radps: float

    @staticmethod
    def from_base(base: TwistBase) -> TwistLimits:
        """The limits in a base's description."""
        return TwistLimits(
            float(base.forward_limit_mps), float(base.left_limit_mps), float(base.turn_limit_radps)
        )

    @property
    def zero(self) -> Command:
        """See `Limits`."""
        return 0.0, 0.0, 0.0

    def within(self, command: Command, before: Command, elapsed_s: float) -> Command:
        """See `Limits`: each part is cut at its limit; all stand where one is no number."""
        if not all(map(math.isfinite, command)):
            return self.zero
        most = self.forward_mps, self.left_mps, self.turn_radps
        return tuple(_clamped(*part, 0.0) for part in zip(command, most, strict=True))

    def slowed(self, command: Command, factor: float) -> Command:
        """See `Limits`."""
        return tuple(part * factor for part in command)

    def standing(self, command: Command) -> Command:
        """See `Limits`."""
        return self.zero


CommandLimits = Limits | TwistLimits


def turns_by_twist(vehicle: Vehicle | TwistBase) -> TypeIs[TwistBase]:
    """Whether a vehicle's description, or its plain numbers, are those of a `TwistBase`."""
    return "turn_limit_radps" in vars(vehicle)


def limits_of(vehicle: Vehicle | TwistBase) -> CommandLimits:
    """The limits in a vehicle's description."""
    return (
        TwistLimits.from_base(vehicle) if turns_by_twist(vehicle) else Limits.from_vehicle(vehicle)
    )


def _clamped(value: float, limit: float, instead: float) -> float:
    return min(max(value, -limit), limit) if math.isfinite(value) else instead
