"""All that moves the residuals of K hypotheses beside their poses, and its elimination.

A car rolls, pitches and bounces; a camera is not quite where its rig says. Residuals are linear in
these errors, which are small. See `jaxnav.core.pose.nuisance` for a single group of them.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxnav.core.filter.ambiguity import PoseBelief
from jaxnav.core.filter.camera_errors import CameraErrors, ErrorsInView, ErrorsPosterior, times
from jaxnav.core.linalg.small_matrices import matvec, product
from jaxnav.core.pose.linearised import answers, reprojection_rows
from jaxnav.core.pose.nuisance import Nuisance, camera_slopes
from jaxnav.core.pose.observation import Snapshot


class ErrorsAtBest(eqx.Module):
    """The cameras' errors q in view at a pose u: N(change + slope du, covariance) about the mean.

    Leading axis (K,) of every leaf.
    """

    change: Float[Array, "*K t"]
    slope: Float[Array, "*K t d"]
    covariance: Float[Array, "*K t t"]
    rows: Float[Array, "*K t e"]

    def given_pose(self, du: Float[Array, " d"], by_xi: Float[Array, "d d"]) -> ErrorsPosterior:
        """The errors of one hypothesis at u + du, by the pose's error there: by_xi is du / dxi."""
        return ErrorsPosterior(
            self.change + matvec(self.slope, du),
            product(self.slope, by_xi),
            self.covariance,
            self.rows,
        )


class Nuisances(eqx.Module):
    """The cameras' errors, then the vehicle's off the ground, eliminated from residuals."""

    places: Nuisance | None  # of the cameras, new in every frame, where a filter keeps their turns
    cameras: Nuisance | None
    in_view: ErrorsInView | None  # the cameras' errors, where a filter keeps them
    vehicle: Nuisance | None  # of residuals from which the cameras' errors are eliminated
    tilts: Float[Array, "v rows K"]  # by the vehicle's nuisance, only the places eliminated
    log_share: Float[Array, " K"]  # -log |I + J_t' J_t| / 2: what the residuals leave of the priors

    @staticmethod
    def of(
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
            in_view = ErrorsInView.beside(root, prior.freedom, errors, moves)
            places = Nuisance.of(moves.places[..., None])
            cameras = in_view.nuisance(places)
        elif moves is not None:
            cameras = moves.nuisance()
        _, slope = reprojection_rows(snapshot.rig, snapshot.seen)(corners)
        by_pose = answers(slope, corners)
        tilts = -jnp.sum(by_pose[:, None] * prior.nuisance[:, :, None, None], axis=0)
        if places is not None:
            tilts = places.eliminated(tilts)
        if tilts.shape[0]:
            left = tilts if cameras is None else cameras.eliminated(tilts)
            vehicle = Nuisance.of(left[:, :, None])
        shares = [part.log_share for part in (places, cameras, vehicle) if part is not None]
        return Nuisances(
            places, cameras, in_view, vehicle, tilts, sum(shares, jnp.zeros_like(corners[0, 0]))
        )

    def with_pose(self) -> tuple[Array, Array] | None:
        """Residuals (m, K) by the errors' mean, and by what comes with the pose u, (d, m, K)."""
        if self.in_view is None:
            return None
        return self.in_view.offset(), self.in_view.with_pose()

    def eliminated(self, rows: Float[Array, "*n m K"]) -> Float[Array, "*n rows K"]:
        """Residuals, or derivatives of them: moved, and the priors' own rows below."""
        for part in (self.places, self.cameras, self.vehicle):
            rows = rows if part is None else part.eliminated(rows)
        return rows

    def errors_at_best(
        self, u: Float[Array, "d K"], r: Float[Array, "m K"], J: Float[Array, "d m K"]
    ) -> ErrorsAtBest | None:
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
        return ErrorsAtBest(change, slope, covariance, rows)
