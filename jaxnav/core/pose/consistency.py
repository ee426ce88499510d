"""Rejection of sightings that are not squares, and of a marker that the others contradict.

    found = consistent(snapshot, navigator.find_candidates, navigator.no_candidates())

Four corners at random places fit no pose, and a marker that was moved, or a copy of it, fits no
pose on which the others agree. Fusing them leads the estimate astray, however large their sigma is.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.core.linalg.trees import where
from jaxnav.core.pose.candidates import Candidates, both_poses, own_errors_px
from jaxnav.core.pose.observation import Sightings, Snapshot

# Corners are those of a square in space where they miss the best projection of one by less than so
# many of their sigmas, or than such a share of the marker's side: 2 px of blur on a marker of 17 px
# is 12 %. Of quads drawn at random over an image 2 % come as near.
_MISFIT_SIGMAS = 10.0
_MISFIT_SHARE = 0.12
# A joint misfit beyond three sigmas of its chi-square, times this, is a contradiction: corners off
# by four times their sigma, more than cameras off by 1 deg or a map off by 1 cm come to in a room.
_CONTRADICTION = 16.0
_GAIN = 4.0  # by which it must fall without one marker, and without no other as far
LEAST_MARKERS = 3  # two can't outvote each other


# `find_candidates` of a snapshot, and of the poses that each sighting has by itself.
Find = Callable[[Snapshot, jaxlie.SE3], Candidates]


class ConsistentSnapshot(NamedTuple):
    """A snapshot without inconsistent sightings, its candidates, and the markers outvoted."""

    snapshot: Snapshot
    candidates: Candidates
    outvoted: Bool[Array, " M"]


class Inliers(NamedTuple):
    """What the rejection determines of a `ConsistentSnapshot`: visibility, not the snapshot."""

    visible: Bool[Array, " D"]
    candidates: Candidates
    outvoted: Bool[Array, " M"]

    def apply_to(self, snapshot: Snapshot) -> ConsistentSnapshot:
        """`ConsistentSnapshot` for the snapshot in which this was found."""
        return ConsistentSnapshot(_among(snapshot, self.visible), self.candidates, self.outvoted)


def remove_outliers(snapshot: Snapshot, find: Find, none: Candidates) -> ConsistentSnapshot:
    """The snapshot without sightings that are not squares and without an outvoted marker.

    With three markers and more in view, the one without which the joint misfit falls below a
    bound, by a factor that no other marker reaches, is outvoted.

    Args:
        snapshot: what is seen.
        find: maps a snapshot, and `both_poses` of it, to `Candidates`; see `find_candidates`.
        none: the result without a marker in view, where `find` is not called.
    """

    def nothing() -> Inliers:
        nobody = jnp.zeros(len(snapshot.markers.ids), bool)
        return Inliers(jnp.zeros_like(snapshot.seen.visible), none, nobody)

    any_seen = jnp.any(snapshot.seen.visible)
    kept: Inliers = jax.lax.cond(any_seen, lambda: find_inliers(snapshot, find), nothing)
    return kept.apply_to(snapshot)


def find_inliers(snapshot: Snapshot, find: Find) -> Inliers:
    """As `remove_outliers`, but calls `find` also where no marker is in view."""
    own = both_poses(snapshot)
    snapshot = _among(snapshot, _can_be_markers(snapshot, own))
    seen, candidates = snapshot.seen, find(snapshot, own)
    nobody = jnp.zeros(len(snapshot.markers.ids), bool)
    if nobody.shape[0] < LEAST_MARKERS or seen.visible.shape[0] < LEAST_MARKERS:
        return Inliers(seen.visible, candidates, nobody)
    in_view = jnp.sum(_in_view(seen, nobody.shape[0]))
    all_of_them = _excess(candidates, seen)

    def outvote() -> tuple[Bool[Array, " D"], Candidates]:
        # One slot of each marker stands for it; slots of the same marker come to the same.
        def without(marker: Array) -> tuple[Array, Candidates]:
            rest = _among(snapshot, seen.marker_index != marker)
            alternative = find(rest, own)
            return _excess(alternative, rest.seen), alternative

        excess, alternatives = jax.vmap(without)(seen.marker_index)
        excess = jnp.where(seen.visible, excess, jnp.inf)
        best = jnp.argmin(excess)
        is_other = seen.marker_index != seen.marker_index[best]
        second = jnp.min(jnp.where(is_other, excess, jnp.inf))
        clear = (excess[best] <= _CONTRADICTION) & (
            excess[best] * _GAIN <= jnp.minimum(second, all_of_them)
        )
        kept = is_other | ~clear
        rest = jax.tree.map(lambda leaf: leaf[best], alternatives)
        return kept, where(clear, rest, candidates)

    kept, candidates = jax.lax.cond(
        (in_view >= LEAST_MARKERS) & (all_of_them > _CONTRADICTION),
        outvote,
        lambda: (jnp.ones_like(seen.visible), candidates),
    )
    outvoted = _in_view(_among(snapshot, ~kept).seen, nobody.shape[0])
    return Inliers(seen.visible & kept, candidates, outvoted)


def _can_be_markers(snapshot: Snapshot, own: jaxlie.SE3) -> Bool[Array, " D"]:
    seen = snapshot.seen
    errors_px = own_errors_px(snapshot, own)
    sides_px = jnp.linalg.norm(seen.corners_px - jnp.roll(seen.corners_px, 1, axis=1), axis=2)
    bound_px = jnp.maximum(
        _MISFIT_SIGMAS * jnp.mean(seen.sigma_px, axis=1),
        _MISFIT_SHARE * jnp.mean(sides_px, axis=1),
    )
    return errors_px <= bound_px


def _among(snapshot: Snapshot, kept: Bool[Array, " D"]) -> Snapshot:
    visible = snapshot.seen.visible & kept
    return eqx.tree_at(lambda s: s.seen.visible, snapshot, visible)


def _in_view(seen: Sightings, markers: int) -> Bool[Array, " M"]:
    return jnp.zeros(markers, bool).at[seen.marker_index].max(seen.visible)


def _excess(candidates: Candidates, seen: Sightings) -> Float[Array, ""]:
    """Cost of the best candidate over the mean plus three sigmas of its chi-square."""
    misfit = candidates.least_cost
    freedom = jnp.maximum(8 * jnp.sum(seen.visible) - 6, 2).astype(misfit.dtype)
    return misfit / (freedom + 3 * jnp.sqrt(2 * freedom))
