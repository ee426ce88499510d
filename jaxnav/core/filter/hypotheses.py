"""A bank of hypotheses that postpones the choice between the poses of a marker.

Range and bearing of a marker are measured well; the direction it is seen from is not, and its
likelihood has two peaks or, under much noise, one flat valley. So the bank starts as a fan over
the viewing direction. Each hypothesis then minimises the paper's e = e1 + e2 in its whitened form,

    |r(T)|^2 / sigma^2 + |xi|^2_P,      T = T_prior exp(xi),

straight on the corners, instead of comparing e at two poses. How well the minimum explains the
corners, and how much of its prior it leaves, weighs the hypothesis; motion across the line of
sight drives the true one and its mirror image apart.

Near the frontal view the two poses of a marker meet and a bank merges them; further on they part
again. Then a hypothesis whose prior covers both is split: beside the posterior next to the
prediction, an empty slot takes the one of the prediction and another candidate, as Gaussians.

Source: Liu, Schofield, Shan (2023), Eq. 13; MacKay (2003), chapter 27 (Laplace's evidence);
Alspach, Sorenson (1972) (Gaussian sums).
"""

import dataclasses
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.bank import EVEN_LOG_WEIGHT, PoseBelief, excess_of, find_merges, normalise
from jaxnav.core.filter.choose import MeasuredPose, Selection
from jaxnav.core.filter.fit import PoseFit, fit_poses
from jaxnav.core.linalg.levenberg_marquardt import mark_found
from jaxnav.core.linalg.small_matrices import (
    cholesky,
    first_highest,
    log_det,
    matvec,
    product,
    sandwich,
    solve_lower,
    where,
)
from jaxnav.core.models.geometry import (
    EVEN_RAD,
    inverse_cayley,
    on_ground,
    rotation_error_rad,
    rotation_matrix,
    safe_atan2,
    safe_norm,
    safe_sqrt,
    shift_and_turn,
    wrap_angle,
)
from jaxnav.core.pose.candidates import SAME_POSE_RAD, excess_of_best
from jaxnav.core.pose.observation import Snapshot
from jaxnav.core.pose.refine import Candidates


def nearer_to_another(
    T_world_vehicle: jaxlie.SE3,
    covariance: Float[Array, "K 6 6"],
    candidates: Candidates,
    selected: Int[Array, ""],
) -> Float[Array, " K"]:
    """Probability that a candidate is nearer in angle than the selected one, for each hypothesis.

    Between two candidates lies a bisector: a pose is nearer to the other one beyond it. Another one
    is another index, and farther off than candidates that merge: of the selected one, computed
    twice, the two roundings are a distance as well.
    """
    base = T_world_vehicle.wxyz_xyz
    other = jax.vmap(lambda T: T.inverse().wxyz_xyz)(candidates.T_vehicle_world)
    between = jax.vmap(jax.vmap(shift_and_turn, (None, 0)), (0, None))(base, other)
    turns = between[..., 3:]  # (K, N, 3)
    own = turns[:, selected]
    across = turns - own[:, None]
    is_other = candidates.valid & (jnp.arange(candidates.valid.shape[0]) != selected)
    is_other = is_other[None] & (safe_norm(across) >= SAME_POSE_RAD)
    across = jnp.where(is_other[..., None], across, 1)
    length = safe_norm(across)
    direction = across / length[..., None]
    gap = jnp.sum(turns**2, axis=2) - jnp.sum(own**2, axis=1)[:, None]
    gap_rad = gap / (2 * length)
    P = covariance[:, None, 3:, 3:]
    variance = jnp.sum(direction[..., None] * P * direction[..., None, :], axis=(2, 3))
    sigma_rad = jnp.maximum(safe_sqrt(jnp.maximum(variance, 0)), 1e-6)
    nearer = jax.scipy.special.erfc(gap_rad / (np.sqrt(2) * sigma_rad)) / 2
    return jnp.max(jnp.where(is_other, nearer, 0), axis=1)


