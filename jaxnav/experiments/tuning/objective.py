"""Compute a loss over many drives: the mean cost of their frames.

A cost is a function of the unconstrained vector x and one item, a recorded sequence or the key of a
drive; the items are batched, and split over the devices of the process.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, PartitionSpec
from jaxtyping import Array, Float, PyTree

# (x, one item, softness of its discrete choices) -> cost of each of its T frames.
Cost = Callable[[Float[Array, " n"], PyTree, Float[Array, ""]], Float[Array, " T"]]


class Batch(NamedTuple):
    """Items, leading axis (B,), and the number of frames by which the sum is divided."""

    items: PyTree
    frames: Float[Array, ""]


class Objective(eqx.Module):
    """The mean cost of a frame, with a prior on x.

    The prior has zero mean and the standard deviation `prior_sigma`: parameters start at typical
    values, and one on which no frame depends stays there.
    """

    cost: Cost
    prior_sigma: float = float(np.log(30.0))

    def __call__(
        self, x: Float[Array, " n"], batch: Batch, softness: Float[Array, ""]
    ) -> Float[Array, ""]:
        prior = jnp.sum(x**2) / (2 * self.prior_sigma**2)
        return (self.total(x, batch.items, softness) + prior) / batch.frames

    def total(
        self, x: Float[Array, " n"], items: PyTree, softness: Float[Array, ""]
    ) -> Float[Array, ""]:
        """The sum of the costs over all frames of all items."""
        devices = jax.devices()
        count = jax.tree.leaves(items)[0].shape[0]

        def over(x: Array, items: PyTree, softness: Array) -> Array:
            return jnp.sum(jax.vmap(self.cost, in_axes=(None, 0, None))(x, items, softness))

        if len(devices) == 1 or count % len(devices):
            return over(x, items, softness)
        # Loops run until the slowest lane ends: every device loops over its own items.
        kind = (AxisType.Auto,)  # the split is known only here, not in the arrays' types
        mesh = jax.make_mesh((len(devices),), ("items",), kind, devices=devices)
        shared, split = PartitionSpec(), PartitionSpec("items")
        total: Array = jax.shard_map(
            lambda *args: jax.lax.psum(over(*args), "items"),
            mesh=mesh,
            in_specs=(shared, split, shared),
            out_specs=shared,
            check_vma=False,
        )(x, items, softness)
        return total


class NotFinite(NamedTuple):
    """The place at which a gradient is not finite."""

    entry: int  # of x
    item: int
    frame: int | None  # the first one; None: only the reverse pass is not finite

    def describe(self, labels: list[str], step: int) -> str:
        """A one-line message for a person."""
        where = "" if self.frame is None else f" from frame {self.frame} on"
        return (
            f"step {step}: the gradient with respect to {labels[self.entry]} is not finite in "
            f"drive {self.item}{where}; not stepped on"
        )


def where_not_finite(
    cost: Cost, x: Float[Array, " n"], items: PyTree, softness: Float[Array, ""]
) -> NotFinite | None:
    """The first entry and item whose gradient is not finite, or None."""

    @jax.jit
    def gradients(x: Array, items: PyTree) -> Array:
        return jax.vmap(jax.grad(lambda x, item: jnp.sum(cost(x, item, softness))), (None, 0))(
            x, items
        )

    broken = ~np.isfinite(np.asarray(gradients(x, items)))
    if not broken.any():
        return None
    item = int(np.argmax(broken.any(axis=1)))
    entry = int(np.argmax(broken[item]))
    one = jax.tree.map(lambda leaf: leaf[item], items)
    direction = jnp.zeros_like(x).at[entry].set(1)
    _, slopes = jax.jit(lambda x: jax.jvp(lambda x: cost(x, one, softness), (x,), (direction,)))(x)
    frames = np.flatnonzero(~np.isfinite(np.asarray(slopes)))
    return NotFinite(entry, item, int(frames[0]) if len(frames) else None)
