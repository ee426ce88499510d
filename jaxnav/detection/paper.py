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
    numbers = library(xy)
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
    return library(xy_px).stack([xx, yy, xy])


def homography(rays: Numbers) -> Numbers:
    """The homography M (3, 3) that takes the corner rays (4, 3), TL TR BR BL, to the paper."""
    corners = np.column_stack([SQUARE, np.ones(4)]).astype(rays.dtype)
    M = _basis(library(rays).asarray(corners)) @ _inverse(_basis(rays))
    return M / (M @ rays.mean(axis=0))[2]


def rays_of(M: Numbers, xy: Float[np.ndarray, "N 2"]) -> Numbers:
    """Rays (N, 3) through points (N, 2) on the paper."""
    return (_inverse(M) @ np.vstack([xy.T, np.ones(len(xy))]).astype(M.dtype)).T


def corner_motion(M: Numbers, rays: Numbers, rays_px: Numbers) -> Numbers:
    """Derivatives (8, 8) of the corners' pixels, u and v of each in turn, by D, when M becomes
    (I + D) M.

    A corner's pixel moves so that its ray stays on the corner while the paper moves.

    Args:
        rays: (3, 4), of the corners, TL TR BR BL.
        rays_px: (2, 3, 4), their derivatives by pixel.
    """
    numbers = library(M)
    (a, c), (b, d) = on_paper(M, rays, rays_px)[1][..., None, :]
    by_x, by_y = generators(numbers.asarray(SQUARE.T.astype(M.dtype)))
    det = a * d - b * c
    by_D = numbers.stack([(d * by_x - b * by_y) / det, (a * by_y - c * by_x) / det])
    return -by_D.transpose(2, 0, 1).reshape(8, 8)


def _basis(points: Numbers) -> Numbers:
    # Takes the unit vectors and (1, 1, 1) to the four points, up to scale.
    first = points[:3].T
    return first * (_inverse(first) @ points[3])[None]


def _inverse(A: Numbers) -> Numbers:
    """The inverse of a matrix (3, 3), not finite where it has none."""
    if isinstance(A, np.ndarray):
        return np.linalg.inv(A)
    a, b, c = A.T
    rows = jnp.stack([jnp.cross(b, c), jnp.cross(c, a), jnp.cross(a, b)])
    return rows / (rows[0] @ a)


def library(array: Numbers) -> Any:
    """`jax.numpy` for a JAX array, `numpy` for another."""
    return jnp if isinstance(array, jax.Array) else np
