"""Corner errors that repeat from frame to frame: how many do, and how little a repeat tells.

A lens residual, a marker that is not flat and blur are the same in the next frame, as long as the
marker's image has hardly moved. Of the variance sigma^2 of a corner a share s repeats. After n
sightings with the same repeated error the mean of n + 1 has the variance

    v(n + 1) = sigma^2 ((1 - s) / (n + 1) + s)

instead of sigma^2 / (n + 1), so the next sighting counts as one of the variance

    sigma_n^2 = 1 / (1 / v(n + 1) - 1 / v(n))
              = sigma^2 (1 - s + (n + 1) s) (1 - s + n s) / (1 - s).

The first counts in full, and many of a vehicle that stands add up to 1 / (s sigma^2) at most.

Repeated errors stay as they are, so corners that contradict the prediction beyond white noise show
something else: the marker is another, or the odometer stands still. These sightings are new, by
n / surprise^2.

The share is learnt. Two of a sighting's eight numbers fit no pose of its marker, wherever camera
and marker are: of white noise their product with the sum S of those of n sightings before has the
mean 0 and the variance 2 n, and where a share repeats the mean 2 s n.

Source: Bayley, Hammersley (1946), "The 'effective' number of independent observations in an
autocorrelated time series".
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.ambiguity import PoseBelief
from jaxnav.core.filter.gate import excess_of
from jaxnav.core.linalg.small_matrices import (
    cholesky,
    gram,
    matvec,
    product,
    sandwich,
    solve_lower,
)
from jaxnav.core.models.geometry import safe_norm, safe_sqrt, transform_points
from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.rig import CameraRig
from jaxnav.core.pose.candidates import Candidates
from jaxnav.core.pose.linearised import answers, reprojection_rows
from jaxnav.core.pose.observation import Sightings, Snapshot

_UNEXPLAINED = 2  # of a sighting's eight numbers: a pose has six
_CERTAIN_SIGMAS = 2.0  # a share is believed as far as it exceeds so many sigmas of white noise
_MEMORY_FRAMES = 1000.0  # after so many, 1 / e of what was learnt of the share is left
_MOST_SIGMAS = 6.0  # that a number, or a product, counts for: a spoilt frame is no proof


class Repeats(eqx.Module):
    """The last sighting of each marker by each camera, and what of its errors was seen before."""

    diagonal_px: Float[Array, "C M 2 2"]  # two opposite corners, which say how all have moved
    count: Float[Array, "C M"]  # sightings that had the errors of the last one, itself among them
    unexplained: Float[Array, "C M 2"]  # S: sum of what fits no pose, in sigmas
    squares: Float[Array, "C M"]  # sum of squared weights in S
    share: Float[Array, ""]  # of a corner's variance that surely repeats; none: 0 or less
    white: Float[Array, ""]  # variance of the sum of all products, were all errors white


class RepeatedErrors(eqx.Module):
    """How much of a corner's variance may repeat, and how far an image moves until it is new.

    The share is `least_share` at first, and grows with what residuals show to `most_share`. As
    large a least one fixes it.
    """

    least_share: Float[Array, ""] | float = 0.0
    most_share: Float[Array, ""] | float = 0.1
    # By which corners have moved when 1 / e of their errors is the same.
    renewal_px: Float[Array, ""] | float = 40.0

    @staticmethod
    def of(hypotheses: int) -> "RepeatedErrors | None":
        """The default; None for a single hypothesis, which doubts nothing."""
        return RepeatedErrors() if hypotheses > 1 else None

    def begin(self, rig: CameraRig, markers: MarkerMap) -> Repeats:
        """Nothing was seen yet."""
        lanes, dtype = (len(rig), len(markers.ids)), rig.cameras.focal_px.dtype
        shapes = ((*lanes, 2, 2), lanes, (*lanes, 2), lanes, (), ())
        return Repeats(*(jnp.zeros(shape, dtype) for shape in shapes))

    def weighed(
        self, repeats: Repeats, snapshot: Snapshot, surprise: Float[Array, ""] | float = 1.0
    ) -> Snapshot:
        """The snapshot with the sigma of repeated sightings raised, see `surprise_of`."""
        seen = snapshot.seen
        s = jnp.maximum(jnp.minimum(repeats.share, self.most_share), self.least_share)
        n = (self._same(repeats, seen) * repeats.count[_lanes(seen)])[:, None] / surprise**2
        scale = jnp.sqrt((1 - s + (n + 1) * s) * (1 - s + n * s) / (1 - s))
        sigma_px = seen.sigma_px * scale.astype(seen.sigma_px.dtype)
        return dataclasses.replace(snapshot, seen=dataclasses.replace(seen, sigma_px=sigma_px))

    def after(
        self,
        repeats: Repeats,
        snapshot: Snapshot,
        T_world_vehicle: jaxlie.SE3,
        known: Bool[Array, ""],
    ) -> Repeats:
        """What is known after a snapshot.

        Args:
            T_world_vehicle: the estimate. Not the best pose of the snapshot alone: near the frontal
                view that bends towards the errors, in every frame alike.
            known: whether it is of the right branch and the snapshot was expected; else the share
                learns nothing.
        """
        seen, dtype = snapshot.seen, repeats.count.dtype
        at = _lanes(seen)
        judged = seen.visible & known
        r = unexplained(T_world_vehicle.inverse(), snapshot).astype(dtype)
        r = jnp.clip(jnp.where(judged[:, None], r, 0), -_MOST_SIGMAS, _MOST_SIGMAS)

        same = self._same(repeats, seen)
        S = same[:, None] * repeats.unexplained[at]
        squares = same**2 * repeats.squares[at]
        variance = jnp.where(judged, _UNEXPLAINED * squares, 0)
        most = _MOST_SIGMAS * safe_sqrt(variance)
        alike = jnp.sum(jnp.clip(jnp.sum(r * S, axis=1), -most, most))
        before = repeats.share * repeats.white + _CERTAIN_SIGMAS * safe_sqrt(repeats.white)
        kept = 1 - jnp.any(variance > 0) / _MEMORY_FRAMES
        white = kept * repeats.white + jnp.sum(variance)
        surely = kept * before + alike - _CERTAIN_SIGMAS * safe_sqrt(white)
        share = jnp.where(white > 0, surely, 0) / jnp.where(white > 0, white, 1)

        def renewed(before: Array, now: Array) -> Array:
            """Hidden sightings keep what was."""
            shown = seen.visible.reshape(-1, *(1,) * (now.ndim - 1))
            return before.at[at].set(jnp.where(shown, now, before[at]).astype(dtype))

        return Repeats(
            renewed(repeats.diagonal_px, seen.corners_px[:, ::2]),
            renewed(repeats.count, same * repeats.count[at] + 1),
            renewed(repeats.unexplained, S + r),
            renewed(repeats.squares, squares + judged),
            share.astype(dtype),
            white.astype(dtype),
        )

    def _same(self, repeats: Repeats, seen: Sightings) -> Float[Array, " D"]:
        """The part of the last repeated errors that these sightings have."""
        moved = seen.corners_px[:, ::2] - repeats.diagonal_px[_lanes(seen)]
        moved_px = safe_norm(moved.reshape(-1, 4) / np.sqrt(2))
        return jnp.exp(-moved_px / self.renewal_px).astype(repeats.count.dtype)


def weigh_repeats(
    model: RepeatedErrors | None,
    repeats: Repeats | None,
    predicted: PoseBelief,
    index: Int[Array, ""],
    candidates: Candidates,
    snapshot: Snapshot,
) -> Snapshot:
    """The snapshot weighed by the surprise of one prediction; as it is without a model."""
    if model is None or repeats is None:
        return snapshot
    return model.weighed(repeats, snapshot, surprise_of(predicted, index, candidates, snapshot))


def learn_repeats(
    model: RepeatedErrors | None,
    repeats: Repeats | None,
    snapshot: Snapshot,
    T_world_vehicle: jaxlie.SE3,
    known: Bool[Array, ""],
) -> Repeats | None:
    """`model.after` a snapshot; None without a model."""
    if model is None or repeats is None:
        return None
    return model.after(repeats, snapshot, T_world_vehicle, known)


def surprise_of(
    predicted: PoseBelief, index: Int[Array, ""], candidates: Candidates, snapshot: Snapshot
) -> Float[Array, ""]:
    """How far the corners contradict a hypothesis: 1 where they don't by more than white noise.

    By its NIS, which is what the corners cost at the best pose between prediction and corners, to
    first order, more than at the best candidate.
    """
    T = jaxlie.SE3(predicted.T_world_vehicle.wxyz_xyz[index])
    alive = predicted.initialised[index]
    P = sandwich(predicted.freedom.T, predicted.covariance[index])
    eye = jnp.eye(P.shape[0], dtype=P.dtype)
    spread = product(predicted.freedom, cholesky(jnp.where(alive, P, eye)))
    spread = jnp.concatenate([spread, predicted.nuisance], axis=1)
    corners = snapshot.markers.corners_world_m[snapshot.seen.marker_index].reshape(-1, 3)
    points = transform_points(T.inverse(), corners).T[..., None]
    residual, slope = reprojection_rows(snapshot.rig, snapshot.seen)(points)
    r, J = residual.reshape(-1), product(spread.T, answers(slope, points)[..., 0])
    information = gram(J) + jnp.eye(J.shape[0], dtype=J.dtype)
    explained = jnp.sum(solve_lower(cholesky(information), matvec(J, r)) ** 2)
    nis = jnp.sum(r**2) - explained - candidates.least_cost
    nis = jnp.where(alive & jnp.isfinite(nis), nis, 0)
    return excess_of(nis, jnp.asarray(J.shape[0], nis.dtype))


def unexplained(T_vehicle_world: jaxlie.SE3, snapshot: Snapshot) -> Float[Array, "D 2"]:
    """What of residuals, in sigmas, no pose of the marker before its camera explains.

    To first order about the given pose: the residuals along two unit vectors that are orthogonal
    to the six derivatives by the marker's pose (Gram, Schmidt), those nearest to its diagonals
    stretched against each other.
    """
    seen, count = snapshot.seen, snapshot.seen.visible.shape[0]
    corners = transform_points(T_vehicle_world, snapshot.markers.corners_world_m[seen.marker_index])
    # About the marker's centre, where the derivatives are most different.
    arms = corners - jnp.mean(corners, axis=1, keepdims=True)
    points, about = (x.reshape(-1, 3).T[..., None] for x in (corners, arms))
    residual, slope = reprojection_rows(snapshot.rig, seen)(points)

    def by_sighting(rows: Array) -> Float[Array, "n D 8"]:
        return rows.reshape(-1, 2, count, 4).transpose(0, 2, 3, 1).reshape(-1, count, 8)

    stretched = jnp.asarray(np.kron([[1, -1, 1, -1]], np.eye(2)), slope.dtype)[:, None]
    units: list[Array] = []
    for vector in [*by_sighting(answers(slope, about)), *jnp.tile(stretched, (count, 1))]:
        for unit in units:
            vector = vector - unit * jnp.sum(unit * vector, axis=1, keepdims=True)
        length = safe_norm(vector)[:, None]
        units.append(vector / jnp.where(length > 0, length, 1))
    return jnp.sum(jnp.stack(units[-_UNEXPLAINED:], 1) * by_sighting(residual)[0][:, None], axis=2)


def _lanes(seen: Sightings) -> tuple[Array, Array]:
    return seen.camera_index, seen.marker_index
