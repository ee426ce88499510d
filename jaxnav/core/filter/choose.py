"""Selectors: rules that choose the true pose among the candidates of one frame.

A selector is called as

    selection = selector(prior, candidates, snapshot)

and returns the pose that each of the filter's K hypotheses takes as measured. It is given the
prediction as poses with covariances, whatever motion model made it, so car and hand-held rig share
every selector. The selectors here keep K = 1 and take one candidate or none; `MultiHypothesis`, in
`hypotheses.py`, carries K > 1 and postpones the choice.

`judge_branch` compares what was chosen with the truth, where that is known.
"""

from typing import ClassVar, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.bank import PoseBelief
from jaxnav.core.filter.errors import ErrorsPosterior
from jaxnav.core.linalg.small_matrices import cholesky, first_highest, log_det, solve_lower
from jaxnav.core.models.geometry import (
    EVEN_RAD,
    planar_from_T_world_vehicle,
    rotation_error_rad,
    rotation_matrix,
    safe_atan2,
    safe_norm,
    wrap_angle,
)
from jaxnav.core.pose.observation import Snapshot, log_sigmas
from jaxnav.core.pose.refine import Candidates
from jaxnav.core.pose.residuals import e2


class MeasuredPose(eqx.Module):
    """The pose that each hypothesis takes: a candidate as measured, or one corrected already.

    A candidate is fused with the prediction by the filter (Eqs. 10, 11). A pose with an
    `innovation` is prediction and corners fused by the selector: the filter adopts it and corrects
    the rest of its state by regression. Lanes where `valid` is False hold finite numbers.
    """

    T_world_vehicle: jaxlie.SE3  # batch axis (K,)
    covariance: Float[Array, "*K 6 6"]  # of xi in T_world_vehicle * exp(xi)
    # Up to a constant: of the residuals at a candidate, or of the corners given the prediction.
    log_likelihood: Float[Array, "*K"]
    valid: Bool[Array, "*K"]
    innovation: Float[Array, "*K d"] | None = None  # of the corners, whitened: squared, the NIS
    # Factor on the covariance. The gate admits a NIS up to inflation * gate_nis; above gate_nis it
    # is counted as a rejection all the same.
    inflation: Float[Array, "*K"] | None = None
    errors: ErrorsPosterior | None = None  # of the cameras, where the filter keeps any


class Selection(eqx.Module):
    """The decision of a selector about K hypotheses and N candidates."""

    measured: MeasuredPose
    kept: Bool[Array, " K"]  # False: this hypothesis is given up, or starts anew from `measured`
    log_weight: Float[Array, " K"]  # after this observation
    merged_into: Int[Array, " K"]  # the hypothesis into which this one merges; its own index: none
    costs: Float[Array, " N"]  # of the candidates, in the selector's unit; inf where invalid
    selected: Int[Array, ""]  # candidate of the reported hypothesis, -1: none
    flip_probability: Float[Array, ""]  # probability that the reported pose is the wrong one
    decided: Bool[Array, ""]  # whether the reported pose may be acted upon
    # The predicted hypothesis that each one continues; None: every one itself.
    parent: Int[Array, " K"] | None = None


@runtime_checkable
class Selector(Protocol):
    """The signature that all selectors share."""

    @property
    def hypotheses(self) -> int:
        """K, the number of hypotheses that the selector keeps."""
        ...

    def __call__(
        self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot
    ) -> Selection: ...


class LowestReprojection(eqx.Module):
    """Selects the candidate with the lowest e1 (px^2): the paper's Method A, and AprilTag's rule.

    It needs no prediction and can't be misled by one. It can't distinguish poses whose e1 differ by
    less than the noise does, as under weak perspective or motion blur.

    Source: Liu, Schofield, Shan (2023), section III; Olson (2011).
    """

    hypotheses: ClassVar[int] = 1

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        return _cheapest(prior, candidates, snapshot, candidates.e1_px2)


class RatioTest(eqx.Module):
    """Selects the candidate with the lowest e1 where sqrt(e1 / e1 of the second) <= max_ratio.

    It trades coverage for correctness: from far away, or face to face with the marker, it selects
    none, and a wrong pose with a clearly lower error still passes.

    Source: Munoz-Salinas et al. (2018), "Mapping and localization from planar markers", section
    4.2; PhotonVision's "pose ambiguity" is the same ratio.
    """

    hypotheses: ClassVar[int] = 1
    max_ratio: float = 1 / 3  # of the reprojection errors (RMS), best to second

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        costs = jnp.where(candidates.valid, candidates.e1_px2, jnp.inf)
        best, second = jnp.sort(costs)[:2] if costs.shape[0] > 1 else (costs[0], jnp.inf)
        clear = best <= self.max_ratio**2 * second
        return _cheapest(prior, candidates, snapshot, candidates.e1_px2, accepted=clear)


