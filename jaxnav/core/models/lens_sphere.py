"""Wide lenses in closed form, which draw a point by way of a sphere or an ellipsoid.

All of them divide x and y by a sum,

    D = a d + b w,  d = sqrt(beta (x^2 + y^2) + w^2)

with w = z but in the double sphere, whose w = z + xi |p| is the depth behind its first sphere:

                   a      b          beta   w            source
    omni           xi     1          1      z            Mei, Rives (2007); Kalibr's omni
    eucm           alpha  1 - alpha  beta   z            Khomutenko, Garcia, Martinet (2016)
    double sphere  alpha  1 - alpha  1      z + xi |p|   Usenko, Demmel, Cremers (2018)

They see where D > 0, which ends the image at infinity if a < b, and where a w + b d > 0, before the
image turns back, if a > b: w / d above minus w1 of Usenko et al. Kalibr's omni bends the image by
k1 k2 p1 p2 of `radtan` after that. On the axis an image grows by 1 / (1 + xi) a radian, by 1 for
eucm: the focal lengths of files are those of their formulas.
"""

from typing import NamedTuple

import jax.numpy as jnp
from jaxtyping import Array, Bool

from jaxnav.core.models.lens_parts import (
    LEAST_RISE,
    MIN_DEPTH_RATIO,
    Image,
    Images,
    Numbers,
    Points,
    Rays,
    along,
    comes_back,
    safe_length,
)
from jaxnav.core.models.lens_pinhole import bent, unbent


class _Sum(NamedTuple):
    """The factors of D; each a number or an array that broadcasts with the points."""

    a: Array
    b: Array
    beta: Array


def omni(points: Points, coefficients: Numbers) -> Image:
    return bent(_divided(points, *_straight(points), _of_omni(coefficients)), _brown(coefficients))


def omni_bearing(xy: Images, coefficients: Numbers) -> Rays:
    xy, w = _raised(unbent(xy, _brown(coefficients)), _of_omni(coefficients))
    return _unit(xy, w)


def omni_sees(points: Points, coefficients: Numbers) -> Bool[Array, "..."]:
    image, _ = omni(points, coefficients)
    ray = omni_bearing(jnp.moveaxis(image, 0, -1), coefficients)
    return _sees(points, points[2], _of_omni(coefficients)) & comes_back(ray, points)


def eucm(points: Points, coefficients: Numbers) -> Image:
    return _divided(points, *_straight(points), _of_eucm(coefficients))


def eucm_bearing(xy: Images, coefficients: Numbers) -> Rays:
    return _unit(*_raised(xy, _of_eucm(coefficients)))


def eucm_sees(points: Points, coefficients: Numbers) -> Bool[Array, "..."]:
    return _sees(points, points[2], _of_eucm(coefficients))


def double_sphere(points: Points, coefficients: Numbers) -> Image:
    return _divided(points, *_behind(points, coefficients[0]), _of_double_sphere(coefficients))


def double_sphere_bearing(xy: Images, coefficients: Numbers) -> Rays:
    xi = coefficients[0]
    xy, w = _raised(xy, _of_double_sphere(coefficients))
    r2 = jnp.sum(xy**2, axis=-1)
    # From the second sphere's middle along (x, y, w) to the first sphere, of radius 1.
    squared = w**2 + (1 - xi**2) * r2
    meets = squared > 0
    root = jnp.where(meets, jnp.sqrt(jnp.where(meets, squared, 1)), 0)
    length = (w * xi + root) / (w**2 + r2)
    return jnp.concatenate([xy * length[..., None], (w * length - xi)[..., None]], axis=-1)


def double_sphere_sees(points: Points, coefficients: Numbers) -> Bool[Array, "..."]:
    return _sees(points, _behind(points, coefficients[0])[0], _of_double_sphere(coefficients))


def _of_omni(coefficients: Array) -> _Sum:
    xi = coefficients[0]
    return _Sum(xi, jnp.ones_like(xi), jnp.ones_like(xi))


