"""Define the cost by which the filter's noise is tuned: corner likelihood, or true poses."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxnav.core.filter.bank import Bank
from jaxnav.core.navigator import Navigator
from jaxnav.core.parameters import with_parameters
from jaxnav.experiments.tuning.branches import find_starts
from jaxnav.experiments.tuning.following import follow, trust_corners
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
