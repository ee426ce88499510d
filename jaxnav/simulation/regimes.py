"""A navigator that does no more work than an observation asks for: the same up to rounding.

Branches for one sighting or several, and for one hypothesis, a few or the whole bank: worth it
where many lanes run side by side, each in its own branch (see `lanes`).
"""

import dataclasses
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxnav.belief.estimate import Belief, Estimate
from jaxnav.belief.hypotheses import MultiHypothesis
from jaxnav.belief.motion import followed_by, leading, survivors_first
from jaxnav.navigator import Navigator, Step
from jaxnav.pose.candidates import Candidates
from jaxnav.pose.consistency import Consistent, among_all
from jaxnav.pose.observation import Observation

# Slots of the banks that are kept compiled beside the whole one: nine frames of ten need a single
# one, and of the others two of three no more than these.
_BANKS = (1, 8)


def step_by_regime(navigator: Navigator) -> Step:
    """`navigator.step` without the slots that are empty; of a subclass, its own `step`."""
    if type(navigator) is not Navigator:
        return navigator.step
    return _ByRegime.like(navigator).step


class _ByRegime(Navigator):
    def look(self, obs: Observation) -> Consistent:
        # Nearly all lanes see a marker: to sort out those that don't costs more than it saves.
        snapshot = self.snapshot(obs)
        slots = snapshot.seen.visible.shape[0]
        if slots == 1:
            return among_all(snapshot, self.find_candidates)

        def several() -> tuple[Array, Candidates, Array]:
            seen = among_all(snapshot, self.find_candidates)
            return seen.snapshot.seen.visible, seen.candidates, seen.outvoted

        def one() -> tuple[Array, Candidates, Array]:
            seen = among_all(snapshot.largest(1), self.find_candidates)
            visible = jnp.zeros(slots, bool).at[0].set(seen.snapshot.seen.visible[0])
            count = min(self.max_candidates, 2 * slots)
            return visible, seen.candidates.padded(count), seen.outvoted

        any_further = jnp.any(snapshot.seen.visible[1:])
        visible, *found = jax.lax.cond(any_further, several, one)
        return Consistent(eqx.tree_at(lambda s: s.seen.visible, snapshot, visible), *found)

    def fuse(self, belief: Belief, seen: Consistent) -> tuple[Belief, Estimate]:
        bank, count = belief.bank, belief.bank.initialised.shape[0]
        if count == 1 or not isinstance(self.selector, MultiHypothesis):
            return super().fuse(belief, seen)
        empty, any_seen = self.motion.init(count), jnp.any(seen.snapshot.seen.visible)

        def within(size: int, sees: bool) -> Callable[[Belief], tuple[Belief, Estimate]]:
            def fuse(belief: Belief) -> tuple[Belief, Estimate]:
                few = dataclasses.replace(belief, bank=leading(belief.bank, size))
                after, evidence = (
                    self.correct(few, seen) if sees else self.coast(few, seen.snapshot.obs)
                )
                estimate = Estimate.of(self.motion, after, evidence)
                whole = followed_by(survivors_first(after.bank), empty)
                return dataclasses.replace(after, bank=whole), estimate

            return fuse

        starts = any_seen & ~jnp.any(bank.initialised & ~self.motion.lost(bank))
        sizes = [size for size in _BANKS if size < count] + [count]
        needed = jnp.max(jnp.where(bank.initialised, jnp.arange(count) + 1, 0))
        needed = jnp.where(starts, count, needed)
        index = jnp.sum(needed > jnp.asarray(sizes[:-1])) + jnp.where(any_seen, len(sizes), 0)
        fused: tuple[Belief, Estimate] = jax.lax.switch(
            index, [within(size, sees) for sees in (False, True) for size in sizes], belief
        )
        return fused
