"""Geometry of a marker's paper under a homography: coordinates, their derivatives, blur on it.

In paper coordinates the marker is [-1, 1]^2, x right, y down. The last axis counts pixels, so that
sums over the few leading entries run over long rows. Functions accept NumPy and JAX arrays.
"""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

Numbers = Any  # a NumPy or a JAX array; functions return the kind they get

SQUARE = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])  # TL TR BR BL


def on_paper(M: Numbers, rays: Numbers, rays_px: Numbers) -> tuple[Numbers, Numbers]:
    """Intersect rays with the paper.

    Args:
        M: (3, 3), takes rays to the paper's (x, y, 1), up to scale.
        rays: (3, N).
        rays_px: (2, 3, N), their derivatives by the pixel's u and v.

    Returns:
        xy (2, N), and its derivatives (2, 2, N): [by u or v, of x or y].
    """
    xyw, xyw_px = M @ rays, M[None] @ rays_px
    xy = xyw[:2] / xyw[2:]
    return xy, (xyw_px[:, :2] - xy[None] * xyw_px[:, 2:]) / xyw[None, 2:]


def generators(xy: Numbers) -> Numbers:
    """Derivatives (2, 8, N) of paper coordinates (2, N) by D, when M becomes (I + D) M.

    D is taken by rows, without its last entry.
    """
    numbers = _library(xy)
    x, y = xy
    zero, one = numbers.zeros_like(x), numbers.ones_like(x)
    along_x = [x, y, one, zero, zero, zero, -x * x, -x * y]
    along_y = [zero, zero, zero, x, y, one, -x * y, -y * y]
    return numbers.stack([numbers.stack(along_x), numbers.stack(along_y)])


def blur_on_paper(xy_px: Numbers, S: Numbers) -> Numbers:
    """Covariance (3, N) on the paper, xx yy xy, of a blur S (xx, xy, yy) in the image, px^2.

    Args:
        xy_px: (2, 2, N), derivatives of paper coordinates by pixel.
        S: (3,).
    """
    (a, c), (b, d) = xy_px
    xx = a * a * S[0] + 2 * a * b * S[1] + b * b * S[2]
    yy = c * c * S[0] + 2 * c * d * S[1] + d * d * S[2]
    xy = a * c * S[0] + (a * d + b * c) * S[1] + b * d * S[2]
    return _library(xy_px).stack([xx, yy, xy])


def homography(rays: Float[np.ndarray, "4 3"]) -> Float[np.ndarray, "3 3"]:
    """The homography M (3, 3) that takes the corner rays (4, 3), TL TR BR BL, to the paper."""
    M = _basis(np.column_stack([SQUARE, np.ones(4)])) @ np.linalg.inv(_basis(rays))
    return M / (M @ rays.mean(axis=0))[2]


def rays_of(M: Float[np.ndarray, "3 3"], xy: Float[np.ndarray, "N 2"]) -> Float[np.ndarray, "N 3"]:
    """Rays (N, 3) through points (N, 2) on the paper."""
    return np.linalg.solve(M, np.vstack([xy.T, np.ones(len(xy))])).T


def _basis(points: np.ndarray) -> np.ndarray:
    # Takes the unit vectors and (1, 1, 1) to the four points, up to scale.
    first = points[:3].T
    return first * np.linalg.solve(first, points[3])


def _library(array: Numbers) -> Any:
    return jnp if isinstance(array, jax.Array) else np
