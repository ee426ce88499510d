"""Pack trees of arrays into two vectors, since each array passed to a compiled call costs some us.

packed = PackedLayout.from_tree(tree).pack(tree)
tree = packed.unpack()
"""

import math
from dataclasses import dataclass, field
from functools import cached_property, partial

import jax
import jax.numpy as jnp
import numpy as np
from jax.tree_util import PyTreeDef
from jaxtyping import PyTree

Vector = jax.Array | np.ndarray


@dataclass(frozen=True)
class LeafPlace:
    """The place of a tree's leaf in one of the vectors."""

    begin: int
    shape: tuple[int, ...]
    dtype: str
    is_float: bool

    @property
    def end(self) -> int:
        """The index where the next leaf begins."""
        return self.begin + math.prod(self.shape)


@dataclass(frozen=True, eq=False)
class PackedLayout:
    """A tree with places as leaves. Layouts are equal if structure, shapes and types are."""

    places: PyTree
    precision: str
    key: str = field(repr=False)

    @staticmethod
    def from_tree(tree: PyTree) -> "PackedLayout":
        """The layout of a tree of floats of one precision, integers in int32's range, and bools."""
        leaves, structure = jax.tree.flatten(tree)
        places, ends, precision = [], [0, 0], "float32"
        for leaf in leaves:
            is_float = bool(jnp.issubdtype(leaf.dtype, jnp.floating))
            precision = str(leaf.dtype) if is_float else precision
            places.append(LeafPlace(ends[is_float], leaf.shape, str(leaf.dtype), is_float))
            ends[is_float] += math.prod(leaf.shape)
        return PackedLayout(
            jax.tree.unflatten(structure, places), precision, f"{structure} {places}"
        )

    def pack(self, tree: PyTree) -> "Packed":
        """Pack a tree of this layout."""
        floats, integers = [jnp.zeros(0, self.precision)], [jnp.zeros(0, jnp.int32)]
        places = jax.tree.leaves(self.places)
        for leaf, place in zip(jax.tree.leaves(tree), places, strict=True):
            part = floats if place.is_float else integers
            part.append(jnp.ravel(leaf).astype(part[0].dtype))
        return Packed(jnp.concatenate(floats), jnp.concatenate(integers), self)

    def unpack(self, floats: Vector, integers: Vector) -> PyTree:
        """The tree of packed vectors."""
        leaves = self._views(floats, integers)
        for index, dtype in self._casts:
            leaves[index] = leaves[index].astype(dtype)
        return jax.tree.unflatten(self._structure, leaves)

    def room(self) -> tuple["Packed", PyTree]:
        """Vectors of NumPy zeros, and a tree of writable views of them, with bools as integers."""
        integers, floats = self._sizes
        packed = Packed(np.zeros(floats, self.precision), np.zeros(integers, np.int32), self)
        views = self._views(packed.floats, packed.integers)
        return packed, jax.tree.unflatten(self._structure, views)

    def _views(self, floats: Vector, integers: Vector) -> list[jax.Array | np.ndarray]:
        parts = integers, floats
        return [
            parts[is_float][where] if shape is None else parts[is_float][where].reshape(shape)
            for where, shape, is_float in self._slices
        ]

    @cached_property
    def _slices(self) -> list[tuple[slice, tuple[int, ...] | None, bool]]:
        """The slice and shape of each leaf; None for a vector, since each reshape takes 1 us."""
        return [
            (slice(at.begin, at.end), None if len(at.shape) == 1 else at.shape, at.is_float)
            for at in jax.tree.leaves(self.places)
        ]

    @cached_property
    def _casts(self) -> list[tuple[int, np.dtype]]:
        """The indices and types of the leaves that are neither floats nor int32."""
        places = list(enumerate(jax.tree.leaves(self.places)))
        others = [(index, at) for index, at in places if not at.is_float and at.dtype != "int32"]
        return [(index, np.dtype(at.dtype)) for index, at in others]

    @cached_property
    def _sizes(self) -> tuple[int, int]:
        """The numbers of integers and of floats."""
        places = jax.tree.leaves(self.places)
        integers, floats = (
            max((at.end for at in places if at.is_float is kind), default=0)
            for kind in (False, True)
        )
        return integers, floats

    @cached_property
    def _structure(self) -> PyTreeDef:
        return jax.tree.structure(self.places)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, PackedLayout) and self.key == other.key

    def __hash__(self) -> int:
        return hash(self.key)


@partial(
    jax.tree_util.register_dataclass, data_fields=("floats", "integers"), meta_fields=("layout",)
)
@dataclass(frozen=True)
class Packed:
    """The numbers of a tree in two vectors, JAX's or NumPy's."""

    floats: Vector  # (n,)
    integers: Vector  # (m,) int32
    layout: PackedLayout

    def unpack(self) -> PyTree:
        """The tree of these numbers."""
        return self.layout.unpack(self.floats, self.integers)

    def fetch(self) -> "Packed":
        """The same numbers in NumPy arrays."""
        return Packed(np.asarray(self.floats), np.asarray(self.integers), self.layout)