def beyond(
    limit_rad: Float[Array, ""] | float,
    apart_rad: Float[Array, " K"],
    sigma_rad: Float[Array, " K"],
) -> Float[Array, " K"]:
    """Probability that |N(apart_rad, sigma_rad^2)| exceeds a limit, for each hypothesis."""
    scale = np.sqrt(2) * jnp.maximum(sigma_rad, 1e-6)
    below, above = (limit_rad - apart_rad) / scale, (limit_rad + apart_rad) / scale
    return (jax.scipy.special.erfc(below) + jax.scipy.special.erfc(above)) / 2


class SecondPoses(NamedTuple):
    """Candidates that a predicted hypothesis may have meant too, or the slots that take them."""

    wanted: Bool[Array, " N"]
    xi: Float[Array, "N d"]  # along `freedom`, from the prediction; 0 in a slot that takes none


def second_poses(
    bank: PoseBelief,
    index: Int[Array, ""] | int,
    candidates: Candidates,
    least_log_weight: Float[Array, ""] | float,
) -> SecondPoses:
    """Find the other poses of a marker that a prediction covers, beside the nearest.

    The nearest one is where the search from the prediction leads.

    Args:
        bank: predicted.
        index: of the hypothesis whose prediction it is.
        candidates: N poses of this observation.
        least_log_weight: of a candidate, beside the most probable one.
    """
    freedom = bank.freedom
    T_prior = jaxlie.SE3(bank.T_world_vehicle.wxyz_xyz[index])
    P = sandwich(freedom.T, bank.covariance[index])
    eye = jnp.eye(freedom.shape[1], dtype=P.dtype)

    def one(
        T_vehicle_world: jaxlie.SE3, covariance: Array, valid: Array
    ) -> tuple[Array, Array, Array]:
        xi = matvec(freedom.T, inverse_cayley(T_prior.inverse() @ T_vehicle_world.inverse()))
        S = P + sandwich(freedom.T, covariance)
        usable = valid & jnp.all(jnp.isfinite(S)) & jnp.all(jnp.isfinite(xi))
        xi, S = jnp.where(usable, xi, 0), jnp.where(usable, S, eye)
        root = cholesky(S)
        away = jnp.sum(solve_lower(root, xi) ** 2)
        return xi, jnp.where(usable, away, jnp.inf), log_det(root)

    xi, away, volume = jax.vmap(one)(
        candidates.T_vehicle_world, candidates.covariance, candidates.valid
    )
    cost = jnp.where(candidates.valid, candidates.cost, jnp.inf)
    log_weight = -(cost + away + volume) / 2
    probable = log_weight > jnp.max(log_weight) + least_log_weight
    nearest = jnp.arange(away.shape[0]) == jnp.argmin(away)
    return SecondPoses(probable & ~nearest & bank.initialised[index], xi)


def give_slots(second: SecondPoses, empty: Bool[Array, " K"]) -> SecondPoses:
    """Give each second pose an empty slot of its own, as long as there are any."""
    wanted = second.wanted
    in_order = jnp.cumsum(empty)[:, None] == jnp.cumsum(wanted)[None]
    taken = in_order & empty[:, None] & wanted[None]
    xi = jnp.sum(jnp.where(taken[..., None], second.xi[None], 0), axis=1)
    return SecondPoses(jnp.any(taken, axis=1), xi)


CANDIDATES = 3  # largest number of candidates beside the fan
_FAN_RAD = float(np.deg2rad(80.0))  # largest viewing angle, from the marker's normal
_RANGE_SIGMA = 0.1  # sigma of the start, as a share of the range
_BEARING_SIGMA_RAD = 0.1
_CANDIDATE_LOG_WEIGHT = -5.0  # of a candidate, where a member of the fan has 0


