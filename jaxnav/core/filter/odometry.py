"""What wheels and gyro of a vehicle read, and what they get wrong, for the planar filter.

The errors of wheels that repeat are five states behind the six of the filter.

    p = (s, k, g, o, tau)

A car's true speed is (1 + s + k) times the one that its odometer reads, and its true steering angle
is (1 + g) read + o, rad. Of a base whose odometry is a twist,

    (v_x, v_y) = (1 + s + k) read,    omega = (1 + s + k) ((1 + g) read + o v_x read),

where g is that of the effective track width and o, rad/m, that of unequal wheels. Corners show the
vehicle where it was tau s before their stamp:

    seen = pose - tau (v - c l),    c = clip(tau / 2 T, 0, 1)

with the velocity v and its lead l over the mean of the last moments, which are T = 25 ms old on
average. A step of the speed or the steering is not seen until tau later. Without l a filter that
reads it at once would learn from each step that the corners are less late than they are. The slip
s comes and goes with the way: a first-order Gauss-Markov process. The other four are constant.

While the branch is open the five are only considered (Schmidt): they widen the covariance of pose
and velocity and stay correlated with them, but keep their own mean and covariance. A mirrored pose
and a wheel that slips explain the same corners, and a hypothesis would learn the error that fits
its own mistake. Once the heading is known they are estimated like every other state.

Source: Schmidt (1966), "Application of state-space methods to navigation problems"; Bar-Shalom,
Li, Kirubarajan (2001), section 10.2 (augmented states); Gelb (1974), "Applied Optimal Estimation"
(first-order Gauss-Markov process); Borenstein, Feng (1996), "Measurement and correction of
systematic odometry errors in mobile robots" (UMBmark: track width and unequal wheels).

A gyro reads the turn of an interval, and its errors are states.

    psi += dt r + (delay + d) (r - psi_dot),    psi_dot = r,    r = (1 - e) z - b

The errors of its scale e, of its delay d and its bias b stand at the end of the state. What of
scale and delay is not the same in every interval (a scale that depends on the rate, a bus that is
busy) is as large again, as noise: a random walk of the angle that is right at 1 rad, and a delay.

The wheels read the velocity at the end of an interval, and a turn rate that slips with them; the
gyro reads the whole turn. So where it reads, the wheels' turn rate moves nothing. The two are
compared twice, which teaches every hypothesis, since it holds whichever pose is the true one:
while the wheels stand, z is the bias; while they turn, they show what they get wrong. Corners teach
the bias as they do the errors of the other sensors, once the heading is known: a mirrored pose
would learn the bias that fits it.

Source: Titterton, Weston (2004), "Strapdown Inertial Navigation Technology", chapters 12 and 13
(errors as states; zero-velocity updates); Schmidt (1966) for errors that are only considered.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter import kalman
from jaxnav.core.linalg.small_matrices import matvec, product, sandwich
from jaxnav.core.models.geometry import planar_rotation, safe_sinc
from jaxnav.core.models.imu import Gyro
from jaxnav.core.models.vehicle import TwistBase, Vehicle, velocity_world
from jaxnav.core.pose.observation import Observation

SIX = 6  # states before the errors: pose and velocity
SLIP = SIX
LEARNT = SLIP + 1  # the errors from here on are constant
SENSORS_END = LEARNT + 4  # the errors of cameras come behind those of sensors
_DELAY = SENSORS_END - 1
MEMORY_S = 0.025  # T
_PLANAR = (0, 1, 5)  # of a twist: v_x, v_y, omega
# A reading beyond this, m/s or rad/s, is an error of the sensor or of its unit.
_LARGEST_TWIST = 1e3


class ReadVelocity(NamedTuple):
    """A velocity that the odometry reads, in the world, and its derivatives."""

    velocity: Float[Array, " 3"]
    by_heading: Float[Array, " 3"]
    by_errors: Float[Array, "3 p"]  # p = 0 or 5
    present: Float[Array, " 3"]  # 1 where the odometry reads it, 0 elsewhere


def read_velocity(
    vehicle: Vehicle | TwistBase, obs: Observation, mean: Float[Array, " n"]
) -> ReadVelocity:
    """Convert what a vehicle's odometry reads to a velocity in the world, at a state's heading.

    Args:
        mean: (6,), or longer with the errors p behind.
    """
    if isinstance(vehicle, TwistBase):
        read = velocity_of_twist(obs.twist, mean)
        return read._replace(present=read.present * jnp.asarray(obs.has_odometry, mean.dtype))
    speed_mps, steering_rad = (
        jnp.asarray(value, mean.dtype) for value in (obs.speed_mps, obs.steering_rad)
    )
    read = velocity_of_bicycle(speed_mps, steering_rad, mean, vehicle.wheelbase_m)
    return read._replace(present=jnp.full(3, jnp.asarray(obs.has_odometry, mean.dtype)))


def velocity_of_twist(twist: Float[Array, " 6"] | None, mean: Float[Array, " n"]) -> ReadVelocity:
    """Convert a twist in the vehicle's axes to a velocity in the world, at a state's heading.

    Args:
        twist: of it v_x, v_y and omega are used; where one of the first two is NaN, neither is.
        mean: (6,), or longer with the errors p behind.
    """
    dtype, errors = mean.dtype, mean[SIX:SENSORS_END]
    given = jnp.full(6, jnp.nan, dtype) if twist is None else jnp.asarray(twist, dtype)
    read = jnp.stack([given[k] for k in _PLANAR])
    usable = jnp.abs(read) < _LARGEST_TWIST
    moves = usable[0] & usable[1]
    present = jnp.stack([moves, moves, usable[2]])
    read = jnp.where(present, read, 0)
    R = planar_rotation(mean[2])
    scale, gain, offset = jnp.ones((), dtype), jnp.ones((), dtype), jnp.zeros((), dtype)
    if errors.shape[0]:
        slip, k, g, o, _ = errors
        scale, gain, offset = 1 + slip + k, 1 + g, o
    nothing = jnp.zeros_like(scale)
    by_scale = jnp.stack([read[0], read[1], gain * read[2] + offset * read[0]])
    velocity = matvec(R, scale * by_scale)
    by_heading = jnp.stack([-velocity[1], velocity[0], nothing])
    by_errors = jnp.zeros((3, 0), dtype)
    if errors.shape[0]:
        turns = [jnp.stack([nothing, nothing, scale * x]) for x in (read[2], read[0])]
        columns = [by_scale, by_scale, *turns, jnp.zeros_like(by_scale)]
        by_errors = product(R, jnp.stack(columns, axis=1))
    return ReadVelocity(velocity, by_heading, by_errors, present.astype(dtype))


def velocity_of_bicycle(
    speed_mps: Float[Array, ""],
    steering_rad: Float[Array, ""],
    mean: Float[Array, " n"],
    wheelbase_m: Float[Array, ""],
) -> ReadVelocity:
    """Convert speed and steering to a velocity in the world (Eqs. 6, 7), at a state's heading.

    Args:
        mean: (6,), or longer with the errors p behind.
    """
    psi_rad, errors = mean[2], mean[SIX:SENSORS_END]
    speed, steering = speed_mps, steering_rad
    if errors.shape[0]:
        slip, k, g, o, _ = errors
        speed, steering = (1 + slip + k) * speed_mps, (1 + g) * steering_rad + o

    def at(steering: Array) -> Array:
        return velocity_world(jnp.ones_like(speed), steering, psi_rad, wheelbase_m)

    unit, by_steering = jax.jvp(at, (steering,), (jnp.ones_like(steering),))
    velocity = speed * unit
    by_heading = jnp.stack([-velocity[1], velocity[0], jnp.zeros_like(speed)])
    present = jnp.ones_like(velocity)
    if not errors.shape[0]:
        return ReadVelocity(velocity, by_heading, jnp.zeros((3, 0), mean.dtype), present)
    by_angle = speed * by_steering
    by_scale = speed_mps * unit
    columns = [by_scale, by_scale, steering_rad * by_angle, by_angle, jnp.zeros_like(by_angle)]
    return ReadVelocity(velocity, by_heading, jnp.stack(columns, axis=1), present)


def slipped(
    mean: Float[Array, " n"],
    P: Float[Array, "n n"],
    way_m: Float[Array, ""],
    sigma: Float[Array, ""],
    length_m: Float[Array, ""],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Let the slip of the wheels fade over a way, and another one come.

        s' = f s + w,    f = exp(-way / length),    var w = (1 - f^2) sigma^2

    Args:
        sigma: standard deviation of the slip.
        length_m: way after which its correlation has fallen to 1/e.
    """
    if mean.shape[0] == SIX:
        return mean, P
    kept = jnp.exp(-way_m / length_m)
    P = P.at[SLIP].multiply(kept).at[:, SLIP].multiply(kept)
    return mean.at[SLIP].multiply(kept), P.at[SLIP, SLIP].add((1 - kept**2) * sigma**2)


