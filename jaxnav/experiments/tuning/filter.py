"""The cost by which the filter's noise is tuned: corner likelihood, or true poses.

The filter runs along a sequence from a chosen start: there it is smooth in its noise parameters.
The estimator is the car's, `Navigator.sense`, frame by frame, with one hypothesis: the other poses
that a marker admits are left out for good (`branches.py` chooses). Selectors that choose anew in
every frame still do so, and no gradient flows through that choice.
"""

import functools
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.filter.bank import Bank
from jaxnav.core.filter.estimate import Belief
from jaxnav.core.filter.free import FreeBody
from jaxnav.core.filter.hypotheses import MultiHypothesis
from jaxnav.core.filter.kalman import log_likelihood
from jaxnav.core.filter.motion import Motion
from jaxnav.core.linalg.levenberg_marquardt import KEEP_FOUND
from jaxnav.core.linalg.small_matrices import as_class
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import with_parameters
from jaxnav.core.pose.candidates import ConsistentSnapshot
from jaxnav.core.pose.observation import Observation, Snapshot
from jaxnav.core.pose.refine import Candidates
from jaxnav.experiments.tuning.branches import error_of, find_starts, nees, position_states
from jaxnav.experiments.tuning.objective import Batch
from jaxnav.experiments.tuning.recorded import FrameSequences
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.files.executables import kept

_CM2_PER_M2 = 1e4


class Item(NamedTuple):
    """One sequence, or many with leading axis (B,)."""

    start: Bank
    recorded: FrameSequences


class FilterCost(eqx.Module):
    """The cost of each frame of a sequence as a function of the noise parameters.

    The likelihood is that of the corners alone, each frame's given all earlier frames and its own
    odometry. The likelihood of the odometry is left out: a car's acceleration and turning is not
    white noise, and a filter that explains it best is too sure of everything else (see
    benchmarks/README-tuning.md).
    """

    navigator: Navigator
    space: Space
    loss: str = eqx.field(static=True)  # likelihood, score or error, see `TuneFilter`

    def __call__(
        self, x: Float[Array, " n"], item: Item, softness: Float[Array, ""]
    ) -> Float[Array, " T"]:
        del softness  # the choice of the branch is fixed
        navigator = trust_corners(with_parameters(self.navigator, self.space.values(x)))
        followed = follow(navigator, item.start, item.recorded)
        if self.loss == "likelihood":
            return -followed.log_likelihood
        if self.loss == "score":
            return -followed.log_score
        return _CM2_PER_M2 * followed.square_m2

    def batches(self, x: Float[Array, " n"], *parts: FrameSequences) -> list[Batch]:
        """A batch of each part, the branches chosen at these parameters and then fixed.

        The parts are estimated in one run, whose program is compiled once for all of them.
        """
        navigator = with_parameters(self.navigator, self.space.values(x))
        recorded = FrameSequences.concatenate(list(parts))
        start = find_starts(navigator, recorded)
        usable = eqx.tree_at(
            lambda r: (r.used, r.judged),
            recorded,
            (recorded.used & start.chosen[:, None], recorded.judged & start.chosen[:, None]),
        )
        counted = usable.used if self.loss == "likelihood" else usable.judged
        ends = np.cumsum([len(part) for part in parts])
        batches = []
        for begin, end in zip([0, *ends[:-1]], ends, strict=True):
            items = jax.tree.map(lambda leaf: leaf[begin:end], Item(start.bank, usable))  # noqa: B023
            frames = jnp.maximum(jnp.sum(counted[begin:end]), 1).astype(x.dtype)
            batches.append(Batch(items, frames))
        return batches

    def mean(self, x: Float[Array, " n"], batch: Batch) -> Float[Array, ""]:
        """The mean cost of a frame in a batch."""
        return _mean(self, x, batch)


@kept
def _mean(cost: FilterCost, x: Array, batch: Batch) -> Array:
    zero = jnp.zeros((), x.dtype)
    costs = jax.vmap(lambda item: cost(x, item, zero))(batch.items)
    return jnp.sum(costs) / batch.frames


