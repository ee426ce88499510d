"""Evaluate primitives for `over_lanes`: arithmetic, sums and products of small arrays, shapes.

A rule takes (arguments, parameters, lanes) and returns the outputs, or None to fall back to
`vmap`'s own batching rule.
"""

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core

from jaxnav.core.lanes.tables import arg_extreme, dynamic_slice, gather, scatter, sort, top_k
from jaxnav.core.lanes.values import (
    DEAR,
    UNROLLED,
    Combine,
    Lane,
    Params,
    Value,
    at_place,
    join_rows,
    rows_of,
    scan_rows,
    write_out,
)


def elementwise(primitive: core.Primitive, args: list[Value], params: Params, lanes: int) -> Lane:
    shape = np.broadcast_shapes(*(arg.shape for arg in args))
    full = (*shape, lanes)

    def met(arg: Value) -> jax.Array:
        if isinstance(arg, Lane):
            if arg.shape == shape:
                return arg.rows
            own = range(len(arg.shape)) if arg.shape else ()
            return lax.broadcast_in_dim(arg.rows, full, (*own, len(shape)))
        arg = jnp.asarray(arg)
        return lax.broadcast_in_dim(arg, full, tuple(range(arg.ndim)))

    args = [
        write_out(arg, 0) if isinstance(arg, Lane) and arg.shape != shape else arg for arg in args
    ]
    work = sum(arg.work for arg in args if isinstance(arg, Lane))
    own = 0 if primitive.name in _FREE else 1 if primitive.name not in _SLOW else 8
    return Lane(primitive.bind(*[met(arg) for arg in args], **params), work + own)


def _atan2(args: list[Value], params: Params, lanes: int) -> list[Value] | None:
    """atan2 in float32 as a polynomial, to 2 ulp; XLA's own calls the C library for every number.

    Source: Moshier (1989), "Methods and programs for mathematical functions" (Cephes, atanf).
    """
    shape = np.broadcast_shapes(*(arg.shape for arg in args))
    if args[0].rows.dtype != jnp.float32 if isinstance(args[0], Lane) else True:
        return None
    y, x = (jnp.broadcast_to(rows_of(arg, lanes), (*shape, lanes)) for arg in args)
    longer, shorter = jnp.maximum(jnp.abs(x), jnp.abs(y)), jnp.minimum(jnp.abs(x), jnp.abs(y))
    ratio = shorter / jnp.where(longer > 0, longer, 1)  # tangent of the angle to the nearer axis
    far = ratio > 0.41421356  # tan(pi / 8): there of the angle to the diagonal
    t = jnp.where(far, (ratio - 1) / (ratio + 1), ratio)
    z = t * t
    series = ((8.05374449538e-2 * z - 1.38776856032e-1) * z + 1.99777106478e-1) * z
    angle = (series - 3.33329491539e-1) * z * t + t
    angle = jnp.where(far, angle + 0.25 * np.float32(np.pi), angle)
    angle = jnp.where(jnp.abs(y) > jnp.abs(x), np.float32(np.pi / 2) - angle, angle)
    angle = jnp.where(jnp.signbit(x), np.float32(np.pi) - angle, angle)
    angle = jnp.where(jnp.signbit(y), -angle, angle)
    return [Lane(jnp.where(jnp.isnan(x) | jnp.isnan(y), jnp.nan, angle), DEAR + 1)]


def _same(args: list[Lane], params: Params, lanes: int) -> list[Value]:
    return [args[0]]


def _any_lane(args: list[Lane], params: Params, lanes: int) -> list[Value]:
    return [jnp.any(args[0].rows)]


def _broadcast_in_dim(args: list[Value], params: Params, lanes: int) -> list[Value]:
    shape, dims = params["shape"], params["broadcast_dimensions"]
    expands = math.prod(shape) > math.prod(args[0].shape)
    arg = write_out(args[0], 0) if expands else args[0]
    assert isinstance(arg, Lane)  # the one that differs between lanes
    return [Lane(lax.broadcast_in_dim(arg.rows, (*shape, lanes), (*dims, len(shape))), arg.work)]


def _reshape(args: list[Lane], params: Params, lanes: int) -> list[Value]:
    return [Lane(args[0].rows.reshape(*params["new_sizes"], lanes), args[0].work)]


def _squeeze(args: list[Lane], params: Params, lanes: int) -> list[Value]:
    return [Lane(lax.squeeze(args[0].rows, params["dimensions"]), args[0].work)]


def _transpose(args: list[Lane], params: Params, lanes: int) -> list[Value]:
    permutation = params["permutation"]
    return [Lane(lax.transpose(args[0].rows, (*permutation, len(permutation))), args[0].work)]


