"""The equidistant lens with a polynomial of the angle: OpenCV's fisheye, Kalibr's equidistant.

Source: Kannala and Brandt (2006), "A generic camera model and calibration method for conventional,
wide-angle, and fish-eye lenses".
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxnav.core.models.geometry import safe_norm
from jaxnav.core.models.lens_parts import (
    LEAST_RISE,
    Image,
    Images,
    Numbers,
    Points,
    Rays,
    along,
    inverted,
    safe_length,
)

_LEAST_DEPTH_RATIO = -0.99  # depth over distance of the last point that can be seen
_STOPS = 32  # on the way from the axis, where the image is asked whether it moves outwards


def equidistant(points: Points, coefficients: Numbers) -> Image:
    """theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) along (x, y)."""
    x, y, z = points
    r2, squared = x**2 + y**2, jnp.sum(points**2, axis=0)
    off_axis = r2 > 1e-14 * z**2
    per_radius = jax.lax.rsqrt(jnp.where(off_axis, r2, 1))
    theta = jnp.where(off_axis, jnp.arctan2(jnp.where(off_axis, r2 * per_radius, 1), z), 0)
    t2 = theta**2
    gain = _gain(t2, coefficients)
    rise = _rise(t2, coefficients)
    # theta / radius, which tends to 1 / z on the axis
    on_axis = 1 / jnp.where(off_axis | (z <= 0), 1, z)
    ratio = jnp.where(off_axis, theta * per_radius, on_axis) * gain
    rise = rise / jnp.where(squared > 0, squared, 1)
    bend = jnp.where(off_axis, (z * rise - ratio) * per_radius**2, 0)
    # The slope of the ratio times both coordinates, then the ratio times their slopes.
    is_depth = along(jnp.asarray([False, False, True]), points)
    slope = jnp.where(is_depth, -rise[None], points * bend[None])[:, None] * points[None, :2]
    straight = along(jnp.eye(3, 2, dtype=points.dtype), points)
    return points[:2] * ratio[None], slope + straight * ratio[None, None]


def equidistant_bearing(xy: Images, coefficients: Numbers) -> Rays:
    theta_bent = safe_norm(xy)
    theta = inverted(lambda t: t * _gain(t**2, coefficients), theta_bent, lambda part: np.pi * part)
    # sin(theta) / theta_bent, which tends to 1 on the axis
    off_axis = theta_bent > 1e-7
    ratio = jnp.where(off_axis, jnp.sin(theta) / jnp.where(off_axis, theta_bent, 1), 1)
    return jnp.concatenate([xy * ratio[..., None], jnp.cos(theta)[..., None]], axis=-1)


def equidistant_sees(points: Points, coefficients: Numbers) -> Bool[Array, "..."]:
    theta = jnp.arctan2(safe_norm(jnp.moveaxis(points[:2], 0, -1)), points[2])
    parts = np.linspace(1 / _STOPS, 1, _STOPS).reshape(-1, *(1,) * theta.ndim)
    way = theta[None] * jnp.asarray(parts, theta.dtype)
    rise, gain = _rise(way**2, coefficients), _gain(way**2, coefficients)
    before = points[2] > _LEAST_DEPTH_RATIO * jnp.maximum(safe_length(points), 1e-12)
    return before & jnp.all(rise > LEAST_RISE * way * gain, axis=0)


def _rise(theta2: Array, coefficients: Array) -> Array:
    """Derivative by theta of theta times the gain."""
    k1, k2, k3, k4 = coefficients
    return 1 + theta2 * (3 * k1 + theta2 * (5 * k2 + theta2 * (7 * k3 + theta2 * 9 * k4)))


def _gain(theta2: Array, coefficients: Array) -> Array:
    k1, k2, k3, k4 = coefficients
    return 1 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4)))
