"""A fixed-lag smoother: the pose of a while ago, by all that was seen since.

Beside the bank it keeps, for each of the last observations and each hypothesis, the link to what
followed (`smoothing.Link`), in a ring. Going back along the reported hypothesis costs two products
of matrices for each observation. What lies behind the ring is in its oldest link: nothing has to
be marginalised.

Source: Rauch, Tung, Striebel (1965), "Maximum likelihood estimates of linear dynamic systems";
Simon (2006), "Optimal State Estimation", section 9.3 (fixed lag).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.belief.bank import Bank, heaviest
from jaxnav.belief.estimate import Belief
from jaxnav.belief.motion import Motion
from jaxnav.belief.smoothing import Link
from jaxnav.pose.observation import Observation

# On the way back: observations passed, slot, time passed, mean and covariance there.
_Place = tuple[Array, Array, Array, Array, Array]


class Lagged(eqx.Module):
    """The reported hypothesis a while ago."""

    T_world_vehicle: jaxlie.SE3
    covariance: Float[Array, "d d"]  # of the motion model's error state; of this hypothesis alone
    age_s: Float[Array, ""]  # how long ago; less than the lag while the hypothesis is younger
    located: Bool[Array, ""]


class Window(eqx.Module):
    """What links the banks of the last L observations, a ring whose newest is at `last`."""

    links: Link  # leaves (L, K, ...)
    parent: Int[Array, "L K"]  # slots of the earlier bank that the later one's continue; -1: none
    dt_s: Float[Array, " L"]
    last: Int[Array, ""]
    lag_s: Float[Array, ""]

    @staticmethod
    def begin(motion: Motion, hypotheses: int, lag_s: float, observations: int) -> "Window":
        """A window that has seen nothing."""
        bank = motion.init(hypotheses)
        P = jnp.zeros_like(bank.covariance)
        links = Link(bank.mean, bank.mean, P, P)
        wide = jax.tree.map(lambda leaf: jnp.tile(leaf, (observations, *[1] * leaf.ndim)), links)
        none = jnp.full((observations, hypotheses), -1, bank.parent.dtype)
        dt_s = jnp.zeros(observations, P.dtype)
        return Window(wide, none, dt_s, jnp.asarray(0), jnp.asarray(lag_s, P.dtype))

    def after(self, motion: Motion, before: Bank, after: Bank, obs: Observation) -> "Window":
        """The window with the step from one bank to the next.

        Args:
            before: at the last observation.
            after: at this one.
            obs: this one.
        """
        links = jax.vmap(lambda mean, P: Link.of(motion, (mean, P), obs))(
            before.mean, before.covariance
        )
        lives = (after.parent >= 0) & before.initialised[after.parent] & after.initialised
        at = (self.last + 1) % self.dt_s.shape[0]
        rows = links, jnp.where(lives, after.parent, -1), jnp.asarray(obs.dt_s, self.dt_s.dtype)
        kept = self.links, self.parent, self.dt_s
        links, parent, dt_s = jax.tree.map(lambda ring, row: ring.at[at].set(row), kept, rows)
        return Window(links, parent, dt_s, at, self.lag_s)

    def look_back(self, motion: Motion, belief: Belief) -> Lagged:
        """The reported hypothesis where it was `lag_s` ago, or as far back as it is known."""
        bank, best, count = belief.bank, heaviest(belief.bank), self.dt_s.shape[0]

        def at(steps: Array) -> Array:
            return (self.last - steps) % count

        def goes_on(carry: _Place) -> Array:
            steps, slot, age_s, *_ = carry
            row = at(steps)
            further = (steps < count) & (self.parent[row, slot] >= 0)
            return further & (age_s + self.dt_s[row] / 2 < self.lag_s)

        def back(carry: _Place) -> _Place:
            steps, slot, age_s, mean, P = carry
            row = at(steps)
            earlier = self.parent[row, slot]
            link = jax.tree.map(lambda leaf: leaf[row, earlier], self.links)
            mean, P = link.back(motion, (mean, P))
            return steps + 1, earlier, age_s + self.dt_s[row], mean, P

        zero = jnp.zeros_like(self.lag_s)
        first = jnp.asarray(0), best, zero, bank.mean[best], bank.covariance[best]
        _, _, age_s, mean, P = jax.lax.while_loop(goes_on, back, first)
        return Lagged(motion.T_world_vehicle(mean), P, age_s, bank.initialised[best])
