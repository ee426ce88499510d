"""Trees of arrays as two vectors: what enters or leaves a compiled call costs some us an array.

packed = Layout.of(tree).pack(tree)
tree = packed.unpacked()
"""

import math
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


@dataclass(frozen=True)
class Place:
    """Where a leaf of a tree is."""

    begin: int
    shape: tuple[int, ...]
    dtype: str
    is_float: bool

    @property
    def end(self) -> int:
        """Where the next one begins."""
        return self.begin + math.prod(self.shape)


@dataclass(frozen=True, eq=False)
class Layout:
    """A tree with places for leaves. Equal where structure, shapes and types are."""

    places: Any
    precision: str
    key: str = field(repr=False)

    @staticmethod
    def of(tree: Any) -> "Layout":
        """Of floats of one precision, integers that int32 holds, and truth values."""
        leaves, structure = jax.tree.flatten(tree)
        places, ends, precision = [], [0, 0], "float32"
        for leaf in leaves:
            is_float = bool(jnp.issubdtype(leaf.dtype, jnp.floating))
            precision = str(leaf.dtype) if is_float else precision
            places.append(Place(ends[is_float], leaf.shape, str(leaf.dtype), is_float))
            ends[is_float] += math.prod(leaf.shape)
        return Layout(jax.tree.unflatten(structure, places), precision, f"{structure} {places}")

    def pack(self, tree: Any) -> "Packed":
        """A tree of this layout."""
        floats, integers = [jnp.zeros(0, self.precision)], [jnp.zeros(0, jnp.int32)]
        places = jax.tree.leaves(self.places)
        for leaf, place in zip(jax.tree.leaves(tree), places, strict=True):
            part = floats if place.is_float else integers
            part.append(jnp.ravel(leaf).astype(part[0].dtype))
        return Packed(jnp.concatenate(floats), jnp.concatenate(integers), self)

    def unpack(self, floats: Any, integers: Any) -> Any:
        """The tree."""
        leaves = [
            floats[begin:end].reshape(shape)
            if is_float
            else integers[begin:end].reshape(shape).astype(dtype, copy=False)
            for begin, end, shape, dtype, is_float in self._slices
        ]
        return jax.tree.unflatten(self._structure, leaves)

    def room(self) -> tuple["Packed", Any]:
        """Zeros of NumPy's, and a tree of views to write to; truth values are integers there."""
        ends = [0, 0]
        for _, end, _, _, is_float in self._slices:
            ends[is_float] = max(ends[is_float], end)
        numbers = np.zeros(ends[0], np.int32), np.zeros(ends[1], self.precision)
        views = [
            numbers[is_float][begin:end].reshape(shape)
            for begin, end, shape, _, is_float in self._slices
        ]
        return Packed(numbers[1], numbers[0], self), jax.tree.unflatten(self._structure, views)

    @cached_property
    def _slices(self) -> list[tuple[int, int, tuple[int, ...], np.dtype, bool]]:
        places: list[Place] = jax.tree.leaves(self.places)
        return [(at.begin, at.end, at.shape, np.dtype(at.dtype), at.is_float) for at in places]

    @cached_property
    def _structure(self) -> Any:
        return jax.tree.structure(self.places)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Layout) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@partial(
    jax.tree_util.register_dataclass,
    data_fields=("floats", "integers"),
    meta_fields=("layout",),
)
@dataclass(frozen=True)
class Packed:
    """All numbers of a tree; of JAX's arrays, or of NumPy's."""

    floats: Any  # (n,)
    integers: Any  # (m,) int32
    layout: Layout

    def unpacked(self) -> Any:
        """The tree."""
        return self.layout.unpack(self.floats, self.integers)

    def fetched(self) -> "Packed":
        """The same, of NumPy's arrays."""
        return Packed(np.asarray(self.floats), np.asarray(self.integers), self.layout)
