"""A gyro in the planar filter: it tells the turn of an interval, and its bias is the last state.

    psi += dt r + delay (r - psi_dot),    psi_dot = r,    r = z - b

The wheels read the velocity at the end of an interval, and a turn rate that slips with them; the
gyro reads the whole turn. So where it has told, the wheels' turn rate is not looked at, and between
them only one thing is compared: while the wheels stand, z is the bias. That holds whichever pose
is the true one, so it teaches every hypothesis. Corners teach the bias as they do the errors of the
other sensors, once the heading is known: a mirrored pose would learn the bias that fits it.

What the delay is off by moves the heading where the rate changes; an error of the scale grows with
the turn, and as a random walk is right at 1 rad.

Source: Titterton, Weston (2004), "Strapdown Inertial Navigation Technology", chapters 12 and 13
(errors as states; zero-velocity updates); Schmidt (1966) for errors that are only considered.
"""

from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.belief import kalman
from jaxnav.belief.sensor_errors import SIX
from jaxnav.models.gyro import Gyro
from jaxnav.pose.observation import Observation

_TURNS = np.array([2, 5])  # heading and turn rate in the state
# Below these the wheels stand: above the noise of an odometer, below what a wheel creeps at.
_STANDS_MPS, _STANDS_RADPS = 0.03, 0.05
_STEADY_RADPS = 0.005  # a rate that changes by less, and its noise, does not


class Turn(NamedTuple):
    """What a gyro says of an interval dt: heading and turn rate at its end."""

    told: Bool[Array, ""]
    psi_rad: Float[Array, ""]
    rate_radps: Float[Array, ""]
    changed_radps: Float[Array, ""]  # the rate, since the state before
    slopes: Float[Array, "2 n"]  # of heading and rate by the state before
    noise: Float[Array, "2 2"]


def turn_of(
    gyro: Gyro,
    obs: Observation,
    mean: Float[Array, " n"],
    acceleration_density: Float[Array, ""],
) -> Turn:
    """The turn that a gyro tells.

    Args:
        mean: of the state before, the gyro's bias last.
        acceleration_density: of the turn, (rad/s^2)^2/Hz: a rate at the end is not its mean.
    """
    dtype, dt_s = mean.dtype, jnp.asarray(obs.dt_s, mean.dtype)
    read = jnp.asarray(jnp.nan if obs.gyro_radps is None else obs.gyro_radps[2], dtype)
    told = (jnp.abs(read) < gyro.saturation_radps) & (dt_s > 0)
    dt_s = jnp.where(told, dt_s, 1)
    delay_s, white = jnp.asarray(gyro.delay_s, dtype), jnp.asarray(gyro.noise_density, dtype) ** 2
    rate = jnp.where(told, read, 0) - mean[-1]
    changed = rate - mean[5]
    slopes = jnp.zeros((2, mean.shape[0]), dtype).at[0, 2].set(1).at[0, 5].set(-delay_s)
    slopes = slopes.at[0, -1].set(-dt_s - delay_s).at[1, -1].set(-1)
    angle_rad = jnp.abs(rate) * dt_s
    of_angle = white * dt_s + (gyro.delay_sigma_s * changed) ** 2 + gyro.scale_sigma**2 * angle_rad
    of_rate = white / dt_s + acceleration_density * dt_s / 3 + changed**2 / 4
    noise = jnp.stack([jnp.stack([of_angle, white]), jnp.stack([white, of_rate])])
    psi = mean[2] + dt_s * rate + delay_s * changed
    return Turn(told, psi, rate, changed, slopes, noise.astype(dtype))


def with_turn(
    turn: Turn, A: Float[Array, "3 n"], Q: Float[Array, "6 6"]
) -> tuple[Float[Array, "6 n"], Float[Array, "6 6"]]:
    """The rows of Eq. 9 for pose and velocity, and their noise, with the turn that was told.

    Args:
        A: the rows of the pose without a gyro.
        Q: noise of pose and velocity without it.
    """
    of_turn = jnp.zeros(SIX, bool).at[_TURNS].set(turn.told)
    rows = jnp.eye(SIX, A.shape[1], dtype=A.dtype).at[:3].set(A)
    rows = jnp.where(of_turn[:, None], jnp.zeros_like(rows).at[_TURNS].set(turn.slopes), rows)
    noise = jnp.zeros_like(Q).at[_TURNS[:, None], _TURNS].set(turn.noise)
    return rows, jnp.where(of_turn[:, None] | of_turn[None], noise, Q)


def bias_at_rest(
    gyro: Gyro,
    turn: Turn,
    before_mps: Float[Array, " 2"],
    wheels: Float[Array, " 3"],
    wheels_sigma_radps: Float[Array, ""],
    dt_s: Float[Array, ""],
    mean: Float[Array, " n"],
    P: Float[Array, "n n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The state after a gyro was compared with wheels that stand, if they do.

    The other errors behind pose and velocity keep their mean and covariance.

    Args:
        before_mps: the velocity before the interval.
        wheels: v_x, v_y, omega that the wheels read now; NaN where they read nothing.
        wheels_sigma_radps: noise of the wheels' turn rate.
    """
    slow = jnp.sum(before_mps**2) < _STANDS_MPS**2
    slow = slow & (jnp.sum(wheels[:2] ** 2) < _STANDS_MPS**2) & (jnp.abs(wheels[2]) < _STANDS_RADPS)
    white = jnp.asarray(gyro.noise_density, mean.dtype) ** 2 / jnp.where(turn.told, dt_s, 1)
    steady = jnp.abs(turn.changed_radps) < _STEADY_RADPS + 4 * jnp.sqrt(white)
    stands = (turn.told & slow & steady).astype(mean.dtype)
    wheels_radps = jnp.where(jnp.isfinite(wheels[2]), wheels[2], 0)
    H = jnp.zeros((1, mean.shape[0]), mean.dtype).at[0, -1].set(1)
    R = (wheels_sigma_radps**2 + white)[None, None]
    seen = kalman.hide_rows((turn.rate_radps - wheels_radps)[None], H, R, stands[None])
    correction, after, _ = kalman.update(P, *seen)
    kept = slice(SIX, -1)
    return mean + correction.at[kept].set(0), after.at[kept, kept].set(P[kept, kept])
