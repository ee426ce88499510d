"""Compute the loss of closed-loop drives and its gradient with respect to the gains.

    drives = ClosedLoop(rollout, DriveLoss(), softness_m=0.03)
    losses, gradients = drives.value_and_grad(x, space, keys)         # (B,), (B, n)
    losses, costs, trace = drives.value(values, keys)                 # as the car would drive

A drive is a rollout's own: the same plant, cameras and `Navigator.step`. Its hard decisions (which
poses are possible, whether the bank has decided) stay hard, and no derivative flows through them;
only the switch from waypoint to waypoint is soft (`soft_switch.py`).

Differentiation is in forward mode: each world carries its derivatives with respect to every gain.
For a handful of gains that is cheaper than reverse mode: nothing is stored, however long the drive,
and a lane whose drive has ended takes the next one.
"""

import dataclasses
import os
from collections.abc import Callable, Mapping
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int, Key, PyTree, UInt32

from jaxnav.core.filter.bank import Bank
from jaxnav.core.parameters import with_parameters
from jaxnav.experiments.tuning.drive_loss import Costs, CostsOfFrame, DriveLoss, no_costs
from jaxnav.experiments.tuning.soft_switch import soften_switch
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.files.executables import kept
from jaxnav.sim.queue import Slots, program_sizes, run_drives
from jaxnav.sim.rollout import Rollout, Trace, strong
from jaxnav.sim.traces import DriveTraces
from jaxnav.sim.world import DriveState


class DriveSlopes(eqx.Module):
    """A drive and its derivatives with respect to P numbers."""

    world: DriveState
    costs: Costs
    slopes: PyTree  # leaves (P, ...): derivatives of the world's moving part, and of the costs

    @property
    def ended(self) -> Bool[Array, "*L"]:
        """Whether the drive is over."""
        return self.world.ended

    @property
    def seen(self) -> Int[Array, "*L"]:
        """The number of sightings in the last frame."""
        return self.world.seen

    @property
    def bank(self) -> Bank:
        """The navigator's hypotheses."""
        return self.world.bank


class ClosedLoop(eqx.Module):
    """Drives of a rollout as a function of the navigator's parameters."""

    rollout: Rollout
    loss: DriveLoss = eqx.field(static=True, default=DriveLoss())
    # Of a strong type whatever is given, so that one program serves all softnesses.
    softness_m: Float[Array, ""] = eqx.field(
        converter=lambda m: jnp.asarray(m, float), default=0.03
    )

    def value(
        self,
        values: Mapping[str, Float[Array, "..."]],
        keys: Key[Array, " B"],
        progress: Callable[[int], object] = lambda ended: None,
    ) -> tuple[Float[np.ndarray, " B"], Costs, Trace]:
        """Drive with the hard controller, as the car does: losses (B,), costs (B,), the traces.

        Args:
            values: parameters by name, as `with_parameters` takes them.
            keys: one for each drive.
        """
        navigator = with_parameters(self.rollout.navigator, values)
        rollout = dataclasses.replace(self.rollout, navigator=navigator)
        trace, costs = rollout.run_keeping(keys, CostsOfFrame(rollout.scenario), progress)
        own = np.asarray(trace.active)
        costs = jax.tree.map(lambda leaf: np.sum(np.where(own, leaf, 0), axis=1), costs)
        return np.asarray(self.loss(costs)), costs, trace

    def value_and_grad(
        self,
        x: Float[Array, " n"],
        space: Space,
        keys: Key[Array, " B"],
        progress: Callable[[int], object] = lambda ended: None,
    ) -> tuple[Float[Array, " B"], Float[Array, "B n"]]:
        """The loss (B,) of every drive with the soft switch, and its gradients (B, n).

        Args:
            x: unconstrained parameters in `space`.
            keys: one for each drive.
        """
        traces = run_drives(
            keys,
            lambda keys: _start(self, x, space, jax.random.key_data(keys)),
            lambda drives, slots: _advance(self, x, space, drives, slots),
            program_sizes(self.rollout.navigator, len(keys) * (1 + len(x))),
            DriveTraces(len(keys), 1),
            os.cpu_count() or 1,
            progress,
        )
        sums, _ = traces.stack()
        costs, slopes = jax.tree.map(lambda leaf: jnp.asarray(leaf[:, -1]), sums)
        return _losses(self.loss, costs, slopes)

    def hard_losses(
        self, x: Float[Array, " n"], space: Space, keys: Key[Array, " B"]
    ) -> Float[np.ndarray, " B"]:
        """The losses (B,) of `value`, by the program that differentiates: a switch of no width is
        the hard one.

        Args:
            x: unconstrained parameters in `space`.
            keys: one for each drive.
        """
        hard = dataclasses.replace(self, softness_m=jnp.zeros_like(self.softness_m))
        return np.asarray(hard.value_and_grad(x, space, keys)[0])

    def first_not_finite(
        self, x: Float[Array, " n"], space: Space, key: Key[Array, ""]
    ) -> int | None:
        """The first frame of a drive after which a derivative is not finite, or None."""
        rollout = dataclasses.replace(self.rollout, chunk_frames=1)
        one = dataclasses.replace(self, rollout=rollout)
        drives = _start(one, x, space, jax.random.key_data(key)[None])
        for frame in range(rollout.scenario.frames):
            drives, _, _ = _advance(one, x, space, drives, Slots(1))
            if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(drives.slopes)):
                return frame
        return None

    def _softened(self, x: Array, space: Space) -> Rollout:
        navigator = with_parameters(self.rollout.navigator, space.values(x))
        return dataclasses.replace(
            self.rollout, navigator=soften_switch(navigator, self.softness_m)
        )