class ObjectSpace(eqx.Module):
    """Selects the candidate with the lowest e2 (m^2): the nearest to the filter's prediction.

    Before the first pose it selects the lowest e1. It keeps to whatever the filter believes, also
    where the image contradicts it, so it does not repair a wrong start.

    Source: Wu et al., as cited by Liu, Schofield, Shan (2023), Eq. 14.
    """

    hypotheses: ClassVar[int] = 1

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        started = prior.initialised[0]
        costs = jnp.where(started, _object_space_m2(prior, candidates, snapshot), candidates.e1_px2)
        return _cheapest(prior, candidates, snapshot, costs)


class PaperCost(eqx.Module):
    """Selects the candidate with the lowest e = e1 + e2 / length_unit_m^2: the paper's rule.

    e1 is in px^2 and e2, against the filter's prediction, in squared lengths. They are added
    unscaled, so the unit of length is a weight; the paper worked in centimetres (see
    docs/design.md, Units of the cost). Before the first pose e is e1 alone: a wrong start is
    followed by a prediction near the wrong pose, and the rule keeps to it.

    Source: Liu, Schofield, Shan (2023), Eqs. 13-15.
    """

    hypotheses: ClassVar[int] = 1
    length_unit_m: float = 0.01

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        object_space = _object_space_m2(prior, candidates, snapshot) / self.length_unit_m**2
        e2_units = jnp.where(prior.initialised[0], object_space, 0)
        return _cheapest(prior, candidates, snapshot, candidates.e1_px2 + e2_units)


class Mahalanobis(eqx.Module):
    """Selects the candidate that image and prediction together make the most probable.

        cost = |r|^2 / sigma^2 - log |C| + |xi|^2_S + log |S|,    S = P + C,

    with the residuals r, the candidate's covariance C (6, 6), the predicted one P (6, 6), and the
    displacement xi (6,) between candidate and prediction. No unit has to be chosen. It decides in
    every frame, for good: like the paper's rule it keeps to a wrong start.

    Source: Bar-Shalom, Li (1995), "Multitarget-multisensor tracking", nearest neighbour
    with normalised distance; MacKay (2003), chapter 27, for the volume of a minimum.
    """

    hypotheses: ClassVar[int] = 1

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        T_world_vehicle_prior = jax.tree.map(lambda leaf: leaf[0], prior.T_world_vehicle)
        volume = _log_determinants(candidates.covariance)
        # Where there is no prior the distance is that of a pose with itself: log stays smooth.
        asked = candidates.valid & prior.initialised[0]

        def distance(T_vehicle_world: jaxlie.SE3, covariance: Array, asked: Array) -> Array:
            itself = T_world_vehicle_prior.inverse().wxyz_xyz
            T = jaxlie.SE3(jnp.where(asked, T_vehicle_world.wxyz_xyz, itself))
            S = prior.covariance[0] + covariance
            factor = cholesky(S)
            away = (T @ T_world_vehicle_prior).inverse().log()
            whitened = solve_lower(factor, away)
            return jnp.sum(whitened**2) + log_det(factor)

        far = jax.vmap(distance)(candidates.T_vehicle_world, candidates.covariance, asked)
        costs = candidates.cost - volume + jnp.where(prior.initialised[0], far, 0)
        return _cheapest(prior, candidates, snapshot, costs, _doubt(candidates.valid, costs))


