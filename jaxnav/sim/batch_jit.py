"""Compile a batch of drives or recordings, which takes longer than to run it."""

import functools
import os
from collections.abc import Callable
from typing import Any, TypeVar, cast

import equinox as eqx
from jaxtyping import PyTree

from jaxnav.core.lanes.over_lanes import compiler_options

Function = TypeVar("Function", bound=Callable[..., PyTree])

jit_with = cast(Any, eqx.filter_jit)  # its types lack `compiler_options`
_LEVEL = "xla_backend_optimization_level"
# What the user sets in $XLA_FLAGS has precedence.
_OPTIONS = {} if f"--{_LEVEL}=" in os.environ.get("XLA_FLAGS", "") else {_LEVEL: 1}


def batch_jit(function: Function) -> Function:
    """`equinox.filter_jit` for what runs a few times, without LLVM's costly passes.

    They take a third of the time to compile a batch of drives, which runs 1.26 times as long
    without them (`benchmarks/README-simulate.md`).
    """
    return cast(Function, jit_with(function, compiler_options=_OPTIONS))


def lanes_jit(function: Function) -> Function:
    """`equinox.filter_jit` of a function of `over_lanes`; its first call asks for the options."""

    @functools.cache
    def compiled() -> Function:
        return cast(Function, jit_with(function, compiler_options=compiler_options()))

    @functools.wraps(function)
    def call(*args: PyTree) -> PyTree:
        return compiled()(*args)

    call.compiled = compiled  # type: ignore[attr-defined]
    return cast(Function, call)