def fan(
    prior: PoseBelief, candidates: Candidates, snapshot: Snapshot, hypotheses: int
) -> PoseBelief:
    """Start a bank: the best candidate turned about the marker, then up to three candidates.

    The fan of a car turns about the vertical through the marker's centre, that of a free body in
    two angles. The candidates weigh little; they serve markers that do not hang upright, whose
    corners no member of a car's fan explains.

    Args:
        prior: an empty bank: its `freedom` says whether the vehicle is a car.
        candidates: the first is turned about the largest marker in view.
        snapshot: what is seen.
        hypotheses: K.
    """
    slots = min(candidates.valid.shape[0], CANDIDATES)
    count = hypotheses - slots
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
    kept = product(prior.freedom, prior.freedom.T)
    range_m = safe_norm(towards)

    def covariance(T: jaxlie.SE3, axes: Array) -> Array:
        R = rotation_matrix(T.rotation())
        swing = jnp.cross(axes, (T.translation() - center)[None])
        about = jnp.concatenate([product(swing, R), product(axes, R)], axis=1)  # (axes, 6)
        local = jnp.concatenate(
            [jnp.full(3, _RANGE_SIGMA * range_m), jnp.full(3, _BEARING_SIGMA_RAD)]
        )
        return sandwich(kept, sigma_rad**2 * product(about.T, about) + jnp.diag(local**2))

    light = jnp.concatenate([jnp.zeros(count), jnp.full(slots, _CANDIDATE_LOG_WEIGHT)])
    alive = jnp.concatenate([jnp.ones(count, bool), candidates.valid[:slots]])
    return PoseBelief(
        T_world_vehicle=Ts_world_vehicle,
        covariance=jax.vmap(covariance)(Ts_world_vehicle, axes),
        log_weight=normalise(jnp.where(alive, light.astype(range_m.dtype), -jnp.inf)),
        initialised=alive,
        freedom=prior.freedom,
        nuisance=prior.nuisance,
        gate_nis=prior.gate_nis,
        errors=None if prior.errors is None else prior.errors.fresh(),
    )


def _planar_fan(
    T_world_marker: jaxlie.SE3, towards: Float[Array, " 3"], count: int
) -> tuple[Array, Array, float]:
    """Turns about the vertical: viewing angles from -80 to 80 degrees.

    Args:
        towards: from the marker to the camera, world.

    Returns:
        Quaternions (count, 4), axes of uncertainty (count, 1, 3), its sigma in rad.
    """
    normal = rotation_matrix(T_world_marker.rotation())[:, 2]
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
    Rs = jax.vmap(lambda v: rotation_matrix(R_world_marker @ _shortest_turn(v)))(views)
    axes = jnp.swapaxes(Rs[:, :, :2], 1, 2)
    area = 2 * np.pi * (1 - np.cos(_FAN_RAD)) / count
    return turns, axes, float(np.sqrt(area) / 2)


def _shortest_turn(direction: Float[Array, " 3"]) -> jaxlie.SO3:
    """The rotation that carries (0, 0, 1) into a unit vector not opposite to it."""
    x, y, z = direction
    wxyz = jnp.stack([jnp.maximum(1 + z, 1e-3), -y, x, jnp.zeros_like(x)])
    return jaxlie.SO3(wxyz).normalize()


# Corners off by more than so many of their sigmas, however the vehicle stands, start no branch.
_TELLS_BRANCHES = 2.0


