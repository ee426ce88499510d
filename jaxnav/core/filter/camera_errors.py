"""Errors of the cameras' places and directions, as a filter keeps them behind its own states.

Each camera has six, in units of their prior's sigma (`CameraRig.extrinsics_sigma`). A pose is
solved together with those of the cameras in view: given the pose the errors are Gaussian, and are
eliminated from the residuals; the filter then corrects them, and all that is correlated with them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.typing import DTypeLike
from jaxtyping import Array, Float

from jaxnav.core.linalg.small_matrices import (
    cholesky,
    gram,
    matvec,
    product,
    sandwich,
    solve_lower,
)
from jaxnav.core.models.geometry import safe_norm
from jaxnav.core.pose.nuisance import CameraSlopes, Nuisance

EACH = 3  # states of a camera


def ridge(dtype: DTypeLike) -> Float[Array, ""]:
    """Variance that keeps what the pose leaves of an error positive where rounding would not."""
    return jnp.sqrt(jnp.finfo(dtype).eps) / 10


class CameraErrors(eqx.Module):
    """The prediction of all cameras' errors by K hypotheses."""

    mean: Float[Array, "*K e"]
    covariance: Float[Array, "*K e e"]
    cross: Float[Array, "*K 6 e"]  # with xi in T_world_vehicle * exp(xi)

    def fresh(self) -> "CameraErrors":
        """The errors of which nothing is known but the prior."""
        eye = jnp.eye(self.mean.shape[-1], dtype=self.mean.dtype)
        return CameraErrors(
            jnp.zeros_like(self.mean),
            jnp.broadcast_to(eye, self.covariance.shape),
            jnp.zeros_like(self.cross),
        )


class ErrorsPosterior(eqx.Module):
    """The errors of the cameras in view, given the corrected pose: N(mean + slope xi, covariance).

    xi is the pose's error in the corrected pose's own axes, along its freedom.
    """

    change: Float[Array, "*K t"]  # of the mean, at the corrected pose
    slope: Float[Array, "*K t d"]
    covariance: Float[Array, "*K t t"]
    rows: Float[Array, "*K t e"]  # selects them among all cameras' errors; zero: not in view


class ErrorsInView(eqx.Module):
    """The errors q of the cameras in view beside the pose, of K hypotheses.

        q = mean + by_pose u + root w,      u, w ~ N(0, I),

    where u is the pose in units of its own sigma.
    """

    mean: Float[Array, "t K"]
    by_pose: Float[Array, "t d K"]
    root: Float[Array, "t t K"]
    rows: Float[Array, "t e"]
    slopes: Float[Array, "t m"]  # of the residuals by q

    @staticmethod
    def beside(
        pose_root: Float[Array, "K d d"],
        freedom: Float[Array, "6 d"],
        errors: CameraErrors,
        moves: CameraSlopes,
    ) -> "ErrorsInView":
        """The errors in view, given poses whose covariance is pose_root pose_root'."""
        groups, e = moves.camera.shape[0], errors.mean.shape[1]
        of_group = moves.camera[:, None] == jnp.arange(e // EACH)[None]
        of_group = (of_group & moves.in_view[:, None]).astype(errors.mean.dtype)
        rows = jnp.kron(of_group, jnp.eye(EACH, dtype=errors.mean.dtype))
        hidden = jnp.repeat(1 - moves.in_view.astype(rows.dtype), EACH)
        slopes = moves.turns.transpose(2, 0, 1).reshape(groups * EACH, -1)

        def one(L: Array, mean: Array, P: Array, cross: Array) -> tuple[Array, Array, Array]:
            C = product(product(freedom.T, cross), rows.T)  # (d, t)
            by_pose = solve_lower(L, C).T
            left = sandwich(rows, P) - gram(by_pose) + jnp.diag(hidden + ridge(rows.dtype))
            return matvec(rows, mean), by_pose, cholesky(left)

        mean, by_pose, root = jax.vmap(one, out_axes=-1)(
            pose_root, errors.mean, errors.covariance, errors.cross
        )
        return ErrorsInView(mean, by_pose, root, rows, slopes)

    def nuisance(self, places: Nuisance) -> Nuisance:
        """w, which moves the residuals, the places eliminated, by slopes' root w."""
        slopes = places.eliminated(self.slopes[..., None])[..., 0]
        return Nuisance.of(self._moved(self.root, slopes)[:, :, None])

    def offset(self) -> Float[Array, "m K"]:
        """By how much the mean moves the residuals."""
        return jnp.sum(self.mean[:, None] * self.slopes[..., None], axis=0)

    def with_pose(self) -> Float[Array, "d m K"]:
        """Derivative of the residuals by u through the errors that come with it."""
        return self._moved(self.by_pose, self.slopes)

    @staticmethod
    def _moved(by: Float[Array, "t n K"], slopes: Float[Array, "t m"]) -> Float[Array, "n m K"]:
        return jnp.sum(by[:, :, None] * slopes[:, None, :, None], axis=0)


def common_turn(errors: ErrorsPosterior, sigma_rad: Float[Array, "C 3"]) -> Float[Array, "e 3"]:
    """Errors by which all cameras in view turn alike, about each axis, of length 1; else 0.

    A body that turns the other way sees the same: where no odometry tells how it moves, nothing
    does. A filter would learn that turn all the same, of the changes of its own twist, and grow
    sure of it: 4 degrees on test_5 of TagSLAM, with a sigma of 0.1 (Huang, Mourikis, Roumeliotis,
    2010, "Observability-based rules for designing consistent EKF SLAM estimators").

    Args:
        errors: of one hypothesis.
        sigma_rad: prior of the cameras' turns.
    """
    turns = jnp.sum(errors.rows, axis=0).reshape(-1, EACH) / sigma_rad
    length = safe_norm(turns.T)
    turns = turns / jnp.where(length > 0, length, 1)[None]
    return (turns[:, :, None] * jnp.eye(EACH, dtype=turns.dtype)[None]).reshape(-1, EACH)


def not_told(
    directions: Float[Array, "e u"],
    before: Float[Array, "n n"],
    correction: Float[Array, " n"],
    P: Float[Array, "n n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """A correction and its covariance in which some directions of the errors are only considered.

    Args:
        directions: orthonormal, of the e errors at the end of the state; or 0.
        before: covariance before the correction.

    Source: Schmidt (1966), "Application of state-space methods to navigation problems".
    """
    first = P.shape[0] - directions.shape[0]
    back = product(directions, directions.T)
    narrowed = before[first:, first:] - P[first:, first:]
    return (
        correction.at[first:].add(-matvec(back, correction[first:])),
        P.at[first:, first:].add(sandwich(back, narrowed)),
    )


def times(A: Float[Array, "n m K"], B: Float[Array, "k m K"]) -> Float[Array, "n k K"]:
    """A B' of each lane."""
    return jnp.sum(A[:, None] * B[None], axis=2)
