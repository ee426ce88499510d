"""Smooth the poses of a recording: go back from its end through the beliefs of a filter."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.bank import Bank, heaviest
from jaxnav.core.filter.estimate import Belief, Estimate
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.smooth import Trail, doubt
from jaxnav.core.linalg.small_matrices import first_highest
from jaxnav.core.models.geometry import EVEN_RAD, rotation_error_rad
from jaxnav.core.navigator import Navigator
from jaxnav.core.pose.observation import Observation
from jaxnav.core.pose.refine import Candidates
from jaxnav.files.executables import kept


class Kept(eqx.Module):
    """The part of filtered frames that a smoother needs, leading axes (F, tracks) or none."""

    belief: Belief  # without what repeats
    candidates: Candidates

    @staticmethod
    def from_estimate(belief: Belief, estimate: Estimate) -> "Kept":
        """Of one frame."""
        bare = eqx.tree_at(lambda b: b.repeats, belief, None, is_leaf=lambda leaf: leaf is None)
        return Kept(bare, estimate.candidates)


class Packed(NamedTuple):
    """`Kept` on the host, moments of living hypotheses alone: of 24 slots one or two live."""

    bare: Kept  # its bank without mean and covariance
    lives: Bool[np.ndarray, "F tracks K"]
    mean: Float[np.ndarray, "rows n"]
    covariance: Float[np.ndarray, "rows d d"]

    @staticmethod
    def from_kept(filtered: Kept) -> "Packed":
        """Pack frames."""
        filtered = jax.device_get(filtered)
        bank = filtered.belief.bank
        bare = eqx.tree_at(_moments, filtered, (None, None))
        lives, mean, covariance = map(np.asarray, (bank.initialised, bank.mean, bank.covariance))
        return Packed(bare, lives, mean[lives], covariance[lives])

    def unpack(self) -> Kept:
        """The frames; hypotheses that don't live are zero."""
        filled = []
        for rows in (self.mean, self.covariance):
            whole = np.zeros((*self.lives.shape, *rows.shape[1:]), rows.dtype)
            whole[self.lives] = rows
            filled.append(whole)
        return eqx.tree_at(_moments, self.bare, tuple(filled), is_leaf=lambda leaf: leaf is None)


def _moments(filtered: Kept) -> tuple[Array, Array]:
    return filtered.belief.bank.mean, filtered.belief.bank.covariance


# Of what lies behind a frame on the way back, for each track; and the observation of all tracks.
_Behind = tuple[Trail, Int[Array, "tracks K"], Observation]


class Localised(eqx.Module):
    """The localised frames of a recording, leading axes (F, tracks) or none."""

    T_world_vehicle: jaxlie.SE3
    covariance: Float[Array, "... 6 6"]  # of xi in T_world_vehicle * cay(xi)
    located: Bool[Array, "..."]
    decided: Bool[Array, "..."]
    flip_probability: Float[Array, "..."]
    candidates: Candidates
    selected: Int[Array, "..."]  # of the candidates; -1: none

    @staticmethod
    def from_estimate(estimate: Estimate) -> "Localised":
        """The poses of one filtered frame."""
        same = {f.name: getattr(estimate, f.name) for f in dataclasses.fields(Localised)}
        same["covariance"] = estimate.covariance[:6, :6]
        return Localised(**same)


def smooth_chunks(
    navigator: Navigator,
    tracks: int,
    filtered: list[Packed],
    observations: Callable[[int], Observation],
) -> Iterator[tuple[int, Localised]]:
    """Go back through the chunks of a recording: yield the index and the poses of each.

    Args:
        navigator: the one that filtered them.
        filtered: of each chunk; it is emptied on the way.
        observations: of the chunk with an index, (F,) in every leaf.
    """
    bank = navigator.motion.init(navigator.selector.hypotheses)
    end = jax.tree.map(
        lambda leaf: jnp.broadcast_to(leaf, (tracks, *leaf.shape)),
        (Trail.begin(bank, jnp.asarray(False)), bank.parent),
    )
    behind: _Behind | None = None
    for index in reversed(range(len(filtered))):
        obs = observations(index)
        behind = behind or (*end, jax.tree.map(lambda leaf: leaf[0], obs))  # any
        behind, poses = smooth_frames(navigator, behind, filtered.pop().unpack(), obs)
        yield index, poses


@kept
def smooth_frames(
    navigator: Navigator, behind: _Behind, filtered: Kept, obs: Observation
) -> tuple[_Behind, Localised]:
    """Go back through frames, from the last to the first.

    Args:
        navigator: the one that filtered them.
        behind: of the last frame.
        filtered: (F, tracks) frames.
        obs: F observations, of which `dt_s` and the odometry are used.
    """

    def one(
        trail: Trail, parent: Array, filtered: Kept, later: Observation
    ) -> tuple[Trail, Localised]:
        belief = filtered.belief
        trail = trail.back(navigator.motion, belief.bank, belief.decided, parent, later)
        return trail, _report(navigator, trail, filtered)

    def back(behind: _Behind, frame: tuple[Kept, Observation]) -> tuple[_Behind, Localised]:
        (trail, parent, later), (filtered, obs) = behind, frame
        trail, smoothed = jax.vmap(one, (0, 0, 0, None))(trail, parent, filtered, later)
        return (trail, filtered.belief.bank.parent, obs), smoothed

    smoothed: tuple[_Behind, Localised] = jax.lax.scan(back, behind, (filtered, obs), reverse=True)
    return smoothed


def _report(navigator: Navigator, trail: Trail, filtered: Kept) -> Localised:
    """What is reported of one frame of one track."""
    motion, belief, selector = navigator.motion, filtered.belief, navigator.selector
    bank: Bank = trail.as_bank(belief.bank)
    best = heaviest(bank)
    T = motion.T_world_vehicle(bank.mean[best])
    flip_probability, decided = belief.flip_probability, trail.decided
    if isinstance(selector, MultiHypothesis):
        flip_probability = doubt(motion, bank, selector.far_rad)
        decided = bank.initialised[best] & (flip_probability < selector.decided_mass)
    candidates = filtered.candidates
    off_rad = jax.vmap(lambda T_vehicle_world: rotation_error_rad(T_vehicle_world.inverse(), T))(
        candidates.T_vehicle_world
    )
    nearest = first_highest(-jnp.where(candidates.valid, off_rad, jnp.inf), EVEN_RAD)
    return Localised(
        T_world_vehicle=T,
        covariance=motion.error_covariance(bank, best)[:6, :6],
        located=bank.initialised[best],
        decided=decided,
        flip_probability=flip_probability,
        candidates=candidates,
        selected=jnp.where(jnp.any(candidates.valid) & bank.initialised[best], nearest, -1),
    )
