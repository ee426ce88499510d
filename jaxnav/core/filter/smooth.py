"""Smoothing: what later observations say of an earlier state.

A filter's belief at an instant knows what was seen until then. Going back from the end of a
recording, each belief is corrected by the one after it:

    C = P F',  G = C P'^-1,  x_s = x + G (x'_s - x'),  P_s = P + G (P'_s - P') G'

with the filter's mean x and covariance P, their prediction x', P' for the next observation, its
derivative F, and the smoothed mean x'_s and covariance P'_s there. A bank is smoothed along the
hypothesis that is heaviest at the end of a track, back through the slots that it has been in
(`Bank.parent`). So the branch of every instant is chosen by all that was seen, before and after.
What the other survivors weigh, and where they were, is the doubt that is left.

`Window` does the same at every step, for the pose of a while ago (a fixed-lag smoother).
Beside the bank it keeps, for each of the last observations and its heaviest hypotheses, the link to
what followed (`Link`), in a ring. Going back along the reported hypothesis costs two
products of matrices for each observation. What lies behind the ring is in its oldest link: nothing
has to be marginalised.

Source: Rauch, Tung, Striebel (1965), "Maximum likelihood estimates of linear dynamic systems";
the covariance in the form of Bar-Shalom, Li, Kirubarajan (2001), section 8.6; Simon (2006),
"Optimal State Estimation", section 9.3 (fixed lag).
"""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.bank import EVEN_LOG_WEIGHT, Bank, Moments, heaviest
from jaxnav.core.filter.estimate import Belief
from jaxnav.core.filter.hypotheses import beyond
from jaxnav.core.filter.kalman import symmetrise
from jaxnav.core.filter.motion import Motion
from jaxnav.core.linalg.small_matrices import first_highest, in_order, where
from jaxnav.core.models.geometry import rotation_error_rad, safe_sqrt
from jaxnav.core.pose.observation import Observation


class Trail(eqx.Module):
    """The hypotheses that live at the end of a track, at one instant before it."""

    mean: Float[Array, " n"]  # of the one that is heaviest at the end, smoothed
    covariance: Float[Array, "d d"]
    slots: Int[Array, " K"]  # of the bank at this instant that each continues; -1: none
    log_weight: Float[Array, " K"]  # at the end
    decided: Bool[Array, ""]  # at the end

    @staticmethod
    def begin(bank: Bank, decided: Bool[Array, ""]) -> "Trail":
        """The hypotheses of the last bank of a track, as the filter left them."""
        best, count = heaviest(bank), bank.initialised.shape[0]
        slots = jnp.where(bank.initialised, jnp.arange(count), -1)
        weight = jnp.where(bank.initialised, bank.log_weight, -jnp.inf)
        decided = decided & bank.initialised[best]
        return Trail(bank.mean[best], bank.covariance[best], slots, weight, decided)

    @property
    def best(self) -> Int[Array, ""]:
        """Which hypothesis is smoothed."""
        return first_highest(self.log_weight, EVEN_LOG_WEIGHT)

    def back(
        self,
        motion: Motion,
        bank: Bank,
        decided: Bool[Array, ""],
        parent: Int[Array, " K"],
        obs: Observation,
    ) -> "Trail":
        """Go back by one observation; another trail begins where this one does.

        Args:
            bank: after the earlier observation, and whether it was decided.
            parent: slots of `bank` that the later one's continue.
            obs: the later observation, whose interval and odometry lie between the two.
        """
        slots = continued(self.slots, parent, bank.initialised)
        own = slots[self.best]
        filtered = bank.mean[own], bank.covariance[own]
        mean, covariance = smoothed(motion, filtered, (self.mean, self.covariance), obs)
        earlier = Trail(mean, covariance, slots, self.log_weight, self.decided)
        return where(own >= 0, earlier, Trail.begin(bank, decided))

    def as_bank(self, bank: Bank) -> Bank:
        """The survivors at this instant in a bank of their own: the smoothed one, and filtered."""
        is_best = jnp.arange(self.slots.shape[0]) == self.best
        return dataclasses.replace(
            bank,
            mean=jnp.where(is_best[:, None], self.mean, bank.mean[self.slots]),
            covariance=jnp.where(
                is_best[:, None, None], self.covariance, bank.covariance[self.slots]
            ),
            log_weight=self.log_weight - jax.nn.logsumexp(self.log_weight),
            initialised=self.slots >= 0,
            number=bank.number[self.slots],
        )


