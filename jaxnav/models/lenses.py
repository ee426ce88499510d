"""Project through a lens, with derivatives, and invert it; a new lens is a row of `LENSES`.

The coordinate axis comes first: points (3, ...) in m in the camera frame, images (2, ...) at focal
length 1, slopes (3, 2, ...) with respect to the point's coordinates, per m. Coefficients are in the
order of OpenCV, each a number or an array that broadcasts with the points; a lens gets its own.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxnav.models.geometry import on_last_axis, safe_norm

# Points nearer to the camera's plane than this multiple of their distance are projected with this
# depth: finite and far outside of any image instead of infinite or mirrored.
MIN_DEPTH_RATIO = 1e-3
# Size of the table from which an inverse lens starts: angles up to 89 or 180 degrees.
_TABLE_SIZE = 96
_NEWTON_STEPS = 4
# On the way from the axis to a point, where a lens is asked whether its image moves outwards; the
# first of a radtan lens, in radii of the point's pinhole image.
_STOPS, _FIRST_STOP = 32, 0.01
_LEAST_DENOMINATOR = 1e-3  # bound for a rational lens far outside of its fitted range

Image = tuple[Float[Array, "2 ..."], Float[Array, "3 2 ..."]]


class LensModel(NamedTuple):
    """A kind of lens: its coefficients, its projection and the inverse."""

    coefficients: tuple[str, ...]
    # Of points and coefficients, with the slope.
    image: Callable[[Float[Array, "3 ..."], Float[Array, "k ..."]], Image]
    # Unit vectors through images.
    bearing: Callable[[Float[Array, "*batch 2"], Float[Array, " k"]], Float[Array, "*batch 3"]]
    least_depth_ratio: float  # depth over distance of the last point that can be seen
    # Whether the image moves outwards all the way from the axis to a point.
    rises: Callable[[Float[Array, "3 ..."], Float[Array, "k ..."]], Bool[Array, "..."]]


def _pinhole(points: Array, coefficients: Array) -> Image:
    del coefficients
    squared = jnp.sum(points**2, axis=0)
    nonzero = squared > 0
    length = jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, squared, 1)), 0)
    nearest = MIN_DEPTH_RATIO * jnp.maximum(length, 1e-12)
    ahead = points[2] > nearest
    per_depth = 1 / jnp.where(ahead, points[2], nearest)
    image = points[:2] * per_depth[None]
    # The slope of the depth, or of the bound that replaces it.
    axis = _axes(jnp.asarray([0.0, 0.0, 1.0], points.dtype), points)
    clamped = MIN_DEPTH_RATIO * points / jnp.maximum(length, 1e-12)[None]
    depth_slope = jnp.where(ahead[None], axis, clamped)
    straight = _axes(jnp.eye(3, 2, dtype=points.dtype), points)
    return image, (straight - depth_slope[:, None] * image[None]) * per_depth[None, None]


def _radtan(points: Array, coefficients: Array) -> Image:
    image, slope = _pinhole(points, coefficients)
    bent, (along_x, mixed, along_y) = _bent(image[0], image[1], coefficients)
    u_slope, v_slope = slope[:, 0], slope[:, 1]
    return bent, jnp.stack(
        [
            along_x[None] * u_slope + mixed[None] * v_slope,
            mixed[None] * u_slope + along_y[None] * v_slope,
        ],
        axis=1,
    )


def _pinhole_rises(points: Array, coefficients: Array) -> Array:
    return jnp.ones(points.shape[1:], bool)


def _on_the_way(last: Array, parts: np.ndarray) -> Array:
    """The parts of an array, along a new first axis."""
    return last[None] * jnp.asarray(parts, last.dtype).reshape(-1, *(1,) * last.ndim)


def _radtan_rises(points: Array, coefficients: Array) -> Array:
    r2 = jnp.sum(_pinhole(points, coefficients)[0] ** 2, axis=0)
    way = _on_the_way(r2, np.geomspace(_FIRST_STOP**2, 1, _STOPS))
    radial, rise = _radial(way, coefficients)
    return jnp.all(radial + 2 * way * rise > 0, axis=0)


def _bent(x: Array, y: Array, coefficients: Array) -> tuple[Array, tuple[Array, Array, Array]]:
    """Distorted image (u, v) of a pinhole's image (x, y), and du/dx, du/dy = dv/dx, dv/dy.

    Source: Brown (1966); with k4 k5 k6 OpenCV's rational model.
    """
    _, _, p1, p2, *_ = coefficients
    r2 = x**2 + y**2
    radial, rise = _radial(r2, coefficients)
    bend = 2 * rise  # derivative of `radial`, over x or y
    bent = jnp.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x**2),
            y * radial + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y,
        ]
    )
    mixed = x * y * bend + 2 * p1 * x + 2 * p2 * y
    along_x = radial + x**2 * bend + 2 * p1 * y + 6 * p2 * x
    along_y = radial + y**2 * bend + 6 * p1 * y + 2 * p2 * x
    return bent, (along_x, mixed, along_y)


def _radial(r2: Array, coefficients: Array) -> tuple[Array, Array]:
    """The factor on the radius, and its derivative with respect to r2, the squared radius."""
    k1, k2, _, _, k3, *below = coefficients

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


def _equidistant(points: Array, coefficients: Array) -> Image:
    """theta (1 + k1 theta^2 + k2 theta^4 + k3 theta^6 + k4 theta^8) along (x, y), with its slope.

    Source: Kannala, Brandt (2006).
    """
    x, y, z = points
    r2, squared = x**2 + y**2, jnp.sum(points**2, axis=0)
    off_axis = r2 > 1e-14 * z**2
    per_radius = jax.lax.rsqrt(jnp.where(off_axis, r2, 1))
    theta = jnp.where(off_axis, jnp.arctan2(jnp.where(off_axis, r2 * per_radius, 1), z), 0)
    t2 = theta**2
    gain = _equidistant_gain(t2, coefficients)
    rise = _equidistant_rise(t2, coefficients)
    # theta / radius, which tends to 1 / z on the axis
    on_axis = 1 / jnp.where(off_axis | (z <= 0), 1, z)
    ratio = jnp.where(off_axis, theta * per_radius, on_axis) * gain
    rise = rise / jnp.where(squared > 0, squared, 1)
    bend = jnp.where(off_axis, (z * rise - ratio) * per_radius**2, 0)
    # The slope of the ratio times both coordinates, then the ratio times their slopes.
    is_depth = _axes(jnp.asarray([False, False, True]), points)
    slope = jnp.where(is_depth, -rise[None], points * bend[None])[:, None] * points[None, :2]
    straight = _axes(jnp.eye(3, 2, dtype=points.dtype), points)
    return points[:2] * ratio[None], slope + straight * ratio[None, None]


def _equidistant_rises(points: Array, coefficients: Array) -> Array:
    theta = jnp.arctan2(safe_norm(jnp.moveaxis(points[:2], 0, -1)), points[2])
    way = _on_the_way(theta**2, np.linspace(1 / _STOPS, 1, _STOPS) ** 2)
    return jnp.all(_equidistant_rise(way, coefficients) > 0, axis=0)


def _equidistant_rise(theta2: Array, coefficients: Array) -> Array:
    """Derivative by theta of theta times the gain."""
    k1, k2, k3, k4 = coefficients
    return 1 + theta2 * (3 * k1 + theta2 * (5 * k2 + theta2 * (7 * k3 + theta2 * 9 * k4)))


def _equidistant_gain(theta2: Array, coefficients: Array) -> Array:
    k1, k2, k3, k4 = coefficients
    return 1 + theta2 * (k1 + theta2 * (k2 + theta2 * (k3 + theta2 * k4)))


def _axes(constant: Array, points: Array) -> Array:
    """The constant with trailing axes of length 1, to broadcast over all points."""
    return constant.reshape(*constant.shape, *(1,) * (points.ndim - 1))


def _towards(xy: Array) -> Array:
    ray = jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)
    return ray / jnp.sqrt(jnp.sum(ray**2, axis=-1, keepdims=True))


def _pinhole_bearing(xy: Array, coefficients: Array) -> Array:
    del coefficients
    return _towards(xy)


def _radtan_bearing(xy_bent: Array, coefficients: Array) -> Array:
    radius_bent = safe_norm(xy_bent)
    table = np.tan(np.linspace(0, np.deg2rad(89), _TABLE_SIZE))
    radius = _invert(lambda r: r * _radial(r**2, coefficients)[0], radius_bent, table)
    safe = jnp.where(radius_bent > 0, radius_bent, 1)
    start = xy_bent * jnp.where(radius_bent > 0, radius / safe, 1)[..., None]

    def newton(xy: Array) -> Array:
        # The tangential terms move the start by little, so a long step means that there is no
        # such ray.
        value, (a, b, d) = _bent(xy[..., 0], xy[..., 1], coefficients)
        residual_x, residual_y = value - jnp.moveaxis(xy_bent, -1, 0)
        determinant = a * d - b * b
        regular = determinant > 1e-6
        inverse = jnp.where(regular, 1 / jnp.where(regular, determinant, 1), 0)
        solved = [d * residual_x - b * residual_y, a * residual_y - b * residual_x]
        step = jnp.stack(solved, axis=-1) * inverse[..., None]
        reachable = safe_norm(step) < 0.2 * (1 + safe_norm(xy))
        return jnp.where(reachable[..., None], xy - step, xy)

    xy = start
    for _ in range(_NEWTON_STEPS):
        xy = newton(xy)
    return _towards(newton(jax.lax.stop_gradient(xy)))


def _equidistant_bearing(xy_bent: Array, coefficients: Array) -> Array:
    theta_bent = safe_norm(xy_bent)
    table = np.linspace(0, np.pi, _TABLE_SIZE)
    theta = _invert(lambda t: t * _equidistant_gain(t**2, coefficients), theta_bent, table)
    # sin(theta) / theta_bent, which tends to 1 on the axis
    off_axis = theta_bent > 1e-7
    ratio = jnp.where(off_axis, jnp.sin(theta) / jnp.where(off_axis, theta_bent, 1), 1)
    return jnp.concatenate([xy_bent * ratio[..., None], jnp.cos(theta)[..., None]], axis=-1)


def _invert(profile: Callable[[Array], Array], target: Array, table: np.ndarray) -> Array:
    """The smallest x >= 0 with profile(x) = target: table look-up, then Newton in its cell.

    The table ends where the profile stops rising: the lens is one-to-one up to there. Only the last
    Newton step carries the gradient, which is that of the implicit function.
    """
    grid = jnp.asarray(table, target.dtype)
    values = profile(grid)
    rising = jnp.concatenate([jnp.ones(1, bool), jnp.cumprod(jnp.diff(values) > 0).astype(bool)])
    last = jnp.sum(rising) - 1
    reached = on_last_axis(values, target[..., None]) <= target[..., None]
    below = jnp.sum(on_last_axis(rising, reached) & reached, axis=-1) - 1
    cell = jnp.clip(below, 0, jnp.maximum(last - 1, 0))
    low, high = grid[cell], grid[jnp.minimum(cell + 1, last)]
    value_low, value_high = values[cell], values[jnp.minimum(cell + 1, last)]
    span = jnp.where(value_high > value_low, value_high - value_low, 1)
    x = low + (high - low) * jnp.clip((target - value_low) / span, 0, 1)

    def newton(x: Array) -> Array:
        value, slope = jax.jvp(profile, (x,), (jnp.ones_like(x),))
        return x - (value - target) / jnp.where(slope > 1e-6, slope, 1)

    for _ in range(_NEWTON_STEPS):
        x = jnp.clip(newton(x), low, high)
    x = jax.lax.stop_gradient(x)
    inside = (target >= value_low) & (target <= value_high)
    return jnp.where(inside, newton(x), x)


_BROWN = ("k1", "k2", "p1", "p2", "k3")
LENSES = {
    "none": LensModel((), _pinhole, _pinhole_bearing, MIN_DEPTH_RATIO, _pinhole_rises),
    "radtan": LensModel(_BROWN, _radtan, _radtan_bearing, MIN_DEPTH_RATIO, _radtan_rises),
    "rational": LensModel(
        (*_BROWN, "k4", "k5", "k6"), _radtan, _radtan_bearing, MIN_DEPTH_RATIO, _radtan_rises
    ),
    "equidistant": LensModel(
        ("k1", "k2", "k3", "k4"), _equidistant, _equidistant_bearing, -0.99, _equidistant_rises
    ),
}
MOST_COEFFICIENTS = max(len(lens.coefficients) for lens in LENSES.values())


def image_of(
    lens: str, points: Float[Array, "3 ..."], coefficients: Float[Array, "8 ..."]
) -> Image:
    """Images (2, ...) at focal length 1 of points (3, ...), and their slopes (3, 2, ...)."""
    kind = LENSES[lens]
    return kind.image(points, coefficients[: len(kind.coefficients)])


def can_be_seen(
    lens: str, points: Float[Array, "3 ..."], coefficients: Float[Array, "8 ..."]
) -> Bool[Array, "..."]:
    """Whether points (3, ...) lie before the lens, and where its image is still one-to-one.

    A polynomial that was fitted up to some angle may fold beyond: it draws points from there into
    the image that no camera sees there.
    """
    kind = LENSES[lens]
    depth_ratio = points[2] / jnp.maximum(safe_norm(jnp.moveaxis(points, 0, -1)), 1e-12)
    before = depth_ratio > kind.least_depth_ratio
    return before & kind.rises(points, coefficients[: len(kind.coefficients)])


def bearing_of(
    lens: str, xy: Float[Array, "*batch 2"], coefficients: Float[Array, " 8"]
) -> Float[Array, "*batch 3"]:
    """Unit vectors (..., 3) in the camera frame through images (..., 2) at focal length 1."""
    kind = LENSES[lens]
    return kind.bearing(xy, coefficients[: len(kind.coefficients)])
