"""Bases other than the QCar, of its size, to simulate by name, and the gyros that they may have."""

import equinox as eqx

from jaxnav.core.models.imu import GYROS
from jaxnav.core.models.vehicle import DEFAULT_TWIST_SIGMA, TwistBase, Vehicle

BASES = ("ackermann", "differential", "omni")
IMUS = ("none", *GYROS)


def equipped(vehicle: Vehicle | TwistBase, base: str, imu: str) -> Vehicle | TwistBase:
    """The vehicle, or the base of that name in its place, with a gyro of that name.

    Args:
        base: one of `BASES`; "ackermann" is the vehicle itself.
        imu: one of `IMUS`; "none" leaves the vehicle the gyro that it has.
    """
    if base != "ackermann":
        left_limit_mps = 1.0 if base == "omni" else 0.0
        # It turns a little faster than once a second, as the scenario `gyro-late` asks.
        vehicle = TwistBase.create(
            1.0, 7.0, 0.15, left_limit_mps, sensor_sigma=DEFAULT_TWIST_SIGMA, gyro=vehicle.gyro
        )
    if imu == "none":
        return vehicle
    with_gyro: Vehicle | TwistBase = eqx.tree_at(
        lambda v: v.gyro, vehicle, GYROS[imu], is_leaf=lambda leaf: leaf is None
    )
    return with_gyro