class MultiHypothesis(eqx.Module):
    """A selector that keeps K weighted hypotheses of the vehicle's pose and reports the heaviest.

    Each hypothesis k minimises e(T) = |r(T)|^2 / sigma^2 + |xi|^2_P next to its prediction, and its
    weight is multiplied with Laplace's evidence at the minimum:

        log w_k += -e(T_k) / 2 - log |A + I| / 2,

    where A is J'J of the corners in units of the prediction's sigma.

    `flip_probability` is the mass farther than `far_rad` from the reported pose, or nearer to
    another candidate than to the selected one, with the tails of every hypothesis. The bank is
    `decided` when hypotheses farther off than `far_rad` weigh less than `decided_mass` and all of
    them together know the orientation to `decided_sigma_rad`; until then the car explores (see
    `control.Exploration` and docs/design.md, Ambiguity).

    Where the prediction of a settled bank spans a second candidate as well, an empty slot takes
    that posterior (see `hypotheses.py`).

    The bank can't decide while the vehicle stands and both poses fit the image equally well. It
    takes the corner errors of different frames for independent: the corners' sigma has to include
    what calibration leaves.

    Source: Liu, Schofield, Shan (2023), Eq. 13; MacKay (2003), chapter 27.
    """

    hypotheses: int = eqx.field(static=True, default=24)  # >= 5
    max_steps: int = eqx.field(static=True, default=60)  # few frames need more than 6
    floor_m: float = 0.0001  # sigma of the error that successive frames share
    floor_rad: float = 0.0001
    merge_distance: float = 0.6  # Mahalanobis, between two means that become one
    linear_rad: float = float(np.deg2rad(3.0))  # means this close merge; times the range for shifts
    forget_log_weight: float = -20.0  # lighter hypotheses are dropped
    outlier_log_evidence: float = -7.0  # bounds what one frame subtracts from a log-weight
    max_inflation: float = 10.0  # largest factor on covariances where all hypotheses misfit
    max_misfit: float = np.inf  # largest factor on the corners' sigma where no pose fits them
    gate: float = 30.0  # excess cost over the best candidate; above it a frame fits no hypothesis
    far_rad: float = float(np.deg2rad(20.0))
    decided_mass: float = 3e-5
    decided_sigma_rad: float = float(np.deg2rad(12.0))

    def __check_init__(self) -> None:
        least = CANDIDATES + 2
        if self.hypotheses < least:
            raise ValueError(f"hypotheses must be at least {least}: a fan and the candidates")
        evidence, mass = self.outlier_log_evidence, self.decided_mass
        known = isinstance(evidence, float) and isinstance(mass, float) and mass > 0
        if known and evidence <= np.log(mass):
            raise ValueError(
                f"a single frame would decide: exp(outlier_log_evidence), {np.exp(evidence):.2g}, "
                f"must be above decided_mass, {mass:.2g}"
            )

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        """Correct the pose of each hypothesis by the corners, and weigh it by its evidence.

        Args:
            prior: K predicted hypotheses; a fan replaces them where none is initialised.
            candidates: N poses of this observation.
            snapshot: the observation with its rig and map.

        Returns:
            A `MeasuredPose` for each hypothesis, with weights, merges and `decided`.
        """
        any_seen = jnp.any(snapshot.seen.visible)
        # Corners that no pose explains by their sigma: the marker is blurred, bent or half hidden.
        scale = jnp.minimum(jnp.sqrt(_misfit(candidates, snapshot)), self.max_misfit)
        sigma_px = snapshot.seen.sigma_px * scale
        snapshot = eqx.tree_at(lambda s: s.seen.sigma_px, snapshot, sigma_px)
        starts = any_seen & ~jnp.any(prior.initialised) & jnp.any(candidates.valid)
        count, bank = prior.log_weight.shape[0], prior
        if count == self.hypotheses:  # a bank is cut only where none of its hypotheses starts
            new: PoseBelief = jax.lax.cond(
                starts, lambda: fan(prior, candidates, snapshot, count), lambda: prior
            )
            same = {name: getattr(prior, name) for name in ("freedom", "nuisance", "gate_nis")}
            bank = dataclasses.replace(new, **same)
        floor = jnp.repeat(jnp.asarray([self.floor_m, self.floor_rad]), 3)
        # All slots take as many steps as the slowest, so an empty slot repeats the heaviest one.
        alive_before = jnp.where(bank.initialised, bank.log_weight, -jnp.inf)
        heaviest = first_highest(alive_before, EVEN_LOG_WEIGHT)
        own = jnp.arange(count)
        does_as = jnp.where(bank.initialised, own, heaviest)
        predicted, of_errors = jax.tree.map(
            lambda leaf: leaf[does_as], ((bank.T_world_vehicle, bank.covariance), bank.errors)
        )
        second = self.second_poses(bank, heaviest, candidates, snapshot)
        tried = give_slots(second, ~bank.initialised & ~starts)
        T_prior, P_prior = predicted
        fits = fit_poses(
            T_prior, P_prior, of_errors, prior, snapshot, floor, self.max_steps, elsewhere=tried
        )
        alive = bank.initialised & fits.finite
        free_cost = candidates.least_cost
        posteriors, nis, log_evidence, inflation = self._inflated(fits, free_cost, alive, starts)
        least_cost = jnp.min(jnp.where(alive, fits.cost, jnp.inf))
        fits_one = starts | (least_cost - free_cost < self.gate)
        passes = starts | (nis <= prior.gate_nis * inflation)
        # What one frame subtracts from a log-weight is bounded.
        compared = alive & fits_one
        most = jnp.max(jnp.where(compared, log_evidence, -jnp.inf))
        change = jnp.maximum(log_evidence - most, self.outlier_log_evidence)
        change = jnp.where(compared, change, 0)
        log_weight = jnp.where(alive, bank.log_weight + change, -jnp.inf)

        # A second posterior shares its parent's prediction, and is no surer of it than the parent.
        branches = tried.wanted & fits.finite & passes & fits_one & alive[does_as]
        fitted = fits.posterior.T_world_vehicle
        of_parent = jaxlie.SE3(fitted.wxyz_xyz[does_as])
        branches = branches & (jax.vmap(rotation_error_rad)(fitted, of_parent) > self.linear_rad)
        lighter = jnp.minimum(log_evidence - log_evidence[does_as], -2 * EVEN_LOG_WEIGHT)
        log_weight = jnp.where(branches, log_weight[does_as] + lighter, log_weight)
        log_weight = normalise(log_weight)
        alive = (alive | branches) & (log_weight > self.forget_log_weight)

        # A hypothesis whose pose the gate rejects stays where it was predicted.
        corrected = posteriors.T_world_vehicle, posteriors.covariance
        after = T_after, P_after = where(passes, corrected, (T_prior, P_prior))
        costs, nearest, flip_probability, decided = self._verdict(
            after, log_weight, alive, candidates, fits_one
        )
        located = jnp.any(alive)
        merged_into = own
        if count > 1:
            merged_into = jax.lax.cond(
                jnp.sum(alive) > 1,
                lambda: find_merges(
                    T_after,
                    P_after,
                    jnp.where(alive, log_weight, -jnp.inf),
                    self._linear(T_after, snapshot),
                    prior.freedom,
                    self.merge_distance,
                ),
                lambda: own,
            )
        return Selection(
            measured=eqx.tree_at(lambda m: m.valid, posteriors, alive & any_seen),
            kept=alive & ~starts,
            log_weight=jnp.where(alive, log_weight, self.forget_log_weight),
            merged_into=mark_found(merged_into),
            costs=costs,
            selected=jnp.where(jnp.any(candidates.valid) & located, nearest, -1),
            flip_probability=jnp.where(located, flip_probability, 0),
            decided=located & decided,
            parent=jnp.where(branches & alive, does_as, own),
        )

    def _inflated(
        self,
        fits: PoseFit,
        free_cost: Float[Array, ""],
        alive: Bool[Array, " K"],
        starts: Bool[Array, ""],
    ) -> tuple[MeasuredPose, Float[Array, " K"], Float[Array, " K"], Float[Array, ""]]:
        """The posteriors where all hypotheses misfit, NIS and log-evidence, and the inflation.

        The inflation, at least 1, by which the covariances of prediction and corners are too small
        is the least NIS of the hypotheses over three sigmas of its chi-square. Where even that one
        is contradicted, all hypotheses share one error: wheels slip, a stamp is late, a camera has
        turned.

        The NIS of a posterior is at least its excess cost over the best candidate, at `free_cost`.
        Where residuals are linear it is that, plus what the prediction pays. In the wrong one of
        two minima it is small as long as the prediction is wide, but the image contradicts it.
        """
        posterior, innovation = fits.posterior, fits.posterior.innovation
        assert innovation is not None
        nis = jnp.sum(innovation**2, axis=1)
        least = jnp.min(jnp.where(alive, nis, jnp.inf))
        known = jnp.isfinite(least) & ~starts
        freedom = jnp.asarray(innovation.shape[1], least.dtype)
        inflation = excess_of(jnp.where(known, least, 0), freedom)
        inflation = jnp.minimum(inflation, self.max_inflation).astype(least.dtype)
        excess = fits.cost - free_cost
        more = (excess > nis) & (nis > 0)
        growth = jnp.sqrt(jnp.where(more, excess / jnp.where(more, nis, 1), 1))
        forgiven = jnp.where(fits.finite, nis, 0) * (1 - 1 / inflation) / 2
        innovation = innovation * growth[:, None]
        inflated = dataclasses.replace(
            posterior,
            covariance=posterior.covariance * inflation,
            innovation=innovation,
            inflation=jnp.broadcast_to(inflation, nis.shape),
        )
        nis = jnp.sum(innovation**2, axis=1)
        return inflated, nis, fits.log_evidence + forgiven, inflation

    def _verdict(
        self,
        after: tuple[jaxlie.SE3, Float[Array, "K 6 6"]],
        log_weight: Float[Array, " K"],
        alive: Bool[Array, " K"],
        candidates: Candidates,
        fits_one: Bool[Array, ""],
    ) -> tuple[Float[Array, " N"], Int[Array, ""], Float[Array, ""], Bool[Array, ""]]:
        """What is reported of the poses after the update, and their covariances.

        Returns:
            The candidates' angles from the reported pose, rad, the index of the nearest, the
            probability that the reported pose is the wrong one, and whether the bank has decided.
        """
        T_world_vehicle, covariance = after
        best = first_highest(log_weight, EVEN_LOG_WEIGHT)
        T_best = jaxlie.SE3(T_world_vehicle.wxyz_xyz[best])
        apart_rad = jax.vmap(lambda T: rotation_error_rad(T, T_best))(T_world_vehicle)
        sigmas_rad = safe_sqrt(jnp.trace(covariance[:, 3:, 3:], axis1=1, axis2=2))
        mass = jnp.where(alive, jnp.exp(log_weight), 0)
        far = jnp.sum(jnp.where(apart_rad > self.far_rad, mass, 0))
        known_rad = safe_sqrt(jnp.sum(mass * (sigmas_rad**2 + apart_rad**2)))
        to_best_rad = jax.vmap(lambda T: rotation_error_rad(T.inverse(), T_best))(
            candidates.T_vehicle_world
        )
        costs = jnp.where(candidates.valid, to_best_rad, jnp.inf)
        nearest = first_highest(-costs, EVEN_RAD)
        of_another = nearer_to_another(T_world_vehicle, covariance, candidates, nearest)
        # Candidates of a spoilt frame are of no branch.
        of_another = jnp.where(fits_one, of_another, 0)
        wrong = jnp.maximum(beyond(self.far_rad, apart_rad, sigmas_rad), of_another)
        decided = (far < self.decided_mass) & (known_rad < self.decided_sigma_rad)
        return costs, nearest, jnp.sum(mass * wrong), decided

    def second_poses(
        self,
        bank: PoseBelief,
        heaviest: Int[Array, ""] | int,
        candidates: Candidates,
        snapshot: Snapshot,
    ) -> SecondPoses:
        """Split a hypothesis whose prior covers both poses of a marker.

        None while the bank is open, when others stand for them, and none where all misfit.
        """
        second = second_poses(bank, heaviest, candidates, self.forget_log_weight)
        settled = bank.log_weight[heaviest] > np.log(0.5) + EVEN_LOG_WEIGHT
        fits = _misfit(candidates, snapshot) < _TELLS_BRANCHES**2
        return second._replace(wanted=second.wanted & settled & fits)

    def _linear(self, T: jaxlie.SE3, snapshot: Snapshot) -> Float[Array, "K 6"]:
        """Shifts and turns so small that the corners are linear in them, of poses (K,), m and rad.

        A shift looks the larger the nearer the marker is.
        """
        to_markers = snapshot.markers.Ts_world_marker.translation()[None]
        nearest_m = jnp.min(safe_norm(T.translation()[:, None] - to_markers), axis=1)
        turns = jnp.full((nearest_m.shape[0], 3), self.linear_rad)
        return jnp.concatenate([self.linear_rad * jnp.tile(nearest_m[:, None], 3), turns], 1)


def _misfit(candidates: Candidates, snapshot: Snapshot) -> Float[Array, ""]:
    """By how much the best candidate misfits, at least 1; 1 without a candidate."""
    excess = excess_of_best(candidates, snapshot.seen)
    return jnp.maximum(jnp.where(jnp.isfinite(excess), excess, 0), 1)