def continued(
    slots: Int[Array, " K"], parent: Int[Array, " K"], initialised: Bool[Array, " K"]
) -> Int[Array, " K"]:
    """The slots one observation earlier, -1 where there was none; see `Trail.back`."""
    earlier = jnp.where(slots >= 0, parent[slots], -1)
    return jnp.where((earlier >= 0) & initialised[earlier], earlier, -1)


class Link(eqx.Module):
    """An earlier state by a later one: x_s = x + G (x'_s - x'), P_s = D + G P'_s G'."""

    mean: Float[Array, "*K n"]  # x, as filtered
    predicted: Float[Array, "*K n"]  # x'
    gain: Float[Array, "*K d d"]  # G
    rest: Float[Array, "*K d d"]  # D, what even an exact later state would leave

    @staticmethod
    def from_filtered(motion: Motion, filtered: Moments, obs: Observation) -> "Link":
        """The link of one hypothesis to its prediction.

        Args:
            filtered: after the earlier observation.
            obs: the later one.
        """
        x, P = filtered
        predicted, Q = motion.evolve(x, jnp.zeros_like(P), obs)

        def evolved(error: Array) -> Array:
            return motion.difference(motion.evolve(motion.moved(x, error), P, obs)[0], predicted)

        F = jax.jacfwd(evolved)(jnp.zeros(P.shape[0], P.dtype))
        P_predicted = F @ P @ F.T + Q
        # Scaled: variances of m^2, rad^2 and of errors that hardly change lie far apart.
        scale = safe_sqrt(jnp.diagonal(P_predicted))
        scale = 1 / jnp.where(scale > 0, scale, 1)
        eye = jnp.eye(P.shape[0], dtype=P.dtype)
        S = P_predicted * scale[:, None] * scale[None] + 4 * jnp.finfo(P.dtype).eps * eye
        C = scale[:, None] * F @ P
        G = (scale[:, None] * jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(S), True), C)).T
        left = eye - G @ F
        return Link(x, predicted, G, symmetrise(left @ P @ left.T + G @ Q @ G.T))

    def back(self, motion: Motion, later: Moments) -> Moments:
        """The earlier moments, of one hypothesis, by the smoothed ones at the later observation."""
        mean = motion.moved(self.mean, self.gain @ motion.difference(later[0], self.predicted))
        return mean, self.rest + symmetrise(self.gain @ later[1] @ self.gain.T)


def smoothed(motion: Motion, filtered: Moments, later: Moments, obs: Observation) -> Moments:
    """Mean and covariance of one hypothesis, corrected by those one observation later.

    Args:
        filtered: after the earlier observation.
        later: smoothed, after the later one.
        obs: the later observation.

    Returns:
        The moments at the earlier instant; the filtered ones where the later ones are not finite.
    """
    mean, covariance = Link.from_filtered(motion, filtered, obs).back(motion, later)
    finite = jnp.all(jnp.isfinite(mean)) & jnp.all(jnp.isfinite(covariance))
    return where(finite, (mean, covariance), filtered)


def doubt(motion: Motion, bank: Bank, far_rad: Float[Array, ""] | float) -> Float[Array, ""]:
    """Probability that the orientation is farther than an angle from the heaviest hypothesis's."""
    poses = motion.poses(bank)
    best = motion.T_world_vehicle(bank.mean[heaviest(bank)])
    apart_rad = jax.vmap(lambda T: rotation_error_rad(T, best))(poses.T_world_vehicle)
    sigma_rad = safe_sqrt(jnp.trace(poses.covariance[:, 3:, 3:], axis1=1, axis2=2))
    mass = jnp.where(bank.initialised, jnp.exp(bank.log_weight), 0)
    return jnp.sum(mass * beyond(far_rad, apart_rad, sigma_rad))


# On the way back: observations passed, slot, time passed, mean and covariance there.
_Place = tuple[Array, Array, Array, Array, Array]


# Hypotheses of an observation that are kept: once a bank is decided one or two live, and the time
# of a step goes into copying the ring.
_KEPT = 8


