"""Evaluate a jaxpr for `over_lanes`: what differs between lanes as rows, the rest once."""

import collections
from collections.abc import Callable, Hashable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core
from jax.interpreters.partial_eval import dce_jaxpr
from jaxtyping import Shaped

from jaxnav.core.lanes.rules import ELEMENTWISE, NUMPY, RULES, VIEWS, elementwise
from jaxnav.core.lanes.strips import CALLS, STRIP, by_itself, in_strips
from jaxnav.core.lanes.values import (
    CHEAP,
    DEAR,
    UNROLLED,
    Lane,
    Params,
    Value,
    known,
    loop_over,
    rows_of,
    scan_rows,
    write_out,
)

# Arguments and results of the equations evaluated so far, by `_key`.
Known = dict[Hashable, tuple[list[Value], list[Value]]]


def evaluate(
    jaxpr: core.Jaxpr,
    consts: Sequence[Any],
    leaves: Sequence[Shaped[jax.Array, "... L"]],
    block: int,
) -> list[Shaped[jax.Array, "... L"]]:
    """The outputs (*shape, L) of a jaxpr, whose arguments (*shape, L) have L lanes."""
    lanes = leaves[0].shape[-1]
    args = [Lane(leaf) for leaf in leaves]
    # What nobody reads, also inside of branches and loops, would be compiled all the same.
    needed = dce_jaxpr(jaxpr, True, instantiate=True)[0]
    outs = _Evaluation(lanes, block).run(needed, [known(c) for c in consts], args)
    return [rows_of(value, lanes) for value in outs]


