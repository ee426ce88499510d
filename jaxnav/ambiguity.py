"""Which candidate is the true pose: the selectors.

A selector is called as

    selection = selector(prior, candidates, obs, markers)

and says how much of each candidate (N) each hypothesis of the filter (K) takes: `weights` (K, N),
rows of zeros where nothing is taken. It sees the prediction as poses with covariances, whatever
motion model made it, so car and hand-held rig share every selector.
"""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
from jaxtyping import Array, Bool, Float, Int

from jaxnav.candidates import Candidates
from jaxnav.markers import MarkerMap
from jaxnav.observation import Observation
from jaxnav.residuals import e2


class PoseBelief(eqx.Module):
    """The filter's prediction: K weighted hypotheses about the pose of the vehicle."""

    T_world_vehicle: jaxlie.SE3  # batch axis (K,)
    covariance: Float[Array, "K 6 6"]  # of xi in T_world_vehicle * exp(xi)
    log_weight: Float[Array, " K"]
    initialised: Bool[Array, " K"]  # False before the first pose


class Selection(eqx.Module):
    """What a selector decided."""

    weights: Float[Array, "K N"]  # share of each candidate in the update of each hypothesis
    costs: Float[Array, " N"]  # what was compared, in the selector's unit; inf where invalid
    selected: Int[Array, ""]  # candidate of the reported hypothesis, -1: none
    flip_probability: Float[Array, ""]  # probability that the selected candidate is the wrong one


@runtime_checkable
class Selector(Protocol):
    """The signature all selectors share."""

    def __call__(
        self, prior: PoseBelief, candidates: Candidates, obs: Observation, markers: MarkerMap
    ) -> Selection: ...


class LowestReprojection(eqx.Module):
    """The candidate with the lower e1: the paper's Method A, what AprilTag does.

    Needs no prediction, and so can't be misled by one. It can't tell poses apart whose e1 differ
    by less than the noise: weak perspective, motion blur.

    Source: Liu, Schofield, Shan (2023), section III; Olson (2011).
    """

    def __call__(
        self, prior: PoseBelief, candidates: Candidates, obs: Observation, markers: MarkerMap
    ) -> Selection:
        return _cheapest(candidates, candidates.e1_px2)


class PaperCost(eqx.Module):
    """The candidate with the lower e = e1 + e2 against the filter's prediction.

    e1 in pixel^2 and e2 in squared lengths are added as they are, so the unit of length weighs
    one against the other; the paper worked in centimetres. Before the first pose e is e1 alone: a
    wrong start is followed by a prediction near the wrong pose, and the rule defends it.

    Source: Liu, Schofield, Shan (2023), Eqs. 13-15.
    """

    length_unit_m: float = 0.01

    def __call__(
        self, prior: PoseBelief, candidates: Candidates, obs: Observation, markers: MarkerMap
    ) -> Selection:
        T_vehicle_world_prior = jax.tree.map(lambda leaf: leaf[0], prior.T_world_vehicle).inverse()
        object_space_m2 = jax.vmap(
            lambda T_vehicle_world: e2(markers, obs.visible, T_vehicle_world, T_vehicle_world_prior)
        )(candidates.T_vehicle_world)
        e2_units = jnp.where(prior.initialised[0], object_space_m2 / self.length_unit_m**2, 0)
        return _cheapest(candidates, candidates.e1_px2 + e2_units)


def _cheapest(candidates: Candidates, costs: Float[Array, " N"]) -> Selection:
    """All of the cheapest valid candidate for a single hypothesis."""
    costs = jnp.where(candidates.valid, costs, jnp.inf)
    selected = jnp.argmin(costs)
    any_valid = jnp.any(candidates.valid)
    weights = (jnp.arange(costs.shape[0]) == selected) & any_valid
    return Selection(
        weights=weights.astype(costs.dtype)[None],
        costs=costs,
        selected=jnp.where(any_valid, selected, -1),
        flip_probability=_image_doubt(candidates, selected),
    )


def _image_doubt(candidates: Candidates, selected: Int[Array, ""]) -> Float[Array, ""]:
    """Probability, judged by this image alone, that another candidate is the true one.

    Candidates are equally likely beforehand and corner noise is Gaussian, so each weighs
    exp(-cost / 2).
    """
    cost = jnp.where(candidates.valid, candidates.cost, 0)
    best = jnp.min(jnp.where(candidates.valid, cost, jnp.inf))
    excess = jnp.where(candidates.valid, cost - best, 0)
    likelihood = jnp.where(candidates.valid, jnp.exp(-excess / 2), 0)
    total = jnp.sum(likelihood)
    return jnp.where(total > 0, 1 - likelihood[selected] / jnp.where(total > 0, total, 1), 0)