def _slice(args: list[Lane], params: Params, lanes: int) -> list[Value]:
    strides, arg = params["strides"], args[0]
    if arg.at is not None and strides is None:
        first = lax.slice(
            arg.source,
            (*params["start_indices"], 0),
            (*params["limit_indices"], arg.source.shape[-1]),
        )
        return [Lane(first, 0, arg.at)]
    return [
        Lane(
            lax.slice(
                args[0].rows,
                (*params["start_indices"], 0),
                (*params["limit_indices"], lanes),
                None if strides is None else (*strides, 1),
            ),
            args[0].work,
        )
    ]


def _concatenate(args: list[Value], params: Params, lanes: int) -> list[Value]:
    return [join_rows([rows_of(arg, lanes) for arg in args], int(params["dimension"]))]


def _stack(args: list[Value], params: Params, lanes: int) -> list[Value]:
    axis = params["axis"]
    rows = [lax.expand_dims(rows_of(arg, lanes), (axis,)) for arg in args]
    return [join_rows(rows, axis)]


def _split(args: list[Lane], params: Params, lanes: int) -> list[Value]:
    axis, ends = params["axis"], np.cumsum(params["sizes"])
    return [
        Lane(lax.slice_in_dim(args[0].rows, int(end - size), int(end), axis=axis), args[0].work)
        for size, end in zip(params["sizes"], ends, strict=True)
    ]


def _pad(args: list[Value], params: Params, lanes: int) -> list[Value] | None:
    if isinstance(args[1], Lane):
        return None
    value = jnp.asarray(args[1])
    return [Lane(lax.pad(rows_of(args[0], lanes), value, (*params["padding_config"], (0, 0, 0))))]


def _rev(args: list[Lane], params: Params, lanes: int) -> list[Value]:
    return [Lane(lax.rev(args[0].rows, params["dimensions"]))]


def _reduce(combine: Combine) -> Callable[..., list[Value] | None]:
    def rule(args: list[Lane], params: Params, lanes: int) -> list[Value] | None:
        axes, rows = tuple(map(int, params["axes"])), args[0].rows
        terms = math.prod(rows.shape[axis] for axis in axes)
        if not 0 < terms <= UNROLLED:
            return None
        places = np.ndindex(*(rows.shape[axis] for axis in axes))
        addends = (at_place(rows, dict(zip(axes, index, strict=True))) for index in places)
        return [Lane(functools.reduce(combine, addends), terms)]

    return rule


def _running(combine: Combine, neutral: int) -> Callable[..., list[Value]]:
    """The rule of a cumulative sum or product, by doubling: XLA's cost is quadratic in length."""

    def rule(args: list[Lane], params: Params, lanes: int) -> list[Value]:
        axis, rows = params["axis"], args[0].rows
        return [Lane(scan_rows(rows, axis, combine, neutral, params["reverse"]))]

    return rule


def _dot_general(args: list[Value], params: Params, lanes: int) -> list[Value] | None:
    (left_k, right_k), (left_b, right_b) = params["dimension_numbers"]
    left, right = args
    shapes = [a.shape for a in args]
    free = [
        [d for d in range(len(shape)) if d not in (*k, *b)]
        for shape, k, b in zip(shapes, (left_k, right_k), (left_b, right_b), strict=True)
    ]
    sizes = [shapes[0][d] for d in left_k]
    if math.prod(sizes) == 0:
        return None
    total: jax.Array | None = None
    batch = [shapes[0][d] for d in left_b]
    kept_left = [shapes[0][d] for d in free[0]]
    kept_right = [shapes[1][d] for d in free[1]]
    out_shape = (*batch, *kept_left, *kept_right, lanes)
    nb, nl, nr = len(batch), len(kept_left), len(kept_right)
    left_dims = (*range(nb), *range(nb, nb + nl))
    right_dims = (*range(nb), *range(nb + nl, nb + nl + nr))

    def term(
        value: Value,
        k: Sequence[int],
        b: Sequence[int],
        f: list[int],
        at: tuple[int, ...],
        dims: tuple[int, ...],
    ) -> jax.Array | None:
        index = dict(zip(k, at, strict=True))
        rest = [d for d in range(len(value.shape)) if d not in index]
        perm = [rest.index(d) for d in (*b, *f)]
        if isinstance(value, Lane):
            chosen = lax.transpose(at_place(value.rows, index), (*perm, len(perm)))
            return lax.broadcast_in_dim(chosen, out_shape, (*dims, nb + nl + nr))
        if isinstance(value, np.ndarray):
            entries = value[tuple(index.get(d, slice(None)) for d in range(value.ndim))]
            if not np.any(entries):
                return None
            chosen = jnp.asarray(entries.transpose(perm))
        else:
            chosen = lax.transpose(at_place(jnp.asarray(value), index), perm)
        return lax.broadcast_in_dim(chosen, out_shape, dims)

    if math.prod(sizes) > UNROLLED:
        pairs = [
            lax.broadcast_in_dim(
                lax.transpose(rows_of(v, lanes), (*b, *f, *k, len(v.shape))),
                (*out_shape[:-1], *sizes, lanes),
                (*dims, *range(len(out_shape) - 1, len(out_shape) + len(sizes))),
            )
            for v, k, b, f, dims in (
                (left, left_k, left_b, free[0], left_dims),
                (right, right_k, right_b, free[1], right_dims),
            )
        ]
        axes = tuple(range(len(out_shape) - 1, len(out_shape) - 1 + len(sizes)))
        return [Lane(jnp.sum(pairs[0] * pairs[1], axis=axes), DEAR + 1)]
    for at in np.ndindex(*sizes):
        a = term(left, left_k, left_b, free[0], at, left_dims)
        b = term(right, right_k, right_b, free[1], at, right_dims)
        if a is not None and b is not None:
            total = a * b if total is None else total + a * b
    if total is None:
        total = jnp.zeros(out_shape, params["preferred_element_type"])
    return [Lane(total, 2 * math.prod(sizes))]


