"""Convert a compiled program to bytes and back: XLA's format for machine code, JSON for the rest.

Reading executes no Python code that the bytes name: there is no pickle. The machine code is run
without a check, so it must be trusted all the same.
"""

import dataclasses
import hashlib
import json
import struct
import sys
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

import jax
import jax.numpy as jnp
from jax.tree_util import PyTreeDef
from jax.typing import ArrayLike
from jaxtyping import PyTree

_CHECKSUM_BYTES = 32  # at the beginning: the checksum of all that follows
_LENGTH = struct.Struct("<Q")  # then the length of the JSON, the JSON, and the machine code
_OURS = ("jaxnav", "jaxlie")  # packages whose classes a tree may contain

Run = Callable[[Sequence[ArrayLike]], list[jax.Array]]


class NotStorableError(ValueError):
    """A program, or the tree that it returns, can't be converted to bytes."""


def to_bytes(compiled: Any, returned: PyTree) -> bytes:
    """Convert a compiled program to the bytes that `from_bytes` reads.

    Args:
        compiled: JAX's compiled program; takes a list of arrays and returns one.
        returned: a tree with the returned arrays, or anything in their place, as leaves.

    Raises:
        NotStorableError: it does more than to map arrays to arrays, its backend can't store it, or
            the tree has classes that are not jaxnav's own.
    """
    held = getattr(compiled._executable, "_unloaded_executable", None)
    if held is None or compiled._params.const_args:
        raise NotStorableError("closes over arrays, or its backend can't store it")
    if held.unordered_effects or held.ordered_effects or held.host_callbacks or held.mut:
        raise NotStorableError("does more than to compute")
    shape = jax.tree.map(lambda leaf: 0, returned)
    tree = _plain(shape)
    structure: Any = jax.tree.structure(shape)
    if jax.tree.structure(_tree(tree)) != structure:
        raise NotStorableError(f"{structure} is not all that its fields say")
    head = json.dumps(
        {
            "used": sorted(held.kept_var_idx),
            "outputs": [[a.shape, str(a.dtype), a.weak_type] for a in held.output_avals],
            "tree": tree,
        }
    ).encode()
    try:
        machine_code = held.backend.serialize_executable(held.xla_executable)
    except jax.errors.JaxRuntimeError as error:
        raise NotStorableError(str(error)) from None
    content = _LENGTH.pack(len(head)) + head + machine_code
    return _checksum(content) + content


def from_bytes(raw: bytes, inputs: list[jax.ShapeDtypeStruct]) -> tuple[Run, PyTreeDef]:
    """Load a program; return it, ready to be called, and the structure of the tree it returns.

    Args:
        inputs: shapes and types of the arrays that it takes.

    Raises:
        Exception: of any kind, where the bytes are damaged or from another JAX or machine.
    """
    content = raw[_CHECKSUM_BYTES:]
    # Damaged machine code may do anything: it must not even be parsed.
    if _checksum(content) != raw[:_CHECKSUM_BYTES]:
        raise ValueError("damaged")
    (length,) = _LENGTH.unpack_from(content)
    begin = _LENGTH.size + length
    head = json.loads(content[_LENGTH.size : begin])
    like = _small_program()
    executable = like.backend.deserialize_executable(
        content[begin:], executable_devices=like.device_list
    )
    used, (scalar,) = head["used"], like.input_avals
    input_avals = [
        scalar.update(shape=inputs[n].shape, dtype=inputs[n].dtype, weak_type=inputs[n].weak_type)
        for n in used
    ]
    output_avals = [
        scalar.update(shape=tuple(shape), dtype=jnp.dtype(dtype), weak_type=weak_type)
        for shape, dtype, weak_type in head["outputs"]
    ]
    held = dataclasses.replace(
        like,
        xla_executable=executable,
        input_avals=input_avals,
        input_shardings=list(like.input_shardings) * len(used),
        xla_in_layouts=[None] * len(used),
        dispatch_in_layouts=[None] * len(used),
        output_avals=output_avals,
        output_shardings=list(like.output_shardings) * len(output_avals),
        xla_out_layouts=[None] * len(output_avals),
        kept_var_idx=set(used),
        all_args_info=None,
    )
    structure = jax.tree.structure([0] * len(output_avals))
    run = jax.stages.Compiled(held.load(), [], ((inputs,), {}), structure, no_kwargs=True)
    return run, jax.tree.structure(_tree(head["tree"]))


@cache
def _small_program() -> Any:
    """A template of JAX's form of a program; a loaded one replaces signature and machine code."""
    scalar = jax.ShapeDtypeStruct((), jnp.float32)
    compiled = jax.jit(lambda leaves: [leaf + 1 for leaf in leaves]).lower([scalar]).compile()
    return compiled._executable._unloaded_executable  # type: ignore[attr-defined]


def _plain(value: PyTree) -> Any:
    """Convert a tree, with its fields and the placeholders of its leaves, to JSON values."""
    kind = type(value)
    if value is None or kind in (bool, int, float, str):
        return value
    if kind in (list, tuple):
        return [kind.__name__, *map(_plain, value)]
    if kind is dict and all(type(key) is str for key in value):
        return ["dict", {key: _plain(inner) for key, inner in value.items()}]
    name = f"{kind.__module__}:{kind.__qualname__}"
    _class(name)
    if isinstance(value, tuple):
        return [name, *map(_plain, value)]
    fields = (field.name for field in dataclasses.fields(value))
    # An Equinox module need not have all of its fields.
    return [name, {field: _plain(getattr(value, field)) for field in fields if _has(value, field)}]


def _tree(plain: Any) -> PyTree:
    """The inverse of `_plain`. It calls no constructor, but sets the fields of each object."""
    if not isinstance(plain, list):
        return plain
    name, *content = plain
    if name == "list":
        return [_tree(inner) for inner in content]
    if name == "tuple":
        return tuple(_tree(inner) for inner in content)
    if name == "dict":
        return {key: _tree(inner) for key, inner in content[0].items()}
    kind = _class(name)
    if issubclass(kind, tuple):
        return tuple.__new__(kind, [_tree(inner) for inner in content])
    made = object.__new__(kind)
    known = {field.name for field in dataclasses.fields(kind)}
    for field, inner in content[0].items():
        if field not in known:
            raise ValueError(f"{name} has no {field}")
        object.__setattr__(made, field, _tree(inner))
    return made


def _class(name: str) -> Any:
    """Find a class by `module:name` among the modules already imported."""
    module, _, qualified = name.partition(":")
    member: Any = sys.modules.get(module)
    if module.partition(".")[0] in _OURS:
        for part in qualified.split("."):
            member = getattr(member, part, None)
        is_named = isinstance(member, type) and hasattr(member, "_fields")
        if isinstance(member, type) and (dataclasses.is_dataclass(member) or is_named):
            return member
    raise NotStorableError(f"{name} is no class of jaxnav's that consists of fields")


def _has(value: object, field: str) -> bool:
    try:
        getattr(value, field)
    except AttributeError:
        return False
    return True


def _checksum(content: bytes) -> bytes:
    return hashlib.sha256(content).digest()
