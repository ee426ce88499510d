"""Motion models: how the belief moves, and how a pose and the odometry correct it.

All share one interface, so that `step` and the selectors know nothing of the state:

    belief = motion.init(hypotheses)
    belief = motion.predict(belief, obs)                         # dt, and odometry where there is
    prior  = motion.poses(belief)                                # what a selector sees
    belief, nis = motion.update(belief, selection, obs)

A belief is a bank of K hypotheses along the leading axis of every leaf. `bicycle_kalman.py` is for
cars, `constant_velocity.py` for everything else.
"""

from collections.abc import Callable
from typing import Any, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav import kalman
from jaxnav.ambiguity import PoseBelief, Selection
from jaxnav.geometry import cayley_jacobian, inverse_cayley, inverse_cayley_jacobian
from jaxnav.observation import Observation
from jaxnav.small_matrices import cho_solve, cholesky, sandwich


class Belief(eqx.Module):
    """K hypotheses: means as the motion model stores them, covariances, weights."""

    mean: Float[Array, "*K n"]
    covariance: Float[Array, "*K d d"]
    log_weight: Float[Array, "*K"]
    initialised: Bool[Array, "*K"]
    rejections: Int[Array, "*K"]  # measured poses in a row that the gate kept out


@runtime_checkable
class Motion(Protocol):
    """What `Navigator` asks of a motion model."""

    def init(self, hypotheses: int = 1) -> Belief: ...
    def predict(self, belief: Belief, obs: Observation) -> Belief: ...
    def poses(self, belief: Belief) -> PoseBelief: ...
    def update(
        self, belief: Belief, selection: Selection, obs: Observation
    ) -> tuple[Belief, Float[Array, " K"]]: ...


def unstarted(mean: Float[Array, " n"], error_states: int, hypotheses: int) -> Belief:
    """K hypotheses that have seen nothing."""
    return Belief(
        mean=jnp.tile(mean, (hypotheses, 1)),
        covariance=jnp.tile(jnp.eye(error_states, dtype=mean.dtype), (hypotheses, 1, 1)),
        log_weight=jnp.zeros(hypotheses, mean.dtype),
        initialised=jnp.zeros(hypotheses, bool),
        rejections=jnp.zeros(hypotheses, int),
    )


def forgotten(belief: Belief, lost: Bool[Array, " K"]) -> Belief:
    """The prediction without the hypotheses that are lost: their next pose starts them anew."""
    return eqx.tree_at(
        lambda b: (b.initialised, b.rejections),
        belief,
        (belief.initialised & ~lost, jnp.where(lost, 0, belief.rejections)),
    )


def corrected(
    belief: Belief,
    selection: Selection,
    correct: Callable[[Belief, Any], tuple[Belief, Array]],
    difference: Callable[[Array, Array], Array],
    moved: Callable[[Array, Array], Array],
) -> tuple[Belief, Float[Array, " K"]]:
    """The belief after a selection: every hypothesis corrected, equal ones merged.

    Args:
        correct: (a hypothesis, its part of `selection.measured`) -> (corrected, NIS).
        difference: see `merged`.
        moved: see `merged`.
    """
    belief = eqx.tree_at(
        lambda b: (b.log_weight, b.initialised), belief, (selection.log_weight, selection.kept)
    )
    belief, nis = jax.vmap(correct)(belief, selection.measured)
    return merged(belief, selection.heir, difference, moved), nis


def gated(
    belief: Belief,
    taken: Bool[Array, ""],
    nis: Float[Array, ""],
    gate_nis: Float[Array, ""] | float,
    first: tuple[Array, Array],
    posterior: tuple[Array, Array],
) -> tuple[Belief, Float[Array, ""]]:
    """One hypothesis that was offered a pose, and its NIS, 0 where there was none to compare.

    It starts with `first`, or takes `posterior` where the gate admits it, or stays as predicted
    (RELIABILITY R1).

    Args:
        first: mean and covariance of a hypothesis that starts here.
        posterior: mean and covariance of one that takes the pose.
    """
    offered = taken & belief.initialised
    starts, accepted = taken & ~belief.initialised, offered & (nis <= gate_nis)
    mean, covariance = (
        jnp.where(accepted, new, jnp.where(starts, begin, old))
        for new, begin, old in zip(posterior, first, (belief.mean, belief.covariance), strict=True)
    )
    return Belief(
        mean,
        covariance,
        belief.log_weight,
        belief.initialised | taken,
        jnp.where(accepted | starts, 0, belief.rejections + offered),
    ), jnp.where(offered, nis, 0)


