"""Lenses that bend a pinhole's image: OpenCV's models of five, eight and twelve coefficients.

Source: Brown (1966), "Decentering distortion of lenses"; with k4 k5 k6 OpenCV's rational model,
with s1 to s4 its thin prism.
"""

from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool

from jaxnav.core.models.geometry import safe_norm
from jaxnav.core.models.lens_parts import (
    MIN_DEPTH_RATIO,
    Image,
    Images,
    Numbers,
    Points,
    Rays,
    along,
    comes_back,
    inverted,
    safe_length,
    towards,
)

# A bent image is inverted up to this angle off the axis.
_WIDEST_RAD = np.deg2rad(89.0)
_LEAST_DENOMINATOR = 1e-3  # bound for a rational lens far outside of its fitted range
_NEWTON_STEPS = 4

Coefficients = Array | Sequence[Array]


def pinhole(points: Points, coefficients: Numbers) -> Image:
    del coefficients
    length = safe_length(points)
    nearest = MIN_DEPTH_RATIO * jnp.maximum(length, 1e-12)
    ahead = points[2] > nearest
    per_depth = 1 / jnp.where(ahead, points[2], nearest)
    image = points[:2] * per_depth[None]
    # The slope of the depth, or of the bound that replaces it.
    axis = along(jnp.asarray([0.0, 0.0, 1.0], points.dtype), points)
    clamped = MIN_DEPTH_RATIO * points / jnp.maximum(length, 1e-12)[None]
    depth_slope = jnp.where(ahead[None], axis, clamped)
    straight = along(jnp.eye(3, 2, dtype=points.dtype), points)
    return image, (straight - depth_slope[:, None] * image[None]) * per_depth[None, None]


def pinhole_bearing(xy: Images, coefficients: Numbers) -> Rays:
    del coefficients
    return towards(xy)


def pinhole_sees(points: Points, coefficients: Numbers) -> Bool[Array, "..."]:
    del coefficients
    return points[2] > MIN_DEPTH_RATIO * jnp.maximum(safe_length(points), 1e-12)


def radtan(points: Points, coefficients: Numbers) -> Image:
    return bent(pinhole(points, coefficients), coefficients)


def radtan_bearing(xy: Images, coefficients: Numbers) -> Rays:
    return towards(unbent(xy, coefficients))


def radtan_sees(points: Points, coefficients: Numbers) -> Bool[Array, "..."]:
    image, _ = radtan(points, coefficients)
    ray = radtan_bearing(jnp.moveaxis(image, 0, -1), coefficients)
    return pinhole_sees(points, coefficients) & comes_back(ray, points)


def bent(straight: Image, coefficients: Coefficients) -> Image:
    """The distortion of an image and its slope."""
    image, slope = straight
    distorted, (along_x, u_by_y, v_by_x, along_y) = _distorted(image[0], image[1], coefficients)
    by_x, by_y = slope[:, 0], slope[:, 1]
    return distorted, jnp.stack(
        [
            along_x[None] * by_x + u_by_y[None] * by_y,
            v_by_x[None] * by_x + along_y[None] * by_y,
        ],
        axis=1,
    )


def unbent(distorted: Images, coefficients: Coefficients) -> Images:
    """The image (..., 2) whose distortion is the given one."""
    radius_bent = safe_norm(distorted)
    radius = inverted(
        lambda r: r * _radial(r**2, coefficients)[0],
        radius_bent,
        lambda part: np.tan(_WIDEST_RAD * part),
    )
    safe = jnp.where(radius_bent > 0, radius_bent, 1)
    start = distorted * jnp.where(radius_bent > 0, radius / safe, 1)[..., None]

    def newton(xy: Array) -> Array:
        # The tangential terms move the start by little, so a long step means that there is no
        # such ray.
        value, (a, b, c, d) = _distorted(xy[..., 0], xy[..., 1], coefficients)
        residual_x, residual_y = value - jnp.moveaxis(distorted, -1, 0)
        determinant = a * d - b * c
        regular = determinant > 1e-6
        inverse = jnp.where(regular, 1 / jnp.where(regular, determinant, 1), 0)
        solved = [d * residual_x - b * residual_y, a * residual_y - c * residual_x]
        step = jnp.stack(solved, axis=-1) * inverse[..., None]
        reachable = safe_norm(step) < 0.2 * (1 + safe_norm(xy))
        return jnp.where(reachable[..., None], xy - step, xy)

    xy = start
    for _ in range(_NEWTON_STEPS):
        xy = newton(xy)
    return newton(jax.lax.stop_gradient(xy))


def _distorted(
    x: Array, y: Array, coefficients: Coefficients
) -> tuple[Array, tuple[Array, Array, Array, Array]]:
    """Distorted image (u, v) of a pinhole's image (x, y), and du/dx, du/dy, dv/dx, dv/dy."""
    _, _, p1, p2, _, *more = coefficients
    r2 = x**2 + y**2
    radial, rise = _radial(r2, coefficients)
    bend = 2 * rise  # derivative of `radial`, over x or y
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2)
    v = y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y
    mixed = x * y * bend + 2 * p1 * x + 2 * p2 * y
    along_x = radial + x**2 * bend + 2 * p1 * y + 6 * p2 * x
    along_y = radial + y**2 * bend + 6 * p1 * y + 2 * p2 * x
    if len(more) <= 3:
        return jnp.stack([u, v]), (along_x, mixed, mixed, along_y)
    s1, s2, s3, s4 = more[3:]
    shift = [r2 * (s1 + r2 * s2), r2 * (s3 + r2 * s4)]
    of_u, of_v = 2 * (s1 + 2 * r2 * s2), 2 * (s3 + 2 * r2 * s4)  # derivatives, over x or y
    slopes = (along_x + x * of_u, mixed + y * of_u, mixed + x * of_v, along_y + y * of_v)
    return jnp.stack([u + shift[0], v + shift[1]]), slopes


def _radial(r2: Array, coefficients: Coefficients) -> tuple[Array, Array]:
    """The factor on the radius, and its derivative with respect to r2, the squared radius."""
    k1, k2, _, _, k3, *below = coefficients[:8]

    def polynomial(a: Array, b: Array, c: Array) -> tuple[Array, Array]:
        return 1 + r2 * (a + r2 * (b + r2 * c)), a + r2 * (2 * b + 3 * r2 * c)

    value, rise = polynomial(k1, k2, k3)
    if not below:
        return value, rise
    under, under_rise = polynomial(*below)
    fits = under > _LEAST_DENOMINATOR
    under = jnp.where(fits, under, _LEAST_DENOMINATOR)
    ratio = value / under
    return ratio, (rise - jnp.where(fits, ratio * under_rise, 0)) / under
