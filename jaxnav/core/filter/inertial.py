"""A gyro in the planar filter: it tells the turn of an interval, and its errors are states.

    psi += dt r + (delay + d) (r - psi_dot),    psi_dot = r,    r = (1 - e) z - b

The errors of its scale e, of its delay d and its bias b stand at the end of the state. What of
scale and delay is not the same in every interval (a scale that depends on the rate, a bus that is
busy) is as large again, as noise: a random walk of the angle that is right at 1 rad, and a delay.

The wheels read the velocity at the end of an interval, and a turn rate that slips with them; the
gyro reads the whole turn. So where it has told, the wheels' turn rate moves nothing. The two are
compared twice, which teaches every hypothesis, since it holds whichever pose is the true one:
while the wheels stand, z is the bias; while they turn, they show what they get wrong. Corners teach
the bias as they do the errors of the other sensors, once the heading is known: a mirrored pose
would learn the bias that fits it.

Source: Titterton, Weston (2004), "Strapdown Inertial Navigation Technology", chapters 12 and 13
(errors as states; zero-velocity updates); Schmidt (1966) for errors that are only considered.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter import kalman
from jaxnav.core.filter.sensor_errors import SENSORS_END, SIX, SLIP, ReadVelocity
from jaxnav.core.linalg.small_matrices import matvec, sandwich
from jaxnav.core.models.geometry import planar_rotation, safe_sinc
from jaxnav.core.models.gyro import Gyro
from jaxnav.core.pose.observation import Observation

# Below these the wheels stand: above the noise of an odometer, below what a wheel creeps at.
_STANDS_MPS, _STANDS_RADPS = 0.03, 0.05
_TURNS_RADPS, _MOST_SLIP = 0.05, 0.5  # slower turns say nothing of a slip; a share of the speed
_STEADY_RADPS = 0.005  # a rate that changes by less, and its noise, does not
GYRO = 3  # states of a gyro, the last of all
_SCALE, _DELAY, _BIAS = -3, -2, -1


def gyro_variance(gyro: Gyro, dtype: jnp.dtype) -> Float[Array, " 3"]:
    """Variances of the errors of scale, delay (s^2) and bias, (rad/s)^2, that nothing has told."""
    sigmas = gyro.scale_sigma, gyro.delay_sigma_s, gyro.bias_sigma_radps
    return jnp.stack([jnp.asarray(sigma, dtype) ** 2 for sigma in sigmas])


class Turn(NamedTuple):
    """What a gyro says of an interval: the turn in it, and the turn rate at its end."""

    told: Bool[Array, ""]
    turn_rad: Float[Array, ""]
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
        mean: of the state before, the gyro's errors last.
        acceleration_density: of the turn, (rad/s^2)^2/Hz: a rate at the end is not its mean.
    """
    dtype, dt_s = mean.dtype, jnp.asarray(obs.dt_s, mean.dtype)
    read = jnp.asarray(jnp.nan if obs.gyro_radps is None else obs.gyro_radps[2], dtype)
    told = (jnp.abs(read) < gyro.saturation_radps) & (dt_s > 0)
    dt_s = jnp.where(told, dt_s, 1)
    white = jnp.asarray(gyro.noise_density, dtype) ** 2
    delay_s = jnp.asarray(gyro.delay_s, dtype) + mean[_DELAY]
    read = jnp.where(told, read, 0)
    rate = (1 - mean[_SCALE]) * read - mean[_BIAS]
    changed = rate - mean[5]
    by_rate = jnp.stack([dt_s + delay_s, jnp.ones_like(dt_s)])  # of heading and rate
    slopes = jnp.zeros((2, mean.shape[0]), dtype).at[0, 2].set(1).at[0, 5].set(-delay_s)
    slopes = slopes.at[:, _SCALE].set(-read * by_rate).at[:, _BIAS].set(-by_rate)
    slopes = slopes.at[0, _DELAY].set(changed)
    angle_rad = jnp.abs(rate) * dt_s
    of_angle = white * dt_s + (gyro.delay_sigma_s * changed) ** 2 + gyro.scale_sigma**2 * angle_rad
    of_rate = white / dt_s + acceleration_density * dt_s / 3 + changed**2 / 4
    noise = jnp.stack([jnp.stack([of_angle, white]), jnp.stack([white, of_rate])])
    turn_rad = dt_s * rate + delay_s * changed
    return Turn(told, turn_rad, rate, changed, slopes, noise.astype(dtype))


