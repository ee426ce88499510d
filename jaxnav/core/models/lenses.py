"""Project through a lens, with derivatives, and invert it; a new lens is a row of `LENSES`.

The coordinate axis comes first: points (3, ...) in m in the camera frame, images (2, ...) at focal
length 1, slopes (3, 2, ...) with respect to the point's coordinates, per m. Coefficients are in the
order of OpenCV, each a number or an array that broadcasts with the points; a lens gets its own.

A pinhole's image is bent by OpenCV's models of five, eight and twelve coefficients (Brown, 1966,
"Decentering distortion of lenses"; k4 k5 k6 are OpenCV's rational model, s1 to s4 its thin prism).
An equidistant lens bends the angle by a polynomial: OpenCV's fisheye, Kalibr's equidistant (Kannala
and Brandt, 2006, "A generic camera model and calibration method for conventional, wide-angle, and
fish-eye lenses").

Wide lenses in closed form draw a point by way of a sphere or an ellipsoid: they divide x and y by
a sum,

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

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from jaxnav.core.models.geometry import on_last_axis, safe_norm, safe_sqrt

# Points nearer to the camera's plane than this multiple of their distance are projected with this
# depth: finite and far outside of any image instead of infinite or mirrored.
MIN_DEPTH_RATIO = 1e-3
# A lens sees up to where its image still moves outwards by this part of its radius a radian: nearer
# to the fold float32 tells a ray to no more than 1e-5.
LEAST_RISE = 0.03
_SAME = 0.75  # power of the rounding: rays that differ by less, 6e-6 or 2e-12, are one
_TABLE_SIZE = 96  # of the first look at a function that is to be inverted
_FINE = 64  # of the second, over two cells of the first
_NEWTON_STEPS = 4

Points = Float[Array, "3 ..."]
Images = Float[Array, "*batch 2"]
Rays = Float[Array, "*batch 3"]
Numbers = Float[Array, "k ..."]  # coefficients; those of one lens, or of every point
Image = tuple[Float[Array, "2 ..."], Float[Array, "3 2 ..."]]


def along(constant: Shaped[Array, "..."], points: Float[Array, "..."]) -> Shaped[Array, "..."]:
    """The constant with trailing axes of length 1, to broadcast over all points."""
    return constant.reshape(*constant.shape, *(1,) * (points.ndim - 1))


def safe_length(points: Float[Array, "n ..."]) -> Float[Array, "..."]:
    """Lengths over the first axis; 0 has the derivative 0."""
    return safe_sqrt(jnp.sum(points**2, axis=0))


def comes_back(rays: Rays, points: Points) -> Bool[Array, "..."]:
    """Whether rays (..., 3), through the images of points (3, ...), lead to these points.

    They do not where another point has the same image: beyond a fold, or off the end of a table.
    """
    straight = points / jnp.maximum(safe_length(points), 1e-12)[None]
    apart = jnp.max(jnp.abs(jnp.moveaxis(rays, -1, 0) - straight), axis=0)
    return apart < float(jnp.finfo(points.dtype).eps) ** _SAME


def towards(xy: Images, depth: Float[Array, "*batch"] | float = 1.0) -> Rays:
    """Unit vectors (..., 3) along (x, y, depth); depth 1: through images of a pinhole."""
    z = jnp.broadcast_to(jnp.asarray(depth, xy.dtype), xy.shape[:-1])
    ray = jnp.concatenate([xy, z[..., None]], axis=-1)
    return ray / jnp.sqrt(jnp.sum(ray**2, axis=-1, keepdims=True))


def inverted(
    profile: Callable[[Array], Array],
    target: Float[Array, "*batch"],
    place: Callable[[np.ndarray], np.ndarray],
) -> Float[Array, "*batch"]:
    """The smallest x >= 0 with profile(x) = target: table look-up, then Newton in its cell.

    The table ends where the profile stops rising: the lens is one-to-one up to there, and a target
    beyond gets that end. Only the last Newton step carries the gradient, which is that of the
    implicit function.

    Args:
        place: of evenly spaced numbers from 0 to 1, where the profile is looked at.
    """
    grid = jnp.asarray(place(np.linspace(0, 1, _TABLE_SIZE)), target.dtype)
    values = profile(grid)
    # The end is beside the last value before one that falls, before it or after.
    last = jnp.sum(_rising(values)) - 1
    folds = last < _TABLE_SIZE - 1
    before = jnp.maximum(last - 1, 0)
    after = grid[jnp.minimum(last + 1, _TABLE_SIZE - 1)]
    fine = grid[before] + (after - grid[before]) * jnp.linspace(0, 1, _FINE, dtype=grid.dtype)
    fine_values = profile(fine)
    at_end = jnp.sum(_rising(fine_values)) - 1
    kept = jnp.arange(_TABLE_SIZE) <= before
    grid = jnp.where(kept, grid, fine[at_end])
    values = jnp.where(kept, values, fine_values[at_end])

    reached = on_last_axis(values, target[..., None]) <= target[..., None]
    cell = jnp.clip(jnp.sum(reached, axis=-1) - 1, 0, before)
    low, high = grid[cell], grid[cell + 1]
    value_low, value_high = values[cell], values[cell + 1]
    span = jnp.where(value_high > value_low, value_high - value_low, 1)
    part = jnp.clip((target - value_low) / span, 0, 1)
    # Near the fold the profile is a parabola.
    part = jnp.where(folds & (cell == before), 1 - jnp.sqrt(1 - part), part)
    x = low + (high - low) * part

    def newton(x: Array) -> Array:
        value, slope = jax.jvp(profile, (x,), (jnp.ones_like(x),))
        return x - (value - target) / jnp.where(slope > 1e-6, slope, 1)

    for _ in range(_NEWTON_STEPS):
        x = jnp.clip(newton(x), low, high)
    x = jax.lax.stop_gradient(x)
    inside = (target >= value_low) & (target <= value_high)
    return jnp.where(inside, newton(x), x)


def _rising(values: Array) -> Array:
    """For each value whether it, and all before it, are larger than the one before."""
    return jnp.concatenate([jnp.ones(1, bool), jnp.cumprod(jnp.diff(values) > 0).astype(bool)])


# A bent image is inverted up to this angle off the axis.
_WIDEST_RAD = np.deg2rad(89.0)
_LEAST_DENOMINATOR = 1e-3  # bound for a rational lens far outside of its fitted range

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


class _Sum(NamedTuple):
    """The factors of D; each a number or an array that broadcasts with the points."""

    a: Array
    b: Array
    beta: Array


def omni(points: Points, coefficients: Numbers) -> Image:
    return bent(_divided(points, *_straight(points), _of_omni(coefficients)), _brown(coefficients))


def omni_bearing(xy: Images, coefficients: Numbers) -> Rays:
    return towards(*_raised(unbent(xy, _brown(coefficients)), _of_omni(coefficients)))


def omni_sees(points: Points, coefficients: Numbers) -> Bool[Array, "..."]:
    image, _ = omni(points, coefficients)
    ray = omni_bearing(jnp.moveaxis(image, 0, -1), coefficients)
    return _sees(points, points[2], _of_omni(coefficients)) & comes_back(ray, points)


def eucm(points: Points, coefficients: Numbers) -> Image:
    return _divided(points, *_straight(points), _of_eucm(coefficients))


def eucm_bearing(xy: Images, coefficients: Numbers) -> Rays:
    return towards(*_raised(xy, _of_eucm(coefficients)))


def eucm_sees(points: Points, coefficients: Numbers) -> Bool[Array, "..."]:
    return _sees(points, points[2], _of_eucm(coefficients))


def double_sphere(points: Points, coefficients: Numbers) -> Image:
    return _divided(points, *_behind(points, coefficients[0]), _of_double_sphere(coefficients))


def double_sphere_bearing(xy: Images, coefficients: Numbers) -> Rays:
    xi = coefficients[0]
    xy, w = _raised(xy, _of_double_sphere(coefficients))
    r2 = jnp.sum(xy**2, axis=-1)
    # From the second sphere's middle along (x, y, w) to the first sphere, of radius 1.
    length = (w * xi + safe_sqrt(w**2 + (1 - xi**2) * r2)) / (w**2 + r2)
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
    return safe_sqrt(beta * (points[0] ** 2 + points[1] ** 2) + w**2)


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
    return xy, (1 - a**2 * beta * r2) / (b + a * safe_sqrt(1 - folding * r2))


_INFINITE = float("inf")


class LensModel(NamedTuple):
    """A kind of lens: its coefficients, its projection and the inverse."""

    coefficients: tuple[str, ...]
    # Of points and coefficients, with the slope.
    image: Callable[[Float[Array, "3 ..."], Float[Array, "k ..."]], Image]
    # Unit vectors through images.
    bearing: Callable[[Float[Array, "*batch 2"], Float[Array, " k"]], Float[Array, "*batch 3"]]
    # Whether points can be seen: before the lens, and before its image stops moving outwards.
    sees: Callable[[Float[Array, "3 ..."], Float[Array, "k ..."]], Bool[Array, "..."]]
    # Coefficients that the formula bounds: the least and the most.
    within: Mapping[str, tuple[float, float]] = {}


_BROWN = ("k1", "k2", "p1", "p2", "k3")
_BELOW = ("k4", "k5", "k6")
_BENT = (radtan, radtan_bearing, radtan_sees)
_ALPHA = (0.0, 1.0)
LENSES = {
    "none": LensModel((), pinhole, pinhole_bearing, pinhole_sees),
    "radtan": LensModel(_BROWN, *_BENT),
    "rational": LensModel((*_BROWN, *_BELOW), *_BENT),
    "thin_prism": LensModel((*_BROWN, *_BELOW, "s1", "s2", "s3", "s4"), *_BENT),
    "equidistant": LensModel(
        ("k1", "k2", "k3", "k4"),
        equidistant,
        equidistant_bearing,
        equidistant_sees,
    ),
    "omni": LensModel(
        ("xi", "k1", "k2", "p1", "p2"),
        omni,
        omni_bearing,
        omni_sees,
        {"xi": (0.0, _INFINITE)},
    ),
    "double_sphere": LensModel(
        ("xi", "alpha"),
        double_sphere,
        double_sphere_bearing,
        double_sphere_sees,
        {"xi": (-0.99, 1.0), "alpha": _ALPHA},
    ),
    "eucm": LensModel(
        ("alpha", "beta"),
        eucm,
        eucm_bearing,
        eucm_sees,
        {"alpha": _ALPHA, "beta": (0.0, _INFINITE)},
    ),
}
MOST_COEFFICIENTS = max(len(lens.coefficients) for lens in LENSES.values())


def image_of(
    lens: str, points: Float[Array, "3 ..."], coefficients: Float[Array, "12 ..."]
) -> Image:
    """Images (2, ...) at focal length 1 of points (3, ...), and their slopes (3, 2, ...)."""
    kind = LENSES[lens]
    return kind.image(points, coefficients[: len(kind.coefficients)])


def can_be_seen(
    lens: str, points: Float[Array, "3 ..."], coefficients: Float[Array, "12 ..."]
) -> Bool[Array, "..."]:
    """Whether points (3, ...) lie before the lens, and where its image is still one-to-one.

    A lens that was fitted up to some angle may fold beyond: it draws points from there into the
    image that no camera sees there.
    """
    kind = LENSES[lens]
    return kind.sees(points, coefficients[: len(kind.coefficients)])


def bearing_of(
    lens: str, xy: Float[Array, "*batch 2"], coefficients: Float[Array, " 12"]
) -> Float[Array, "*batch 3"]:
    """Unit vectors (..., 3) in the camera frame through images (..., 2) at focal length 1."""
    kind = LENSES[lens]
    return kind.bearing(xy, coefficients[: len(kind.coefficients)])
