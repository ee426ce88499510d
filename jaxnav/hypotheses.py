"""A bank of hypotheses that postpones the choice between the poses of a marker.

Range and bearing of a marker are measured well; the direction it is seen from is not, and its
likelihood has two peaks or, under much noise, one flat valley. So the bank starts as a fan over
the viewing direction. Each hypothesis then minimises the paper's e = e1 + e2 in its whitened form,

    |r(T)|^2 / sigma^2 + |xi|^2_P,      T = T_prior exp(xi),

straight on the corners, instead of comparing e at two poses. How well the minimum explains the
corners, and how much of its prior it leaves, weighs the hypothesis; motion across the line of
sight drives the true one and its mirror image apart.

Source: Liu, Schofield, Shan (2023), Eq. 13; MacKay (2003), chapter 27 (Laplace's evidence);
Alspach, Sorenson (1972) (Gaussian sums).
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
import optimistix as optx
from jaxtyping import Array, Bool, Float, Int

from jaxnav.ambiguity import PoseBelief, PosePosterior, Selection, turn_rad
from jaxnav.candidates import Candidates
from jaxnav.geometry import (
    on_ground,
    right_jacobian,
    safe_atan2,
    safe_norm,
    safe_sqrt,
    transform_points,
    wrap_angle,
)
from jaxnav.levenberg_marquardt import ImplicitGradient, NormalEquationsLM
from jaxnav.observation import Snapshot
from jaxnav.residuals import reprojection_residuals
from jaxnav.small_matrices import cho_solve, cholesky, log_det, solve_lower

_FAN_RAD = float(np.deg2rad(80.0))  # from the marker's normal
_RANGE_SIGMA = 0.1  # how well a fan starts: of the range
_BEARING_SIGMA_RAD = 0.1
_CANDIDATE_LOG_WEIGHT = -5.0  # of a candidate beside the fan


class MultiHypothesis(eqx.Module):
    """Every pose that explains what was seen so far, weighed; the heaviest is reported.

    `flip_probability` is the mass farther than `far_rad` from the reported pose. The bank calls
    itself decided when that is below `decided_mass` and the orientation is known to
    `decided_sigma_rad`; until then the car explores (see `control.py`).

    It can't decide while nothing moves and the image is silent, and it takes the corner errors of
    different frames for independent: tell it the sigma of their sum, calibration included.
    """

    hypotheses: int = eqx.field(static=True, default=24)
    max_steps: int = eqx.field(static=True, default=6)
    floor_m: float = 0.0001  # of what successive frames get wrong alike (RELIABILITY R8)
    floor_rad: float = 0.0001
    merge_distance: float = 0.6  # Mahalanobis, between two means that become one
    linear_rad: float = float(np.deg2rad(3.0))  # an angle, and as much of the range
    forget_log_weight: float = -20.0  # lighter ones are dropped
    outlier_log_evidence: float = -12.0  # what a single frame can say against a hypothesis
    gate: float = 30.0  # whitened squared distance to the corners' own minimum; above: an outlier
    far_rad: float = float(np.deg2rad(20.0))
    decided_mass: float = 3e-5
    decided_sigma_rad: float = float(np.deg2rad(12.0))

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        """Weigh the hypotheses by the corners, and say what pose each has measured."""
        any_seen = jnp.any(snapshot.seen.visible)
        snapshot = _trusted(snapshot, candidates)
        starts = any_seen & ~jnp.any(prior.initialised) & jnp.any(candidates.valid)
        bank = _where(starts, self._fan(prior, candidates, snapshot), prior)
        floor = jnp.repeat(jnp.asarray([self.floor_m, self.floor_rad]), 3)
        fits = jax.vmap(lambda T, P: _fit(T, P, prior, snapshot, floor, self.max_steps))(
            bank.T_world_vehicle, bank.covariance
        )
        alive = bank.initialised & fits.finite
        evidence = self._evidence(fits, alive, candidates, starts)
        log_weight = _normalised(jnp.where(alive, bank.log_weight + evidence, -jnp.inf))
        alive = alive & (log_weight > self.forget_log_weight)

        best = jnp.argmax(log_weight)
        Ts_posterior = fits.posterior.T_world_vehicle
        T_best = jax.tree.map(lambda leaf: leaf[best], Ts_posterior)
        apart_rad = jax.vmap(lambda T: turn_rad(T.inverse() @ T_best))(Ts_posterior)
        mass = jnp.where(alive, jnp.exp(log_weight), 0)
        flip_probability = jnp.sum(jnp.where(apart_rad > self.far_rad, mass, 0))
        sigma_rad = safe_sqrt(jnp.max(jnp.diagonal(fits.posterior.covariance[best])[3:]))
        to_best_rad = jax.vmap(lambda T: turn_rad(T @ T_best))(candidates.T_vehicle_world)
        costs = jnp.where(candidates.valid, to_best_rad, jnp.inf)
        located = jnp.any(alive)
        return Selection(
            measured=eqx.tree_at(lambda m: m.taken, fits.posterior, alive & any_seen),
            kept=alive & ~starts,
            log_weight=jnp.where(alive, log_weight, self.forget_log_weight),
            heir=self._heirs(fits.posterior, log_weight, alive, prior.freedom, snapshot),
            costs=costs,
            selected=jnp.where(jnp.any(candidates.valid) & located, jnp.argmin(costs), -1),
            flip_probability=jnp.where(located, flip_probability, 0),
            decided=located
            & (flip_probability < self.decided_mass)
            & (sigma_rad < self.decided_sigma_rad),
        )

    def _evidence(
        self, fits: "_Fit", alive: Bool[Array, " K"], candidates: Candidates, starts: Array
    ) -> Float[Array, " K"]:
        """What this frame adds to the log-weights, bounded; nothing where it fits none of them."""
        best = jnp.max(jnp.where(alive, fits.log_evidence, -jnp.inf))
        bounded = jnp.maximum(fits.log_evidence - best, self.outlier_log_evidence)
        free_cost = jnp.min(jnp.where(candidates.valid, candidates.cost, jnp.inf))
        least = jnp.min(jnp.where(alive, fits.cost, jnp.inf))
        fits_one = starts | (least - free_cost < self.gate)
        return jnp.where(alive & fits_one, bounded, 0)

    def _heirs(
        self,
        posterior: PosePosterior,
        log_weight: Array,
        alive: Array,
        freedom: Array,
        snapshot: Snapshot,
    ) -> Int[Array, " K"]:
        """Who takes in whom: the heaviest of those close enough to be one Gaussian.

        Close is a fraction of the receiver's own sigma, or of an angle so small that the corners
        are linear in it.
        """
        count = self.hypotheses
        T = posterior.T_world_vehicle
        between = jaxlie.SE3(T.wxyz_xyz[:, None]).inverse() @ jaxlie.SE3(T.wxyz_xyz[None])
        wxyz = between.rotation().wxyz
        turns = 2 * jnp.where(wxyz[..., :1] < 0, -1, 1) * wxyz[..., 1:]
        apart = jnp.concatenate([between.translation(), turns], axis=-1) @ freedom
        nearest_m = jnp.min(
            safe_norm(
                T.translation()[:, None] - snapshot.markers.Ts_world_marker.translation()[None]
            ),
            axis=1,
        )
        linear = jnp.concatenate(
            [
                self.linear_rad * jnp.tile(nearest_m[:, None], 3),
                jnp.full((count, 3), self.linear_rad),
            ],
            1,
        )
        P = posterior.covariance + jax.vmap(jnp.diag)(linear**2)
        P = jnp.einsum("id,kij,je->kde", freedom, P, freedom)
        factor = jax.vmap(cholesky)(P)
        whitened = jax.vmap(lambda L, a: solve_lower(L, a.T))(factor, apart)
        close = jnp.sum(whitened**2, axis=1) < self.merge_distance**2  # [receiver, other]
        close = close & alive[:, None] & alive[None]
        rank = jnp.argsort(jnp.argsort(-jnp.where(alive, log_weight, -jnp.inf)))
        heavier = rank[:, None] < rank[None]
        # A receiver is taken in by nobody itself.
        takes = close & heavier
        takes = takes & ~jnp.any(takes, axis=0)[:, None]
        best_rank = jnp.where(takes, rank[:, None], count)
        return jnp.where(jnp.any(takes, axis=0), jnp.argmin(best_rank, axis=0), jnp.arange(count))

    def _fan(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> PoseBelief:
        """All viewing directions that range and bearing leave open, and the candidates.

        A car turns about the vertical through the marker; a free body in two angles. The candidates
        weigh little: they are there for markers that are not upright, of which no other member
        of a car's fan explains the corners.
        """
        slots = min(candidates.valid.shape[0], 3)
        count = self.hypotheses - slots
        T_world_vehicle = jax.tree.map(lambda leaf: leaf[0], candidates.T_vehicle_world).inverse()
        largest = jnp.argmax(snapshot.seen.visible)
        T_world_marker = jaxlie.SE3(
            snapshot.markers.Ts_world_marker.wxyz_xyz[snapshot.seen.marker_index[largest]]
        )
        T_camera_vehicle = jaxlie.SE3(
            snapshot.rig.Ts_camera_vehicle.wxyz_xyz[snapshot.seen.camera_index[largest]]
        )
        center = T_world_marker.translation()
        T_world_camera = T_world_vehicle @ T_camera_vehicle.inverse()
        towards = T_world_camera.translation() - center
        planar = prior.freedom.shape[1] == 3
        if planar:
            turns, axes, sigma_rad = _planar_fan(T_world_marker, towards, count)
        else:
            turns, axes, sigma_rad = _spherical_fan(T_world_marker, towards, count)
        pivot = jaxlie.SE3.from_translation(center)
        turned = jax.vmap(
            lambda wxyz: (
                (
                    pivot
                    @ jaxlie.SE3.from_rotation(jaxlie.SO3(wxyz))
                    @ pivot.inverse()
                    @ T_world_vehicle
                ).wxyz_xyz
            )
        )(turns)
        Ts_candidate = jax.vmap(lambda T: T.inverse())(candidates.T_vehicle_world).wxyz_xyz[:slots]
        Ts_world_vehicle = jaxlie.SE3(jnp.concatenate([turned, Ts_candidate]))
        if planar:
            Ts_world_vehicle = on_ground(Ts_world_vehicle)
        axes = jnp.concatenate([axes, jnp.broadcast_to(axes[:1], (slots, *axes.shape[1:]))])
        kept = prior.freedom @ prior.freedom.T
        range_m = safe_norm(towards)

        def covariance(T: jaxlie.SE3, axes: Array) -> Array:
            R = T.rotation().as_matrix()
            swing = jnp.cross(axes, (T.translation() - center)[None])
            about = jnp.concatenate([swing @ R, axes @ R], axis=1)  # (axes, 6)
            local = jnp.concatenate(
                [jnp.full(3, _RANGE_SIGMA * range_m), jnp.full(3, _BEARING_SIGMA_RAD)]
            )
            return kept @ (sigma_rad**2 * about.T @ about + jnp.diag(local**2)) @ kept

        light = jnp.concatenate([jnp.zeros(count), jnp.full(slots, _CANDIDATE_LOG_WEIGHT)])
        alive = jnp.concatenate([jnp.ones(count, bool), candidates.valid[:slots]])
        return PoseBelief(
            T_world_vehicle=Ts_world_vehicle,
            covariance=jax.vmap(covariance)(Ts_world_vehicle, axes),
            log_weight=_normalised(jnp.where(alive, light.astype(range_m.dtype), -jnp.inf)),
            initialised=alive,
            freedom=prior.freedom,
            nuisance=prior.nuisance,
        )


class _Fit(eqx.Module):
    """The minimum of e next to a prediction."""

    posterior: PosePosterior
    cost: Float[Array, ""]  # |r|^2 / sigma^2 at the minimum
    log_evidence: Float[Array, ""]
    finite: Bool[Array, ""]


def _fit(
    T_world_prior: jaxlie.SE3,
    covariance: Float[Array, "6 6"],
    prior: PoseBelief,
    snapshot: Snapshot,
    floor: Float[Array, " 6"],
    max_steps: int,
) -> _Fit:
    """Minimise e over u, in units of the prediction's own sigma: xi = freedom L u, P = L L'.

    Args:
        floor: standard deviations (m, rad) of what successive frames get wrong alike, which no
            number of frames averages out.
    """
    freedom, nuisance = prior.freedom, prior.nuisance
    d, dtype = freedom.shape[1], covariance.dtype
    eye = jnp.eye(d, dtype=dtype)
    P = freedom.T @ covariance @ freedom
    usable = jnp.all(jnp.isfinite(P)) & (jnp.min(jnp.diagonal(P)) > 0)
    spread = freedom @ (root := cholesky(jnp.where(usable, P, eye)))
    corners = transform_points(T_world_prior.inverse(), snapshot.markers.corners_world_m)

    def whitened(xi: Array) -> Array:
        back = jaxlie.SE3.exp(-xi)
        pixels = reprojection_residuals(
            snapshot.rig, snapshot.seen, transform_points(back, corners)
        )
        return (pixels / snapshot.seen.sigma_px[..., None]).reshape(-1)

    if nuisance.shape[1]:
        # The nuisance t is small: residuals are linear in it, and its best value in them.
        J_t = jax.jacfwd(lambda t: whitened(nuisance @ t))(jnp.zeros(nuisance.shape[1], dtype))
        factor_t = cholesky(J_t.T @ J_t + jnp.eye(nuisance.shape[1], dtype=dtype))

        def residual(u: Array) -> Array:
            r = whitened(spread @ u)
            t = -cho_solve(factor_t, J_t.T @ r)
            return jnp.concatenate([r + J_t @ t, t])
    else:

        def residual(u: Array) -> Array:
            return whitened(spread @ u)

    tolerance = 1e-10 if dtype == jnp.float64 else 1e-5
    solution: optx.Solution = optx.least_squares(
        lambda u, _: jnp.concatenate([residual(u), u]),
        NormalEquationsLM(rtol=tolerance, atol=tolerance),
        jnp.zeros(d, dtype),
        max_steps=max_steps,
        adjoint=ImplicitGradient(),
        throw=False,
    )
    u = solution.value
    r, push_forward = jax.linearize(residual, u)
    J = jax.vmap(push_forward)(eye).T
    information = J.T @ J
    cost = jnp.sum(r**2)
    log_evidence = -(cost + u @ u) / 2 - log_det(cholesky(information + eye)) / 2

    # What the corners say by themselves: u_alone, with covariance R; fused with the prediction.
    ridge = jnp.sqrt(jnp.finfo(dtype).eps)
    alone = cholesky(information + ridge * eye)
    u_alone = u - cho_solve(alone, J.T @ r)
    unspread = solve_lower(root, eye)
    R = cho_solve(alone, eye)
    R = R + unspread @ (freedom.T @ jnp.diag(floor**2) @ freedom) @ unspread.T
    innovation = cholesky(R + eye)
    u_fused = cho_solve(innovation, u_alone)
    nis = u_alone @ u_fused
    # I - (I + R)^-1 = R (I + R)^-1, symmetric.
    C = eye - cho_solve(innovation, eye)
    xi = spread @ u_fused
    moved = jaxlie.SE3.exp(xi)
    T = (T_world_prior @ moved).normalize()
    carry = right_jacobian(xi) @ spread
    posterior_covariance = carry @ ((C + C.T) / 2) @ carry.T
    numbers = [T.wxyz_xyz, posterior_covariance.reshape(-1), log_evidence[None], nis[None]]
    finite = usable & jnp.all(jnp.isfinite(jnp.concatenate(numbers)))
    return _Fit(
        posterior=PosePosterior(
            jaxlie.SE3(jnp.where(finite, T.wxyz_xyz, T_world_prior.wxyz_xyz)),
            jnp.where(finite, posterior_covariance, jnp.eye(6, dtype=dtype)),
            jnp.where(finite, nis, jnp.inf),
            finite,
        ),
        cost=jnp.where(finite, cost, jnp.inf),
        log_evidence=jnp.where(finite, log_evidence, -jnp.inf),
        finite=finite,
    )


def _trusted(snapshot: Snapshot, candidates: Candidates) -> Snapshot:
    """The corners, trusted no more than their own misfit allows.

    Where not even the best pose explains them within three sigmas of chi-square, their sigma is
    larger than they say: a blurred, bent or half hidden marker.

    Source: Birge (1932), "The calculation of errors by the method of least squares".
    """
    seen = snapshot.seen
    misfit = jnp.min(jnp.where(candidates.valid, candidates.cost, jnp.inf))
    freedom = jnp.maximum(8 * jnp.sum(seen.visible) - 6, 2).astype(misfit.dtype)
    expected = freedom + 3 * jnp.sqrt(2 * freedom)
    excess = jnp.where(jnp.isfinite(misfit), misfit / expected, 1)
    scale = jnp.sqrt(jnp.maximum(excess, 1))
    return eqx.tree_at(lambda s: s.seen.sigma_px, snapshot, seen.sigma_px * scale)


def _planar_fan(
    T_world_marker: jaxlie.SE3, towards: Float[Array, " 3"], count: int
) -> tuple[Array, Array, float]:
    """Turns about the vertical: viewing angles from -80 to 80 degrees.

    Args:
        towards: from the marker to the camera, world.

    Returns:
        Quaternions (count, 4), axes of uncertainty (count, 1, 3), its sigma in rad.
    """
    normal = T_world_marker.rotation().as_matrix()[:, 2]
    azimuth_rad = wrap_angle(safe_atan2(towards[1], towards[0]) - safe_atan2(normal[1], normal[0]))
    angles_rad = jnp.linspace(-_FAN_RAD, _FAN_RAD, count, dtype=towards.dtype) - azimuth_rad
    zero = jnp.zeros_like(angles_rad)
    turns = jnp.stack([jnp.cos(angles_rad / 2), zero, zero, jnp.sin(angles_rad / 2)], axis=1)
    vertical = jnp.asarray([0.0, 0.0, 1.0], towards.dtype)
    axes = jnp.broadcast_to(vertical, (count, 1, 3))
    return turns, axes, 2 * _FAN_RAD / max(count - 1, 1)


def _spherical_fan(
    T_world_marker: jaxlie.SE3, towards: Float[Array, " 3"], count: int
) -> tuple[Array, Array, float]:
    """Turns in both angles: viewing directions evenly over a cap of 80 degrees.

    Args and result as `_planar_fan`, with two axes. Source of the spiral: Vogel (1979).
    """
    share = (np.arange(count) + 0.5) / count
    cosine = 1 - share * (1 - np.cos(_FAN_RAD))
    azimuth = np.arange(count) * np.pi * (3 - np.sqrt(5))
    sine = np.sqrt(1 - cosine**2)
    views = jnp.asarray(
        np.column_stack([sine * np.cos(azimuth), sine * np.sin(azimuth), cosine]), towards.dtype
    )
    R_world_marker = T_world_marker.rotation()
    direction = R_world_marker.inverse() @ towards
    direction = direction / jnp.maximum(safe_norm(direction), 1e-9)
    # Through the frontal view, so that the marker does not seem to roll.
    to_frontal = _shortest_turn(direction).inverse()
    turns_marker = jax.vmap(lambda v: (_shortest_turn(v) @ to_frontal).wxyz)(views)
    turns = jax.vmap(
        lambda wxyz: (R_world_marker @ jaxlie.SO3(wxyz) @ R_world_marker.inverse()).wxyz
    )(turns_marker)
    Rs = jax.vmap(lambda v: (R_world_marker @ _shortest_turn(v)).as_matrix())(views)
    axes = jnp.swapaxes(Rs[:, :, :2], 1, 2)
    area = 2 * np.pi * (1 - np.cos(_FAN_RAD)) / count
    return turns, axes, float(np.sqrt(area) / 2)


def _shortest_turn(direction: Float[Array, " 3"]) -> jaxlie.SO3:
    """The rotation that carries (0, 0, 1) into a unit vector not opposite to it."""
    x, y, z = direction
    wxyz = jnp.stack([jnp.maximum(1 + z, 1e-3), -y, x, jnp.zeros_like(x)])
    return jaxlie.SO3(wxyz).normalize()


def _normalised(log_weight: Float[Array, " K"]) -> Float[Array, " K"]:
    """Weights that sum to 1; all as they are where none is finite."""
    highest = jnp.max(log_weight)
    any_finite = jnp.isfinite(highest)
    shifted = jnp.where(any_finite, log_weight - jnp.where(any_finite, highest, 0), 0)
    return jnp.where(any_finite, shifted - jnp.log(jnp.sum(jnp.exp(shifted))), log_weight)


def _where(condition: Bool[Array, ""], yes: Any, no: Any) -> Any:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), yes, no)