def turned(
    turn: Turn,
    mean: Float[Array, " n"],
    later: Float[Array, " 6"],
    A: Float[Array, "3 6"],
    Q: Float[Array, "6 6"],
    dt_s: Float[Array, ""],
) -> tuple[Float[Array, " 6"], Float[Array, "6 n"], Float[Array, "6 6"]]:
    """Pose and velocity after an interval (Eq. 9), their rows and their noise, with its turn.

    The velocity turns along. Left in the world it would lag behind the heading in every curve, and
    the wheels, which read it at the heading, would say that the vehicle has turned less.

    Args:
        mean: of the state before.
        later: pose and velocity after it without a gyro.
        A: the rows of the pose without a gyro, by pose and velocity.
        Q: the noise of pose and velocity without it.
    """
    eye = jnp.eye(SIX, mean.shape[0], dtype=mean.dtype)
    by_turn = turn.slopes[0] - eye[2]  # of the turn, by the state before
    half, whole = planar_rotation(turn.turn_rad / 2)[:2, :2], planar_rotation(turn.turn_rad)[:2, :2]
    chord_s = dt_s * safe_sinc(turn.turn_rad / 2)
    way_m, velocity = chord_s * matvec(half, mean[3:5]), matvec(whole, mean[3:5])
    way_by_turn, velocity_by_turn = _across(way_m) / 2, _across(velocity)
    place = eye[:2].at[:, 3:5].set(chord_s * half) + way_by_turn[:, None] * by_turn[None]
    moves = (
        jnp.zeros_like(eye[:2]).at[:, 3:5].set(whole) + velocity_by_turn[:, None] * by_turn[None]
    )
    rows = jnp.concatenate([place, turn.slopes[:1], moves, turn.slopes[1:]])
    zero, one = jnp.zeros((1,), mean.dtype), jnp.ones((1,), mean.dtype)
    of_turn = jnp.concatenate([way_by_turn, one, velocity_by_turn, zero])
    by_noise = jnp.stack([of_turn, eye[5, :SIX]], axis=1)
    linear = jnp.asarray([1, 1, 0, 1, 1, 0], mean.dtype)
    noise = Q * linear[:, None] * linear[None] + sandwich(by_noise, turn.noise)
    psi_rad = mean[2] + turn.turn_rad
    parts = (mean[:2] + way_m, psi_rad[None], velocity, turn.rate_radps[None])
    return (
        jnp.where(turn.told, jnp.concatenate(parts), later),
        jnp.where(turn.told, rows, eye.at[:3, :SIX].set(A)),
        jnp.where(turn.told, noise, Q),
    )


def _across(vector: Float[Array, " 2"]) -> Float[Array, " 2"]:
    """The derivative of a vector by its turn."""
    return jnp.stack([-vector[1], vector[0]])


def slip_of(
    turn: Turn,
    read: ReadVelocity,
    wheels_sigma_radps: Float[Array, ""],
    mean: Float[Array, " n"],
    P: Float[Array, "n n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The state after the wheels' turn rate was compared with the gyro's.

    It teaches the errors of the wheels, and nothing else. Where the two differ by more than those
    explain, the wheels slip: the variance of the slip grows by what is left.

    Args:
        read: by the wheels, at the state after the turn.
        wheels_sigma_radps: noise of the wheels' turn rate.
    """
    compared = turn.told & (read.present[2] > 0)
    H = jnp.zeros_like(mean).at[5].set(1).at[SIX:SENSORS_END].set(-read.by_errors[2])
    change, by_slip = read.velocity[2] - mean[5], read.by_errors[2, 0]
    S = jnp.sum(H * matvec(P, H)) + wheels_sigma_radps**2
    steep = jnp.abs(by_slip) > _TURNS_RADPS
    slips = jnp.maximum(change**2 - S, 0) / jnp.where(steep, by_slip, 1) ** 2
    slips = jnp.where(compared & steep, jnp.minimum(slips, _MOST_SLIP**2), 0)
    P, S = P.at[SLIP, SLIP].add(slips), S + slips * by_slip**2
    wheels = jnp.zeros_like(mean).at[SIX : SENSORS_END - 1].set(1)  # all but the cameras' delay
    PH = matvec(P, H)
    gain = jnp.where(compared, wheels * PH / S, 0)
    left = P - gain[:, None] * PH[None]  # (I - K H) P
    back = matvec(left, H) - wheels_sigma_radps**2 * gain
    return mean + gain * change, kalman.symmetrise(left - back[:, None] * gain[None])


def bias_at_rest(
    gyro: Gyro,
    turn: Turn,
    before_mps: Float[Array, " 2"],
    read: ReadVelocity,
    wheels_sigma_radps: Float[Array, ""],
    dt_s: Float[Array, ""],
    mean: Float[Array, " n"],
    P: Float[Array, "n n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The state after a gyro was compared with wheels that stand, if they do.

    The other errors behind pose and velocity keep their mean and covariance.

    Args:
        before_mps: the velocity before the interval.
        read: by the wheels, now.
        wheels_sigma_radps: noise of the wheels' turn rate.
    """
    slow = jnp.sum(before_mps**2) < _STANDS_MPS**2
    slow = slow & (jnp.sum(read.velocity[:2] ** 2) < _STANDS_MPS**2)
    slow = slow & (jnp.abs(read.velocity[2]) < _STANDS_RADPS) & jnp.all(read.present > 0)
    white = jnp.asarray(gyro.noise_density, mean.dtype) ** 2 / jnp.where(turn.told, dt_s, 1)
    steady = jnp.abs(turn.changed_radps) < _STEADY_RADPS + 4 * jnp.sqrt(white)
    stands = (turn.told & slow & steady).astype(mean.dtype)
    H = jnp.zeros((1, mean.shape[0]), mean.dtype).at[0, _BIAS].set(1)
    R = (wheels_sigma_radps**2 + white)[None, None]
    seen = kalman.hide_rows((turn.rate_radps - read.velocity[2])[None], H, R, stands[None])
    correction, after, _ = kalman.update(P, *seen)
    kept = slice(SIX, _BIAS)
    return mean + correction.at[kept].set(0), after.at[kept, kept].set(P[kept, kept])
