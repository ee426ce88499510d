"""Check the shapes and dtypes of arrays that annotations state, and no other type.

Outside the core a test may pass a stand-in where an annotation names a class, and NumPy's arrays
where it names JAX's.
"""

import dataclasses
import types
from collections.abc import Callable
from functools import reduce
from operator import or_
from typing import Any, get_args, get_origin

import jax
import jaxtyping
import numpy as np
from beartype import beartype
from jaxtyping import AbstractArray


def wrap_arrays_alone() -> None:
    """Keep jaxtyping's import hook off functions and classes without an array to check.

    It binds the arguments of every call twice, and compiles a closure's check anew wherever the
    closure is made: a third of the time of a simulated drive. What the type checker itself asks of
    these functions is still asked.
    """
    wrap = jaxtyping.jaxtyped

    def jaxtyped(*given: Any, **options: Any) -> Any:
        if given or options.get("typechecker") is None:
            return wrap(*given, **options)
        check = options["typechecker"]

        def decorate(thing: Any) -> Any:
            if isinstance(thing, types.FunctionType):
                hints = thing.__annotations__
                if not any(map(_holds_array, hints.values())):
                    return check(thing) if hints else thing
            elif isinstance(thing, type) and dataclasses.is_dataclass(thing):
                if check(thing.__init__) is thing.__init__:
                    return thing
            return wrap(**options)(thing)

        return decorate

    jaxtyping.jaxtyped = jaxtyped


def check_arrays(function: Callable[..., Any]) -> Callable[..., Any]:
    """A type checker for jaxtyping's import hook: it looks at annotations that hold an array."""
    # A tree is also put together from other leaves: masks, axes, results of partition.
    if function.__name__ == "__init__":
        return function
    kept = {name: _lenient(of) for name, of in function.__annotations__.items() if _holds_array(of)}
    if not kept:
        return function
    function.__annotations__ = kept
    return beartype(function)


def _holds_array(annotation: Any) -> bool:
    return _is_array(annotation) or any(_holds_array(part) for part in get_args(annotation))


def _is_array(annotation: Any) -> bool:
    return isinstance(annotation, type) and issubclass(annotation, AbstractArray)


def _lenient(annotation: Any) -> Any:
    """The annotation, with either kind of array where JAX's is named."""
    if _is_array(annotation):
        if annotation.array_type is not jax.Array or annotation.dtype.__name__ == "Key":
            return annotation
        return annotation.dtype[jax.Array | np.ndarray, annotation.dim_str]
    parts = [_lenient(part) for part in get_args(annotation)]
    if not any(map(_holds_array, parts)):
        return annotation
    if isinstance(annotation, types.UnionType):
        return reduce(or_, parts)
    return get_origin(annotation)[tuple(parts)]