class _Evaluation(NamedTuple):
    lanes: int
    block: int

    def run(
        self,
        jaxpr: core.Jaxpr,
        consts: Sequence[Value],
        args: Sequence[Value],
        known_outs: Known | None = None,
    ) -> list[Value]:
        """Evaluate a jaxpr: its outputs.

        Args:
            known_outs: results of the equations evaluated so far in this trace, by equation and
                arguments: derivatives compute much of a function again.
        """
        known_outs = {} if known_outs is None else known_outs
        uses = collections.Counter(
            var for eqn in jaxpr.eqns for var in eqn.invars if not isinstance(var, core.Literal)
        )
        uses.update(var for var in jaxpr.outvars if not isinstance(var, core.Literal))
        env: dict[core.Var, Value] = dict(zip(jaxpr.constvars, consts, strict=True))

        def keep(var: core.Var, value: Value) -> None:
            env[var] = write_out(value, CHEAP if uses[var] > 1 else DEAR)

        for var, value in zip(jaxpr.invars, args, strict=True):
            keep(var, value)

        def read(var: core.Var | core.Literal) -> Value:
            return np.asarray(var.val) if isinstance(var, core.Literal) else env[var]

        for eqn in jaxpr.eqns:
            ins = [read(var) for var in eqn.invars]
            key = _key(eqn, ins)
            if key in known_outs:
                env.update(zip(eqn.outvars, known_outs[key][1], strict=True))
                continue
            outs = self._apply(eqn, ins, known_outs)
            for var, value in zip(eqn.outvars, outs, strict=True):
                keep(var, value)
            if key is not None:  # with its arguments, or another object could get their identity
                known_outs[key] = ins, [env[var] for var in eqn.outvars]
        return [read(var) for var in jaxpr.outvars]

    def _apply(self, eqn: core.JaxprEqn, args: list[Value], known_outs: Known) -> list[Value]:
        name, params = eqn.primitive.name, eqn.params
        if name in CALLS:
            closed = params[CALLS[name]]
            return self.run(closed.jaxpr, [known(c) for c in closed.consts], args, known_outs)
        if name == "platform_index":
            return [_platform_index(params["platforms"])]
        if name in ("cond", "while", "scan"):
            for arg in args:  # fetched before another trace begins
                _ = arg.rows if isinstance(arg, Lane) else arg
        if name == "cond":
            return self._cond(args, params)
        if all(isinstance(arg, np.ndarray) for arg in args) and name in NUMPY:
            return [np.asarray(NUMPY[name](*args, **params))]
        if not any(isinstance(arg, Lane) for arg in args):
            outs = eqn.primitive.bind(*args, **params)
            return list(outs) if eqn.primitive.multiple_results else [outs]
        if name == "while" and self.lanes > STRIP and by_itself(eqn):
            strip, fixed = _Evaluation(STRIP, self.block), len(args) - len(eqn.outvars)
            start = [rows_of(arg, self.lanes) for arg in args[fixed:]]
            outs = in_strips(lambda args: strip._while(args, params), args[:fixed], start)
            return [Lane(out) for out in outs]
        if name == "while":
            return self._while(args, params)
        if name == "scan":
            return self._scan(eqn, args)
        if name in ELEMENTWISE and name not in RULES:
            return [elementwise(eqn.primitive, args, params, self.lanes)]
        if name not in VIEWS:  # a sum reads every term once
            args = [write_out(arg, CHEAP if name == "reduce_sum" else 0) for arg in args]
        rule = RULES.get(name)
        outs = rule(args, params, self.lanes) if rule else None
        return self._generic(eqn.primitive, args, params) if outs is None else outs

    def _generic(self, primitive: core.Primitive, args: list[Value], params: Params) -> list[Value]:
        """Evaluate a primitive by `vmap`'s own batching rule."""
        axes = [-1 if isinstance(arg, Lane) else None for arg in args]
        arrays = [arg.rows if isinstance(arg, Lane) else arg for arg in args]
        outs = jax.vmap(lambda *a: primitive.bind(*a, **params), in_axes=axes, out_axes=-1)(*arrays)
        return [Lane(out) for out in (outs if primitive.multiple_results else [outs])]

    def _while(self, args: list[Value], params: Params) -> list[Value]:
        """Run a loop until the last lane ends; a lane that has ended keeps its carry."""
        n_cond, n_body = params["cond_nconsts"], params["body_nconsts"]
        cond_consts, body_consts = args[:n_cond], args[n_cond : n_cond + n_body]
        cond, body = params["cond_jaxpr"], params["body_jaxpr"]

        def goes(carry: list[jax.Array]) -> Value:
            consts = [known(c) for c in cond.consts]
            return self.run(cond.jaxpr, consts, [*cond_consts, *(Lane(c) for c in carry)])[0]

        def any_goes(carry: list[jax.Array]) -> jax.Array:
            still = goes(carry)
            return jnp.any(still.rows) if isinstance(still, Lane) else jnp.asarray(still)

        def step(carry: list[jax.Array]) -> list[jax.Array]:
            outs = self.run(
                body.jaxpr,
                [known(c) for c in body.consts],
                [*body_consts, *(Lane(c) for c in carry)],
            )
            moved, still = [rows_of(out, self.lanes) for out in outs], goes(carry)
            if not isinstance(still, Lane):  # one condition for all: the body freezes lanes
                return moved
            # (*batch, L): a `vmap` inside `fn` put its axes first.
            return [
                jnp.where(_spread(still.rows, old.ndim), new, old)
                for new, old in zip(moved, carry, strict=True)
            ]

        start = [rows_of(arg, self.lanes) for arg in args[n_cond + n_body :]]
        with loop_over(start):
            return [Lane(out) for out in lax.while_loop(any_goes, step, start)]

    def _scan(self, eqn: core.JaxprEqn, args: list[Value]) -> list[Value]:
        params, inner = eqn.params, eqn.params["jaxpr"].jaxpr

        def stacked(outer: Sequence[Any], inner: Sequence[Any]) -> int:
            """How many have the loop's axis, which every version of JAX names differently."""
            return sum(a.aval.ndim != b.aval.ndim for a, b in zip(outer, inner, strict=True))

        n_carry = len(eqn.outvars) - stacked(eqn.outvars, inner.outvars)
        n_consts = len(args) - n_carry - stacked(eqn.invars, inner.invars)
        consts = args[:n_consts]
        carry = [rows_of(arg, self.lanes) for arg in args[n_consts : n_consts + n_carry]]
        xs = [rows_of(arg, self.lanes) for arg in args[n_consts + n_carry :]]
        closed = params["jaxpr"]

        def body(
            carry: list[jax.Array], xs: list[jax.Array]
        ) -> tuple[list[jax.Array], list[jax.Array]]:
            outs = self.run(
                closed.jaxpr,
                [known(c) for c in closed.consts],
                [*consts, *(Lane(c) for c in carry), *(Lane(x) for x in xs)],
            )
            rows = [rows_of(out, self.lanes) for out in outs]
            return rows[:n_carry], rows[n_carry:]

        with loop_over(carry):
            carry, ys = lax.scan(
                body,
                carry,
                xs,
                length=params["length"],
                reverse=params["reverse"],
                unroll=params["unroll"],
            )
        return [Lane(out) for out in [*carry, *ys]]

    def _cond(self, args: list[Value], params: Params) -> list[Value]:
        index, *operands = args
        branches = params["branches"]

        def branch(closed: core.ClosedJaxpr, lanes: int) -> Callable[..., list[jax.Array]]:
            def run(operands: list[Value]) -> list[jax.Array]:
                outs = _Evaluation(lanes, self.block).run(
                    closed.jaxpr, [known(c) for c in closed.consts], operands
                )
                return [rows_of(out, lanes) for out in outs]

            return run

        if isinstance(index, np.ndarray):
            closed = branches[int(np.clip(index, 0, len(branches) - 1))]
            return self.run(closed.jaxpr, [known(c) for c in closed.consts], operands)
        if not isinstance(index, Lane):
            runs = [branch(closed, self.lanes) for closed in branches]
            return [Lane(o) for o in lax.switch(index, [lambda r=r: r(operands) for r in runs])]
        block = min(self.block, self.lanes)
        chosen = jnp.clip(index.rows.astype(jnp.int32), 0, len(branches) - 1)
        return [
            Lane(out)
            for out in _sorted_switch(
                chosen,
                [branch(closed, block) for closed in branches],
                operands,
                branches[0].out_avals,
                block,
            )
        ]


