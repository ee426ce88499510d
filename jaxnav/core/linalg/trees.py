"""`where` for trees of arrays, and a module under another class."""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array, ArrayLike, Bool

_Tree = TypeVar("_Tree")
_Module = TypeVar("_Module")


def where(condition: Bool[Array, "*rows"], yes: _Tree, no: _Tree) -> _Tree:
    """`jnp.where` of every leaf; the condition's axes are the leaves' leading ones."""

    def choose(a: ArrayLike, b: ArrayLike) -> Array:
        shape = condition.shape + (1,) * (jnp.ndim(a) - condition.ndim)
        return jnp.where(condition.reshape(shape), a, b)

    chosen: _Tree = jax.tree.map(choose, yes, no)
    return chosen


def as_class(cls: type[_Module], module: object) -> _Module:
    """An instance of a class, which may override methods, with the fields of another module."""
    other = object.__new__(cls)
    for name, part in vars(module).items():
        object.__setattr__(other, name, part)
    return other
