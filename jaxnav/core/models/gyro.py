"""A gyroscope: what it gets wrong; the figures of two classes are in `imu_classes.py`.

    z = (1 + e) w(t - delay) + b + white noise,    b' = white noise

Source: IEEE Std 952 (1997), annex C (angle random walk N and rate random walk K).
"""

import equinox as eqx
from jaxtyping import Array, Float

from jaxnav.core.models.imu_classes import IMU_CLASSES


class Gyro(eqx.Module):
    """Errors of a gyroscope about one axis, for a filter and for a simulation."""

    noise_density: Float[Array, ""] | float  # N: rad/s/sqrt(Hz)
    bias_sigma_radps: Float[Array, ""] | float  # of the bias before anything has told it
    bias_walk: Float[Array, ""] | float  # K: random walk of the bias, rad/s/sqrt(s)
    saturation_radps: Float[Array, ""] | float  # a reading at the limit or beyond it is none
    scale_sigma: Float[Array, ""] | float = 0.0  # of the error e of its scale
    delay_s: Float[Array, ""] | float = 0.0  # how much older than its stamp a reading is
    delay_sigma_s: Float[Array, ""] | float = 0.0  # of what is left of the delay


GYROS = {
    name: Gyro(
        figures.gyro_noise,
        figures.gyro_offset_radps,
        figures.gyro_walk,
        figures.gyro_range_radps,
        figures.gyro_scale,
        delay_sigma_s=figures.gyro_late_s,
    )
    for name, figures in IMU_CLASSES.items()
}