def velocity_lead_after(
    velocity_lead: Float[Array, " 3"], change: Float[Array, " 3"], dt_s: Float[Array, ""]
) -> Float[Array, " 3"]:
    """The lead of a velocity over its exponential mean, after an interval of constant acceleration.

        l' = f l + (1 - f) (T / dt) change,    f = exp(-dt / T)

    Args:
        change: of the velocity in the interval.
    """
    intervals = jnp.maximum(dt_s / MEMORY_S, jnp.finfo(velocity_lead.dtype).eps)
    faded = -jnp.expm1(-intervals)
    return (1 - faded) * velocity_lead + faded / intervals * change


def seen_pose(
    mean: Float[Array, " n"], velocity_lead: Float[Array, " 3"], sign: int = -1
) -> tuple[Float[Array, " 3"], Float[Array, "3 h"]]:
    """Where the corners show the vehicle, and its derivative by the states before the cameras'.

    The derivative leaves out that the lead turns with the heading.

    Args:
        sign: 1 leads back: from a state whose pose is the seen one to the pose at its stamp.
    """
    slope = jnp.eye(3, min(mean.shape[0], SENSORS_END), dtype=mean.dtype)
    if mean.shape[0] == SIX:
        return mean[:3], slope
    tau, lead = mean[_DELAY], matvec(planar_rotation(mean[2]), velocity_lead)
    way = tau * (mean[3:SIX] - jnp.clip(tau / (2 * MEMORY_S), 0, 1) * lead)
    # d (tau c) / d tau
    grown = jnp.where(tau < 2 * MEMORY_S, jnp.maximum(tau, 0) / MEMORY_S, 1)
    slope = slope.at[:, 3:SIX].set(sign * tau * jnp.eye(3, dtype=mean.dtype))
    return mean[:3] + sign * way, slope.at[:, _DELAY].set(sign * (mean[3:SIX] - grown * lead))


