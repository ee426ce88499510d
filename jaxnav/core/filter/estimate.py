"""`Belief`, the filter's state between observations, and `Estimate`, what is reported of it."""

from dataclasses import fields

import equinox as eqx
import jax.numpy as jnp
import jaxlie
from jax.typing import DTypeLike
from jaxtyping import Array, Bool, Float, Int

from jaxnav.core.filter.bank import Bank, heaviest, mixture_log_mean
from jaxnav.core.filter.choose import Selection
from jaxnav.core.filter.errors import Repeats
from jaxnav.core.filter.motion import BankUpdate, Motion
from jaxnav.core.pose.candidates import ConsistentSnapshot
from jaxnav.core.pose.refine import Candidates


class Belief(eqx.Module):
    """The filter's state after an observation: all that the next one starts from."""

    bank: Bank
    decided: Bool[Array, ""]  # False: several poses are still possible, and none is acted upon
    flip_probability: Float[Array, ""]  # probability that the reported pose is the wrong one
    restarts: Int[Array, ""]  # how often all hypotheses were forgotten so far
    repeats: Repeats | None  # None: no error is taken to repeat

    @staticmethod
    def begin(bank: Bank, repeats: Repeats | None = None) -> "Belief":
        """The belief before the first observation, with an empty bank."""
        nothing = jnp.zeros((), bank.mean.dtype)
        return Belief(bank, jnp.asarray(False), nothing, jnp.zeros((), jnp.int32), repeats)


class Evidence(eqx.Module):
    """Candidates, costs and gate of one observation's corners."""

    candidates: Candidates
    costs: Float[Array, " N"]  # of the candidates, in the selector's unit
    selected: Int[Array, ""]  # index of the candidate taken, -1: none
    accepted: Bool[Array, ""]  # the filter has taken the pose
    nis: Float[Array, ""]  # of the pose taken, 0 where there was none
    gate_nis: Float[Array, ""]  # a larger one contradicts the prediction, accepted or not
    outvoted: Bool[Array, " M"]  # markers that the others in view contradict
    # log p(corners | prediction of the whole bank), up to a constant; 0 at a start.
    log_likelihood: Float[Array, ""]

    @property
    def agrees(self) -> Bool[Array, ""]:
        """Whether the pose taken was expected, without any covariance being inflated for it."""
        return self.accepted & (self.nis <= self.gate_nis)

    @staticmethod
    def from_update(
        seen: ConsistentSnapshot,
        prior: Bank,
        selection: Selection,
        updated: BankUpdate,
        gate_nis: Float[Array, ""] | float,
    ) -> "Evidence":
        """The evidence of what was seen, by the selection and the update that it led to."""
        bank = updated.bank
        best = heaviest(bank)
        return Evidence(
            candidates=seen.candidates,
            costs=selection.costs,
            selected=selection.selected,
            accepted=updated.accepted[best] & (selection.selected >= 0),
            nis=jnp.where(bank.initialised[best], updated.nis[best], 0),
            gate_nis=jnp.asarray(gate_nis, bank.mean.dtype),
            outvoted=seen.outvoted,
            log_likelihood=mixture_log_mean(prior, updated.log_likelihood),
        )

    @staticmethod
    def none(candidates: Candidates, markers: int, dtype: DTypeLike) -> "Evidence":
        """The evidence of an observation without a marker in view.

        Args:
            candidates: none of them valid.
            markers: how many the map has.
            dtype: of the belief.
        """
        zero = jnp.zeros((), dtype)
        return Evidence(
            candidates=candidates,
            costs=jnp.full_like(candidates.cost, jnp.inf),
            selected=jnp.asarray(-1),
            accepted=jnp.asarray(False),
            nis=zero,
            gate_nis=zero + jnp.inf,
            outvoted=jnp.zeros(markers, bool),
            log_likelihood=zero,
        )


class Estimate(Evidence):
    """All that is known after one observation: the belief's report and the corners' evidence.

    The report is of the heaviest hypothesis; its covariance is the bank's second moment about it.
    """

    pose: Float[Array, " 3"]  # x_m, y_m, psi_rad in the world
    pose_covariance: Float[Array, "3 3"]
    velocity: Float[Array, " 3"]  # v_x_mps, v_y_mps, psi_dot_radps in the world
    velocity_covariance: Float[Array, "3 3"]
    covariance: Float[Array, "d d"]  # of the state's error: (6, 6) for a car, see the motion model
    T_world_vehicle: jaxlie.SE3
    located: Bool[Array, ""]  # False until the first pose was taken
    hypothesis: Int[Array, ""]  # number of the reported one, kept while it survives
    flip_probability: Float[Array, ""]  # probability that the reported pose is the wrong one
    decided: Bool[Array, ""]  # False: several poses are still possible, and none is acted upon

    @staticmethod
    def from_belief(motion: Motion, belief: Belief, evidence: Evidence) -> "Estimate":
        """The estimate of a belief and of the evidence that led to it."""
        bank, best = belief.bank, heaviest(belief.bank)
        covariance = motion.error_covariance(bank, best)
        return Estimate(
            **vars(evidence),
            **motion.planar(bank.mean[best], covariance)._asdict(),
            covariance=covariance[: motion.states, : motion.states],
            T_world_vehicle=motion.T_world_vehicle(bank.mean[best]),
            located=bank.initialised[best],
            hypothesis=bank.number[best],
            flip_probability=belief.flip_probability,
            decided=belief.decided & bank.initialised[best],
        )

    @property
    def evidence(self) -> Evidence:
        """The fields of `Evidence` alone."""
        return Evidence(**{field.name: getattr(self, field.name) for field in fields(Evidence)})
