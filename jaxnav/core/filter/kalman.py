"""The linear Kalman filter: predict and update, independent of any vehicle.

Source: Liu, Schofield, Shan (2023), Eqs. 8-11; the covariance update in the form of Bucy and
Joseph (1968), since Eq. 11's (I - K H) P loses positive definiteness in float32.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnav.core.linalg.small_matrices import (
    cho_solve,
    cholesky,
    log_det,
    matvec,
    product,
    solve_lower,
)

# A variance never falls below this fraction of the largest one.
_RELATIVE_FLOOR = 1e-12


def update(
    P: Float[Array, "n n"],
    innovation: Float[Array, " m"],
    H: Float[Array, "m h"],
    R: Float[Array, "m m"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"], Float[Array, "m m"]]:
    """One update of a linear Kalman filter, in Joseph's form.

        S = H P H' + R,  K = P H' S^-1,  P = (I - K H) P (I - K H)' + K R K'

    Args:
        H: by the first h states; the others are not measured.

    Returns:
        Correction K @ innovation (n,) of the mean, posterior covariance (n, n), and S (m, m).

    A measurement that is missing is a zero row of H with a zero innovation and a unit variance,
    uncorrelated with the rest: it changes nothing (see `hide_rows`).

    Source: Liu, Schofield, Shan (2023), Eqs. 10 and 11; Bucy, Joseph (1968).
    """
    h = H.shape[1]
    HP = product(H, P[:h])
    S = symmetrise(product(HP[:, :h], H.T) + R)
    K = cho_solve(cholesky(S), HP).T
    left = P - product(K, HP)  # (I - K H) P
    rounding = product(left[:, :h], H.T) - product(K, R)  # 0, were K exact
    posterior = symmetrise(left - product(rounding, K.T))
    return matvec(K, innovation), add_floor(posterior, P), S


def replace_first(P: Float[Array, "n n"], H: Float[Array, "k h"]) -> Float[Array, "n n"]:
    """The covariance of a state whose first k entries are replaced by H x of its first h, x."""
    k, h = H.shape
    top = product(H, P[:h])
    corner = symmetrise(product(top[:, :h], H.T))
    return P.at[:k].set(top).at[:, :k].set(top.T).at[:k, :k].set(corner)


def hide_rows(
    innovation: Float[Array, " m"],
    H: Float[Array, "m h"],
    R: Float[Array, "m m"],
    present: Float[Array, " m"],
) -> tuple[Float[Array, " m"], Float[Array, "m h"], Float[Array, "m m"]]:
    """(innovation, H, R) with the rows where `present` is 0 made ineffective; 1 keeps a row."""
    kept = present[:, None] * present[None, :]
    return present * innovation, present[:, None] * H, kept * R + jnp.diag(1 - present)


def whiten(innovation: Float[Array, " m"], S: Float[Array, "m m"]) -> Float[Array, " m"]:
    """L^-1 innovation with S = L L': uncorrelated entries of variance 1."""
    return solve_lower(cholesky(S), innovation)


def nis(innovation: Float[Array, " m"], S: Float[Array, "m m"]) -> Float[Array, ""]:
    """Normalised innovation squared, innovation' S^-1 innovation: chi-square with m dof."""
    return jnp.sum(whiten(innovation, S) ** 2)


def log_likelihood(innovation: Float[Array, " m"], S: Float[Array, "m m"]) -> Float[Array, ""]:
    """log N(innovation; 0, S) without its constant, -m log(2 pi) / 2."""
    factor = cholesky(S)
    return -(jnp.sum(solve_lower(factor, innovation) ** 2) + log_det(factor)) / 2


def add_floor(posterior: Float[Array, "n n"], prior: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The posterior plus a floor, 1e-12 of the prior's largest variance, on its diagonal."""
    floor = _RELATIVE_FLOOR * jnp.max(jnp.diagonal(prior))
    return posterior + floor * jnp.eye(prior.shape[0], dtype=prior.dtype)


def symmetrise(P: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """(P + P') / 2."""
    return (P + P.T) / 2


def as_covariance(sigma: Float[Array, " d"] | Float[Array, "d d"]) -> Float[Array, "d d"]:
    """diag(sigma^2) of standard deviations (d,); a covariance (d, d) is returned as it is."""
    return jnp.diag(sigma**2) if sigma.ndim == 1 else sigma


def as_matrix(density: Float[Array, " d"] | Float[Array, "d d"]) -> Float[Array, "d d"]:
    """diag(density) of a vector (d,); a matrix (d, d) is returned as it is."""
    return jnp.diag(density) if density.ndim == 1 else density


def white_acceleration(
    density: Float[Array, " d"] | Float[Array, "d d"], dt_s: Float[Array, ""] | float
) -> Float[Array, "2*d 2*d"]:
    """Q of a position-velocity state driven by white acceleration of density D:

        Q = [D dt^3 / 3, D dt^2 / 2; D dt^2 / 2, D dt].

    Args:
        density: power spectral density, (m/s^2)^2/Hz or (rad/s^2)^2/Hz: of each axis, or a matrix.
        dt_s: sample period.

    Source: Bar-Shalom, Li, Kirubarajan (2001), Eq. 6.2.2-12.
    """
    D = as_matrix(density)
    return jnp.block([[D * dt_s**3 / 3, D * dt_s**2 / 2], [D * dt_s**2 / 2, D * dt_s]])
