"""Errors of a vehicle's sensors that repeat: five states behind the six of the filter.

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
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnav.core.linalg.small_matrices import matvec, product
from jaxnav.core.models import bicycle
from jaxnav.core.models.bicycle import Vehicle
from jaxnav.core.models.geometry import planar_rotation
from jaxnav.core.models.twist_base import TwistBase
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
    """The velocity that a vehicle's odometry means to a state.

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
    """The velocity that a twist in the vehicle's axes means to a state, in the world.

    Args:
        twist: of it v_x, v_y and omega are used; where one of the first two is NaN, neither is.
        mean: (6,), or longer with the errors p behind.
    """
    dtype, errors = mean.dtype, mean[SIX:SENSORS_END]
    told = jnp.full(6, jnp.nan, dtype) if twist is None else jnp.asarray(twist, dtype)
    read = jnp.stack([told[k] for k in _PLANAR])
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
    """The velocity (Eqs. 6 and 7) that speed and steering mean to a state, in the world.

    Args:
        mean: (6,), or longer with the errors p behind.
    """
    psi_rad, errors = mean[2], mean[SIX:SENSORS_END]
    speed, steering = speed_mps, steering_rad
    if errors.shape[0]:
        slip, k, g, o, _ = errors
        speed, steering = (1 + slip + k) * speed_mps, (1 + g) * steering_rad + o

    def at(steering: Array) -> Array:
        return bicycle.velocity_world(jnp.ones_like(speed), steering, psi_rad, wheelbase_m)

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
    """The state after a way, in which a part of the slip was forgotten for another.

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


def lead_after(
    lead: Float[Array, " 3"], change: Float[Array, " 3"], dt_s: Float[Array, ""]
) -> Float[Array, " 3"]:
    """The lead of a velocity over its exponential mean, after an interval of constant acceleration.

        l' = f l + (1 - f) (T / dt) change,    f = exp(-dt / T)

    Args:
        change: of the velocity in the interval.
    """
    intervals = jnp.maximum(dt_s / MEMORY_S, jnp.finfo(lead.dtype).eps)
    faded = -jnp.expm1(-intervals)
    return (1 - faded) * lead + faded / intervals * change


def seen_pose(
    mean: Float[Array, " n"], lead: Float[Array, " 3"]
) -> tuple[Float[Array, " 3"], Float[Array, "3 h"]]:
    """Where the corners show the vehicle, and its derivative by the states before the cameras'.

    The derivative leaves out that the lead turns with the heading.
    """
    slope = _sheared(mean, lead, -1)
    return (mean[:3] if mean.shape[0] == SIX else mean[:3] - _way_since(mean, lead)), slope


def from_seen(
    mean: Float[Array, " n"], lead: Float[Array, " 3"]
) -> tuple[Float[Array, " n"], Float[Array, "3 h"]]:
    """The state of one whose first three entries are the seen pose, and their derivative by it.

    Of the derivative, the columns of the cameras' errors are left out: they are 0.
    """
    if mean.shape[0] == SIX:
        return mean, _sheared(mean, lead, 1)
    return mean.at[:3].add(_way_since(mean, lead)), _sheared(mean, lead, 1)


def _way_since(mean: Array, lead: Array) -> Array:
    """tau (v - c l), by which the vehicle has moved since it was seen."""
    tau = mean[_DELAY]
    part = jnp.clip(tau / (2 * MEMORY_S), 0, 1)
    return tau * (mean[3:SIX] - part * matvec(planar_rotation(mean[2]), lead))


def _sheared(mean: Array, lead: Array, sign: int) -> Array:
    """Derivative of pose + sign tau (v - c l)."""
    slope = jnp.eye(3, min(mean.shape[0], SENSORS_END), dtype=mean.dtype)
    if mean.shape[0] == SIX:
        return slope
    tau = mean[_DELAY]
    # d (tau c) / d tau
    grown = jnp.where(tau < 2 * MEMORY_S, jnp.maximum(tau, 0) / MEMORY_S, 1)
    by_delay = mean[3:SIX] - grown * matvec(planar_rotation(mean[2]), lead)
    slope = slope.at[:, 3:SIX].set(sign * tau * jnp.eye(3, dtype=mean.dtype))
    return slope.at[:, _DELAY].set(sign * by_delay)
