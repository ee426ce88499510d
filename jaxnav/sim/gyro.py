"""Simulate a gyroscope: what it reads of a turn, with the errors that its vehicle tells of."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Key

from jaxnav.core.models.imu import Gyro


class GyroState(eqx.Module):
    """The errors of the gyro of one drive."""

    bias_radps: Float[Array, ""]
    scale: Float[Array, ""]  # rate read over true rate
    late_s: Float[Array, ""]
    lag_rad: Float[Array, ""]  # turned, and not read yet


def switched_on(
    gyro: Gyro, later_s: float, longest_s: float, key: Key[Array, ""], dtype: jnp.dtype
) -> GyroState:
    """A gyro whose errors are drawn as it tells of them.

    Args:
        later_s: how much later than that its readings are.
        longest_s: upper limit of the delay, the frame period.
    """
    bias, scale, late = jax.random.normal(key, (3,), dtype)
    late_s = gyro.delay_s + later_s + gyro.delay_sigma_s * late
    return GyroState(
        jnp.asarray(gyro.bias_sigma_radps * bias, dtype),
        jnp.asarray(1 + gyro.scale_sigma * scale, dtype),
        jnp.asarray(jnp.clip(late_s, 0, longest_s), dtype),
        jnp.zeros((), dtype),
    )


def read_gyro(
    gyro: Gyro,
    state: GyroState,
    turned_rad: Float[Array, ""],
    dt_s: Float[Array, ""],
    key: Key[Array, ""],
) -> tuple[GyroState, Float[Array, " 3"]]:
    """The state after an interval, and the mean angular velocity that is read of it, (3,).

    Args:
        turned_rad: heading at its end less that at its begin, between them at a constant rate.
        dt_s: 0 for the first frame, of which nothing is read.
    """
    reads = dt_s > 0
    dt_s = jnp.where(reads, dt_s, 1)
    lag_rad = state.late_s / dt_s * turned_rad
    white, walk = jax.random.normal(key, (2,), turned_rad.dtype)
    rate = state.scale * (turned_rad - lag_rad + state.lag_rad) / dt_s
    rate = rate + state.bias_radps + gyro.noise_density / jnp.sqrt(dt_s) * white
    rate = jnp.clip(rate, -gyro.saturation_radps, gyro.saturation_radps)
    walked = state.bias_radps + gyro.bias_walk * jnp.sqrt(dt_s) * walk
    after = GyroState(walked, state.scale, state.late_s, lag_rad)
    after = jax.tree.map(lambda new, old: jnp.where(reads, new, old), after, state)
    z = jnp.where(reads, rate, jnp.nan)
    return after, jnp.stack([jnp.zeros_like(z), jnp.zeros_like(z), z])