# Below these the wheels stand: above the noise of an odometer, below what a wheel creeps at.
_STANDS_MPS, _STANDS_RADPS = 0.03, 0.05
_TURNS_RADPS, _MOST_SLIP = 0.05, 0.5  # slower turns say nothing of a slip; a share of the speed
_STEADY_RADPS = 0.005  # a rate that changes by less, and its noise, does not
GYRO = 3  # states of a gyro, the last of all
_GYRO_SCALE, _GYRO_DELAY, _GYRO_BIAS = -3, -2, -1


def gyro_variance(gyro: Gyro, dtype: jnp.dtype) -> Float[Array, " 3"]:
    """Variances of the errors of scale, delay (s^2) and bias, (rad/s)^2, at first."""
    sigmas = gyro.scale_sigma, gyro.delay_sigma_s, gyro.bias_sigma_radps
    return jnp.stack([jnp.asarray(sigma, dtype) ** 2 for sigma in sigmas])


class Turn(NamedTuple):
    """What a gyro says of an interval: the turn in it, and the turn rate at its end."""

    measured: Bool[Array, ""]
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
    """Read the turn of an interval off a gyro.

    Args:
        mean: of the state before, the gyro's errors last.
        acceleration_density: of the turn, (rad/s^2)^2/Hz: a rate at the end is not its mean.
    """
    dtype, dt_s = mean.dtype, jnp.asarray(obs.dt_s, mean.dtype)
    read = jnp.asarray(jnp.nan if obs.gyro_radps is None else obs.gyro_radps[2], dtype)
    measured = (jnp.abs(read) < gyro.saturation_radps) & (dt_s > 0)
    dt_s = jnp.where(measured, dt_s, 1)
    white = jnp.asarray(gyro.noise_density, dtype) ** 2
    delay_s = jnp.asarray(gyro.delay_s, dtype) + mean[_GYRO_DELAY]
    read = jnp.where(measured, read, 0)
    rate = (1 - mean[_GYRO_SCALE]) * read - mean[_GYRO_BIAS]
    changed = rate - mean[5]
    by_rate = jnp.stack([dt_s + delay_s, jnp.ones_like(dt_s)])  # of heading and rate
    slopes = jnp.zeros((2, mean.shape[0]), dtype).at[0, 2].set(1).at[0, 5].set(-delay_s)
    slopes = slopes.at[:, _GYRO_SCALE].set(-read * by_rate).at[:, _GYRO_BIAS].set(-by_rate)
    slopes = slopes.at[0, _GYRO_DELAY].set(changed)
    angle_rad = jnp.abs(rate) * dt_s
    of_angle = white * dt_s + (gyro.delay_sigma_s * changed) ** 2 + gyro.scale_sigma**2 * angle_rad
    of_rate = white / dt_s + acceleration_density * dt_s / 3 + changed**2 / 4
    noise = jnp.stack([jnp.stack([of_angle, white]), jnp.stack([white, of_rate])])
    turn_rad = dt_s * rate + delay_s * changed
    return Turn(measured, turn_rad, rate, changed, slopes, noise.astype(dtype))