@kept
def _start(
    loop: ClosedLoop, x: Float[Array, " n"], space: Space, keys: UInt32[Array, "drives 2"]
) -> DriveSlopes:
    def first(key: Array) -> DriveSlopes:
        def moving(x: Array) -> tuple[PyTree, DriveState]:
            world = strong(loop._softened(x, space).first(jax.random.wrap_key_data(key)))
            return (_moving(world)[0], no_costs(world.car.pose.dtype)), world

        (_, costs), slopes, world = _pushed(moving, (x,), (_basis(x),))
        return DriveSlopes(world, costs, slopes)

    return jax.vmap(first)(keys)


@kept
def _advance(
    loop: ClosedLoop, x: Float[Array, " n"], space: Space, drives: DriveSlopes, slots: Slots
) -> tuple[DriveSlopes, PyTree, Bool[Array, " drives"]]:
    """Advance every drive by `chunk_frames`: the drives, their costs so far as the one entry of a
    chunk, and whether the slots did not suffice."""

    def one(drive: DriveSlopes) -> tuple[DriveSlopes, PyTree, Array]:
        moving, still = _moving(drive.world)

        def after(x: Array, moving: PyTree, costs: Costs) -> tuple[PyTree, PyTree]:
            rollout, world = loop._softened(x, space), eqx.combine(moving, still)
            keep = CostsOfFrame(rollout.scenario)
            after, (trace, more), lacks = rollout.chunk(world, keep, slots)
            # Selected, not multiplied by 0: values after the end must not spoil the derivatives.
            costs = jax.tree.map(
                lambda cost, more: cost + jnp.sum(jnp.where(trace.active, more, 0)), costs, more
            )
            return (_moving(after)[0], costs), (after, lacks)

        tangents = (_basis(x), *drive.slopes)
        (_, costs), slopes, (world, lacks) = _pushed(after, (x, moving, drive.costs), tangents)
        sums = jax.tree.map(lambda leaf: leaf[None], (costs, slopes[1]))
        return DriveSlopes(world, costs, slopes), sums, lacks

    return jax.vmap(one)(drives)


@partial(jax.jit, static_argnums=0)
def _losses(
    loss: DriveLoss, costs: Costs, slopes: Costs
) -> tuple[Float[Array, " B"], Float[Array, "B n"]]:
    def along(costs: Costs, slope: Costs) -> Array:
        return jax.jvp(loss, (costs,), (slope,))[1]

    return loss(costs), jax.vmap(jax.vmap(along, (None, 0)))(costs, slopes)


def without_gradient(gradients: Float[Array, "B n"], labels: list[str]) -> list[str]:
    """The names of the parameters on which no drive's loss depends."""
    asked = np.any(np.asarray(gradients) != 0, axis=0)
    names = np.array(labels)
    return [name for name in dict.fromkeys(labels) if not np.any(asked[names == name])]


def _moving(world: DriveState) -> tuple[DriveState, DriveState]:
    """Partition a world into the part that changes with the gains, and the rest."""
    spec = jax.tree.map(lambda _: False, world)
    spec = dataclasses.replace(
        spec,
        **{
            part: jax.tree.map(eqx.is_inexact_array, getattr(world, part))
            for part in ("car", "acting", "command", "gyro", "state")
        },
    )
    moving, still = eqx.partition(world, spec)
    return moving, still


def _pushed(fn: Callable[..., tuple[PyTree, PyTree]], primals: PyTree, tangents: PyTree) -> PyTree:
    """The value of fn, its derivatives along P directions at once, and its auxiliary output."""
    return jax.vmap(
        lambda along: jax.jvp(fn, primals, along, has_aux=True), out_axes=(None, 0, None)
    )(tangents)


def _basis(x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """The unit vectors of the parameter space."""
    return jnp.eye(x.shape[0], dtype=x.dtype)
