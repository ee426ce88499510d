"""A navigator that skips the work of empty slots: the same results up to rounding.

It branches on one sighting or several, and on one hypothesis, a few or the whole bank. That pays
if many lanes run side by side, each in its own branch (see `lanes`).
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from jaxnav.core.filter.bank import (
    Bank,
    fill_slots,
    first_hypotheses,
    heaviest,
    survivors_first,
)
from jaxnav.core.filter.estimate import Belief, Estimate
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.linalg.small_matrices import as_class
from jaxnav.core.navigator import Navigator, Step
from jaxnav.core.pose.candidates import ConsistentSnapshot, Inliers, find_inliers
from jaxnav.core.pose.observation import Observation

# Sizes, in slots, of the banks compiled beside the whole one: nine frames of ten need a single
# slot, and two of three of the others no more than the larger size.
_BANKS = (1, 8)


def step_by_regime(navigator: Navigator) -> Step:
    """`navigator.step` without the empty slots; a subclass's own `step` is returned unchanged."""
    if type(navigator) is not Navigator:
        return navigator.step
    return as_class(_ByRegime, navigator).step


class _ByRegime(Navigator):
    def look(self, obs: Observation) -> ConsistentSnapshot:
        # Nearly all lanes see a marker: sorting out those that don't costs more than it saves.
        snapshot = self.snapshot(obs)
        slots = snapshot.seen.visible.shape[0]
        if slots == 1:
            return find_inliers(snapshot, self.find_candidates).apply_to(snapshot)

        def one() -> Inliers:
            kept = find_inliers(snapshot.largest(1), self.find_candidates)
            visible = jnp.zeros(slots, bool).at[0].set(kept.visible[0])
            count = min(self.max_candidates, 2 * slots)
            return Inliers(visible, kept.candidates.padded(count), kept.outvoted)

        any_further = jnp.any(snapshot.seen.visible[1:])
        kept: Inliers = jax.lax.cond(
            any_further, lambda: find_inliers(snapshot, self.find_candidates), one
        )
        return kept.apply_to(snapshot)

    def fuse(self, belief: Belief, seen: ConsistentSnapshot) -> tuple[Belief, Estimate]:
        bank, count = belief.bank, belief.bank.initialised.shape[0]
        if count == 1 or not isinstance(self.selector, MultiHypothesis):
            return super().fuse(belief, seen)
        empty, any_seen = self.motion.init(count), jnp.any(seen.snapshot.seen.visible)
        sizes = [size for size in _BANKS if size < count] + [count]

        def regime(needed: Int[Array, ""]) -> Int[Array, ""]:
            return jnp.sum(needed > jnp.asarray(sizes[:-1]))

        def predicting(size: int) -> Callable[[Belief], Belief]:
            def predict(belief: Belief) -> Belief:
                few = dataclasses.replace(belief, bank=first_hypotheses(belief.bank, size))
                predicted = self.predict(few, seen.snapshot.obs)
                return dataclasses.replace(predicted, bank=fill_slots(predicted.bank, empty))

            return predict

        def correcting(size: int, sees: bool) -> Callable[[Belief], tuple[Belief, Estimate]]:
            def correct(predicted: Belief) -> tuple[Belief, Estimate]:
                few = dataclasses.replace(predicted, bank=first_hypotheses(predicted.bank, size))
                after, evidence = self.correct(few, seen) if sees else self.coast(few)
                estimate = Estimate.from_belief(self.motion, after, evidence)
                whole = fill_slots(survivors_first(after.bank), empty)
                return dataclasses.replace(after, bank=whole), estimate

            return correct

        predicted: Belief = jax.lax.switch(
            regime(_slots_taken(bank)), [predicting(size) for size in sizes], belief
        )
        bank = predicted.bank
        needed = _slots_taken(bank) + jnp.where(any_seen, self._branches(bank, seen), 0)
        starts = any_seen & ~jnp.any(bank.initialised)
        needed = jnp.where(starts, count, needed)
        fused: tuple[Belief, Estimate] = jax.lax.switch(
            regime(needed) + jnp.where(any_seen, len(sizes), 0),
            [correcting(size, sees) for sees in (False, True) for size in sizes],
            predicted,
        )
        return fused

    def _branches(self, predicted: Bank, seen: ConsistentSnapshot) -> Int[Array, ""]:
        """How many empty slots the selector is going to take for second poses."""
        assert isinstance(self.selector, MultiHypothesis)
        best = heaviest(predicted)
        prior = self.motion.poses(jax.tree.map(lambda leaf: leaf[best][None], predicted))
        second = self.selector.second_poses(prior, 0, seen.candidates, seen.snapshot)
        return jnp.sum(second.wanted)


def _slots_taken(bank: Bank) -> Int[Array, ""]:
    """The number of first slots of a bank outside of which no hypothesis lives."""
    return jnp.max(jnp.where(bank.initialised, jnp.arange(bank.initialised.shape[0]) + 1, 0))
