"""Conversion of sensor_msgs/Imu into samples, without ROS."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from jaxnav.core.models.imu import ImuSamples
from jaxnav.files.topics import ImuEntry


def row(message: Any) -> tuple[float, ...]:
    """Turn rate, rad/s, and specific force, m/s^2, of a message; orientation is not looked at."""
    w, a = message.angular_velocity, message.linear_acceleration
    return float(w.x), float(w.y), float(w.z), float(a.x), float(a.y), float(a.z)


def samples(
    entry: ImuEntry, stamps_ns: Sequence[int], rows: Sequence[tuple[float, ...]]
) -> ImuSamples:
    """The samples of a topic, in the order of their stamps; of one stamp the first is taken.

    Args:
        entry: where the IMU is, and how good.
        stamps_ns: of the messages' headers.
        rows: of `row`.
    """
    stamps, first = np.unique(np.asarray(stamps_ns, np.int64), return_index=True)
    values = np.asarray(rows, float).reshape(-1, 6)[first]
    return ImuSamples(
        stamps_ns=stamps,
        gyro_radps=values[:, :3],
        accel_mps2=values[:, 3:],
        T_vehicle_imu=entry.T_matrix(),
        noise=entry.noise(),
        delay_s=entry.imu_delay_s,
        max_gyro_radps=entry.max_gyro_radps,
        max_accel_mps2=entry.max_accel_mps2,
        level=entry.level,
    )
