"""The loss of a drive, and how it changes with the gains.

    drives = ClosedLoop(rollout, DriveLoss(), softness_m=0.03)
    losses, gradients = drives.value_and_grad(x, space, keys)         # (B,), (B, n)
    losses, costs, trace = drives.value(values, keys)                 # as the car would drive

A drive is a rollout's own: the same plant, cameras and `Navigator.step`. What is hard in it (which
poses are possible, whether the bank has decided) stays hard, and no derivative flows through it;
only the switch from waypoint to waypoint is soft (`soft_switch.py`).

Derivatives go forward with the drive: with each world goes how it changes with every gain. For a
handful of gains that is cheaper than going back: nothing is remembered, however long the drive, and
a lane whose drive has ended takes the next one.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Key

from jaxnav.lanes.over_lanes import COMPILER_OPTIONS, lanes_first, lanes_last, over_lanes
from jaxnav.navigator import Step
from jaxnav.parameters import with_parameters
from jaxnav.simulation.kept import Kept
from jaxnav.simulation.queue import run_lanes
from jaxnav.simulation.regimes import step_by_regime
from jaxnav.simulation.rollout import Rollout, Trace
from jaxnav.simulation.world import World
from jaxnav.tuning.drive_loss import Costs, CostsOfFrame, DriveLoss, no_costs
from jaxnav.tuning.soft_switch import softened
from jaxnav.tuning.unconstrained import Space

_jit = cast(Any, eqx.filter_jit)  # whose types know of no compiler options


class Sensitive(eqx.Module):
    """A drive, and how it changes with P numbers."""

    world: World
    costs: Costs
    slopes: Any  # leaves (P, ...): of what moves in the world, and of the costs

    @property
    def ended(self) -> Bool[Array, ""]:
        """Whether the drive is over."""
        return self.world.ended


class ClosedLoop(eqx.Module):
    """Drives of a rollout as a function of the navigator's parameters."""

    rollout: Rollout
    loss: DriveLoss = eqx.field(static=True, default=DriveLoss())
    softness_m: Float[Array, ""] = eqx.field(converter=jnp.asarray, default=0.03)
    many: int = eqx.field(static=True, default=256)  # drives for which `over_lanes` pays
    many_lanes: int = eqx.field(static=True, default=256)  # a thread

    def value(
        self,
        values: Mapping[str, Array],
        keys: Key[Array, " B"],
        progress: Callable[[int], object] = lambda ended: None,
    ) -> tuple[np.ndarray, Costs, Trace]:
        """The drives as they are, the controller hard: losses (B,), costs (B,), the traces.

        Args:
            values: parameters by name, as `with_parameters` takes them.
            keys: a drive for each.
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
        """The loss of every drive with the soft switch, and its derivatives.

        Args:
            x: unconstrained parameters, of `space`.
            keys: a drive for each.
        """
        lanes, threads, advance = min(self.rollout.lanes, len(keys)), 1, self._advance
        if len(keys) >= self.many:
            lanes, threads, advance = self.many_lanes, self.rollout.threads, self._advance_many
        kept = run_lanes(
            keys,
            lambda keys: self._start(x, space, keys),
            lambda drives: advance(x, space, drives),
            lanes,
            threads,
            Kept(len(keys), 1),
            progress,
        )
        sums, _ = kept.side_by_side()
        costs, slopes = jax.tree.map(lambda leaf: jnp.asarray(leaf[:, -1]), sums)
        return self._losses(costs, slopes)

    def first_not_finite(
        self, x: Float[Array, " n"], space: Space, key: Key[Array, ""]
    ) -> int | None:
        """The frame of one drive from which on a derivative is no number; None where all are."""
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
    def _start(self, x: Array, space: Space, keys: Key[Array, " lanes"]) -> Sensitive:
        def first(key: Array) -> Sensitive:
            def moving(x: Array) -> tuple[Any, World]:
                world = _strong(self._softened(x, space).first(key))
                return (_moving(world)[0], no_costs(world.car.pose.dtype)), world

            (_, costs), slopes, world = _pushed(moving, (x,), (_basis(x),))
            return Sensitive(world, costs, slopes)

        return jax.vmap(first)(keys)

    @eqx.filter_jit
    def _advance(self, x: Array, space: Space, drives: Sensitive) -> tuple[Sensitive, Any]:
        """Some frames of every lane, and what the drives have cost so far."""

        def frame(drive: Sensitive) -> Sensitive:
            return self._frame(x, space, drive, lambda rollout: rollout.navigator.step)

        drives, _ = jax.lax.scan(
            lambda d, _: (jax.vmap(frame)(d), None), drives, length=self.rollout.chunk_frames
        )
        return drives, _sums(drives)

    @_jit(compiler_options=COMPILER_OPTIONS)
    def _advance_many(self, x: Array, space: Space, drives: Sensitive) -> tuple[Sensitive, Any]:
        """The same for many lanes, each with no more work than it has."""

        def frame(drive: Sensitive) -> Sensitive:
            return self._frame(x, space, drive, lambda r: step_by_regime(r.navigator))

        last, _ = jax.lax.scan(
            lambda d, _: (over_lanes(frame)(d), None),
            lanes_last(drives),
            length=self.rollout.chunk_frames,
        )
        drives = lanes_first(last)
        return drives, _sums(drives)

    def _frame(
        self, x: Array, space: Space, drive: Sensitive, step: Callable[[Rollout], Step]
    ) -> Sensitive:
        before, costs_of_frame = drive.world, CostsOfFrame(self.rollout.scenario)
        moving, still = _moving(before)

        def after(x: Array, moving: Any, costs: Costs) -> tuple[Any, World]:
            rollout = self._softened(x, space)
            world = eqx.combine(moving, still)
            after = _strong(rollout.frame(world, step(rollout))[0])
            # Chosen, not multiplied by 0: what goes on after the end must not spoil derivatives.
            costs = jax.tree.map(
                lambda cost, more: jnp.where(before.ended, cost, cost + more),
                costs,
                costs_of_frame(world, after),
            )
            return (_moving(after)[0], costs), after

        tangents = (_basis(x), *drive.slopes)
        (_, costs), slopes, world = _pushed(after, (x, moving, drive.costs), tangents)
        return Sensitive(world, costs, slopes)

    def _softened(self, x: Array, space: Space) -> Rollout:
        navigator = with_parameters(self.rollout.navigator, space.values(x))
        return dataclasses.replace(self.rollout, navigator=softened(navigator, self.softness_m))


def without_gradient(gradients: Float[Array, "B n"], labels: list[str]) -> list[str]:
    """The names of the parameters on which no drive's loss depends."""
    asked = np.any(np.asarray(gradients) != 0, axis=0)
    names = np.array(labels)
    return [name for name in dict.fromkeys(labels) if not np.any(asked[names == name])]


