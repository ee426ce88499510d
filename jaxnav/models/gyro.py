"""A gyroscope: what it gets wrong, and typical figures of two classes.

    z = (1 + e) w(t - delay) + b + white noise,    b' = white noise

Source: IEEE Std 952 (1997), annex C (angle random walk N and rate random walk K).
"""

import math

import equinox as eqx
from jaxtyping import Array, Float


class Gyro(eqx.Module):
    """Errors of a gyroscope about one axis, for a filter and for a simulation."""

    noise_density: Float[Array, ""] | float  # N: rad/s/sqrt(Hz)
    bias_sigma_radps: Float[Array, ""] | float  # of the bias before anything has told it
    bias_walk: Float[Array, ""] | float  # K: random walk of the bias, rad/s/sqrt(s)
    saturation_radps: Float[Array, ""] | float  # a reading at the limit or beyond it is none
    scale_sigma: Float[Array, ""] | float = 0.0  # of the error e of its scale
    delay_s: Float[Array, ""] | float = 0.0  # how much older than its stamp a reading is
    delay_sigma_s: Float[Array, ""] | float = 0.0  # of what is left of the delay


def _in_degrees(
    noise: float, bias: float, limit: float, walk: float, scale: float, late_s: float
) -> Gyro:
    """A gyro whose first three figures are deg/s/sqrt(Hz), deg/s and deg/s."""
    noise, bias, limit = (math.radians(x) for x in (noise, bias, limit))
    return Gyro(noise, bias, walk, limit, scale, delay_sigma_s=late_s)


# Noise density, zero-rate offset, range and tolerance of the sensitivity are the typical figures of
# the data sheets: Bosch BMI088 (BST-BMI088-DS001), Analog Devices ADIS16470. The walks are above
# what an Allan plot shows, as filters need them: 1.9e-5 is what EuRoC's rig gives for an ADIS16448
# (Burri et al., 2016). What is left of the delay is that of a bus that a host polls, and of a
# sensor that stamps its own samples.
GYROS = {
    "consumer": _in_degrees(0.014, 1.0, 2000.0, walk=2e-5, scale=0.01, late_s=5e-3),
    "tactical": _in_degrees(0.008, 0.2, 2000.0, walk=4e-6, scale=0.003, late_s=1e-3),
}
