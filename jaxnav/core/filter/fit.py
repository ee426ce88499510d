"""The pose of each hypothesis at the minimum of the paper's e next to its prediction.

    e(T) = |r(T)|^2 / sigma^2 + |xi|^2_P,      T = T_prior cay(xi),

minimised over the directions in which the vehicle can move, instead of compared at two poses.
Laplace's evidence at the minimum weighs the hypothesis. r are the residuals of the corners, P is
the covariance of the prediction.

Source: Liu, Schofield, Shan (2023), Eq. 13; MacKay (2003), chapter 27.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import optimistix as optx
from jaxtyping import Array, Bool, Float

from jaxnav.core.filter.bank import CameraErrors, PoseBelief
from jaxnav.core.filter.choose import MeasuredPose
from jaxnav.core.filter.errors import ErrorsPosterior, Nuisances
from jaxnav.core.linalg.levenberg_marquardt import (
    ImplicitGradient,
    NormalEquations,
    NormalEquationsLM,
)
from jaxnav.core.linalg.small_matrices import (
    cho_solve,
    cholesky,
    gram,
    log_det,
    matvec,
    product,
    sandwich,
    solve_lower,
    solve_upper,
)
from jaxnav.core.models.geometry import cayley, cayley_jacobian, inverse_cayley_jacobian
from jaxnav.core.pose.observation import Snapshot, log_sigmas
from jaxnav.core.pose.residuals import (
    cross_product,
    in_frames,
    jacobian_by_twist,
    reprojection_rows,
    turn_arms,
    wrench,
)


class PoseFit(eqx.Module):
    """The minimum of e next to each of K predictions."""

    posterior: MeasuredPose
    cost: Float[Array, "*K"]  # |r|^2 / sigma^2 at the minimum
    log_evidence: Float[Array, "*K"]
    finite: Bool[Array, "*K"]


def fit_poses(
    T_world_prior: jaxlie.SE3,
    covariance: Float[Array, "K 6 6"],
    errors: CameraErrors | None,
    prior: PoseBelief,
    snapshot: Snapshot,
    floor: Float[Array, " 6"],
    max_steps: int,
    elsewhere: tuple[Bool[Array, " K"], Float[Array, "K d"]] | None = None,
) -> PoseFit:
    """Minimise e over u, in units of the prediction's own sigma: xi = freedom L u, P = L L'.

        e(u) = |r(T_prior cay(freedom L u))|^2 / sigma^2 + |u|^2

    Args:
        T_world_prior: K predictions, batch axis (K,).
        covariance: (K, 6, 6) of the predictions.
        errors: of the cameras, as predicted; None: those of each frame are new.
        prior: gives `freedom` (6, d) and `nuisance` (6, t).
        snapshot: what is seen.
        floor: (6,) standard deviations (m, rad) of the error that successive frames share, which
            no number of frames averages out.
        max_steps: bound on the LM steps.
        elsewhere: hypotheses that are not searched for but take the corners as linear about
            another pose, and that pose: xi along `freedom`, (K, d).

    Returns:
        K minima, along the leading axis of every leaf.
    """
    freedom = prior.freedom
    d, dtype = freedom.shape[1], covariance.dtype
    eye = jnp.eye(d, dtype=dtype)
    P = jax.vmap(lambda P: sandwich(freedom.T, P))(covariance)
    variances = jnp.diagonal(P, axis1=1, axis2=2)
    usable = jnp.all(jnp.isfinite(P), axis=(1, 2)) & (jnp.min(variances, axis=1) > 0)
    root = jax.vmap(cholesky)(jnp.where(usable[:, None, None], P, eye[None]))
    spread = jax.vmap(lambda L: product(freedom, L))(root)
    corners_world = snapshot.markers.corners_world_m[snapshot.seen.marker_index].reshape(-1, 3)
    corners = in_frames(T_world_prior.inverse(), corners_world)
    nuisances = Nuisances.at_predictions(corners, root, errors, prior, snapshot)
    linearised = _linearised(corners, jnp.moveaxis(spread, 0, -1), nuisances, snapshot)

    def with_prediction(u: Array, _: None) -> tuple[Any, NormalEquations]:
        r, normal = linearised(u)[:2]
        return jnp.concatenate([r, u]), NormalEquations(
            normal.information + eye[:, :, None], normal.gradient + u
        )

    tolerance = 1e-10 if dtype == jnp.float64 else 1e-5
    solution: optx.Solution = optx.least_squares(
        with_prediction,
        NormalEquationsLM(rtol=tolerance, atol=tolerance),
        jnp.zeros((d, covariance.shape[0]), dtype),
        has_aux=True,
        max_steps=max_steps,
        adjoint=ImplicitGradient(),
        throw=False,
    )
    u, linear = solution.value, jnp.zeros_like(usable)
    if elsewhere is not None:
        linear, xi = elsewhere
        u = jnp.where(linear, jax.vmap(solve_lower, out_axes=-1)(root, xi), u)
    r, normal, raw = linearised(u)
    fused: PoseFit = jax.vmap(
        partial(_fused, freedom=freedom, floor=floor), in_axes=(*(0,) * 5, *(-1,) * 6, 0)
    )(
        T_world_prior,
        usable,
        linear,
        root,
        spread,
        u,
        jnp.sum(r**2, axis=0),
        normal.gradient,
        normal.information,
        nuisances.log_share,
        -jnp.broadcast_to(log_sigmas(snapshot.seen), usable.shape),
        nuisances.errors_at_best(u, *raw),
    )
    return fused


def _linearised(
    corners: Float[Array, "3 P K"],
    spread: Float[Array, "6 d K"],
    nuisances: Nuisances,
    snapshot: Snapshot,
) -> Callable[[Float[Array, "d K"]], tuple[Array, NormalEquations, tuple[Array, Array]]]:
    """The whitened residuals as a function of u, with the nuisances eliminated.

    Args:
        corners: in the frame of each prediction.

    Returns:
        A function that maps u (d, K) to residuals (m, K), at the nuisances that minimise them, to
        their normal equations, and to residuals and slopes (d, m, K) before the elimination.
    """
    rows = reprojection_rows(snapshot.rig, snapshot.seen)
    errors = nuisances.with_pose()

    def linearised(u: Array) -> tuple[Array, NormalEquations, tuple[Array, Array]]:
        xi = jnp.sum(spread * u[None], axis=1)
        half, shift = xi[3:] / 2, xi[:3]
        per_norm = 1 / (1 + jnp.sum(half**2, axis=0))
        # cay(-xi) moves the corners; d cay(xi) = cay(xi) cay(J d), see `cayley_jacobian`.
        moved = turn_arms(-half, corners) - (shift + _swung(-half, shift))[:, None]
        turn = (spread[3:] - cross_product(half[:, None], spread[3:])) * per_norm[None, None]
        along = spread[:3] + _swung(-half[:, None], spread[:3])
        along = along - cross_product(shift[:, None] / 2, turn)
        twist = jnp.concatenate([along, turn])
        residual, slope = rows(moved)
        J = -jnp.sum(jacobian_by_twist(slope, moved)[:, None] * twist[:, :, None], axis=0)
        r = residual.reshape(J.shape[1:])
        if errors is not None:
            offset, with_pose = errors
            J = J + with_pose
            r = r + offset + jnp.sum(with_pose * u[:, None], axis=0)
        raw = r, J
        # J and r each by itself: the gradient follows from r and the wrench alone, and so do its
        # derivatives.
        r, J = nuisances.eliminated(r), nuisances.eliminated(J)
        left = r[: residual[..., 0].size]
        w = jnp.concatenate(wrench((left.reshape(residual.shape), slope), moved))
        gradient = -jnp.sum(twist * w[:, None], axis=0)
        if errors is not None:
            gradient = gradient + jnp.sum(errors[1] * left[None], axis=1)
        return r, NormalEquations(gram(J), gradient), raw

    return linearised


def _swung(half: Float[Array, "3 ..."], shift: Float[Array, "3 ..."]) -> Array:
    """cay(xi) shifts by more than `shift`, since it turns meanwhile: the difference, (3, ...)."""
    swing = cross_product(half, shift)
    return (swing + cross_product(half, swing)) / (1 + jnp.sum(half**2, axis=0))[None]


def _fused(
    T_world_prior: jaxlie.SE3,
    usable: Bool[Array, ""],
    linear: Bool[Array, ""],
    root: Float[Array, "d d"],
    spread: Float[Array, "6 d"],
    u: Float[Array, " d"],
    cost: Float[Array, ""],
    gradient: Float[Array, " d"],
    information: Float[Array, "d d"],
    log_share: Float[Array, ""],
    log_scale: Float[Array, ""],
    errors: ErrorsPosterior | None,
    *,
    freedom: Float[Array, "6 d"],
    floor: Float[Array, " 6"],
) -> PoseFit:
    """Posterior and evidence of one hypothesis at its minimum u, or, `linear`, about another u.

    With A = J'J of the corners in units of the prediction's sigma, N the floor in the same units,
    and R = A^-1 + N, the posterior covariance is R (I + R)^-1, the evidence
    -(|r|^2 + |u|^2) / 2 - log |A + I| / 2.
    """
    dtype = u.dtype
    eye = jnp.eye(u.shape[0], dtype=dtype)
    # The minimum of the corners alone, u_alone with covariance R, is fused with the prediction.
    ridge = jnp.sqrt(jnp.finfo(dtype).eps)
    information = information + ridge * eye
    alone, by_corners = cholesky(information), cholesky(information + eye)
    u_alone = u - cho_solve(alone, gradient)
    unspread = solve_lower(root, eye)
    N = sandwich(unspread, sandwich(freedom.T, jnp.diag(floor**2)))
    R = cho_solve(alone, eye) + N
    sigma = cholesky(R + eye)  # of u_alone about the prediction
    contradiction = solve_lower(sigma, u_alone)
    u_fused = solve_upper(sigma, contradiction)
    C = _between(information, N)
    # log p(corners | prediction): the misfit at the best pose, and that pose's distance.
    misfit = cost - jnp.sum(gradient * (u - u_alone))
    least = jnp.where(linear, misfit + jnp.sum(contradiction**2), cost + jnp.sum(u**2))
    log_evidence = log_share - (least + log_det(by_corners)) / 2
    log_likelihood = (
        log_scale
        + log_share
        - (misfit + log_det(alone) + jnp.sum(contradiction**2) + log_det(sigma)) / 2
    )
    xi = matvec(spread, u_fused)
    errors_in_view = None
    if errors is not None:
        # Error at the corrected pose -> at the prediction -> in units of its sigma.
        back = product(unspread, sandwich(freedom.T, inverse_cayley_jacobian(xi)))
        # C0 = (A + I)^-1 is C without the floor; C^-1 = I + L W^-1 L' with A = L L' and
        # W = I + L' N L. Of u the share C0 C^-1 is not floor, and C0 - C0 C^-1 C0 is its rest.
        floor_root = cholesky(eye + sandwich(alone.T, N))
        share = cho_solve(by_corners, eye + gram(solve_lower(floor_root, alone.T).T))
        rest = sandwich(cho_solve(by_corners, alone), eye - cho_solve(floor_root, eye))
        errors_in_view = errors.given_pose(u_fused - u, product(share, back), rest)
    T = (T_world_prior @ cayley(xi)).normalize()
    carry = product(cayley_jacobian(xi), spread)
    posterior_covariance = sandwich(carry, C)
    numbers = [T.wxyz_xyz, posterior_covariance.reshape(-1), log_evidence[None], contradiction]
    finite = usable & jnp.all(jnp.isfinite(jnp.concatenate(numbers)))
    return PoseFit(
        posterior=MeasuredPose(
            jaxlie.SE3(jnp.where(finite, T.wxyz_xyz, T_world_prior.wxyz_xyz)),
            jnp.where(finite, posterior_covariance, jnp.eye(6, dtype=dtype)),
            jnp.where(finite, log_likelihood, 0),
            finite,
            innovation=jnp.where(finite, contradiction, jnp.inf),
            errors=jax.tree.map(lambda leaf: jnp.where(finite, leaf, 0), errors_in_view),
        ),
        cost=jnp.where(finite, jnp.where(linear, misfit, cost), jnp.inf),
        log_evidence=jnp.where(finite, log_evidence, -jnp.inf),
        finite=finite,
    )


def _between(A: Float[Array, "d d"], N: Float[Array, "d d"]) -> Float[Array, "d d"]:
    """R (I + R)^-1 for R = A^-1 + N: the covariance between a prediction I and a measurement R.

    As sums of squares, which no rounding makes indefinite, however much surer than the prediction
    the measurement is: with M = (I + N)^-1 it is M (A + M)^-1 M + M (N + N^2) M.
    """
    eye = jnp.eye(A.shape[0], dtype=A.dtype)
    M = gram(solve_lower(cholesky(eye + N), eye).T)
    corners = solve_lower(cholesky(A + M), M)
    return gram(corners.T) + sandwich(M, N) + gram(product(M, N))