def _moving(world: World) -> tuple[World, World]:
    """What changes with the gains, and the rest of a world: each without the other."""
    spec = jax.tree.map(lambda _: False, world)
    spec = dataclasses.replace(
        spec,
        **{
            part: jax.tree.map(eqx.is_inexact_array, getattr(world, part))
            for part in ("car", "acting", "command", "state")
        },
    )
    moving, still = eqx.partition(world, spec)
    return moving, still


def _pushed(fn: Callable[..., tuple[Any, World]], primals: Any, tangents: Any) -> Any:
    """fn's value, its derivatives along P directions at once, and what it has besides."""
    return jax.vmap(
        lambda along: jax.jvp(fn, primals, along, has_aux=True), out_axes=(None, 0, None)
    )(tangents)


def _basis(x: Float[Array, " n"]) -> Float[Array, "n n"]:
    """Each of the numbers by itself."""
    return jnp.eye(x.shape[0], dtype=x.dtype)


def _sums(drives: Sensitive) -> tuple[Costs, Costs]:
    """The costs and their slopes, as the one entry of a chunk."""
    sums: tuple[Costs, Costs] = jax.tree.map(
        lambda leaf: leaf[:, None], (drives.costs, drives.slopes[1])
    )
    return sums


def _strong(world: World) -> World:
    """Types as they are declared, or the next frame would be compiled for others."""
    strong: World = jax.tree.map(lambda leaf: jax.lax.convert_element_type(leaf, leaf.dtype), world)
    return strong