ELEMENTWISE = set(
    "abs acos acosh add add_any and asin asinh atan atan2 atanh bitcast_convert_type cbrt ceil "
    "clamp convert_element_type copy copy_p cos cosh div eq eq_to erf erf_inv erfc exp exp2 expm1 "
    "floor ge gt integer_pow is_finite le le_to lgamma log log1p logistic lt lt_to max min mul ne "
    "neg nextafter not or pow rem round rsqrt select_n shift_left shift_right_arithmetic "
    "shift_right_logical sign sin sinh sqrt square sub tan tanh xor".split()
)
VIEWS = {
    *"broadcast_in_dim reshape squeeze transpose slice split rev stop_gradient".split(),
    "nondifferentiable_backward",
}
_FREE = {"convert_element_type", "copy", "copy_p", "neg", "not", "bitcast_convert_type"}
_SLOW = set(
    "acos acosh asin asinh atan atan2 atanh cbrt cos cosh div erf erf_inv erfc exp exp2 expm1 "
    "lgamma log log1p logistic pow rsqrt sin sinh sqrt tan tanh".split()
)
RULES: dict[str, Callable[..., list[Value] | None]] = {
    "stop_gradient": _same,
    "nondifferentiable_backward": _same,
    "nonbatchable": _same,
    "unvmap_any": _any_lane,  # equinox's loops, which freeze ended lanes themselves
    "broadcast_in_dim": _broadcast_in_dim,
    "reshape": _reshape,
    "squeeze": _squeeze,
    "transpose": _transpose,
    "slice": _slice,
    "concatenate": _concatenate,
    "stack": _stack,
    "split": _split,
    "pad": _pad,
    "rev": _rev,
    "reduce_sum": _reduce(lax.add),
    "reduce_max": _reduce(lax.max),
    "reduce_min": _reduce(lax.min),
    "reduce_and": _reduce(lax.bitwise_and),
    "reduce_or": _reduce(lax.bitwise_or),
    "argmax": arg_extreme(lax.gt),
    "argmin": arg_extreme(lax.lt),
    "dot_general": _dot_general,
    "cumsum": _running(lax.add, 0),
    "cumprod": _running(lax.mul, 1),
    "atan2": _atan2,
    "gather": gather,
    "dynamic_slice": dynamic_slice,
    "scatter": scatter,
    "sort": sort,
    "top_k": top_k,
}


def _plain(fn: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *args, **params: fn(*args)


NUMPY: dict[str, Callable[..., Any]] = {
    "iota": lambda dtype, shape, dimension, **_: np.broadcast_to(
        np.arange(shape[dimension], dtype=dtype).reshape(
            [-1 if d == dimension else 1 for d in range(len(shape))]
        ),
        shape,
    ),
    "lt": _plain(np.less),
    "le": _plain(np.less_equal),
    "gt": _plain(np.greater),
    "ge": _plain(np.greater_equal),
    "eq": _plain(np.equal),
    "ne": _plain(np.not_equal),
    "add": _plain(np.add),
    "sub": _plain(np.subtract),
    "mul": _plain(np.multiply),
    "neg": _plain(np.negative),
    "and": _plain(np.bitwise_and),
    "or": _plain(np.bitwise_or),
    "select_n": lambda which, *cases: np.where(which, cases[1], cases[0]),
    "broadcast_in_dim": lambda x, shape, broadcast_dimensions, **_: np.broadcast_to(
        x.reshape([x.shape[broadcast_dimensions.index(d)] if d in broadcast_dimensions else 1
                   for d in range(len(shape))]), shape
    ),
    "concatenate": lambda *x, dimension: np.concatenate(x, dimension),
    "convert_element_type": lambda x, new_dtype, **_: x.astype(new_dtype),
    "reshape": lambda x, new_sizes, **_: x.reshape(new_sizes),
    "squeeze": lambda x, dimensions: x.squeeze(tuple(dimensions)),
    "transpose": lambda x, permutation: x.transpose(permutation),
    "stack": lambda *x, axis: np.stack(x, axis),
    "copy": lambda x: x,
}  # fmt: skip