class Lagged(eqx.Module):
    """The reported hypothesis a while ago."""

    T_world_vehicle: jaxlie.SE3
    covariance: Float[Array, "d d"]  # of the motion model's error state; of this hypothesis alone
    age_s: Float[Array, ""]  # how long ago; less than the lag while the hypothesis is younger
    located: Bool[Array, ""]


class Window(eqx.Module):
    """What links the banks of the last L observations, a ring whose newest is at `last`."""

    links: Link  # leaves (L, k, ...), of the k heaviest hypotheses of the earlier bank
    slots: Int[Array, "L k"]  # which these are; -1: none
    parent: Int[Array, "L K"]  # slots of the earlier bank that the later one's continue; -1: none
    dt_s: Float[Array, " L"]
    last: Int[Array, ""]
    lag_s: Float[Array, ""]

    @staticmethod
    def begin(bank: Bank, lag_s: float, observations: int) -> "Window":
        """A window that has seen nothing, before a bank's first observation."""
        kept = jax.tree.map(lambda leaf: leaf[:_KEPT], bank)
        P = jnp.zeros_like(kept.covariance)
        none = -jnp.ones_like(bank.parent)
        rows = Link(kept.mean, kept.mean, P, P), none[:_KEPT], none
        links, slots, parent = jax.tree.map(
            lambda leaf: jnp.tile(leaf, (observations, *[1] * leaf.ndim)), rows
        )
        dt_s = jnp.zeros(observations, P.dtype)
        return Window(links, slots, parent, dt_s, jnp.asarray(0), jnp.asarray(lag_s, P.dtype))

    def after(self, motion: Motion, before: Bank, after: Bank, obs: Observation) -> "Window":
        """Append the step from one bank to the next.

        Args:
            before: at the last observation.
            after: at this one.
            obs: this one.
        """
        weight = jnp.where(before.initialised, before.log_weight, -jnp.inf)
        slots = in_order(weight, self.slots.shape[1]).astype(self.slots.dtype)
        links = jax.vmap(lambda mean, P: Link.from_filtered(motion, (mean, P), obs))(
            before.mean[slots], before.covariance[slots]
        )
        slots = jnp.where(before.initialised[slots], slots, -1)
        lives = (after.parent >= 0) & before.initialised[after.parent] & after.initialised
        parent = jnp.where(lives, after.parent, -1)
        at = (self.last + 1) % self.dt_s.shape[0]
        rows = links, slots, parent, jnp.asarray(obs.dt_s, self.dt_s.dtype)
        kept = self.links, self.slots, self.parent, self.dt_s
        links, slots, parent, dt_s = jax.tree.map(
            lambda ring, row: ring.at[at].set(row), kept, rows
        )
        return Window(links, slots, parent, dt_s, at, self.lag_s)

    def look_back(self, motion: Motion, belief: Belief) -> Lagged:
        """The reported hypothesis where it was `lag_s` ago, or as far back as it is known."""
        bank, best, count = belief.bank, heaviest(belief.bank), self.dt_s.shape[0]

        def at(steps: Array) -> Array:
            return (self.last - steps) % count

        def goes_on(carry: _Place) -> Array:
            steps, slot, age_s, *_ = carry
            row = at(steps)
            earlier = self.parent[row, slot]
            further = (steps < count) & (earlier >= 0) & jnp.any(self.slots[row] == earlier)
            return further & (age_s + self.dt_s[row] / 2 < self.lag_s)

        def back(carry: _Place) -> _Place:
            steps, slot, age_s, mean, P = carry
            row = at(steps)
            earlier = self.parent[row, slot]
            which = jnp.argmax(self.slots[row] == earlier)
            link = jax.tree.map(lambda leaf: leaf[row, which], self.links)
            mean, P = link.back(motion, (mean, P))
            return steps + 1, earlier, age_s + self.dt_s[row], mean, P

        zero = jnp.zeros_like(self.lag_s)
        first = jnp.asarray(0), best, zero, bank.mean[best], bank.covariance[best]
        _, _, age_s, mean, P = jax.lax.while_loop(goes_on, back, first)
        return Lagged(motion.T_world_vehicle(mean), P, age_s, bank.initialised[best])
