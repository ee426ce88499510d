"""Errors beside the pose: of the cameras, of a car off the ground, and those that corners repeat.

A car rolls, pitches and bounces; a camera is not quite where its rig says. Residuals are linear in
these errors, which are small, and they are eliminated (see `jaxnav.core.pose.residuals`). A filter
that keeps the cameras' turns behind its own states, three of each camera in units of their prior's
sigma (`CameraRig.extrinsics_sigma`), solves a pose together with those in view: given the pose they
are Gaussian. The filter then corrects them, and all that is correlated with them.

How many errors of a corner repeat from frame to frame, and how little a repeat tells:

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
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.bank import CameraErrors, PoseBelief, excess_of
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
from jaxnav.core.pose.observation import Sightings, Snapshot
from jaxnav.core.pose.refine import Candidates
from jaxnav.core.pose.residuals import (
    CameraSlopes,
    Nuisance,
    camera_slopes,
    jacobian_by_twist,
    reprojection_rows,
)

EACH = 3  # states of a camera


def ridge(dtype: DTypeLike) -> Float[Array, ""]:
    """Variance that keeps what the pose leaves of an error positive where rounding would not."""
    return jnp.sqrt(jnp.finfo(dtype).eps) / 10


class ErrorsPosterior(eqx.Module):
    """The errors of the cameras in view, given the pose: N(mean + slope d, covariance).

    d is how far the pose is off, along its freedom: in its own axes, once it is corrected.
    """

    change: Float[Array, "*K t"]  # of the mean, at the pose
    slope: Float[Array, "*K t d"]
    covariance: Float[Array, "*K t t"]
    rows: Float[Array, "*K t e"]  # selects them among all cameras' errors; zero: not in view

    def given_pose(
        self, du: Float[Array, " d"], by_xi: Float[Array, "d d"], rest: Float[Array, "d d"]
    ) -> "ErrorsPosterior":
        """The errors of one hypothesis at u + du, by the pose's error there.

        The floor is an error of the pose alone, and the errors follow what is not floor. Did they
        follow all of it, a frame could leave them less certain than it found them.

        Args:
            by_xi: by the pose's error, what of du is not floor.
            rest: covariance of what is not floor, given u.
        """
        return ErrorsPosterior(
            change=self.change + matvec(self.slope, du),
            slope=product(self.slope, by_xi),
            covariance=self.covariance + sandwich(self.slope, rest),
            rows=self.rows,
        )


class ErrorsInView(eqx.Module):
    """The errors q of the cameras in view beside the pose, of K hypotheses.

        q = mean + by_pose u + root w,      u, w ~ N(0, I),

    where u is the pose in units of its own sigma.
    """

    mean: Float[Array, "t K"]
    by_pose: Float[Array, "t d K"]
    root: Float[Array, "t t K"]
    rows: Float[Array, "t e"]
    slopes: Float[Array, "t m"]  # of the residuals by q

    @staticmethod
    def at_predictions(
        pose_root: Float[Array, "K d d"],
        freedom: Float[Array, "6 d"],
        errors: CameraErrors,
        moves: CameraSlopes,
    ) -> "ErrorsInView":
        """The errors in view, given poses whose covariance is pose_root pose_root'."""
        groups, e = moves.camera.shape[0], errors.mean.shape[1]
        of_group = moves.camera[:, None] == jnp.arange(e // EACH)[None]
        of_group = (of_group & moves.in_view[:, None]).astype(errors.mean.dtype)
        rows = jnp.kron(of_group, jnp.eye(EACH, dtype=errors.mean.dtype))
        hidden = jnp.repeat(1 - moves.in_view.astype(rows.dtype), EACH)
        slopes = moves.turns.transpose(2, 0, 1).reshape(groups * EACH, -1)

        def one(L: Array, mean: Array, P: Array, cross: Array) -> tuple[Array, Array, Array]:
            C = product(product(freedom.T, cross), rows.T)  # (d, t)
            by_pose = solve_lower(L, C).T
            left = sandwich(rows, P) - gram(by_pose) + jnp.diag(hidden + ridge(rows.dtype))
            return matvec(rows, mean), by_pose, cholesky(left)

        mean, by_pose, root = jax.vmap(one, out_axes=-1)(
            pose_root, errors.mean, errors.covariance, errors.cross
        )
        return ErrorsInView(mean, by_pose, root, rows, slopes)


def _moved(by: Float[Array, "t n K"], slopes: Float[Array, "t m"]) -> Float[Array, "n m K"]:
    """Derivative of residuals with these slopes by what moves the errors by `by`."""
    return jnp.sum(by[:, :, None] * slopes[:, None, :, None], axis=0)


def common_turn(errors: ErrorsPosterior, sigma_rad: Float[Array, "C 3"]) -> Float[Array, "e 3"]:
    """Errors by which all cameras in view turn alike, about each axis, of length 1; else 0.

    A body that turns the other way sees the same: where no odometry tells how it moves, nothing
    does. A filter would learn that turn all the same, of the changes of its own twist, and grow
    sure of it: 4 degrees on test_5 of TagSLAM, with a sigma of 0.1 (Huang, Mourikis, Roumeliotis,
    2010, "Observability-based rules for designing consistent EKF SLAM estimators").

    Args:
        errors: of one hypothesis.
        sigma_rad: prior of the cameras' turns.
    """
    turns = jnp.sum(errors.rows, axis=0).reshape(-1, EACH) / sigma_rad
    length = safe_norm(turns.T)
    turns = turns / jnp.where(length > 0, length, 1)[None]
    return (turns[:, :, None] * jnp.eye(EACH, dtype=turns.dtype)[None]).reshape(-1, EACH)


def schmidt_update_along(
    directions: Float[Array, "e u"],
    before: Float[Array, "n n"],
    correction: Float[Array, " n"],
    P: Float[Array, "n n"],
) -> tuple[Float[Array, " n"], Float[Array, "n n"]]:
    """Leave some directions of the errors as they were before a correction (Schmidt).

    Args:
        directions: orthonormal, of the e errors at the end of the state; or 0.
        before: covariance before the correction.

    Source: Schmidt (1966), "Application of state-space methods to navigation problems".
    """
    first = P.shape[0] - directions.shape[0]
    back = product(directions, directions.T)
    narrowed = before[first:, first:] - P[first:, first:]
    return (
        correction.at[first:].add(-matvec(back, correction[first:])),
        P.at[first:, first:].add(sandwich(back, narrowed)),
    )


def times(A: Float[Array, "n m K"], B: Float[Array, "k m K"]) -> Float[Array, "n k K"]:
    """A B' of each lane."""
    return jnp.sum(A[:, None] * B[None], axis=2)


class Nuisances(eqx.Module):
    """The cameras' errors, then the vehicle's off the ground, eliminated from residuals."""

    places: Nuisance | None  # of the cameras, new in every frame, where a filter keeps their turns
    cameras: Nuisance | None
    in_view: ErrorsInView | None  # the cameras' errors, where a filter keeps them
    vehicle: Nuisance | None  # of residuals from which the cameras' errors are eliminated
    tilts: Float[Array, "v rows K"]  # by the vehicle's nuisance, only the places eliminated
    log_share: Float[Array, " K"]  # -log |I + J_t' J_t| / 2: what the residuals leave of the priors

    @staticmethod
    def at_predictions(
        corners: Float[Array, "3 P K"],
        root: Float[Array, "K d d"],
        errors: CameraErrors | None,
        prior: PoseBelief,
        snapshot: Snapshot,
    ) -> "Nuisances":
        """The nuisances at K predictions.

        Args:
            corners: in the frame of each prediction, m.
            root: of the predictions' covariances along `prior.freedom`.
            errors: of the cameras, as predicted; None: those of each frame are new.
        """
        moves = camera_slopes(snapshot.rig, snapshot.markers, snapshot.seen)
        places = cameras = in_view = vehicle = None
        if moves is not None and errors is not None:
            in_view = ErrorsInView.at_predictions(root, prior.freedom, errors, moves)
            places = Nuisance.from_slopes(moves.places[..., None])
            slopes = places.eliminated(in_view.slopes[..., None])[..., 0]
            cameras = Nuisance.from_slopes(_moved(in_view.root, slopes)[:, :, None])
        elif moves is not None:
            cameras = moves.nuisance()
        _, slope = reprojection_rows(snapshot.rig, snapshot.seen)(corners)
        by_pose = jacobian_by_twist(slope, corners)
        tilts = -jnp.sum(by_pose[:, None] * prior.nuisance[:, :, None, None], axis=0)
        if places is not None:
            tilts = places.eliminated(tilts)
        if tilts.shape[0]:
            left = tilts if cameras is None else cameras.eliminated(tilts)
            vehicle = Nuisance.from_slopes(left[:, :, None])
        shares = [part.log_share for part in (places, cameras, vehicle) if part is not None]
        return Nuisances(
            places, cameras, in_view, vehicle, tilts, sum(shares, jnp.zeros_like(corners[0, 0]))
        )

    def with_pose(self) -> tuple[Array, Array] | None:
        """Residuals (m, K) by the errors' mean, and by what comes with the pose u, (d, m, K)."""
        if self.in_view is None:
            return None
        mean, by_pose, slopes = self.in_view.mean, self.in_view.by_pose, self.in_view.slopes
        return jnp.sum(mean[:, None] * slopes[..., None], axis=0), _moved(by_pose, slopes)

    def eliminated(self, rows: Float[Array, "*n m K"]) -> Float[Array, "*n rows K"]:
        """Eliminate the errors from residuals, or from derivatives; their priors add rows."""
        for part in (self.places, self.cameras, self.vehicle):
            rows = rows if part is None else part.eliminated(rows)
        return rows

    def errors_at_best(
        self, u: Float[Array, "d K"], r: Float[Array, "m K"], J: Float[Array, "d m K"]
    ) -> ErrorsPosterior | None:
        """The cameras' errors that explain residuals r + J du at u + du best.

        With A = I + S' S of the cameras, T the vehicle's slopes and D = I + T' (I + S S')^-1 T,
        the covariance is A^-1 + M D^-1 M', M = A^-1 S' T.
        """
        cameras, vehicle, in_view = self.cameras, self.vehicle, self.in_view
        if self.places is None or cameras is None or in_view is None:
            return None
        r, J = self.places.eliminated(r), self.places.eliminated(J)

        def best(rows: Array) -> Array:
            if vehicle is not None:
                of_vehicle = vehicle.at_best(cameras.eliminated(rows))  # (v, 1, K)
                rows = rows + jnp.sum(of_vehicle * self.tilts, axis=0)
            return cameras.at_best(rows)[:, 0]

        w, by_u = best(r), jax.vmap(best)(J)  # (t, K), (d, t, K)
        slopes, gains = cameras.slopes[:, :, 0], cameras.gains[:, :, 0]
        covariance = jnp.eye(w.shape[0], dtype=w.dtype)[..., None] - times(gains, slopes)
        if vehicle is not None:
            M = times(gains, self.tilts)
            left = jnp.eye(M.shape[1], dtype=w.dtype)[..., None] - times(
                vehicle.gains[:, :, 0], vehicle.slopes[:, :, 0]
            )
            covariance = covariance + times(times(M, left), M)
        L, B = in_view.root, in_view.by_pose
        change = jnp.sum(B * u[None], axis=1) + jnp.sum(L * w[None], axis=1)
        slope = B + times(L, by_u)
        covariance = times(times(L, covariance), L)
        rows = jnp.broadcast_to(in_view.rows, (w.shape[1], *in_view.rows.shape))
        change, slope, covariance = (jnp.moveaxis(x, -1, 0) for x in (change, slope, covariance))
        return ErrorsPosterior(change, slope, covariance, rows)


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

    def begin(self, rig: CameraRig, markers: MarkerMap) -> Repeats:
        """The state before anything was seen."""
        lanes, dtype = (len(rig), len(markers.ids)), rig.cameras.focal_px.dtype
        shapes = ((*lanes, 2, 2), lanes, (*lanes, 2), lanes, (), ())
        return Repeats(*(jnp.zeros(shape, dtype) for shape in shapes))

    def weighed(
        self, repeats: Repeats, snapshot: Snapshot, surprise: Float[Array, ""] | float = 1.0
    ) -> Snapshot:
        """Raise the sigma of sightings that repeat; see `surprise_of`."""
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
        """Learn from a snapshot.

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
            """The table with the sightings in view; hidden ones keep what was."""
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
    r, J = residual.reshape(-1), product(spread.T, jacobian_by_twist(slope, points)[..., 0])
    information = gram(J) + jnp.eye(J.shape[0], dtype=J.dtype)
    explained = jnp.sum(solve_lower(cholesky(information), matvec(J, r)) ** 2)
    nis = jnp.sum(r**2) - explained - candidates.least_cost
    nis = jnp.where(alive & jnp.isfinite(nis), nis, 0)
    return excess_of(nis, jnp.asarray(J.shape[0], nis.dtype))


def unexplained(T_vehicle_world: jaxlie.SE3, snapshot: Snapshot) -> Float[Array, "D 2"]:
    """The part of residuals, in sigmas, that no pose of the marker before its camera explains.

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
    for vector in [*by_sighting(jacobian_by_twist(slope, about)), *jnp.tile(stretched, (count, 1))]:
        for unit in units:
            vector = vector - unit * jnp.sum(unit * vector, axis=1, keepdims=True)
        length = safe_norm(vector)[:, None]
        units.append(vector / jnp.where(length > 0, length, 1))
    return jnp.sum(jnp.stack(units[-_UNEXPLAINED:], 1) * by_sighting(residual)[0][:, None], axis=2)


def _lanes(seen: Sightings) -> tuple[Array, Array]:
    return seen.camera_index, seen.marker_index
