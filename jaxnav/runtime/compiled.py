"""What a car calls, compiled once on a machine and loaded ever after: `Navigator.step`, and others.

JAX's own cache spares a later process the compiler, but tracing and lowering a step take longer
than loading it. So the executable itself is kept.
"""

import hashlib
import os
import pickle
import platform
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import jaxlie
import numpy as np
from jax.experimental import serialize_executable

from jaxnav.navigator import Navigator, Step, jitted_step

_KEPT = 32  # executables, of some MB each: the last ones used
_LIBRARIES = ("jax", "jaxlib", "jaxlie", "equinox", "optimistix", "lineax")


def compiled_step(navigator: Navigator, folder: Path | None) -> Step:
    """`jax.jit(navigator.step)`, whose first call loads what another process has compiled.

    See `compiled`.
    """
    if folder is None:
        return partial(jitted_step, navigator)
    return compiled(Navigator.step, navigator, folder)


def compiled(
    function: Callable[..., Any], navigator: Navigator, folder: Path | None
) -> Callable[..., Any]:
    """`jax.jit(function)` of a navigator, whose first call loads what another process has compiled.

    Executables hold none of the navigator's numbers: a car that was calibrated anew loads what it
    compiled before. The call raises TypeError when the arguments' shapes or types change from
    call to call.

    Args:
        function: of a navigator and of further trees of arrays; one of jaxnav's own.
        folder: of executables, made when it is missing, and run as they are found: nobody else may
            write there. Without one, and where the navigator has parts that are not jaxnav's own,
            nothing is kept.

    Returns:
        The function of the further trees.
    """
    if folder is None or not all(_is_ours(part) for part in _parts(navigator)):
        return partial(_jitted(function), navigator)
    numbers, structure = jax.tree.flatten(navigator)
    numbers = [jnp.asarray(number) for number in numbers]
    ready: dict[Any, tuple[Any, Any]] = {}  # a program for each set of fields that are there

    def call(*told: Any) -> Any:
        leaves, given = jax.tree.flatten(told)
        if given not in ready:
            inputs = jax.tree.leaves(jax.eval_shape(lambda: told))
            name = f"{function.__module__}.{function.__qualname__}"
            file = _file(folder, str((name, structure, given)), [*numbers, *inputs])
            ready[given] = _loaded(file, numbers, inputs) or _compiled(
                function, file, structure, given, numbers, inputs
            )
        program, returned = ready[given]
        return jax.tree.unflatten(returned, program(numbers, leaves))

    return call


def is_compiled(
    function: Callable[..., Any], navigator: Navigator, folder: Path, *told: Any
) -> bool:
    """Whether `compiled(function, navigator, folder)(*told)` finds its executable in the folder."""
    numbers, structure = jax.tree.flatten(navigator)
    given = jax.tree.structure(told)
    inputs = jax.tree.leaves(jax.eval_shape(lambda: told))
    name = f"{function.__module__}.{function.__qualname__}"
    leaves = [*map(jnp.asarray, numbers), *inputs]
    return _file(folder, str((name, structure, given)), leaves).is_file()


@cache
def _jitted(function: Callable[..., Any]) -> Callable[..., Any]:
    """One program for all navigators of a structure."""
    return jax.jit(function)


def _compiled(
    function: Callable[..., Any],
    file: Path,
    structure: Any,
    given: Any,
    numbers: list[Any],
    inputs: list[Any],
) -> tuple[Any, Any]:
    seen: list[Any] = []

    def flat(numbers: list[Any], inputs: list[Any]) -> list[Any]:
        told = jax.tree.unflatten(given, inputs)
        returned = function(jax.tree.unflatten(structure, numbers), *told)
        seen.append(returned)
        return jax.tree.leaves(returned)

    # By a name that JAX's own cache has never met: what it loads runs, but lacks its kernels once
    # stored again.
    flat.__name__ = f"step_{time.time_ns()}"
    program = jax.jit(flat).lower(numbers, inputs).compile()
    shape = jax.tree.map(lambda leaf: 0, seen[0])  # whose tree could not be stored by itself
    with suppress(ValueError, NotImplementedError):  # of a backend that can't
        _keep(file, (serialize_executable.serialize(program), shape))
    return program, jax.tree.structure(shape)


def _loaded(file: Path, numbers: list[Any], inputs: list[Any]) -> tuple[Any, Any] | None:
    try:
        stored, shape = pickle.loads(file.read_bytes())
        program = serialize_executable.deserialize_and_load(*stored)
        blank = [np.zeros(like.shape, like.dtype) for like in inputs]
        jax.block_until_ready(program(numbers, blank))  # what is damaged shows now
        file.touch()
    except Exception:  # none yet, or damaged in whatever way: it is made anew
        return None
    return program, jax.tree.structure(shape)


def _keep(file: Path, content: Any) -> None:
    """All of it or nothing, and of older ones no more than `_KEPT`."""
    try:
        file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=file.parent, delete=False) as part:
            try:
                part.write(pickle.dumps(content))
                part.flush()
                Path(part.name).replace(file)
            except BaseException:
                Path(part.name).unlink(missing_ok=True)
                raise
        by_use = sorted(file.parent.glob("*.step"), key=lambda path: path.stat().st_mtime)
        for old in by_use[:-_KEPT]:
            old.unlink(missing_ok=True)
    except OSError:
        return  # a full or a foreign disk: the program is there all the same


def _file(folder: Path, structures: str, leaves: list[Any]) -> Path:
    """Named by all that the executable depends on."""
    device = jax.devices()[0]
    sources = sorted(Path(__file__).resolve().parents[1].glob("*.py"))
    depends_on = [
        structures,
        [(leaf.shape, str(leaf.dtype)) for leaf in leaves],
        [(name, version(name)) for name in _LIBRARIES],
        (device.platform, device.device_kind, platform.machine(), platform.node()),
        str(jnp.zeros(()).dtype),
        (os.environ.get("XLA_FLAGS"), os.environ.get("PJRT_NPROC")),
        [hashlib.sha256(source.read_bytes()).hexdigest() for source in sources],
    ]
    return folder / f"{hashlib.sha256(repr(depends_on).encode()).hexdigest()}.step"


def _is_ours(part: Any) -> bool:
    return isinstance(part, jaxlie.MatrixLieGroup) or type(part).__module__.startswith("jaxnav.")


def _parts(module: Any) -> Iterator[Any]:
    """A module and all that it consists of."""
    yield module
    parts = jax.tree.leaves(
        list(vars(module).values()) if isinstance(module, eqx.Module) else [],
        is_leaf=lambda part: isinstance(part, eqx.Module | jaxlie.MatrixLieGroup),
    )
    for part in parts:
        if isinstance(part, eqx.Module | jaxlie.MatrixLieGroup):
            yield from _parts(part)