class OrientationGiven(eqx.Module):
    """Selects the candidate that agrees with another sensor: a heading, or the markers' normals.

    The observation brings them, each with its sigma: `heading_rad` from a compass or a gyro that
    was aligned before (MegaTag2), `normals_camera` from an RGB-D camera (Jin et al.) or from
    lenticular markers (Tanaka et al.). Their whitened squared error is added to the cost of the
    corners, |r|^2 / sigma^2 - log |C| with the candidate's covariance C (6, 6); without a reading
    that alone is the cost. The sensor is believed without a check of its plausibility.

    Source: Jin, Matikainen, Srinivasa (2017), "Sensor fusion for fiducial tags"; Tanaka et
    al. (2014), "Solution to pose ambiguity of visual markers using moire patterns"; Limelight's
    MegaTag2.
    """

    hypotheses: ClassVar[int] = 1

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        # Less the width of the minimum: how much of what is possible each candidate stands for.
        costs = candidates.cost - _log_determinants(candidates.covariance)
        Ts_world_vehicle = jax.vmap(lambda T: T.inverse())(candidates.T_vehicle_world)
        if snapshot.obs.heading_rad is not None:
            psi_rad = planar_from_T_world_vehicle(Ts_world_vehicle)[:, 2]
            gap = wrap_angle(psi_rad - snapshot.obs.heading_rad) / snapshot.obs.heading_sigma_rad
            costs = costs + jnp.where(jnp.isfinite(gap), gap, 0) ** 2
        if snapshot.obs.normals_camera is not None:
            costs = costs + jax.vmap(lambda T: _normals_error(T, snapshot))(
                candidates.T_vehicle_world
            )
        return _cheapest(prior, candidates, snapshot, costs, _doubt(candidates.valid, costs))


class Oracle(eqx.Module):
    """Selects the candidate nearest to the truth in angle, which bounds all other selectors."""

    hypotheses: ClassVar[int] = 1

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        T_true = snapshot.obs.T_world_vehicle_true
        if T_true is None:
            raise ValueError("Oracle needs observations that carry T_world_vehicle_true")
        turns = jax.vmap(lambda T: rotation_error_rad(T.inverse(), T_true))(
            candidates.T_vehicle_world
        )
        return _cheapest(prior, candidates, snapshot, turns, doubts=jnp.zeros_like(turns))


class Ungated(eqx.Module):
    """A rule on a filter without gate and restart, as its authors write it.

    It selects what its rule selects. `Navigator` takes the rule out of it and sets the motion
    model's `gate_nis` to inf: every selected pose is fused, however far from the prediction, and no
    contradiction starts the filter anew (see docs/design.md, Gate).
    """

    rule: Selector

    @property
    def hypotheses(self) -> int:
        """Those of the rule."""
        return self.rule.hypotheses

    def __call__(self, prior: PoseBelief, candidates: Candidates, snapshot: Snapshot) -> Selection:
        return self.rule(prior, candidates, snapshot)


def _cheapest(
    prior: PoseBelief,
    candidates: Candidates,
    snapshot: Snapshot,
    costs: Float[Array, " N"],
    doubts: Float[Array, " N"] | None = None,
    accepted: Bool[Array, ""] | bool = True,
) -> Selection:
    """The selection of the cheapest valid candidate for a single hypothesis, if `accepted`.

    Args:
        doubts: probability of each candidate to be the wrong one; by default what this image
            alone says, its whitened e1 and the width of its minimum.
    """
    if doubts is None:
        volume = _log_determinants(candidates.covariance)
        doubts = _doubt(candidates.valid, candidates.cost - volume)
    costs = jnp.where(candidates.valid, costs, jnp.inf)
    # Candidates count from the lowest e1: it is what decides between costs that are equal.
    cheapest = first_highest(-costs, within=1e-6 * jnp.abs(jnp.min(costs)))
    misfit = jnp.where(jnp.isfinite(candidates.cost[cheapest]), candidates.cost[cheapest], 0)
    any_valid = jnp.any(candidates.valid) & accepted
    T_vehicle_world = jax.tree.map(lambda leaf: leaf[cheapest], candidates.T_vehicle_world)
    return Selection(
        measured=MeasuredPose(
            jaxlie.SE3(T_vehicle_world.inverse().wxyz_xyz[None]),
            candidates.covariance[cheapest][None],
            (-misfit / 2 - log_sigmas(snapshot.seen))[None],
            any_valid[None],
        ),
        kept=prior.initialised,
        log_weight=prior.log_weight,
        merged_into=jnp.zeros(1, int),
        costs=costs,
        selected=jnp.where(any_valid, cheapest, -1),
        flip_probability=jnp.where(any_valid, doubts[cheapest], 0),
        decided=prior.initialised[0] | any_valid,
    )


def _doubt(valid: Bool[Array, " N"], costs: Float[Array, " N"]) -> Float[Array, " N"]:
    """Probability of each candidate to be wrong, where exp(-cost / 2) is its likelihood."""
    best = jnp.min(jnp.where(valid, costs, jnp.inf))
    excess = jnp.where(valid, costs - best, 0)
    likelihood = jnp.where(valid, jnp.exp(-excess / 2), 0)
    total = jnp.sum(likelihood)
    return jnp.where(total > 0, 1 - likelihood / jnp.where(total > 0, total, 1), 0)


