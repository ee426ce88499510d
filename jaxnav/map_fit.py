"""The update of one hypothesis: the minimum of the paper's e next to its prediction.

    e(T) = |r(T)|^2 / sigma^2 + |xi|^2_P,      T = T_prior cay(xi),

minimised over the directions in which the vehicle can move, instead of compared at two poses; with
Laplace's evidence for the prediction, which weighs it.

Source: Liu, Schofield, Shan (2023), Eq. 13; MacKay (2003), chapter 27.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxnav.ambiguity import PoseBelief, PosePosterior
from jaxnav.geometry import cayley, cayley_jacobian, cayley_points, transform_points
from jaxnav.levenberg_marquardt import ImplicitGradient, NormalEquationsLM
from jaxnav.observation import Snapshot
from jaxnav.residuals import reprojection_residuals
from jaxnav.small_matrices import (
    cho_solve,
    cholesky,
    log_det,
    product,
    sandwich,
    solve_lower,
    solve_upper,
)


class Fit(eqx.Module):
    """The minimum of e next to a prediction."""

    posterior: PosePosterior
    cost: Float[Array, ""]  # |r|^2 / sigma^2 at the minimum
    log_evidence: Float[Array, ""]
    finite: Bool[Array, ""]


def fit(
    T_world_prior: jaxlie.SE3,
    covariance: Float[Array, "6 6"],
    prior: PoseBelief,
    snapshot: Snapshot,
    floor: Float[Array, " 6"],
    max_steps: int,
) -> Fit:
    """Minimise e over u, in units of the prediction's own sigma: xi = freedom L u, P = L L'.

    Args:
        floor: standard deviations (m, rad) of what successive frames get wrong alike, which no
            number of frames averages out.
    """
    freedom, nuisance = prior.freedom, prior.nuisance
    d, dtype = freedom.shape[1], covariance.dtype
    eye = jnp.eye(d, dtype=dtype)
    P = sandwich(freedom.T, covariance)
    usable = jnp.all(jnp.isfinite(P)) & (jnp.min(jnp.diagonal(P)) > 0)
    root = cholesky(jnp.where(usable, P, eye))
    spread = product(freedom, root)
    pixels = reprojection_residuals(snapshot.rig, snapshot.seen)
    corners = transform_points(T_world_prior.inverse(), snapshot.markers.corners_world_m)

    def whitened(xi: Array) -> Array:
        return (pixels(cayley_points(-xi, corners)) / snapshot.seen.sigma_px[..., None]).reshape(-1)

    if nuisance.shape[1]:
        # The nuisance t is small: residuals are linear in it, and its best value in them.
        J_t = jax.jacfwd(lambda t: whitened(nuisance @ t))(jnp.zeros(nuisance.shape[1], dtype))
        factor_t = cholesky(J_t.T @ J_t + jnp.eye(nuisance.shape[1], dtype=dtype))

        def residual(u: Array) -> Array:
            r = whitened(spread @ u)
            t = -cho_solve(factor_t, J_t.T @ r)
            return jnp.concatenate([r + J_t @ t, t])
    else:

        def residual(u: Array) -> Array:
            return whitened(spread @ u)

    tolerance = 1e-10 if dtype == jnp.float64 else 1e-5
    solution: optx.Solution = optx.least_squares(
        lambda u, _: jnp.concatenate([residual(u), u]),
        NormalEquationsLM(rtol=tolerance, atol=tolerance),
        jnp.zeros(d, dtype),
        max_steps=max_steps,
        adjoint=ImplicitGradient(),
        throw=False,
    )
    u = solution.value
    r, push_forward = jax.linearize(residual, u)
    J = jax.vmap(push_forward)(eye).T
    information = J.T @ J
    cost = jnp.sum(r**2)
    log_evidence = -(cost + u @ u) / 2 - log_det(cholesky(information + eye)) / 2

    # What the corners say by themselves: u_alone, with covariance R; fused with the prediction.
    ridge = jnp.sqrt(jnp.finfo(dtype).eps)
    alone = cholesky(information + ridge * eye)
    u_alone = u - cho_solve(alone, J.T @ r)
    unspread = solve_lower(root, eye)
    R = cho_solve(alone, eye)
    R = R + sandwich(unspread, sandwich(freedom.T, jnp.diag(floor**2)))
    sigma = cholesky(R + eye)  # of u_alone about the prediction
    contradiction = solve_lower(sigma, u_alone)
    u_fused = solve_upper(sigma, contradiction)
    # I - (I + R)^-1 = R (I + R)^-1, symmetric.
    C = eye - cho_solve(sigma, eye)
    xi = spread @ u_fused
    T = (T_world_prior @ cayley(xi)).normalize()
    carry = product(cayley_jacobian(xi), spread)
    posterior_covariance = sandwich(carry, (C + C.T) / 2)
    numbers = [T.wxyz_xyz, posterior_covariance.reshape(-1), log_evidence[None], contradiction]
    finite = usable & jnp.all(jnp.isfinite(jnp.concatenate(numbers)))
    return Fit(
        posterior=PosePosterior(
            jaxlie.SE3(jnp.where(finite, T.wxyz_xyz, T_world_prior.wxyz_xyz)),
            jnp.where(finite, posterior_covariance, jnp.eye(6, dtype=dtype)),
            jnp.where(finite, contradiction, jnp.inf),
            jnp.ones((), dtype),
            finite,
        ),
        cost=jnp.where(finite, cost, jnp.inf),
        log_evidence=jnp.where(finite, log_evidence, -jnp.inf),
        finite=finite,
    )
