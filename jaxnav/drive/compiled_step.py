"""Compile a navigator's functions once on a machine: `Navigator.step`, and others."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path

import jax
import jax.numpy as jnp
from jax.tree_util import PyTreeDef
from jaxtyping import PyTree

from jaxnav.core.models.markers import MarkerMap
from jaxnav.core.models.vehicle import Vehicle
from jaxnav.core.navigator import Navigator, Step, jitted_step
from jaxnav.files import executables


def compiled_step(navigator: Navigator, folder: Path | None) -> Step:
    """`jax.jit(navigator.step)`, whose first call loads what another process has compiled.

    See `compile_or_load`.
    """
    if folder is None:
        return partial(jitted_step, navigator)
    return compile_or_load(Navigator.step, navigator, folder)


def compile_or_load(
    function: Callable[..., PyTree], navigator: Navigator, folder: Path | None
) -> Callable[..., PyTree]:
    """`jax.jit(function)` of a navigator, whose first call loads what another process has compiled.

    Executables hold none of the navigator's numbers: a car that was calibrated anew loads what it
    compiled before. The call raises TypeError when the arguments' shapes or types change from
    call to call.

    Args:
        function: one of jaxnav's own, of a navigator and of further trees of arrays.
        folder: folder of executables, see `keep_in`. Without one, or if the navigator has parts
            that are not jaxnav's own, nothing is kept.

    Returns:
        The function of the further trees, with the navigator bound.
    """
    navigator = strip_static(navigator)
    if folder is None or not executables.all_ours(navigator):
        return partial(_jitted(function), navigator)
    numbers = [jnp.asarray(number) for number in jax.tree.leaves(navigator)]
    # A program for each structure of the arguments.
    ready: dict[PyTreeDef, tuple[executables.Run, PyTreeDef]] = {}

    def call(*arguments: PyTree) -> PyTree:
        leaves, given = jax.tree.flatten(arguments)
        if given not in ready:
            ready[given] = executables.program(function, (navigator, *arguments), folder)
        program, returned = ready[given]
        return jax.tree.unflatten(returned, program([*numbers, *leaves]))

    return call


def strip_static(navigator: Navigator) -> Navigator:
    """The navigator without its vehicle's sensor corrections, its map's origin and its markers'
    names: these are static fields, not leaves, and nothing is computed with them."""

    def without(part: PyTree) -> PyTree:
        if isinstance(part, MarkerMap):
            return part.without_names()
        if not isinstance(part, Vehicle):
            return part
        return replace(
            part, speed_scale=1.0, steering_gain=1.0, steering_offset_rad=0.0, camera_delay_s=0.0
        )

    return jax.tree.map(
        without, navigator, is_leaf=lambda part: isinstance(part, Vehicle | MarkerMap)
    )


@cache
def _jitted(function: Callable[..., PyTree]) -> Callable[..., PyTree]:
    """`jax.jit(function)`, cached: one program for all navigators of a structure."""
    return jax.jit(function)
