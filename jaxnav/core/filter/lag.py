"""A fixed-lag smoother: the pose of a while ago, by all that was seen since.

Beside the bank it keeps, for each of the last observations and its heaviest hypotheses, the link to
what followed (`smoothing.Link`), in a ring. Going back along the reported hypothesis costs two
products of matrices for each observation. What lies behind the ring is in its oldest link: nothing
has to be marginalised.

Source: Rauch, Tung, Striebel (1965), "Maximum likelihood estimates of linear dynamic systems";
Simon (2006), "Optimal State Estimation", section 9.3 (fixed lag).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.bank import Bank, heaviest
from jaxnav.core.filter.estimate import Belief
from jaxnav.core.filter.motion import Motion
from jaxnav.core.filter.smoothing import Link
from jaxnav.core.linalg.small_matrices import in_order
from jaxnav.core.pose.observation import Observation

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
        """The window with the step from one bank to the next.

        Args:
            before: at the last observation.
            after: at this one.
            obs: this one.
        """
        weight = jnp.where(before.initialised, before.log_weight, -jnp.inf)
        slots = in_order(weight, self.slots.shape[1]).astype(self.slots.dtype)
        links = jax.vmap(lambda mean, P: Link.of(motion, (mean, P), obs))(
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
