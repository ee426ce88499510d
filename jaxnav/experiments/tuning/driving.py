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
from collections.abc import Callable, Mapping
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key, PyTree

from jaxnav.core.lanes.over_lanes import lanes_first, lanes_last, over_lanes
from jaxnav.core.navigator import Step
from jaxnav.core.parameters import with_parameters
from jaxnav.experiments.tuning.drive_loss import Costs, CostsOfFrame, DriveLoss, no_costs
from jaxnav.experiments.tuning.soft_switch import soften_switch
from jaxnav.experiments.tuning.unconstrained import Space
from jaxnav.sim.batch_jit import lanes_jit
from jaxnav.sim.queue import run_lanes
from jaxnav.sim.regimes import step_by_regime
from jaxnav.sim.rollout import Rollout, Trace, by_lanes, vmap_lanes
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


class ClosedLoop(eqx.Module):
    """Drives of a rollout as a function of the navigator's parameters."""

    rollout: Rollout
    loss: DriveLoss = eqx.field(static=True, default=DriveLoss())
    # Of a strong type whatever is given, so that one program serves all softnesses.
    softness_m: Float[Array, ""] = eqx.field(
        converter=lambda m: jnp.asarray(m, float), default=0.03
    )
    many: int = eqx.field(static=True, default=256)  # least number of drives for `over_lanes`
    many_lanes: int = eqx.field(static=True, default=128)  # per thread

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
        compiled_for: int | None = None,
    ) -> tuple[Float[Array, " B"], Float[Array, "B n"]]:
        """The loss (B,) of every drive with the soft switch, and its gradients (B, n).

        Args:
            x: unconstrained parameters in `space`.
            keys: one for each drive.
            compiled_for: the number of drives whose program runs them; by default that of `keys`.
        """
        count = len(keys) if compiled_for is None else compiled_for
        lanes, threads, advance = min(vmap_lanes(self.rollout.lanes), count), 1, self._advance
        if by_lanes(count, self.many):
            lanes, threads, advance = self.many_lanes, self.rollout.threads, self._advance_many
        kept = run_lanes(
            keys,
            lambda keys: self._start(x, space, keys),
            lambda drives: advance(x, space, drives),
            lanes,
            threads,
            DriveTraces(len(keys), 1),
            progress,
        )
        sums, _ = kept.stack()
        costs, slopes = jax.tree.map(lambda leaf: jnp.asarray(leaf[:, -1]), sums)
        return self._losses(costs, slopes)

    def hard_losses(
        self, x: Float[Array, " n"], space: Space, keys: Key[Array, " B"], beside: int
    ) -> Float[np.ndarray, " B"]:
        """The losses (B,) of `value`, where possible without another program to compile.

        A switch of no width is the hard one, so the program that differentiates many drives runs
        these as well.

        Args:
            x: unconstrained parameters in `space`.
            keys: one for each drive.
            beside: the number of drives that are differentiated in the same process.
        """
        if beside < self.many:
            return self.value(space.values(x), keys)[0]
        hard = dataclasses.replace(self, softness_m=jnp.zeros_like(self.softness_m))
        return np.asarray(hard.value_and_grad(x, space, keys, compiled_for=beside)[0])

    def first_not_finite(
        self, x: Float[Array, " n"], space: Space, key: Key[Array, ""]
    ) -> int | None:
        """The first frame of a drive after which a derivative is not finite, or None."""
        rollout = dataclasses.replace(self.rollout, chunk_frames=1)
        one = dataclasses.replace(self, rollout=rollout)
        drives = one._start(x, space, key[None])
        for frame in range(rollout.scenario.frames):
            drives, _ = one._advance(x, space, drives)
            if not all(np.all(np.isfinite(leaf)) for leaf in jax.tree.leaves(drives.slopes)):
                return frame
        return None

    @eqx.filter_jit
    def _losses(
        self, costs: Costs, slopes: Costs
    ) -> tuple[Float[Array, " B"], Float[Array, "B n"]]:
        def along(costs: Costs, slope: Costs) -> Array:
            return jax.jvp(self.loss, (costs,), (slope,))[1]

        derivatives = jax.vmap(jax.vmap(along, (None, 0)))(costs, slopes)
        return self.loss(costs), derivatives

    @eqx.filter_jit
    def _start(self, x: Array, space: Space, keys: Key[Array, " lanes"]) -> DriveSlopes:
        def first(key: Array) -> DriveSlopes:
            def moving(x: Array) -> tuple[PyTree, DriveState]:
                world = _strong(self._softened(x, space).first(key))
                return (_moving(world)[0], no_costs(world.car.pose.dtype)), world

            (_, costs), slopes, world = _pushed(moving, (x,), (_basis(x),))
            return DriveSlopes(world, costs, slopes)

        return jax.vmap(first)(keys)

    @eqx.filter_jit
    def _advance(self, x: Array, space: Space, drives: DriveSlopes) -> tuple[DriveSlopes, Any]:
        """Advance every lane by `chunk_frames`: the drives, and their costs so far."""

        def frame(drive: DriveSlopes) -> DriveSlopes:
            return self._frame(x, space, drive, lambda rollout: rollout.navigator.step)

        drives, _ = jax.lax.scan(
            lambda d, _: (jax.vmap(frame)(d), None), drives, length=self.rollout.chunk_frames
        )
        return drives, _sums(drives)

    @lanes_jit
    def _advance_many(self, x: Array, space: Space, drives: DriveSlopes) -> tuple[DriveSlopes, Any]:
        """`_advance` for many lanes by `over_lanes`, each lane in its own branches."""

        def frame(drive: DriveSlopes) -> DriveSlopes:
            return self._frame(x, space, drive, lambda r: step_by_regime(r.navigator))

        last, _ = jax.lax.scan(
            lambda d, _: (over_lanes(frame)(d), None),
            lanes_last(drives),
            length=self.rollout.chunk_frames,
        )
        drives = lanes_first(last)
        return drives, _sums(drives)

    def _frame(
        self, x: Array, space: Space, drive: DriveSlopes, step: Callable[[Rollout], Step]
    ) -> DriveSlopes:
        before, costs_of_frame = drive.world, CostsOfFrame(self.rollout.scenario)
        moving, still = _moving(before)

        def after(x: Array, moving: PyTree, costs: Costs) -> tuple[PyTree, DriveState]:
            rollout = self._softened(x, space)
            world = eqx.combine(moving, still)
            after = _strong(rollout.frame(world, step(rollout))[0])
            # Selected, not multiplied by 0: values after the end must not spoil the derivatives.
            costs = jax.tree.map(
                lambda cost, more: jnp.where(before.ended, cost, cost + more),
                costs,
                costs_of_frame(world, after),
            )
            return (_moving(after)[0], costs), after

        tangents = (_basis(x), *drive.slopes)
        (_, costs), slopes, world = _pushed(after, (x, moving, drive.costs), tangents)
        return DriveSlopes(world, costs, slopes)

    def _softened(self, x: Array, space: Space) -> Rollout:
        navigator = with_parameters(self.rollout.navigator, space.values(x))
        return dataclasses.replace(
            self.rollout, navigator=soften_switch(navigator, self.softness_m)
        )


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


def _pushed(
    fn: Callable[..., tuple[PyTree, DriveState]], primals: PyTree, tangents: PyTree
) -> PyTree:
    """The value of fn, its derivatives along P directions at once, and its auxiliary output."""
    return jax.vmap(
        lambda along: jax.jvp(fn, primals, along, has_aux=True), out_axes=(None, 0, None)
    )(tangents)


def _basis(x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """The unit vectors of the parameter space."""
    return jnp.eye(x.shape[0], dtype=x.dtype)


def _sums(drives: DriveSlopes) -> tuple[Costs, Costs]:
    """The costs and their slopes, as the single entry of a chunk."""
    sums: tuple[Costs, Costs] = jax.tree.map(
        lambda leaf: leaf[:, None], (drives.costs, drives.slopes[1])
    )
    return sums


def _strong(world: DriveState) -> DriveState:
    """The world with strong types, so that the next frame is not compiled for other types."""
    strong: DriveState = jax.tree.map(
        lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), world
    )
    return strong
