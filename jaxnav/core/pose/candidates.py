"""Candidate poses of the vehicle: both IPPE poses of every sighting, refined and merged.

Sightings that are no squares, and a marker that the others contradict, are left out: four corners
at random places fit no pose, and a marker that was moved, or a copy of it, fits no pose on which
the others agree. Fusing them leads the estimate astray, however large their sigma is.

Source: Liu, Schofield, Shan (2023), Algorithm 1, "get both possible poses using the IPPE method
and Eq. 3".
"""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float

from jaxnav.core.linalg.small_matrices import in_order, where
from jaxnav.core.models.geometry import (
    on_ground,
    rotation_matrix,
    safe_norm,
    safe_sqrt,
    transform_points,
)
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.pose.ippe import ippe_from_rays
from jaxnav.core.pose.observation import Sightings, Snapshot, cameras_of
from jaxnav.core.pose.refine import Candidates, refine_sightings
from jaxnav.core.pose.residuals import in_frames, reprojection_rows

# Two local minima this close are merged: 1.1 degrees, and 0.02 of the distance to the marker.
SAME_POSE_RAD = 0.02


def find_candidates(
    snapshot: Snapshot,
    max_candidates: int = 4,
    max_steps: int = 12,
    ground_plane: bool = False,
    own: jaxlie.SE3 | None = None,
) -> Candidates:
    """Find every candidate pose, refined on the joint e1 of all sightings, equal ones merged.

    One camera that sees one marker gives two; two cameras on one marker give up to four, which
    the refinement usually draws together into two (see docs/design.md, Candidates). With many
    markers the `max_candidates` poses that explain all corners best are refined.

    Args:
        snapshot: what is seen.
        max_candidates: N, how many poses are refined and returned at most.
        max_steps: bound on the LM steps.
        ground_plane: keep the vehicle level on the ground, z = 0: only (x, y, psi) are refined.
        own: the result of `both_poses(snapshot)`, where the caller has it already.
    """
    rig, markers, seen = snapshot.rig, snapshot.markers, snapshot.seen
    own = both_poses(snapshot) if own is None else own
    Ts_vehicle_world = jaxlie.SE3(own.wxyz_xyz.reshape(-1, 7))
    owner_visible = jnp.repeat(seen.visible, 2)
    if ground_plane:
        Ts_vehicle_world = jax.vmap(lambda T: on_ground(T.inverse()).inverse())(Ts_vehicle_world)

    count = min(max_candidates, owner_visible.shape[0])
    if count < owner_visible.shape[0]:
        corners_world = markers.corners_world_m[seen.marker_index].reshape(-1, 3)
        residual, _ = reprojection_rows(rig, seen)(in_frames(Ts_vehicle_world, corners_world))
        joint_e1 = jnp.sum((residual * seen.sigma_px.reshape(1, -1, 1)) ** 2, axis=(0, 1))
        best = in_order(-jnp.where(owner_visible, joint_e1, jnp.inf), count)
        Ts_vehicle_world = jaxlie.SE3(Ts_vehicle_world.wxyz_xyz[best])
        owner_visible = owner_visible[best]

    found = refine_sightings(
        rig, markers, seen, Ts_vehicle_world, max_steps, ground_plane, wanted=owner_visible
    )
    # Corners far outside of any image can overflow; such a lane is no candidate.
    finite, valid = found.valid, owner_visible & found.valid
    # Of several sightings, what still falls after the last step is on its way from the minimum of
    # one to that of all. Of one it is near its own: two that are about to become one are flat.
    alone = jnp.sum(seen.visible) < 2
    valid &= found.converged | alone | ~jnp.any(valid & found.converged)
    found = dataclasses.replace(
        found,
        e1_px2=jnp.where(finite, found.e1_px2, 0),
        cost=jnp.where(finite, found.cost, 0),
        valid=valid,
    )
    order = in_order(-jnp.where(valid, found.e1_px2, jnp.inf), count)
    found = jax.tree.map(lambda leaf: leaf[order], found)
    repeats = _repeats(found.T_vehicle_world, seen, markers, found.valid)
    return dataclasses.replace(found, valid=found.valid & ~repeats)


def own_errors_px(snapshot: Snapshot, own: jaxlie.SE3) -> Float[Array, " D"]:
    """RMS distance (D,), px, of each sighting's corners to the better of its own two poses.

    It is large where the corners are not the image of a square, and 0 in hidden lanes.

    Args:
        snapshot: what is seen.
        own: `both_poses(snapshot)`.
    """
    rig, markers, seen = snapshot.rig, snapshot.markers, snapshot.seen

    corners_world = markers.corners_world_m[seen.marker_index]
    corners_vehicle = jax.vmap(jax.vmap(transform_points, (0, None)))(own, corners_world)
    points = corners_vehicle.transpose(3, 0, 2, 1).reshape(3, -1, 2)
    residual, _ = reprojection_rows(rig, seen)(points)
    error_px = residual.reshape(2, -1, 4, 2) * seen.sigma_px[None, :, :, None]
    return safe_sqrt(jnp.min(jnp.mean(jnp.sum(error_px**2, axis=0), axis=1), axis=1))