def followed(
    P: Float[Array, "n n"],
    T_world_prior: jaxlie.SE3,
    T_world_vehicle: jaxlie.SE3,
    covariance: Array,
    freedom: Float[Array, "6 d"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """The whole state after its pose was corrected: the regression of the rest on the pose.

    Args:
        P: of the predicted state, its first d entries the pose error xi = freedom' cay^-1(...).
        covariance: (6, 6) of the corrected pose, at the corrected pose.

    Returns:
        Correction of the state (the pose's own entries included), and covariance after it.
    """
    d = freedom.shape[1]
    away = inverse_cayley(T_world_prior.inverse() @ T_world_vehicle)
    xi = away @ freedom
    # Error at the prediction -> at the corrected pose, and back.
    carry = sandwich(freedom.T, cayley_jacobian(away))
    back = sandwich(freedom.T, inverse_cayley_jacobian(away))
    posterior = sandwich(freedom.T, covariance)
    factor = cholesky(P[:d, :d])
    gain = cho_solve(factor, P[:d]).T  # (n, d), identity on top
    at_prior = sandwich(back, posterior)
    carried = kalman.symmetrise(P + sandwich(gain, at_prior - P[:d, :d]))
    to_posterior = jnp.eye(P.shape[0], dtype=P.dtype).at[:d, :d].set(carry)
    carried = kalman.symmetrise(sandwich(to_posterior, carried))
    return gain @ xi, kalman.floored(carried, P)


def merged(
    belief: Belief,
    heir: Int[Array, " K"],
    difference: Callable[[Array, Array], Array],
    moved: Callable[[Array, Array], Array],
) -> Belief:
    """Hypotheses that share an heir as one, with their common mean and covariance.

    Args:
        belief: after the update, with the weights of that.
        heir: index of the hypothesis that takes each one in.
        difference: (mean, from) -> error state (d,).
        moved: (mean, error state) -> mean.

    Source: Salmond (2009), "Mixture reduction algorithms for point and extended object tracking".
    """
    count = heir.shape[0]
    if count == 1:
        return belief
    mass = jnp.where(belief.initialised, jnp.exp(belief.log_weight), 0)
    member = (heir[None] == jnp.arange(count)[:, None]) & belief.initialised[None]
    total = jnp.sum(jnp.where(member, mass[None], 0), axis=1)
    share = jnp.where(member, mass[None] / jnp.where(total > 0, total, 1)[:, None], 0)
    apart = jax.vmap(lambda base: jax.vmap(lambda m: difference(m, base))(belief.mean))(belief.mean)
    shift = jnp.einsum("ji,jid->jd", share, apart)
    spread = apart - shift[:, None]
    covariance = jnp.einsum("ji,ide->jde", share, belief.covariance) + jnp.einsum(
        "ji,jid,jie->jde", share, spread, spread
    )
    alone = jnp.sum(member, axis=1) <= 1
    stays = belief.initialised & (heir == jnp.arange(count))
    return Belief(
        mean=jnp.where(alone[:, None], belief.mean, jax.vmap(moved)(belief.mean, shift)),
        covariance=jnp.where(alone[:, None, None], belief.covariance, covariance),
        log_weight=jnp.where(stays, jnp.log(jnp.where(total > 0, total, 1)), belief.log_weight),
        initialised=stays,
        rejections=belief.rejections,
    )


def restarted_where_broken(belief: Belief, start: Belief) -> Belief:
    """The belief, with `start` in place of hypotheses whose numbers overflowed."""
    hypotheses = (belief.mean, belief.covariance.reshape(*belief.mean.shape[:1], -1))
    finite = jnp.all(jnp.isfinite(jnp.concatenate(hypotheses, axis=1)), axis=1)
    return jax.vmap(lambda ok, b, s: jax.tree.map(lambda x, y: jnp.where(ok, x, y), b, s))(
        finite, belief, start
    )