def _sorted_switch(
    chosen: jax.Array,
    branches: list[Callable[[list[Value]], list[jax.Array]]],
    operands: list[Value],
    shapes: Sequence[Any],
    block: int,
) -> list[jax.Array]:
    """Run each branch over blocks of the lanes that chose it; the last block repeats a lane."""
    lanes, count = chosen.shape[0], len(branches)
    is_in = chosen[None] == jnp.arange(count)[:, None]
    running = scan_rows(is_in.astype(jnp.int32), 1, lax.add, 0, False)
    members = running[:, -1]
    blocks = -(-members // block)
    first_block = jnp.cumsum(blocks) - blocks
    order = jnp.argsort(chosen, stable=True)
    first = jnp.cumsum(members) - members
    place = jnp.sum(jnp.where(is_in, running - 1, 0), axis=0)
    slot = first_block[chosen] * block + place
    slots = (lanes // block + count) * block

    def gather(at: jax.Array) -> list[Value]:
        return [Lane(o.rows, 0, at) if isinstance(o, Lane) else o for o in operands]

    buffers = [jnp.zeros((*aval.shape, slots), aval.dtype) for aval in shapes]
    for number, branch in enumerate(branches):
        last = jnp.maximum(first[number] + members[number] - 1, 0)

        def body(
            j: jax.Array,
            buffers: list[jax.Array],
            number: int = number,
            branch: Callable[[list[Value]], list[jax.Array]] = branch,
            last: jax.Array = last,
        ) -> list[jax.Array]:
            at = order[jnp.minimum(first[number] + j * block + jnp.arange(block), last)]
            outs = branch(gather(at))
            start = (first_block[number] + j) * block
            return [
                lax.dynamic_update_slice_in_dim(b, out, start, b.ndim - 1)
                for b, out in zip(buffers, outs, strict=True)
            ]

        with loop_over(buffers):
            buffers = lax.fori_loop(0, blocks[number], body, buffers)
    return [b.at[..., slot].get(mode="promise_in_bounds") for b in buffers]


def _key(eqn: core.JaxprEqn, args: list[Value]) -> Hashable | None:
    """A key that two equations share if they compute the same; None for one that is to be apart."""
    if eqn.primitive.name in CALLS or eqn.effects:
        return None
    same = [
        (arg.dtype, arg.shape, arg.tobytes())
        if isinstance(arg, np.ndarray) and arg.size <= UNROLLED
        else id(arg)
        for arg in args
    ]
    key = (eqn.primitive, *same, *sorted(eqn.params.items(), key=lambda item: item[0]))
    try:
        hash(key)
    except TypeError:  # an array among the parameters
        return None
    return key


def _spread(rows: jax.Array, ndim: int) -> jax.Array:
    """Reshape (*batch, L) to `ndim` axes, to broadcast against (*batch, ..., L)."""
    return rows.reshape(rows.shape[:-1] + (1,) * (ndim - rows.ndim) + rows.shape[-1:])


def _platform_index(platforms: Sequence[Sequence[str] | None]) -> np.ndarray:
    here = jax.default_backend()
    fits = [i for i, names in enumerate(platforms) if names is None or here in names]
    return np.asarray(fits[0], np.int32)