def _log_determinants(covariances: Float[Array, "N 6 6"]) -> Float[Array, " N"]:
    """log |C| of covariances whose entries may differ by many orders of magnitude."""

    def one(covariance: Array) -> Array:
        sigma = jnp.sqrt(jnp.diagonal(covariance))
        correlation = covariance / (sigma[:, None] * sigma[None])
        return log_det(cholesky(correlation)) + 2 * jnp.sum(jnp.log(sigma))

    return jax.vmap(one)(covariances)


def _object_space_m2(
    prior: PoseBelief, candidates: Candidates, snapshot: Snapshot
) -> Float[Array, " N"]:
    T_vehicle_world_prior = jax.tree.map(lambda leaf: leaf[0], prior.T_world_vehicle).inverse()
    return jax.vmap(
        lambda T_vehicle_world: e2(
            snapshot.markers, snapshot.obs.visible, T_vehicle_world, T_vehicle_world_prior
        )
    )(candidates.T_vehicle_world)


def _normals_error(T_vehicle_world: jaxlie.SE3, snapshot: Snapshot) -> Float[Array, ""]:
    """Sum of squared angles between the markers' normals and the measured ones, in sigmas^2."""
    obs, rig = snapshot.obs, snapshot.rig
    assert obs.normals_camera is not None
    matrices = jax.vmap(rotation_matrix)
    normals_world = matrices(snapshot.markers.Ts_world_marker.rotation())[:, :, 2]
    R_vehicle_world = rotation_matrix(T_vehicle_world.rotation())
    Rs_camera_vehicle = matrices(rig.Ts_camera_vehicle.rotation())
    normals_camera = jnp.einsum("cij,jk,mk->cmi", Rs_camera_vehicle, R_vehicle_world, normals_world)
    known = obs.visible & jnp.all(jnp.isfinite(obs.normals_camera), axis=2)
    measured = jnp.where(known[..., None], obs.normals_camera, normals_camera)
    sine = safe_norm(jnp.cross(normals_camera, measured))
    cosine = jnp.sum(normals_camera * measured, axis=2)
    turn_rad = jnp.where(known, safe_atan2(sine, cosine), 0)
    return jnp.sum((turn_rad / obs.normal_sigma_rad) ** 2)


OUTLIER_DEG = 10.0
SAME_BRANCH_DEG = 3.0  # candidates that are nearer to each other count as one


class Branch(eqx.Module):
    """Verdict on one choice of a candidate. At most one of `wrong` and `outlier` is True."""

    judged: Bool[Array, ""]  # a candidate was taken
    # Another candidate, more than `SAME_BRANCH_DEG` away, is closer to the truth in angle.
    wrong: Bool[Array, ""]
    outlier: Bool[Array, ""]  # no candidate lies within 10 degrees of the truth
    ambiguous: Bool[Array, ""]  # there was more than one candidate


def judge_branch(
    candidates: Candidates, selected: Int[Array, ""], T_world_vehicle_true: jaxlie.SE3
) -> Branch:
    """Whether the selected candidate is the one nearest to the truth in angle, or next to it.

    Args:
        candidates: N poses of one observation.
        selected: index of the candidate that was taken, -1: none.
        T_world_vehicle_true: the true pose.
    """
    angles_rad = jax.vmap(
        lambda T_vehicle_world: rotation_error_rad(T_vehicle_world.inverse(), T_world_vehicle_true)
    )(candidates.T_vehicle_world)
    angles_rad = jnp.where(candidates.valid, angles_rad, jnp.inf)
    nearest_rad, chosen = jnp.min(angles_rad), jnp.maximum(selected, 0)
    Ts = candidates.T_vehicle_world.wxyz_xyz
    T_chosen, T_nearest = jaxlie.SE3(Ts[chosen]), jaxlie.SE3(Ts[jnp.argmin(angles_rad)])
    is_other = rotation_error_rad(T_chosen, T_nearest) > jnp.deg2rad(SAME_BRANCH_DEG)
    judged = selected >= 0
    outlier = judged & (nearest_rad > jnp.deg2rad(OUTLIER_DEG))
    wrong = judged & ~outlier & is_other & (angles_rad[chosen] > nearest_rad + EVEN_RAD)
    return Branch(judged, wrong, outlier, judged & (jnp.sum(candidates.valid) > 1))


def position_error_m(T_a_b: jaxlie.SE3, T_a_c: jaxlie.SE3) -> Float[Array, ""]:
    """Distance between two positions, m."""
    return safe_norm(T_a_b.translation() - T_a_c.translation())
