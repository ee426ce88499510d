"""What families of lenses share: shapes, where an image ends, and the inverse of a function."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Shaped

from jaxnav.core.models.geometry import on_last_axis

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
    squared = jnp.sum(points**2, axis=0)
    nonzero = squared > 0
    return jnp.where(nonzero, jnp.sqrt(jnp.where(nonzero, squared, 1)), 0)


def comes_back(rays: Rays, points: Points) -> Bool[Array, "..."]:
    """Whether rays (..., 3), through the images of points (3, ...), lead to these points.

    They do not where another point has the same image: beyond a fold, or off the end of a table.
    """
    straight = points / jnp.maximum(safe_length(points), 1e-12)[None]
    apart = jnp.max(jnp.abs(jnp.moveaxis(rays, -1, 0) - straight), axis=0)
    return apart < float(jnp.finfo(points.dtype).eps) ** _SAME


def towards(xy: Images) -> Rays:
    """Unit vectors (..., 3) through images (..., 2) of a pinhole at focal length 1."""
    ray = jnp.concatenate([xy, jnp.ones_like(xy[..., :1])], axis=-1)
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
