"""The rest of a state after its pose was corrected."""

import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Float

from jaxnav.core.filter import kalman
from jaxnav.core.filter.ambiguity import PosePosterior
from jaxnav.core.filter.camera_errors import ridge
from jaxnav.core.linalg.small_matrices import (
    cholesky,
    gram,
    matvec,
    product,
    sandwich,
    solve_lower,
    solve_upper,
)
from jaxnav.core.models.geometry import inverse_cayley, inverse_cayley_jacobian


def follow_pose(
    P: Float[Array, "n n"],
    T_world_prior: jaxlie.SE3,
    posterior: PosePosterior,
    freedom: Float[Array, "6 d"],
    states: int,
    behind: int = 0,
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The whole state after its pose was corrected: the rest follows by regression.

    With y = (xi, q), the pose's error and the errors of the cameras in view, the rest v, and the
    gain G = P_vy P_yy^-1:

        v += G y,    P_vx = G M C,    P_vv = P_vv - G P_yv + G C_y G',

    where C is the covariance of the corrected pose, M carries its error to y, and
    C_y = M C M' + the covariance of q given the pose.

    What C is inflated by widens pose and velocity alone. Errors that are only considered keep their
    covariance, and would be correlated with a wider pose by more than they vary.

    Args:
        P: (n, n) of the predicted state, whose first d entries are
            xi = freedom' cay^-1(T_world_prior^-1 T_world_vehicle), and whose last ones are the
            cameras' errors, but for `behind`.
        T_world_prior: the predicted pose.
        posterior: the corrected pose, with a covariance in its own axes, and the errors in view.
        freedom: (6, d), the directions in which the vehicle can move.
        states: of pose and velocity, before the errors.
        behind: states behind the cameras' errors.

    Returns:
        Correction (n,) of the state, the pose's d entries included, and the covariance after it.
    """
    d, n = freedom.shape[1], P.shape[0]
    end = n - behind
    away = inverse_cayley(T_world_prior.inverse() @ posterior.T_world_vehicle)
    xi = matvec(freedom.T, away)
    C = sandwich(freedom.T, posterior.covariance) / posterior.inflation
    # Error at the corrected pose -> at the prediction.
    M = sandwich(freedom.T, inverse_cayley_jacobian(away))
    y, P_yy, P_y, given_pose = xi, P[:d, :d], P[:d], None
    errors = posterior.errors
    if errors is not None:
        M = jnp.concatenate([M, errors.slope])
        y = jnp.append(xi, errors.change)
        e = errors.rows.shape[1]
        P_y = jnp.concatenate([P_y, product(errors.rows, P[end - e : end])])
        of_errors = product(P_y[:, end - e : end], errors.rows.T)
        P_yy = jnp.block([[P_yy, of_errors[:d]], [of_errors[:d].T, of_errors[d:]]])
        hidden = 1 - jnp.sum(errors.rows, axis=1)
        P_yy = P_yy + jnp.diag(jnp.append(jnp.zeros(d, P.dtype), hidden + ridge(P.dtype)))
        given_pose = errors.covariance
    factor = cholesky(P_yy)
    whitened = solve_lower(factor, P_y[:, d:])
    gain = solve_upper(factor, whitened).T  # of the rest on y, (n - d, len(y))
    rest = P[d:, d:] - gram(whitened.T)
    if given_pose is not None:
        rest = rest + sandwich(gain[:, d:], given_pose)
    # Not as P plus a correction: the pose would keep the rounding of its prediction, which may be
    # thousands of times as wide.
    by_pose = sandwich(jnp.concatenate([jnp.eye(d, dtype=C.dtype), product(gain, M)]), C)
    after = kalman.symmetrise(by_pose.at[d:, d:].add(rest))
    wider = (posterior.inflation - 1) * by_pose[:states, :states]
    after = after.at[:states, :states].add(wider)
    return jnp.append(xi, matvec(gain, y)), kalman.add_floor(after, P)