def turned(
    turn: Turn,
    mean: Float[Array, " n"],
    later: Float[Array, " 6"],
    A: Float[Array, "3 6"],
    Q: Float[Array, "6 6"],
    dt_s: Float[Array, ""],
) -> tuple[Float[Array, " 6"], Float[Array, "6 n"], Float[Array, "6 6"]]:
    """Pose and velocity after an interval (Eq. 9) in which a gyro has read the turn.

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
        jnp.where(turn.measured, jnp.concatenate(parts), later),
        jnp.where(turn.measured, rows, eye.at[:3, :SIX].set(A)),
        jnp.where(turn.measured, noise, Q),
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
    """Compare the wheels' turn rate with the gyro's.

    It teaches the errors of the wheels, and nothing else. Where the two differ by more than those
    explain, the wheels slip: the variance of the slip grows by what is left.

    Args:
        read: by the wheels, at the state after the turn.
        wheels_sigma_radps: noise of the wheels' turn rate.
    """
    compared = turn.measured & (read.present[2] > 0)
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
    """Compare a gyro with wheels that stand, if they do.

    The other errors behind pose and velocity keep their mean and covariance.

    Args:
        before_mps: the velocity before the interval.
        read: by the wheels, now.
        wheels_sigma_radps: noise of the wheels' turn rate.
    """
    slow = jnp.sum(before_mps**2) < _STANDS_MPS**2
    slow = slow & (jnp.sum(read.velocity[:2] ** 2) < _STANDS_MPS**2)
    slow = slow & (jnp.abs(read.velocity[2]) < _STANDS_RADPS) & jnp.all(read.present > 0)
    white = jnp.asarray(gyro.noise_density, mean.dtype) ** 2 / jnp.where(turn.measured, dt_s, 1)
    steady = jnp.abs(turn.changed_radps) < _STEADY_RADPS + 4 * jnp.sqrt(white)
    stands = (turn.measured & slow & steady).astype(mean.dtype)
    H = jnp.zeros((1, mean.shape[0]), mean.dtype).at[0, _GYRO_BIAS].set(1)
    R = (wheels_sigma_radps**2 + white)[None, None]
    seen = kalman.hide_rows((turn.rate_radps - read.velocity[2])[None], H, R, stands[None])
    correction, after, _ = kalman.update(P, *seen)
    kept = slice(SIX, _GYRO_BIAS)
    return mean + correction.at[kept].set(0), after.at[kept, kept].set(P[kept, kept])