def both_poses(snapshot: Snapshot) -> jaxlie.SE3:
    """Both IPPE poses `T_vehicle_world` of every sighting by itself, batch axes (D, 2).

    Sightings that are not visible give finite poses without a meaning.
    """
    rig, markers, seen = snapshot.rig, snapshot.markers, snapshot.seen

    def one(
        T_camera_vehicle: jaxlie.SE3, T_world_marker: jaxlie.SE3, size_m: Array, rays: Array
    ) -> jaxlie.SE3:
        Ts_camera_marker = ippe_from_rays(rays, size_m)
        return jax.vmap(
            lambda T_camera_marker: (
                T_camera_vehicle.inverse() @ T_camera_marker @ T_world_marker.inverse()
            )
        )(Ts_camera_marker)

    return jax.vmap(one)(
        cameras_of(rig, seen)[1],
        jaxlie.SE3(markers.Ts_world_marker.wxyz_xyz[seen.marker_index]),
        markers.size_m[seen.marker_index],
        seen.rays,
    )


def _repeats(
    T_vehicle_world: jaxlie.SE3, seen: Sightings, markers: MarkerMap, valid: Bool[Array, " N"]
) -> Bool[Array, " N"]:
    """Whether an earlier valid lane holds the same pose, within `SAME_POSE_RAD`."""
    first_seen = seen.marker_index[jnp.argmax(seen.visible)]
    center_world = markers.Ts_world_marker.translation()[first_seen]
    centers_vehicle = jax.vmap(lambda T: transform_points(T, center_world))(T_vehicle_world)
    range_m = jnp.maximum(safe_norm(centers_vehicle), 1e-3)
    R = jax.vmap(rotation_matrix)(T_vehicle_world.rotation())
    # |R_i - R_j|_F = 2 sqrt(2) sin(angle / 2)
    turn = safe_norm((R[:, None] - R[None]).reshape(*R.shape[:1], *R.shape[:1], 9)) / jnp.sqrt(2.0)
    shift = safe_norm(centers_vehicle[:, None] - centers_vehicle[None]) / range_m[:, None]
    same = (turn < SAME_POSE_RAD) & (shift < SAME_POSE_RAD)
    earlier = jnp.tri(same.shape[0], k=-1, dtype=bool)
    return jnp.any(same & earlier & valid[None], axis=1)


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


def remove_outliers(snapshot: Snapshot, find: Find, none: Candidates) -> ConsistentSnapshot:
    """Leave out sightings that are not squares, and a marker that the others outvote.

    With three markers and more in view, the one without which the joint misfit falls below a
    bound, by a factor that no other marker reaches, is outvoted.

    Args:
        snapshot: what is seen.
        find: maps a snapshot, and `both_poses` of it, to `Candidates`; see `find_candidates`.
        none: the result without a marker in view, where `find` is not called.
    """

    nobody = jnp.zeros(len(snapshot.markers.ids), bool)
    visible, candidates, outvoted = jax.lax.cond(
        jnp.any(snapshot.seen.visible),
        lambda: _consistent(snapshot, find),
        lambda: (jnp.zeros_like(snapshot.seen.visible), none, nobody),
    )
    return ConsistentSnapshot(_among(snapshot, visible), candidates, outvoted)


def _consistent(
    snapshot: Snapshot, find: Find
) -> tuple[Bool[Array, " D"], Candidates, Bool[Array, " M"]]:
    """What `remove_outliers` finds where a marker is in view: visibility, not the snapshot."""
    own = both_poses(snapshot)
    snapshot = _among(snapshot, _can_be_markers(snapshot, own))
    seen, candidates = snapshot.seen, find(snapshot, own)
    nobody = jnp.zeros(len(snapshot.markers.ids), bool)
    if nobody.shape[0] < LEAST_MARKERS or seen.visible.shape[0] < LEAST_MARKERS:
        return seen.visible, candidates, nobody
    in_view = jnp.sum(_in_view(seen, nobody.shape[0]))
    all_of_them = excess_of_best(candidates, seen)

    def outvote() -> tuple[Bool[Array, " D"], Candidates]:
        # One slot of each marker stands for it; slots of the same marker come to the same.
        def without(marker: Array) -> tuple[Array, Candidates]:
            rest = _among(snapshot, seen.marker_index != marker)
            alternative = find(rest, own)
            return excess_of_best(alternative, rest.seen), alternative

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
    return seen.visible & kept, candidates, outvoted


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


def excess_of_best(candidates: Candidates, seen: Sightings) -> Float[Array, ""]:
    """Cost of the best candidate over its chi-square's mean plus three sigmas; inf without one."""
    misfit = candidates.least_cost
    freedom = jnp.maximum(8 * jnp.sum(seen.visible) - 6, 2).astype(misfit.dtype)
    return misfit / (freedom + 3 * jnp.sqrt(2 * freedom))