def _brown(coefficients: Array) -> tuple[Array, ...]:
    _, k1, k2, p1, p2 = coefficients
    return k1, k2, p1, p2, jnp.zeros_like(k1)


def _of_eucm(coefficients: Array) -> _Sum:
    alpha, beta = coefficients
    return _Sum(alpha, 1 - alpha, beta)


def _of_double_sphere(coefficients: Array) -> _Sum:
    alpha = coefficients[1]
    return _Sum(alpha, 1 - alpha, jnp.ones_like(alpha))


def _straight(points: Array) -> tuple[Array, Array]:
    """The depth of points, and its slope (3, ...)."""
    return points[2], along(jnp.asarray([0.0, 0.0, 1.0], points.dtype), points)


def _behind(points: Array, xi: Array) -> tuple[Array, Array]:
    """The depth behind the first sphere, and its slope (3, ...)."""
    length = safe_length(points)
    w, slope = _straight(points)
    per_length = xi / jnp.where(length > 0, length, 1)
    return w + xi * length, slope + per_length[None] * points


def _widened(points: Array, w: Array, beta: Array) -> Array:
    """d of points (3, ...)."""
    squared = beta * (points[0] ** 2 + points[1] ** 2) + w**2
    nonzero = squared > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, squared, 1)), 0)


def _divided(points: Array, w: Array, w_slope: Array, terms: _Sum) -> Image:
    """x and y over D, which is bounded from below as the depth before a pinhole is."""
    a, b, beta = terms
    length = safe_length(points)
    d = _widened(points, w, beta)
    per_d = jnp.where(d > 0, 1 / jnp.where(d > 0, d, 1), 0)
    least = MIN_DEPTH_RATIO * jnp.maximum(length, 1e-12)
    ahead = a * d + b * w > least
    per_sum = 1 / jnp.where(ahead, a * d + b * w, least)
    image = points[:2] * per_sum[None]
    aside = along(jnp.asarray([1.0, 1.0, 0.0], points.dtype), points) * points
    slope = (a * beta * per_d)[None] * aside + (a * w * per_d + b)[None] * w_slope
    clamped = MIN_DEPTH_RATIO * points / jnp.maximum(length, 1e-12)[None]
    slope = jnp.where(ahead[None], slope, clamped)
    straight = along(jnp.eye(3, 2, dtype=points.dtype), points)
    return image, (straight - slope[:, None] * image[None]) * per_sum[None, None]


def _sees(points: Array, w: Array, terms: _Sum) -> Array:
    """Whether points lie before both limits."""
    a, b, beta = terms
    d = _widened(points, w, beta)
    total = a * d + b * w
    before = total > MIN_DEPTH_RATIO * jnp.maximum(safe_length(points), 1e-12)
    return before & (a * w + b * d > LEAST_RISE * total)


def _raised(xy: Array, terms: _Sum) -> tuple[Array, Array]:
    """Images (..., 2) that the lens draws, and the w that makes D = 1 at (x, y)."""
    a, b, beta = terms
    r2 = jnp.sum(xy**2, axis=-1)
    folding = (a**2 - b**2) * beta
    # Of an image beyond the fold, the last one in its direction.
    beyond = folding * r2 > 1
    shrink = jnp.where(beyond, jnp.sqrt(1 / jnp.where(beyond, folding * r2, 1)), 1)
    xy, r2 = xy * shrink[..., None], r2 * shrink**2
    inside = folding * r2 < 1
    root = jnp.where(inside, jnp.sqrt(jnp.where(inside, 1 - folding * r2, 1)), 0)
    return xy, (1 - a**2 * beta * r2) / (b + a * root)


def _unit(xy: Array, w: Array) -> Array:
    ray = jnp.concatenate([xy, w[..., None]], axis=-1)
    return ray / jnp.sqrt(jnp.sum(ray**2, axis=-1, keepdims=True))
