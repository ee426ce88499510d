"""Evaluate primitives for `over_lanes`: gather, scatter and sort in small tables.

A rule takes (arguments, parameters, lanes) and returns the outputs, or None to fall back to
`vmap`'s own batching rule.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from jaxnav.core.lanes.values import (
    DEAR,
    UNROLLED,
    Combine,
    Lane,
    Params,
    Value,
    at_place,
    barrier,
    rows_of,
)

Dims = Sequence[Any]  # JAX's integers: Python's, NumPy's, or a literal's


def _windows(
    shape: Dims,
    index: np.ndarray,
    slice_sizes: Dims,
    window_dims: Dims,
    collapsed: Dims,
    start_map: Dims,
    operand_batch: Dims,
    index_batch: Dims,
) -> np.ndarray | None:
    """The flat positions in the operand that a gather reads or a scatter writes.

    None if a window does not lie inside the operand.
    """
    batch_shape = index.shape[:-1]
    start = np.zeros((*batch_shape, len(shape)), int)
    start[..., list(start_map)] = index
    for od, sd in zip(operand_batch, index_batch, strict=True):
        start[..., od] = np.arange(batch_shape[sd]).reshape(
            [-1 if d == sd else 1 for d in range(len(batch_shape))]
        )
    if np.any(start < 0) or np.any(start + np.asarray(slice_sizes) > np.asarray(shape)):
        return None
    kept = [d for d in range(len(shape)) if d not in (*collapsed, *operand_batch)]
    places = []
    for d in range(len(shape)):
        at = start[..., d].reshape((*batch_shape, *(1,) * len(kept)))
        if d in kept:
            along = [1] * len(kept)
            along[kept.index(d)] = slice_sizes[d]
            at = at + np.arange(slice_sizes[d]).reshape((1,) * len(batch_shape) + tuple(along))
        places.append(np.broadcast_to(at, (*batch_shape, *(slice_sizes[k] for k in kept))))
    flat = np.asarray(np.ravel_multi_index(tuple(places), tuple(shape)) if shape else 0)
    rank = flat.ndim
    others = [d for d in range(rank) if d not in window_dims]
    source = {dim: len(batch_shape) + i for i, dim in enumerate(window_dims)}
    source.update({dim: i for i, dim in enumerate(others)})
    return flat.transpose([source[d] for d in range(rank)])


def gather(args: list[Value], params: Params, lanes: int) -> list[Value] | None:
    operand, index = args
    dn, sizes = params["dimension_numbers"], params["slice_sizes"]
    if isinstance(index, np.ndarray) and isinstance(operand, Lane):
        flat = _windows(
            operand.shape,
            index,
            sizes,
            dn.offset_dims,
            dn.collapsed_slice_dims,
            dn.start_index_map,
            dn.operand_batching_dims,
            dn.start_indices_batching_dims,
        )
        return None if flat is None else [Lane(_rows_at(operand.rows, flat), DEAR)]
    if not isinstance(index, Lane):
        return None
    # Every lane chooses its own row of the table.
    if len(dn.start_index_map) != 1 or dn.collapsed_slice_dims != dn.start_index_map:
        return None
    axis = dn.start_index_map[0]
    shape = operand.shape
    if shape[axis] > UNROLLED:
        return None
    if any(s != n for d, (s, n) in enumerate(zip(sizes, shape, strict=True))
           if d != axis and d not in dn.operand_batching_dims):  # fmt: skip
        return None
    at = lax.squeeze(index.rows, (index.rows.ndim - 2,))
    if dn.operand_batching_dims:
        return None
    rank = len(dn.offset_dims) + at.ndim - 1
    out_shape = tuple([0] * rank)
    others = [d for d in range(rank) if d not in dn.offset_dims]
    kept = [d for d in range(len(shape)) if d != axis]
    out = [0] * rank
    for position, d in zip(dn.offset_dims, kept, strict=True):
        out[position] = shape[d]
    for position, size in zip(others, at.shape[:-1], strict=True):
        out[position] = size
    out_shape = (*out, lanes)
    at = lax.broadcast_in_dim(at, out_shape, (*others, rank))

    def row(k: int) -> jax.Array:
        if isinstance(operand, Lane):
            return lax.broadcast_in_dim(
                at_place(operand.rows, {axis: k}), out_shape, (*dn.offset_dims, rank)
            )
        return lax.broadcast_in_dim(
            at_place(jnp.asarray(operand), {axis: k}), out_shape, tuple(dn.offset_dims)
        )

    chosen = row(0)
    for k in range(1, shape[axis]):
        chosen = lax.select(at >= k, row(k), chosen)
    return [Lane(chosen, shape[axis])]


def dynamic_slice(args: list[Value], params: Params, lanes: int) -> list[Value] | None:
    operand, *starts = args
    moving = [d for d, s in enumerate(starts) if not isinstance(s, np.ndarray)]
    if any(np.any(s) for s in starts if isinstance(s, np.ndarray)) or len(moving) != 1:
        return None
    axis, shape, sizes = moving[0], operand.shape, params["slice_sizes"]
    start = starts[axis]
    if sizes[axis] != 1 or shape[axis] > UNROLLED or not isinstance(start, Lane):
        return None
    rows = rows_of(operand, lanes)
    rows = lax.slice(rows, (0,) * rows.ndim, (*(shape[d] if d == axis else sizes[d]
                                                for d in range(len(shape))), lanes))  # fmt: skip
    chosen = lax.slice_in_dim(rows, 0, 1, axis=axis)
    for k in range(1, shape[axis]):
        row = lax.slice_in_dim(rows, k, k + 1, axis=axis)
        at = lax.broadcast_in_dim(start.rows, row.shape, (row.ndim - 1,))
        chosen = lax.select(at >= k, row, chosen)
    return [Lane(chosen, shape[axis])]


def scatter(args: list[Value], params: Params, lanes: int) -> list[Value] | None:
    operand, index, updates = args
    if not isinstance(index, np.ndarray):
        return None
    dn = params["dimension_numbers"]
    window = dn.update_window_dims
    kept = [
        d
        for d in range(len(operand.shape))
        if d not in (*dn.inserted_window_dims, *dn.operand_batching_dims)
    ]
    sizes = [1] * len(operand.shape)
    for position, d in zip(window, kept, strict=True):
        sizes[d] = updates.shape[position]
    flat = _windows(
        operand.shape,
        index,
        sizes,
        window,
        dn.inserted_window_dims,
        dn.scatter_dims_to_operand_dims,
        dn.operand_batching_dims,
        dn.scatter_indices_batching_dims,
    )
    if flat is None:
        return None
    size = math.prod(operand.shape)
    source = np.arange(size)
    source[flat.reshape(-1)] = size + np.arange(flat.size)
    both = jnp.concatenate(
        [rows_of(operand, lanes).reshape(size, lanes), rows_of(updates, lanes).reshape(-1, lanes)]
    )
    return [Lane(_rows_at(both, source.reshape(operand.shape)), DEAR)]


def _rows_at(rows: jax.Array, flat: np.ndarray) -> jax.Array:
    """The rows at known flat positions, with neighbouring rows copied together."""
    lanes = rows.shape[-1]
    rows = rows.reshape(-1, lanes)
    order = flat.reshape(-1)
    breaks = np.flatnonzero(np.diff(order) != 1) + 1
    runs = np.split(order, breaks)
    if len(runs) > 4:
        selection = rows.at[order].get(mode="promise_in_bounds", unique_indices=False)
        return selection.reshape(*flat.shape, lanes)
    pieces = [lax.slice_in_dim(rows, int(run[0]), int(run[-1]) + 1) for run in runs if run.size]
    if not pieces:
        return jnp.zeros((*flat.shape, lanes), rows.dtype)
    out = pieces[0] if len(pieces) == 1 else lax.concatenate(pieces, 0)
    return out.reshape(*flat.shape, lanes)


def arg_extreme(better: Combine) -> Callable[..., list[Value] | None]:
    def rule(args: list[Lane], params: Params, lanes: int) -> list[Value] | None:
        (axis,), rows = tuple(map(int, params["axes"])), args[0].rows
        count = rows.shape[axis]
        if count > UNROLLED:
            return None
        best = at_place(rows, {axis: 0})
        where = jnp.zeros(best.shape, params["index_dtype"])
        for k in range(1, count):
            row = at_place(rows, {axis: k})
            takes = better(row, best)
            if jnp.issubdtype(rows.dtype, jnp.floating):
                takes = takes | (jnp.isnan(row) & ~jnp.isnan(best))
            best = lax.select(takes, row, best)
            where = lax.select(takes, jnp.full_like(where, k), where)
        return [Lane(where, 3 * count)]

    return rule


def _ranks(keys: jax.Array, descending: bool) -> jax.Array:
    """The rank (n, ..., L) of each key in the order; equal keys keep their order.

    Ascending, NaN comes last and zeros are equal; descending, the order is IEEE's: as in XLA.
    """
    if jnp.issubdtype(keys.dtype, jnp.floating):
        if not descending:
            keys = jnp.where(jnp.isnan(keys), jnp.nan, jnp.where(keys == 0, 0, keys))
        less = lax.lt_to_p.bind
    else:
        less = lax.lt
    count = keys.shape[0]
    own = jnp.arange(count).reshape((-1,) + (1,) * (keys.ndim - 1))
    ranks = jnp.zeros(keys.shape, jnp.int32)
    for j in range(count):
        other = jnp.broadcast_to(keys[j : j + 1], keys.shape)
        before = less(keys, other) if descending else less(other, keys)
        after = less(other, keys) if descending else less(keys, other)
        ranks = ranks + (before | (~after & (own > j))).astype(jnp.int32)
    return ranks


def _placed(ranks: jax.Array, values: jax.Array, places: int) -> jax.Array:
    """The first `places` of values (n, ..., L) in the order of their ranks."""
    place = jnp.arange(places, dtype=jnp.int32).reshape((-1,) + (1,) * (values.ndim - 1))
    shape = (places, *values.shape[1:])
    out = jnp.broadcast_to(values[:1], shape)
    for k in range(1, values.shape[0]):
        here = jnp.broadcast_to(ranks[k : k + 1], shape) == place
        out = lax.select(here, jnp.broadcast_to(values[k : k + 1], shape), out)
    return out


def sort(args: list[Value], params: Params, lanes: int) -> list[Value] | None:
    axis, rows = params["dimension"], [rows_of(arg, lanes) for arg in args]
    if params["num_keys"] != 1 or not params["is_stable"] or rows[0].shape[axis] > UNROLLED:
        return None
    rows = [jnp.moveaxis(r, axis, 0) for r in rows]
    ranks = barrier(_ranks(rows[0], descending=False))
    return [Lane(jnp.moveaxis(_placed(ranks, r, r.shape[0]), 0, axis)) for r in rows]


def top_k(args: list[Lane], params: Params, lanes: int) -> list[Value] | None:
    rows, axis = args[0].rows, params.get("axis", len(args[0].shape) - 1)
    if rows.shape[axis] > UNROLLED:
        return None
    rows = jnp.moveaxis(rows, axis, 0)
    ranks = barrier(_ranks(rows, descending=True))
    index = jnp.broadcast_to(
        jnp.arange(rows.shape[0], dtype=jnp.int32).reshape((-1,) + (1,) * (rows.ndim - 1)),
        rows.shape,
    )
    return [Lane(jnp.moveaxis(_placed(ranks, r, params["k"]), 0, axis)) for r in (rows, index)]