class FilterScores(eqx.Module):
    """The filter's scores in every frame; 0 if the frame was not used, or not judged.

    After an overflow has lost the hypothesis the scores are infinitely bad, so that no step goes to
    parameters that break the filter.
    """

    log_likelihood: Float[Array, "*B T"]  # of the corners given the prediction
    log_score: Float[Array, "*B T"]  # log density of the true pose under the belief
    square_m2: Float[Array, "*B T"]  # squared position error
    nees: Float[Array, "*B T"]


def trust_corners(navigator: Navigator) -> Navigator:
    """The navigator without its guards against outliers, which would hide a wrong Q or R."""
    motion, selector = navigator.motion, navigator.selector
    navigator = eqx.tree_at(lambda n: n.motion.gate_nis, navigator, float("inf"))
    if isinstance(motion, FreeBody):
        navigator = eqx.tree_at(lambda n: n.motion.lost_sigma_m, navigator, float("inf"))
    if isinstance(selector, MultiHypothesis):
        navigator = eqx.tree_at(
            lambda n: (n.selector.max_inflation, n.selector.max_misfit), navigator, (1.0, 1.0)
        )
        return as_class(_GoesOn, navigator)
    return as_class(_Trusts, navigator)


def follow(navigator: Navigator, start: Bank, recorded: FrameSequences) -> FilterScores:
    """Run the filter frame by frame along one sequence (no batch axis)."""
    local = eqx.tree_at(lambda n: n.markers, navigator, recorded.markers)
    start = _with_priors(local.motion, start)

    @functools.partial(jax.checkpoint, policy=KEEP_FOUND)
    def frame(
        belief: Belief, now: tuple[Observation, Array, Array, Array]
    ) -> tuple[Belief, FilterScores]:
        obs, used, truth, judged = now
        after, estimate = local.sense(belief, obs)
        after = jax.tree.map(lambda a, b: jnp.where(used, a, b), after, belief)
        error = error_of(local.motion, after.bank.mean[0], jaxlie.SE3(truth))
        d = error.shape[0]
        P = after.bank.covariance[0, :d, :d]
        lives, worst = after.bank.initialised[0], jnp.asarray(jnp.inf, P.dtype)

        def select(counts: Array, value: Array, otherwise: Array) -> Array:
            return jnp.where(counts, jnp.where(lives, value, otherwise), 0)

        judged = judged & used
        return after, FilterScores(
            log_likelihood=select(used, estimate.log_likelihood, -worst),
            log_score=select(judged, log_likelihood(error, P), -worst),
            square_m2=select(judged, jnp.sum(error[: position_states(d)] ** 2), worst),
            nees=select(judged, nees(error, P), worst),
        )

    frames = (recorded.obs, recorded.used, recorded.T_world_vehicle_true, recorded.judged)
    return jax.lax.scan(frame, local.believe(start), frames)[1]


def _with_priors(motion: Motion, start: Bank) -> Bank:
    """The start, whose errors of the sensors are as likely as the model says, for its gradient."""
    errors = slice(motion.states, None)
    priors = motion.init(1).covariance[:, errors, errors]
    covariance = start.covariance.at[:, errors, errors].set(priors)
    return eqx.tree_at(lambda b: b.covariance, start, covariance)


class _Trusts(Navigator):
    """A navigator that takes all corners for those of markers."""

    def look(self, obs: Observation) -> ConsistentSnapshot:
        snapshot = self.snapshot(obs)
        nobody = jnp.zeros(len(self.markers.ids), bool)
        return ConsistentSnapshot(snapshot, self.find_candidates(snapshot), nobody)


class _GoesOn(_Trusts):
    """A navigator that searches no candidates: a continued hypothesis needs none."""

    def find_candidates(self, snapshot: Snapshot, own: jaxlie.SE3 | None = None) -> Candidates:
        return self.no_candidates()
