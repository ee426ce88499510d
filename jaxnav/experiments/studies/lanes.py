"""Run one function over many lanes, in fixed batches on all local devices, reproducible bit by bit.

All batches have one shape, so that every lane is computed by the same machine code in any place.
Several devices take one batch each.
"""

import functools
from collections.abc import Callable
from typing import Any, TypeVar

import jax
import numpy as np
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Num, PyTree, Shaped

BATCH = 2048
Tree = TypeVar("Tree")


def run_lanes(
    program: Callable[..., PyTree],
    shared: tuple[PyTree, ...],
    lanes: tuple[Num[np.ndarray, "L ..."], ...],
    precision: str,
) -> dict[str, Shaped[np.ndarray, "L ..."]]:
    """Run program(*shared, *lane) -> dict of arrays for every lane; the results are on the host.

    Args:
        program: a function of one lane; pass the same object for the same program, or it is
            compiled again.
        shared: arguments common to all lanes.
        lanes: arrays with a common leading axis, floats in any precision.
        precision: "float32" or "float64".
    """
    count = len(lanes[0])
    with jax.enable_x64(precision == "float64"):
        devices = tuple(jax.local_devices())
        batch = BATCH * len(devices)
        run, sharding = _compiled(program, devices)
        parts = []
        shared, lanes = in_precision((shared, lanes), precision)
        for begin in range(0, count, batch):
            some = [_padded(leaf[begin : begin + batch], batch) for leaf in lanes]
            outputs = run(shared, *jax.device_put(some, sharding))
            kept = min(batch, count - begin)
            parts.append({name: leaf[:kept] for name, leaf in jax.device_get(outputs).items()})
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def in_precision(tree: Tree, precision: str) -> Tree:
    """The tree as NumPy arrays, with floats in the study's precision."""

    def one(leaf: Any) -> np.ndarray:
        array = np.asarray(leaf)
        return array.astype(precision) if array.dtype.kind == "f" else array

    converted: Tree = jax.tree.map(one, tree)
    return converted


@functools.lru_cache(maxsize=64)
def _compiled(
    program: Callable[..., PyTree], devices: tuple[jax.Device, ...]
) -> tuple[Callable[..., PyTree], NamedSharding]:
    mesh = Mesh(np.array(devices), ("lane",))
    lane, everywhere = PartitionSpec("lane"), PartitionSpec()

    def on_one_device(shared: tuple[PyTree, ...], *lanes: jax.Array) -> PyTree:
        return jax.vmap(lambda *one: program(*shared, *one))(*lanes)

    def batch(shared: tuple[PyTree, ...], *lanes: jax.Array) -> PyTree:
        if len(devices) == 1:
            return on_one_device(shared, *lanes)
        return jax.shard_map(
            on_one_device,
            mesh=mesh,
            in_specs=(everywhere, *[lane] * len(lanes)),
            out_specs=lane,
            check_vma=False,
        )(shared, *lanes)

    return jax.jit(batch), NamedSharding(mesh, lane)


def _padded(leaf: np.ndarray, length: int) -> np.ndarray:
    return np.concatenate([leaf, np.repeat(leaf[-1:], length - len(leaf), axis=0)])
